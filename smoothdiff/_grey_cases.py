"""Gauss-Newton case by case: what a renderer is to be given for each of many pictures.

A case is a picture whose parameters are sought, in units of sigma. Each has a search of its own,
which takes a step when it is the case's turn, from the best of these: where it was, the network's
answer, new parameters, and what came nearest of all renders so far, whichever case they were made
for. So cases help one another, and none stays in a valley that others have shown to be a wrong one.

Splitting a network where AD ends is the method of auxiliary coordinates (Carreira-Perpinan and
Wang, Distributed optimization of deeply nested systems, 2014).
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from smoothdiff._products import dot
from smoothdiff._solvers import _batch_by_batch
from smoothdiff._solvers.gauss_newton import GaussNewton


class Known(eqx.Module):
    """Of each case the best that was rendered, with its loss; and where its search stands."""

    best: Float[Array, "cases n"]
    loss: Float[Array, " cases"]
    at: Float[Array, "cases n"]
    searches: Any


class Rendered(eqx.Module):
    """The last renders, from old to new, and the parameters that they are of; NaN at first."""

    points: Float[Array, "kept n"]
    shown: Float[Array, "kept ..."]

    def after(self, points: Array, shown: Array) -> "Rendered":
        """With these in place of the oldest."""
        count = len(self.points)
        new = Rendered(points, shown)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b])[len(b) :][:count], self, new)

    def within(self, best: Float[Array, "cases n"]) -> Bool[Array, " kept"]:
        """Which did not fail, and have parameters within the range of the best ones."""
        finite = jnp.isfinite(self.shown).all(axis=tuple(range(1, self.shown.ndim)))
        return inside(self.points, best) & finite


class CaseSearches(eqx.Module):
    """The searches of all cases.

    Args:
        render: From parameters in units of sigma to a picture.
        pictures: Those of the cases.
        size: The number of parameters.
        drawn: Cases that take a step at a time.
        kept: Renders to remember; with 0 a case learns from its own alone.
        new: Whether each step also renders as many new parameters.
    """

    render: Callable[[Array], Array]
    pictures: Float[Array, "cases ..."]
    size: int = eqx.field(static=True)
    drawn: int = eqx.field(static=True)
    kept: int = eqx.field(static=True)
    new: bool = eqx.field(static=True)

    @property
    def samples(self) -> int:
        """Of a step of a search."""
        return 4 + int(3 * math.log(self.size))

    @property
    def fresh(self) -> int:
        """New parameters of each case: as many as its search has renders."""
        return self.samples + 2 if self.new else 0

    @property
    def moves(self) -> bool:
        """Whether one of these is a render that is made again with one parameter moved."""
        return self.new and self.size > 1

    @property
    def evaluations(self) -> int:
        """Renders of a round; a search also has where it was, and the network's answer."""
        return self.drawn * (self.samples + 2 + self.fresh)

    @property
    def _solver(self) -> GaussNewton:
        # by batches whatever the number of parameters, as cases step together under vmap
        return GaussNewton(1.0, num_samples=self.samples, history=2 * self.samples)

    def chosen(self, number: Int[Array, ""]) -> Int[Array, " drawn"]:
        """The cases whose turn it is in a round."""
        return (number * self.drawn + jnp.arange(self.drawn, dtype=number.dtype)) % len(
            self.pictures
        )

    @eqx.filter_jit
    def begin(self, key: Key[Array, ""], said: Float[Array, "cases n"]) -> tuple[Known, Rendered]:
        """What is known when the network has said this of the cases, and no render yet."""
        picture = jax.eval_shape(self.render, said[0])
        size = math.prod(picture.shape)
        begin = lambda x: _batch_by_batch.init(self._solver, x, {"key": key}, size)
        unknown = jnp.full(len(said), jnp.inf, said.dtype)
        nothing = (jnp.full((self.kept, *a.shape), jnp.nan, a.dtype) for a in (said[0], picture))
        return Known(said, unknown, said, jax.vmap(begin)(said)), Rendered(*nothing)

    @eqx.filter_jit
    def step(
        self,
        key: Key[Array, ""],
        said: Float[Array, "drawn n"],
        chosen: Int[Array, " drawn"],
        known: Known,
        rendered: Rendered,
        moved: Float[Array, "drawn n"],
    ) -> tuple[Known, Rendered, Float[Array, " drawn"], Float[Array, "drawn ..."]]:
        """Steps of some cases, of which the network has said this; and the losses of that.

        The first new parameters of each case are replaced by `moved`, unless that is NaN. Returned
        last: the renders of these, where there are any.
        """
        draw, *keys = jax.random.split(key, self.drawn + 1)
        # at first nothing is known, and these are all but what the untrained network says
        others = like(draw, known.best, (self.drawn, self.fresh))
        if self.moves:
            there = jnp.isfinite(moved).all(axis=1)
            others = others.at[:, 0].set(jnp.where(there[:, None], moved, others[:, 0]))
        best, loss, at, searches = (
            jax.tree.map(lambda leaf: leaf[chosen], part)
            for part in (known.best, known.loss, known.at, known.searches)
        )
        at, searches, points, shown, answered = jax.vmap(self._step)(
            jnp.stack(keys), said, others, best, loss, at, searches, self.pictures[chosen]
        )
        found, value = self._best(points, shown, chosen, known)
        flat: Callable[[Array], Array] = lambda a: a.reshape(-1, *a.shape[2:])
        known = Known(
            found,
            value,
            known.at.at[chosen].set(at),
            jax.tree.map(lambda leaf, part: leaf.at[chosen].set(part), known.searches, searches),
        )
        # where it was and the network's answer come first
        return (
            known,
            rendered.after(flat(points), flat(shown)),
            answered,
            shown[:, 2].astype(self.pictures.dtype),
        )

    @eqx.filter_jit
    def earlier(
        self, key: Key[Array, ""], known: Known, rendered: Rendered
    ) -> tuple[Float[Array, "drawn n"], Float[Array, "drawn ..."]]:
        """Some earlier renders in the range, to be made again with one parameter moved; or NaN."""
        if not self.moves:
            some = (known.best[: self.drawn], self.pictures[: self.drawn])
            return jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), some)
        # where none is within the range any will do, and at first all are NaN
        share = jnp.maximum(rendered.within(known.best).astype(known.best.dtype), 1e-9)
        number = jax.random.choice(key, len(share), (self.drawn,), p=share / jnp.sum(share))
        return rendered.points[number], rendered.shown[number].astype(self.pictures.dtype)

    def agree(self, known: Known) -> bool:
        """Whether a case that is known still has the loss that it had, but for rounding."""
        case = int(jnp.argmin(known.loss))
        again = _losses(self.render(known.best[case])[None], self.pictures[case])[0]
        before = known.loss[case]
        near = jnp.sqrt(jnp.finfo(again.dtype).eps) * jnp.mean(self.pictures[case] ** 2)
        return bool(jnp.abs(again - before) <= near)

    def _best(
        self, points: Array, shown: Array, chosen: Array, known: Known
    ) -> tuple[Float[Array, "cases n"], Float[Array, " cases"]]:
        """The best of each case and its loss, after renders of each of those that were chosen."""
        if self.kept:
            flat = points.reshape(-1, self.size)
            nearest, loss = _nearest(shown.reshape(len(flat), *shown.shape[2:]), self.pictures)
            new = flat[nearest]
        else:
            losses = jax.vmap(_losses)(shown, self.pictures[chosen])
            at = jnp.argmin(losses, axis=1)
            own = jnp.take_along_axis(points, at[:, None, None], axis=1)[:, 0]
            new = known.best.at[chosen].set(own)
            loss = jnp.full_like(known.loss, jnp.inf).at[chosen].set(jnp.min(losses, axis=1))
        better = loss < known.loss
        found = jnp.where(better[:, None], new, known.best)
        return found, jnp.where(better, loss, known.loss).astype(known.loss.dtype)

    def _step(self, key, said, others, best, loss, at, state, picture):
        """One step of one search; all that was rendered for it; the loss of the answer."""
        tried = jnp.concatenate([jnp.stack([at, said]), others])
        shown = jax.vmap(self.render)(tried)
        losses = _losses(shown, picture)
        start = jnp.append(tried, best[None], axis=0)[jnp.argmin(jnp.append(losses, loss))]
        # after a jump the search looks as far around as it has jumped
        state = state.jumped(jnp.sqrt(jnp.mean((start - at) ** 2)))
        residuals = lambda x, picture: (self.render(x) - picture, None)
        at, state, _ = _batch_by_batch.step(
            self._solver, residuals, start, picture, {"key": key}, state
        )
        points, rows, good = state.search.history.newest(self.samples)
        seen: Array = rows.reshape(-1, *picture.shape).astype(shown.dtype) + picture[None]
        seen = jnp.where(good.reshape(-1, *(1,) * picture.ndim), seen, jnp.nan)
        points, seen = jnp.append(tried, points, axis=0), jnp.append(shown, seen, axis=0)
        return at, state, points, seen, losses[1]


