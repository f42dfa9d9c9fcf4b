"""The study of simulators: they are what they claim, and runs are scored, kept and shown."""

import json
from argparse import Namespace

import numpy as np
import pytest

from benchmarks import _study
from benchmarks._task import NotAble
from benchmarks.studies import simulators
from benchmarks.studies.profiles import peers
from benchmarks.studies.profiles.runs import Method
from benchmarks.studies.simulators import case_of, cell, scored
from benchmarks.studies.simulators.programs import SIMULATORS


@pytest.mark.parametrize("name", SIMULATORS)
def test_a_simulator_gives_the_same_finite_numbers_twice_and_none_at_the_answer(name):
    simulator = SIMULATORS[name]
    low, high, truth = (np.array(a, float) for a in simulator[2:])
    assert np.all((low < truth) & (truth < high))
    for seed in range(3):
        case = case_of(simulator, seed, residuals=True)
        off = case.fun(case.start)
        assert np.all(np.isfinite(off))
        np.testing.assert_array_equal(case.fun(case.start), off)
        assert np.sum(off**2) > 0
        number = case_of(simulator, seed, residuals=False)
        np.testing.assert_array_equal(number.start, case.start)
        assert number.fun(number.start) == pytest.approx(np.sum(off**2))
        answer = (truth - low) / (high - low)
        np.testing.assert_allclose(case.fun(answer), 0, atol=1e-9)


def test_levels_are_shares_of_the_loss_at_the_start():
    run = {"evaluations": [1, 5, 9], "values": [8.0, 0.04, 0.0], "start": 8.0, "count": 12}
    never = {"evaluations": [1], "values": [2.0], "start": 2.0, "count": 3}
    found = scored([run, never])
    assert found["to"] == {"0.01": [5, np.inf], "0.0001": [9, np.inf]}
    assert found["count"] == [12, 3]


@pytest.mark.parametrize(
    ("took", "shown"),
    [
        ([3, 9, 5], "5"),
        ([3, None, 5], "5 (2)"),
        ([None, None, 5], "- (1)"),
        ([3, 5, None, None], "- (2)"),
    ],
)
def test_a_cell_is_a_median_of_all_or_who_got_there(took, shown):
    assert cell(took) == shown


def test_a_run_is_written_shown_and_taken_up_again(tmp_path, monkeypatch, capsys):
    starts = []

    def simplex(seen):
        starts.append(seen.case.start)
        peers.nelder_mead(seen)

    def absent(seen):
        raise NotAble("needs a package: pip install absent")

    methods = {
        "nelder_mead": Method("", False, simplex, ""),
        "least_squares": peers.METHODS["least_squares"],
        "cobyqa": Method("", False, absent, ""),
    }
    monkeypatch.setattr(simulators, "METHODS", methods)
    monkeypatch.setattr(simulators, "FIRST", tuple(methods))
    asked = {"full": False, "fresh": False, "methods": None, "seeds": 2, "said": "simulators"}
    options = Namespace(names=["gears"], **asked)
    _study.run(simulators, options, tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["methods"] == ["nelder_mead", "least_squares"]
    found = results["simulators"]["gears"]["nelder_mead"]
    assert len(starts) == len(found["count"]) == 2
    assert all(count <= results["budget"] for count in found["count"])
    shown = capsys.readouterr().out
    assert "gears" in shown
    assert "pip install absent" in shown
    assert (tmp_path / "simulators.png").exists()

    _study.run(simulators, options, tmp_path)
    assert len(starts) == 2  # all were kept
    assert json.loads((tmp_path / "results.json").read_text()) == results
    for wrong in {"names": ["no such"]}, {"methods": "nelder_mead,no such"}:
        with pytest.raises(SystemExit, match="There is no 'no such'; choose from "):
            _study.run(simulators, Namespace(**{**vars(options), **wrong}), tmp_path)
