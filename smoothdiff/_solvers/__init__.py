"""Solvers: optimistix's interface, and what `sd.minimise` needs beyond it.

A solver is an `AbstractSmoothSolver` and one of optimistix's abstract solvers, so that the same
object runs inside `optimistix.minimise(fun, solver, y0, options={"key": key})` and, with the same
iterates, one step at a time under `smoothdiff.minimise`. What has `sizes(y)` steps point by point:
the host then calls the function between compiled parts (`_host_steps`), and iterates are the same
but for rounding. What both rely on:

* The options are `"key"` and, optionally, `"bounds"` (`read_options`). The random numbers of a step
  come from the key, folded with counters of the state, and from nothing else.
* The state is an `eqx.Module` of arrays, of the same shapes and dtypes at every step, with a field
  `progress: Progress`. No typed keys, Python numbers or operators are in it.
* With the option `"takes_key"` args is a pair (args, key), and the function sees another key in
  each step and in each round of the judgement (`_random_numbers`).
* `init` evaluates nothing. `sd.minimise` calls it with concrete values: it refuses bad ones.
* `step` makes at most `evaluations_per_step(y)` evaluations and counts them in its progress. When
  the estimate or the new iterate is not finite, it returns the old iterate and a progress whose
  `finite` is False.
* `terminate` depends on the state alone, and with `finite` False gives `RESULTS.nonfinite`;
  `reason(state)` says in a word why it asked to stop.
* `postprocess` makes at most `final_evaluations(y)` evaluations, to judge its candidates beside the
  lowest point that was evaluated, for which the points of a step go to `Progress.after` (`judged`).
  It returns the statistics `fun`, the function at the winner, `smoothed` and `stderr`, from a batch
  around it, and `evaluations`, those of the whole run.
"""

from smoothdiff._solvers._base import AbstractSmoothSolver, Progress
from smoothdiff._solvers.first_order import FirstOrder
from smoothdiff._solvers.gauss_newton import GaussNewton
from smoothdiff._solvers.local_cross_entropy import LocalCrossEntropy
from smoothdiff._solvers.local_gauss_newton import LocalGaussNewton
from smoothdiff._solvers.newton_cg import NewtonCG
from smoothdiff._solvers.zerograds import ZeroGrads

__all__ = [
    "AbstractSmoothSolver",
    "FirstOrder",
    "GaussNewton",
    "LocalCrossEntropy",
    "LocalGaussNewton",
    "NewtonCG",
    "Progress",
    "ZeroGrads",
]
