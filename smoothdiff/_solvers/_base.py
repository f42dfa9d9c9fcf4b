"""What the solvers share: progress that a host loop can read, and options."""

import abc
import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._numbers import check_whole
from smoothdiff._params import Params, as_key, take_apart
from smoothdiff._seen import Seen
from smoothdiff._solvers._stages import Sizes
from smoothdiff._solvers._where import where

# optax and norms mix dtypes (Adam raises a float to an integer), whatever the user's setting
promotion = partial(jax.numpy_dtype_promotion, "standard")


class Progress(eqx.Module):
    """What a solver has done so far, in arrays only, as the field `progress` of its state.

    `smoothed`, `stderr` and `sigma` belong to the last batch, NaN where a step makes no estimate of
    the smoothed function. `best_*` is the lowest estimate so far: lowest by luck as much as by
    merit, hence a candidate and no answer. `lowest_*` is the point of all that were evaluated at
    which the function itself was lowest, and `start_y` where the run began. `finite` turns False
    when a step failed; the iterate is then the one from before that step. `overflowed` says that a
    sum of squares of the last step was infinite, and not NaN.
    """

    step: Int[Array, ""]
    evaluations: Int[Array, ""]
    smoothed: Float[Array, ""]
    stderr: Float[Array, ""]
    sigma: Float[Array, ""]
    finite: Bool[Array, ""]
    overflowed: Bool[Array, ""]
    best_y: PyTree[Array]
    best_smoothed: Float[Array, ""]
    lowest_y: PyTree[Array]
    lowest_fun: Float[Array, ""]
    start_y: PyTree[Array]

    @staticmethod
    def start(y: PyTree[Array], dtype: Any) -> "Progress":
        """Nothing done yet: any estimate is better than infinity."""
        unknown = jnp.asarray(jnp.inf, dtype)
        count = jnp.asarray(0, jnp.int32)
        good = jnp.asarray(True)
        return Progress(
            step=count,
            evaluations=count,
            smoothed=unknown,
            stderr=unknown,
            sigma=unknown,
            finite=good,
            overflowed=~good,
            best_y=y,
            best_smoothed=unknown,
            lowest_y=y,
            lowest_fun=unknown,
            start_y=y,
        )

    def at_start(self) -> Bool[Array, ""]:
        """Whether the lowest point is the start."""
        same = jax.tree.map(lambda a, b: jnp.all(a == b), self.lowest_y, self.start_y)
        return jnp.all(jnp.stack(jax.tree.leaves(same)))

    def after(
        self,
        y: PyTree[Array],
        smoothed: Float[Array, ""],
        stderr: Float[Array, ""],
        sigma: PyTree,
        evaluations: int | Int[Array, ""],
        finite: Bool[Array, ""],
        seen: Seen,
        overflowed: Bool[Array, ""] | bool = False,
    ) -> "Progress":
        """The progress after one more step, which estimated the smoothed function at `y`.

        `seen` is the lowest of all that it evaluated, whether it failed or not.
        """
        dtype = self.smoothed.dtype
        smoothed, stderr = smoothed.astype(dtype), stderr.astype(dtype)
        widths = [jnp.max(jnp.asarray(s)).astype(dtype) for s in jax.tree.leaves(sigma)]
        better, best = finite & (smoothed < self.best_smoothed), (self.best_y, self.best_smoothed)
        best_y, best_smoothed = where(better, (y, smoothed), best)
        # of equals the last: on a plateau that is further from where the run came in. But the start
        # stays until something is lower: a function may be constant
        equal = (seen.value == self.lowest_fun) & ~self.at_start()
        lower = jnp.isfinite(seen.value) & ((seen.value < self.lowest_fun) | equal)
        there, before = (seen.point, seen.value.astype(dtype)), (self.lowest_y, self.lowest_fun)
        lowest_y, lowest_fun = where(lower, there, before)
        return Progress(
            step=self.step + 1,
            evaluations=self.evaluations + evaluations,
            smoothed=smoothed,
            stderr=stderr,
            sigma=jnp.max(jnp.stack(widths)),
            finite=finite,
            overflowed=jnp.asarray(overflowed),
            best_y=best_y,
            best_smoothed=best_smoothed,
            lowest_y=lowest_y,
            lowest_fun=lowest_fun,
            start_y=self.start_y,
        )


def stopped(
    progress: Progress, enough: Bool[Array, ""], converged: Bool[Array, ""] | None = None
) -> tuple[Bool[Array, ""], optx.RESULTS]:
    """What `terminate` returns: the run is over after a failed step, or when it is `enough`.

    What is enough has stagnated unless it `converged`, as it has where that is not given.
    """
    well: Any = optx.RESULTS.successful
    if converged is not None:
        stagnation: Any = optx.RESULTS.stagnation
        # optimistix goes on only while all is well
        well = optx.RESULTS.where(converged | ~enough, well, stagnation)
    result = optx.RESULTS.where(progress.finite, well, optx.RESULTS.nonfinite)
    return enough | ~progress.finite, result


