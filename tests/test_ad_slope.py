"""The baseline "ad": unbiased whatever AD says, and far less noisy where AD lacks only edges.

A line of pixels sees a bar before a dark ground, lit by many basis functions: shading, which AD
knows, and two silhouettes, of which it knows nothing. Bar and light are independent, so the
smoothed loss is known in closed form.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import assert_unbiased, keys
from jax.scipy.stats import norm

import smoothdiff as sd

SIGMA = 0.2
PIXELS = np.linspace(-2, 2, 48)
LIGHTS = np.cos(np.arange(24)[None] * (PIXELS[:, None] + 2) * np.pi / 4) / 4
AT = {
    "edges": jnp.array([-0.9, 0.7]),
    "light": jnp.asarray(np.random.default_rng(0).normal(size=24)),
}
TARGET = np.where(np.abs(PIXELS) < 1.1, 1.5, 0.0)
# eight pairs and the slope, against nine pairs
EVALUATIONS = {"ad": 17, "mean": 18, "linear": 18}


def loss(at):
    """Hard edges: AD by the light is exact, by the edges zero."""
    pixels, lights = jnp.asarray(PIXELS, jnp.float32), jnp.asarray(LIGHTS, jnp.float32)
    target = jnp.asarray(TARGET, jnp.float32)
    seen = (pixels > at["edges"][0]) & (pixels < at["edges"][1])
    shown = seen.astype(jnp.float32) * (lights @ at["light"])
    return jnp.mean(jnp.square(shown - target))


def exact(at):
    """The mean of the loss over both normal distributions; edges do not cross within six sigma."""
    inside = norm.cdf((PIXELS - at["edges"][0]) / SIGMA) * norm.cdf(
        (at["edges"][1] - PIXELS) / SIGMA
    )
    spread = SIGMA**2 * np.sum(LIGHTS**2, axis=1)
    there = (LIGHTS @ at["light"] - TARGET) ** 2 + spread
    return jnp.mean(inside * there + (1 - inside) * TARGET**2)


@functools.partial(jax.jit, static_argnums=(0,))
def grads(baseline, many):
    """Estimates of the gradient with many keys."""
    options = {"num_samples": EVALUATIONS[baseline], "sampler": sd.Gaussian(antithetic=True)}
    g = sd.smooth_grad(loss, SIGMA, baseline=baseline, **options)
    return jax.vmap(g, in_axes=(0, None))(many, AT)


def variance(found):
    return sum(float(jnp.sum(jnp.var(leaf, axis=0))) for leaf in jax.tree.leaves(found))


@pytest.mark.slow
def test_it_is_unbiased_and_a_third_as_noisy_as_samples_alone():
    found = grads("ad", keys(2048))
    assert_unbiased(found, jax.grad(exact)(AT), resolution=0.02)
    for alone in ("mean", "linear"):
        assert variance(found) < variance(grads(alone, keys(2048))) / 3
    # AD alone has no noise here and is no derivative of the loss: its edges do not move
    np.testing.assert_array_equal(jax.grad(loss)(AT)["edges"], 0)
    assert np.max(np.abs(jax.grad(exact)(AT)["edges"])) > 0.1


def test_a_wrong_slope_costs_accuracy_and_no_bias():
    @jax.custom_jvp
    def wrong(x):
        return jnp.sum(jnp.where(x > 0, 1.0, 0.0))

    @wrong.defjvp
    def _(primals, tangents):
        return wrong(primals[0]), 3 * jnp.sum(tangents[0])

    x = jnp.array([0.3, -0.1])
    g = sd.smooth_grad(wrong, 1.0, baseline="ad", num_samples=32, sampler=sd.Gaussian())
    found = jax.jit(jax.vmap(g, in_axes=(0, None)))(keys(2048), x)
    assert_unbiased(found, norm.pdf(x), resolution=0.05)


def test_what_is_linear_is_exact_for_value_gradient_and_hessian(key, x64):
    slope = jnp.arange(1.0, 41.0)
    f = lambda x: slope @ x + 1e6
    options = {"baseline": "ad", "num_samples": 4}

    @jax.jit
    def run(x):
        smoothed = lambda x, sigma: sd.smooth(f, sigma, **options)(key, x)
        grad = sd.smooth_grad(f, 0.3, **options)(key, x)
        hvp = sd.smooth_hvp(f, 0.3, **options)(key, x, x)
        return smoothed(x, 0.3), grad, hvp, jax.grad(smoothed, (0, 1))(x, 0.3)

    x = jnp.ones(40)
    value, grad, hvp, by_ad = run(x)
    np.testing.assert_allclose(value, f(x), rtol=1e-15)
    np.testing.assert_allclose(grad, slope, rtol=1e-8)
    np.testing.assert_allclose(hvp, 0, atol=1e-5)
    # by AD of the smoothed function too, in sigma as well
    np.testing.assert_allclose(by_ad[0], slope, rtol=1e-8)
    np.testing.assert_allclose(by_ad[1], 0, atol=1e-5)


@pytest.mark.slow
def test_evaluations_are_counted_and_errors_cover(key):
    seen = []

    def watched(at):
        jax.debug.callback(lambda x: seen.append(x), at["edges"][0])
        return loss(at)

    g = sd.smooth_grad(watched, SIGMA, baseline="ad", stderr=True, num_samples=17)
    estimate, error = jax.block_until_ready(g(key, AT))
    jax.effects_barrier()
    assert len(seen) == 17
    off = jax.tree.map(lambda a, b: np.abs(a - b), estimate, jax.grad(exact)(AT))
    assert np.all(off["light"] < 6 * error["light"])


def test_images_are_refused(key):
    g = sd.smooth_jacobian(lambda x: jnp.sin(x), 0.1, baseline="ad", num_samples=8)
    with pytest.raises(ValueError, match="one number"):
        g(key, jnp.ones(3))
    with pytest.raises(ValueError, match="Gaussian smoothing only"):
        sd.smooth_grad(jnp.sum, 0.1, baseline="ad", num_samples=8, noise=Triangle())(
            key, jnp.ones(3)
        )


class Triangle:
    """A noise that is not Gaussian."""

    def sample(self, key, shape, dtype):
        return jax.random.triangular(key, -1, 0, 1, shape).astype(dtype)

    def log_prob(self, z):
        return jnp.sum(jnp.log(jnp.maximum(1 - jnp.abs(z), 1e-6)), axis=-1)
