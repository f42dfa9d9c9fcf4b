"""A global search along one parameter after the other, for functions whose parameters act alone.

Along each parameter, from bound to bound, the function is evaluated where a parabola through two
neighbours would need the least curvature to be lower than all that is known (STEP: Langerman,
Seront and Bersini, 1994). A short try comes first, of two parameters: if the function does not
change at two places together by the sum of what it changed at each, parameters do not act alone,
and the scan ends there.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._box import has_box
from smoothdiff._solvers._where import where

# evaluations along a parameter: in the try of the first parameters, in a first scan, and the most
_TRY, _FIRST, _MOST = 16, 50, 200
_TRIED = 2
# a place is to be lower than the lowest by this share of how far the median is above that
_LOWER = 0.01
# how far the change at both places may be from the sum of the two, relative to the smaller one
_OFF = 0.1


class Scan(eqx.Module):
    """Evaluations along a parameter through `base`: `taken` of `limit`, `funs` at `places`.

    `found` has the best places of the parameters before and `nearest` how far from there the next
    evaluation was, `line` is the next parameter. `mixed` has a place of each for the test of a try;
    `change` is the sum of what the function changed there, one by one, and `least` the smallest of
    these. In a `tried` scan all parameters follow; `tests` says that the test comes next.
    """

    base: Float[Array, " n"]
    fun: Float[Array, ""]
    line: Int[Array, ""]
    limit: Int[Array, ""]
    places: Float[Array, " m"]
    funs: Float[Array, " m"]
    taken: Int[Array, ""]
    found: Float[Array, " n"]
    nearest: Float[Array, " n"]
    mixed: Float[Array, " n"]
    change: Float[Array, ""]
    least: Float[Array, ""]
    tried: Bool[Array, ""]
    tests: Bool[Array, ""]
    failed: Bool[Array, ""]

    @staticmethod
    def start(base: Float[Array, " n"], fun: Float[Array, ""], steps: Float[Array, " n"]) -> "Scan":
        """Before the try, with the function at `base`; found are so far these `steps`."""
        none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
        empty = jnp.full(_MOST, jnp.inf, base.dtype)
        still, limit = jnp.zeros_like(fun), jnp.full_like(none, _TRY)
        huge = still + jnp.inf
        return Scan(
            base, fun, none, limit, empty, empty, none, base, steps, base, still, huge, no, no, no
        )

    def again(self, base: Float[Array, " n"], fun: Float[Array, ""]) -> "Scan":
        """A scan through another point, of twice as many evaluations, or the first after a try."""
        limit = jnp.where(self.tried, 2 * self.limit, _FIRST).astype(self.limit.dtype)
        anew = Scan.start(base, fun, self.nearest)
        changed = limit, jnp.asarray(True), limit > _MOST
        return eqx.tree_at(lambda s: (s.limit, s.tried, s.failed), anew, changed)

    def next(
        self, params: Params, base: Float[Array, " n"], fun: Float[Array, ""]
    ) -> tuple["Scan", Bool[Array, ""]]:
        """The try if there was none, or a longer scan after one; and whether there is any."""
        done, made = self.done(), self.made()
        first, longer = Scan.start(base, fun, params.sigma), self.again(base, fun)
        scan = where(made, where(done, longer, self), first)
        return scan, ~scan.failed & has_box(params)

    def propose(
        self, low: Float[Array, " n"], high: Float[Array, " n"], count: int
    ) -> Float[Array, "K n"]:
        """So many points along the parameter, its bounds first, or the point of the test."""
        n = len(self.base)
        at = jnp.minimum(self.line, n - 1)
        slot = self.taken + jnp.arange(count, dtype=self.taken.dtype)
        places = jnp.where(slot == 0, low[at], high[at])
        places = jnp.where(slot < 2, places, self._easiest(count))
        line = jnp.broadcast_to(self.base, (count, n)).at[:, at].set(places)
        return jnp.where(self.tests, self.mixed[None], line)

    def _easiest(self, count: int) -> Float[Array, " K"]:
        """The middles of the intervals that need the least curvature."""
        places, funs = self._known()
        order = jnp.argsort(places)
        places, funs = places[order], funs[order]
        known = jnp.isfinite(funs)
        lowest = jnp.min(funs)
        middle = jnp.nanmedian(jnp.where(known, funs, jnp.nan))
        eps = jnp.finfo(funs.dtype).eps * jnp.maximum(jnp.abs(lowest), 1)
        above = jnp.sqrt(funs - lowest + _LOWER * (middle - lowest) + eps)
        length = places[1:] - places[:-1]
        # the root of the inverse of the curvature
        ease = jnp.where(known[1:] & known[:-1], length / (above[1:] + above[:-1]), 0)
        _, best = jax.lax.top_k(ease, min(count, len(ease)))
        best = jnp.resize(best, (count,))
        middles = (places[best] + places[best + 1]) / 2
        at = jnp.minimum(self.line, len(self.base) - 1)
        return jnp.where(jnp.isfinite(middles), middles, self.base[at])

    def _known(self) -> tuple[Array, Array]:
        """The base and all others of this line; those that are not there yet are infinite."""
        at = jnp.minimum(self.line, len(self.base) - 1)
        places = jnp.concatenate([self.places, self.base[at][None]])
        return places, jnp.concatenate([self.funs, self.fun[None]])

    def after(self, points: Float[Array, "K n"], funs: Float[Array, " K"]) -> "Scan":
        """With these values, infinite where there is none."""
        return where(self.tests, self._tested(funs), self._lined(points, funs))

    def done(self) -> Bool[Array, ""]:
        """Whether all parameters were scanned."""
        return self.tried & (self.line >= len(self.base))

    def made(self) -> Bool[Array, ""]:
        """Whether the try is over."""
        return self.tried | self.failed

    def _tested(self, funs: Array) -> "Scan":
        failed = ~(jnp.abs(jnp.min(funs) - self.fun - self.change) <= _OFF * self.least)
        scan = self.again(self.base, self.fun)
        return eqx.tree_at(lambda s: s.failed, scan, failed)

    def _lined(self, points: Array, funs: Array) -> "Scan":
        n, count = len(self.base), len(funs)
        at = jnp.minimum(self.line, n - 1)
        place = jnp.minimum(self.taken + jnp.arange(count, dtype=self.taken.dtype), _MOST - 1)
        known = eqx.tree_at(
            lambda s: (s.places, s.funs, s.taken),
            self,
            (
                self.places.at[place].set(points[:, at]),
                self.funs.at[place].set(funs),
                self.taken + count,
            ),
        )
        ended = known.taken >= self.limit
        places, values = known._known()
        best = jnp.argmin(values)
        away = jnp.abs(places - places[best])
        nearest = jnp.min(jnp.where(away > 0, away, jnp.inf))
        # a parameter between equal bounds has no other place
        nearest = jnp.where(jnp.isfinite(nearest), nearest, self.nearest[at])
        # the lowest place that is no neighbour: nearby, parameters may seem to act alone
        far = jnp.abs(places - self.base[at]) >= jnp.abs(places[1] - places[0]) / _TRY
        other = jnp.argmin(jnp.asarray(jnp.where(far, values, jnp.inf)))
        change = values[other] - self.fun
        line = self.line + 1
        empty = jnp.full_like(self.places, jnp.inf)
        over = eqx.tree_at(
            lambda s: (
                *(s.line, s.places, s.funs, s.taken, s.found, s.nearest),
                *(s.mixed, s.change, s.least, s.tests),
            ),
            self,
            (
                line,
                empty,
                empty,
                jnp.zeros_like(self.taken),
                self.found.at[at].set(places[best]),
                self.nearest.at[at].set(nearest),
                self.mixed.at[at].set(places[other]),
                self.change + change,
                jnp.minimum(self.least, jnp.abs(change)),
                ~self.tried & (line == min(_TRIED, n)),
            ),
        )
        return where(ended, over, known)
