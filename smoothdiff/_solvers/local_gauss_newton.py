"""Gauss-Newton in all places at once, where each parameter moves only some of the residuals."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler, Gaussian
from smoothdiff._seen import Seen, kept
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    check_settings,
    is_small,
    read_options,
    smoothed_params,
    stopped,
)
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._judgement import judging
from smoothdiff._solvers._local_ensemble import (
    DAMPINGS,
    Blame,
    best_of_each_place,
    ensemble_steps,
)
from smoothdiff._solvers._random_numbers import in_step, takes_key
from smoothdiff._solvers._residual_batch import (
    ResidualBatch,
    around,
    centred,
    check_terms,
    judge_rows,
)
from smoothdiff._solvers._where import where
from smoothdiff._support import AbstractSupport, as_support

# ends that are evaluated in a step: one for each damping, and the best of each place
_TRIED = len(DAMPINGS) + 1
# samples in a step, and what limits them: the cubes of their number, one for each term
_FEWEST, _MOST = 16, 96 - _TRIED
_CUBES = 5e8
# sigma falls while the samples' sum of squares is more than so many times that of the iterate
_NOISE = 2.0
_SHRINK, _GROW = 0.9, 1.05
# so many small steps in a row count as convergence
_SMALL = 3


class LocalGaussNewtonState(eqx.Module):
    """The state of `LocalGaussNewton`: `scale` is the width relative to sigma."""

    progress: Progress
    scale: Float[Array, ""]
    small: Int[Array, ""]


class LocalGaussNewton(AbstractSmoothSolver, optx.AbstractLeastSquaresSolver):
    r"""Nonlinear least squares with local support: thousands of parameters from small batches.

    $$ w_t = -(G_t + \lambda \tau_t I)^{-1} g_t, \qquad
       y_j \leftarrow y_j + \sigma \operatorname{mean}_{t \ni j} (w_t \cdot u_j) $$

    $$ G_t = \sum_s N_{ts} R_s R_s^T, \qquad g_t = \sum_s N_{ts} R_s m_s $$

    The residuals are an array of terms, such as the pixels of a picture or its tiles, and `support`
    says which of them a parameter may move. Few parameters matter to a term. So a batch of M
    samples, small beside all n parameters, is large beside those few. Each term t solves the
    problem of its neighbourhood in the space of the samples u (M x M numbers), and a parameter
    takes the mean of what its terms say. R are the residuals of the samples minus their mean m.
    $N = S S^T$ counts the parameters that two terms share, and $\tau$ is the mean of the diagonal
    of G.

    The step is tried with eight dampings $\lambda$, from 30 to 0.01. A ninth try takes for each
    parameter the damping that was best in its own terms. So a step may be long in one place and
    short in another. The best of the nine is the next iterate, even if the last one was better, as
    a single point of a rough function is a matter of luck. What is returned is the lowest point
    that was evaluated, or with noise the best of a few by fresh evaluations.

    `GaussNewton` needs no support, but its time and memory grow with the number of parameters times
    that of residuals. Here M^2 numbers are kept for each term. It runs on CPUs and GPUs; on TPUs
    JAX lacks a tridiagonalisation.

    Args:
        sigma: the smoothing width in the units of the parameters, positive for each of them. A
            number or a pytree like the parameters adapts. It falls by a tenth in a step if the mean
            sum of squares of the samples is more than twice that of the next iterate, and grows
            again if not. So noise in the residuals keeps it up. While all samples are the same it
            doubles. An optax schedule is followed as it is.
        support: which terms a parameter may influence, as for `smooth`: `local_support`,
            `matrix_support`, `moving_support` or any linear function from parameter-shaped to
            term-shaped arrays with entries 0 and 1. The residuals are one array with the shape of
            the terms; further axes, such as colours, belong to their term.
        num_samples: evaluations a step, at least 12: the samples, and nine ends that are tried. By
            default about n / 2 samples, between 16 and 87; fewer for more than 760 terms, so that a
            step takes seconds at most (28 for 65,536 terms).
        sampler: where to sample.
        batch_size: as for `GaussNewton`.
        nonfinite: as for `GaussNewton`. Where all nine ends fail, the iterate stays.
        rtol: as for `GaussNewton`.
        atol: as for `GaussNewton`.
        norm: as for `GaussNewton`.

    Raises:
        ValueError: fewer than 12 evaluations a step, another word for `nonfinite`; and, when it
            runs, a leaf without a sigma, a support that does not go with the residuals.
        TypeError: a support that is no function; residuals that are no real floating-point numbers.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> hidden = jax.random.uniform(jax.random.key(1), (8, 8))
        >>> blur = lambda x: (x + jnp.roll(x, 1, 0) + jnp.roll(x, 1, 1)) / 3
        >>> picture = lambda x: jnp.round(32 * blur(x)) / 32
        >>> result = sd.least_squares(
        ...     lambda x, photo: picture(x) - photo,
        ...     jnp.full((8, 8), 0.5),
        ...     picture(hidden),
        ...     key=jax.random.key(0),
        ...     solver=sd.LocalGaussNewton(0.1, sd.local_support(1)),
        ...     max_evaluations=300,
        ... )
        >>> bool(jnp.mean(jnp.abs(picture(result.y) - picture(hidden))) < 1 / 32)
        True

    Source: own; see `_local_ensemble.py` for what it takes from ensemble Kalman filters (Hunt,
    Kostelich and Szunyogh, 2007).
    """

    sigma: PyTree
    support: Callable[[PyTree], Array]
    _: KW_ONLY
    num_samples: int | None = None
    sampler: AbstractSampler = Gaussian()
    batch_size: int | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def __check_init__(self):
        if self.num_samples is not None and self.num_samples < _TRIED + 3:
            raise ValueError(
                f"num_samples={self.num_samples}: a step needs at least {_TRIED + 3} evaluations, "
                f"as {_TRIED} of them are ends of steps that are tried"
            )
        check_settings(self)
        self._blamed()

    def _blamed(self) -> AbstractSupport:
        support = as_support(self.support)
        if support is None:
            raise TypeError("LocalGaussNewton needs a support; GaussNewton does without one")
        return support

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One batch, and the ends that are tried."""
        return self._samples(y) + _TRIED

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the start, and the last iterate and the best estimate again."""
        return judging(self._samples(y), new=1, old=2)

    def _samples(self, y: PyTree[Array]) -> int:
        """Evaluations of a batch."""
        if self.num_samples is not None:
            return self.num_samples - _TRIED
        n = sum(leaf.size for leaf in jax.tree.leaves(y))
        terms = jax.eval_shape(self._blamed().at(y), y).size
        affordable = int((_CUBES / max(terms, 1)) ** (1 / 3))
        return max(_FEWEST, min(n // 2, _MOST, affordable))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> LocalGaussNewtonState:
        """Checks what can be looked at; evaluates nothing."""
        params = smoothed_params(self, y, jnp.asarray(0, jnp.int32), options)
        check_terms(f_struct, jax.eval_shape(self._blamed().at(y), y))
        dtype = params.theta.dtype
        one, none = jnp.ones((), dtype), jnp.zeros((), jnp.int32)
        return LocalGaussNewtonState(Progress.start(y, dtype), one, none)

    def step(self, fn, y, args, options, state: LocalGaussNewtonState, tags):
        """One batch, one step in each place, the best of nine ends."""
        progress = state.progress
        params = smoothed_params(self, y, progress.step, options)
        numbers = in_step(args, options, progress.step)
        residuals = Evaluator(fn, numbers, params.layout, True, self.batch_size)
        blame = Blame.of(self._blamed(), params.layout.tree, params.theta)
        key = jax.random.fold_in(read_options(options)[0], progress.step)
        sigma = params.sigma * state.scale

        points = around(params, self.sampler, key, sigma, self._samples(y))
        rows, aux = residuals(points)
        batch = ResidualBatch.of(points, rows, jnp.asarray(len(points)))
        theta, at_end = _next(params, residuals, blame, batch, sigma)

        fun, stderr = batch.loss()
        scale = state.scale
        if not callable(self.sigma):
            # only a plateau makes it wider than the user's, and it does not jump back from there
            wider = jnp.where(scale < 1, jnp.minimum(_GROW * scale, 1), scale)
            # where no end is finite, the next samples are nearer
            worse = ~jnp.isfinite(at_end) | (fun > _NOISE * at_end)
            wanted = jnp.where(worse, _SHRINK * scale, wider)
            scale = jnp.where(batch.same(), 2 * scale, wanted)
        new_y = params.layout.tree(theta)
        narrow = is_small(self, params.layout.tree(jnp.abs(theta - params.theta) + sigma), y)
        small = jnp.where(narrow, state.small + 1, 0)
        finite = batch.enough(self.nonfinite) & all_finite((fun, theta, scale))
        new_y, scale = where(finite, (new_y, scale), (y, state.scale))
        point, there = batch.lowest()
        point, there = jnp.where(at_end < there, theta, point), jnp.minimum(there, at_end)
        seen = Seen(params.layout.tree(point), there)
        rest = sigma, len(points) + _TRIED, finite, seen, batch.overflowed
        progress = progress.after(y, fun, stderr, *rest)
        return new_y, LocalGaussNewtonState(progress, scale, small), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After small steps in a row, or a failed one."""
        return stopped(state.progress, state.small >= _SMALL)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges all that was seen and the start; with noise also the last and the best iterate."""
        progress = state.progress

        def samples(y: PyTree[Array], key: Array) -> Array:
            params = smoothed_params(self, y, progress.step, options)
            return around(params, self.sampler, key, params.sigma * state.scale, self._samples(y))

        # every iterate but the start is an end that was evaluated
        new, old = [progress.start_y], (y, progress.best_y)
        if takes_key(options):
            new, old = [y, *new], [progress.best_y]
        evaluate = Evaluator(fn, args, layout_of(y), True, self.batch_size)
        y, stats = judge_rows(
            progress, evaluate, options, self.nonfinite, samples, self._samples(y), new, old
        )
        return y, aux, stats


def _next(
    params: Params,
    residuals: Evaluator,
    blame: Blame,
    batch: ResidualBatch,
    sigma: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The best of the ends of the steps that a batch suggests, and half the sum of squares there.

    Where no end is finite, the iterate and infinity.
    """
    terms = blame.terms(params.theta).size
    by_term = lambda rows: rows.reshape(-1, terms, rows.shape[1] // terms)
    u = centred(batch.points, batch.good) / sigma[None]
    rows = centred(batch.rows, batch.good)
    count = jnp.maximum(jnp.sum(batch.good), 1).astype(rows.dtype)
    mean = jnp.sum(batch.rows, axis=0) / count

    steps = ensemble_steps(blame, u, by_term(rows), by_term(mean[None])[0])
    ends = kept(jax.vmap(params.clip)(params.theta[None] + sigma[None] * steps))
    squares = jnp.sum(by_term(residuals(ends)[0]) ** 2, axis=2)
    mixed = kept(best_of_each_place(blame, ends, squares)[None])
    last = jnp.sum(by_term(residuals(mixed)[0]) ** 2, axis=2)
    losses = jnp.sum(jnp.concatenate([squares, last]), axis=1) / 2
    losses = jnp.where(jnp.isfinite(losses), losses, jnp.inf)
    best = jnp.argmin(losses)
    there = jnp.isfinite(losses[best])
    theta = jnp.where(there, jnp.concatenate([ends, mixed])[best], params.theta)
    return theta, losses[best]
