"""Descents: the loop, what is tuned and kept, and that the scenes' gradients are unbiased."""

import json
from argparse import Namespace
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from benchmarks import descents
from benchmarks.descents import Configuration, Descent, _loop, _runs, keep_within, variants
from benchmarks.descents._denoising import denoising
from benchmarks.scenes import piecewise, plate, smoke
from benchmarks.tasks import aniso, noisy, texture, volume

sgd: Any = optax.sgd
OPTIONS = Namespace(full=False, seeds=None, fresh=False)
COMMAND = "python -m benchmarks run bowl"


def bowl(curvature=1.0):
    """A quadratic whose best rate is 1, but for a little noise."""

    def gradient(y, key, scene):
        return {"a": curvature * (y["a"] - scene) + 1e-3 * jax.random.normal(key, (4,))}

    return Descent(
        name="bowl",
        title="A bowl",
        scene=lambda seed: seed + jnp.arange(4.0),
        start=lambda seed, scene: {"a": scene + 1},
        gradient=gradient,
        errors=lambda y, scene: {
            "an unused error": jnp.zeros(()),
            "error": jnp.linalg.norm(y["a"] - scene),
        },
        score="error",
        configurations=(
            Configuration("descent", "Gradient descent", {"": sgd}),
            Configuration(
                "both",
                "Two variants",
                {"slow": lambda rate: sgd(0.1 * rate), "fast": sgd},
                tuned_at=2,
            ),
        ),
        rates=(0.1, 1.0, 3.0),
        marks=(2, 5),
        levels=(0.1, 1e-9),
        seeds=2,
        pictures=lambda y, scene: {"line": y["a"], "grey": jnp.outer(y["a"], y["a"])},
        target=lambda scene: {"line": scene},
        pictured=(2, 5),
    )


