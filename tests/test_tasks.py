"""The tasks that need no renderer: the minimum is sought, starts are allowed, plateaus are flat."""

import itertools
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._task import Task, precision_of
from benchmarks.scenes import networks
from benchmarks.tasks import (
    boxes,
    brdf,
    digits,
    functions,
    gravity,
    led,
    mosaic,
    node_graph,
    rockets,
    wicker,
)

KINDS = ("function", "program")
NAMES = [name for name, entry in _registry.tasks().items() if entry.kind in KINDS] + ["brdf"]
STEPS = dict.fromkeys(boxes.TASKS, 1 / boxes.PIXELS)
STEPS |= {"rocket": rockets.SECONDS_PER_STEP, "rocket10": 1 / rockets.STEPS10}
DEAR = ("gravity", "mosaic", "mlp", "spline-vae")  # to compile
# its reference and its loss are the same to the last bit under the compiler options of users
EXACT = ("rocket10",)
FLAT = (*STEPS, "led", "mosaic", "wicker", "node-graph", "spline-vae")


def slowly(names, slow):
    """All names, of which some run in the slow part."""
    return [pytest.param(name, marks=[pytest.mark.slow] if name in slow else []) for name in names]


@cache
def family(name, full=False) -> list[Task]:
    found = _registry.task(name).build(full)
    return found if isinstance(found, list) else [found]


def built(name) -> Task:
    return family(name)[0]


@pytest.mark.parametrize("name", slowly(NAMES, (*DEAR, *EXACT)))
def test_the_reference_is_the_minimum_and_starts_are_allowed(name):
    for task in family(name):
        with precision_of(task):
            sought = task.score.reference if task.choose is None else task.choose(0)
            starts = [task.start(seed) for seed in range(4)]
            low, high = (np.asarray(bound) for bound in task.problem.bounds)
            assert task.problem.sigma < np.min(high - low) / 3
            assert np.all((low < sought) & (sought < high))
            for seed, y in enumerate(starts):
                assert y.dtype == task.precision
                assert y.shape == sought.shape == low.shape == high.shape
                assert np.all((low <= y) & (y <= high))
                assert np.array_equal(y, task.start(seed))
            losses = jax.jit(jax.vmap(task.problem.loss))(jnp.stack([sought, *starts]))
            lowest = task.score.optimum or 0.0
            assert losses.dtype == task.precision
            assert losses[0] == pytest.approx(lowest, abs=1e-12)
            assert np.all(losses[1:] > lowest + 1e-4)
            if (wrong := task.score.distance) is not None:
                assert wrong(sought) == 0 < wrong(starts[0]) <= sought.size


def test_families_are_named_by_function_and_dimension():
    for name, count in (("rosenbrock", 3), ("ellipsoid", 2), ("bbob", 32)):
        tasks = family(name, full=True)
        assert len({task.name for task in tasks}) == len(tasks) == count
        for task in tasks:
            assert task.name.endswith(f"-{task.score.reference.size}d")
            assert task.score.optimum == 0
            assert task.seeds == 20


@pytest.mark.slow
@pytest.mark.parametrize("name", FLAT)
def test_the_loss_has_no_slope(name):
    task = built(name)
    assert not np.any(jax.jit(jax.grad(task.problem.loss))(task.start(0)))


@pytest.mark.parametrize("name", slowly(STEPS, EXACT))
def test_around_the_reference_nothing_changes_for_half_a_step(name):
    task, half = built(name), STEPS[name] / 2
    reference = np.asarray(task.score.reference, float)
    moves = np.random.default_rng(0).uniform(-0.95, 0.95, (16, reference.size))
    away = half * np.concatenate([moves, 1.05 * np.eye(reference.size)])
    losses = jax.jit(jax.vmap(task.problem.loss))((reference + away).astype(np.float32))
    assert np.array_equal(losses > 0, np.arange(len(away)) >= len(moves))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mosaic", "gravity", "spline-vae"])
def test_many_at_once_are_as_one_by_one(name):
    task = built(name)
    ys = jnp.stack([task.start(seed) for seed in range(3)])
    one = jax.jit(task.problem.loss)
    together = np.asarray(jax.jit(jax.vmap(task.problem.loss))(ys))
    # a pixel or a fall may turn with the rounding
    assert together == pytest.approx([float(one(y)) for y in ys], rel=0.02)


