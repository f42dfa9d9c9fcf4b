"""Grey boxes: what the black box is to be given, by Gauss-Newton, and a network that learns it.

Each case has a solver of its own, which takes a step when it is the case's turn. It goes on where
it was, or at the network's answer where that is better, so cases help one another. The network is
trained by AD to answer what the solvers have found, which costs no evaluations.

Splitting a network where AD ends is the method of auxiliary coordinates (Carreira-Perpinan and
Wang, Distributed optimization of deeply nested systems, 2014).
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import NotAble, Solve, Task

TITLE = "Network by AD, renderer by Gauss-Newton (ours)"
CASES = 32  # whose solvers take a step at a time
LESSONS, BATCH = 16, 32  # steps of Adam after it, and cases in each
DOUBT = 0.2  # in units of sigma: an error beyond it may be the solver's
RATE, DECAY = 1e-3, 0.02  # of Adam, and what is left of it at the end


def prepare(task: Task) -> Solve:
    """Compiles steps of the solvers and lessons of the network."""
    grey = task.grey
    if grey is None or grey.residuals is None:
        raise NotAble("this task has no part that AD knows, or no residuals behind it")
    residuals, count = grey.residuals, len(grey.cases)
    answer = jnp.zeros_like(jax.eval_shape(grey.white, task.reference, grey.cases[0]))
    shape = jax.eval_shape(residuals, answer, grey.cases[0])
    samples = sd.GaussNewton(grey.sigma).evaluations_per_step(answer)
    solver = sd.GaussNewton(grey.sigma, num_samples=samples, history=2 * samples)
    function = lambda x, case: (residuals(x, case), None)
    drawn = min(CASES, count)
    rounds = task.budget.evaluations // (drawn * (samples + 2))
    optim = optax.adam(optax.linear_schedule(RATE, DECAY * RATE, rounds * LESSONS))
    answers = jax.jit(lambda y: jax.vmap(partial(grey.white, y))(grey.cases))

    def step(key, said, found, state, case):
        """One step of one solver."""
        ahead = grey.black(said, case) < grey.black(found, case)
        jump = jnp.sqrt(jnp.mean((said - found) ** 2)) / grey.sigma
        scale = jnp.clip(jnp.where(ahead, jump, 0), state.scale, jnp.maximum(state.scale, 1))
        state = eqx.tree_at(lambda state: state.scale, state, scale)
        start = jnp.where(ahead, said, found)
        options = {"key": key}
        found, state, _ = solver.step(function, start, case, options, state, frozenset())
        return found, state

    @jax.jit
    def solve_some(key, y, found, states, chosen):
        """Steps of the solvers of some cases."""
        keys = jax.random.split(key, drawn)
        cases = grey.cases[chosen]
        said = jax.vmap(partial(grey.white, y))(cases)
        some = jax.tree.map(lambda leaf: leaf[chosen], states)
        new, some = jax.vmap(step)(keys, said, found[chosen], some, cases)
        states = jax.tree.map(lambda leaf, part: leaf.at[chosen].set(part), states, some)
        return found.at[chosen].set(new), states

    @jax.jit
    def learn(key, y, state, found, known):
        """One lesson on cases that have been drawn."""
        chosen = jax.random.choice(key, count, (BATCH,), p=known / jnp.sum(known))

        def loss(y):
            said = jax.vmap(partial(grey.white, y))(grey.cases[chosen])
            return jnp.mean(optax.huber_loss(said, found[chosen], delta=DOUBT * grey.sigma))

        updates, state = optim.update(jax.grad(loss)(y), state, y)
        return optax.apply_updates(y, updates), state

    def solve(y0, key, record):
        y, state = y0, optim.init(y0)
        found, known = answers(y), jnp.zeros(count)
        begin = lambda x: solver.init(function, x, None, {"key": key}, shape, None, frozenset())
        states = jax.vmap(begin)(found)
        for i in itertools.count():
            now = jax.random.fold_in(key, i)
            chosen = jnp.arange(i * drawn, (i + 1) * drawn) % count
            found, states = solve_some(now, y, found, states, chosen)
            known = known.at[chosen].set(1)
            for lesson in jax.random.split(now, LESSONS):
                y, state = learn(lesson, y, state, found, known)
            record(y)

    return solve
