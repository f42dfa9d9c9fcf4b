"""When a function last fell by much: where that is long ago, little is left to find nearby."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# much is more than this share of the value, or of how far other values are above it
_MUCH = 0.01
# long ago is so many evaluations for each parameter, and one, and no fewer than so many steps
_LONG = 4


class Fall(eqx.Module):
    """The value `to` which the function last fell by much, and the evaluations `since`.

    It counts those that models ask for: steps and rounds of samples.
    """

    to: Float[Array, ""]
    since: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, ""]) -> "Fall":
        """Nothing is known of the function."""
        return Fall(jnp.full_like(like, jnp.inf), jnp.zeros((), jnp.int32))

    def after(self, fun: Float[Array, ""], usual: Float[Array, ""], count: int) -> "Fall":
        """With so many evaluations, after which the lowest value and a usual one are these."""
        # beside a height of no meaning every fall is little, but not beside the value
        whole = jnp.minimum(usual - fun, jnp.abs(fun))
        much = self.to - fun > _MUCH * whole
        since = jnp.where(much, 0, self.since + count)
        return Fall(jnp.where(much, fun, self.to), since.astype(self.since.dtype))

    def long_ago(self, n: int, count: int) -> Bool[Array, ""]:
        """Whether that is long ago, with n parameters and so many evaluations at once."""
        return self.since >= _LONG * max(n + 1, count)
