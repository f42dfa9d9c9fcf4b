"""What searches have in common that evaluate a function point by point."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._averaging import Average
from smoothdiff._solvers._box import has_box
from smoothdiff._solvers._fall import Fall
from smoothdiff._solvers._first_points import FirstPoints
from smoothdiff._solvers._history import History, hardly_differ
from smoothdiff._solvers._look import Look
from smoothdiff._solvers._pilot import Pilot
from smoothdiff._solvers._ratio_test import is_lower, noticeable
from smoothdiff._solvers._stages import FIRST, LOOK, PILOT, TRUST, Sizes
from smoothdiff._solvers._where import where

# so many small steps in a row count as convergence
_SMALL = 3
# so many times as many evaluations may fail if samples come nearer to where the function is finite
_COMING = 4
# a step is nothing beside others below this share of the largest sigma
_BESIDE = 1e-3


class AbstractPointSearch(eqx.Module):
    """Where a search stands: all that was evaluated, and what comes next.

    It begins with the `first` points. Where they hardly differ, the `pilot` follows, and the first
    points again if it found something else. There may be a `look` where little is left to do; where
    it found a lower point the search begins anew. `trust` has a local model, and how far it is
    trusted.

    `evaluated` counts the evaluations, `small` the small steps in a row. The `fall` says when the
    function last fell noticeably. There is an `average` if the function takes random numbers.
    """

    stage: Int[Array, ""]
    history: History
    start: Float[Array, " n"]
    first: FirstPoints
    evaluated: Int[Array, ""]
    small: Int[Array, ""]
    fall: Fall
    pilot: Pilot
    average: Average | None
    look: Look | None
    trust: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def again(
        self,
        params: Params,
        theta: Float[Array, " n"],
        start: Float[Array, " n"],
        lowest: tuple[Float[Array, " n"], Float[Array, ""]],
        key: Array,
    ) -> Any:
        """Another search, from elsewhere, from where the run began or through the lowest point.

        It has other random numbers.
        """

    @abc.abstractmethod
    def widened(self, params: Params, theta: Float[Array, " n"], width: Float[Array, ""]) -> Any:
        """The same search before its first points, so many sigmas from a point that is known."""

    @abc.abstractmethod
    def elsewhere(self, params: Params, theta: Float[Array, " n"]) -> Any:
        """Another such search before its first points, from a point that is known."""

    def width(self) -> Float[Array, " n"]:
        """How far from the iterate the function is looked at, relative to sigma."""
        return self.first.reach * self.length()

    @abc.abstractmethod
    def length(self) -> Float[Array, "..."]:
        """The same, relative to where the first points were."""

    @abc.abstractmethod
    def propose(
        self,
        params: Params,
        draw: Callable[[int], Float[Array, "k n"]],
        sizes: Sizes,
        stage: int | None = None,
    ) -> tuple[Float[Array, "K n"], Any]:
        """The next points to evaluate, not yet within the bounds, and what the model says of them.

        `draw` makes so many samples of the round, which are standard normal. Who knows the stage
        says it, so that nothing is compiled for the others.
        """

    @abc.abstractmethod
    def after(
        self,
        params: Params,
        new: History,
        proposal: Any,
        sizes: Sizes,
        stage: int | None = None,
    ) -> Any:
        """The search with these new evaluations."""

    def settled(self) -> Bool[Array, ""]:
        """Whether a short step is a sign of convergence; the local model's may be none."""
        return ~self.is_local() | self.trust.settled

    def right(self) -> Bool[Array, ""]:
        """Whether the last point was a check, and the local model was right about it."""
        return self.is_local() & self.trust.right

    def level(self) -> Bool[Array, ""]:
        """Whether the last step promised no more than rounding, and came to that."""
        return jnp.asarray(False)

    def over(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether the search leads nowhere any more, so that another may follow.

        A mean is never so near that further rounds do not bring it nearer.
        """
        return jnp.asarray(False) if self.average is not None else self.lost(sizes)

    @abc.abstractmethod
    def lost(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether it leads nowhere any more where there is no mean."""

    @abc.abstractmethod
    def smoothing(self) -> Float[Array, ""]:
        """What smoothing adds to the function at the iterate, by the model."""

    def ignored(self) -> Bool[Array, " n"]:
        """Parameters that seem to change nothing: steps along them say nothing."""
        return jnp.zeros(self.start.shape, bool)

    def candidates(
        self, start: Float[Array, " n"], lowest: Float[Array, " n"]
    ) -> list[Float[Array, " n"]]:
        """What may be better than the lowest point, but was not evaluated; the run had that start.

        Of equals these are the answer.
        """
        return [] if self.average is None else [self.iterate()]

    @abc.abstractmethod
    def round(self) -> Int[Array, ""]:
        """Counts the rounds of samples, so that each has random numbers of its own."""

    def numbers(self) -> Int[Array, ""]:
        """Counts the keys of a function that takes one.

        The local model has a key, in which its values are compared, and each round of samples.
        """
        return self.round()

    def averaging(self) -> Any:
        """The same search, of a function that takes random numbers."""
        return dataclasses.replace(self, average=Average.start(self.start))

    def with_mean(self, average: Average) -> Any:
        """With another center in the mean."""
        return dataclasses.replace(self, average=average)

    def checking(self) -> Bool[Array, ""]:
        """Whether the next evaluation is no step, but checks the local model."""
        return self.is_local() & self.trust.check

    def checked(self) -> Any:
        """With such a check next, if the local model is next."""
        return eqx.tree_at(lambda s: s.trust.check, self, self.is_local())

    def teaches(self) -> Bool[Array, ""]:
        """Whether the next evaluation is no step, and counts as none."""
        return self.checking() | self.is_looking()

    def counted(self, small: Array, teaches: Array, last: Array, count: int) -> Any:
        """With a small step more or less, and so many evaluations; the `last` one is enough.

        What only `teaches` is no step.
        """
        small = jnp.where(small, jnp.where(teaches, self.small, self.small + 1), 0)
        small = jnp.where(last, _SMALL, small)
        counts = self.evaluated + count, small
        counted = eqx.tree_at(lambda s: (s.evaluated, s.small), self, counts)
        return counted.marked(count)

    def marked(self, count: int) -> Any:
        """With so many evaluations that may have lowered the function, also little by little."""
        fun = self.history.least()
        return dataclasses.replace(self, fall=self.fall.after(fun, noticeable(fun), count))

    def kept(self, new: History) -> Any:
        """With these evaluations in the history instead of the oldest."""
        # what is lowest by luck stays no longer than others
        history = self.history.followed_by(new, keeps_best=self.average is None)
        return eqx.tree_at(lambda s: s.history, self, history)

    def enough(self, count: int) -> Bool[Array, ""]:
        """Whether any of the last evaluations gave numbers, once there are so many.

        Where there are numbers elsewhere, more may fail, as they come nearer.
        """
        valid = self.history.evaluated()
        first = (self.stage == FIRST) & jnp.any(valid)
        # the best one stays among the oldest
        newest = min(_COMING * count, len(valid) - 1)
        return (self.evaluated < count) | jnp.any(valid[-newest:]) | first

    def at_edge(self) -> Bool[Array, ""]:
        """Whether more of the last evaluations than there are parameters had no value.

        Once or twice a step may just have gone too far, and a shorter one is all it takes.
        """
        finite = self.history.evaluated()
        known = jnp.minimum(self.evaluated, len(finite))
        return known - jnp.sum(finite, dtype=known.dtype) > len(self.start)

    def converged(self) -> Bool[Array, ""]:
        """Whether the last steps were small."""
        return self.small >= _SMALL

    def plateau(self, reach: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether the function is the same as at the best point somewhere further than that.

        Residuals are, if all of them are: sums of squares are by chance, too.
        """
        point, row, _ = self.history.best(self.start)
        away = jnp.any(jnp.abs(self.history.points - point[None]) > reach[None], axis=1)
        same = jnp.all(self.history.rows == row[None], axis=1)
        return jnp.any(self.history.valid & same & away)

    def too_near(self, steps: Float[Array, " n"]) -> Bool[Array, " n"]:
        """Parameters whose steps are nothing beside others, and change hardly anything."""
        history = self.history
        alone, here = history.alone(self.start)
        level = hardly_differ(history.rows, history.rows[here])[:, None]
        flat = jnp.any(alone & level, axis=0) & ~jnp.any(alone & ~level, axis=0)
        return flat & (steps < _BESIDE * jnp.max(steps))

    def seed(self) -> Int[Array, ""]:
        """Of the next samples: another one for each round, look, and search after one.

        Below zero for those that run beside first points, which may come several times.
        """
        look = self.look
        seed = jnp.where(self.stage == FIRST, -1 - self.evaluated, self.round())
        return seed if look is None else seed + look.seed(self.is_looking())

    def is_looking(self) -> Bool[Array, ""]:
        """Whether points anywhere come next."""
        return self.stage == LOOK

    def is_local(self) -> Bool[Array, ""]:
        """Whether a step within the trust region comes next."""
        return self.stage == TRUST

    def is_trial(self) -> Bool[Array, ""]:
        """Whether the next points may be anything, since nobody asked for them."""
        return self.is_local() | (self.stage == PILOT) | self.is_looking()

    def iterate(self) -> Float[Array, " n"]:
        """The best point; of a function that takes random numbers the mean, once there is one."""
        best, *_ = self.history.best(self.start)
        return best if self.average is None else self.average.over(best)

    def piloting(self, params: Params) -> Any:
        """With the pilot next, if the first points are over and all evaluations hardly differ."""
        rows, valid = self.history.rows, self.history.valid
        same = jnp.all(hardly_differ(rows, rows[jnp.argmax(valid)]) | ~valid)
        stage = jnp.full_like(self.stage, PILOT)
        flat = eqx.tree_at(lambda s: (s.stage, s.pilot.follows), self, (stage, self.stage))
        return where(same & (self.stage != FIRST) & self.pilot.left(params), flat, self)

    def piloted(self, params: Params, new: History) -> Any:
        """After these points of the pilot: the first points again, or what would have followed."""
        steps = (new.points - self.start[None]) / params.sigma[None]
        known, box = jnp.argmax(self.history.valid), has_box(params)
        changed = ~hardly_differ(new.rows, self.history.rows[known])
        # in a box they go on until one is lower, whatever the others are
        found = changed & (~box | (new.valid & (new.funs < self.history.funs[known])))
        pilot = self.pilot.after(steps, found, new.valid | box)
        stage = jnp.where(pilot.left(params), self.stage, pilot.follows)
        more = eqx.tree_at(lambda s: (s.stage, s.pilot), self, (stage, pilot))
        width = jnp.where(box, 1, pilot.length)
        widened = more.widened(params, self.iterate(), width)
        return where(pilot.length > 0, widened, more)

    def looking(self, params: Params, sizes: Sizes, least: Bool[Array, ""]) -> Any:
        """With a look over all of the box next, if one is due; not at the `least`.

        Or with one further on, if it may have run off.
        """
        if (look := self.look) is None:
            return self
        due = self.look_due(params, sizes) & ~look.done & ~self.is_looking()
        starts = due & ~least & ~self.is_good() & (has_box(params) | self.may_run_off(params))
        stage = jnp.where(starts, LOOK, self.stage).astype(self.stage.dtype)
        begun = look.begun(self.history.best(self.start)[2], self.stage)
        done = eqx.tree_at(lambda k: k.done, look, look.done | due | least)
        return eqx.tree_at(lambda s: (s.stage, s.look), self, (stage, where(starts, begun, done)))

    def look_due(self, params: Params, sizes: Sizes) -> Bool[Array, ""]:
        """Whether the search would end."""
        return self.converged() | self.over(sizes)

    def is_good(self) -> Bool[Array, ""]:
        """Whether the lowest point is so low that no look is needed."""
        return jnp.asarray(False)

    def may_run_off(self, params: Params) -> Bool[Array, ""]:
        """Whether it seems to have converged, and so far away that there may be no minimum."""
        return jnp.asarray(False)

    def looked(self) -> Bool[Array, ""]:
        """Whether there is no look to come before the end."""
        return jnp.asarray(True) if self.look is None else self.look.done

    def after_look(self, params: Params, count: int) -> Any:
        """After so many of its points: a new search where one is lower, or what would follow."""
        assert self.look is not None
        point, _, fun = self.history.best(self.start)
        look = self.look.more(params, count)
        stage = jnp.where(look.done, look.follows, self.stage)
        more = eqx.tree_at(lambda s: (s.stage, s.look), self, (stage, look))
        anew = dataclasses.replace(self.elsewhere(params, point), look=look.again())
        # so far from the start, what is known of the function is that of other places
        knows_little = self.may_run_off(params) & (look.found == 0)
        return where(look.done & (is_lower(fun, look.before) | knows_little), anew, more)
