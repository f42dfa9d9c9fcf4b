"""Rocket10: when must the engines of ten rockets go off, so that each reaches its target?

A flight by explicit Euler, as in rocket. Engines go off at the next step, so the loss is piecewise
constant. A parameter of 1 is the whole flight. Sigma is that of ZeroGrads (supplement, Table 1).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks import methods
from benchmarks._task import Budget, Task
from benchmarks.tasks._drawn import drawn
from benchmarks.tasks.rocket import DRAG, GRAVITY, SECONDS_PER_STEP

TITLE = "Rocket10: when ten engines are switched off"
METHODS = methods.PROGRAMS
SIZE, STEPS = 10, 150
TILT = np.linspace(-0.5, 0.5, SIZE)  # of an engine, in radians from upright
THRUST = 18.0 + 4.0 * np.cos(3.0 * np.arange(SIZE))
ENGINES = THRUST[:, None] * np.stack([np.sin(TILT), np.cos(TILT)], axis=1)
_SHARES = np.random.default_rng(0).uniform(0.2, 0.8, SIZE)
REFERENCE = (np.floor(_SHARES * STEPS) + 0.5) / STEPS  # each half-way between two steps
SIGMA = 0.33


def fly(y: Float[Array, "10"]) -> Float[Array, "10 2"]:
    """Where the rockets are at the end of the flight, in metres."""
    engines = jnp.asarray(ENGINES, y.dtype)
    weight = jnp.asarray([[0, GRAVITY]], y.dtype)

    def step(state, time):
        position, velocity = state
        force = jnp.where(time < y[:, None], engines, 0) - weight
        return (
            position + SECONDS_PER_STEP * velocity,
            velocity + SECONDS_PER_STEP * (force - DRAG * velocity),
        ), None

    times = jnp.asarray(np.arange(STEPS) / STEPS, y.dtype)
    rest = jnp.zeros((SIZE, 2), y.dtype)
    (position, _), _ = jax.lax.scan(step, (rest, rest), times, unroll=10)
    return position


def build(full: bool) -> Task:
    return drawn(
        "rocket10",
        TITLE,
        fly,
        REFERENCE,
        sigma=SIGMA,
        budget=Budget(10_000, 240) if full else Budget(2000, 60),
        seeds=10 if full else 3,
        optimum=0.0,
    )
