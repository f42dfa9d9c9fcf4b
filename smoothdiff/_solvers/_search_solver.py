"""A solver that searches: point by point with few parameters, by batches with many."""

from types import ModuleType
from typing import Any, ClassVar

import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._solvers._base import AbstractSmoothSolver, stopped
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._judgement import by_rows, judging
from smoothdiff._solvers._point_by_point import PointStep


class AbstractSearchSolver(AbstractSmoothSolver):
    """What `GaussNewton` and `NewtonCG` share; by batches where there are no `sizes`.

    The `squares` of what the function returns are minimised, or itself. `_batches` has the steps
    of batches. So many `_candidates` of a search are judged beside the best point.
    """

    squares: ClassVar[bool]
    _batches: ClassVar[ModuleType]
    _candidates: ClassVar[int]

    def _evaluator(self, fn: Any, args: PyTree, y: PyTree[Array]) -> Evaluator:
        """The function as the loop point by point calls it."""
        return Evaluator(fn, args, layout_of(y), self.squares, None)

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One, or `num_samples`; with many parameters a batch, and the steps that are tried."""
        sizes = self.sizes(y)
        return sizes.step if sizes else self._batches.evaluations_per_step(self, y)

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the best point, candidates of the search, with noise the start as well.

        With a key there are up to three candidates in three rounds, which are fewer.
        """
        if self.sizes(y):
            return judging(0, new=self._candidates, old=1)
        return self._batches.final_evaluations(self, y)

    def step(self, fn, y, args, options, state, tags):
        """The next evaluations."""
        sizes = self.sizes(y)
        if sizes is None:
            return self._batches.step(self, fn, y, args, options, state)
        parts = PointStep(self, sizes, y, options, state)
        return parts.step(self._evaluator(fn, parts.numbers(args), y))

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Where the last search leads nowhere any more, or after a failed step."""
        sizes = self.sizes(y)
        if sizes is None:
            return stopped(state.progress, self._batches.over(self, state))
        search = state.search
        converged = search.converged()
        over = (state.restarts == 0) & (converged | search.over(sizes)) & search.looked()
        return stopped(state.progress, over, converged)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges the best point, with noise beside others."""
        sizes = self.sizes(y)
        if sizes is None:
            y, stats = self._batches.judge(self, fn, y, args, options, state)
            return y, aux, stats
        parts = PointStep(self, sizes, y, options, state)
        y, stats = parts.judge(by_rows(self._evaluator(fn, args, y), options))
        return y, state.aux, stats
