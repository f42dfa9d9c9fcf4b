"""Rocket: when was the engine on? A flight by explicit Euler, seen six times.

The engine is on from 0 to y0, and again, with another thrust, from y1 to y2. A switch takes effect
at the next step, so the loss is piecewise constant and has no derivative.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

TITLE = "Rocket: times at which the engine was switched"
STEPS, SECONDS_PER_STEP, SEEN_EVERY = 300, 0.02, 50
THRUSTS = ((6.0, 14.0), (-4.0, 12.0))
GRAVITY, DRAG = 9.81, 0.1
REFERENCE = (1.25, 3.05, 4.65)  # each half-way between two steps
BOUNDS = (0.0, 6.0)


def fly(y: Float[Array, "3"]) -> Float[Array, "6 2"]:
    """The positions at which the rocket is seen, in metres."""
    times = jnp.arange(STEPS, dtype=y.dtype) * SECONDS_PER_STEP
    first, second = times < y[0], (y[1] <= times) & (times < y[2])
    engine = jnp.stack([first, second], 1).astype(y.dtype) @ jnp.asarray(THRUSTS, y.dtype)
    force = engine - jnp.asarray([[0, GRAVITY]], y.dtype)

    def step(state, force):
        position, velocity = state
        return (
            position + SECONDS_PER_STEP * velocity,
            velocity + SECONDS_PER_STEP * (force - DRAG * velocity),
        ), None

    def until_seen(state, force):
        state, _ = jax.lax.scan(step, state, force, unroll=10)
        return state, state[0]

    rest = jnp.zeros(2, y.dtype)
    return jax.lax.scan(until_seen, (rest, rest), force.reshape(-1, SEEN_EVERY, 2))[1]


def build(full: bool) -> Task:
    """Starts are within a second of the reference."""
    reference = jnp.asarray(REFERENCE)
    seen = jax.jit(fly)(reference)

    def residuals(y: Float[Array, "3"]) -> Float[Array, "6 2"]:
        return fly(y) - seen

    def loss(y: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.mean(residuals(y) ** 2)

    def start(seed):
        return reference + jax.random.uniform(jax.random.key(seed), (3,), minval=-1, maxval=1)

    return Task(
        name="rocket",
        title=TITLE,
        loss=loss,
        exact_loss=loss,
        start=start,
        reference=reference,
        bounds=(jnp.full(3, BOUNDS[0]), jnp.full(3, BOUNDS[1])),
        sigma=0.4,
        budget=Budget(3000, 60) if full else Budget(1000, 10),
        seeds=20 if full else 3,
        residuals=residuals,
    )
