"""optimistix both ways: its solvers around ours under `minimise`, and ours under its own loops."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from closed_forms import as_users_have_it
from parts import new_ones

import smoothdiff as sd
from smoothdiff._solvers import AbstractSmoothSolver

KEY = jax.random.key(0)
START, TARGET = np.array([-1.2, 1.0], np.float32), np.array([0.6, -0.4], np.float32)
ADAM = sd.FirstOrder(optax.adam(0.05), 0.2)


def bowl(y, args):
    return jnp.sum((y - args) ** 2)


def valley(y, args):
    return jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])


def squares(y, args):
    return jnp.sum(valley(y, args) ** 2)


# its solvers around ours


# no types, as these classes are shorter than optimistix's would be
Minimiser: Any = optx.AbstractMinimiser
BestSoFar: Any = optx.BestSoFarMinimiser


class Damped(Minimiser):
    """What a user may write: half of each step, and the statistics of the solver within."""

    solver: sd.FirstOrder

    rtol = property(lambda self: self.solver.rtol)
    atol = property(lambda self: self.solver.atol)
    norm = property(lambda self: self.solver.norm)

    def init(self, *problem):
        return {"steps": self.solver.init(*problem), "count": jnp.zeros((), jnp.int32)}

    def step(self, fn, y, args, options, state, tags):
        new, steps, aux = self.solver.step(fn, y, args, options, state["steps"], tags)
        return (y + new) / 2, {"steps": steps, "count": state["count"] + 1}, aux

    def terminate(self, fn, y, args, options, state, tags):
        return self.solver.terminate(fn, y, args, options, state["steps"], tags)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        rest = args, options, state["steps"], tags, result
        y, aux, stats = self.solver.postprocess(fn, y, aux, *rest)
        return y, aux, stats | {"count": state["count"]}


@pytest.mark.slow
def test_the_best_so_far_is_that_of_our_steps():
    solver = optx.BestSoFarMinimiser(ADAM)
    bare = sd.minimise(bowl, START, TARGET, key=KEY, solver=ADAM, max_steps=40)
    result = sd.minimise(bowl, START, TARGET, key=KEY, solver=solver, max_steps=40)
    for one, other in zip(result.history, bare.history, strict=True):
        np.testing.assert_allclose(one.y, other.y, atol=1e-5)
    assert result.fun == bowl(result.y, TARGET) <= result.history[-1].fun
    assert (result.solver, result.reason) == (solver, "max_steps")
    assert result.state.best_loss < 1
    # what it returns, and the lowest again
    assert result.evaluations == 40 * 8 + 2


def test_a_solver_of_the_users_own_steps_and_judges_as_it_says(tmp_path):
    run = lambda steps, **loop: sd.minimise(
        bowl, START, TARGET, key=KEY, solver=Damped(ADAM), max_steps=steps, **loop
    )
    bare = sd.minimise(bowl, START, TARGET, key=KEY, solver=ADAM, max_steps=1)
    whole = run(9)
    np.testing.assert_allclose(whole.history[0].y, (START + bare.history[0].y) / 2, rtol=1e-5)
    assert whole.state["count"] == 9
    assert np.isfinite([whole.smoothed, whole.stderr]).all()
    run(5, checkpoint=tmp_path / "run.npz")
    np.testing.assert_array_equal(run(9, checkpoint=tmp_path / "run.npz").y, whole.y)


@pytest.mark.slow
def test_around_a_search_point_by_point_the_budget_and_the_reason_are_ours():
    solver = optx.BestSoFarLeastSquares(sd.GaussNewton(0.3))
    box = sd.black_box(lambda y: np.array([10 * (y[1] - y[0] ** 2), 1 - y[0]]))
    fun = lambda y, args: box(y)
    result = sd.least_squares(fun, START, key=KEY, solver=solver)
    assert (result.reason, result.result) == ("converged", optx.RESULTS.successful)
    np.testing.assert_allclose(result.y, [1, 1], atol=1e-4)
    short = sd.least_squares(fun, START, key=KEY, solver=solver, max_evaluations=20)
    assert short.reason == "max_evaluations"
    assert 10 <= short.evaluations <= 20


class Forgetful(BestSoFar):
    """Hides the state of what it wraps."""

    def init(self, *problem):
        return jnp.zeros(())


@pytest.mark.parametrize(
    ("minimise", "solver", "match"),
    [
        (sd.minimise, optx.BFGS(1e-3, 1e-3), "one of optimistix's around it, not BFGS"),
        (sd.minimise, optx.BestSoFarMinimiser(optx.BFGS(1e-3, 1e-3)), "not BestSoFarMinimiser"),
        (sd.least_squares, optx.BestSoFarMinimiser(ADAM), "is not for this"),
        (sd.minimise, Forgetful(ADAM), "keeps that one's state"),
    ],
)
def test_what_does_not_step_as_ours_do_is_refused(minimise, solver, match):
    with pytest.raises(TypeError, match=match):
        as_users_have_it(minimise)(bowl, START, TARGET, key=KEY, solver=solver)


# ours under its loops

# these are tested in files of their own, as they need more than sigma or do not end so near
OTHERS = (sd.FirstOrder, sd.LocalCrossEntropy, sd.LocalGaussNewton, sd.ZeroGrads)
NEW = new_ones(AbstractSmoothSolver, [sd.GaussNewton, sd.NewtonCG, *OTHERS], 0.3).values()


def its_own(solver):
    """The loop of a solver, and a function for it."""
    if isinstance(solver, optx.AbstractMinimiser):
        return optx.minimise, bowl, solver
    return optx.least_squares, valley, solver


@pytest.mark.parametrize(
    ("run", "fun", "solver"),
    [
        pytest.param(optx.minimise, bowl, sd.NewtonCG(0.3), marks=pytest.mark.slow),
        (optx.least_squares, valley, sd.GaussNewton(0.3)),
        *map(its_own, NEW),
    ],
)
def test_with_defaults_they_end_by_themselves(run, fun, solver):
    solution = run(fun, solver, START, TARGET, options={"key": KEY})
    assert solution.result == optx.RESULTS.successful
    assert solution.stats["num_steps"] < 200
    np.testing.assert_allclose(solution.value, TARGET if fun is bowl else [1, 1], atol=1e-3)


@pytest.mark.slow
def test_a_curved_valley_ends_by_itself():
    """At its bottom; in float32 some runs say that they led nowhere any more."""
    run = lambda key: optx.minimise(
        squares, sd.NewtonCG(0.3), START, TARGET, options={"key": key}, throw=False
    )
    solutions = jax.vmap(run)(jax.random.split(KEY, 8))
    np.testing.assert_allclose(solutions.value, 1, atol=1e-3)
    assert np.all(solutions.result != optx.RESULTS.nonlinear_max_steps_reached)
    assert np.mean(solutions.result == optx.RESULTS.successful) >= 0.5


@pytest.mark.slow
def test_what_leads_nowhere_is_no_success():
    """A plateau that is wider than anything that was looked at."""
    flat = lambda y, args: 0 * jnp.sum(y) + 1
    with pytest.raises(eqx.EquinoxRuntimeError, match="stagnation"):
        optx.least_squares(flat, sd.GaussNewton(0.3), START, options={"key": KEY})


@pytest.mark.slow
@pytest.mark.parametrize("num_samples", [pytest.param(None, marks=pytest.mark.slow), 3])
def test_aux_is_that_of_the_iterate(num_samples):
    """So the best so far, which goes by aux, is the best of what was evaluated."""
    solver = optx.BestSoFarLeastSquares(sd.GaussNewton(0.3, num_samples=num_samples))
    run = lambda fun, solver: optx.least_squares(
        fun, solver, START, options={"key": KEY}, has_aux=True
    )
    solution = run(lambda y, args: (valley(y, args), {"at": y, "none": None}), solver)
    np.testing.assert_allclose(solution.value, [1, 1], atol=1e-3)
    np.testing.assert_array_equal(solution.aux["at"], solution.value)
    bare = run(lambda y, args: (valley(y, args), y), solver.solver)
    np.testing.assert_allclose(bare.aux, bare.value)
