"""Derivatives in a million parameters, measured in a process of its own."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks.studies.stress._check import Check

SIZE = 1_000_000
SAMPLERS = {"Sobol": sd.Sobol(), "Gaussian": sd.Gaussian()}
# The standard deviation of one sample's a·∇F and a·∇²F a below, divided by sqrt(N)
SPREAD = {"gradient": 2.1, "Hessian-vector product": 5.3}


def million(samplers=("Sobol", "Gaussian"), num_samples: int = 64) -> Iterator[Check]:
    """Gradient and Hessian-vector product of 1e6 parameters with `batch_size=4`: memory, values."""
    for sampler in samplers:
        # spawned, as a fork of JAX can hang
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:
            memory, found = pool.submit(measure, sampler, num_samples).result()
        yield Check(f"peak, {sampler}", "GB", 2.0, memory)
        for what, value in found.items():
            away = abs(value - 1) / (SPREAD[what] / np.sqrt(num_samples))
            yield Check(f"{what}, {sampler}", "standard errors", 4.0, away)


def measure(sampler: str, num_samples: int) -> tuple[float, dict[str, float]]:
    """Peak memory in GB, and a·∇F and a·∇²F a, both 1, of f = a·x + (a·x)²/2 with |a| = 1."""
    along = jnp.full(SIZE, 1e-3)

    def fun(x):
        u = jnp.vdot(along, x)
        return u + u * u / 2

    options = {"sampler": SAMPLERS[sampler], "num_samples": num_samples, "batch_size": 4}
    key, x = jax.random.key(0), jnp.zeros(SIZE)
    grad = jax.jit(sd.smooth_grad(fun, 1.0, **options))(key, x)
    hvp = jax.jit(sd.smooth_hvp(fun, 1.0, **options))(key, x, along)
    found = {"gradient": grad, "Hessian-vector product": hvp}
    return _peak(), {what: jnp.vdot(along, value).item() for what, value in found.items()}


def _peak() -> float:
    """Peak memory of this process in GB."""
    # getrusage would count what the process that started this one held
    with open("/proc/self/status") as lines:
        line = next(line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e6