@pytest.mark.parametrize("name", ["led", "texture256"])
def test_the_loss_is_the_sum_of_the_terms(name):
    problem, y = built(name).problem, built(name).start(0)
    terms_of = problem.terms
    assert terms_of is not None
    loss, terms = jax.jit(lambda y: (problem.loss(y), terms_of(y)))(y)
    assert terms.shape == problem.support(y).shape
    # rounding walks at random as a sum goes on
    rounding = np.sqrt(terms.size) * np.finfo(np.float32).eps
    assert float(terms.sum()) == pytest.approx(float(loss), rel=rounding)


@pytest.mark.parametrize("name", ["rosenbrock", "ellipsoid"])
def test_the_loss_is_the_sum_of_the_squared_residuals(name):
    problem = built(name).problem
    residuals_of = problem.residuals
    assert residuals_of is not None
    with precision_of(built(name)):
        y = built(name).start(1)
        loss, residuals = jax.jit(lambda y: (problem.loss(y), residuals_of(y)))(y)
        assert float(loss) == pytest.approx(np.sum(np.asarray(residuals) ** 2), rel=1e-12)


@pytest.mark.parametrize("module", [led, mosaic], ids=["led", "mosaic"])
def test_a_parameter_changes_only_its_support(module, key):
    support, draw = module.support(), jax.jit(module.draw)
    y = jax.random.uniform(key, (module.SIZE,))
    before = draw(y)
    assert support(y).shape == before.shape
    for j in (0, 17, 150, module.SIZE - 1):
        changed = np.asarray(draw(y.at[j].set(1 - y[j])) != before)
        may = np.asarray(support(jnp.zeros_like(y).at[j].set(1))) > 0
        assert changed.any()
        assert np.all(may[changed])
        assert may.mean() < 0.02


def test_colours_add_up_or_hide():
    together = jnp.full(4, 0.5)
    red, green = np.array(boxes.COLOURS[:2], np.float32)
    adding, hiding = jax.jit(boxes.draw), jax.jit(boxes.draw_occluding)
    assert np.asarray(adding(together))[32, 32] == pytest.approx(red + green)
    assert np.asarray(hiding(together))[32, 32] == pytest.approx(green)
    apart = jnp.array([0.25, 0.25, 0.75, 0.75])
    assert np.array_equal(adding(apart), hiding(apart))


def test_rockets_fly_by_euler_steps():
    def flown(steps, engine, size=()):
        position, velocity = np.zeros((2, *size, 2))
        for step in range(steps):
            acceleration = engine(step) - [0, rockets.GRAVITY] - rockets.DRAG * velocity
            position = position + rockets.SECONDS_PER_STEP * velocity
            velocity = velocity + rockets.SECONDS_PER_STEP * acceleration
            if (step + 1) % rockets.SEEN_EVERY == 0:
                yield position

    def engine(step):
        time, (first, second) = step * rockets.SECONDS_PER_STEP, np.array(rockets.THRUSTS)
        return first * (time < y[0]) + second * (y[1] <= time < y[2])

    y = np.array(rockets.REFERENCE, np.float32) + np.float32(0.3)
    seen = np.array(list(flown(rockets.STEPS, engine)))
    assert np.asarray(jax.jit(rockets.fly)(y)) == pytest.approx(seen, rel=1e-4)
    y10 = np.array(rockets.REFERENCE10, np.float32) + np.float32(0.1)
    engines = lambda step: np.where((step / rockets.STEPS10 < y10)[:, None], rockets.ENGINES, 0)
    *_, end = flown(rockets.STEPS10, engines, y10.shape)
    assert np.asarray(jax.jit(rockets.fly10)(y10)) == pytest.approx(end, rel=1e-4)


