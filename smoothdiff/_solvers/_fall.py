"""When a function last fell: where that is long ago, little is left to do, or to find nearby."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# much is more than this share of the value, or of how far other values are above it
_MUCH = 0.01
# long ago is so many evaluations for each parameter, and one, and no fewer than so many steps
_LONG = 4


class Fall(eqx.Module):
    """The value `to` which the function last fell by enough, and the evaluations `since`."""

    to: Float[Array, ""]
    since: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, ""]) -> "Fall":
        """Nothing is known of the function."""
        return Fall(jnp.full_like(like, jnp.inf), jnp.zeros((), jnp.int32))

    def after(self, fun: Float[Array, ""], enough: Float[Array, ""], count: int) -> "Fall":
        """With so many evaluations more.

        Args:
            fun: the lowest value now, infinite where there is none.
            enough: by more than that a fall counts, also little by little.
            count: the evaluations.
        """
        fell = self.to - fun > enough
        since = jnp.where(fell, 0, self.since + count)
        return Fall(jnp.where(fell, fun, self.to), since.astype(self.since.dtype))

    def long_ago(self, n: int, count: int) -> Bool[Array, ""]:
        """Whether that is long ago, with n parameters and so many evaluations at once."""
        return self.since >= _LONG * max(n + 1, count)


def much(fun: Float[Array, ""], usual: Float[Array, ""]) -> Float[Array, ""]:
    """A fall to this value is much if it is more, where a usual value is that."""
    # beside a height of no meaning every fall is little, but not beside the value
    return _MUCH * jnp.minimum(usual - fun, jnp.abs(fun))
