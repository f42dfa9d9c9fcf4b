"""When were engines on? Flights by explicit Euler; a loss that is piecewise constant.

A switch takes effect at the next step, so there is no derivative. The engine of `rocket` is on from
0 to y0, and again, with another thrust, from y1 to y2, and it is seen six times. In `rocket10` ten
engines are switched off, so that each rocket reaches its target; a parameter of 1 is the whole
flight, and sigma is that of ZeroGrads (supplement, Table 1).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Effort
from benchmarks.tasks._drawn import function, program, uniform

SECONDS_PER_STEP = 0.02
GRAVITY, DRAG = 9.81, 0.1
# of rocket
STEPS, SEEN_EVERY = 300, 50
THRUSTS = ((6.0, 14.0), (-4.0, 12.0))
REFERENCE = (1.25, 3.05, 4.65)  # each half-way between two steps
# of rocket10
SIZE10, STEPS10 = 10, 150
TILT = np.linspace(-0.5, 0.5, SIZE10)  # of an engine, in radians from upright
THRUST = 18.0 + 4.0 * np.cos(3.0 * np.arange(SIZE10))
ENGINES = THRUST[:, None] * np.stack([np.sin(TILT), np.cos(TILT)], axis=1)
_SHARES = np.random.default_rng(0).uniform(0.2, 0.8, SIZE10)
REFERENCE10 = (np.floor(_SHARES * STEPS10) + 0.5) / STEPS10  # each half-way between two steps


def _step(state: tuple[Array, Array], force: Array) -> tuple[tuple[Array, Array], None]:
    """The positions and velocities a step of Euler's later."""
    position, velocity = state
    return (
        position + SECONDS_PER_STEP * velocity,
        velocity + SECONDS_PER_STEP * (force - DRAG * velocity),
    ), None


def fly(y: Float[Array, "3"]) -> Float[Array, "6 2"]:
    """The positions at which the rocket is seen, in metres."""
    times = jnp.arange(STEPS, dtype=y.dtype) * SECONDS_PER_STEP
    first, second = times < y[0], (y[1] <= times) & (times < y[2])
    engine = jnp.stack([first, second], 1).astype(y.dtype) @ jnp.asarray(THRUSTS, y.dtype)
    force = engine - jnp.asarray([[0, GRAVITY]], y.dtype)

    def until_seen(state, force):
        state, _ = jax.lax.scan(_step, state, force, unroll=10)
        return state, state[0]

    rest = jnp.zeros(2, y.dtype)
    return jax.lax.scan(until_seen, (rest, rest), force.reshape(-1, SEEN_EVERY, 2))[1]


def fly10(y: Float[Array, "10"]) -> Float[Array, "10 2"]:
    """Where the rockets are at the end of the flight, in metres."""
    engines, weight = jnp.asarray(ENGINES, y.dtype), jnp.asarray([[0, GRAVITY]], y.dtype)
    times = jnp.asarray(np.arange(STEPS10) / STEPS10, y.dtype)
    rest = jnp.zeros((SIZE10, 2), y.dtype)
    push = lambda state, time: _step(state, jnp.where(time < y[:, None], engines, 0) - weight)
    return jax.lax.scan(push, (rest, rest), times, unroll=10)[0][0]


TASKS = function(
    "rocket",
    "Rocket: times at which the engine was switched",
    parameters=3,
    plateaus=True,
    draw=fly,
    reference=REFERENCE,
    sigma=0.4,
    effort=(Effort(1000, 10, seeds=3), Effort(3000, 60, seeds=20)),
    start=uniform(3, -1, 1, around=REFERENCE),
    bounds=(0.0, 6.0),
) | program(
    "rocket10",
    "Rocket10: when ten engines are switched off",
    parameters=10,
    plateaus=True,
    draw=fly10,
    reference=REFERENCE10,
    sigma=0.33,
    effort=(Effort(2000, 60, seeds=3), Effort(10_000, 240, seeds=10)),
    optimum=0.0,
)