@pytest.mark.slow
def test_the_hessian_of_the_phong_sphere_is_analytic(x64):
    y = np.asarray(built("brdf").start(0))
    target = brdf.shade(jnp.asarray(brdf.REFERENCE), 16)
    loss = lambda y: jnp.mean((brdf.shade(y, 16) - target) ** 2)
    gradient, step = jax.jit(jax.vmap(jax.grad(loss))), 1e-5 * np.eye(7)
    differences = (gradient(y[None] + step) - gradient(y[None] - step)) / 2e-5
    hessian = jax.jit(jax.hessian(loss))(y)
    assert np.asarray(hessian) == pytest.approx(np.asarray(differences), rel=1e-6, abs=1e-9)
    assert np.linalg.norm(hessian[6]) > 1e-3


def test_the_ellipsoid_is_as_long_as_it_says(x64):
    task = built("ellipsoid")
    assert task.problem.residuals is not None
    slopes = jax.jit(jax.jacfwd(task.problem.residuals))(task.score.reference)
    stretched = np.linalg.svd(slopes, compute_uv=False)
    assert stretched[0] / stretched[-1] == pytest.approx(1e3, rel=1e-6)


def test_the_negated_gaussian_starts_from_a_grid_where_it_is_indefinite(x64):
    (task,) = family("negated-gaussian", full=True)
    starts = np.stack([task.start(seed) for seed in range(task.seeds)])
    assert len(np.unique(starts, axis=0)) == task.seeds
    assert np.abs(starts).max(axis=0) == pytest.approx(2.5)
    curvature = jax.jit(jax.vmap(jax.hessian(functions.well)))(starts)
    indefinite = np.linalg.eigvalsh(curvature)[:, 0] < 0
    assert np.array_equal(indefinite, np.linalg.norm(starts, axis=1) > 1)


@pytest.mark.parametrize("n", [2, 20])
def test_bbob_is_zero_at_the_optimum_of_each_instance(n):
    for number in functions.BBOB:
        function = functions.OnHost(number, n)
        optima = [function.choose(seed) for seed in range(20)]
        assert len(np.unique(optima, axis=0)) == 20
        assert np.abs(optima).max() <= 5
        for seed, optimum in enumerate(optima):
            function.choose(seed)
            assert function(optimum[None]) == pytest.approx([0], abs=1e-9)
            assert np.all(function(optimum[None] + np.eye(n)) > 0)


def test_bbob_has_cocos_values():
    f1, f8, _ = family("bbob")
    assert f1.choose is not None
    assert f8.choose is not None
    with precision_of(f1):
        y = np.asarray(f1.start(0))
        many = jax.jit(jax.vmap(f1.problem.loss))
        for seed in (0, 7):
            optimum = f1.choose(seed)
            values = many(np.stack([y, optimum]))
            assert values == pytest.approx([np.sum((y - optimum) ** 2), 0])
        # Rosenbrock's function as COCO scales and shifts it
        z = max(1, 5**0.5 / 8) * (y - f8.choose(3)) + 1
        expected = np.sum(100 * (z[:-1] ** 2 - z[1:]) ** 2 + (z[:-1] - 1) ** 2)
        assert float(f8.problem.loss(y)) == pytest.approx(expected)


def test_led_counts_wrong_switches():
    task = built("led")
    y = task.start(3)
    assert task.score.distance is not None
    wrong = int(task.score.distance(y))
    assert wrong > 100
    lit = 3 / led.SEGMENT.size
    assert float(jax.jit(task.problem.loss)(y)) == pytest.approx(wrong * lit, rel=1e-5)
    segments, pixels = np.unique(led.SEGMENT[led.SEGMENT >= 0], return_counts=True)
    assert np.array_equal(segments, np.arange(336))
    assert np.all(pixels == 3)
    draw = jax.jit(led.draw)
    assert np.array_equal(draw(y), draw(jnp.where(y > 0.5, 0.51, 0.49)))


@pytest.mark.slow
def test_the_support_of_led_serves_the_gradient(key):
    task = built("led")
    problem, reference = task.problem, task.score.reference
    assert problem.terms is not None
    grad = sd.smooth_grad(problem.terms, problem.sigma, num_samples=64, support=problem.support)
    y = task.start(0)
    slope = np.asarray(jax.jit(grad)(key, y))
    wrong = np.asarray(led.switches(y) != led.switches(reference))
    agrees = np.sign(slope) == np.where(np.asarray(reference) > 0.5, -1, 1)
    assert np.mean(agrees[wrong]) > 0.95


