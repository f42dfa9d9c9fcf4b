"""What the steps of a run have in common: the function, the solver and its methods, compiled."""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._solvers._evaluator import called


class Trial(NamedTuple):
    """The function at the lowest point once more, and whether it is another value."""

    fun: Float[Array, " 1"]
    noisy: bool


class Problem(eqx.Module):
    """What the steps have in common; its methods are the solver's, compiled."""

    fun: Callable[[PyTree, PyTree], Any]
    solver: Any
    args: PyTree
    options: dict[str, Any]

    def _fn(self, y: PyTree, args: PyTree) -> tuple[PyTree[Array], None]:
        return called(self.fun, y, args), None

    @eqx.filter_jit
    def value(self, y: PyTree) -> PyTree[Array]:
        return self._fn(y, self.args)[0]

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
        out = jax.eval_shape(lambda y: self.value(y), y)
        check(out)
        state = self.solver.init(self._fn, y, self.args, self.options, out, None, frozenset())
        # weak types would compile the second step anew
        return self, jax.tree.map(lambda a: jnp.asarray(a, a.dtype), state)

    def reason(self, state: Any) -> str:
        """One word for why it stops here, where `done` said so."""
        return self.solver.reason(state)

    def resumed(self, state: Any) -> None:
        """Told of the state of a run that is taken up."""

    def stage(self, state: Any) -> int:
        """Which of the steps comes next that are compiled each by itself."""
        return 0

    @eqx.filter_jit
    def step(self, y: PyTree, state: Any) -> tuple[PyTree, Any, Bool[Array, ""]]:
        """The next iterate and state, and whether the solver wants to stop there."""

        # a loop of one step, since XLA rounds the body of a loop otherwise than the bare step: this
        # gives optimistix's iterates to the last bit
        def body(carry: tuple[PyTree, Any]) -> tuple[PyTree, Any]:
            y, state = carry
            step = self.solver.step
            y, state, _ = step(self._fn, y, self.args, self.options, state, frozenset())
            return y, state

        before = state.progress.step
        y, state = jax.lax.while_loop(lambda c: c[1].progress.step == before, body, (y, state))
        return y, state, self._done(y, state)

    def _done(self, y: PyTree, state: Any) -> Bool[Array, ""]:
        return self.solver.terminate(self._fn, y, self.args, self.options, state, frozenset())[0]

    done = eqx.filter_jit(_done)

    def spare(self, y: PyTree, state: Any) -> int:
        """Evaluations that more steps can take if a trial shows no noise."""
        return 0

    def trial(self, y: PyTree, state: Any) -> Trial:
        """Where there are some."""
        raise NotImplementedError

    @eqx.filter_jit
    def judge(
        self, y: PyTree, state: Any, trial: Trial | None = None
    ) -> tuple[PyTree, dict[str, Any]]:
        """The answer and its statistics, with what a trial showed."""
        result = optx.RESULTS.successful
        y, _, stats = self.solver.postprocess(
            self._fn, y, None, self.args, self.options, state, frozenset(), result
        )
        return y, stats
