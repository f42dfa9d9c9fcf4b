"""One estimate over 1 to 8 devices, which are parts of this host and share its cores.

Strong scaling: the same samples on more devices. Weak: as many more samples as devices. Wall time
cannot fall further than there are cores, so CPU time is measured, too: where it stays the same,
sharing out costs nothing, and devices with cores of their own would be so many times as fast.

`python -m benchmarks.studies._devices 4` measures 4 devices, in a process of their own as XLA makes
them when it starts, and prints JSON.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

import smoothdiff as sd
from benchmarks._summary import quarters

DEVICES = 1, 2, 4, 8
SAMPLES, PIXELS, STEPS, TURNS = 64, 4096, 100, 7
# one thread for each device, or the first would take all cores
FLAGS = "--xla_force_host_platform_device_count={} --xla_cpu_multi_thread_eigen=false"
WAYS = "strong", "weak"


def picture(y: jax.Array) -> jax.Array:
    """Pixels that are dear, each on its own, with an edge."""
    begin = jnp.linspace(0.0, 1.0, PIXELS)
    end = jax.lax.fori_loop(0, STEPS, lambda _, x: jnp.sin(x * y[0] + y[1]), begin)
    return jnp.where(end > y[2], 1.0, 0.0)


def measured() -> Iterator[dict[str, Any]]:
    """A line for each number of devices and way of scaling, against one device."""
    first: dict[str, dict[str, Any]] = {}
    for devices in DEVICES:
        command = [sys.executable, "-m", "benchmarks.studies._devices", str(devices)]
        environment = os.environ | {"XLA_FLAGS": FLAGS.format(devices), "JAX_PLATFORMS": "cpu"}
        run = subprocess.run(command, env=environment, check=True, capture_output=True)
        for way, line in json.loads(run.stdout).items():
            one = first.setdefault(way, line)
            more = devices if way == "weak" else 1
            yield {
                "scaling": way,
                "devices": devices,
                **line,
                "times as fast": more * one["seconds"][1] / line["seconds"][1],
                "CPU time to one device's, %": 100
                * line["CPU seconds"]
                / one["CPU seconds"]
                / more,
            }


def alone(devices: int) -> dict[str, dict[str, Any]]:
    """Seconds of a gradient, and what a device keeps meanwhile."""
    mesh = jax.make_mesh((devices,), ("samples",))
    loss = lambda y: jnp.mean(picture(y))
    y, keys = jnp.array([2.0, 0.3, 0.5]), jax.random.split(jax.random.key(0), TURNS)
    found = {}
    for way in WAYS:
        samples = SAMPLES * (devices if way == "weak" else 1)
        options: Any = {"num_samples": samples, "sampler": sd.Gaussian(), "baseline": "mean"}
        gradient = sd.smooth_grad(loss, 0.1, sharding=mesh, **options)
        program = jax.jit(gradient).lower(keys[0], y).compile()
        program(keys[0], y).block_until_ready()
        seconds, cpu = [], time.process_time()
        for key in keys:
            began = time.perf_counter()
            program(key, y).block_until_ready()
            seconds.append(time.perf_counter() - began)
        cpu = (time.process_time() - cpu) / TURNS
        memory = program.memory_analysis()
        assert memory is not None
        kept = memory.temp_size_in_bytes / 1e6
        line = {"samples": samples, "seconds": quarters(seconds), "CPU seconds": cpu}
        found[way] = line | {"MB a device": kept}
    return found


if __name__ == "__main__":
    print(json.dumps(alone(int(sys.argv[1]))))
