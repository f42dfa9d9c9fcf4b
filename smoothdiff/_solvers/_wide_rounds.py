"""Rounds of samples around a center, and the regression that moves it: where functions jump."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._products import dot
from smoothdiff._solvers._averaging import SHARE, apart, seen_from_center
from smoothdiff._solvers._history import History, alike
from smoothdiff._solvers._parameter_regression import gauss_newton_step
from smoothdiff._solvers._residual_batch import centred
from smoothdiff._solvers._stages import Sizes

# each sigma follows twice the standard error of the step, at most so much smaller or larger at a
# time
_SHRINK, _GROW = 0.25, 1.5
# ... and no wider than so many times what the user gave, unless all samples are the same
_WIDEST = 2.0
# ... and no parameter by less than so much of the widest one
_NARROWEST = 0.1
# the longest step of any parameter, in units of its sigma: beyond it nothing has been seen
LONGEST = 2.0
# a step is tried so many times as far, where that is at least sigma
_FURTHER = 5.0
# a function that takes a key has so many first rounds; then one of so many evaluations is next to
# the center
_FIRST, _CENTERS = 6, 2
# that is a sample at this share of its distance, and all that is nearer than so many widths
_CLOSE, _THERE = 0.005, 0.02
# so many steps in a row that halve the loss, within the width, came true
_TRUE = 2
# rounds come to nothing after so many evaluations, for each parameter and one, that found no lower
# point; they are so much narrower when they are tried again
_IDLE, _VAIN = 6, 0.5
# the local model is tested only once samples are so narrow, in sigma: wider ones are to find the
# valley
_NARROW = 0.3


class Wide(eqx.Module):
    """A round of samples: `taken` of them so far, around the end of the last `move`.

    They are `scale` wide along each parameter, relative to sigma. `rounds` counts them, `true`
    those in a row that came true, `idle` the evaluations without a lower point, `found` says that
    there was one, `before` is the loss at the last center, `row` the residuals at this one, and
    `seen` says that the last samples were not the same.
    """

    center: Float[Array, " n"]
    row: Float[Array, " P"]
    move: Float[Array, " n"]
    scale: Float[Array, " n"]
    before: Float[Array, ""]
    taken: Int[Array, ""]
    rounds: Int[Array, ""]
    true: Int[Array, ""]
    idle: Int[Array, ""]
    found: Bool[Array, ""]
    seen: Bool[Array, ""]

    @staticmethod
    def start(center: Array, row: Array, scale: Float[Array, " n"]) -> "Wide":
        """The first round, around a point that is known."""
        none = jnp.zeros((), jnp.int32)
        before = jnp.asarray(jnp.inf, row.dtype)
        still = jnp.zeros_like(center)
        no = jnp.asarray(False)
        return Wide(center, row, still, scale, before, none, none, none, none, no, no)

    def came_true(self) -> Bool[Array, ""]:
        """Whether the steps are what they promise, so that the local model may go on."""
        return self.true >= _TRUE

    def came_to_nothing(self) -> Bool[Array, ""]:
        """Whether no lower point was found for long."""
        return self.idle >= _IDLE * (len(self.center) + 1)

    def may_wait(self) -> Bool[Array, ""]:
        """Whether the local model may be tested before the next round.

        No round that came true is followed by a test, as the next one may say so too.
        """
        narrow = jnp.sqrt(jnp.mean(self.scale**2)) < _NARROW
        return narrow & self.found & (self.true == 0)

    def is_settling(self) -> Bool[Array, ""]:
        """Whether the first rounds are over, which may have far to go."""
        return self.rounds > _FIRST

    def size(self, sizes: Sizes, takes_key: bool) -> Int[Array, ""]:
        """So many evaluations make a round."""
        usual = jnp.where(self.seen, sizes.later, sizes.first)
        # those at once have the same random numbers: one at the center is enough
        more = takes_key and sizes.at_once == 1
        return jnp.where(self.is_settling(), _CENTERS * usual, usual) if more else usual

    def places(
        self, sizes: Sizes, takes_key: bool
    ) -> tuple[Float[Array, " count"], Int[Array, " count"]]:
        """Which samples the next evaluations are, and how far away, as a share of that.

        The first is the center. With a key there are others as good as there: a `Search` hands out
        no point twice.
        """
        at = self.taken + jnp.arange(sizes.step, dtype=jnp.int32)
        first = at == 0
        if not takes_key:
            return jnp.where(first, 0, jnp.ones_like(at, self.scale.dtype)), at - 1
        every = max(_CENTERS, sizes.at_once)
        there = self.is_settling() & (at % every == 0)
        before = jnp.where(self.is_settling(), at // every, 0)
        share = jnp.where(there, jnp.asarray(_CLOSE, self.scale.dtype), 1)
        return jnp.where(first, 0, share), jnp.where(there, before, at - 1 - before)

    def later_scale(self) -> Float[Array, " n"]:
        """How wide the samples are where the local model has failed since."""
        vain = (self.rounds > 0) & self.came_to_nothing()
        widest = jnp.where(self.came_true(), jnp.maximum(self.scale, 1), self.scale)
        return jnp.where(vain, _VAIN * self.scale, widest)

    def sampled(
        self,
        params: Params,
        history: History,
        rows: Array,
        good: Array,
        lowest: Float[Array, " P"],
        least: Float[Array, ""],
    ) -> "Wide":
        """With these residuals, the newest of the history.

        The `lowest` ones are those of its best point, the loss there is the `least`.
        """
        first, fun = self.taken == 0, jnp.where(good[0], jnp.sum(rows[0] ** 2) / 2, jnp.inf)
        near = jnp.max(jnp.abs(self.move / (params.sigma * self.scale))) < 1
        halved = (fun < self.before / 2) & (fun <= least) & near
        newest = history.rows[-len(rows) :]
        lower = jnp.any(jnp.all(newest == lowest[None], axis=1) & good)
        return Wide(
            center=self.center,
            row=jnp.where(first, jnp.where(good[0], rows[0], jnp.inf), self.row),
            move=self.move,
            scale=self.scale,
            before=jnp.where(first, fun, self.before),
            taken=self.taken + len(rows),
            rounds=self.rounds,
            true=jnp.where(first, jnp.where(halved, self.true + 1, 0), self.true),
            idle=jnp.where(lower, 0, self.idle + len(rows)),
            found=self.found | lower,
            seen=self.seen,
        )

    def stepped(
        self, history: History, params: Params, count: Array, takes_key: bool = False
    ) -> "Wide":
        """The regression over the round and what was before it; the next round.

        Where the function `takes_key`, samples are no nearer to each other than noise allows.
        """
        sigma = params.sigma * self.scale
        # what is lowest by luck is no better
        here = self.center, self.row
        center, here = here if takes_key else history.lowest(*here)
        u = (history.points - center[None]) / sigma[None]
        sides = sides_of(params, center, sigma)
        fresh = history.valid & (jnp.arange(len(u)) >= len(u) - count)
        known, there = (u, history.rows, history.valid), jnp.zeros_like(fresh)
        if takes_key:
            there = fresh & self.is_settling() & (jnp.max(jnp.abs(u), axis=1) < _THERE)
            known = seen_from_center(*known, there)
        move, error = gauss_newton_step(*known, *sides)
        if takes_key:
            near = jnp.max(jnp.abs(move)) < 1
            move = jnp.where(self.is_settling() & near, SHARE * move, move)
        length = jnp.abs(move) / LONGEST
        move = move / jnp.maximum(1, jnp.max(length))
        theta = params.clip(center + sigma * move)
        some = history.rows[jnp.argmax(fresh)]
        same = jnp.all(alike(history.rows, some) | ~fresh)
        # a few that are the same call for more of them first
        flat = same & ~self.seen
        scale = next_scale(self.scale, flat, history, here, u, error, length)
        # what is narrow by chance would hardly be seen again
        scale = jnp.maximum(scale, _NARROWEST * jnp.max(scale))
        if takes_key:
            least = apart(self.scale, *_noise_and_signal(u, history.rows, history.valid))
            scale = jnp.where(flat, scale, jnp.maximum(scale, least))
        # where most samples gave no numbers they were too far away
        few = 2 * jnp.sum(fresh & ~there) < count - jnp.sum(there)
        scale = jnp.where(few, self.scale / 2, scale)
        finite = jnp.all(jnp.isfinite(theta)) & jnp.all(jnp.isfinite(scale))
        return Wide(
            center=jnp.where(finite, theta, center),
            row=self.row,
            move=jnp.where(finite, theta - self.center, 0),
            scale=jnp.where(finite, scale, self.scale / 2),
            before=self.before,
            taken=jnp.zeros_like(self.taken),
            rounds=self.rounds + 1,
            true=self.true,
            idle=self.idle,
            found=self.found,
            seen=~same,
        )


def further(
    move: Float[Array, " n"], sigma: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """A step on in the direction of the last one, and whether it is worth an evaluation."""
    step = _FURTHER * move
    return step, jnp.mean((step / sigma) ** 2) > 1


def sides_of(
    params: Params, center: Array, sigma: Array | None = None
) -> tuple[Array | None, Array | None]:
    """The bounds as seen from a point, in units of sigma."""
    sigma = params.sigma if sigma is None else sigma
    if params.bounds is None:
        return None, None
    low, high = ((side - center) / sigma for side in params.bounds)
    return low, high


def next_scale(
    scale: Float[Array, "..."],
    flat: Bool[Array, ""],
    history: History,
    here: Float[Array, " P"],
    u: Float[Array, "M n"],
    error: Float[Array, "..."],
    length: Float[Array, "..."],
) -> Float[Array, "..."]:
    """How wide the next samples are, relative to sigma.

    Args:
        scale: That of these, one number or one for each parameter.
        flat: All of them are the same; then the next ones are twice as wide.
        history: All samples, these included.
        here: The residuals where the step starts, at the iterate or a better point.
        u: The points of the history as seen from there.
        error: The standard error of the step.
        length: Of the step, in longest ones.
    """
    # a plateau of the residuals around the iterate is seen whole or not at all
    plateau = history.valid & alike(history.rows, here)
    extent = jnp.max(jnp.where(plateau, jnp.sqrt(jnp.mean(u**2, axis=1)), 0))
    wanted = jnp.maximum(jnp.maximum(2 * error, length), extent)
    wanted = jnp.clip(wanted, _SHRINK, _GROW)
    return jnp.where(flat, 2 * scale, jnp.minimum(wanted * scale, _WIDEST))


def _noise_and_signal(
    u: Float[Array, "M n"], rows: Float[Array, "M P"], valid: Bool[Array, " M"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The roots of the variance of rows that a linear fit leaves, and of that which it explains.

    Both are sums over the row; the second is that over standard normal points u.
    """
    count = jnp.sum(valid).astype(u.dtype)
    u, rows = centred(u, valid), centred(rows, valid)
    left: Array
    values: Array
    left, values, _ = jnp.linalg.svd(u, full_matrices=False)
    known = values > len(u) * jnp.finfo(u.dtype).eps * values[0]
    inverse = jnp.where(known, 1 / jnp.where(known, values, 1), 0)
    along = dot(left.T, rows)
    freedom = jnp.maximum(count - u.shape[1] - 1, 1)
    noise = jnp.maximum(jnp.sum(rows**2) - jnp.sum(along**2), 0) / freedom
    # noise makes slopes seem longer than they are
    signal = jnp.sum((inverse[:, None] * along) ** 2) - noise * jnp.sum(inverse**2)
    return jnp.sqrt(noise), jnp.sqrt(jnp.maximum(signal, 0))