def usual_range(best: Float[Array, "cases n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The lowest and highest of each parameter, without a few that lie apart.

    Those may look like a picture and yet be far from all others, as an angle a full turn away.
    Among the outer twentieths the range ends where a gap is wider than a standard deviation.
    """
    return _lowest(best), -_lowest(-best)


def _lowest(best: Float[Array, "cases n"]) -> Float[Array, " n"]:
    """Above the last wide gap of the lowest twentieth."""
    outer, ordered = len(best) // 20, jnp.sort(best, axis=0)
    below, above = ordered[:outer], ordered[1 : outer + 1]
    wide = above - below > jnp.std(best, axis=0)[None]
    return jnp.max(jnp.append(ordered[:1], jnp.where(wide, above, ordered[:1]), axis=0), axis=0)


def inside(points: Float[Array, "k n"], best: Float[Array, "cases n"]) -> Bool[Array, " k"]:
    """Which are within the usual range of the best ones."""
    low, high = usual_range(best)
    return ((points >= low[None]) & (points <= high[None])).all(axis=1)


def lessons_among(known: Known, rendered: Rendered) -> Bool[Array, " cases+kept"]:
    """Which cases and which renders a network may learn from: those in the usual range.

    Without renders to share most cases have had no turn for long, and there is no range yet.
    """
    if not len(rendered.points):
        return jnp.ones(len(known.best), bool)
    return jnp.append(inside(known.best, known.best), rendered.within(known.best))


def like(
    key: Key[Array, ""], best: Float[Array, "cases n"], shape: tuple[int, int]
) -> Float[Array, "drawn fresh n"]:
    """Parameters as the best ones are spread: a kernel density estimate by Scott's rule, clipped.

    That of `jax.scipy.stats` says NaN where an entry is the same in all, as it may be at first.
    """
    which, where = jax.random.split(key)
    width = jnp.std(best, axis=0) * len(best) ** (-1 / (best.shape[1] + 4))
    points = best[jax.random.randint(which, shape, 0, len(best))]
    points += width[None, None] * jax.random.normal(where, points.shape, points.dtype)
    low, high = usual_range(best)
    return jnp.clip(points, low[None, None], high[None, None])


def _nearest(shown: Array, pictures: Array) -> tuple[Int[Array, " cases"], Float[Array, " cases"]]:
    """For each picture the number of the render that is nearest, and its loss."""
    flat, wanted = shown.reshape(len(shown), -1), pictures.reshape(len(pictures), -1)
    # nearest by products of matrices, and then exactly
    apart = jnp.sum(flat**2, axis=1)[None] - 2 * dot(wanted, flat.T)
    nearest = jnp.argmin(_finite(apart), axis=1)
    return nearest, _finite(jnp.mean((flat[nearest] - wanted) ** 2, axis=1))


def _losses(shown: Array, picture: Array) -> Float[Array, " renders"]:
    """The mean squared difference of each to a picture; what is not finite is the worst."""
    apart = (shown - picture[None]).reshape(len(shown), -1)
    return _finite(jnp.mean(apart**2, axis=1))


def _finite(losses: Array) -> Array:
    return jnp.where(jnp.isfinite(losses), losses, jnp.inf)
