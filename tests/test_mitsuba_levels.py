"""Levels of a Mitsuba scene: what each renders, what it costs, and what is found by way of them."""

import jax
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff.renderers import mitsuba
from tests.closed_forms import as_users_have_it
from tests.test_mitsuba import scene

PATH = {"type": "path", "max_depth": 8}


def photo(resolution, spp=16, seed=0, **changes):
    mi.set_variant("scalar_rgb")
    options = {"resolution": resolution, "spp": spp, "seed": seed}
    render = mitsuba.renderer(scene(**changes), "ball.translate", **options)
    return np.asarray(render(jnp.array([-0.5, 0.2, 0.3])))


def test_the_finest_level_is_the_picture_minus_the_photograph():
    seen = photo((16, 32))
    *_, finest = mitsuba.levels(scene(), "ball.translate", seen, spp=4)
    render = mitsuba.renderer(scene(), "ball.translate", resolution=(16, 32), spp=4)
    y = jnp.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(finest.fun(y, None), render(y) - seen, atol=1e-6)


def test_coarse_levels_have_fewer_pixels_and_samples():
    seen = np.zeros((64, 128, 3), np.float32)
    levels = mitsuba.levels(scene(), "ball.translate", seen, spp=64)
    y = jnp.zeros(3)
    shapes = [jax.eval_shape(level.fun, y, None).shape for level in levels]
    assert shapes == [(8, 16, 3), (16, 32, 3), (32, 64, 3), (64, 128, 3)]
    costs = [8 * 16 * 16, 16 * 32 * 16, 32 * 64 * 16, 64 * 128 * 64]
    assert [level.cost for level in levels] == costs


def test_levels_of_few_samples_keep_them_down_to_a_thousand():
    seen = np.zeros((64, 128, 3), np.float32)
    levels = mitsuba.levels(scene(), "ball.translate", seen, spp=4)
    costs = [8 * 16 * 9, 16 * 32 * 4, 32 * 64 * 4, 64 * 128 * 4]
    assert [level.cost for level in levels] == costs


def test_light_bounces_as_often_on_all_levels():
    # within a white ball that shines, each bounce adds nine tenths of the one before
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.9}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    ball = {"type": "sphere", "radius": 5.0, "flip_normals": True, "bsdf": white, "lamp": lamp}
    inside = {"type": "scene", "integrator": PATH, "ball": ball, "camera": {"type": "perspective"}}
    levels = mitsuba.levels(inside, "ball.translate", np.zeros((32, 32, 3), np.float32), spp=16)
    lit = [float(jnp.mean(level.fun(jnp.zeros(3), None))) for level in levels]
    light = sum(0.9**bounce for bounce in range(PATH["max_depth"]))
    np.testing.assert_allclose(lit, [4 * light, 2 * light, light], rtol=0.01)


def test_residuals_of_all_levels_are_about_as_large():
    seen = photo(64)
    levels = mitsuba.levels(scene(), "ball.translate", seen, spp=16)
    sums = [float(jnp.sum(level.fun(jnp.zeros(3), None) ** 2)) for level in levels]
    # what is seen in the finest one alone is left out
    assert all(0.4 * sums[-1] < coarse <= 1.05 * sums[-1] for coarse in sums)


def test_inputs_are_a_function_of_y():
    seen, y = photo(8), jnp.array([0.1, 0.3])
    name = "ball.translate"
    aside = lambda y: {name: jnp.array([y[0], 0.0, y[1]])}
    (level,) = mitsuba.levels(scene(), [name], seen, spp=4, inputs=aside)
    (plain,) = mitsuba.levels(scene(), name, seen, spp=4)
    np.testing.assert_array_equal(level.fun(y, None), plain.fun(aside(y)[name], None))


@pytest.mark.slow
def test_a_place_is_found_for_less_than_the_finest_level_alone():
    """To 1.5 times the squares that the noise of a photograph of its own leaves at the truth."""
    truth = jnp.array([-0.5, 0.2, 0.3])
    levels = mitsuba.levels(scene(), "ball.translate", photo(64, seed=1), spp=16)
    finest = levels[-1].fun
    target = 0.75 * float(jnp.sum(finest(truth, None) ** 2))
    start, costs, alone = jnp.array([0.3, -0.2, 0.0]), [], []
    for seed in range(3):
        options = {"key": jax.random.key(seed), "bounds": (-1.0, 1.0), "target": target}
        found = sd.coarse_to_fine(sd.least_squares, levels, start, **options)
        np.testing.assert_allclose(found.y, truth, atol=0.1)
        costs.append(found.cost)
        alone.append(sd.least_squares(finest, start, **options).evaluations)
    assert np.median(costs) < 0.75 * np.median(alone)


@pytest.mark.parametrize("shape", [(8, 8), (8, 8, 1)])
def test_a_photograph_has_three_colours(shape):
    levels = as_users_have_it(mitsuba.levels)
    with pytest.raises(ValueError, match="height, width, 3"):
        levels(scene(), "ball.translate", np.zeros(shape), spp=4)


@pytest.mark.parametrize(
    ("shown", "options", "match"),
    [
        (np.full((8, 8, 3), 255, np.uint8), {"spp": 4}, "linear RGB"),
        (np.full((8, 8, 3), np.nan), {"spp": 4}, "finite"),
        (np.ones((8, 8, 3)), {"spp": -5}, "spp must be at least 1"),
        (np.ones((8, 8, 3)), {"spp": 4, "sensor": [0, 0]}, "of one sensor"),
    ],
)
def test_what_is_no_photograph_is_refused(shown, options, match):
    levels = as_users_have_it(mitsuba.levels)
    with pytest.raises(ValueError, match=match):
        levels(scene(), "ball.translate", shown, **options)


def test_the_finest_level_has_the_samples_that_were_asked_for():
    levels = mitsuba.levels(scene(), "ball.translate", np.ones((32, 32, 3), np.float32), spp=20)
    assert levels[-1].cost == 32 * 32 * 20


@pytest.mark.parametrize("spp", [1, 3, 4])
def test_costs_of_small_pictures_rise(spp):
    levels = mitsuba.levels(scene(), "ball.translate", np.ones((16, 16, 3), np.float32), spp=spp)
    costs = [level.cost for level in levels]
    assert costs == sorted(costs)
    assert costs[-1] == 256 * spp
