"""The points of one estimate as a pytree: kept in memory, or drawn again chunk by chunk."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._samplers import AbstractSampler
from smoothdiff._sharding import check_parts, shared_out


@eqx.filter_jit  # without a jit of the caller's, compiling op by op takes seconds
def _drawn(sampler: AbstractSampler, key: Array, start, count: int, num: int, n: int, dtype):
    return sampler.draw(key, start, count, num, n, dtype)


def _check_weights(sampler: AbstractSampler, log_ratio: Array | None) -> None:
    """Raises where a sampler gives weights to normal points, or none to others."""
    if sampler.gaussian and log_ratio is not None:
        raise TypeError(
            f"{sampler} says that its points are normal, and `draw` returns weights: write "
            "`gaussian: ClassVar[bool] = False` in the class, or return None for them"
        )
    if not sampler.gaussian and log_ratio is None:
        raise TypeError(
            f"{sampler} says that its points are not normal, and `draw` returns no weights: return "
            "the logarithms of normal density over that of the points"
        )


class Draws(eqx.Module):
    """`num` points in n dimensions. Without a chunk size they are drawn once and kept.

    With one, only the key is kept: every pass over the points draws each chunk again, which costs
    random numbers but no memory and, above all, no evaluation of the user's function.
    """

    key_data: Array
    kept: tuple[Array, Array | None] | None
    sampler: AbstractSampler
    num: int = eqx.field(static=True)
    n: int = eqx.field(static=True)
    chunk: int = eqx.field(static=True)
    impl: str = eqx.field(static=True)
    dtype: jnp.dtype = eqx.field(static=True)
    sharding: NamedSharding | None = eqx.field(static=True)

    def __init__(
        self,
        sampler: AbstractSampler,
        key: Array,
        num: int,
        n: int,
        dtype,
        batch_size: int | None,
        sharding: NamedSharding | None = None,
    ):
        sampler.check(num, n)
        block = sampler.block(num, n)
        self.sampler = sampler
        self.key_data = jax.random.key_data(key)
        self.impl = str(jax.random.key_impl(key))
        if self.impl in ("rbg", "unsafe_rbg"):
            # under vmap the first row's key would draw for all rows, and a chunk has another first
            # row; either half of such a key is a key of threefry
            self.key_data, self.impl = self.key_data[:2], "threefry2x32"
        self.num, self.n, self.dtype = num, n, jnp.dtype(dtype)
        # whole blocks only, and at least one
        chunk = num if batch_size is None else max(block, batch_size // block * block)
        self.chunk = min(num, chunk)
        self.sharding = sharding
        if sharding is not None:
            for part in {self.chunk, num % self.chunk}:
                check_parts(sharding, part, "the number of samples that are drawn together")
        self.kept = self._draw(0, num) if self.chunk == num else None

    def _draw(self, start, count: int):
        key = jax.random.wrap_key_data(self.key_data, impl=self.impl)
        z, log_ratio = _drawn(self.sampler, key, start, count, self.num, self.n, self.dtype)
        _check_weights(self.sampler, log_ratio)
        return shared_out((z, log_ratio), self.sharding)

    def _chunks(self, rows: PyTree) -> tuple[Array, PyTree, PyTree]:
        """Starts of the full chunks, their rows stacked, and the rows of the last, shorter one."""
        full = self.num // self.chunk
        starts = jnp.arange(full) * self.chunk
        cut = full * self.chunk
        stacked = jax.tree.map(lambda a: a[:cut].reshape(full, self.chunk, *a.shape[1:]), rows)
        return starts, stacked, jax.tree.map(lambda a: a[cut:], rows)

    def map(self, fun: Callable[..., PyTree]) -> PyTree:
        """Applies `fun(z, log_ratio)` to the points and returns its rows, in order."""
        if self.kept is not None:
            return fun(*self.kept)
        starts, _, _ = self._chunks(())
        out = jax.lax.map(lambda start: fun(*self._draw(start, self.chunk)), starts)
        out = jax.tree.map(lambda a: a.reshape(math.prod(a.shape[:2]), *a.shape[2:]), out)
        rest = self.num % self.chunk
        if rest:
            last = fun(*self._draw(self.num - rest, rest))
            out = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), out, last)
        return out

    def sum(self, fun: Callable[..., PyTree], rows: PyTree) -> PyTree:
        """Adds up `fun(start, z, log_ratio, rows)` over the chunks; `fun` sums over its own rows.

        Under reverse-mode AD a chunk is drawn again rather than remembered.
        """
        if self.kept is not None:
            return fun(0, *self.kept, rows)
        starts, stacked, rest = self._chunks(rows)

        @jax.checkpoint
        def chunk(start, part):
            return fun(start, *self._draw(start, self.chunk), part)

        def add(total, inputs):
            return jax.tree.map(jnp.add, total, chunk(*inputs)), None

        shape = jax.eval_shape(chunk, starts[0], jax.tree.map(lambda a: a[0], stacked))
        zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
        total, _ = jax.lax.scan(add, zero, (starts, stacked))
        left = self.num % self.chunk
        if left:
            start = self.num - left
            total = jax.tree.map(jnp.add, total, fun(start, *self._draw(start, left), rest))
        return total
