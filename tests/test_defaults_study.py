"""The study of the shortest call: its simulators, and how evaluations are read off."""

import jax
import numpy as np
import pytest

from benchmarks.studies import defaults
from benchmarks.studies.defaults.simulators import SIMULATORS


@pytest.mark.parametrize("name", SIMULATORS)
def test_simulators_give_the_same_finite_numbers_twice(name):
    simulator = SIMULATORS[name]
    fun, first = simulator.fun(), np.zeros(())
    for seed in range(3):
        y = simulator.start(seed)
        assert all(of.low <= y[name] <= of.high for name, of in simulator.space.items())
        first, again = (np.asarray(fun(y, None)) for _ in range(2))
        assert np.all(np.isfinite(first))
        np.testing.assert_array_equal(first, again)
    if simulator.truth is not None:
        # but for float32, in which the parameters come
        there = np.linalg.norm(np.asarray(fun(simulator.truth, None)))
        assert there <= 1e-3 * np.linalg.norm(first)


def test_a_run_is_there_at_one_percent_of_the_way():
    run = {"evaluations": np.array([0, 1, 2, 5]), "errors": np.array([10.0, 3.0, 0.105, 0.0])}
    assert defaults.there(run, lowest=0.0) == 5
    assert defaults.there(run, lowest=0.01) == 2
    assert defaults.there(run, lowest=-100.0) == np.inf


def test_the_best_setting_is_named_beside_the_shortest_call():
    took = {None: [10.0, 12.0, np.inf]} | {factor: [20.0] * 3 for factor in defaults.FACTORS}
    found = defaults.line("x", "X", "GaussNewton", took | {0.5: [10.0, 10.0, 10.0]})
    assert found["factor"] == 0.5
    assert found["ratio"] == pytest.approx(1.2)
    assert found["solved"] == {"shortest": 2, "best": 3}
    (grid,) = defaults.tables({"cases": [found]})
    assert grid.rows[0].name == "X"


@pytest.mark.slow
def test_the_shortest_call_counts_as_the_function_does():
    case = defaults.of_simulator("ball")
    run = defaults.trace(case, 0, None)
    assert run["solver"] == "GaussNewton"
    assert np.all(np.diff(run["errors"]) <= 0)
    assert defaults.there(run, run["errors"].min()) < 60
    assert jax.tree.structure(case.start(0)) == jax.tree.structure(SIMULATORS["ball"].truth)
