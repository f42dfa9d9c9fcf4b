"""Fits that leave out, in closed form, what depends on the sample that they are subtracted from."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from smoothdiff._draws import Draws


def left_out_group(draws: Draws) -> int | None:
    """How many rows are left out together; None if the fit must use all of them.

    A balanced set that is a single group is fitted as a whole: without some of its points it is no
    longer balanced, and the fit is worse than the bias that it avoids.
    """
    group = draws.sampler.group(draws.num, draws.n)
    return None if draws.sampler.balanced and group >= draws.num else group


def leave_out(
    errors: Float[Array, "N P"],
    block_of: Callable[[np.ndarray], Array],
    group: int,
) -> Float[Array, "N P"]:
    """The errors of predicting each group of rows from the others, for a linear fit.

    With predictions that are linear in the values, the error of rows b without their own values is
    $B_{bb}^{-1} e_b$ for known e and B: the residuals and $I - H$ for least squares with the hat
    matrix H, and $\\alpha$ and $C$ for a Gaussian process with the inverse C of its matrix.

    Args:
        errors: e, one row for each sample.
        block_of: the blocks $B_{bb}$, (groups, g, g), for indices of shape (groups, g).
        group: rows to leave out together; the last group may be smaller.
    """
    num = len(errors)
    whole = num // group * group
    parts = []
    for start, size in ((0, group), (whole, num - whole)):
        count = (whole if start == 0 else num - whole) // size if size else 0
        if not count:
            continue
        index = start + np.arange(count * size).reshape(count, size)
        rows = errors[start : start + count * size].reshape(count, size, -1)
        blocks = block_of(index)
        solved = rows / blocks if size == 1 else jnp.linalg.solve(blocks, rows)
        parts.append(solved.reshape(count * size, -1))
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def group_share(counts: Float[Array, " N"], group: int) -> Float[Array, " N"]:
    """For each row, the share of all samples that its group has."""
    ids = np.arange(len(counts)) // group
    sums = jax.ops.segment_sum(counts, ids, int(ids[-1]) + 1)
    return (sums / jnp.sum(counts))[ids]
