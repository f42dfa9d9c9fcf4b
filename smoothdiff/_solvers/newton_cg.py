"""Newton's method on a number that need not be differentiable, from function values alone."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import KW_ONLY
from types import ModuleType
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from smoothdiff._samplers import AbstractSampler
from smoothdiff._solvers import _newton_batches, _point_by_point
from smoothdiff._solvers._base import check_settings, smoothed_params
from smoothdiff._solvers._history import History
from smoothdiff._solvers._parameter_scan import Scan
from smoothdiff._solvers._search_solver import AbstractSearchSolver
from smoothdiff._solvers._stages import Sizes
from smoothdiff._solvers._value_search import ValueSearch

# from so many parameters on, evaluations come in batches
_MANY = 100
# the fewest and the most samples of a round by default
_FEW, _SOME = 4, 16


class NewtonCG(AbstractSearchSolver, optx.AbstractMinimiser):
    r"""Newton's method on a black box that returns one number, from function values alone.

    $$ \min_p \; g \cdot p + \tfrac12 p \cdot H p, \qquad \|p\|_{M^{-1}} \le \Delta $$

    With fewer than 100 parameters the function is evaluated point by point. The first points are
    the start, and one sigma from it to both sides along each parameter, or to one side one and half
    a sigma where a bound cuts off most of the other. Where both are higher than the start, and the
    parabola through all three is lowest within a quarter of sigma, those along the parameters that
    follow come nearer, too: to 0.03 sigma at most. Where all hardly differ, pairs of points follow,
    each four times as far away, up to a thousand sigma, or within finite bounds points anywhere,
    and then the first points again if these found a change. Then two models take turns, and the one
    that lowers the function faster goes on. The local one begins, and goes on while half of its
    steps lower the function, up to four times as long:

    - a local one, around the best point. It interpolates the nearest evaluations, and its Hessian
      differs least from the last one. While they do not determine it, and where they say clearly
      that the function is no quadratic, the farther ones count less. The step that minimises it
      within the trust region is one evaluation; the radius $\Delta$ grows where the function falls
      as predicted and shrinks where it does not. After a short step one evaluation checks the
      model: a little farther away, in a flat direction that no other point tells of, and at none
      that is known.
    - a wide one, for functions that jump, have noise or many minima: a regression over samples
      around a center, which gives the smoothed value, gradient and Hessian-vector products in
      closed form, with standard errors. A truncated conjugate-gradient method minimises it. What is
      known of the noise decides how far to go: entries of the gradient are shrunk by their standard
      errors, and the test of the last step is relaxed by that of the difference. Samples count less
      the higher they are. The width shrinks to the length of the step as far as noise allows, and
      grows where a round of samples has one value alone, as on a plateau. After six rounds that
      lead nowhere the center goes back to the best point.

    With `nonfinite="drop"`, where both first points of a parameter fail, nearer ones follow, and so
    they do after a round of samples that all fail. After more than n failures one counts as a
    little higher than the best point, so the model turns away from there. A parameter whose first
    points had the value of the start, and whose sigma is below a thousandth of the largest, has
    farther ones. Else it keeps no run going. In the end it is back at the start, if that raises
    nothing.

    M, the metric of both, takes the shape of the Hessian, directions included up to 64 parameters.
    So sigma says where to begin.

    Where the function takes a key, the local model has one turn, of 12 (n + 1) evaluations, or 24
    (n + 1) while it predicts. The wide one takes what all samples of a round have in common as
    noise, if that is likelier.

    With 100 parameters and more, or with an optax schedule of sigma, each step takes a batch, and
    the wide model alone.

    Within finite bounds a search looks once at n + 1 points, but no fewer than 7, spread over all
    of the box, and at n that differ from the best one in one parameter each. It does so once
    4 (n + 1) evaluations, or four steps, have lowered the function by less than 0.01 of its value,
    or of how far others are above it if that is less, and its local model has not predicted of
    late; between rounds if that model has failed for good; else before it ends. Once a round has
    shown noise it does so before it ends only. If one is lower, it begins anew, and may look again.
    Else it goes on. A value that is not finite ends nothing there. With `restarts` all of them are
    anywhere, and searches that are added do not look. Where there is no box and it has converged
    more than 1e5 sigma from the start, it begins anew there once, half as wide as it came far, and
    looks at one point twice as far away each time: a function that falls for ever has no minimum.

    Bounds are never left. A sample beyond them is clamped or, where that would throw it out of a
    narrow valley, pulled back along its ray, and the models take it where it was evaluated.

    Records have the `smoothed` function with batches only. The `smoothed` value of the result is
    that of the last model, or of a last batch.

    Args:
        sigma: the smoothing width in the units of the parameters: a number or a pytree like the
            parameters to begin with; or an optax schedule, a function from the number of the step
            to a number, that is followed.
        num_samples: evaluations a step, which can run at once: ends of steps at several radii, and
            points beside them, from which the model learns. By default one; with batches 4 + 3 log
            n for n parameters.
        history: how many evaluations are kept, by default (n + 1)(n + 2), but from 40 to 512, and
            less where they would take more than 128 MB.
        sampler: where to sample, one whose points are normal; by default `Sobol`.
        nonfinite: "propagate" a sample that is NaN or infinite, which ends the run with an error,
            or "drop" it.
        rtol: relative tolerance. The run has converged when three steps in a row are shorter than
            the tolerance, for each parameter atol + rtol max(|y|, sigma), unless only the radius
            made them short, or they failed where the model promised more than rounding may take.
            After the first of the three one evaluation checks the model; it must rise about as
            predicted. A point counts as a small step if the model promises no more than rounding
            takes. If other searches are to follow, a search goes on until its patience ends: its
            wide samples may find more.
        atol: absolute tolerance. With both zero no run converges; else the tolerance is at least
            the root of the rounding of max(|y|, sigma). With batches steps and tolerances are
            compared by their norms, without sigma.
        norm: the norm of steps, in units of the tolerance.
        patience: a search ends after so many evaluations in a row in which the wide model led
            nowhere, if the local one does not either. It also ends where twice as many lowered the
            function, in all, by less than a share of 1e-8 (float32: 8e-6); within a thousandth of
            sigma as many are enough. Not where the function has noise. A model is done at once
            where values differ by rounding alone. By default 20 (n + 1), and at least five steps.
            With batches it counts steps, by default 30.
        restarts: how many searches may follow: for functions with several minima. Within bounds a
            first search that is long on wide samples, or else the second, tries each parameter
            alone, from bound to bound. That ends after 33 evaluations unless the parameters act
            independently. Then it goes on with 50, later 100 and 200, for each parameter. All other
            searches are of wide samples alone: one of four begins at the first point, the others
            anywhere within the bounds, without bounds around the best point so far, as wide as
            chance has it. With batches all begin at the first point. The best point of all is
            returned.

    Raises:
        ValueError: no evaluation in a step, fewer kept ones than two, a patience of none, negative
            restarts, another `nonfinite`; and, when it runs, a leaf without a sigma, or a sampler
            with weights.

    Example:
        >>> import jax, jax.numpy as jnp, optimistix as optx, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(8 * (y - 1) ** 2))
        >>> solver = sd.NewtonCG(0.5)
        >>> solution = optx.minimise(
        ...     plateaus, solver, jnp.zeros(2), options={"key": jax.random.key(0)},
        ...     max_steps=20, throw=False
        ... )
        >>> [round(float(y)) for y in solution.value]
        [1, 1]

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, section 4, for
    Newton-CG on sampled derivatives; Steihaug 1983 for the inner solver; Sun and Nocedal 2023 for
    the relaxed test; Powell 2004 for the local model; Langerman, Seront and Bersini 1994 (STEP) for
    the search along one parameter.
    """

    squares: ClassVar[bool] = False
    _batches: ClassVar[ModuleType] = _newton_batches
    _candidates: ClassVar[int] = 1

    sigma: PyTree
    _: KW_ONLY
    num_samples: int | None = None
    history: int | None = None
    sampler: AbstractSampler | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 1e-5
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    patience: int | None = None
    restarts: int = 0

    def __check_init__(self):
        check_settings(self)
        if self.history is not None and self.history < 2:
            raise ValueError(f"history must be at least 2, or None for the default: {self.history}")

    def sizes(self, y: PyTree[Array]) -> Sizes | None:
        """One evaluation a step, or as many as the user says can run at once.

        None with many parameters, and with a schedule, which wants samples of its width.
        """
        n = sum(leaf.size for leaf in jax.tree.leaves(y))
        if n >= _MANY or callable(self.sigma):
            return None
        # about one for each parameter; Sobol points are balanced if they are a power of two
        count = 2 ** int(math.log2(min(max(n, _FEW), _SOME)))
        patience = self.patience or _point_by_point.patience(n, self.num_samples)
        return Sizes.of(self.num_samples, count, count, patience)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Any:
        """Checks what can be looked at; evaluates nothing."""
        sizes = self.sizes(y)
        if sizes is None:
            return _newton_batches.init(self, y, options, f_struct.dtype)
        params = smoothed_params(self, y, jnp.asarray(0, jnp.int32), options)
        theta = params.theta
        n = theta.size
        usual = min(max((n + 1) * (n + 2), _newton_batches.FEWEST), _newton_batches.MOST)
        length = max(self.history or usual, sizes.first, n + 2)
        history = History.empty(length, n, 1, theta.dtype)
        width = jnp.ones((), theta.dtype)
        search = ValueSearch.of(params, theta, width, history)
        if self.restarts and params.bounds is not None:
            scan = Scan.start(theta, jnp.zeros_like(width), params.sigma)
            search = dataclasses.replace(search, scan=scan)
        return _point_by_point.init(self, y, search, options, aux_struct)

    def reason(self, state: Any) -> str:
        """Small steps, a gradient that is all noise, or too many evaluations for nothing.

        Where the same point had the same value again there is no noise.
        """
        if isinstance(state, _newton_batches.NewtonBatchState):
            return "noise" if state.center.trust.insignificant else "converged"
        if state.search.converged():
            return "converged"
        search = state.search
        noisy = search.noisy | (search.average is not None)
        return "noise" if search.center.trust.insignificant & noisy else "stalled"
