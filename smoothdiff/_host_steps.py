"""Steps of a search point by point on the host: the function is called between compiled parts.

The parts know shapes only. So they are compiled once for all functions, keys, sigmas and budgets,
and only for those stages that a run comes to.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._flat import Flat
from smoothdiff._packed import Packed
from smoothdiff._programs import jit_quickly
from smoothdiff._solvers._base import smoothed_params
from smoothdiff._solvers._judgement import Contest
from smoothdiff._solvers._point_by_point import PointState, PointStep
from smoothdiff._solvers._stages import Sizes

# with a history of fewer numbers a step is short, and compiling it well would take longer than all
# of the steps
_SHORT = 1_000_000


class _Last:
    """The last state as it went into a program or came out of it: most go into several."""

    def __init__(self) -> None:
        self._pair: tuple[Any, Any] = None, None

    def packed(self, state: PointState) -> Packed:
        """Packed anew, unless it is the same one."""
        known, packed = self._pair
        if known is not state:
            packed = Packed.of(state)
            self._pair = state, packed
        return packed

    def tree(self, packed: Packed) -> PointState:
        """The state, of which this is then known; its scalars are NumPy's, on no device."""
        packed = packed.on_host()
        state = packed.tree()
        self._pair = state, packed
        return state


# a call of a module's method makes a module, which takes a twentieth of a millisecond
@dataclasses.dataclass(frozen=True, eq=False)
class HostSteps:
    """A solver that steps point by point, without a function.

    In the solver and the options all that does not decide shapes is an array. The `last` state is
    packed once for all programs.
    """

    solver: Any
    options: dict[str, Any]
    sizes: Sizes
    last: _Last = dataclasses.field(default_factory=_Last, init=False)

    @staticmethod
    def of(solver: Any, options: dict[str, Any], y: PyTree[Array]) -> "HostSteps":
        """For parameters like `y`.

        Raises:
            ValueError: a sigma, bounds or options that cannot work.
        """
        smoothed_params(solver, y, jnp.asarray(0, jnp.int32), options)
        numbers = jax.tree.map(jnp.asarray, (solver.sigma, solver.rtol, solver.atol))
        general = eqx.tree_at(lambda s: (s.sigma, s.rtol, s.atol), solver, numbers)
        options = dict(options)
        if "bounds" in options:
            options["bounds"] = jax.tree.map(jnp.asarray, options["bounds"])
        return HostSteps(general, options, solver.sizes(y))

    def init(self, y: PyTree[Array], out: PyTree[jax.ShapeDtypeStruct]) -> PointState:
        """The first state for a function that returns this."""
        return self.last.tree(_first_state(Flat.of((self.solver, self.options, y, out))))

    def propose(
        self, y: PyTree[Array], state: PointState, count: int | None = None
    ) -> tuple[Float[Array, "K n"], Any]:
        """The points of the next step, or so many of them, and what the model says of them."""
        propose, *_ = _compiled(state)
        return propose(self._at(y, state), self._sizes(count), int(state.search.stage))

    def told(
        self,
        y: PyTree[Array],
        state: PointState,
        points: Float[Array, "K n"],
        rows: Float[Array, "K P"],
        proposal: Any,
    ) -> tuple[PyTree, PointState, Bool[Array, ""]]:
        """The next iterate and state, and whether the solver wants to stop there."""
        step, sizes = self._at(y, state), self._sizes(len(points))
        _, searched, counted = _compiled(state)
        after = searched(step, points, rows, proposal, sizes, int(state.search.stage))
        new_y, packed, over = counted(step, points, rows, after, sizes)
        return new_y, self.last.tree(packed), over

    def over(self, y: PyTree[Array], state: PointState) -> Bool[Array, ""]:
        """Whether the solver wants to stop before a step."""
        return _over(self._at(y, state), self.sizes)

    def learnt(
        self,
        y: PyTree[Array],
        state: PointState,
        points: Float[Array, "K n"],
        rows: Float[Array, "K P"],
    ) -> PointState:
        """The state with evaluations that it did not propose."""
        return self.last.tree(_learnt(self._at(y, state), points, rows, self.sizes))

    def contest(self, y: PyTree[Array], state: PointState, takes_key: bool = False) -> Contest:
        """The candidates for the answer, in NumPy's arrays."""
        return jax.device_get(_contest(self._at(y, state), self.sizes, takes_key).tree())

    def decided(
        self,
        y: PyTree[Array],
        state: PointState,
        contest: Contest,
        done: int,
        found: Float[np.ndarray, " m"],
    ) -> tuple[PyTree, dict[str, Array]]:
        """The best candidate by the values of so many rounds, and the statistics of the run."""
        rest = Flat.of(contest), np.int32(done), found
        return _decided(self._at(y, state), self.sizes, *rest)

    def parts(self, y: PyTree[Array], state: PointState) -> PointStep:
        """The step, for what is not compiled."""
        return PointStep(self.solver, self.sizes, y, self.options, state)

    @functools.cached_property
    def _fixed(self) -> Packed:
        return Packed.of((self.solver, self.options))

    def _at(self, y: PyTree[Array], state: PointState) -> tuple[Packed, PyTree, Packed]:
        return self._fixed, y, self.last.packed(state)

    def __reduce__(self) -> tuple[Any, ...]:
        # the structure of a module cannot be pickled
        return HostSteps, (self.solver, self.options, self.sizes)

    def _sizes(self, count: int | None) -> Sizes:
        return self.sizes if count is None else self.sizes._replace(step=count)


