"""The first points of a search for residuals: each parameter gets a step that suits it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import quick_of

import smoothdiff as sd
from smoothdiff._solvers._first_points import FirstPoints

START = np.array([1.0, -2.0, 0.5])


# compiled, as in a solver
BEGIN = jax.jit(FirstPoints.start, static_argnums=1)
NEXT, AFTER = jax.jit(FirstPoints.next, static_argnums=1), jax.jit(FirstPoints.after)


def measured(losses, count=1):
    """All the first points, so many at once; `losses(reach)` has the start's, then each step's."""
    first, evaluated = BEGIN(jnp.zeros(3)), []
    while not bool(first.done()):
        at, taken = (np.asarray(a) for a in NEXT(first, count))
        evaluated += at[taken].tolist()
        funs = np.asarray(losses(np.asarray(first.reach)))[at]
        first = AFTER(first, jnp.asarray(np.where(taken, funs, 0.0)), np.zeros(3, bool))
    return np.asarray(first.reach), evaluated


def linear(slopes):
    """Half the squares of residuals that are linear in each parameter."""

    def losses(reach):
        rows = START[None] + reach[:, None] * np.diag(slopes)
        return [START @ START / 2, *np.sum(rows**2, axis=1) / 2]

    return losses


@pytest.mark.parametrize("count", quick_of([1, 2, 4], [1]))
def test_a_parameter_of_another_scale_gets_a_nearer_point(count, x64):
    reach, evaluated = measured(linear([1.0, 1e5, -3.0]), count)
    assert sorted(evaluated) == [0, 1, 2, 2, 3]
    # one that comes after it is a little nearer, too
    np.testing.assert_allclose(reach[[0, 2]], [1, 0.1**0.5 if count == 1 else 1])
    assert reach[1] == pytest.approx(np.linalg.norm(START) / 1e5, rel=0.01)


def test_what_is_not_tried_yet_comes_nearer_with_the_others(x64):
    """Bounds far too wide for all parameters cost one evaluation, not one for each."""
    reach, evaluated = measured(linear([20.0, 30.0, 40.0]))
    assert evaluated == [0, 1, 1, 2, 3]
    np.testing.assert_allclose(reach, np.linalg.norm(START) / 20, rtol=0.1)
    # but no nearer than three hundredths, however wide they are
    assert 0.03 <= measured(linear([1e5, 1e5, -0.1]))[0][2] < 0.04


def test_where_there_is_no_number_the_next_point_is_a_tenth_as_far(x64):
    def losses(reach):
        return [1.0, 1.0, np.inf if reach[1] > 0.05 else 1.0, np.inf]

    reach, evaluated = measured(losses)
    np.testing.assert_allclose(reach, [1, 0.01, 1e-3])
    # each place twice, as a failure may be one by chance
    assert evaluated == [0, 1, *[2] * 5, *[3] * 8]


def test_of_a_point_that_fails_the_other_side_comes_first(x64):
    first, seen = BEGIN(jnp.zeros(1)), []
    for fun in [1.0, *8 * [np.inf]]:
        seen.append(np.where(first.turned, -1, 1).item() * first.reach.item())
        first = AFTER(first, jnp.array([fun]), np.ones(1, bool))
    np.testing.assert_allclose(seen, [1, 1, 1, -1, -1, 0.1, 0.1, -0.1, -0.1], rtol=1e-6)


def test_a_loss_that_is_high_on_the_other_side_is_tried_nearer_there_as_often():
    """And another search begins with the first side again."""
    first, seen = BEGIN(jnp.zeros(1)), []
    for fun in [1.0, np.inf, np.inf, *8 * [1e6]]:
        if first.done():
            break
        seen.append(np.where(first.turned, -1, 1).item() * first.reach.item())
        first = AFTER(first, jnp.array([fun]), np.ones(1, bool))
    np.testing.assert_allclose(seen, [1, 1, 1, -1, -1e-3, -1e-6, -1e-9], rtol=1e-5)
    assert not jax.jit(FirstPoints.around)(first, jnp.ones(())).turned[0]


@pytest.mark.parametrize("bounds", quick_of([None, (-2.0, 4.0)], [(-2.0, 4.0)]))
def test_a_start_at_the_edge_of_where_it_fails_is_left(bounds):
    """Half of the first points fail, however near they are."""

    def rows(y, args):
        linear = jnp.array([y[0] - 0.2, 2 * (y[1] + 0.3), y[2] * y[0] - 0.1])
        return jnp.where(y[0] + y[1] > 2.0, jnp.nan, linear)

    result = sd.least_squares(rows, jnp.ones(3), key=jax.random.key(0), bounds=bounds)
    np.testing.assert_allclose(result.y, [0.2, -0.3, 0.5], atol=1e-3)
    assert result.evaluations < 60


def test_a_start_without_a_number_asks_for_nothing_nearer():
    reach, evaluated = measured(lambda reach: [np.inf, 1e9, np.inf, 1.0])
    np.testing.assert_array_equal(reach, 1)
    assert evaluated == [0, 0, 1, 2, 2, 3]


def test_calls_that_fail_by_chance_cost_no_more_than_themselves():
    """Each point that failed is evaluated again, and then all is as if it never had."""
    times, failing, calls = np.linspace(0, 4, 20, dtype=np.float32), set(), [0]

    def residuals(y):
        calls[0] += 1
        row = y[0] * np.exp(-y[1] * times) + y[2] - (2 * np.exp(-1.3 * times) + 0.5)
        return (row * (np.nan if calls[0] in failing else 1)).astype(np.float32)

    box = sd.black_box(residuals, jax.ShapeDtypeStruct((20,), jnp.float32), on_nonfinite="nan")

    def solved(*which):
        failing.clear()
        failing.update(which)
        calls[0] = 0
        y0 = jnp.array([1.0, 0.5, 0.1])
        return sd.least_squares(lambda y, _: box(y), y0, key=jax.random.key(0))

    without = solved()
    for which in [(2,), (1, 3), (2, 4, 6)]:
        result = solved(*which)
        assert result.evaluations == without.evaluations + len(which)
        np.testing.assert_array_equal(result.y, without.y)


@pytest.mark.parametrize("count", [1, 3])
def test_of_two_sides_those_that_fail_come_nearer_together(count):
    sides = np.kron(np.eye(2), np.array([[1.0], [-1]])).astype(np.float32)
    others, seen = jnp.full((count, 2), 9.0), []

    @jax.jit
    def taken(first):
        return first.points(sides, lambda: others, count), first.known(count)

    def all_of(first):
        while not first.done():
            points, first = taken(first)
            seen.extend(np.asarray(points).tolist())
        return first

    first = all_of(BEGIN(jnp.zeros(2), 2))
    first = all_of(jax.jit(FirstPoints.again)(first, np.array([False, True]), 0.1))
    once, nearer = [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], [[0, 1], [0, -1]]
    assert [point for point in seen if point != [9, 9]] == once + nearer
    assert len(seen) == -(-5 // count) * count + -(-2 // count) * count
    np.testing.assert_allclose(first.reach, [1, 0.1])


@pytest.mark.slow
@pytest.mark.parametrize("count", quick_of([4, 8], [8]))
def test_what_runs_beside_first_points_is_new_and_tells_of_no_parameter(count):
    """Along the second parameter alone there are numbers nearby only, and elsewhere everywhere."""

    def fun(y):
        alone = (y[0] == 0) & (np.abs(y[1]) > 0.02)
        return np.where(alone, np.nan, np.sum((y - 0.5) ** 2))

    solver = sd.NewtonCG(1.0, num_samples=count, nonfinite="drop")
    search = sd.Search(np.zeros(2, np.float32), key=jax.random.key(0), solver=solver)
    asked = []
    for _ in range(5):
        points = search.ask(count)
        search.tell(points, [fun(np.asarray(y)) for y in points])
        asked.extend(np.asarray(y).tolist() for y in points)
    along = [abs(y[1]) for y in asked if y[0] == 0 and y[1] != 0]
    np.testing.assert_allclose(along, [1, 1, 0.1, 0.1, 0.01, 0.01], rtol=1e-6)
    assert len({tuple(y) for y in asked}) == len(asked)


def model(y, _):
    """A decay whose rate is a thousand times as small as its amplitude, as in NIST's KIRBY2."""
    t = jnp.linspace(0, 100.0, 40)
    return y[0] * jnp.exp(jnp.clip(y[1] * t, -60, 60)) - 80 * jnp.exp(-0.03 * t)


