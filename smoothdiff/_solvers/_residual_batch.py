"""Residuals at points around an iterate: where they are taken, what came, what they decide."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._draws import Draws
from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler
from smoothdiff._seen import Seen, kept, lowest
from smoothdiff._solvers._base import Progress, read_options
from smoothdiff._solvers._evaluator import Evaluator, half_squares
from smoothdiff._solvers._judgement import by_rows, judged
from smoothdiff._solvers._random_numbers import in_step


class ResidualBatch(eqx.Module):
    """The first `count` of these rows were evaluated; the `good` ones of them are finite.

    All but the `drawn` ones were made for the model alone, and may be anything: they have no part
    in the estimate of the loss. The squares of some may have `overflowed`, which are no NaN.
    """

    points: Float[Array, "m n"]
    rows: Float[Array, "m P"]
    good: Bool[Array, " m"]
    drawn: Bool[Array, " m"]
    count: Int[Array, ""]
    overflowed: Bool[Array, ""]

    @staticmethod
    def of(
        points: Array, rows: Array, count: Int[Array, ""], drawn: Array | None = None
    ) -> "ResidualBatch":
        """Rows whose squares are not finite become zeros. Usually all are drawn."""
        there = jnp.arange(len(rows)) < count
        squares = jnp.sum(rows**2, axis=1)
        good, overflowed = there & jnp.isfinite(squares), there & jnp.isinf(squares)
        overflowed = jnp.any(overflowed & jnp.all(jnp.isfinite(rows), axis=1))
        drawn = there if drawn is None else there & drawn
        rows = jnp.where(good[:, None], rows, 0)
        return ResidualBatch(points, rows, good, drawn, count, overflowed)

    def enough(self, nonfinite: str) -> Bool[Array, ""]:
        """Whether all that were drawn are good; if some may be dropped, half of all."""
        if nonfinite == "propagate":
            return ~jnp.any(self.drawn & ~self.good)
        return 2 * jnp.sum(self.good) >= self.count

    def here(self) -> Float[Array, " P"]:
        """The residuals at the iterate, the first row; infinite if they are to be dropped."""
        return jnp.where(self.good[0], self.rows[0], jnp.inf)

    def same(self) -> Bool[Array, ""]:
        """Whether there is no difference between the residuals of the good ones."""
        first = self.rows[jnp.argmax(self.good)]
        return jnp.all(jnp.where(self.good[:, None], self.rows == first[None], True))

    def lowest(self) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The point with the smallest sum of squares, and half of that."""
        return lowest(self.points, jnp.where(self.good, half_squares(self.rows), jnp.inf))

    def loss(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The mean of half the sum of squares over the good ones, and its standard error."""
        values, used = half_squares(self.rows), self.good & self.drawn
        # where all that were drawn are dropped, another point has to do
        used = jnp.where(jnp.any(used), used, self.good)
        count = jnp.sum(used).astype(values.dtype)
        mean = jnp.sum(jnp.where(used, values, 0)) / count
        square = jnp.sum(jnp.where(used, (values - mean) ** 2, 0))
        stderr = jnp.sqrt(square / jnp.maximum(count * (count - 1), 1))
        return mean, jnp.where(count > 1, stderr, jnp.nan)


def around(
    params: Params, sampler: AbstractSampler, key: Array, sigma: Float[Array, " n"], count: int
) -> Float[Array, "count n"]:
    """Points around the parameters, within the bounds."""
    draws = Draws(sampler, key, count, params.theta.size, params.theta.dtype, None)
    place = lambda z, _: jax.vmap(params.clip)(params.theta[None] + sigma[None] * z)
    return kept(draws.map(place))


def centred(x: Float[Array, "m k"], valid: Bool[Array, " m"]) -> Float[Array, "m k"]:
    """Seen from the mean of the valid rows; zeros where not valid.

    By way of one of them, so that columns that are the same in all rows become exact zeros.
    """
    x = jnp.where(valid[:, None], x - x[jnp.argmax(valid)][None], 0)
    mean = jnp.sum(x, axis=0) / jnp.maximum(jnp.sum(valid), 1).astype(x.dtype)
    return jnp.where(valid[:, None], x - mean[None], 0)


def check_residuals(f_struct: PyTree) -> None:
    """Raises TypeError unless all residuals are real floating-point numbers."""
    for leaf in jax.tree.leaves(f_struct):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise TypeError(
                f"the residuals have dtype {leaf.dtype}; they must be real floating-point "
                "numbers: use .astype(float)"
            )


def check_terms(f_struct: PyTree, terms: jax.ShapeDtypeStruct) -> None:
    """Raises unless the residuals are one array of real numbers, with the first axes of terms."""
    check_residuals(f_struct)
    leaves = jax.tree.leaves(f_struct)
    if len(leaves) != 1 or leaves[0].shape[: len(terms.shape)] != terms.shape:
        shapes = [leaf.shape for leaf in leaves]
        raise ValueError(
            f"the support maps the parameters to terms of shape {terms.shape}, but the "
            f"residuals have shape {shapes[0] if len(shapes) == 1 else shapes}: return one "
            "array whose first axes are those of the terms"
        )


def judge_rows(
    progress: Progress,
    evaluate: Evaluator,
    options: dict[str, Any],
    nonfinite: str,
    samples: Callable[[PyTree[Array], Array], Float[Array, "m n"]],
    count: int,
    new: Sequence[PyTree[Array]],
    old: Sequence[PyTree[Array]],
) -> tuple[PyTree[Array], dict[str, Array]]:
    """What `judged` gives where the function returns rows.

    `samples` makes so many points around the answer, with a key, for its smoothed loss. That is NaN
    if too few are good.
    """
    key = jax.random.fold_in(read_options(options)[0], progress.step)

    def estimate(y: PyTree[Array]) -> tuple[Array, Array, Seen]:
        points = samples(y, key)
        numbers = in_step(evaluate.args, options, progress.step)
        rows, _ = dataclasses.replace(evaluate, args=numbers)(points)
        batch = ResidualBatch.of(points, rows, jnp.asarray(len(points)))
        fun, stderr = batch.loss()
        point, value = batch.lowest()
        seen = Seen(evaluate.layout.tree(point), value)
        return jnp.where(batch.enough(nonfinite), fun, jnp.nan), stderr, seen

    return judged(progress, by_rows(evaluate, options), estimate, count, new, old)
