"""Gauss-Newton with local support: brute force, known optima, counting, bounds, noise, faults."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._solvers._local_ensemble import (
    DAMPINGS,
    Blame,
    best_of_each_place,
    ensemble_steps,
)
from smoothdiff._solvers._residual_batch import centred

KEY = jax.random.key(3)
N = 80
HIDDEN = np.random.default_rng(0).uniform(-1, 1, N)
SUPPORT = sd.local_support(1, ndim=1)
EVALUATED = []


# problems of eighty parameters; one compiled step does for all, since `which` is data


def blurred(y):
    """Each term sees a parameter and its neighbours; two residuals for a term."""
    padded = jnp.pad(y, 1)
    near = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return jnp.stack([near, 0.5 * padded[1:-1]], axis=-1)


def steps(y, fineness=20):
    """The same, in steps: no derivative says anything."""
    return jnp.round(fineness * blurred(y)) / fineness


def off(y, hidden):
    return blurred(y) - blurred(hidden)


def off_in_steps(y, hidden):
    return steps(y) - steps(hidden)


def noisy(y, hidden):
    bits = jax.lax.bitcast_convert_type(jnp.sum(y).astype(jnp.float32) * 1e3, jnp.int32)
    return off(y, hidden) + 0.05 * jax.random.normal(jax.random.key(bits), (N, 2), y.dtype)


def level(y, hidden):
    """Nothing within ten of the smaller sigma says anything."""
    return jnp.stack([jnp.round(y / 6) - 2.0] * 2, axis=-1)


def holes(y, hidden):
    """A tenth of the samples fail at first; the answer lies on the good side."""
    return jnp.where(y[7] > hidden[7] + 0.4, jnp.nan, off(y, hidden))


def edge(y, hidden):
    """Beyond it nothing is finite."""
    return jnp.where(jnp.mean(y) > 0.1, jnp.nan, off(y, hidden) - 1)


def watched(y, hidden):
    """Where it was evaluated is in `EVALUATED`."""
    jax.debug.callback(lambda one: EVALUATED.append(one), y[0])
    return off(y, hidden)


PROBLEMS = [off, off_in_steps, noisy, level, holes, edge, watched]


def any_of(y, args):
    which, hidden = args
    return jax.lax.switch(which, PROBLEMS, y, hidden)


def args_of(problem, dtype) -> Any:
    return jnp.asarray(PROBLEMS.index(problem), jnp.int32), jnp.asarray(np.asarray(HIDDEN, dtype))


def fit(problem, y0: Any = 0.0, sigma=0.3, num_samples=33, dtype: Any = np.float32, **run):
    settings = {name: run.pop(name) for name in ("nonfinite", "atol") if name in run}
    sigma = jnp.asarray(sigma, dtype)
    solver = sd.LocalGaussNewton(sigma, SUPPORT, num_samples=num_samples, **settings)
    y0 = np.broadcast_to(y0, N).astype(dtype)
    run = {"key": KEY, "max_evaluations": 800} | run
    return sd.least_squares(any_of, y0, args_of(problem, dtype), solver=solver, **run)


VALUE = jax.jit(any_of)


def squares(y, problem=off):
    y = np.broadcast_to(y, N)
    return np.sum(np.square(VALUE(jnp.asarray(y), args_of(problem, y.dtype))))


# ---------------------------------------------------------------------------------------------
# the step


@pytest.mark.parametrize(("samples", "terms"), [(6, 5), (3, 9)])
def test_steps_are_those_of_the_formula(samples, terms, x64):
    """With more pairs of samples than terms, so that N is written down, and with fewer."""
    rng = np.random.default_rng(1)
    matrix = (rng.random((terms, 7)) < 0.5).astype(float)
    matrix[:, 6] = 0  # a parameter that moves nothing
    matrix[4] = 0  # a term that nothing moves
    u, mean = rng.normal(size=(samples, 7)), rng.normal(size=(terms, 2))
    rows = rng.normal(size=(samples, terms, 2))

    @jax.jit
    def steps_of(u, rows, mean):
        blame = Blame.of(sd.matrix_support(matrix), lambda x: x, jnp.zeros(7))
        return ensemble_steps(blame, u, rows, mean)

    found = np.asarray(steps_of(u, rows, mean))
    shared = matrix @ matrix.T
    for damping, step in zip(DAMPINGS, found, strict=True):
        weights = np.zeros((terms, samples))
        for t, near in enumerate(shared):
            gram = np.einsum("s,asq,bsq->ab", near, rows, rows)
            side = np.einsum("s,asq,sq->a", near, rows, mean)
            level = np.trace(gram) / samples
            if level > 0:
                weights[t] = -np.linalg.solve(gram + damping * level * np.eye(samples), side)
        count = np.maximum(matrix.sum(axis=0), 1)
        expected = np.einsum("tj,ta,aj->j", matrix, weights, u) / count
        np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found[:, 6], 0)


def test_a_small_batch_solves_many_local_problems_at_once(x64):
    """Each parameter moves its own term alone: 40 samples solve all eighty to the damping."""
    rng = np.random.default_rng(2)
    slopes, here = rng.uniform(0.5, 2, N), rng.normal(size=N)
    u = rng.normal(size=(40, N))
    u -= u.mean(axis=0)
    blame = Blame.of(sd.local_support(0, ndim=1), lambda x: x, jnp.zeros(N))
    rows = jnp.asarray((u * slopes)[..., None])
    step = eqx.filter_jit(ensemble_steps)
    last = step(blame, jnp.asarray(u), rows, jnp.asarray(here[:, None]))[-1]
    left = np.asarray(here + slopes * last)
    assert np.max(np.abs(left) / np.abs(here)) < 0.01


def test_the_best_of_each_place():
    ends = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.float32)
    losses = np.array([[1, 2, np.nan], [2, 1, 7], [np.inf, 3, 8]], np.float32)

    @jax.jit
    def best(ends, losses):
        blame = Blame.of(sd.local_support(0, ndim=1), lambda x: x, jnp.zeros(3))
        return best_of_each_place(blame, ends, losses)

    np.testing.assert_array_equal(best(ends, losses), [1.0, 5.0, 6.0])


def test_what_is_the_same_in_all_samples_is_an_exact_zero(dtype):
    x, valid = np.full((51, 3), 1 / 3, dtype), np.arange(51) > 0
    x[0] = np.nan
    np.testing.assert_array_equal(jax.jit(centred)(x, valid), 0)


# ---------------------------------------------------------------------------------------------
# runs


@pytest.mark.slow
def test_many_parameters_in_few_evaluations():
    result = fit(off)
    assert result.y.dtype == np.float32
    assert squares(result.y) < 1e-3 * squares(np.float32(0))


@pytest.mark.slow
def test_it_says_when_it_has_converged(x64):
    result = fit(off, dtype=np.float64, atol=0.01, max_evaluations=4000)
    assert result.reason == "converged"
    assert result.y.dtype == np.float64
    assert squares(result.y) < 1e-3 * squares(np.float64(0))
    assert result.history[-1].sigma < 0.01


@pytest.mark.slow
def test_and_where_there_is_no_derivative():
    result = fit(off_in_steps)
    assert squares(result.y, off_in_steps) < 0.01 * squares(np.float32(0), off_in_steps)


@pytest.mark.slow
def test_trees_bounds_and_further_axes():
    """Channels share the support of their cell, and no point outside is ever evaluated."""
    seen = []
    target = {"a": jax.random.uniform(jax.random.key(5), (4, 4, 3)), "b": jnp.full((4, 4), 0.4)}

    def fun(y, args):
        jax.debug.callback(lambda a, b: seen.append((np.min(b), np.max(a))), y["a"], y["b"])
        return jnp.concatenate([y["a"] - target["a"], (y["b"] - target["b"])[..., None]], axis=-1)

    cells = sd.local_support(0)
    support = lambda y: cells(jnp.concatenate([y["a"], y["b"][..., None]], axis=-1))
    y0 = {"a": jnp.full((4, 4, 3), 0.5), "b": jnp.full((4, 4), 0.9)}
    result = sd.least_squares(
        fun,
        y0,
        key=KEY,
        solver=sd.LocalGaussNewton({"a": 0.3, "b": 0.5}, support, batch_size=7),
        bounds=({"a": None, "b": 0.4}, {"a": 0.8, "b": None}),
        max_evaluations=600,
    )
    jax.effects_barrier()
    lowest, highest = np.min(np.array(seen), axis=0)[0], np.max(np.array(seen), axis=0)[1]
    assert lowest >= np.float32(0.4)
    assert highest <= np.float32(0.8)
    np.testing.assert_allclose(result.y["b"], 0.4, atol=0.05)
    np.testing.assert_allclose(result.y["a"], jnp.minimum(target["a"], 0.8), atol=0.05)


def test_a_support_that_moves():
    pixels = jnp.arange(100.0)
    begin = jnp.arange(5.0) * 20 + 4
    goal = begin + 6 + jnp.sin(jnp.arange(5.0))
    draw = lambda y: jnp.exp(-((pixels[:, None] - y[None]) ** 2) / 18).sum(axis=1)
    near = lambda y: (jnp.abs(pixels[:, None] - y[None]) < 8).astype(y.dtype)
    support = sd.moving_support(lambda y: lambda params: near(y) @ params)
    result = sd.least_squares(
        lambda y, args: draw(y) - draw(goal),
        begin,
        key=KEY,
        solver=sd.LocalGaussNewton(2.0, support),
        max_evaluations=800,
    )
    np.testing.assert_allclose(result.y, goal, atol=0.05)


def test_evaluations_are_counted():
    EVALUATED.clear()
    result = fit(watched, max_evaluations=200)
    jax.effects_barrier()
    assert result.evaluations == len(EVALUATED) <= 200


@pytest.mark.parametrize(("n", "evaluations"), [(20, 25), (100, 59), (500, 96), (256**2, 28)])
def test_evaluations_per_step(n, evaluations):
    solver = sd.LocalGaussNewton(0.3, lambda y: y)
    assert solver.evaluations_per_step(jnp.zeros(n)) == evaluations


def test_optimistix_makes_the_same_steps_and_they_are_vmapped():
    solver, args = sd.LocalGaussNewton(0.3, SUPPORT, num_samples=33), args_of(off, np.float32)

    @jax.jit
    @jax.vmap
    def run(key, y0):
        fun = lambda y, args: off(y, args[1])
        options = {"key": key}
        return optx.least_squares(fun, solver, y0, args, options, max_steps=5, throw=False).value

    keys, starts = jax.random.split(KEY, 2), np.zeros((2, N), np.float32)
    starts[1] = 0.5
    found = run(keys, starts)
    for key, start, y in zip(keys, starts, found, strict=True):
        alone = fit(off, start, key=key, max_evaluations=None, max_steps=5)
        np.testing.assert_allclose(y, alone.y, atol=1e-3)


def test_sigma_falls_with_the_error_and_not_below_the_noise():
    clean, rough = (fit(fun, max_steps=40, max_evaluations=4000) for fun in (off, noisy))
    assert clean.history[-1].sigma < 0.02
    assert rough.history[-1].sigma > 0.05
    # what is left of the parameters' error is what the noise leaves
    assert squares(rough.y) < 0.01 * squares(np.float32(0))


def test_a_plateau_is_left():
    result = fit(level, sigma=0.1)
    assert squares(result.y, level) < 0.1 * squares(np.float32(0), level)


# ---------------------------------------------------------------------------------------------
# faults and bad input


@pytest.mark.slow
def test_samples_that_fail():
    y0 = np.float32(HIDDEN[7])
    result = fit(holes, y0, num_samples=42, nonfinite="drop")
    assert squares(result.y) < 0.01 * squares(y0)
    with pytest.raises(sd.MinimiseError, match='nonfinite="drop"') as error:
        fit(holes, y0)
    assert np.all(np.isfinite(error.value.result.y))


@pytest.mark.slow
def test_where_all_ends_fail_the_iterate_stays():
    """At an edge beyond which nothing is finite: most samples are, and no end."""
    y0 = np.full(N, 0.085, np.float32)
    run = {"num_samples": 42, "nonfinite": "drop", "max_evaluations": None, "max_steps": 1}
    result = fit(edge, y0, sigma=0.1, **run)
    np.testing.assert_array_equal(result.history[0].y, y0)
    assert np.mean(result.y) < 0.1


def test_bad_arguments():
    with pytest.raises(ValueError, match="at least 12 evaluations"):
        sd.LocalGaussNewton(0.3, SUPPORT, num_samples=11)
    with pytest.raises((ValueError, TypeError), match="nonfinite"):
        sd.LocalGaussNewton(0.3, SUPPORT, nonfinite="ignore")  # pyright: ignore
    with pytest.raises(TypeError, match="support"):
        sd.LocalGaussNewton(0.3, None)  # pyright: ignore
    with pytest.raises(TypeError, match="support"):
        sd.LocalGaussNewton(0.3, 3)  # pyright: ignore

    def run(fun, y0: Any = HIDDEN, support: Any = SUPPORT, sigma: Any = 0.3):
        solver = sd.LocalGaussNewton(sigma, support)
        return sd.least_squares(fun, y0, key=KEY, solver=solver, max_evaluations=800)

    zero = lambda y: off(y, jnp.zeros(N))
    with pytest.raises(ValueError, match="first axes are those of the terms"):
        run(lambda y, args: zero(y)[:-1])
    with pytest.raises(ValueError, match="one array"):
        run(lambda y, args: (zero(y), zero(y)))
    with pytest.raises(ValueError, match="every leaf"):
        run(
            lambda y, args: zero(y["a"]) * y["b"],
            {"a": jnp.zeros(N), "b": jnp.ones(())},
            lambda y: SUPPORT(y["a"]),
            {"a": 0.3, "b": None},
        )
