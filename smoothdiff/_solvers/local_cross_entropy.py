"""A cross-entropy search for each parameter, where each moves only some of the residuals."""

import math
from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._params import Params, is_concrete, take_apart
from smoothdiff._samplers import Gaussian
from smoothdiff._seen import Seen, kept
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    check_settings,
    is_small,
    read_options,
    stopped,
)
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._judgement import judging
from smoothdiff._solvers._local_ensemble import Blame
from smoothdiff._solvers._random_numbers import in_step
from smoothdiff._solvers._residual_batch import ResidualBatch, around, check_terms, judge_rows
from smoothdiff._solvers._where import where
from smoothdiff._support import AbstractSupport, as_support

# the share of a population that the next one is like, and the fewest of them that have a spread
_ELITE, _FEWEST = 4, 2
# of the new mean and spread; the rest is that of the population before
_SHARE = 0.7
# so many narrow populations in a row count as convergence
_NARROW = 3
# on a plateau the population grows up to so many sigmas
_WIDEST = 1000.0


class LocalCrossEntropyState(eqx.Module):
    """The state of `LocalCrossEntropy`: `spread` is the width of the population."""

    progress: Progress
    spread: Float[Array, " n"]
    small: Int[Array, ""]


class LocalCrossEntropy(AbstractSmoothSolver, optx.AbstractLeastSquaresSolver):
    r"""Cross-entropy search with local support: many switches or texels at once, over all bounds.

    $$ E_j = \{\text{the quarter of all } i \text{ with the lowest }
       c_{ij} = \textstyle\sum_t S_{tj} \|r_t(x_i)\|^2\} $$

    $$ (\mu_j, s_j) \leftarrow 0.3 \, (\mu_j, s_j) + 0.7 \, \left(
       \operatorname{mean}_{i \in E_j} x_{ij}, \;
       \operatorname{rms}_{i \in E_j} (x_{ij} - \mu_j)\right) $$

    Each parameter has a search of its own, in one dimension, and all searches share their
    evaluations. A population $x_i$ is normal, with a mean $\mu$ and a spread $s$ of each parameter.
    A parameter is judged by the squares of those terms alone that it may move, so it sees only
    their noise. The first population is spread evenly over the bounds, wherever the start is. So no
    search begins in a wrong valley, and both answers to a switch are tried. The spread is taken
    around the last mean: a population that still moves stays wide. Only the order of values counts,
    so jumps, outliers and failed samples do no harm.

    It pays where a term depends on one parameter or a few: switches, texels, cubes that hide one
    another. Where many parameters act on each term, `LocalGaussNewton` needs fewer evaluations, and
    is more accurate at the end. A step takes n times `num_samples` numbers and no linear algebra.

    Args:
        support: which terms a parameter may influence, as for `LocalGaussNewton`. The residuals
            are one array whose first axes are those of the terms. If the objective is a sum of
            terms $t \ge 0$ that are no squares, return $\sqrt{2 t}$.
        sigma: the spread of the first population around the start, a number or a pytree like the
            parameters. By default it covers the bounds, which must be finite then.
        num_samples: evaluations a step, at least 9: the population, and one at its mean.
        batch_size: as for `GaussNewton`.
        nonfinite: "propagate" or "drop" samples that are NaN or infinite. Dropped samples count as
            the worst; more than half of a population is too many.
        rtol: relative tolerance. The run has converged when the spread of three populations in a
            row is below `atol + rtol * norm(y)`. By default both are zero, and the run uses up its
            budget.
        atol: absolute tolerance.
        norm: the norm of spreads and iterates.

    Raises:
        ValueError: fewer than 9 evaluations a step, another word for `nonfinite`; and, when it
            runs, neither a sigma nor finite bounds, a support that does not go with the residuals.
        TypeError: a support that is no function; residuals that are no real floating-point numbers.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> lit = jax.random.bernoulli(jax.random.key(1), shape=(300,))
        >>> display = lambda y: (y > 0.5).astype(float)
        >>> result = sd.least_squares(
        ...     lambda y, photo: display(y) - photo,
        ...     jnp.full(300, 0.5),
        ...     lit.astype(float),
        ...     key=jax.random.key(0),
        ...     solver=sd.LocalCrossEntropy(sd.local_support(0, ndim=1)),
        ...     bounds=(0.0, 1.0),
        ...     max_evaluations=150,
        ... )
        >>> bool(jnp.all((result.y > 0.5) == lit))
        True

    Source: Rubinstein, The Cross-Entropy Method for Combinatorial and Continuous Optimization
    (1999); the spread as in CMA-ES (Hansen, The CMA Evolution Strategy: A Tutorial, 2016); with a
    support, own.
    """

    support: Callable[[PyTree], Array]
    _: KW_ONLY
    sigma: PyTree = None
    num_samples: int = 32
    batch_size: int | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def __check_init__(self):
        if self.num_samples <= _ELITE * _FEWEST:
            raise ValueError(
                f"num_samples={self.num_samples}: a step needs at least {_ELITE * _FEWEST + 1} "
                "evaluations, as a quarter of a population has to have a spread"
            )
        check_settings(self)
        if callable(self.sigma):
            raise TypeError("sigma is the spread of the first population, and no schedule")
        self._blamed()

    def _blamed(self) -> AbstractSupport:
        support = as_support(self.support)
        if support is None:
            raise TypeError("LocalCrossEntropy needs a support; GaussNewton does without one")
        return support

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """A population and its mean."""
        return self.num_samples

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the last mean, and with noise the start and the best estimate again."""
        return judging(self.num_samples, new=1, old=2)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> LocalCrossEntropyState:
        """Checks what can be looked at; evaluates nothing."""
        read_options(options)
        check_terms(f_struct, jax.eval_shape(self._blamed().at(y), y))
        params = self._params(y, options)
        if self.sigma is None and not _bounded(params):
            raise ValueError(
                "LocalCrossEntropy begins with a population over all bounds: give finite bounds "
                "for each parameter, or sigma=, its spread around the start"
            )
        spread = params.sigma if self.sigma is not None else _span(params) / math.sqrt(12)
        progress = Progress.start(y, params.theta.dtype)
        return LocalCrossEntropyState(progress, spread, jnp.zeros((), jnp.int32))

    def _params(self, y: PyTree[Array], options: dict) -> Params:
        """The parameters, with their sigma; where that is not given any will do."""
        sigma = self.sigma
        if sigma is None:
            sigma = jax.tree.map(lambda leaf: jnp.abs(leaf) + 1, y)
        params = take_apart(y, sigma, read_options(options)[1])
        if params.free:
            raise ValueError("LocalCrossEntropy needs a sigma for every leaf of the parameters")
        return params

    def step(self, fn, y, args, options, state: LocalCrossEntropyState, tags):
        """One population, and the mean and spread of the next one."""
        progress, spread = state.progress, state.spread
        params = self._params(y, options)
        numbers = in_step(args, options, progress.step)
        residuals = Evaluator(fn, numbers, params.layout, True, self.batch_size)
        blame = Blame.of(self._blamed(), params.layout.tree, params.theta)
        key = jax.random.fold_in(read_options(options)[0], progress.step)

        first = progress.step == 0
        anywhere = first & (self.sigma is None)
        points = jax.lax.cond(
            anywhere,
            lambda: _even(params, key, self.num_samples - 1),
            lambda: around(params, Gaussian(), key, spread, self.num_samples - 1),
        )
        points = kept(jnp.concatenate([points, params.theta[None]]))
        rows, aux = residuals(points)
        seen = ResidualBatch.of(points, rows, jnp.asarray(len(points)))
        population = ResidualBatch.of(points[:-1], rows[:-1], jnp.asarray(len(points) - 1))

        theta, wide, flat = jax.lax.cond(
            anywhere,
            lambda: _fit(blame, population),
            lambda: _fit(blame, population, params.theta),
        )
        share = jnp.where(anywhere, 1, _SHARE).astype(spread.dtype)
        theta = params.clip(params.theta + share * (theta - params.theta))
        wide = spread + share * (wide - spread)
        # where a parameter has moved nothing there is nothing to learn but that it is too narrow
        widest = jnp.minimum(_span(params), _WIDEST * params.sigma)
        wide: Array = jnp.where(flat, jnp.minimum(2 * spread, widest), wide)
        fun, stderr = population.loss()

        new_y = params.layout.tree(theta)
        narrow = is_small(self, params.layout.tree(wide), new_y)
        small = jnp.where(narrow, state.small + 1, 0)
        finite = population.enough(self.nonfinite) & all_finite((fun, theta, wide))
        new_y, wide = where(finite, (new_y, wide), (y, spread))
        point, there = seen.lowest()
        # a population over the bounds says nothing of the function around the start
        fun = jnp.where(anywhere, jnp.nan, fun)
        lowest = Seen(params.layout.tree(point), there)
        rest = spread, len(points), finite, lowest, seen.overflowed
        progress = progress.after(y, fun, stderr, *rest)
        return new_y, LocalCrossEntropyState(progress, wide, small), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After narrow populations in a row, or a failed step."""
        return stopped(state.progress, state.small >= _NARROW)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges all that was seen and the last mean; with noise also the start and the best."""
        progress = state.progress

        def samples(y: PyTree[Array], key: Array) -> Array:
            params = self._params(y, options)
            return around(params, Gaussian(), key, state.spread, self.num_samples)

        evaluate = Evaluator(fn, args, layout_of(y), True, self.batch_size)
        # every mean but the last was evaluated
        new, old = [y], (progress.start_y, progress.best_y)
        y, stats = judge_rows(
            progress, evaluate, options, self.nonfinite, samples, self.num_samples, new, old
        )
        return y, aux, stats


def _bounded(params: Params) -> bool:
    """Whether all bounds are finite, as far as can be told now."""
    span = _span(params)
    return not is_concrete(span) or bool(jnp.all(jnp.isfinite(span)))


def _span(params: Params) -> Float[Array, " n"]:
    """How far apart the bounds are."""
    if params.bounds is None:
        return jnp.full_like(params.theta, jnp.inf)
    low, high = params.bounds
    return high - low


def _even(params: Params, key: Array, count: int) -> Float[Array, "count n"]:
    """Points over the bounds, for each parameter one in each of so many equal parts."""
    if params.bounds is None:
        return jnp.full((count, params.theta.size), jnp.nan, params.theta.dtype)
    layer, place = jax.random.split(key)
    shape, dtype = (count, params.theta.size), params.theta.dtype
    numbers = jnp.broadcast_to(jnp.arange(count, dtype=dtype)[:, None], shape)
    shuffled = jax.random.permutation(layer, numbers, independent=True)
    share = (shuffled + jax.random.uniform(place, shape, dtype)) / count
    return params.bounds[0][None] + _span(params)[None] * share


def _fit(
    blame: Blame, population: ResidualBatch, middle: Float[Array, " n"] | None = None
) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, " n"]]:
    """Mean and spread of the elite of each parameter; who is as good as the last is in it.

    The spread is that around the middle of the population, by default around the mean. Also whether
    the whole population is as good.
    """
    points, rows = population.points, population.rows
    terms = blame.terms(points[0]).size
    squares = jnp.sum(rows.reshape(len(rows), terms, -1) ** 2, axis=2)
    costs = jax.vmap(blame.params)(squares)
    costs = jnp.where(population.good[:, None], costs, jnp.inf)
    fewest = (len(points) + 1) // _ELITE
    worst = jnp.sort(costs, axis=0)[fewest - 1]
    elite = (costs <= worst[None]) & population.good[:, None]
    count = jnp.maximum(jnp.sum(elite, axis=0), 1).astype(points.dtype)
    mean = jnp.sum(jnp.where(elite, points, 0), axis=0) / count
    away = points - (mean if middle is None else middle)[None]
    squared = jnp.sum(jnp.where(elite, away**2, 0), axis=0) / count
    # as of the fewest, so that a parameter of which many are as good looks a little further
    flat = jnp.all(elite | ~population.good[:, None], axis=0)
    return mean, jnp.sqrt(squared * (fewest / (fewest - 1))), flat
