"""The study of simulated workers: what its clock says, and what it shows."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies import _devices, _workers, scale

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_without_waiting_no_worker_is_idle_and_in_rounds_most_are():
    runs = [scale.search(scale.rosenbrock, 2, 4, seed=0, waits=waits) for waits in (True, False)]
    rounds, free = runs
    assert rounds["efficiency"] < 0.8
    np.testing.assert_allclose(free["efficiency"], 1.0)
    assert free["a second"] > 1.5 * rounds["a second"]


def test_a_run_that_found_nothing_is_a_dash(tmp_path):
    found = {"evaluations": 50, "seconds": 9.0, "a second": 5.0, "efficiency": 0.5, "host": 0.02}
    lost = {**found, "evaluations": None, "seconds": None}
    lines = [
        {"function": name, "workers": workers, "rounds": found, "no waiting": lost}
        for name in scale.FUNCTIONS
        for workers in (4, 32)
    ]
    devices = [
        {"scaling": way, "devices": count, "times as fast": 1.0, "CPU time to one device's, %": 100}
        for way in ("strong", "weak")
        for count in (1, 2)
    ]
    executors = [{"executor": "none", "ms a call of nothing": [0.1, 0.2, 0.3]}]
    results = {"starts": 1, "lines": lines, "cores": 2}
    results |= {"devices": devices, "executors": executors}
    simulated, _, calls = scale.tables(results)
    assert simulated.rows[0].cells == ("4", "5 / 5", "50 / 50", "50 / -", "9 / -", "20 / 20")
    assert calls.rows[0].cells == ("0.2 [0.1, 0.3]",)
    scale.draw(results, tmp_path)
    assert all((tmp_path / name).stat().st_size > 0 for name in ("scale.png", "devices.png"))


@pytest.mark.slow
def test_devices_share_out_samples_and_memory():
    """Two of them, in a process of their own."""
    flags = os.environ | {"XLA_FLAGS": _devices.FLAGS.format(2), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "benchmarks.studies._devices", "2"]
    run = subprocess.run(command, env=flags, check=True, capture_output=True, cwd=ROOT)
    strong, weak = json.loads(run.stdout).values()
    assert (strong["samples"], weak["samples"]) == (_devices.SAMPLES, 2 * _devices.SAMPLES)
    np.testing.assert_allclose(2 * strong["MB a device"], weak["MB a device"], rtol=0.01)


@pytest.mark.slow
def test_every_executor_makes_the_calls(monkeypatch):
    monkeypatch.setattr(_workers, "CALLS", 4)
    monkeypatch.setattr(_workers, "TURNS", 1)
    lines = {line["executor"]: line for line in _workers.measured()}
    assert set(lines) == set(_workers.EXECUTORS)
    assert lines["none"]["ms a call of 10 ms"][1] >= 10
