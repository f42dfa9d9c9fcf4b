"""The tasks of ZeroGrads: what is sought is the minimum, starts are allowed, plateaus are flat."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import smoothdiff as sd
from benchmarks._task import Task
from benchmarks.tasks import (
    gravity,
    led,
    mlp,
    mosaic,
    node_graph,
    rocket10,
    spline_vae,
    texture256,
    wicker,
)

SIZES = {
    led: 336,
    mosaic: 320,
    rocket10: 10,
    gravity: 5,
    wicker: 3,
    node_graph: 24,
    texture256: 196_608,
    mlp: 35_152,
    spline_vae: 8764,
}
FLAT = (led, mosaic, rocket10, wicker, node_graph, spline_vae)
name = lambda module: module.__name__.rpartition(".")[-1]


def built(module) -> list[Task]:
    found = module.build(False)
    return found if isinstance(found, list) else [found]


@pytest.mark.parametrize("module", SIZES, ids=name)
def test_the_reference_is_the_minimum_and_starts_are_allowed(module):
    for task in built(module):
        loss = jax.jit(task.loss)
        assert loss(task.reference) == pytest.approx(0, abs=1e-12)
        low, high = task.bounds
        assert np.all((low < task.reference) & (task.reference < high))
        assert task.sigma < np.min(high - low) / 3
        assert task.reference.size == SIZES[module]
        for seed in range(4):
            y = task.start(seed)
            assert y.dtype == task.reference.dtype == np.float32
            assert y.shape == task.reference.shape == low.shape == high.shape
            assert np.all((low <= y) & (y <= high))
            assert np.array_equal(y, task.start(seed))
            assert loss(y) > 1e-4
        assert loss(task.start(0)) == loss(task.start(0))


@pytest.mark.parametrize("module", [mosaic, gravity, spline_vae], ids=name)
def test_many_at_once_are_as_one_by_one(module):
    for task in built(module)[:1]:
        ys = jnp.stack([task.start(seed) for seed in range(3)])
        one = jax.jit(task.loss)
        one_by_one = [float(one(y)) for y in ys]
        together = np.asarray(jax.jit(jax.vmap(task.loss))(ys))
        # a pixel or a fall may turn with the rounding
        assert together == pytest.approx(one_by_one, rel=0.02)


@pytest.mark.parametrize("module", FLAT, ids=name)
def test_the_loss_has_no_slope(module):
    (task,) = built(module)
    assert np.all(np.asarray(jax.jit(jax.grad(task.loss))(task.start(0))) == 0)


def test_led_counts_wrong_switches(key):
    (task,) = built(led)
    y = task.start(3)
    wrong = int(jnp.sum(led.switches(y) != led.switches(task.reference)))
    assert wrong > 100
    lit = 3 / led.SEGMENT.size
    assert float(jax.jit(task.loss)(y)) == pytest.approx(wrong * lit, rel=1e-5)
    segments, pixels = np.unique(led.SEGMENT[led.SEGMENT >= 0], return_counts=True)
    assert np.array_equal(segments, np.arange(336))
    assert np.all(pixels == 3)
    same_side = jnp.where(y > 0.5, 0.51, 0.49)
    assert np.array_equal(led.draw(y), led.draw(same_side))


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


@pytest.mark.parametrize("module", [led, mosaic], ids=name)
def test_a_parameter_changes_only_its_support(module, key):
    support, draw = module.support(), jax.jit(module.draw)
    y = jax.random.uniform(key, (SIZES[module],))
    before = draw(y)
    assert support(y).shape == before.shape
    for j in (0, 17, 150, SIZES[module] - 1):
        turned = draw(y.at[j].set(1 - y[j]))
        may = np.asarray(support(jnp.zeros_like(y).at[j].set(1))) > 0
        changed = np.asarray(turned != before)
        assert changed.any()
        assert np.all(may[changed])
        assert may.mean() < 0.02


@pytest.mark.parametrize("module", [led, mosaic, texture256], ids=name)
def test_the_loss_is_the_sum_of_the_terms(module):
    (task,) = built(module)
    assert task.terms is not None
    assert task.support is not None
    y = task.start(0)
    terms = jax.jit(task.terms)(y)
    assert terms.shape == task.support(y).shape
    # rounding walks at random as a sum goes on
    rounding = np.sqrt(terms.size) * np.finfo(np.float32).eps
    assert float(terms.sum()) == pytest.approx(float(jax.jit(task.loss)(y)), rel=rounding)


@pytest.mark.parametrize("module", [led, wicker, node_graph], ids=name)
def test_what_is_not_wrong_is_drawn_right(module):
    (task,) = built(module)
    assert task.distance is not None
    assert task.optimum == 0
    assert 0 < task.distance(task.start(0)) <= SIZES[module]
    nudged = task.reference + jnp.where(task.reference > 0.5, 1e-3, -1e-3)
    assert task.distance(nudged) == 0
    assert jax.jit(task.loss)(nudged) == 0


def test_the_support_of_led_serves_the_gradient(key):
    (task,) = built(led)
    assert task.terms is not None
    grad = sd.smooth_grad(task.terms, task.sigma, num_samples=64, support=task.support)
    y = task.start(0)
    slope = np.asarray(jax.jit(grad)(key, y))
    wrong = np.asarray(led.switches(y) != led.switches(task.reference))
    agrees = np.sign(slope) == np.where(np.asarray(task.reference) > 0.5, -1, 1)
    assert np.mean(agrees[wrong]) > 0.95


def test_rockets_fly_by_euler_steps():
    y = np.asarray(rocket10.REFERENCE) + 0.1
    position, velocity = np.zeros((10, 2)), np.zeros((10, 2))
    for step in range(rocket10.STEPS):
        force = np.where((step / rocket10.STEPS < y)[:, None], rocket10.ENGINES, 0)
        acceleration = force - [0, rocket10.GRAVITY] - rocket10.DRAG * velocity
        position = position + rocket10.SECONDS_PER_STEP * velocity
        velocity = velocity + rocket10.SECONDS_PER_STEP * acceleration
    flown = jax.jit(rocket10.fly)(jnp.asarray(y, jnp.float32))
    assert np.asarray(flown) == pytest.approx(position, rel=1e-4)


def test_rockets_are_late_or_early_by_a_step():
    (task,) = built(rocket10)
    reference, half = np.asarray(task.reference), 0.5 / rocket10.STEPS
    loss = jax.jit(jax.vmap(task.loss))
    moves = np.random.default_rng(0).uniform(-0.95, 0.95, (16, 10))
    assert np.all(loss((reference + half * moves).astype(np.float32)) == 0)
    beyond = reference + 1.05 * half * np.eye(10)
    assert np.all(loss(beyond.astype(np.float32)) > 0)


@pytest.mark.parametrize("kind", gravity.RATES)
def test_cubes_that_fall_as_they_should_form_a_tower(kind):
    fall = jax.jit(jax.vmap(lambda y: gravity.fall(y, gravity.RATES[kind])))
    reference = np.array(gravity.REFERENCE, np.float32)
    aside = reference + np.array([0, 0, 0.5, 0, 0], np.float32)
    tower, tipped = np.asarray(fall(np.stack([reference, aside])))[:, -1].mean(axis=2)
    assert tower[:, 1] == pytest.approx([1.5, 2.5], abs=0.05)
    assert tipped[1, 1] < 2


def test_contacts_between_cubes_keep_the_momentum(x64, key):
    position = jnp.array([[0.0, 5.0], [0.3, 5.9], [-0.6, 6.6]])
    angle, spin = jnp.array([[0.1, -0.2, 0.5], [1.0, -2.0, 3.0]])
    velocity = jax.random.normal(key, (3, 2))
    force, torque = jax.jit(gravity._contacts)(
        (position, angle, velocity, spin), jnp.asarray(1e3), jnp.asarray(5.0)
    )
    assert np.abs(force).max() > 10
    assert np.asarray(force.sum(0)) == pytest.approx([0, 0], abs=1e-9)
    assert float(jnp.sum(torque + gravity._cross(position, force))) == pytest.approx(0, abs=1e-9)


def test_a_dropped_cube_rises_again_by_its_restitution(x64):
    rate, restitution = gravity.RATES["stiff"], 0.6
    log = np.log(restitution)
    damping = jnp.asarray(-2 * rate * log / np.hypot(log, np.pi))
    # on one corner under its middle, so that it does not turn
    angle = jnp.full(3, jnp.pi / 4)
    position = jnp.array([[0.0, 0.5**0.5], [9.0, 9.0], [99.0, 9.0]])
    velocity = jnp.array([[0.0, -2.0], [0.0, 0.0], [0.0, 0.0]])
    step = 1e-4
    contacts = jax.jit(gravity._contacts)
    for _ in range(300):
        state = position, angle, velocity, jnp.zeros(3)
        velocity = velocity + step * contacts(state, jnp.asarray(rate**2), damping)[0]
        position = position + step * velocity
    # a dashpot that never pulls lets go a little earlier, and so throws back a little more
    assert 2 * restitution < velocity[0, 1] < 2.2 * restitution


def test_wicker_is_constant_for_each_triple_of_counts(key):
    (task,) = built(wicker)
    boxes = np.array(list(itertools.product(*(range(n) for n in wicker.CHOICES))))
    inside = np.asarray(jax.random.uniform(key, (2, *boxes.shape), minval=0.01, maxval=0.99))
    ys = ((boxes + inside) / wicker.CHOICES).astype(np.float32)
    first, second = np.asarray(jax.jit(jax.vmap(jax.vmap(task.loss)))(ys))
    assert first == pytest.approx(second, rel=1e-5)
    assert np.array_equal(boxes[first == 0] + wicker.FEWEST, [wicker.COUNTS])
    corners = jax.vmap(wicker.counts)(jnp.array([[0.0] * 3, [1.0] * 3]))
    assert np.array_equal(corners, [wicker.FEWEST, wicker.FEWEST + wicker.CHOICES - 1])


def test_edges_of_the_graph_are_rounded_and_may_have_no_effect():
    (task,) = built(node_graph)
    loss = jax.jit(task.loss)
    reference = np.asarray(task.reference)
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


def test_the_mlp_is_a_network_that_draws_a_digit():
    (task,) = built(mlp)
    assert task.image is not None
    y = task.start(1)
    _, layers = ravel_pytree(mlp.networks.initial(mlp.LAYERS, jax.random.key(1)))
    x = mlp.INPUT
    shapes = [tuple(np.shape(weights)) for weights, _ in layers(y)]
    assert shapes == [(32, 256), (32, 32), (784, 32)]
    for i, (weights, bias) in enumerate(layers(y)):
        x = np.asarray(weights) @ x + np.asarray(bias)
        x = np.maximum(x, 0) if i < 2 else 1 / (1 + np.exp(-x))
        assert np.abs(bias).max() <= weights.shape[1] ** -0.5
    assert np.asarray(task.image(y))[..., 0].ravel() == pytest.approx(x, abs=1e-5)
    digit = np.asarray(task.image(task.reference))
    assert digit.min() == pytest.approx(0.02, abs=1e-4)
    assert digit.max() > 0.9


def test_the_spline_goes_through_its_points():
    points = jnp.asarray(spline_vae.DIGITS[5], jnp.float32)
    picture = np.asarray(jax.jit(spline_vae.rasterise)(points))
    column, row = np.floor(np.asarray(points) * 28).astype(int).T
    assert np.all(picture[row, column] == 1)
    assert set(np.unique(picture)) == {0, 1}
    assert 0.05 < picture.mean() < 0.3
    assert np.all(np.asarray(spline_vae.rasterise(points + 2)) == 0)


def test_the_decoder_of_the_reference_draws_the_digits():
    (task,) = built(spline_vae)
    code = jnp.asarray(spline_vae.codes(), jnp.float32)
    assert code.shape == (10, 20)
    decoder = spline_vae.solved(code)
    moves = jax.vmap(lambda c: spline_vae.networks.apply(decoder, c))(code)
    drawn = np.asarray(moves).reshape(10, 10, 2) + spline_vae.DIAGONAL
    assert drawn == pytest.approx(spline_vae.DIGITS, abs=1e-4)
    assert task.image is not None
    assert task.image(task.reference).shape == (56, 140, 3)
