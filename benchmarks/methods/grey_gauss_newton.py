"""Grey boxes: what the black box is to be given, by Gauss-Newton, and a network that learns it.

Each case has a solver of its own, which takes a step when it is the case's turn, from the best of
these: where it was, the network's answer, poses drawn for this step, and what came nearest of all
renders so far, whichever case they were made for. So cases help one another, and no case stays in a
valley that others have shown to be a wrong one.

The network is trained by AD, which costs no evaluations: to answer what is known to be best, and
for a render what was rendered. So it has as many pictures to learn from as there were renders, of
which those within the range of what is known to be best count. The renders of the solvers soon look
like the pictures themselves, and a network that has learnt these by heart fails on others. Hence
half of all renders are of poses from a kernel density estimate of what is known to be best; what
lies beyond its range is moved to the edge. Lessons become more as there is more to learn, and the
weights of late lessons are averaged (Shamir and Zhang, Stochastic gradient descent for non-smooth
optimization, 2013); it is these that the solvers ask.

Splitting a network where AD ends is the method of auxiliary coordinates (Carreira-Perpinan and
Wang, Distributed optimization of deeply nested systems, 2014).
"""

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import smoothdiff as sd
from benchmarks._task import Grey, Key, MethodEntry, NotAble, Problem, Solve, Y
from smoothdiff._solvers import _batch_by_batch

CASES = 32  # whose solvers take a step at a time
LESSONS = 16, 240  # steps of Adam after the first time, and after the last one
BATCH = 16, 48  # cases in a lesson, and renders
KEPT = 16384  # renders to learn from, the last ones
DOUBT = 0.2  # in units of sigma: an error beyond it may be the solver's
RATE, DECAY = 3e-3, 0.02  # of Adam, and what is left of it at the end
LATE = 10  # in the mean of all weights those after t lessons count about as the ninth power of t


class Known(NamedTuple):
    """Of each case the best that was rendered, with its loss; and where its solver stands."""

    best: jax.Array
    loss: jax.Array
    at: jax.Array
    states: Any


class Rendered(NamedTuple):
    """The last renders, from old to new, and what they are of; NaN at first."""

    points: jax.Array
    shown: jax.Array

    def after(self, points: jax.Array, shown: jax.Array) -> "Rendered":
        """With these in place of the oldest."""
        new = Rendered(points, shown)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b])[len(b) :], self, new)


class Solvers:
    """A solver for each case, and what all cases learn from their renders.

    It is told what the network says of a picture, for its shape.
    """

    def __init__(self, grey: Grey, answer: jax.Array):
        samples = 4 + int(3 * math.log(answer.size))
        self._grey, self._samples = grey, samples
        # by batches whatever the number of parameters: cases step together under vmap
        self._solver = sd.GaussNewton(grey.sigma, num_samples=samples, history=2 * samples)
        self._function = lambda x, picture: (grey.render(x) - picture, None)
        self._picture = jax.eval_shape(grey.render, answer)
        self.drawn = min(CASES, len(grey.cases))
        # renders of a solver: its samples, where it was, the network's answer
        self._each = samples + 2
        # and as many new poses
        self.evaluations = self.drawn * 2 * self._each

    def begin(self, key: Key, said: jax.Array) -> tuple[Known, Rendered]:
        """What is known when the network has said this of the cases, and no render yet."""
        size = math.prod(self._picture.shape)
        begin = lambda x: _batch_by_batch.init(self._solver, x, {"key": key}, size)
        known = Known(said, jnp.full(len(said), jnp.inf), said, jax.vmap(begin)(said))
        nothing = (jnp.full((KEPT, *a.shape), jnp.nan, a.dtype) for a in (said[0], self._picture))
        return known, Rendered(*nothing)

    def step(
        self, key: Key, y: Y, known: Known, rendered: Rendered, chosen: jax.Array
    ) -> tuple[Known, Rendered, jax.Array]:
        """Steps of the solvers of some cases; also which renders are within the known range."""
        pictures = self._grey.cases
        draw, *keys = jax.random.split(key, self.drawn + 1)
        said = jax.vmap(partial(self._grey.white, y))(pictures[chosen])
        # at first nothing is known, and these are all but what the untrained network says
        others = _like(draw, known.best, (self.drawn, self._each))
        best, loss, at, states = jax.tree.map(lambda leaf: leaf[chosen], known)
        at, states, made = jax.vmap(self._step)(
            jnp.stack(keys), said, others, best, loss, at, states, pictures[chosen]
        )
        points: jax.Array
        points, shown = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), made)
        nearest, loss = _nearest(shown, pictures)
        better = loss < known.loss
        known = Known(
            jnp.where(better[:, None], points[nearest], known.best),
            jnp.where(better, loss, known.loss),
            known.at.at[chosen].set(at),
            jax.tree.map(lambda leaf, part: leaf.at[chosen].set(part), known.states, states),
        )
        rendered = rendered.after(points, shown)
        return known, rendered, _within(rendered, known.best)

    def _step(self, key, said, others, best, loss, at, state, picture):
        """One step of one solver, and what was rendered for it, and of other poses."""
        tried = jnp.concatenate([jnp.stack([at, said]), others])
        shown = jax.vmap(self._grey.render)(tried)
        losses = jnp.append(_finite(jnp.mean((shown - picture[None]) ** 2, (1, 2, 3))), loss)
        start = jnp.append(tried, best[None], axis=0)[jnp.argmin(losses)]
        # after a jump the solver looks as far around as it has jumped, up to its first width
        jump = jnp.sqrt(jnp.mean((start - at) ** 2)) / self._grey.sigma
        scale = state.search.scale
        scale = jnp.clip(jump, scale, jnp.maximum(scale, 1))
        state = eqx.tree_at(lambda state: state.search.scale, state, scale)
        rest = picture, {"key": key}, state
        at, state, _ = _batch_by_batch.step(self._solver, self._function, start, *rest)
        history = state.search.history
        last = slice(-self._samples, None)
        seen: jax.Array = history.rows[last].reshape(-1, *picture.shape) + picture[None]
        seen = jnp.where(history.valid[last, None, None, None], seen, jnp.nan)
        points = jnp.append(tried, history.points[last], 0)
        return at, state, Rendered(points, jnp.append(shown, seen, 0))