@pytest.mark.slow
def test_one_sigma_for_parameters_of_different_scales(x64):
    y0 = jnp.array([60.0, -0.001])
    loss = lambda y: float(jnp.sum(model(y, None) ** 2))
    result = sd.least_squares(
        model, y0, key=jax.random.key(0), solver=sd.GaussNewton(6.0), max_evaluations=40
    )
    assert loss(result.y) < 1e-4 * loss(y0)


@pytest.mark.slow
def test_a_round_beyond_the_domain_is_drawn_nearer(x64):
    """A function that has numbers in a small ball only, and jumps there, is still minimised."""

    def fun(y, _):
        stairs = jnp.floor(200 * y) / 200
        return jnp.where(jnp.sum(y**2) < 0.2**2, stairs - jnp.array([0.1, -0.05]), jnp.nan)

    solver = sd.GaussNewton(1.0, nonfinite="drop")
    result = sd.least_squares(
        fun, jnp.zeros(2), key=jax.random.key(0), solver=solver, max_evaluations=150
    )
    assert float(result.fun) < 0.1 * (0.1**2 + 0.05**2) / 2


@pytest.mark.slow
def test_a_function_without_numbers_is_an_error():
    solver = sd.GaussNewton(1.0, nonfinite="drop")
    with pytest.raises(sd.MinimiseError, match="NaN or infinite"):
        sd.least_squares(
            lambda y, _: y * jnp.nan,
            jnp.zeros(2),
            key=jax.random.key(0),
            solver=solver,
            max_evaluations=150,
        )