def test_results_say_what_was_tuned_reached_and_drawn(tmp_path, capsys):
    descents.run(bowl(), OPTIONS, tmp_path, COMMAND)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["command"] == COMMAND
    both = results["configurations"]["both"]
    assert (both["variant"], both["rate"], both["at_edge"]) == ("fast", 1.0, False)
    assert set(both["tried"]) == {"slow", "fast"}
    assert both["to_levels"]["0.1"]["median"] == 1  # the first step of rate 1 gets there
    assert both["to_levels"]["1e-09"]["median"] is None
    assert both["at_marks"]["error"]["2"]["upper"] < 0.01
    assert len(both["seconds"]) == results["configurations"]["descent"]["runs"] == 2
    for name in ("error-vs-iterations", "error-vs-time", "pictures-2", "pictures-5"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000
    assert "Two variants" in capsys.readouterr().out


def test_runs_are_kept_and_redone_when_the_program_changes(tmp_path, monkeypatch):
    ran = []
    run = _loop.Loop.__call__
    monkeypatch.setattr(
        _loop.Loop, "__call__", lambda self, *args: ran.append(args) or run(self, *args)
    )

    def runs(descent, fresh=False):
        ran.clear()
        _runs.run_all(descent, descent.seeds, tmp_path, fresh=fresh, progress=False)
        return len(ran)

    one = replace(bowl(), configurations=bowl().configurations[:1])
    everything = 3 * one.tuning_seeds + one.seeds
    assert runs(one) == everything
    assert {args[1] for args in ran} == {0, 1, 1000, 1001}  # tuned on other starts than scored
    assert runs(one) == 0
    assert runs(replace(one, seeds=3)) == 1
    assert runs(replace(one, gradient=bowl(2.0).gradient)) == everything
    assert runs(one, fresh=True) == everything
    # a configuration that does the same under another name shares the runs
    again = one.configurations[0]._replace(name="again")
    assert runs(replace(one, configurations=(again,))) == 0
    assert not list(tmp_path.glob("*.tmp"))


def test_a_run_is_the_loop_that_optax_documents():
    descent = bowl()
    scene = descent.scene(7)
    momentum: Any = partial(optax.sgd, momentum=0.5)
    run = _loop.Loop(descent, momentum)(0.1, 7, scene, 5, keep=(5,))
    y: Any = descent.start(7, scene)
    transform = momentum(0.1)
    state = transform.init(y)
    for i in range(5):
        gradient = descent.gradient(y, jax.random.fold_in(jax.random.key(7), i), scene)
        updates, state = transform.update(gradient, state, y)
        y = optax.apply_updates(y, updates)
    np.testing.assert_allclose(run.kept[5]["a"], y["a"], rtol=1e-5)
    assert run.iterations[-1] == 5
    assert run.errors["error"][-1] == pytest.approx(np.linalg.norm(y["a"] - scene), rel=1e-5)
    assert (np.diff(run.seconds) > 0).all()


def test_what_diverges_is_never_chosen(tmp_path):
    wild = Configuration("wild", "Wild", {"": lambda rate: sgd(1e30 * (rate - 1.0) + 1.0)})
    descent = replace(bowl(), configurations=(wild,), pictures=None, rates=(0.1, 1.0, 3.0))
    descents.run(descent, OPTIONS, tmp_path, COMMAND)
    results = json.loads((tmp_path / "results.json").read_text())  # strict: no NaN
    assert results["configurations"]["wild"]["rate"] == 1.0
    assert results["configurations"]["wild"]["tried"][""]["3"] is None


def test_keep_within_stops_at_the_bounds():
    y = jnp.array([0.1, 0.5, 0.9])
    clip: Any = keep_within(0.0, 1.0)
    updates, _ = clip.update(jnp.array([-1.0, 0.1, 1.0]), clip.init(y), y)
    np.testing.assert_allclose(y + updates, [0.0, 0.6, 1.0], rtol=1e-6)
    with pytest.raises(ValueError, match="update"):
        clip.update(updates, clip.init(y))


def test_variants_tie_the_rates_of_decay():
    seen = []

    def build(rate, b1, b2, filter):
        seen.append((b1, b2, filter))
        return optax.sgd(rate)

    found = variants((0.2, 0.5), {"a": None, "b": None}, build)
    for optimiser in found.values():
        optimiser(0.1)
    assert list(found) == ["b1=0.2 a", "b1=0.2 b", "b1=0.5 a", "b1=0.5 b"]
    np.testing.assert_allclose([b2 for _, b2, _ in seen], [0.36, 0.36, 0.75, 0.75])


def test_denoising_chooses_on_another_draw(tmp_path):
    exact = jnp.ones((8, 8))
    found = denoising(
        lambda key: exact + jax.random.normal(key, (8, 8)),
        exact,
        exact,
        {"Mean": {"none": lambda x, y: x, "all": lambda x, y: jnp.full_like(x, jnp.mean(x))}},
        tmp_path / "drawn.png",
    )
    assert found["Mean"]["variant"] == "all"
    assert found["Mean"]["error"] < 0.5 < found["Noisy gradient"]["error"]
    assert found["Mean"]["wrong_signs"] == 0 < found["Noisy gradient"]["wrong_signs"]
    assert (tmp_path / "drawn.png").exists()


def test_signals_are_piecewise_smooth():
    y = piecewise.signal(3, 1000)
    jumps = np.sort(np.abs(np.diff(y)))[::-1]
    assert (y == piecewise.signal(3, 1000)).all()
    assert jumps[0] > 0.1
    assert jumps[piecewise.PIECES - 1] < 0.01


def _uncached(task):
    scene = getattr(task, "scene", None)
    return getattr(scene, "__wrapped__", scene)


@pytest.mark.parametrize("task", [aniso, noisy, texture, volume])
def test_tasks_fit_together(task, monkeypatch):
    # without the cache, which would keep what is traced here
    monkeypatch.setattr(task, "scene", _uncached(task), raising=False)
    built = task.build(False)
    for descent in [built] if isinstance(built, Descent) else built:
        scene = jax.eval_shape(lambda descent=descent: descent.scene(0))
        y = jax.eval_shape(lambda scene, descent=descent: descent.start(0, scene), scene)
        key = jax.eval_shape(lambda: jax.random.key(0))
        gradient = jax.eval_shape(descent.gradient, y, key, scene)
        assert jax.tree.structure(gradient) == jax.tree.structure(y)
        pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(y), strict=True)
        assert all((one.shape, one.dtype) == (two.shape, two.dtype) for one, two in pairs)
        errors = jax.eval_shape(descent.errors, y, scene)
        assert descent.score in errors
        assert all(error.shape == () for error in errors.values())
        assert set(descent.pictured) <= set(descent.marks)
        names = [each.name for each in descent.configurations]
        assert len(set(names)) == len(names)


def mean_and_error(draws):
    draws = np.stack(draws)
    return draws.mean(0), draws.std(0, ddof=1) / np.sqrt(len(draws))


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
        return plate.loss(plate.exact(y, 20_000), reference)

    truth = directions @ np.ravel(jax.grad(loss)(y))
    # one picture in `exact` is of texels' middles, so a little remains
    np.testing.assert_allclose(mean, truth, atol=4.5 * error.max() + 0.01 * np.abs(truth).max())


def test_the_derivative_of_the_plate_is_that_of_its_picture():
    y = jnp.full((2, 2), 0.5)
    step = 0.02
    image = lambda y: jnp.sum(plate.exact(y, 50_000))
    difference = (image(y + step) - image(y - step)) / (2 * step)
    assert jnp.sum(jax.grad(image)(y)) == pytest.approx(float(difference), rel=0.02)


def test_one_moment_with_a_filter_that_does_nothing_is_adam():
    same = lambda signal, guide: signal
    for name in ("m", "v"):
        mine: Any = texture.one_moment(name, 0.1, 0.2, 0.36, same)
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
