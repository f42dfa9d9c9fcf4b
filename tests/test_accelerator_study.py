"""The study of an accelerator: what it times, and what it shows with and without one."""

from argparse import Namespace
from typing import Any

import jax
import pytest

from benchmarks import _study
from benchmarks.studies import accelerator

FOUND = {"first, s": 2.0, "ms": [9.0, 10.0, 11.0]}
FAST = {"first, s": 3.0, "ms": [1.0, 2.0, 4.0]}


@pytest.mark.parametrize("there", [False, True])
def test_it_is_drawn_and_shown(there, tmp_path, capsys):
    calls = {"smooth_grad": {"CPU": FOUND} | ({"accelerator": FAST} if there else {})}
    if there:
        calls["more than a CPU can do"] = {"accelerator": FAST}
    devices = {"CPU": "cpu"} | ({"accelerator": "NVIDIA H200"} if there else {})
    results: dict[str, Any] = {"turns": 7, "devices": devices, "calls": calls}
    accelerator.draw(results, tmp_path)
    assert (tmp_path / "accelerator.png").read_bytes().startswith(b"\x89PNG")
    (grid,) = accelerator.tables(results)
    alone, fast = ("2", "10 [9, 11]"), ("3", "2 [1, 4]", "5")
    assert grid.rows[0].cells == (alone + fast if there else alone)
    _study.show([grid])
    assert ("no accelerator" in capsys.readouterr().out) is not there


@pytest.mark.slow
def test_all_calls_are_timed_on_all_devices(monkeypatch, tmp_path):
    """More samples than the CPU is given are for an accelerator, if there is one."""
    monkeypatch.setattr(accelerator, "TURNS", 1)
    monkeypatch.setattr(accelerator, "SAMPLES", (4, 8, 2_048))
    monkeypatch.setattr(accelerator, "PARAMETERS", (10,))
    monkeypatch.setattr(accelerator, "RESIDUALS", 20)
    monkeypatch.setattr(accelerator, "SPACE", (8, 8, 3))
    found = accelerator.measure(Namespace(), tmp_path)["calls"]
    there = jax.default_backend() != "cpu"
    assert len(found) == 8 + there
    assert sum("CPU" in call for call in found.values()) == 8
    assert all(("accelerator" in call) is there for call in found.values())
    for times in (times for call in found.values() for times in call.values()):
        assert 0 < times["ms"][1] < 1e3 * times["first, s"]
