"""The benchmark of errors: its truth is true, it runs, resumes, compares, and shows results."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from benchmarks import variance
from benchmarks.variance import compare, descent, estimators, measure, replicates, tables
from benchmarks.variance.problems import PROBLEMS

TINY = variance.Setting(
    name="tiny",
    problems=("quad",),
    estimators=("sobol-mean", "fr22"),
    samples=(8,),
    repeats={"quad": 3},
    grid=descent.Grid((2,), ("pairs",), (0.03,), ((0.8, 0.95),)),
    costs=False,
)


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def row(squares, evaluations=64):
    squares = np.asarray(squares, float)
    return measure.Row(evaluations, squares, np.ones_like(squares), np.full(len(squares), 1e-3))


@pytest.mark.parametrize("name", ["quad", "box10", "texture"])
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


def test_runs_writes_and_resumes(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(descent, "BUDGETS", {"local": 4, "scalar": 4})
    variance.main(tmp_path, TINY, command="a test")
    assert "Quad" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())
    found = results["problems"]["quad"]["estimators"]
    assert found["fr22"]["gradient"]["evaluations"] == [8]
    low, middle, high = found["sobol-mean"]["hvp"]["rmse"][0]
    assert 0 < low <= middle <= high
    for picture in ("quad.png", "descent.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")

    def measure_again(*_):
        raise AssertionError("measured again")

    monkeypatch.setattr(measure, "_measure", measure_again)
    case = measure.case("quad", 3)
    sobol = estimators.ESTIMATORS["sobol-mean"]
    again = measure.rows(case, "sobol-mean", sobol, 8, tmp_path / "runs")
    assert measure.relative_rmse(again["hvp"])[1] == pytest.approx(middle, rel=1e-3)
    with pytest.raises(AssertionError, match="measured again"):  # another estimator by that name
        measure.rows(case, "sobol-mean", estimators.ESTIMATORS["sobol"], 8, tmp_path / "runs")


def test_evaluations_are_at_most_what_is_asked_for():
    for problem in (PROBLEMS["box10"](), PROBLEMS["texture"]()):
        for estimator in estimators.estimators_for(problem.name).values():
            for part in estimator.parts(problem, 250):
                assert 0 < part.evaluations <= 250


def test_ratios_compare_the_same_positions():
    low, middle, high = measure.ratio(row([1, 4, 9]), row([4, 16, 36]))
    assert (low, middle, high) == pytest.approx((2, 2, 2))
    assert measure.relative_rmse(row([4, 4, 4]))[1] == 2


def test_targets_ingredients_and_thresholds(capsys):
    names = (compare.OURS, *compare.OPPONENTS, "sobol-mean", "sobol-gp")
    levels = (1, 100, 25, 16, 4, 1)
    errors = {name: [level, 2 * level] for name, level in zip(names, levels, strict=True)}

    def by_num(squares):
        return {
            num: {q: row(np.array(squares) / num**2, num) for q in ("gradient", "hessian")}
            for num in (64, 256)
        }

    measured: compare.Measured = {
        "box2": {name: by_num(squares) for name, squares in errors.items()}
    }

    targets = compare.against_targets(measured)
    assert len(targets) == 4  # gradient and Hessian at two of three N, of one of two problems
    assert [over["ratio"][1] for over in targets[0]["over"].values()] == pytest.approx([10, 5, 4])
    assert targets[0]["over"][compare.PUBLISHED]["target"] == 3
    given = compare.ingredients(measured)["box2"]
    assert given["sobol-mean"]["hessian"][256] == pytest.approx(5)

    # errors that fall with N and are halved by the fit spare as many evaluations again
    ms = {f"{q}, {b}": t for q in ("gradient", "hessian") for b, t in (("mean", 1.0), ("gp", 1.64))}
    fit: dict[str, Any] = {"samples": 64, "ms": ms}
    fit["pays_from_us"] = compare.pays_from_us(measured["box2"], fit)
    assert fit["pays_from_us"]["gradient"] == pytest.approx(10, rel=1e-3)

    written = json.loads(json.dumps(given))
    for shown, text in (
        (tables._targets(targets), "10.0 [10.0, 10.0] / 3"),
        (tables._ingredients({"box2": written}), "Sobol, mean"),
        (tables._fits([fit]), "10 us"),
    ):
        Console(width=180).print(shown)
        assert text in capsys.readouterr().out


def test_replicates_cost_and_cover(monkeypatch):
    monkeypatch.setattr(replicates, "REPLICATES", (1, 2))
    monkeypatch.setattr(replicates, "BASELINES", ("mean",))
    one, two = replicates.run(measure.case("quad", 3), 16)
    assert one["rmse_over_one_set"] == pytest.approx([1, 1, 1])
    assert two["sets"] == 2
    assert 0 <= two["coverage"][1] <= 1
    assert two["half_width_over_rmse"] > 1


def test_costs_to_a_level():
    curve = np.array([[1.0, 0.5, 0.05], [1.0, 0.5, 0.4]])
    assert descent.costs(curve, 4, 0.1).tolist() == [12.0, np.inf]
