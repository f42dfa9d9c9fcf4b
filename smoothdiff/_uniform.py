"""Uniform random numbers by row: independent, or Sobol's sequence with Owen's scrambling."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, UInt32

from smoothdiff._directions import MAX_DIMENSION, direction_numbers


def uniform_bits(
    key: Key[Array, ""], rows: Int[Array, " m"], dims: int, size: int | None
) -> UInt32[Array, "m dims"]:
    """Uniform 32-bit numbers, each row from the key and its index alone; rows are consecutive.

    With a `size` they are quasi-random: rows come in sets of that many, each a Sobol sequence
    scrambled on its own. Dimensions beyond `MAX_DIMENSION` stay independent.
    """
    even = 0 if size is None else min(dims, MAX_DIMENSION)
    parts = []
    if size is not None:
        seeds = jax.vmap(
            lambda set_: jax.random.bits(jax.random.fold_in(key, set_), (2, even), jnp.uint32)
        )
        index = (rows % size).astype(jnp.uint32)
        # as many sets as so many consecutive rows can touch
        sets = rows[0] // size + jnp.arange((rows.size + size - 2) // size + 1)
        own_seeds = seeds(sets)[rows // size - sets[0]]
        parts.append(_scramble(_sobol(index, even, size), own_seeds))
    if dims > even:
        # another branch of the key than the seeds'
        own = key if size is None else jax.random.fold_in(key, np.uint32(2**32 - 1))
        parts.append(_independent(own, rows, dims - even))
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)


def _independent(key: Array, rows: Array, dims: int) -> Array:
    bits = lambda row: jax.random.bits(jax.random.fold_in(key, row), (dims,), jnp.uint32)
    return jax.vmap(bits)(rows)


def midpoints(bits: UInt32[Array, "..."], dtype) -> Array:
    """Uniform numbers at the midpoints of cells, so that no inverse CDF of them is infinite."""
    width = 23 if jnp.finfo(dtype).bits == 32 else 32
    cell = (bits >> np.uint32(32 - width)).astype(dtype)
    return (cell + 0.5) * 2.0**-width


def _sobol(index: UInt32[Array, " m"], n: int, size: int) -> UInt32[Array, "m n"]:
    """Points `index` of the Sobol sequence as 32-bit fractions."""
    bits = max(1, (size - 1).bit_length())
    point = jnp.zeros((index.size, n), jnp.uint32)
    for k, direction in enumerate(direction_numbers(n, bits)):
        bit = (index >> np.uint32(k)) & np.uint32(1)
        point ^= bit[:, None] * direction[None]
    return point


def _scramble(x: UInt32[Array, "m n"], seeds: UInt32[Array, "m 2 n"]) -> UInt32[Array, "m n"]:
    """Owen's nested uniform scrambling: a hash in which each bit depends on higher bits only.

    The first seed makes each point exactly uniform, the second makes the bits of two points
    independent beyond the first in which they differ.

    Source: B. Burley, Practical hash-based Owen scrambling (JCGT 2020), with the better hash of
    N. Vegdahl, Building a better LK hash (2021).
    """
    x = _reverse_bits(x) + seeds[:, 0]
    x ^= x * np.uint32(0x3D20ADEA)
    x += seeds[:, 1]
    x *= (seeds[:, 1] >> np.uint32(16)) | np.uint32(1)
    x ^= x * np.uint32(0x05526C56)
    x ^= x * np.uint32(0x53A22864)
    return _reverse_bits(x)


def _reverse_bits(x: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        mask = np.uint32(mask)
        x = ((x >> np.uint32(shift)) & mask) | ((x & mask) << np.uint32(shift))
    return (x >> np.uint32(16)) | (x << np.uint32(16))
