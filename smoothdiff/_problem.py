"""What the steps of a run have in common: the function, the solver and its methods, compiled."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._solvers import Progress
from smoothdiff._solvers._evaluator import called


class Trial(NamedTuple):
    """The function at the lowest point once more, and whether it is another value."""

    fun: Float[np.ndarray, " 1"]
    noisy: bool


class Function(eqx.Module):
    """The user's function as optimistix calls it."""

    fun: Callable[[PyTree, PyTree], Any]

    def __call__(self, y: PyTree, args: PyTree) -> tuple[PyTree[Array], None]:
        return called(self.fun, y, args), None


# no module: a call of a module's method makes a module, which takes a twentieth of a millisecond
@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """What the steps have in common; its methods are the solver's, compiled."""

    fun: Callable[[PyTree, PyTree], Any]
    solver: Any
    args: PyTree
    options: dict[str, Any]

    def value(self, y: PyTree) -> PyTree[Array]:
        """What the function returns."""
        return _value(Function(self.fun), y, self.args)

    def place(self) -> contextlib.AbstractContextManager:
        """Within this context new arrays are where the steps are."""
        return contextlib.nullcontext()

    def here(self, y: PyTree[Array]) -> PyTree[Array]:
        """Parameters where the steps are."""
        return y

    def begin(self, y: PyTree, check: Callable[[PyTree], None]) -> tuple["Problem", Any]:
        """What the steps are taken with, and the first state.

        `check` raises for a structure of what the function returns that is refused. Nothing is
        compiled, so that the solver can look at values and refuse them too.
        """
        out = jax.eval_shape(self.value, y)
        check(out)
        rest = self.args, self.options, out, None, frozenset()
        state = self.solver.init(Function(self.fun), y, *rest)
        # weak types would compile the second step anew
        return self, jax.tree.map(lambda a: jnp.asarray(a, a.dtype), state)

    def knowing(self, out: PyTree, y: PyTree, state: Any) -> tuple["Problem", Any]:
        """The problem and its first state, once an evaluation at y, which counts, returned that."""
        count = state.progress.evaluations + 1
        return self, eqx.tree_at(lambda s: s.progress.evaluations, state, count)

    def uncounted(self, progress: Progress) -> int:
        """Evaluations that were made and are not among those of the state."""
        return 0

    def reason(self, state: Any) -> str:
        """One word for why it stops here, where `done` said so."""
        return self.solver.reason(state)

    def resumed(self, state: Any) -> None:
        """Told of the state of a run that is taken up."""

    def stage(self, state: Any) -> int:
        """Which of the steps comes next that are compiled each by itself."""
        return 0

    def step(self, y: PyTree, state: Any) -> tuple[PyTree, Any, Bool[Array, ""]]:
        """The next iterate and state, and whether the solver wants to stop there."""
        return _step(self._parts(), y, state)

    def done(self, y: PyTree, state: Any) -> Bool[Array, ""]:
        """Whether the solver wants to stop before a step."""
        return _done(self._parts(), y, state)

    def spare(self, y: PyTree, state: Any) -> int:
        """Evaluations that more steps can take if a trial shows no noise."""
        return 0

    def trial(self, y: PyTree, state: Any) -> Trial:
        """Where there are some."""
        raise NotImplementedError

    def judge(
        self, y: PyTree, state: Any, trial: Trial | None = None
    ) -> tuple[PyTree, dict[str, Any]]:
        """The answer and its statistics, with what a trial showed."""
        return _judge(self._parts(), y, state)

    def _parts(self) -> "_Parts":
        return Function(self.fun), self.solver, self.args, self.options


_Parts = tuple[Function, Any, PyTree, dict[str, Any]]


@eqx.filter_jit
def _value(fn: Function, y: PyTree, args: PyTree) -> PyTree[Array]:
    return fn(y, args)[0]


@eqx.filter_jit
def _step(parts: _Parts, y: PyTree, state: Any) -> tuple[PyTree, Any, Bool[Array, ""]]:
    fn, solver, args, options = parts

    # a loop of one step, since XLA rounds the body of a loop otherwise than the bare step: this
    # gives optimistix's iterates to the last bit
    def body(carry: tuple[PyTree, Any]) -> tuple[PyTree, Any]:
        y, state = carry
        y, state, _ = solver.step(fn, y, args, options, state, frozenset())
        return y, state

    before = state.progress.step
    y, state = jax.lax.while_loop(lambda c: c[1].progress.step == before, body, (y, state))
    return y, state, _over(parts, y, state)


def _over(parts: _Parts, y: PyTree, state: Any) -> Bool[Array, ""]:
    fn, solver, args, options = parts
    return solver.terminate(fn, y, args, options, state, frozenset())[0]


_done = eqx.filter_jit(_over)


@eqx.filter_jit
def _judge(parts: _Parts, y: PyTree, state: Any) -> tuple[PyTree, dict[str, Any]]:
    fn, solver, args, options = parts
    rest = args, options, state, frozenset(), optx.RESULTS.successful
    y, _, stats = solver.postprocess(fn, y, None, *rest)
    return y, stats