def is_small(solver: Any, move: PyTree[Array], y: PyTree[Array]) -> Bool[Array, ""]:
    """Whether a step, or how wide one samples, is within the solver's tolerance at `y`."""
    with promotion():
        return solver.norm(move) < solver.atol + solver.rtol * solver.norm(y)


def check_settings(solver: Any) -> None:
    """Raises TypeError or ValueError unless those settings hold that several solvers have."""
    for field in dataclasses.fields(solver):
        value = getattr(solver, field.name)
        if field.type is int or (field.type == int | None and value is not None):
            check_whole(value, field.name)
    count, nonfinite = solver.num_samples, solver.nonfinite
    if count is not None and count < 1:
        raise ValueError(f"num_samples={count}: a step needs at least one evaluation")
    if nonfinite not in ("propagate", "drop"):
        raise ValueError(f'nonfinite must be "propagate" or "drop", not {nonfinite!r}')
    if getattr(solver, "patience", None) is not None and solver.patience < 1:
        raise ValueError(f"patience must be 1 or more: {solver.patience}")
    if getattr(solver, "restarts", 0) < 0:
        raise ValueError(f"restarts must be 0 or more: {solver.restarts}")


class AbstractSmoothSolver(eqx.Module):
    """What a solver adds to optimistix's interface, so that `sd.minimise` can run it.

    The package's docstring states the whole contract.
    """

    @abc.abstractmethod
    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """The most evaluations of the function that one `step` makes."""

    @abc.abstractmethod
    def final_evaluations(self, y: PyTree[Array]) -> int:
        """The most evaluations of the function that `postprocess` makes."""

    def sizes(self, y: PyTree[Array]) -> Sizes | None:
        """Those of a search point by point, or None where each step takes a batch."""
        return None

    def reason(self, state: Any) -> str:
        """One word for why `terminate` asked to stop; called on the host, with a concrete state."""
        return "converged"


def write_options(
    key: Any, bounds: tuple[PyTree, PyTree] | None, takes_key: bool
) -> dict[str, Any]:
    """The options of a solver, without those that are not used."""
    options = {"key": key, "bounds": bounds, "takes_key": takes_key or None}
    return {name: option for name, option in options.items() if option is not None}


def read_options(options: dict[str, Any]) -> tuple[Array, tuple[PyTree, PyTree] | None]:
    """The key and the bounds (or None) from the options of a solver."""
    unknown = set(options) - {"key", "bounds", "takes_key"}
    if unknown:
        raise ValueError(
            f'options has unknown entries {sorted(unknown)}: use "key", "bounds" and "takes_key"'
        )
    if options.get("key") is None:
        raise ValueError(
            "the solver draws random samples and needs a key: pass "
            'options={"key": jax.random.key(0)} to optimistix, or key= to sd.minimise'
        )
    return as_key(options["key"]), options.get("bounds")


def sigma_at(sigma: PyTree, step: Int[Array, ""]) -> PyTree:
    """The smoothing width of a step: an optax schedule is asked, anything else is what it is."""
    with promotion():
        return sigma(step) if callable(sigma) else sigma


def smoothed_params(
    solver: Any, y: PyTree[Array], step: Int[Array, ""], options: dict[str, Any]
) -> Params:
    """The parameters with the solver's sigma at a step.

    Raises:
        ValueError: a leaf without a sigma.
    """
    params = take_apart(y, sigma_at(solver.sigma, step), read_options(options)[1])
    if params.free:
        raise ValueError(
            f"{type(solver).__name__} needs a sigma for every leaf of the parameters, not None: it "
            "has no other derivatives"
        )
    return params


def project(y: PyTree[Array], bounds: tuple[PyTree, PyTree] | None) -> PyTree[Array]:
    """The point within the bounds that is nearest to `y`; a side that is None is open."""
    if bounds is None:
        return y
    leaves, treedef = jax.tree.flatten(y)
    for side, limit in zip(bounds, (jnp.maximum, jnp.minimum), strict=True):
        full = jax.tree.broadcast(side, y, is_leaf=lambda b: b is None)
        sides = treedef.flatten_up_to(full)
        leaves = [
            leaf if b is None else limit(leaf, jnp.broadcast_to(b, leaf.shape).astype(leaf.dtype))
            for leaf, b in zip(leaves, sides, strict=True)
        ]
    return treedef.unflatten(leaves)


def all_finite(tree: PyTree[Array]) -> Bool[Array, ""]:
    """Whether there is no NaN and no infinity in any leaf."""
    return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]).all()
