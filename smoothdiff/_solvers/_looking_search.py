"""Searches point by point that look further: with a pilot, and over all of the bounds."""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._params import Params
from smoothdiff._solvers._box import has_box
from smoothdiff._solvers._history import History, hardly_differ
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._ratio_test import is_lower
from smoothdiff._solvers._stages import FIRST, LOOK, PILOT, Sizes
from smoothdiff._solvers._where import where


class AbstractLookingSearch(AbstractPointSearch):
    """A search that begins anew where points that no model asked for are lower.

    A `pilot` follows first points that hardly differ, a `look` comes where little is left to do.
    """

    @abc.abstractmethod
    def widened(
        self, params: Params, theta: Float[Array, " n"], width: Float[Array, ""]
    ) -> "AbstractLookingSearch":
        """The same search before its first points, so many sigmas from a point that is known."""

    @abc.abstractmethod
    def elsewhere(self, params: Params, theta: Float[Array, " n"]) -> "AbstractLookingSearch":
        """Another such search before its first points, from a point that is known."""

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
