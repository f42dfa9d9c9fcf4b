"""A solver of optimistix that is given our steps, such as `BestSoFarMinimiser(FirstOrder(...))`."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._seen import Seen
from smoothdiff._solvers._base import AbstractSmoothSolver, Progress
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._judgement import by_rows, judged, judging

_STATS = {"fun", "smoothed", "stderr", "evaluations"}


class WrappedState(eqx.Module):
    """The state of the solver around ours, in which ours is somewhere."""

    state: PyTree

    def ours(self) -> Any:
        """The state of our solver."""
        return _only(self.state, lambda node: isinstance(getattr(node, "progress", None), Progress))

    @property
    def progress(self) -> Progress:
        """What our solver has done so far."""
        return self.ours().progress


class Wrapped(AbstractSmoothSolver):
    """Steps as the solver around ours says; budget and reasons are those of our own.

    Where its `postprocess` does not call ours, what it returns is judged beside the lowest point
    that was evaluated.
    """

    solver: Any

    def ours(self) -> AbstractSmoothSolver:
        """The solver of ours that is somewhere within the other."""
        return _only(self.solver, lambda node: isinstance(node, AbstractSmoothSolver))

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """As ours."""
        return self.ours().evaluations_per_step(y)

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """As ours, or those that judge what the other solver returns."""
        return max(self.ours().final_evaluations(y), judging(0, new=1, old=1))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> WrappedState:
        """That of the solver."""
        return WrappedState(self.solver.init(fn, y, args, options, f_struct, aux_struct, tags))

    def step(self, fn, y, args, options, state: WrappedState, tags):
        """That of the solver."""
        y, after, aux = self.solver.step(fn, y, args, options, state.state, tags)
        return y, WrappedState(after), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """That of the solver."""
        return self.solver.terminate(fn, y, args, options, state.state, tags)

    def reason(self, state: WrappedState) -> str:
        """As ours."""
        return self.ours().reason(state.ours())

    def postprocess(self, fn, y, aux, args, options, state: WrappedState, tags, result):
        """That of the solver, and a judgement if that is none."""
        rest = args, options, state.state, tags, result
        y, aux, stats = self.solver.postprocess(fn, y, aux, *rest)
        if not set(stats) >= _STATS:
            progress = state.progress
            unknown = jnp.full_like(progress.lowest_fun, jnp.nan)
            estimate = lambda y: (unknown, unknown, Seen(y, jnp.full_like(unknown, jnp.inf)))
            squares = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
            values = by_rows(Evaluator(fn, args, layout_of(y), squares, None), options)
            y, stats = judged(progress, values, estimate, 0, [y], [progress.start_y])
        return y, aux, {name: stats[name] for name in _STATS}


def wraps_ours(solver: Any) -> bool:
    """Whether one solver of ours is within another one."""
    return len(_nodes(solver, lambda node: isinstance(node, AbstractSmoothSolver))) == 1


def _only(tree: PyTree, wanted: Callable[[Any], bool]) -> Any:
    found = _nodes(tree, wanted)
    if len(found) != 1:
        raise TypeError(
            "a solver around one of smoothdiff's keeps that one's state as a part of its own state"
        )
    return found[0]


def _nodes(tree: PyTree, wanted: Callable[[Any], bool]) -> list[Any]:
    return [node for node in jax.tree.leaves(tree, is_leaf=wanted) if wanted(node)]