def prepare(problem: Problem) -> Solve:
    """Compiles steps of the solvers and lessons of the network."""
    grey = problem.grey
    if grey is None:
        raise NotAble("this task has no part that AD knows")
    count = len(grey.cases)
    answer = jnp.zeros_like(jax.eval_shape(grey.white, problem.like, grey.cases[0]))
    solvers = Solvers(grey, answer)
    rounds = max(1, problem.budget.evaluations // solvers.evaluations)
    lessons = np.linspace(*LESSONS, rounds).astype(int)
    optim = optax.adam(optax.linear_schedule(RATE, DECAY * RATE, int(lessons.sum())))
    answers = jax.jit(lambda y: jax.vmap(partial(grey.white, y))(grey.cases))
    step = jax.jit(solvers.step)

    @jax.jit
    def learn(key, y, state, best, rendered, within):
        misfit = _lesson(key, grey, best, rendered, within)
        updates, state = optim.update(jax.grad(misfit)(y), state, y)
        return optax.apply_updates(y, updates), state

    def solve(y0, key, record):
        y, mean, state, taught = y0, y0, optim.init(y0), 0
        known, rendered = solvers.begin(key, answers(y))
        for i in itertools.count():
            solving, learning = jax.random.split(jax.random.fold_in(key, i))
            chosen = jnp.arange(i * solvers.drawn, (i + 1) * solvers.drawn) % count
            known, rendered, within = step(solving, mean, known, rendered, chosen)
            for lesson in jax.random.split(learning, lessons[min(i, rounds - 1)]):
                y, state = learn(lesson, y, state, known.best, rendered, within)
                mean = optax.incremental_update(y, mean, LATE / (LATE + taught))
                taught += 1
            record(mean)

    return solve


def _lesson(
    key: Key, grey: Grey, best: jax.Array, rendered: Rendered, within: jax.Array
) -> Callable[[Y], jax.Array]:
    """The misfit of a network on cases and renders that are drawn, the latter from those within."""
    of_cases, of_renders = jax.random.split(key)
    cases, renders = BATCH
    case = jax.random.choice(of_cases, len(grey.cases), (cases,))
    share = within.astype(best.dtype)
    # where there are no renders to learn from, what is drawn has no weight
    number = jax.random.choice(of_renders, KEPT, (renders,), p=share / jnp.sum(share))
    weight = jnp.append(jnp.ones(cases), within[number])
    shown = jnp.where(within[number][:, None, None, None], rendered.shown[number], 0)
    inputs = jnp.append(grey.cases[case], shown, axis=0)
    targets = jnp.append(best[case], rendered.points[number], axis=0)
    targets = jnp.where(weight[:, None] > 0, targets, 0)

    def misfit(y):
        said = jax.vmap(partial(grey.white, y))(inputs)
        each = optax.huber_loss(said, targets, delta=DOUBT * grey.sigma)
        return jnp.mean(weight[:, None] * each)

    return misfit


def _nearest(shown: jax.Array, pictures: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For each picture the number of the render that is nearest, and its loss."""
    flat, wanted = shown.reshape(len(shown), -1), pictures.reshape(len(pictures), -1)
    # nearest by products of matrices, and then exactly
    nearest = jnp.argmin(_finite(jnp.sum(flat**2, 1)[None] - 2 * wanted @ flat.T), axis=1)
    return nearest, _finite(jnp.mean((flat[nearest] - wanted) ** 2, axis=1))


def _within(rendered: Rendered, best: jax.Array) -> jax.Array:
    """Which renders did not fail, and are of poses within the range of the best ones."""
    low, high = jnp.min(best, axis=0), jnp.max(best, axis=0)
    inside = (rendered.points >= low[None]) & (rendered.points <= high[None])
    return inside.all(axis=1) & jnp.isfinite(rendered.shown).all(axis=(1, 2, 3))


def _like(key: jax.Array, best: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Poses as the best ones are spread: a kernel density estimate by Scott's rule, and clipped.

    That of `jax.scipy.stats` says NaN where an entry is the same in all, as it may be at first.
    """
    which, where = jax.random.split(key)
    width = jnp.std(best, axis=0) * len(best) ** (-1 / (best.shape[1] + 4))
    poses = jax.random.choice(which, best, shape)
    poses += width[None, None] * jax.random.normal(where, poses.shape)
    low, high = jnp.min(best, axis=0), jnp.max(best, axis=0)
    return jnp.clip(poses, low[None, None], high[None, None])


def _finite(losses: jax.Array) -> jax.Array:
    """What is not finite is the worst."""
    return jnp.where(jnp.isfinite(losses), losses, jnp.inf)


METHODS = {
    "grey_gauss_newton": MethodEntry(
        "Network by AD, renderer by Gauss-Newton (ours)", ("network",), prepare
    )
}
