"""The benchmark's tasks: what is sought is the minimum, starts are allowed, plateaus are flat."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks import tasks
from benchmarks._task import Task, precision_of
from benchmarks.tasks import bbob, boxes, brdf, negated_gaussian, rocket


def built(name, full=False) -> list[Task]:
    found = tasks.module(name).build(full)
    return found if isinstance(found, list) else [found]


HERE = [task for name in tasks.BLACK_BOXES if name != "shadow" for task in built(name)]
BY_NAME = {task.name: task for task in HERE}
WITH_RESIDUALS = [task.name for task in HERE if task.residuals is not None]
PLATEAUS = ("box2", "box10", "box10-occluding", "rocket")


@pytest.fixture(params=HERE, ids=lambda task: task.name)
def task(request):
    """Each task that runs without a renderer, in its precision."""
    with precision_of(request.param):
        yield request.param


def test_the_reference_is_the_minimum(task):
    reference = task.reference if task.choose is None else task.choose(0)
    y, lowest = jnp.asarray(reference), task.optimum or 0.0
    loss = jax.jit(task.loss)
    assert loss(y).dtype == task.precision
    assert loss(y) == pytest.approx(lowest, abs=1e-12)
    for seed in range(3):
        assert loss(task.start(seed)) > lowest + 1e-4
    low, high = task.bounds
    assert np.all((low < reference) & (reference < high))
    assert task.sigma < np.min(high - low) / 4


def test_starts_are_within_the_bounds_and_known_by_their_seed(task):
    low, high = (np.asarray(bound) for bound in task.bounds)
    for seed in range(task.seeds):
        y = task.start(seed)
        assert y.dtype == task.precision
        assert y.shape == task.reference.shape == low.shape == high.shape
        assert np.all((low <= y) & (y <= high))
        assert np.array_equal(y, task.start(seed))


@pytest.mark.parametrize("name", WITH_RESIDUALS)
def test_the_loss_is_the_sum_or_the_mean_of_the_squared_residuals(name):
    found = BY_NAME[name]
    assert found.residuals is not None
    with precision_of(found):
        y = found.start(1)
        squares = np.asarray(jax.jit(found.residuals)(y)) ** 2
        loss = float(jax.jit(found.loss)(y))
    assert min(abs(loss / squares.mean() - 1), abs(loss / squares.sum() - 1)) < 1e-5


@pytest.mark.parametrize("name", PLATEAUS)
def test_around_the_reference_nothing_changes_for_half_a_step(name):
    found = BY_NAME[name]
    half = rocket.SECONDS_PER_STEP / 2 if name == "rocket" else 1 / boxes.PIXELS / 2
    moves = np.random.default_rng(0).uniform(-0.95, 0.95, (16, found.reference.size))
    loss = jax.jit(jax.vmap(found.loss))
    reference = np.asarray(found.reference)
    assert np.all(loss((reference + half * moves).astype(np.float32)) == 0)
    beyond = reference + 1.05 * half * np.eye(reference.size)
    assert np.all(loss(beyond.astype(np.float32)) > 0)


def test_colours_add_up_or_hide():
    together = jnp.full(4, 0.5)
    red, green = np.array(boxes.COLOURS[:2], np.float32)
    adding, hiding = jax.jit(boxes.draw), jax.jit(boxes.draw_occluding)
    assert np.asarray(adding(together))[32, 32] == pytest.approx(red + green)
    assert np.asarray(hiding(together))[32, 32] == pytest.approx(green)
    apart = jnp.array([0.25, 0.25, 0.75, 0.75])
    assert np.array_equal(adding(apart), hiding(apart))


def test_the_rocket_flies_by_euler_steps():
    y = np.array(rocket.REFERENCE) + 0.3
    position, velocity, seen = np.zeros(2), np.zeros(2), []
    for step in range(rocket.STEPS):
        time = step * rocket.SECONDS_PER_STEP
        first, second = (np.array(thrust) for thrust in rocket.THRUSTS)
        force = first * (time < y[0]) + second * (y[1] <= time < y[2])
        acceleration = force - [0, rocket.GRAVITY] - rocket.DRAG * velocity
        position = position + rocket.SECONDS_PER_STEP * velocity
        velocity = velocity + rocket.SECONDS_PER_STEP * acceleration
        if (step + 1) % rocket.SEEN_EVERY == 0:
            seen.append(position)
    flown = jax.jit(rocket.fly)(jnp.asarray(y, jnp.float32))
    assert np.asarray(flown) == pytest.approx(np.array(seen), rel=1e-4)


def test_the_hessian_of_the_phong_sphere_is_analytic(x64):
    (found,) = built("brdf")
    y = np.asarray(found.start(0))
    target = brdf.shade(jnp.asarray(brdf.REFERENCE), 16)
    loss = lambda y: jnp.mean((brdf.shade(y, 16) - target) ** 2)
    gradient, step = jax.jit(jax.vmap(jax.grad(loss))), 1e-5 * np.eye(7)
    differences = (gradient(y[None] + step) - gradient(y[None] - step)) / 2e-5
    hessian = jax.jit(jax.hessian(loss))(y)
    assert np.asarray(hessian) == pytest.approx(np.asarray(differences), rel=1e-6, abs=1e-9)
    assert np.linalg.norm(hessian[6]) > 1e-3


def test_the_ellipsoid_is_as_long_as_it_says(x64):
    (found,) = built("ellipsoid")
    eigenvalues = np.linalg.eigvalsh(jax.jit(jax.hessian(found.loss))(found.reference))
    assert eigenvalues[-1] / eigenvalues[0] == pytest.approx(1e6, rel=1e-6)


def test_the_negated_gaussian_starts_from_a_grid_where_it_is_indefinite(x64):
    (found,) = built("negated-gaussian", full=True)
    starts = np.stack([found.start(seed) for seed in range(found.seeds)])
    assert len(np.unique(starts, axis=0)) == found.seeds
    assert np.abs(starts).max(axis=0) == pytest.approx(2.5)
    curvature = jax.jit(jax.vmap(jax.hessian(negated_gaussian.well)))(starts)
    indefinite = np.linalg.eigvalsh(curvature)[:, 0] < 0
    assert np.array_equal(indefinite, np.linalg.norm(starts, axis=1) > 1)


@pytest.mark.parametrize("number", bbob.FUNCTIONS)
@pytest.mark.parametrize("n", [2, 20])
def test_bbob_is_zero_at_the_optimum_of_each_instance(number, n):
    function = bbob.Function(number, n)
    optima = [function.choose(seed) for seed in range(20)]
    assert len(np.unique(optima, axis=0)) == 20
    for seed, optimum in enumerate(optima):
        function.choose(seed)
        assert np.abs(optimum).max() <= 5
        assert function(optimum[None]) == pytest.approx([0], abs=1e-9)
        assert np.all(function(optimum[None] + np.eye(n)) > 0)


def test_bbob_has_cocos_values():
    f1, f8 = BY_NAME["f1-5d"], BY_NAME["f8-5d"]
    assert f1.choose is not None
    assert f8.choose is not None
    with precision_of(f1):
        y = np.asarray(f1.start(0))
        many = jax.jit(jax.vmap(f1.loss))
        for seed in (0, 7):
            optimum = f1.choose(seed)
            values = many(np.stack([y, optimum]))
            assert values == pytest.approx([np.sum((y - optimum) ** 2), 0])
        # Rosenbrock's function as COCO scales and shifts it
        optimum = f8.choose(3)
        z = max(1, 5**0.5 / 8) * (y - optimum) + 1
        expected = np.sum(100 * (z[:-1] ** 2 - z[1:]) ** 2 + (z[:-1] - 1) ** 2)
        assert float(f8.loss(y)) == pytest.approx(expected)


def test_whole_families_are_named_by_function_and_dimension():
    for name, count in (("rosenbrock", 3), ("ellipsoid", 2), ("bbob", 32)):
        family = built(name, full=True)
        assert len({task.name for task in family}) == len(family) == count
        for task in family:
            size = ravel_pytree(task.reference)[0].size
            assert task.name.endswith(f"-{size}d")
            assert task.optimum == 0
            assert task.seeds == 20
