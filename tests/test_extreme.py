"""What `python -m benchmarks stress` looks at: every check holds; most of it takes long."""

from argparse import Namespace
from functools import partial

import pytest

from benchmarks import _study
from benchmarks.studies import stress
from benchmarks.studies.stress import faults, memory, scales, shapes, simulator
from benchmarks.studies.stress._check import Check

CHEAP = {
    "scale": partial(scales.scale, baselines=("mean",)),
    "log-weights": partial(faults.log_weights, sizes=(1,)),
}
DEAR = {
    "offset": partial(scales.offset, baselines=("mean", "gp"), places=8),
    "scale, gp": partial(scales.scale, baselines=("gp",)),
    "width": scales.width,
    "decades": partial(scales.decades, baselines=("gp",)),
    "plateaus": shapes.plateaus,
    "stiff": shapes.stiff,
    "rosenbrock": shapes.rosenbrock,
    "definiteness": shapes.definiteness,
    "negated Gaussian": shapes.negated_gaussian,
    "oscillator": partial(simulator.oscillator, jumps=1, num_samples=64),
    "million": partial(memory.million, samplers=("Sobol",), num_samples=16),
    "log-weights, 10,000": partial(faults.log_weights, sizes=(10_000,)),
    "holes": partial(faults.holes, baselines=("mean", "center", "gp")),
}
DEARER = [pytest.param(case, id=name, marks=pytest.mark.slow) for name, case in DEAR.items()]


@pytest.mark.parametrize(
    "case", [*(pytest.param(case, id=name) for name, case in CHEAP.items()), *DEARER]
)
def test_every_check_holds(case):
    checks = list(case())
    assert checks
    assert [check for check in checks if not check.holds] == []


def test_verdicts_are_written_and_shown(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    checks = [
        Check("good", "kg", 2.0, 1.0),
        Check("bad", "kg", 2.0, 3.0),
        Check("void", "m", 0, float("nan")),
    ]
    monkeypatch.setattr(stress, "CASES", {"scales": lambda: iter(checks)})
    _study.run(stress, Namespace(said="a test"), tmp_path)
    printed = capsys.readouterr().out
    assert "1 of 2 fail" in printed
    assert "1 of 1 fail" in printed
    assert "bad" in printed
    assert (tmp_path / "stress.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "results.json").exists()
