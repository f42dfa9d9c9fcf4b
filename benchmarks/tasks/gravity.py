"""Gravity: three cubes are dropped onto each other, and form a tower if they fall as they should.

Rigid squares in a plane, with springs, dashpots and friction where a corner is inside another body,
by a fixed time step. Sought are the initial positions of the upper two and the restitution of all.
Where a cube tips over, the loss jumps. A stiff contact lasts no more than seven steps.
Sigma is that of ZeroGrads (supplement, Table 1), in units of the domain.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Effort, Task, entry
from benchmarks.tasks._drawn import drawn

STEPS, SECONDS_PER_STEP, SEEN_EVERY = 900, 1 / 500, 225
GRAVITY, FRICTION, SLIP = 9.81, 0.6, 0.05
HALF, INERTIA = 0.5, 1 / 6  # of cubes of mass 1
RATES = {"soft": 40.0, "stiff": 150.0}  # of a cube on one corner, in radians a second
CORNERS = HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
# from the lowest and the highest parameter: x and height of the upper two, and the restitution
LOWEST = np.array([-0.8, 1.9, -0.8, 3.5, 0.2])
HIGHEST = np.array([0.8, 2.4, 0.8, 4.2, 0.7])
REFERENCE = (0.55, 0.4, 0.44, 0.6, 0.4)
BOTTOM = (0.0, 0.8)


def fall(y: Float[Array, "5"], rate: float) -> Float[Array, "times 2 4 2"]:
    """The corners of the upper two cubes at the times at which they are seen, in metres."""
    given = jnp.asarray(LOWEST, y.dtype) + jnp.asarray(HIGHEST - LOWEST, y.dtype) * y
    position = jnp.concatenate([jnp.asarray(BOTTOM, y.dtype), given[:4]]).reshape(3, 2)
    # the damping ratio with which a spring throws back this share of the speed
    log = jnp.log(given[4])
    damping = -2 * rate * log / jnp.hypot(log, jnp.pi)
    rest = jnp.zeros_like(position)
    state = position, jnp.zeros(3, y.dtype), rest, jnp.zeros(3, y.dtype)

    def step(state, _):
        position, angle, velocity, spin = state
        force, torque = _contacts(state, rate**2, damping)
        force = force - jnp.asarray([[0, GRAVITY]], y.dtype)
        velocity = velocity + SECONDS_PER_STEP * force
        spin = spin + SECONDS_PER_STEP * torque / INERTIA
        return (
            position + SECONDS_PER_STEP * velocity,
            angle + SECONDS_PER_STEP * spin,
            velocity,
            spin,
        ), None

    def until_seen(state, _):
        state, _ = jax.lax.scan(step, state, length=SEEN_EVERY)
        position, angle, _, _ = state
        return state, (position[:, None] + _arms(angle))[1:]

    return jax.lax.scan(until_seen, state, length=STEPS // SEEN_EVERY)[1]


def _arms(angle: Float[Array, "3"]) -> Float[Array, "3 4 2"]:
    """From the middle of each cube to its corners."""
    return jnp.einsum("cj,bij->bci", jnp.asarray(CORNERS, angle.dtype), _frames(angle))


def _frames(angle: Float[Array, "3"]) -> Float[Array, "3 2 2"]:
    """The rotation of each cube."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)


def _contacts(state, stiffness: float, damping: Array) -> tuple[Array, Array]:
    """Forces and torques on the cubes, from corners that are in the ground or in another cube."""
    position, angle, velocity, spin = state
    frames, arms = _frames(angle), _arms(angle)
    corners = position[:, None] + arms
    speeds = velocity[:, None] + spin[:, None, None] * _turned(arms)
    # the corners of cube b as body o sees them: axes b, c (corner), o, and two coordinates
    others = corners[:, :, None] - position[None, None]
    inside = jnp.einsum("bcoi,oij->bcoj", others, frames)
    side = jnp.argmax(jnp.abs(inside), -1)
    farthest = jnp.take_along_axis(inside, side[..., None], -1)[..., 0]
    itself = jnp.eye(3, dtype=bool)[:, None, :]
    depth = jnp.where(itself, 0, jnp.maximum(HALF - jnp.abs(farthest), 0))
    out = jnp.sign(farthest)[..., None] * jnp.moveaxis(frames, -1, -2)[np.arange(3), side]
    others_speed = velocity[None, None] + spin[None, None, :, None] * _turned(others)
    push = _push(depth, out, speeds[:, :, None] - others_speed, stiffness, damping)
    up = jnp.broadcast_to(jnp.asarray([0, 1], depth.dtype), corners.shape)
    ground = _push(jnp.maximum(-corners[..., 1], 0), up, speeds, stiffness, damping)
    on_corner = push.sum(2) + ground
    force = on_corner.sum(1) - push.sum((0, 1))
    return force, _cross(arms, on_corner).sum(1) - _cross(others, push).sum((0, 1))


def _push(depth, out, speed, stiffness: float, damping: Array) -> Array:
    """The force of a contact on what is inside: a spring, a dashpot that never pulls, friction."""
    along = jnp.stack([-out[..., 1], out[..., 0]], -1)
    away, slip = jnp.sum(speed * out, -1), jnp.sum(speed * along, -1)
    normal = jnp.where(depth > 0, jnp.maximum(stiffness * depth - damping * away, 0), 0)
    sideways = -FRICTION * normal * jnp.tanh(slip / SLIP)
    return normal[..., None] * out + sideways[..., None] * along


def _turned(arm: Array) -> Array:
    """The speed of a point at this arm, for each unit of spin."""
    return jnp.stack([-arm[..., 1], arm[..., 0]], -1)


def _cross(arm: Array, force: Array) -> Array:
    return arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0]


def build(full: bool, name: str, title: str) -> list[Task]:
    """Soft and stiff contacts."""
    return [
        drawn(
            full,
            name=f"{kind}-5d",
            title=f"{title}, {kind} contacts",
            draw=partial(fall, rate=rate),
            reference=REFERENCE,
            sigma=0.2,
            effort=(Effort(600, 120, seeds=2), Effort(3000, 600, seeds=10)),
            optimum=0.0,
        )
        for kind, rate in RATES.items()
    ]


TASKS = entry(
    "program",
    build,
    "gravity",
    "Gravity: three cubes that are dropped",
    parameters=(5, 5),
    plateaus=False,
)
