"""A network predicts the parameters of a smoothed black box whose output meets a loss.

The box renders three pixels, each the indicator of a rectangle, so that the whole composition is
known without sampling. The higher-order paper (appendix E) keeps the curvature of the box and drops
that of the network; AD of the smoothed box drops nothing.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import PLAIN, assert_unbiased, keys
from jax.flatten_util import ravel_pytree
from jax.scipy.stats import norm

import smoothdiff as sd

SIGMA = 0.5
LOW = np.array([[-1.0, -0.5], [0.2, -1.0], [-0.3, 0.1]], np.float32)
HIGH = np.array([[0.4, 0.9], [1.5, 0.3], [0.8, 1.2]], np.float32)
TARGET = np.array([0.2, 0.6, 0.9], np.float32)

NETWORK = eqx.nn.MLP(1, 2, 2, 1, activation=jnp.tanh, key=jax.random.key(7))
ARRAYS, STATIC = eqx.partition(NETWORK, eqx.is_array)
PHI, UNRAVEL = ravel_pytree(ARRAYS)


def network(phi):
    """The two parameters of the box from the ten weights of the network."""
    return eqx.combine(UNRAVEL(phi), STATIC)(jnp.ones(1))


def box(x):
    """Which of the three rectangles contain x: NumPy behind a callback, AD sees nothing of it."""

    def host(x):
        x = np.asarray(x)[..., None, :]
        return np.all((x > LOW) & (x < HIGH), axis=-1).astype(x.dtype)

    out = jax.ShapeDtypeStruct((3,), x.dtype)
    return jax.pure_callback(host, out, x, vmap_method="expand_dims")


def smoothed_box(theta):
    edge = lambda at: norm.cdf((at - theta[None]) / SIGMA)
    return jnp.prod(edge(HIGH) - edge(LOW), axis=1)


def loss(image):
    return jnp.sum((image - TARGET) ** 2)


def loss_inside(theta):
    """E L(f): a pixel is one with the probability that the smoothed box gives."""
    share = smoothed_box(theta)
    return jnp.sum(share * (1 - TARGET) ** 2 + (1 - share) * TARGET**2)


def loss_outside(theta):
    """L(E f)."""
    return loss(smoothed_box(theta))


def estimate(kind, num_samples):
    """The estimate of either objective as a function of (key, phi)."""
    if kind == "inside":
        g = sd.smooth(lambda x: loss(box(x)), SIGMA, **PLAIN, num_samples=num_samples)
        return lambda key, phi: g(key, network(phi))
    g = sd.smooth(box, SIGMA, **PLAIN, num_samples=num_samples)
    return lambda key, phi: loss(g(key, network(phi)))


EXACT = {"inside": loss_inside, "outside": loss_outside}


@pytest.mark.slow
@pytest.mark.parametrize(
    # the loss outside is O(1/N) biased from one batch, so N is large there
    ("kind", "num_samples", "num_keys"),
    [("inside", 512, 384), ("outside", 8192, 64)],
)
def test_gradient_and_hessian_of_the_whole_composition(kind, num_samples, num_keys):
    f = estimate(kind, num_samples)

    def both(key):
        def gradient(phi):
            grad = jax.grad(f, 1)(key, phi)
            return grad, grad

        hessian, grad = jax.jacfwd(gradient, has_aux=True)(PHI)
        return grad, hessian

    found = jax.jit(lambda keys: jax.lax.map(both, keys, batch_size=32))(keys(num_keys))

    @jax.jit
    def run(phi):
        exact = lambda phi: EXACT[kind](network(phi))
        # the approximation of the paper: J^T H J without the curvature of the network
        jacobian = jax.jacfwd(network)(phi)
        dropped = jacobian.T @ jax.hessian(EXACT[kind])(network(phi)) @ jacobian
        return (jax.grad(exact)(phi), jax.hessian(exact)(phi)), dropped

    want, dropped = run(PHI)
    assert_unbiased(found, want, resolution=0.03)
    hessians = np.asarray(found[1])
    mean, spread = hessians.mean(axis=0), hessians.std(axis=0) / np.sqrt(num_keys)
    assert np.max(np.abs(mean - dropped) / spread) > 20


@pytest.mark.slow
def test_the_two_objectives_are_told_apart():
    """E L(f) and L(E f) differ by the variance of the pixels; one batch of N adds 1/N of it."""
    theta = network(PHI)
    share = smoothed_box(theta)
    variance = jnp.sum(share * (1 - share))
    np.testing.assert_allclose(loss_inside(theta), loss_outside(theta) + variance, rtol=1e-5)
    for num_samples in (4, 64):
        options: dict[str, Any] = {**PLAIN, "num_samples": num_samples}
        inside = sd.smooth(lambda x: loss(box(x)), SIGMA, **options)
        outside = sd.smooth(box, SIGMA, **options)
        both = lambda key, a=inside, b=outside: (a(key, theta), loss(b(key, theta)))
        found = jax.jit(jax.vmap(both))(keys(8192))
        biased = loss_outside(theta) + variance / num_samples
        assert_unbiased(found, (loss_inside(theta), biased), resolution=0.02)


def test_a_gauss_newton_step_of_the_smoothed_image(key):
    """The Jacobian of the image through the network, by `jax.linearize`: no further renders."""
    calls = []

    def counted(x):
        def host(x):
            calls.append(x.shape[0])
            return np.all((np.asarray(x)[:, None] > LOW) & (np.asarray(x)[:, None] < HIGH), axis=-1)

        out = jax.ShapeDtypeStruct((3,), jnp.bool)
        return jax.pure_callback(host, out, x, vmap_method="expand_dims").astype(x.dtype)

    image = sd.smooth(counted, SIGMA, **PLAIN, num_samples=4096)

    @jax.jit
    def run():
        value, apply = jax.linearize(lambda phi: image(key, network(phi)), PHI)
        return value, jax.vmap(apply)(jnp.eye(PHI.size)).T

    value, jacobian = run()
    assert calls == [4096]
    exact = lambda phi: smoothed_box(network(phi))
    np.testing.assert_allclose(value, jax.jit(exact)(PHI), atol=0.05)
    np.testing.assert_allclose(jacobian, jax.jit(jax.jacfwd(exact))(PHI), atol=0.1)
