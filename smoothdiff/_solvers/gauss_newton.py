"""Gauss-Newton on residuals that need not be differentiable: one batch teaches all of them."""

import math
from collections.abc import Callable
from dataclasses import KW_ONLY
from types import ModuleType
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._samplers import AbstractSampler
from smoothdiff._sharding import as_sharding
from smoothdiff._solvers import _batch_by_batch, _point_by_point
from smoothdiff._solvers._base import check_settings, smoothed_params
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._history import History
from smoothdiff._solvers._residual_batch import check_residuals
from smoothdiff._solvers._residual_search import ResidualSearch
from smoothdiff._solvers._search_solver import AbstractSearchSolver
from smoothdiff._solvers._stages import Sizes

# the default patience of the only search is at least so much, as a plateau may be wide
_LAST = 100


class GaussNewton(AbstractSearchSolver, optx.AbstractLeastSquaresSolver):
    r"""Nonlinear least squares by Gauss-Newton, on residuals that need not be differentiable.

    $$ r(y_t + \sigma u) \approx r_t + J u, \qquad
       u_t = \arg\min_{\|u\| \le \Delta} \tfrac12 \|r_t + J u\|^2, \qquad
       y_{t+1} = \Pi(y_t + \sigma u_t) $$

    The function returns residuals, such as an image minus its reference, and every evaluation
    teaches all of them. What is sought is a small sum of squares, $\min_y \frac12 \sum_p r_p(y)^2$.

    With fewer than 100 parameters the function is evaluated point by point.

    - **The first points** are the start, and one sigma from it along each parameter. Where the loss
      is more than ten times as high there, a nearer point follows, and the width of that parameter
      shrinks as much. Those along the parameters that follow come nearer, too, in the geometric
      mean, but at most to 0.03 sigma. A point that fails is evaluated once more, in case that was
      chance, before a nearer one. Where the residuals hardly change, and sigma is below a
      thousandth of the largest, as for a parameter that is zero but for rounding, a farther one
      follows. If all residuals hardly differ, pairs of points follow, each four times as far away,
      up to a thousand sigma, or within finite bounds points anywhere. Where these find a change,
      the first points are taken again.
    - **The local model** needs one evaluation a step. $y_t$ is the best point. J fits the nearest
      points. Far ones, where J is off by more than the noise of evaluations, count less. Of all
      such J it is the one that differs least from the last. The radius $\Delta$ grows if the
      reduction is as predicted, and shrinks if the loss does not fall. Where J asks for a short
      step or none, as at the minimum of a fit to noisy data, points beside check it.
    - **The wide regression** takes over on functions that jump: when steps fail in a row, when a
      shorter step is predicted no better than a longer one, or when no residual changes. It samples
      rounds of points around a center, which may go uphill, reflected at the bounds:

    $$ r(y + \sigma u) \approx m + J u + e, \qquad
       u = -(J^T \Gamma^{-1} J + I)^{-1} J^T \Gamma^{-1} m $$

    The metric $\Gamma$ is the covariance of what a linear model of the last `history` evaluations
    cannot explain. So pixels that jump at random have no say. Where all pixels do, the step is
    damped as by Levenberg and Marquardt. The width of each parameter follows its standard error:
    one that tells little so far stays wide while others are narrow. The local model takes over
    again once two steps of the regression in a row are as predicted, or once 6 (n + 1) evaluations
    have found nothing lower. Before that it is tested: after 6 (n + 1) evaluations that lowered the
    loss, if the samples are then below 0.3 sigma wide. Wider ones are to find the valley. A test
    has 4 (n + 1) steps at most. The local model stays if it lowers the logarithm of the loss at 0.3
    times the rate of the rounds before. Else the rounds go on where they were, and the next test
    comes after twice as many evaluations. Where the function takes a key, there are no tests. After
    six rounds every second evaluation, or one of `num_samples`, is next to the center: what
    residuals are there is not the mean over samples where they are curved. Steps shorter than the
    width are then halved.

    Within finite bounds a search that would end with more than a tenth of the loss of its start
    looks at n + 1 points, but no fewer than 7, spread over all of the box, and at n that differ
    from the best one in one parameter each. Where one is lower, it begins anew. A value that is not
    finite ends nothing there. Searches that `restarts` add do not look.

    With 100 parameters and more, or with a schedule of sigma, each step takes a batch, and there is
    the wide regression alone. A batch may say little about each of so many parameters. Then 12 of
    its evaluations try the ends of 12 steps, and the best is taken if it is an improvement. Some
    are the step above at several lengths. The others use a Jacobian without the entries that may be
    chance: the sparsity pattern. If each parameter moves few residuals, the samples that this needs
    grow with the logarithm of n only. It takes n x P numbers for P residuals, and is left out where
    that is more than 2e8.

    The largest matrix that is factorised is history x history, or with fewer than 100 parameters
    n x n. Records have the `smoothed` loss, $\mathbb{E}_z[\frac12 \sum_p r_p(y + \sigma z)^2]$,
    with batches only. The `smoothed` loss of the result is that of the last model, or of a last
    batch.

    Args:
        sigma: the smoothing width in the units of the parameters, positive for each of them: how
            far the first points are from the start. A number or a pytree like the parameters
            adapts. An optax schedule, a function from the number of the step to a number, is
            followed as it is.
        num_samples: evaluations a step, which can run at once: ends of steps at several radii, and
            points beside them, from which the model learns. By default one; for 100
            parameters and more n / 2, at most 96.
        history: how many evaluations to keep in memory, with their residuals. By default 12 n,
            between 32 and 256, and at least three rounds; with 100 parameters and more, four
            batches.
        sampler: where to sample. By default `Sobol`, for 100 parameters and more `Gaussian`, as
            few Sobol points in many dimensions make parameters look alike.
        batch_size: evaluate at most so many samples at a time, as for `smooth`.
        nonfinite: "propagate" or "drop" samples with a NaN or an infinity in their residuals; a
            round that loses half of them is followed by a narrower one. The end of a step that is
            tried may be anything; after more than n failures one counts as a little worse than
            the best point, so the model turns away from there.
        rtol: relative tolerance. The run has converged when three steps in a row are shorter than
            the tolerance, for each parameter atol + rtol max(|y|, sigma), unless only the radius
            made them short, or they failed where the model promised more than rounding may take.
            After steps that came true none of a few roundings of y fails. A step that promises no
            more than 64 roundings of the loss, and comes to that, counts as a short one. So does a
            check that comes true. It follows the first short step, and comes where the model asks
            for nothing: one evaluation where the model is least sure, so far away that the loss
            should rise by a share of 4e-4. Where no step as long as a hundredth of sigma
            was predicted, and more than a tenth of the first loss is left, that may be a ripple's
            minimum: wide rounds look around first. Without `restarts` one short step is enough
            where 1e-20 or less is left of the losses that are known, without the highest quarter
            of them; in float32 1e-10.
        atol: absolute tolerance. With both zero no run converges; else the tolerance is at least
            the root of the rounding of max(|y|, sigma). With batches steps and tolerances are
            compared by their norms, without sigma.
        norm: the norm of steps, in units of the tolerance.
        patience: a search ends after so many evaluations in a row that together lowered the loss
            by less than a share of 1e-8 (float32: 8e-6). By default 20 (n + 1), at least five
            steps, and in the last search at least 100. With batches it counts steps, by default 30,
            and the last search goes on.
        restarts: how many searches may follow, with the first sigma and other random numbers: for
            residuals with several minima, or with plateaus. They begin anywhere within the bounds,
            or without bounds around the best point so far, at a random width. With batches they
            begin at the first point. The best point of all is returned.
        sharding: devices that share out the evaluations of a step, as for `smooth`: so give
            `num_samples`, as many as there are devices or a multiple. Each keeps a part of every
            row of residuals, if there are equal parts.

    Raises:
        ValueError: no evaluation in a step, a history that holds less than a step, a
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

    Source: own. The first points and the ratio test are those of DFO-LS (Cartis, Fiala, Marteau
    and Roberts, 2019), the least change is Broyden's; the wide regression is the update of ensemble
    Kalman inversion (Iglesias, Law and Stuart, 2013), here with a ridge by marginal likelihood and
    a history.
    """

    squares: ClassVar[bool] = True
    _batches: ClassVar[ModuleType] = _batch_by_batch
    _candidates: ClassVar[int] = 0

    sigma: PyTree
    _: KW_ONLY
    num_samples: int | None = None
    history: int | None = None
    sampler: AbstractSampler | None = None
    batch_size: int | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 1e-5
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    patience: int | None = None
    restarts: int = 0
    sharding: Any = eqx.field(default=None, static=True, converter=as_sharding)

    def __check_init__(self):
        check_settings(self)
        if self.sharding is not None and self.batch_size is not None:
            raise ValueError(
                "with a sharding all samples are evaluated at once, each device its share: leave "
                "out batch_size, and give a smaller num_samples"
            )
        count, kept = self.num_samples, self.history
        if count is not None and kept is not None and kept < count:
            raise ValueError(
                f"history={kept} is less than num_samples={count}: keep at least a batch"
            )

    def sizes(self, y: PyTree[Array]) -> Sizes | None:
        """One evaluation a step, or as many as the user says can run at once.

        None with many parameters, and with a schedule, which wants samples of its width.
        """
        n = sum(leaf.size for leaf in jax.tree.leaves(y))
        if n >= _batch_by_batch.MANY or callable(self.sigma):
            return None
        first = 4 + int(3 * math.log(n))
        # what the history has need not be seen again
        later = min(first, max(4, n))
        usual = _point_by_point.patience(n, self.num_samples)
        patience = self.patience or max(usual, 0 if self.restarts else _LAST)
        return Sizes.of(self.num_samples, first, later, patience)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Any:
        """Checks what can be looked at; evaluates nothing."""
        check_residuals(f_struct)
        size = sum(leaf.size for leaf in jax.tree.leaves(f_struct))
        sizes = self.sizes(y)
        if sizes is None:
            return _batch_by_batch.init(self, y, options, size)
        theta = smoothed_params(self, y, jnp.asarray(0, jnp.int32), options).theta
        n = theta.size
        usual = max(min(max(12 * n, 32), 256), 3 * sizes.first, 2 * n)
        # a round, its evaluations at the center included
        length = max(self.history or usual, 2 * sizes.first, n + 2)
        search = ResidualSearch.of(theta, History.empty(length, n, size, theta.dtype))
        return _point_by_point.init(self, y, search, options, aux_struct)

    def reason(self, state: Any) -> str:
        """Small steps, or too many evaluations that hardly lowered the loss."""
        return "converged" if state.search.converged() else "stalled"

    def _evaluator(self, fn: Any, args: PyTree, y: PyTree[Array]) -> Evaluator:
        return Evaluator(fn, args, layout_of(y), self.squares, self.batch_size, self.sharding)
