r"""Surrogates for `ZeroGrads`: cheap differentiable functions that stand in for a black box.

A surrogate is an `eqx.Module` that takes the parameters as one vector, in units of sigma and from
the start of the run, and returns a number. `ZeroGrads` makes it by `surrogate(size, key=key)`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from smoothdiff._products import dot
from smoothdiff._select import Selection, select

__all__ = ["MLP", "Quadratic", "Selection", "select"]


class MLP(eqx.Module):
    r"""A fully connected network, optionally behind a positional encoding.

    $$ h(u) = \text{net}(\gamma(u)), \qquad
       \gamma(u) = (u, \sin 2^k u, \cos 2^k u)_{k = 0, \ldots, L - 1} $$

    Args:
        size: the number of parameters.
        width: neurons in a hidden layer.
        depth: hidden layers. Below 50 parameters the paper has three of 64 neurons, of which two
            learn as much; from there on eight of 128, which took longer to learn anything.
        activation: the paper has leaky ReLU. A smooth one leaves less of the error where there are
            few parameters, and it has a second derivative.
        frequencies: L, the octaves of a positional encoding. The paper has one from 50 parameters
            on, and does not say how many octaves.
        key: draws the weights, uniform within the root of one over a layer's inputs to both sides
            of zero.

    Example:
        >>> import functools, jax, jax.numpy as jnp
        >>> from smoothdiff.surrogates import MLP
        >>> small = functools.partial(MLP, width=32, activation=jax.nn.tanh)  # for ZeroGrads
        >>> small(10, key=jax.random.key(0))(jnp.zeros(10)).shape
        ()

    Source: ZeroGrads: Learning Local Surrogates for Non-Differentiable Graphics (Fischer and
    Ritschel), supplement, section 1.
    """

    layers: eqx.nn.MLP
    frequencies: int = eqx.field(static=True)

    def __init__(
        self,
        size: int,
        *,
        width: int = 64,
        depth: int = 2,
        activation: Callable[[Array], Array] = jax.nn.gelu,
        frequencies: int = 0,
        key: Key[Array, ""],
    ):
        inputs = size * (1 + 2 * frequencies)
        self.layers = eqx.nn.MLP(inputs, "scalar", width, depth, activation, key=key)
        self.frequencies = frequencies

    def __call__(self, u: Float[Array, " n"]) -> Float[Array, ""]:
        """The surrogate at one point."""
        octaves = jnp.asarray(2.0 ** np.arange(self.frequencies), u.dtype)
        waves = (octaves[:, None] * u[None]).reshape(-1)
        return self.layers(jnp.concatenate([u, jnp.sin(waves), jnp.cos(waves)]))


class Quadratic(eqx.Module):
    r"""A quadratic potential, which has $n^2$ weights (the ablation NoNN).

    $$ h(u) = (u, 1)^T M (u, 1) $$

    Args:
        size: the number of parameters, n.
        key: not used: M starts as the identity.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from smoothdiff.surrogates import Quadratic
        >>> print(Quadratic(2, key=jax.random.key(0))(jnp.array([1.0, 2.0])))
        6.0

    Source: ZeroGrads (Fischer and Ritschel), section 4.1.
    """

    matrix: Float[Array, "m m"]

    def __init__(self, size: int, *, key: Key[Array, ""]):
        del key
        self.matrix = jnp.eye(size + 1)

    def __call__(self, u: Float[Array, " n"]) -> Float[Array, ""]:
        """The surrogate at one point."""
        # only the symmetric part of the matrix has an effect, so nothing needs to keep it symmetric
        v = jnp.append(u, 1)
        return dot(v, dot(self.matrix, v))
