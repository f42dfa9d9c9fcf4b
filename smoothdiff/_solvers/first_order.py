"""First order: any optax transformation, driven by the gradient of the smoothed function."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params, take_apart
from smoothdiff._samplers import AbstractSampler, Gaussian
from smoothdiff._seen import watched
from smoothdiff._smooth import smooth
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    check_settings,
    is_small,
    project,
    promotion,
    read_options,
    sigma_at,
    stopped,
)
from smoothdiff._solvers._judgement import judged, judging, one_by_one
from smoothdiff._solvers._optax import check_optax, updated
from smoothdiff._solvers._path_length import PathLength, steps_scaled
from smoothdiff._solvers._random_numbers import in_step
from smoothdiff._solvers._where import where

# so many small updates in a row count as convergence: under noise a single one is luck
_PATIENCE = 5
# so many batches in a row that have lost most of their samples are drawn again
_TRIES = 5
# the share of the newest iterate in the running average
_NEWEST = 0.1


class FirstOrderState(eqx.Module):
    """The state of `FirstOrder`: with an average of the iterates and counts of steps in a row.

    `length` is None unless the solver is adaptive.
    """

    progress: Progress
    opt_state: PyTree
    average: PyTree[Array]
    # small updates, and batches that were lost
    stall: Int[Array, ""]
    lost: Int[Array, ""]
    length: PathLength | None


class FirstOrder(AbstractSmoothSolver, optx.AbstractMinimiser):
    r"""Gradient descent on the smoothed function, by any optax transformation.

    $$ y_{t+1} = \Pi\left(y_t + u_t\right), \qquad
       u_t = \text{optax}\left(\hat\nabla F_{\sigma_t}(y_t)\right), $$

    $\Pi$ is the projection onto the bounds. Each step takes one batch of `num_samples` evaluations,
    for the gradient, the value and its standard error. The point returned is the best of these: the
    lowest that was evaluated, the last iterate, the running average of about the last ten (best
    where noise makes the iterates wander), the iterate of lowest estimate, and the start.

    Args:
        optim: an optax transformation, such as `optax.adam(0.1)`. It may ask for `value` and
            `grad`, but not for the function itself, as line searches do.
        sigma: the smoothing width in the units of the parameters: a number, a pytree like the
            parameters (None in a leaf: not smoothed, differentiated by AD), or an optax schedule,
            a function from the number of the step to a number.
        adaptive: whether sigma, a schedule's as well, and the updates are multiplied by one number,
            which begins at one, and in each step by $e^{c l / 2}$, where l is
            $\|p\|^2 / n - 1.2$, but from -1 to 1. The path
            $p \leftarrow (1 - c) p + \sqrt{c (2 - c)} \, d$ adds up the directions d of gradients,
            in sigmas and as long as $\sqrt n$, over about n evaluations: c is `num_samples` / n, at
            most 0.1. Where they agree it is longer than where they are random, and steps grow, up
            to a thousand times; within bounds until sigma is a fifth of the least range. Where they
            oscillate or are noise, steps shrink, to a millionth at most. Directions that lead out
            of the bounds do not count. Steps grow where the gradient is zero, as with the baseline
            "mean" on a plateau; after a step that has failed they are half as long.
        num_samples: evaluations a step. The default is small: many rough steps beat few good ones
            at the same number of evaluations.
        sampler: where to sample.
        baseline: what to subtract, as for `smooth`.
        batch_size: evaluate at most so many samples at a time, as for `smooth`.
        nonfinite: "propagate" or "drop" samples that are NaN or infinite, as for `smooth`. A step
            that has lost more than half of its samples changes nothing, and the next one draws
            others; the sixth in a row ends the run.
        rtol: relative tolerance. The run has converged when five updates in a row are below
            `atol + rtol * norm(y)`.
        atol: absolute tolerance. By default both are zero, and the run uses up its budget.
        norm: the norm of updates and iterates.

    Raises:
        TypeError: an `optim` that is no optax transformation; when it runs, one that asks for the
            function itself.
        ValueError: when it runs, what `smooth` refuses: a sigma, a number of samples or a baseline
            that does not go with the parameters.

    Example:
        >>> import jax, jax.numpy as jnp, optax, optimistix as optx, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(4 * jnp.abs(y - 1)))
        >>> solver = sd.FirstOrder(optax.adam(0.05), optax.linear_schedule(0.5, 0.1, 200))
        >>> solution = optx.minimise(
        ...     plateaus, solver, jnp.zeros(2), options={"key": jax.random.key(0)}, throw=False
        ... )
        >>> [round(float(y)) for y in solution.value]
        [1, 1]

    Source: Plateau-reduced Differentiable Path Tracing (Fischer and Ritschel), which uses Adam.
    `adaptive`: cumulative step-size adaptation (Hansen and Ostermeier 2001), here of the directions
    of sampled gradients, whatever `optim` makes of them.
    """

    optim: optax.GradientTransformation
    sigma: PyTree
    _: KW_ONLY
    adaptive: bool = False
    num_samples: int = 8
    sampler: AbstractSampler = Gaussian(antithetic=True)
    baseline: str | AbstractBaseline = "mean"
    batch_size: int | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def __check_init__(self):
        check_settings(self)
        check_optax(self.optim, "optim")

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One batch."""
        return self.num_samples

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the start, the last iterate, the average and the best estimate."""
        return judging(self.num_samples, new=4)

    def _scaled(self, y, state, options) -> tuple[Params, Array | None, PyTree]:
        """The parameters with the sigma of a step, what that is multiplied by, and the product."""
        sigma = sigma_at(self.sigma, state.progress.step)
        params = take_apart(y, sigma, read_options(options)[1])
        if state.length is None:
            return params, None, sigma
        scale = state.length.within(params)
        with promotion():
            return params, scale, jax.tree.map(lambda s: s * scale, sigma)

    def _estimator(self, fn, args, step, options, sigma: PyTree) -> Callable:
        """`y -> value, (stderr, seen)`, differentiable, with the key of a step."""
        key, bounds = read_options(options)

        def estimate(y):
            # one pair or frame alone has no standard error, but it does have a gradient
            points = self.num_samples - as_baseline(self.baseline).evaluations()
            size = take_apart(y, sigma, bounds).theta.size
            spread = points > self.sampler.group(points, size)
            smoothed = smooth(
                watched(fn, args),
                sigma,
                num_samples=self.num_samples,
                sampler=self.sampler,
                baseline=self.baseline,
                bounds=bounds,
                batch_size=self.batch_size,
                nonfinite=self.nonfinite,
                has_aux=True,
                stderr=spread,
            )
            out = smoothed(jax.random.fold_in(key, step), y)
            (fun, seen), stderr = out if spread else (out, jnp.full_like(out[0], jnp.nan))
            return fun, (stderr, seen.lowest())

        return estimate

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> FirstOrderState:
        """Checks what can be looked at; evaluates nothing."""
        _, bounds = read_options(options)
        step = jnp.asarray(0, jnp.int32)
        params = take_apart(y, sigma_at(self.sigma, step), bounds)
        length = PathLength.start(params) if self.adaptive else None
        progress = Progress.start(y, f_struct.dtype)
        return FirstOrderState(progress, self.optim.init(y), y, step, step, length)

    def step(self, fn, y, args, options, state: FirstOrderState, tags):
        """One batch, one update."""
        progress = state.progress
        args = in_step(args, options, progress.step)
        params, scale, sigma = self._scaled(y, state, options)
        estimate = self._estimator(fn, args, progress.step, options, sigma)
        (fun, (stderr, seen)), grad = jax.value_and_grad(estimate, has_aux=True)(y)
        with promotion():
            updates, opt_state = updated(self.optim, grad, state.opt_state, y, value=fun)
            if scale is not None:
                updates = steps_scaled(updates, params, scale)
            new_y = optax.apply_updates(y, updates)
        new_y = project(new_y, read_options(options)[1])
        share = jnp.maximum(_NEWEST, 1 / (progress.step + 1).astype(fun.dtype))
        average = jax.tree.map(
            lambda a, new: a + share.astype(a.dtype) * (new - a), state.average, new_y
        )
        small = is_small(self, jax.tree.map(jnp.subtract, new_y, y), y)
        stall = jnp.where(small, state.stall + 1, 0)
        finite = all_finite((fun, grad, new_y))
        length = after = None
        if state.length is not None:
            length, after = (
                state.length.after(params, grad, self.num_samples),
                state.length.failed(),
            )
        new_y, opt_state, average, length = where(
            finite,
            (new_y, opt_state, average, length),
            (y, state.opt_state, state.average, after),
        )
        lost = jnp.where(finite, 0, state.lost + 1)
        stall = jnp.where(finite, stall, state.stall)
        again = (lost <= _TRIES) if self.nonfinite == "drop" else finite
        progress = progress.after(y, fun, stderr, sigma, self.num_samples, finite | again, seen)
        # the function was never evaluated at y itself, so its aux is that of a sample near y
        return new_y, FirstOrderState(progress, opt_state, average, stall, lost, length), seen.aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After small updates in a row, or a failed step."""
        return stopped(state.progress, state.stall >= _PATIENCE)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges all that was seen, the start, the last iterate, the average, the best estimate."""
        progress = state.progress
        numbers = in_step(args, options, progress.step)
        *_, sigma = self._scaled(y, state, options)
        estimate = self._estimator(fn, numbers, progress.step, options, sigma)

        def smoothed(y):
            fun, (stderr, seen) = estimate(y)
            return fun, stderr, seen

        values = one_by_one(fn, args, options, self.batch_size)
        # the mean of points at a bound may be beyond it, by rounding
        average = project(state.average, read_options(options)[1])
        last = (average, y) if values.takes_key else (y, average)
        new = *last, progress.best_y, progress.start_y
        y, stats = judged(progress, values, smoothed, self.num_samples, new)
        return y, aux, stats
