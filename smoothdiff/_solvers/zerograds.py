"""ZeroGrads: gradient descent on a surrogate that is fitted to the function as it goes."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler, Gaussian
from smoothdiff._seen import watched
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    check_settings,
    is_small,
    read_options,
    sigma_at,
    smoothed_params,
    stopped,
)
from smoothdiff._solvers._descent import as_optimizer, descended
from smoothdiff._solvers._judgement import judged, judging, one_by_one
from smoothdiff._solvers._locality import Locality, check_box, inner_width, log, share
from smoothdiff._solvers._optax import check_optax
from smoothdiff._solvers._random_numbers import in_step
from smoothdiff._solvers._replay import Replay
from smoothdiff._solvers._surrogate_fit import Fit, Settings
from smoothdiff._solvers._where import where
from smoothdiff.surrogates import MLP

# so many small updates in a row count as convergence, as in FirstOrder
_PATIENCE = 5
# what the surrogate's key is made with: the number of no step
_NO_STEP = 2**31 - 1


class ZeroGradsState(eqx.Module):
    """The state of `ZeroGrads`: the surrogate's and the optimiser's, and a count of small steps."""

    progress: Progress
    fit: Fit
    opt_state: PyTree
    stall: Int[Array, ""]


class ZeroGrads(AbstractSmoothSolver, optx.AbstractMinimiser):
    r"""Gradient descent on a surrogate that learns the function near the parameters as it goes.

    $$ \phi \leftarrow \text{optax}\Big(\nabla_\phi \tfrac1N \sum_i
       \big(h_\phi(\rho_i) - f(\rho_i - \tau_i)\big)^2\Big), \qquad
       y \leftarrow \Pi\big(\text{optax}(\nabla h_\phi(y))\big), $$

    Here $\rho \sim \mathcal{N}(y, \sigma^2)$ keeps the surrogate h local, and $\tau \sim
    \mathcal{N}(0, \sigma_i^2)$ smooths the function that it sees. One batch of `num_samples`
    evaluations a step serves all updates. A batch changes the weights of the surrogate a little, so
    the gradient follows from all batches so far, and their noise averages out. The surrogate sees
    points as distances from the start in units of sigma, and values in units of their running mean
    deviation. So a run does not depend on the scale of the function. The point returned is the best
    of these: the lowest that was evaluated, the last iterate, the iterate of lowest estimate, and
    the start.

    The defaults are the paper's, except for the network, `replay` and what goes with it, the rate,
    the units, and `num_samples` in many dimensions. The paper's ablations are `inner_sigma=0`
    (NoSmooth), `surrogate=smoothdiff.surrogates.Quadratic` (NoNN) and `local=False` (NoLocal).

    Args:
        sigma: the width of the neighbourhood in which the surrogate is fitted, the paper's outer
            sigma, in the units of the parameters: a number, a pytree like the parameters, or an
            optax schedule, a function from the number of the step to a number. The paper keeps it
            at 0.33 of the domain, or 0.025 for the weights of networks and for textures. With few
            parameters let it and the rate fall, see `optimizer`: a run with a constant sigma ends
            about that far from the minimum. With many parameters keep it, as the surrogate does not
            learn fast enough to follow.
        surrogate: called as `surrogate(size, key=key)`, gives an `eqx.Module` that takes a vector
            of `size` numbers and returns one: `surrogates.MLP`, or with other settings
            `functools.partial(surrogates.MLP, width=32)`. Or a module that is already made.
        inner_sigma: the width of the smoothing kernel, likewise; by default 15 % of sigma. It may
            be zero.
        num_samples: evaluations a step. The paper has 16 or 20 where there are many parameters;
            many rough steps beat few good ones.
        surrogate_steps: updates of the surrogate for each batch: by default 10 for up to 50
            parameters, 3 beyond, as in the paper.
        replay: how many earlier batches the fit sees again. A sample's weight is the density of the
            present neighbourhood there over the density that drew it, at most one. By default 100
            batches for up to 50 parameters, none beyond, as in the paper.
        parameter_steps: updates of the parameters for each batch.
        surrogate_optimizer: an optax transformation for the surrogate's weights.
        optimizer: an optax transformation for the parameters. It may ask for `value`, `grad` and
            `value_fn`, those of the surrogate in units of the first batch's mean deviation, so line
            searches cost no evaluation. By default Adam with a rate of 5 % of sigma. Most of the
            paper's are 0.3 % to 0.5 %: slower, and closer in the end. For few parameters and n
            steps, `optax.adam(optax.linear_schedule(0.15 * s, 0.003 * s, n))` goes well with
            `sigma=optax.linear_schedule(s, 0.1 * s, n)`.
        up_to_constant: fit only the differences between the values of a batch, which are all that a
            gradient needs. By default for more than 50 parameters. For fewer, and in the paper, the
            values themselves are fitted: replayed batches need them to tell of curvature.
        local: with False the surrogate is fitted to points spread evenly over the bounds.
        log: fit the logarithm of the function, which must not be negative.
        sampler: where to sample; a point is $(\rho, \tau)$ as one.
        nonfinite: "propagate" or "drop" samples that are NaN or infinite, as for `smooth`.
        rtol: relative tolerance. The run has converged when five updates in a row are below
            `atol + rtol * norm(y)`.
        atol: absolute tolerance. By default both are zero, and the run uses up its budget.
        norm: the norm of updates and iterates.

    Raises:
        TypeError: a surrogate that cannot be called, an optimizer that is no optax transformation.
        ValueError: no steps, a negative `replay`, or one sample where differences are fitted; and,
            when it runs, a leaf without a sigma, an inner sigma that is negative or of another
            structure, a sampler with weights, `local=False` without bounds.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(4 * jnp.abs(y - 1)))
        >>> result = sd.minimise(
        ...     plateaus, jnp.zeros(2), key=jax.random.key(0), solver=sd.ZeroGrads(0.5),
        ...     max_evaluations=400,
        ... )
        >>> [round(float(y)) for y in result.y]
        [1, 1]

    Source: ZeroGrads: Learning Local Surrogates for Non-Differentiable Graphics (Fischer and
    Ritschel), algorithms 1 and 2; the settings are those of its supplement.
    """

    sigma: PyTree
    _: KW_ONLY
    surrogate: Callable[..., Any] = MLP
    inner_sigma: PyTree = None
    num_samples: int = 2
    surrogate_steps: int | None = None
    replay: int | None = None
    parameter_steps: int = 1
    surrogate_optimizer: optax.GradientTransformation = optax.adam(1e-3)
    optimizer: optax.GradientTransformation | None = None
    up_to_constant: bool | None = None
    local: bool = True
    log: bool = False
    sampler: AbstractSampler = Gaussian(antithetic=True)
    nonfinite: Literal["propagate", "drop"] = "propagate"
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def __check_init__(self):
        check_settings(self)
        check_optax(self.surrogate_optimizer, "surrogate_optimizer")
        if self.optimizer is not None:
            check_optax(self.optimizer, "optimizer")
        for name in ("surrogate_steps", "parameter_steps"):
            steps = getattr(self, name)
            if steps is not None and steps < 1:
                raise ValueError(f"{name} must be at least 1, not {steps}")
        if self.replay is not None and self.replay < 0:
            raise ValueError(f"replay must be 0 batches or more, not {self.replay}")
        if self.up_to_constant is not False and self.num_samples == 1:
            raise ValueError(
                "one sample has no differences: use num_samples=2, or up_to_constant=False"
            )
        if not callable(self.surrogate):
            raise TypeError(
                "surrogate must be a class or function to be called as surrogate(size, key=key), "
                f"such as smoothdiff.surrogates.MLP, or an eqx.Module, not {self.surrogate!r}"
            )

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One batch."""
        return self.num_samples

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the start, the last iterate and the best estimate."""
        return judging(self.num_samples, new=3)

    def _make(self, params: Params, options: dict[str, Any]) -> tuple[PyTree, PyTree]:
        """The surrogate before any fit: its weights, and the rest of it."""
        surrogate = self.surrogate
        if not isinstance(surrogate, eqx.Module):
            key = jax.random.fold_in(read_options(options)[0], _NO_STEP)
            surrogate = surrogate(params.theta.size, key=key)
        weights, rest = eqx.partition(surrogate, eqx.is_inexact_array)
        return jax.tree.map(lambda w: w.astype(params.theta.dtype), weights), rest

    def _locality(self, params: Params, y: PyTree, step, options) -> Locality:
        inner = inner_width(params, y, sigma_at(self.inner_sigma, step))
        key = jax.random.fold_in(read_options(options)[0], step)
        return Locality(
            params, inner, key, self.sampler, self.num_samples, self.nonfinite, self.local
        )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> ZeroGradsState:
        """Makes the surrogate and checks what can be looked at; evaluates nothing."""
        step = jnp.asarray(0, jnp.int32)
        params = smoothed_params(self, y, step, options)
        self._locality(params, y, step, options)
        if not self.local:
            check_box(params)
        weights, _ = self._make(params, options)
        fitting = self.surrogate_optimizer.init(weights)
        batches = 1 + self._fitting(params).replay
        replay = Replay.start(batches, self.num_samples, params.theta, f_struct.dtype)
        fit = Fit.start(weights, fitting, replay, params.theta, params.sigma, f_struct.dtype)
        opt_state = as_optimizer(self.optimizer, params).init(y)
        return ZeroGradsState(Progress.start(y, f_struct.dtype), fit, opt_state, step)

    def _fitting(self, params: Params) -> Settings:
        return Settings.default(
            params.theta.size,
            surrogate_steps=self.surrogate_steps,
            replay=self.replay,
            up_to_constant=self.up_to_constant,
        )

    def learnt(self, state: ZeroGradsState, y: PyTree[Array]) -> Callable[[PyTree], Array]:
        """The surrogate of a run, as a function of parameters like `y`, in units of the values.

        For `control_variate`, say. It stands in for the function within sigma of the last iterates
        only, and with `up_to_constant` but for a constant; with `log` it is like the logarithm.

        Args:
            state: that of a run, `optimistix.minimise(...).state`.
            y: parameters of that run; only their structure and shapes count.

        Returns:
            A differentiable function from parameters to a number.

        Raises:
            ValueError: as a run does, a leaf without a sigma.
        """
        options = {"key": jax.random.key(0)}  # of weights that the learnt ones replace
        params = smoothed_params(self, y, state.progress.step, options)
        _, rest = self._make(params, options)
        surrogate, fit = eqx.combine(state.fit.weights, rest), state.fit
        return lambda y: fit.value(surrogate, params.layout.vector(jax.tree.leaves(y)))

    def step(self, fn, y, args, options, state: ZeroGradsState, tags):
        """One batch, updates of the surrogate on it, and of the parameters on the surrogate."""
        progress = state.progress
        params = smoothed_params(self, y, progress.step, options)
        locality = self._locality(params, y, progress.step, options)
        rho, batch = locality.around(watched(fn, in_step(args, options, progress.step)))
        seen = batch.aux.lowest()
        _, rest = self._make(params, options)
        fit = state.fit.updated(
            rest,
            rho,
            log(batch.values) if self.log else batch.values,
            share(batch),
            progress.step,
            log_density=locality.log_density,
            settings=self._fitting(params),
            optimizer=self.surrogate_optimizer,
        )
        surrogate, vector = eqx.combine(fit.weights, rest), params.layout.vector
        new_y, opt_state = descended(
            lambda y: fit.height(surrogate, vector(jax.tree.leaves(y))),
            y,
            state.opt_state,
            as_optimizer(self.optimizer, params),
            read_options(options)[1],
            length=self.parameter_steps,
        )
        small = is_small(self, jax.tree.map(jnp.subtract, new_y, y), y)
        stall = jnp.where(small, state.stall + 1, 0)
        finite = all_finite((fit.weights, fit.spread, new_y))
        new, old = (new_y, fit, opt_state), (y, state.fit, state.opt_state)
        new_y, fit, opt_state = where(finite, new, old)
        fun, stderr = locality.mean(batch)
        sigma = sigma_at(self.sigma, progress.step)
        progress = progress.after(y, fun, stderr, sigma, self.num_samples, finite, seen)
        # the function was never evaluated at y itself, so its aux is that of a sample near y
        return new_y, ZeroGradsState(progress, fit, opt_state, stall), seen.aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After small updates in a row, or a failed step."""
        return stopped(state.progress, state.stall >= _PATIENCE)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges all that was seen, the start, the last iterate and the best estimate.

        What is smoothed around the winner is smoothed by the inner kernel alone.
        """
        progress = state.progress

        def estimate(y):
            params = smoothed_params(self, y, progress.step, options)
            locality = self._locality(params, y, progress.step, options)
            batch = locality.smoothed(watched(fn, in_step(args, options, progress.step)))
            return (*locality.mean(batch), batch.aux.lowest())

        new = y, progress.best_y, progress.start_y
        values, batch = one_by_one(fn, args, options, None), self.num_samples
        y, stats = judged(progress, values, estimate, batch, new)
        return y, aux, stats
