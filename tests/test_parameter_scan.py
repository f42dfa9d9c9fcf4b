"""The scan of parameters one by one: finds global minima, and knows where it does not apply."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._solvers._parameter_scan import Scan

LOW, HIGH = -5.0, 5.0
BEST = jnp.array([1.3, -2.1, 0.4])


def rastrigin(y, turn=None):
    """About ten minima along each axis, and one global one at BEST."""
    z = y - BEST if turn is None else turn @ (y - BEST)
    return jnp.sum(z**2 + 10 * (1 - jnp.cos(2 * jnp.pi * z)))


def scanned(fun, base, count):
    """The scan until it is done or has failed, and how many evaluations it took."""
    low, high = jnp.full_like(base, LOW), jnp.full_like(base, HIGH)

    def step(carry):
        scan, spent = carry
        points = scan.propose(low, high, count)
        return scan.after(points, jax.vmap(fun)(points)), spent + count

    more = lambda carry: ~(carry[0].done() | carry[0].failed)
    first = Scan.start(base, fun(base), jnp.ones_like(base)), 0
    return jax.jit(lambda: jax.lax.while_loop(more, step, first))()


@pytest.mark.parametrize("count", [1, 4])
def test_independent_parameters_are_found_one_by_one(count):
    base = jnp.array([-4.0, 3.3, 4.8])
    scan, spent = scanned(rastrigin, base, count)
    assert scan.done()
    assert not scan.failed
    # in the basin of the global minimum, whose neighbours are a unit away
    np.testing.assert_allclose(scan.found, BEST, atol=0.3)
    # two tries of 16, their test, and 50 for each parameter, in whole steps
    assert spent <= 2 * (16 + count) + count + 3 * (50 + count)
    assert np.all(scan.nearest > 0)


def test_parameters_that_act_together_end_the_scan_early():
    turn, _ = jnp.linalg.qr(jax.random.normal(jax.random.key(0), (3, 3)))
    scan, spent = scanned(lambda y: rastrigin(y, turn), jnp.array([-4.0, 3.3, 4.8]), 1)
    assert scan.failed
    assert spent == 33


def test_parameters_at_their_best_do_not_hide_the_others():
    base = BEST.at[2].set(-4.6)
    scan, _ = scanned(rastrigin, base, 1)
    assert scan.done()
    np.testing.assert_allclose(scan.found, BEST, atol=0.3)


@pytest.mark.parametrize("base", [[-1.2, 1.0, 3.0], [1.0, 1.0, 1.0]])
def test_a_valley_ends_the_scan(base):
    """Of two parameters that act together, one may change the function far more than the other."""

    def rosenbrock(y):
        return jnp.sum(100 * (y[1:] - y[:-1] ** 2) ** 2 + (1 - y[:-1]) ** 2)

    assert scanned(rosenbrock, jnp.array(base), 1)[0].failed


def test_infinite_values_are_no_trouble():
    holed = lambda y: jnp.where(jnp.abs(y[0] + 3) < 0.5, jnp.inf, jnp.sum((y - BEST) ** 2))
    scan, _ = scanned(holed, jnp.array([4.0, 4.0, 4.0]), 1)
    assert scan.done()
    np.testing.assert_allclose(scan.found, BEST, atol=0.3)


@pytest.mark.slow
def test_a_parameter_between_equal_bounds_stays_there():
    points = []

    def seen(y):
        points.append(np.asarray(y))
        return np.sum((y - BEST) ** 2)

    box = sd.black_box(seen, jax.ShapeDtypeStruct((), jnp.float32))
    sides = jnp.array([-3.0, 1.0, -3.0]), jnp.array([3.0, 1.0, 3.0])
    run = {"solver": sd.NewtonCG(0.6, restarts=9), "bounds": sides, "max_evaluations": 300}
    sd.minimise(lambda y, _: box(y), jnp.array([2.3, 1.0, 2.3]), key=jax.random.key(0), **run)
    assert len(points) > 200
    assert np.all(np.array(points)[:, 1] == 1)
    assert np.all(np.isfinite(points))


def test_a_longer_scan_follows():
    scan = Scan.start(BEST, jnp.asarray(1.0), jnp.ones(3)).again(BEST, jnp.asarray(1.0))
    limits = []
    while not scan.failed:
        limits.append(int(scan.limit))
        scan = scan.again(BEST, jnp.asarray(1.0))
    assert limits == [50, 100, 200]


def solved(seed, bounds, max_evaluations):
    key = jax.random.key(seed)
    start = jax.random.uniform(key, (3,), minval=-4, maxval=4)
    return sd.minimise(
        lambda y, args: rastrigin(y),
        start,
        key=key,
        solver=sd.NewtonCG(1.0, restarts=10),
        bounds=bounds,
        max_evaluations=max_evaluations,
    )


@pytest.mark.slow
def test_open_sides_are_not_scanned():
    assert np.isfinite(solved(0, (-jnp.inf, HIGH), 300).fun)


@pytest.mark.slow
def test_a_long_search_scans_before_it_ends():
    """In ten dimensions, where wide samples alone go on for long."""
    best = jnp.linspace(-3, 3, 10)
    fun = lambda y, args: jnp.sum((y - best) ** 2 + 10 * (1 - jnp.cos(2 * jnp.pi * (y - best))))
    result = sd.minimise(
        fun,
        jnp.full(10, 4.2),
        key=jax.random.key(0),
        solver=sd.NewtonCG(1.0, restarts=10),
        bounds=(LOW, HIGH),
        max_evaluations=1500,
    )
    assert result.fun < 1e-3


@pytest.mark.slow
def test_a_solver_with_restarts_finds_the_global_minimum():
    found = np.array([solved(seed, (LOW, HIGH), 900).fun for seed in range(4)])
    # a first scan may miss a basin that is a tenth of the line
    assert np.sum(found < 1e-3) >= 3
