"""The benchmark of errors: its truth is true, it runs, resumes, compares, and shows results."""

import json
from argparse import Namespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import _study
from benchmarks.studies import variance
from benchmarks.studies.variance import costs, descent, errors, estimators, targets
from benchmarks.studies.variance.problems import PROBLEMS


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def row(squares, evaluations=64):
    squares = np.asarray(squares, float)
    return errors.Row(evaluations, squares, np.ones_like(squares), np.full(len(squares), 1e-3))


def curve(level):
    """Errors that fall with the number of evaluations."""
    rmse = lambda num: [0.9 * level / num, level / num, 1.1 * level / num]
    return {str(n): {"evaluations": n, "rmse": rmse(n), "ms": 0.5} for n in (64, 256, 1024)}


def results():
    """As of a full run, in which the published sampler errs ten times as much as ours."""
    problems = {
        problem: {
            "title": problem,
            "repeats": 2,
            "estimators": {
                name: {"title": estimator.title}
                | {
                    q: curve(10 if name == "aggregate" else 1)
                    for q in PROBLEMS[problem]().quantities
                }
                for name, estimator in estimators.ANYWHERE.items()
            },
        }
        for problem in ("box2", "box10")
    }
    fading = {"evaluations": [2, 4], "error": [[1, 0.1], [1, 0.2], [1, 0.3]]}
    return {
        "problems": problems,
        "targets": [{"problem": "box2", "aggregate": [9.0, 10.0, 11.0], "aggregate, goal": 3}],
        "descent": [{"credit": "local", "to 99 %": [212.0, 244.0, None], "curve": fading}],
        "replicates": [{"baseline": "mean", "sets": 4, "coverage": [0.93, 0.96, 0.98]}],
        "fits": [{"N": 1024, "gradient, gp": 12.34, "gradient pays from, us": None}],
    }


@pytest.mark.parametrize("name", ["box10", "texture"])
def test_the_closed_form_is_the_mean_of_the_function(name):
    problem, num = PROBLEMS[name](), 1024
    y = problem.position(jax.random.key(7))
    z = np.random.default_rng(0).normal(size=(num, problem.n)).astype(np.float32)
    values = np.asarray(jax.jit(jax.vmap(lambda z: problem.fun(y + problem.sigma * z)))(z))
    exact = float(jax.jit(problem.smoothed)(y, jnp.full(problem.n, problem.sigma)))
    assert abs(values.mean() - exact) < 4 * values.std() / num**0.5


def test_terms_add_up_and_the_support_covers_them():
    problem = PROBLEMS["texture"]()
    assert problem.terms is not None
    y = problem.position(jax.random.key(0))
    assert jnp.sum(problem.terms(y)) == pytest.approx(float(problem.fun(y)))
    reach = problem.support(jnp.zeros(problem.n).at[500].set(1.0))
    moved = problem.terms(y.at[500].add(5.0)) != problem.terms(y)
    assert jnp.sum(moved) > 1
    assert not jnp.any(moved & (reach == 0))


def test_evaluations_are_at_most_what_is_asked_for():
    for name in ("box10", "texture"):
        for estimator in estimators.ESTIMATORS[name].values():
            for part in estimator.parts(PROBLEMS[name](), 250):
                assert 0 < part.evaluations <= 250


def test_ratios_compare_the_same_positions():
    low, middle, high = errors.ratio(row([1, 4, 9]), row([4, 16, 36]))
    assert (low, middle, high) == pytest.approx((2, 2, 2))
    assert errors.relative_rmse(row([4, 4, 4]))[1] == 2


def test_targets_are_compared_with_their_opponents(monkeypatch):
    goals = {("box2", "hessian", 64): {"aggregate": 3}}
    monkeypatch.setattr(targets, "TARGETS", goals)
    levels = {"ours": 1, "aggregate": 100, "aggregate-mean": 25, "optax": 16}
    measured = {n: {"hessian": {64: row([x, 2 * x])}} for n, x in levels.items()}
    (line,) = targets.against_targets({"box2": measured})
    assert [line[name][1] for name in ("aggregate", "aggregate-mean", "optax")] == [10, 5, 4]
    assert (line["aggregate, goal"], line["optax, goal"]) == (3, None)


def test_a_fit_pays_where_it_takes_less_time_than_the_evaluations_it_spares():
    plain, fitted = ({"gradient": {int(n): at for n, at in curve(x).items()}} for x in (1, 0.5))
    found = {"sobol-mean": plain, "sobol-gp": fitted}
    ms = {"gradient, mean": 1.0, "gradient, gp": 1.64}
    assert costs.pays_from(found, ms, 64, "gradient") == pytest.approx(10)
    assert costs.pays_from(found | {"sobol-gp": plain}, ms, 64, "gradient") is None


def test_costs_to_a_level():
    curves = np.array([[1.0, 0.5, 0.05], [1.0, 0.5, 0.4]])
    assert descent.costs(curves, 4, 0.1).tolist() == [12.0, np.inf]


@pytest.mark.slow
def test_results_are_drawn_and_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    written = _study.write(results(), tmp_path)
    _study.show(variance.tables(written))
    printed = capsys.readouterr().out
    for text in ("10 [9, 11]", "0.016/0.0039/0.00098", "244 [212, -]", "0.96 [0.93, 0.98]", "12.3"):
        assert text in printed
    variance.draw(written, tmp_path)
    for name in ("box2", "box10", "ingredients", "descent"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_whole_study_runs_writes_and_resumes(monkeypatch, tmp_path):
    some = {
        name: estimators.BOXES[name] for name in ("ours", "aggregate", "sobol-mean", "sobol-gp")
    }
    monkeypatch.setattr(variance, "ESTIMATORS", {"box2": some, "box10": some})
    monkeypatch.setattr(variance, "FULL", {"box2": 2, "box10": 2})
    monkeypatch.setattr(variance, "FULL_SAMPLES", (8, 16))
    monkeypatch.setattr(targets, "TARGETS", {})
    short = {k: setting._replace(evaluations=8) for k, setting in descent.SETTINGS.items()}
    monkeypatch.setattr(descent, "SETTINGS", short)
    monkeypatch.setattr(costs, "TIMED", (16,))
    monkeypatch.setattr(costs, "SAMPLES", 16)
    monkeypatch.setattr(costs, "REPLICATES", (1, 2))
    options = Namespace(said="a test", full=True, fresh=False)
    _study.run(variance, options, tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    found = results["problems"]["box2"]["estimators"]
    assert found["aggregate"]["hessian"]["8"]["evaluations"] == 8
    low, middle, high = found["sobol-mean"]["hvp"]["8"]["rmse"]
    assert 0 < low <= middle <= high
    one, two, *_ = results["replicates"]
    assert one["RMSE over one set's"] == [1, 1, 1]
    assert two["sets"] == 2
    assert 0 <= two["coverage"][1] <= 1
    assert results["fits"][0]["gradient, gp"] > 0

    def measure_again(*_):
        raise AssertionError("measured again")

    monkeypatch.setattr(errors, "_measure", measure_again)
    for name in ("fits", "replicates"):
        monkeypatch.setattr(costs, name, lambda *_: [])
    again = variance.measure(options, tmp_path)["problems"]["box2"]["estimators"]
    assert again["sobol-mean"]["hvp"][8]["rmse"][1] == pytest.approx(middle, rel=1e-3)
    options.fresh = True
    with pytest.raises(AssertionError, match="measured again"):
        variance.measure(options, tmp_path)
