"""Descents: what is tuned, run and shown, and that the scenes' gradients are unbiased."""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.core import Tracer

import smoothdiff as sd
from benchmarks import _descents, _registry, _study
from benchmarks._descent import Configuration, Descent, axes, filtered, method, observed, problem
from benchmarks._task import Score, Task, TaskEntry
from benchmarks.scenes import _monte_carlo, plate, smoke
from benchmarks.tasks import lines, texture, volume


def sgd(rate, b1, b2, *, frozen=0):
    return optax.sgd(rate * (1 - frozen))


OPTIONS = Namespace(full=False, seeds=None, fresh=False, said="python -m benchmarks run bowl")


def bowl(name="bowl", high=np.inf):
    """A quadratic whose best rate is 1, but for a little noise."""
    scene = {"scene": jnp.arange(4.0)}

    def choose(seed):
        scene["scene"] = seed % 10 + jnp.arange(4.0)
        return scene["scene"]

    def gradient(y, key, scene):
        return {"a": y["a"] - scene + 1e-3 * jax.random.normal(key, (4,))}

    return Descent(
        name=name,
        title="A bowl",
        problem=problem(gradient, lambda: scene["scene"], {"a": jnp.zeros(4)}, 5, high=high),
        score=Score(
            errors=lambda y, scene: {
                "another": jnp.ones(()),
                "error": jnp.max(abs(y["a"] - scene)),
            },
            levels={"error": (0.1, 1e-9), "another": ()},
        ),
        start=lambda seed: {"a": jnp.zeros(4)},
        seeds=2,
        choose=choose,
        configurations=(
            Configuration("descent", "Gradient descent", sgd, remembers=False),
            Configuration("both", "Two", sgd, {"frozen": (0, 1)}, remembers=False),
            Configuration("adam", "Adam", partial(filtered, None)),
        ),
        rate=0.25,
        marks=(2, 5),
        pictures=lambda y, scene: {"line": y["a"], "grey": jnp.outer(y["a"], y["a"])},
        target=lambda scene: {"line": scene},
        pictured=(2,),
    )


