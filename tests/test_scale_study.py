"""The study of simulated workers: what its clock says, and what it shows."""

import numpy as np
import pytest

from benchmarks.studies import scale


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
    (grid,) = scale.tables({"starts": 1, "lines": lines})
    assert grid.rows[0].cells == ("4", "5 / 5", "50 / 50", "50 / -", "9 / -", "20 / 20")
    scale.draw({"starts": 1, "lines": lines}, tmp_path)
    assert (tmp_path / "scale.png").stat().st_size > 0