def test_mosaic_is_what_rays_see():
    y = np.random.default_rng(5).uniform(0, 1, mosaic.SIZE)
    picture = np.asarray(jax.jit(mosaic.draw)(jnp.asarray(y, jnp.float32)))
    toward = np.array([0, mosaic.AWAY, -mosaic.UP])
    row, column = np.divmod(np.arange(mosaic.SIZE), mosaic.COLUMNS)
    angle = np.pi / 2 * y
    turn = np.stack([np.cos(angle), np.sin(angle)])
    into = lambda x, depth: (turn[0] * x + turn[1] * depth, turn[0] * depth - turn[1] * x)

    def ray_sees(x, v):
        height = np.full(mosaic.SIZE, v * mosaic.AWAY)
        begin = (*into(x - column - 0.5, v * mosaic.UP - row), height)
        along = (*into(toward[0], toward[1]), np.full(mosaic.SIZE, toward[2]))
        low = (-mosaic.HALF, -mosaic.HALF, 0)
        planes = [
            ((at - b) / a, (at + 2 * mosaic.HALF - b) / a)
            for b, a, at in zip(begin, along, low, strict=True)
        ]
        enter = np.stack([np.minimum(*pair) for pair in planes])
        leave = np.stack([np.maximum(*pair) for pair in planes]).min(0)
        first = np.where(enter.max(0) < leave, enter.max(0), np.inf)
        cube = int(np.argmin(first))
        if np.isinf(first[cube]):
            return np.full(3, mosaic.FLOOR)
        return mosaic.COLOURS.reshape(-1, 3)[cube] * mosaic.SHADES[int(np.argmax(enter[:, cube]))]

    pixels = np.random.default_rng(6).integers(0, picture.shape[:2], (100, 2))
    different = 0
    for pixel in pixels:
        rays = itertools.product(*(mosaic.RAYS * at + np.arange(mosaic.RAYS) for at in pixel))
        seen = np.mean([ray_sees(mosaic.X[ray], mosaic.V[ray[0]]) for ray in rays], axis=0)
        different += not np.allclose(picture[tuple(pixel)], seen, atol=1e-5)
    assert different <= 1  # a ray along an edge


@pytest.mark.slow
@pytest.mark.parametrize("kind", gravity.RATES)
def test_cubes_that_fall_as_they_should_form_a_tower(kind):
    fall = jax.jit(jax.vmap(lambda y: gravity.fall(y, gravity.RATES[kind])))
    reference = np.array(gravity.REFERENCE, np.float32)
    aside = reference + np.array([0, 0, 0.5, 0, 0], np.float32)
    tower, tipped = np.asarray(fall(np.stack([reference, aside])))[:, -1].mean(axis=2)
    assert tower[:, 1] == pytest.approx([1.5, 2.5], abs=0.05)
    assert tipped[1, 1] < 2


@pytest.mark.slow
def test_cubes_keep_their_momentum_and_rise_again_by_their_restitution(x64, key):
    contacts = jax.jit(gravity._contacts)
    position = jnp.array([[0.0, 5.0], [0.3, 5.9], [-0.6, 6.6]])
    angle, spin = jnp.array([[0.1, -0.2, 0.5], [1.0, -2.0, 3.0]])
    state = position, angle, jax.random.normal(key, (3, 2)), spin
    force, torque = contacts(state, jnp.asarray(1e3), jnp.asarray(5.0))
    assert np.abs(force).max() > 10
    assert np.asarray(force.sum(0)) == pytest.approx([0, 0], abs=1e-9)
    assert float(jnp.sum(torque + gravity._cross(position, force))) == pytest.approx(0, abs=1e-9)

    rate, restitution = gravity.RATES["stiff"], 0.6
    log = np.log(restitution)
    damping = jnp.asarray(-2 * rate * log / np.hypot(log, np.pi))
    # on one corner under its middle, so that it does not turn
    angle = jnp.full(3, jnp.pi / 4)
    position = jnp.array([[0.0, 0.5**0.5], [9.0, 9.0], [99.0, 9.0]])
    velocity = jnp.array([[0.0, -2.0], [0.0, 0.0], [0.0, 0.0]])
    step = 1e-4
    for _ in range(300):
        state = position, angle, velocity, jnp.zeros(3)
        velocity = velocity + step * contacts(state, jnp.asarray(rate**2), damping)[0]
        position = position + step * velocity
    # a dashpot that never pulls lets go a little earlier, and so throws back a little more
    assert 2 * restitution < velocity[0, 1] < 2.2 * restitution