@pytest.mark.slow
def test_results_say_what_was_tuned_reached_and_drawn(tmp_path, monkeypatch):
    built: list[Task] = [bowl("one"), replace(bowl("other"), pictures=None)]
    entry = TaskEntry("Bowls", "descent", lambda full: built)
    monkeypatch.setattr(_registry, "task", lambda name: entry)
    measured = _descents.measure("bowl", OPTIONS, tmp_path)
    results = _study.write(_study.about(OPTIONS) | measured, tmp_path)
    configurations = results["tasks"]["one"]["configurations"]
    both = configurations["both"]["tuned"]["2"]
    assert both["settings"] == {"rate": 1.0, "frozen": 0}
    assert both["ends"] == ["frozen"]
    assert configurations["descent"]["tuned"]["5"]["settings"] == {"rate": 1.0}
    assert set(configurations["adam"]["tuned"]["5"]["settings"]) == {"rate", "b1", "tie"}
    two = configurations["both"]
    assert two["to_levels"]["0.1"]["median"] == 1  # the first step of rate 1 gets there
    assert two["to_levels"]["1e-09"]["median"] is None
    assert two["at_marks"]["error"]["2"]["upper"] < 0.01

    for grids in (_descents.tables(results), _descents.compare(results, results)):
        assert [len(grid.rows) for grid in grids] == 2 * 4 * [len(configurations)]
    _descents.draw(results, tmp_path)
    for name in ("one/pictures-2", "other/error-vs-iterations", "other/error-vs-time"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000

    raw = sorted(tmp_path.glob("raw/*.npz"))
    assert {path.stem.split("-")[-2] for path in raw} == {"0", "1", "1000", "1001"}
    written = [path.stat().st_mtime_ns for path in raw]
    built.pop(0)
    again = _descents.measure("bowl", OPTIONS, tmp_path)["tasks"]["other"]
    assert again == measured["tasks"]["other"]
    assert [path.stat().st_mtime_ns for path in raw] == written


def test_a_run_is_the_loop_that_optax_documents():
    """With bounds, at which it stays."""
    momentum: Any = lambda rate, b1, b2: optax.sgd(rate, momentum=b1)
    task = bowl(high=1.5)
    scene, found, key = task.scene(0), {}, jax.random.key(7)
    settings = {"rate": 0.4, "b1": 0.5, "tie": 2}
    how = method(task, Configuration("m", "M", momentum), settings, observed(5, (2, 5)))
    record = lambda y, iterations: found.update({iterations: y["a"]})
    how.prepare(task.problem)(task.start(0), key, record)
    y: Any = task.start(0)
    transform = momentum(0.4, 0.5, None)
    state, gradient = transform.init(y), cast(Callable, task.problem.gradient)
    for i in range(5):
        slope = gradient(y, jax.random.fold_in(key, i), scene)
        updates, state = transform.update(slope, state, y)
        y = jax.tree.map(lambda x: jnp.minimum(x, 1.5), optax.apply_updates(y, updates))
    np.testing.assert_allclose(found[5], y["a"], rtol=1e-5)
    assert list(found)[-1] == 5
    assert (found[5][2:] == 1.5).all()


def test_all_configurations_have_one_grid_of_rates_and_decays():
    """1 - b2 = (1 - b1)^tie; what is a whole number is known when it is compiled."""
    seen = {}

    def build(rate, b1, b2, *, levels, sigma):
        if not isinstance(b1, Tracer):  # in the loop it is
            seen.update(b1=float(b1), b2=float(b2), levels=levels, sigma=float(sigma))
        return optax.sgd(rate)

    task = bowl()
    grids = [axes(task, each)[0] for each in task.configurations]
    assert grids[0] == {"rate": grids[2]["rate"]}
    assert set(grids[2]) == {"rate", "b1", "tie"}
    configuration = Configuration("c", "C", build, {"levels": (1, 2), "sigma": (0.5, 1.0)})
    grid, start = axes(task, configuration)
    assert start == {"rate": 0.25, "b1": 0.5, "tie": 2, "levels": 2, "sigma": 1.0}
    assert {"rate", "b1", "tie"} < set(grid)
    how = method(task, configuration, start | {"b1": 0.9, "tie": 3}, (1,))
    how.prepare(task.problem)(task.start(0), jax.random.key(0), lambda *_: None)
    assert (seen["b1"], seen["levels"]) == (pytest.approx(0.9), 2)
    assert seen["b2"] == pytest.approx(0.999)
    assert how != method(task, configuration, start | {"b1": 0.9}, (1,))


def test_signals_are_piecewise_smooth():
    y = lines.signal(3, 1000)
    jumps = np.sort(np.abs(np.diff(y)))[::-1]
    assert (y == lines.signal(3, 1000)).all()
    assert jumps[0] > 0.1
    assert jumps[lines.PIECES - 1] < 0.01


@pytest.mark.parametrize("build", [lines.aniso, lines.noisy, texture.build, volume.build])
def test_tasks_fit_together(build):
    built = build(False)
    for descent in built if isinstance(built, list) else [built]:
        y = descent.start(0)
        scene = jax.eval_shape(descent.problem.scene)
        gradient = jax.eval_shape(descent.problem.gradient, y, jax.random.key(0), scene)
        alike = lambda one, two: (one.shape, one.dtype) == (two.shape, two.dtype)
        assert jax.tree.all(jax.tree.map(alike, gradient, y))
        errors = jax.eval_shape(descent.score.errors, y, scene)
        assert set(errors) == set(descent.score.levels)
        assert all(error.shape == () for error in errors.values())
        assert set(descent.pictured) <= set(descent.marks)
        names = [each.name for each in descent.configurations]
        assert len(set(names)) == len(names)
    for module in (texture, volume):
        module.scene.cache_clear()  # it was not computed


def mean_and_error(draws):
    draws = np.stack(draws)
    return draws.mean(0), draws.std(0, ddof=1) / np.sqrt(len(draws))


@pytest.mark.slow
def test_gradients_of_the_plate_are_unbiased():
    size = 6
    reference = jnp.full((size, size, 3), 0.3)
    y = jnp.asarray(plate.texture(size))
    directions = np.random.default_rng(0).normal(size=(8, size * size))
    gradient = jax.jit(jax.vmap(lambda key: plate.gradient(y, key, reference, primal=2, samples=1)))
    keys = jax.random.split(jax.random.key(1), 20_000)
    slopes = np.asarray(gradient(keys)).reshape(len(keys), -1) @ directions.T
    mean, error = mean_and_error(slopes)

    def loss(y):  # of the expected picture, since the gradient is that of L(E picture)
        return _monte_carlo.loss(plate.exact(y, 20_000), reference)

    truth = directions @ np.ravel(jax.grad(loss)(y))
    # one picture in `exact` is of texels' middles, so a little remains
    np.testing.assert_allclose(mean, truth, atol=4.5 * error.max() + 0.01 * np.abs(truth).max())


def test_the_derivative_of_the_plate_is_that_of_its_picture():
    y = jnp.full((2, 2), 0.5)
    step = 0.02
    image = lambda y: jnp.sum(plate.exact(y, 5_000))
    difference = (image(y + step) - image(y - step)) / (2 * step)
    assert jnp.sum(jax.grad(image)(y)) == pytest.approx(float(difference), rel=0.02)


def test_one_moment_with_a_filter_that_does_nothing_is_adam():
    same: Any = lambda signal, guide: signal
    for name in ("m", "v"):
        mine: Any = texture.one_moment(name, lambda: same, 0.1, 0.2, 0.36)
        adam: Any = sd.filtered_adam(0.1, 0.2, 0.36)
        y = jnp.array([1.0, -2.0])
        state, theirs = mine.init(y), adam.init(y)
        for _ in range(3):
            got, state = mine.update(y**3, state, y)
            want, theirs = adam.update(y**3, theirs, y)
            np.testing.assert_allclose(got, want, rtol=1e-5)
            y = y + got


def small_smoke():
    key = jax.random.key(4)
    return smoke.Volume(
        0.3 * jax.random.uniform(key, (4, 4, 4, 1)),
        jax.random.uniform(jax.random.fold_in(key, 1), (4, 4, 4, 3)),
    )


def test_nothing_is_seen_as_the_background_and_much_of_it_as_its_colour():
    camera = smoke.cameras(3)
    clear = smoke.Volume(jnp.zeros((4, 4, 4, 1)), jnp.full((4, 4, 4, 3), 0.5))
    view = {"pixels": 8, "steps": 16, "samples": 1}
    seen = smoke.render(clear, camera, jax.random.key(0), **view)
    np.testing.assert_allclose(seen, smoke.BACKGROUND, rtol=1e-6)
    dense = clear._replace(density=jnp.full((4, 4, 4, 1), 10.0))
    middle = smoke.render(dense, camera, jax.random.key(0), **view)[:, 3:5, 3:5]
    np.testing.assert_allclose(middle, 0.5, rtol=1e-5)


@pytest.mark.slow
def test_gradients_of_the_smoke_have_one_mean_however_noisy():
    volume, camera = small_smoke(), smoke.cameras(2)
    reference = jnp.full((2, 4, 4, 3), 0.2)
    directions = np.random.default_rng(0).normal(size=(6, 4**3 * 4))

    def slopes(clean, number):
        def slope(key):
            found = smoke.gradient(volume, camera, reference, key, steps=6, clean=clean)
            return jnp.concatenate([jnp.ravel(leaf) for leaf in found])

        keys = jax.random.split(jax.random.key(int(clean)), number)
        return mean_and_error(np.asarray(jax.jit(jax.vmap(slope))(keys)) @ directions.T)

    noisy_mean, noisy_error = slopes(False, 20_000)
    clean_mean, clean_error = slopes(True, 5_000)
    spread = np.hypot(noisy_error, clean_error)
    assert (np.abs(noisy_mean - clean_mean) < 4.5 * spread).all()
    assert (noisy_error * 2 > clean_error).all()  # a fourth of the draws, and still less noise