@jit_quickly
def _first_state(flat: Flat) -> Packed:
    solver, options, y, out = flat.tree()
    state = solver.init(None, y, None, options, out, None, frozenset())
    # weak types would compile the second step anew
    return Packed.of(jax.tree.map(lambda a: jnp.asarray(a, a.dtype), state))


def _step_of(flat: tuple[Packed, PyTree, Packed], sizes: Sizes) -> PointStep:
    (solver, options), y, state = flat[0].tree(), flat[1], flat[2].tree()
    return PointStep(solver, sizes, y, options, state)


def _propose(flat: tuple[Packed, PyTree, Packed], sizes: Sizes, stage: int) -> tuple[Array, Any]:
    return _step_of(flat, sizes).propose(stage)


def _searched(
    flat: tuple[Packed, PyTree, Packed],
    points: Array,
    rows: Array,
    proposal: Any,
    sizes: Sizes,
    stage: int,
) -> Packed:
    return Packed.of(_step_of(flat, sizes).searched(points, rows, proposal, stage))


def _counted(
    flat: tuple[Packed, PyTree, Packed], points: Array, rows: Array, after: Packed, sizes: Sizes
) -> tuple[PyTree, Packed, Bool[Array, ""]]:
    """Also whether the solver wants to stop there."""
    step = _step_of(flat, sizes)
    y, state = step.counted(points, rows, after.tree())
    return y, Packed.of(state), dataclasses.replace(step, y=y, state=state).over()


# what is needed before and after the steps, and for what others have evaluated


@functools.partial(jit_quickly, static_argnums=1)
def _over(flat: tuple[Packed, PyTree, Packed], sizes: Sizes) -> Bool[Array, ""]:
    return _step_of(flat, sizes).over()


@functools.partial(jit_quickly, static_argnums=3)
def _learnt(
    flat: tuple[Packed, PyTree, Packed], points: Array, rows: Array, sizes: Sizes
) -> Packed:
    return Packed.of(_step_of(flat, sizes).learnt(points, rows))


@functools.partial(jit_quickly, static_argnums=(1, 2))
def _contest(flat: tuple[Packed, PyTree, Packed], sizes: Sizes, takes_key: bool) -> Flat:
    return Flat.of(_step_of(flat, sizes).contest(takes_key))


@functools.partial(jit_quickly, static_argnums=1)
def _decided(
    flat: tuple[Packed, PyTree, Packed], sizes: Sizes, contest: Flat, done: Array, found: Array
) -> tuple[PyTree, dict[str, Array]]:
    return _step_of(flat, sizes).decided(contest.tree(), done, found)


# the parts of a step, and which of their arguments are known when compiling
_PARTS = {_propose: (1, 2), _searched: (4, 5), _counted: (4,)}
_WELL = [jax.jit(part, static_argnums=known) for part, known in _PARTS.items()]
_QUICKLY = [jit_quickly(part, static_argnums=known) for part, known in _PARTS.items()]


def _compiled(state: PointState) -> list[Callable]:
    """The parts for a history of this size."""
    return _QUICKLY if state.search.history.rows.size < _SHORT else _WELL