def test_wicker_is_constant_for_each_triple_of_counts(key):
    counts = np.array(list(itertools.product(*(range(n) for n in wicker.CHOICES))))
    inside = np.asarray(jax.random.uniform(key, (2, *counts.shape), minval=0.01, maxval=0.99))
    ys = ((counts + inside) / wicker.CHOICES).astype(np.float32)
    first, second = np.asarray(jax.jit(jax.vmap(jax.vmap(built("wicker").problem.loss)))(ys))
    assert first == pytest.approx(second, rel=1e-5)
    assert np.array_equal(counts[first == 0] + wicker.FEWEST, [wicker.COUNTS])
    corners = jax.jit(jax.vmap(wicker.counts))(jnp.array([[0.0] * 3, [1.0] * 3]))
    assert np.array_equal(corners, [wicker.FEWEST, wicker.FEWEST + wicker.CHOICES - 1])


def test_edges_of_the_graph_are_rounded_and_may_have_no_effect():
    task = built("node-graph")
    loss = jax.jit(task.problem.loss)
    reference = np.asarray(task.score.reference)
    assert loss((reference > 0.5).astype(np.float32)) == 0
    # none can be missing
    for j in np.flatnonzero(reference > 0.5):
        without = reference.copy()
        without[j] = 0.25
        assert loss(without) > 1e-4
    # an edge to an input that has one already, from an earlier node
    late = reference.copy()
    late[node_graph.EDGES.index(("3a", 2))] = 0.75
    assert loss(late) == 0


@pytest.mark.slow
def test_the_mlp_is_a_network_that_draws_a_digit():
    task = built("mlp")
    assert task.score.image is not None
    start = networks.initial(digits.LAYERS, jax.random.key(1))
    y, _ = ravel_pytree(start)
    assert np.array_equal(y, task.start(1))
    x = digits.INPUT
    assert [np.shape(weights) for weights, _ in start] == [(32, 256), (32, 32), (784, 32)]
    for i, (weights, bias) in enumerate(start):
        x = np.asarray(weights) @ x + np.asarray(bias)
        x = np.maximum(x, 0) if i < 2 else 1 / (1 + np.exp(-x))
        assert np.abs(bias).max() <= weights.shape[1] ** -0.5
    assert np.asarray(task.score.image(y))[..., 0].ravel() == pytest.approx(x, abs=1e-5)
    digit = np.asarray(task.score.image(task.score.reference))
    assert digit.min() == pytest.approx(0.02, abs=1e-4)
    assert digit.max() > 0.9


def test_the_spline_goes_through_its_points():
    points = jnp.asarray(digits.DIGITS[5], jnp.float32)
    rasterise = jax.jit(digits.rasterise)
    picture = np.asarray(rasterise(points))
    column, row = np.floor(np.asarray(points) * 28).astype(int).T
    assert np.all(picture[row, column] == 1)
    assert set(np.unique(picture)) == {0, 1}
    assert 0.05 < picture.mean() < 0.3
    assert not np.any(rasterise(points + 2))


@pytest.mark.slow
def test_the_decoder_of_the_reference_draws_the_digits():
    code = jnp.asarray(digits.codes(), jnp.float32)
    assert code.shape == (10, 20)
    decoder = digits.solved_decoder(code)
    moves = jax.vmap(lambda c: networks.apply(decoder, c))(code)
    drawn = np.asarray(moves).reshape(10, 10, 2) + digits.DIAGONAL
    assert drawn == pytest.approx(digits.DIGITS, abs=1e-4)
    score = built("spline-vae").score
    assert score.image is not None
    assert jax.eval_shape(score.image, score.reference).shape == (56, 140, 3)
