"""What `python -m benchmarks stress` looks at, as far as it is fast: every check holds."""

from functools import partial

import pytest

from benchmarks import stress
from benchmarks.stress._check import Check

FAST = {
    "offset": partial(stress.offset, baselines=("mean", "gp")),
    "scale": stress.scale,
    "width": stress.width,
    "decades": partial(stress.decades, baselines=("gp",)),
    "plateaus": stress.plateaus,
    "stiff": stress.stiff,
    "rosenbrock": stress.rosenbrock,
    "definiteness": stress.definiteness,
    "negated Gaussian": stress.negated_gaussian,
    "oscillator": partial(stress.oscillator, jumps=1, num_samples=64),
    "million": partial(stress.million, samplers=("Sobol",), num_samples=16),
    "log-weights": partial(stress.log_weights, sizes=(1, 10_000)),
    "holes": partial(stress.holes, baselines=("mean", "center", "gp")),
}


@pytest.mark.parametrize("case", FAST.values(), ids=FAST)
def test_every_check_holds(case):
    checks = list(case())
    assert checks
    assert [check for check in checks if not check.holds] == []


def test_verdicts_are_written_and_shown(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    nan = float("nan")
    checks = [
        Check("good", "kg", 2.0, 1.0),
        Check("bad", "kg", 2.0, 3.0),
        Check("void", "m", 0, nan),
    ]
    stress.main(tmp_path, {"scales": lambda: iter(checks)})
    printed = capsys.readouterr().out
    assert "1 of 2 fail" in printed
    assert "1 of 1 fail" in printed
    assert "bad" in printed
    assert (tmp_path / "stress.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "results.json").exists()
