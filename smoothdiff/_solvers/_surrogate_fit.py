"""The fit of a surrogate to batches of values: what it learns from them, and in which units."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PyTree

from smoothdiff._solvers._base import promotion
from smoothdiff._solvers._replay import Replay

# the share of the newest batch in the running level and spread of the values
_NEWEST = 0.1


class Settings(NamedTuple):
    """How a surrogate is fitted; the names are those of `ZeroGrads`."""

    surrogate_steps: int
    replay: int
    up_to_constant: bool

    @staticmethod
    def default(size: int, **given: int | None) -> "Settings":
        """What is given, and else what is best for so many parameters."""
        default = _OF_FEW if size <= _FEW else _OF_MANY
        return default._replace(**{name: g for name, g in given.items() if g is not None})


# with few parameters, earlier batches are still near, and a fit to many points shows more than a
# slope; with many, they are not, and a closer fit to the newest ones is one to their noise
_FEW = 50
_OF_FEW = Settings(surrogate_steps=10, replay=100, up_to_constant=False)
_OF_MANY = Settings(surrogate_steps=3, replay=0, up_to_constant=True)


class Fit(eqx.Module):
    """A surrogate at work: its weights, and the units in which it sees points and values.

    `level` and `spread` are running means: of the values, and of their mean deviation in a batch.
    """

    weights: PyTree
    opt_state: PyTree
    replay: Replay
    origin: Float[Array, " n"]
    unit: Float[Array, " n"]
    level: Float[Array, ""]
    spread: Float[Array, ""]
    first_spread: Float[Array, ""]

    @staticmethod
    def start(
        weights: PyTree, opt_state: PyTree, replay: Replay, origin: Array, unit: Array, dtype
    ) -> "Fit":
        """Nothing learnt yet."""
        zero = jnp.zeros((), dtype)
        return Fit(weights, opt_state, replay, origin, unit, zero, zero, zero)

    def height(self, surrogate: Callable[[Array], Array], x: Float[Array, " n"]) -> Array:
        """The surrogate at a point, in units of the first batch's spread.

        They stay the same while the values get smaller, so that steps do get smaller too.
        """
        slope = self.spread / _positive(self.first_spread)
        return slope * surrogate((x - self.origin) / self.unit).astype(slope.dtype)

    def value(self, surrogate: Callable[[Array], Array], x: Float[Array, " n"]) -> Array:
        """The surrogate at a point, in units of the values."""
        unit = surrogate((x - self.origin) / self.unit).astype(self.spread.dtype)
        return self.level + self.spread * unit

    def updated(
        self,
        rest: PyTree,
        rho: Float[Array, "N n"],
        values: Float[Array, " N"],
        share: Float[Array, " N"],
        step: Int[Array, ""],
        *,
        log_density: Callable[[Array], Array],
        settings: Settings,
        optimizer: optax.GradientTransformation,
    ) -> "Fit":
        """The fit after some updates on the newest batch and on those that are replayed.

        `rest` is what of the surrogate is no weight; `log_density(rho)` is that of the samples.
        """
        weighted = share.astype(values.dtype)
        mean = jnp.sum(weighted * values)
        newest = jnp.maximum(_NEWEST, 1 / (step + 1).astype(values.dtype))
        level = self.level + newest * (mean - self.level)
        deviation = jnp.sum(weighted * jnp.abs(values - mean))
        spread = self.spread + newest * (deviation - self.spread)
        first_spread = jnp.where(self.first_spread > 0, self.first_spread, spread)
        # the scale of earlier batches, so that it does not depend on the samples that it is used on
        seen_level = jnp.where(step == 0, level, self.level)
        seen_spread = jnp.where(step == 0, spread, self.spread)
        u = (rho - self.origin[None]) / self.unit[None]
        density = lambda u: log_density(self.origin + self.unit * u)
        replay = self.replay.after(step, u, values, share, jax.vmap(density)(u))
        shares = replay.weights(jax.vmap(jax.vmap(density))(replay.u))
        goals = ((replay.values - seen_level) / _positive(seen_spread)).astype(rho.dtype)

        def loss(weights: PyTree) -> Array:
            surrogate = eqx.combine(weights, rest)
            left = lambda u, goal, share: surrogate_loss(
                surrogate, u, goal, share, settings.up_to_constant
            )
            return jnp.sum(jax.vmap(left)(replay.u, goals, shares))

        def update(carry, _):
            weights, opt_state = carry
            with promotion():
                updates, opt_state = optimizer.update(jax.grad(loss)(weights), opt_state, weights)
                return (optax.apply_updates(weights, updates), opt_state), None

        carry = self.weights, self.opt_state
        (weights, opt_state), _ = jax.lax.scan(update, carry, length=settings.surrogate_steps)
        return Fit(weights, opt_state, replay, self.origin, self.unit, level, spread, first_spread)


def surrogate_loss(
    surrogate: Callable[[Array], Array],
    u: Float[Array, "N n"],
    values: Float[Array, " N"],
    share: Float[Array, " N"],
    up_to_constant: bool,
) -> Float[Array, ""]:
    r"""What the fit leaves of a batch, $\sum_i s_i (h(\rho_i) - f(\rho_i - \tau_i))^2$.

    Its expectation is the loss of eq. 2 but for a number that does not depend on h, so its gradient
    in the weights of h is unbiased. Up to a constant, the mean of what is left goes first.
    The shares of a batch sum to one, or to less where there are others.
    """
    left = jax.vmap(surrogate)(u) - values
    if up_to_constant:
        left -= jnp.sum(share * left) / _positive(jnp.sum(share))
    return jnp.sum(share * left**2)


def _positive(spread: Array) -> Array:
    """Where no value differed from another there is nothing to divide by."""
    return jnp.where(spread > 0, spread, 1)
