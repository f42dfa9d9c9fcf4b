"""Gauss-Newton on residuals that need not be differentiable: one batch teaches all of them."""

import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler, Gaussian, Sobol
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    judge,
    promotion,
    read_options,
    smoothed_params,
    stopped,
    unless_failed,
)
from smoothdiff._solvers._local_steps import TRIED, steps_to_try
from smoothdiff._solvers._parameter_regression import gauss_newton_step
from smoothdiff._solvers._residual_batch import (
    ResidualBatch,
    Residuals,
    around,
    check_residuals,
    fresh_loss,
)
from smoothdiff._solvers._residual_history import History
from smoothdiff._solvers._residual_search import ResidualSearch, next_scale
from smoothdiff._solvers._restarts import Restarts, check_restarts

# the longest step of any parameter, in units of its sigma: beyond it nothing has been seen
_LONGEST = 2.0
# evaluations a step of a problem with many parameters
_MOST = 96
# from so many parameters on, several steps are evaluated and the best is taken
_MANY = 100


class GaussNewtonState(eqx.Module):
    """The state of `GaussNewton`."""

    progress: Progress
    search: ResidualSearch
    restarts: Restarts | None


class GaussNewton(AbstractSmoothSolver, optx.AbstractLeastSquaresSolver):
    r"""Nonlinear least squares by Gauss-Newton, on residuals that need not be differentiable.

    $$ r(y + \sigma u) \approx m + J u + e, \qquad
       u_t = -(J^T \Gamma^{-1} J + I)^{-1} J^T \Gamma^{-1} m, \qquad
       y_{t+1} = \Pi(y_t + \sigma_t u_t) $$

    The function returns residuals, such as an image minus its reference, and every evaluation
    teaches all of them. A linear model of all residuals is fitted to the last `history`
    evaluations. $\Gamma$, the covariance of what it leaves, is the metric: pixels that jump at
    random have no say, and where all do, the step is damped as by Levenberg and Marquardt. Nothing
    larger than history x history is factorised, whatever the numbers of parameters and residuals.
    With few parameters a step is not checked by evaluations of its own; the next batch includes its
    end point, and fits in what it finds. Where five times the step is as long as sigma, it includes
    the point there as well, in place of a sample. The next step starts from the best point of the
    history, in place of $y_t$, if its sum of squares is a fifth less: along a slope that is a long
    way on.

    With 100 parameters and more (and at least 36 evaluations a step), where a batch says little
    about each of so many, 12 of the evaluations go to the ends of 12 steps, and the best is taken
    if it is an improvement: the one above at several lengths, and steps by a Jacobian of which only
    those entries are kept that cannot be chance. That finds by itself which residuals a parameter
    moves, if these are few, from a number of samples that grows with the logarithm of n. It takes
    n x P numbers for P residuals, and is left out where that is more than 2e8.

    What is sought is a small sum of squares, $\min_y \frac12 \sum_p r_p(y)^2$. Where it does not
    vanish the metric becomes the identity as sigma shrinks, so that the limit is the least-squares
    solution. The `fun` that is reported, and by which the result is judged, is the smoothed loss
    $\mathbb{E}_z[\frac12 \sum_p r_p(y + \sigma z)^2]$, the square first: what `minimise` would
    report for that loss. (The loss of smoothed residuals, $\frac12 \sum_p \mathbb{E}[r_p]^2$,
    is less by half the sum of the residuals' variances.) A point further on is no sample of that: a
    step that has one estimates from the others, which may be the iterate alone, and then knows no
    standard error.

    Args:
        sigma: the smoothing width in the units of the parameters, positive for each of them. A
            number or a pytree like the parameters adapts: it is multiplied by what the standard
            error of the step asks for, and grows where all samples are the same. An optax
            schedule, a function from the number of the step to a number, is taken as it is.
        num_samples: evaluations a step, the one at the iterate included. By default
            4 + 3 log(n) for n parameters at first and while all samples are the same, later at
            most n, but at least 2, as the history has the others (under `vmap` all are evaluated
            all the same). For more than about 24 parameters n / 2, at most 96.
        history: evaluations to keep, whose points and residuals are in memory. By default 12 n,
            but at least 32 and at most 256, and never less than three steps; four steps for 100
            parameters and more.
        sampler: where to sample. By default `Sobol`, for 100 parameters and more `Gaussian`, as
            few Sobol points in many dimensions make parameters look alike.
        batch_size: evaluate at most so many samples at a time, as for `smooth`.
        nonfinite: "propagate" or "drop" samples with a NaN or an infinity in their residuals; as
            long as half of a batch are finite. The end of a step that is tried may be anything.
        rtol: relative tolerance. The run has converged when three steps in a row and their sigma
            are below `atol + rtol * norm(y)`.
        atol: absolute tolerance. By default both are zero, and the run uses up its budget.
        norm: the norm of steps and iterates.
        patience: with restarts, so many steps in a row without a lower estimate end a search, as
            convergence does. The last search goes on, and so does the only one.
        restarts: how many searches may follow, each from the first point and with the first sigma,
            but with other random numbers: for residuals with several minima, or with plateaus at
            the start. The best point of all is returned. A schedule of sigma goes on where it was.

    Raises:
        ValueError: fewer than 3 evaluations a step, a history that holds less than a step, a
            patience of no step, negative restarts, another word for `nonfinite`; and, when it runs,
            a leaf without a sigma.
        TypeError: residuals that are no real floating-point numbers.

    Example:
        >>> import jax, jax.numpy as jnp, optimistix as optx, smoothdiff as sd
        >>> pixels = jnp.arange(32.0)
        >>> bar = lambda y: jnp.where(jnp.abs(pixels - y) < 4.5, 1.0, 0.0)
        >>> solution = optx.least_squares(
        ...     lambda y, args: bar(y) - bar(20.0),
        ...     sd.GaussNewton(3.0),
        ...     jnp.array(15.0),
        ...     options={"key": jax.random.key(0)},
        ...     max_steps=30,
        ...     throw=False,
        ... )
        >>> round(float(solution.value))
        20

    Source: own; the regression is the update of ensemble Kalman inversion (Iglesias, Law and
    Stuart, 2013), here with a ridge by marginal likelihood and a history.
    """

    sigma: PyTree
    num_samples: int | None
    history: int | None
    sampler: AbstractSampler | None
    batch_size: int | None
    nonfinite: Literal["propagate", "drop"]
    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]]
    patience: int
    restarts: int

    def __init__(
        self,
        sigma: PyTree,
        *,
        num_samples: int | None = None,
        history: int | None = None,
        sampler: AbstractSampler | None = None,
        batch_size: int | None = None,
        nonfinite: Literal["propagate", "drop"] = "propagate",
        rtol: float = 0.0,
        atol: float = 0.0,
        norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm,
        patience: int = 30,
        restarts: int = 0,
    ):
        if num_samples is not None and num_samples < 3:
            raise ValueError(f"num_samples={num_samples}: a step needs at least 3 evaluations")
        if nonfinite not in ("propagate", "drop"):
            raise ValueError(f'nonfinite must be "propagate" or "drop", not {nonfinite!r}')
        if num_samples is not None and history is not None and history < num_samples:
            raise ValueError(
                f"history={history} is less than num_samples={num_samples}: keep at least a batch"
            )
        check_restarts(patience, restarts)
        self.sigma = sigma
        self.num_samples = num_samples
        self.history = history
        self.sampler = sampler
        self.batch_size = batch_size
        self.nonfinite = nonfinite
        self.rtol = rtol
        self.atol = atol
        self.norm = norm
        self.patience = patience
        self.restarts = restarts

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One batch, as large as the first, and the steps that are tried."""
        first, _, tried = self._evaluations(y)
        return first + tried

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """A batch for each of the two candidates."""
        return 2 * self.evaluations_per_step(y)

    def _evaluations(self, y: PyTree[Array]) -> tuple[int, int, int]:
        """Samples of a first batch, and of a later one; and how many steps are tried."""
        n = sum(leaf.size for leaf in jax.tree.leaves(y))
        first = self.num_samples or max(int(4 + 3 * math.log(n)), min(n // 2, _MOST))
        # what the history has need not be seen again
        later = first if self.num_samples else min(first, max(2, n))
        tried = TRIED if n >= _MANY and first >= 3 * TRIED else 0
        return first - tried, later - tried, tried

    def _points(self, params: Params, key: Array, sigma: Array, count: int) -> Array:
        # few Sobol points are all but the same in some pairs of very many dimensions
        sampler = self.sampler or (Sobol() if params.theta.size < _MANY else Gaussian())
        return around(params, sampler, key, sigma, count)

    def _batch(
        self, residuals: Residuals, key: Array, sigma: Array, y: PyTree, search: ResidualSearch
    ) -> tuple[ResidualBatch, PyTree]:
        """The iterate and samples around it, fewer of them once they differ; and aux.

        With few parameters one of the samples makes way for a point further on.
        """
        first, later, tried = self._evaluations(y)
        params = residuals.params
        points = jnp.concatenate([params.theta[None], self._points(params, key, sigma, first - 1)])
        drawn = jnp.ones(first, bool)
        if not tried:
            step, worth = search.further(sigma)
            further = params.clip(params.theta + step)
            points = points.at[1].set(jnp.where(worth, further, points[1]))
            drawn = drawn.at[1].set(~worth)

        def evaluate(count: int) -> tuple[Array, PyTree]:
            rows, aux = residuals(points[:count])
            return jnp.pad(rows, ((0, first - count), (0, 0))), aux

        if later == first:
            count, (rows, aux) = jnp.asarray(first), evaluate(first)
        else:
            count = jnp.where(search.seen, later, first)
            rows, aux = jax.lax.cond(search.seen, lambda: evaluate(later), lambda: evaluate(first))
        return ResidualBatch.of(points, rows, count, drawn), aux

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> GaussNewtonState:
        """Checks what can be looked at; evaluates nothing."""
        params = smoothed_params(self, y, jnp.asarray(0, jnp.int32), options)
        check_residuals(f_struct)
        n, dtype = params.theta.size, params.theta.dtype
        first, *_ = self._evaluations(y)
        if self.history is None:
            length = max(min(max(12 * n, 32), 256), (3 if n < _MANY else 4) * first)
        else:
            length = max(self.history, first)
        size = sum(leaf.size for leaf in jax.tree.leaves(f_struct))
        search = ResidualSearch.start(History.empty(length, n, size, dtype))
        restarts = Restarts.start(self.restarts, params.theta, search.scale)
        return GaussNewtonState(Progress.start(y, dtype), search, restarts)

    def step(self, fn, y, args, options, state, tags):
        """One batch, one regression, one step."""
        progress, search = state.progress, state.search
        params = smoothed_params(self, y, progress.step, options)
        residuals = Residuals(fn, args, params, self.batch_size)
        key = jax.random.fold_in(read_options(options)[0], progress.step)
        count, _, tried = self._evaluations(y)
        sigma = params.sigma * search.scale
        batch, aux = self._batch(residuals, key, sigma, y, search)
        history = search.history.after(batch.points, batch.rows, batch.good, batch.count)

        center, here = params.theta, batch.rows[0]
        if not tried:
            center, here = history.lowest(center, batch.here())
        u = (history.points - center[None]) / sigma[None]
        sides = [
            None if side is None else (side - center) / sigma for side in (params.low, params.high)
        ]
        # steps that are evaluated are so within the bounds
        known = (None, None) if tried else sides
        move, error = gauss_newton_step(u, history.residuals, history.valid, *known)
        longest = jnp.max(jnp.abs(move))
        move = move / jnp.maximum(1, longest / _LONGEST)
        if tried:
            steps = steps_to_try(move, u, history.residuals, history.valid, here, count, *sides)
            move, longest = _best(residuals, sigma, steps, here)
        theta = params.clip(center + sigma * move)
        same = batch.same()
        scale = search.scale
        if not callable(self.sigma):
            # a few that are the same call for more of them first
            flat = same & (batch.count == count)
            scale = next_scale(scale, flat, history, here, u, error, longest / _LONGEST)

        fun, stderr = batch.loss()
        new_y = params.layout.tree(theta)
        with promotion():
            moved = self.norm(params.layout.tree(jnp.abs(theta - params.theta) + sigma))
            small = moved < self.atol + self.rtol * self.norm(y)
        finite = batch.enough(self.nonfinite) & all_finite((fun, theta, scale))
        after = search.after(scale, history, theta - params.theta, ~same, fun, small)
        new_y, after = unless_failed(finite, (new_y, after), (y, search))
        progress = progress.after(y, fun, stderr, sigma, batch.count + tried, finite)
        restarts = state.restarts
        if restarts is not None:
            lowest = progress.best_fun < state.progress.best_fun
            first = ResidualSearch.start(jax.tree.map(jnp.zeros_like, history))
            start = params.layout.tree(restarts.theta)
            (new_y, after), restarts = restarts.after(lowest, search.scale).next(
                after.over(self.patience), (new_y, after), (start, first)
            )
        return new_y, GaussNewtonState(progress, after, restarts), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After small steps in a row, or a failed one."""
        return stopped(state.progress, state.search.converged())

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges the last iterate and the best recorded on the next step's samples."""
        progress = state.progress
        key = jax.random.fold_in(read_options(options)[0], progress.step)
        count = self.evaluations_per_step(y)
        # with restarts, on the width on which the lowest estimate was made
        scale = state.search.scale if state.restarts is None else state.restarts.kernel

        def estimate(y):
            params = smoothed_params(self, y, progress.step, options)
            points = self._points(params, key, params.sigma * scale, count)
            residuals = Residuals(fn, args, params, self.batch_size)
            return fresh_loss(residuals, points, self.nonfinite)

        y, fun, stderr = judge(estimate, y, progress.best_y)
        evaluations = progress.evaluations + self.final_evaluations(y)
        return y, aux, {"fun": fun, "stderr": stderr, "evaluations": evaluations}


def _best(
    residuals: Residuals, sigma: Array, steps: Float[Array, "k n"], here: Float[Array, " P"]
) -> tuple[Array, Array]:
    """The step that leads to the smallest sum of squares, if that is a smaller one; its length."""
    params = residuals.params
    ends = jax.vmap(params.clip)(params.theta[None] + sigma[None] * steps)
    found = jnp.sum(residuals(ends)[0] ** 2, axis=1)
    found = jnp.where(jnp.isfinite(found), found, jnp.inf)
    best = jnp.argmin(found)
    move = jnp.where(found[best] < jnp.sum(here**2), steps[best], 0)
    return move, jnp.max(jnp.abs(move))
