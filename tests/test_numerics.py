"""Offsets and scales of the function, and widths from tiny to huge."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import PLAIN, assert_same, boxes

import smoothdiff as sd


def test_a_large_offset_costs_only_its_own_rounding(key):
    x = jnp.array([0.1, 0.2])
    offset = lambda x: boxes(x) + 1e6
    rounding = 2 * np.spacing(np.float32(1e6))
    for transform, power in ((sd.smooth_grad, 1), (sd.smooth_hessian, 2)):
        near = jax.jit(transform(boxes, 0.4, **PLAIN, num_samples=256))(key, x)
        far = jax.jit(transform(offset, 0.4, **PLAIN, num_samples=256))(key, x)
        assert jnp.max(jnp.abs(near - far)) < rounding / 0.4**power
    value = jax.jit(sd.smooth(offset, 0.4, **PLAIN, num_samples=256))(key, x)
    assert abs(float(value) - 1e6) < 4


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_scales_of_the_function(size, key):
    x = jnp.array([0.1, 0.2])

    @jax.jit
    def run(size):
        options: dict[str, Any] = {**PLAIN, "num_samples": 64, "stderr": True}
        return (
            sd.smooth_value_and_grad(lambda x: size * boxes(x), 0.4, **options)(key, x),
            sd.smooth_hvp(lambda x: size * boxes(x), 0.4, **options)(key, x, x),
        )

    assert_same(jax.tree.map(lambda leaf: leaf / size, run(size)), run(1.0))


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1.0, 1e3])
def test_scales_of_sigma(sigma, key):
    """A function in units of sigma has derivatives in units of 1/sigma."""

    def run(s):
        g = sd.smooth_value_and_grad(
            lambda x: boxes(x / s), s, **PLAIN, num_samples=64, stderr=True
        )
        (value, grad), (value_error, grad_error) = jax.jit(g)(key, jnp.zeros(2))
        return value, value_error, s * grad, s * grad_error

    assert_same(run(sigma), run(1.0))


def test_sigmas_that_span_eight_decades(key):
    scale = jnp.array([1e-4, 1e4])

    @jax.jit
    def g(s):
        return sd.smooth_hessian(lambda x: boxes(x / s), s, **PLAIN, num_samples=64)(
            key, jnp.zeros(2)
        )

    assert_same(g(scale) * scale[:, None] * scale[None, :], g(jnp.ones(2)))
