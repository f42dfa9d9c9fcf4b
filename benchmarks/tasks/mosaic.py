"""Mosaic: 320 cubes on a floor, seen from the front and above. How far is each turned?

Cubes hide parts of those behind, and are drawn by 2 x 2 rays for each pixel, always the same, so
the picture is piecewise constant. A parameter of 1 is a quarter turn, from one side to the next.
Sigma is that of ZeroGrads (supplement, Table 1), in units of the domain.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import sparse

import smoothdiff as sd
from benchmarks._task import Budget, Task
from benchmarks.tasks._drawn import drawn

TITLE = "Mosaic: rotations of 320 cubes"
ROWS, COLUMNS = 16, 20
SIZE = ROWS * COLUMNS
PIXELS, RAYS = 5, 2  # to the next column of cubes, which are one unit apart; along each axis
HALF = 0.33  # of a side; the diagonal is shorter than 1, so cubes do not touch
UP, AWAY = np.sin(np.radians(35)), np.cos(np.radians(35))  # of the camera's elevation
SHADES = (0.35, 1.0, 0.7)  # of the left side, the right side and the top
FLOOR = 0.15
SIGMA = 0.025


def _rays() -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the screen, (H, W) each: from the left, and upwards from the floor."""
    reach = np.sqrt(2) * HALF
    height = (ROWS - 1 + 2 * reach) * UP + 2 * HALF * AWAY
    x, v = (np.arange(RAYS * int(size * PIXELS)) + 0.5 for size in (COLUMNS, height))
    x, v = x / PIXELS / RAYS, v[::-1] / PIXELS / RAYS - reach * UP
    return np.meshgrid(x, v)


def _candidates() -> np.ndarray:
    """The rows of cubes that a ray may meet, the nearer one first: (2, H, W), some not there."""
    farther = np.floor(V / UP + np.sqrt(2) * HALF).astype(int)
    return np.stack([farther - 1, farther])


X, V = _rays()
BY_PIXEL = (X.shape[0] // RAYS, RAYS, X.shape[1] // RAYS, RAYS)
ROW = _candidates()
COLUMN = np.broadcast_to(np.floor(X).astype(int), ROW.shape)
THERE = (ROW >= 0) & (ROW < ROWS)
CUBE = np.where(THERE, ROW * COLUMNS + COLUMN, 0)
COLOURS = np.random.default_rng(1).uniform(0.2, 1, (SIZE, 3))
# three for each cube, and at the end the floor's
PAINTS = np.vstack([np.kron(COLOURS, np.reshape(SHADES, (3, 1))), np.full((1, 3), FLOOR)])
REFERENCE = np.random.default_rng(2).uniform(0.1, 0.9, SIZE)


def draw(y: Float[Array, "320"]) -> Float[Array, "48 100 3"]:
    """The picture, linear RGB."""
    angle = jnp.pi / 2 * y
    cos, sin = jnp.cos(angle)[CUBE], jnp.sin(angle)[CUBE]
    number = lambda array: jnp.asarray(array, y.dtype)
    # a ray in the coordinates of a cube: turned into its frame, then cut with three pairs of planes
    x, depth = number(X - COLUMN - 0.5), number(V * UP - ROW)
    begin = jnp.stack([x * cos + depth * sin, depth * cos - x * sin])
    along = AWAY * jnp.maximum(jnp.stack([sin, cos]), 1e-6)
    enter, leave = (-HALF - begin) / along, (HALF - begin) / along
    top = number(np.broadcast_to((V * AWAY - 2 * HALF) / UP, ROW.shape))[None]
    floor = number(np.broadcast_to(V * AWAY / UP, ROW.shape))[None]
    enter = jnp.concatenate([enter, top])
    seen = (enter.max(0) < jnp.concatenate([leave, floor]).min(0)) & THERE
    painted = len(SHADES) * CUBE + jnp.argmax(enter, 0)
    nearest = jnp.where(seen[0], painted[0], jnp.where(seen[1], painted[1], len(PAINTS) - 1))
    return number(PAINTS)[nearest].reshape(*BY_PIXEL, 3).mean((1, 3))


def support():
    """Which values of the picture a parameter may change: those of pixels that may see its cube."""
    height, _, width, _ = BY_PIXEL
    _, row, column = np.nonzero(THERE)
    pixel = row // RAYS * width + column // RAYS
    seen = sparse.coo_array((np.ones(pixel.size), (pixel, CUBE[THERE])), (height * width, SIZE))
    return sd.matrix_support(sparse.kron(seen.tocsr(), np.ones((3, 1))), (height, width, 3))


def build(full: bool) -> Task:
    return drawn(
        "mosaic",
        TITLE,
        draw,
        REFERENCE,
        sigma=SIGMA,
        budget=Budget(60_000, 240) if full else Budget(8000, 30),
        seeds=10 if full else 2,
        image=draw,
        notes=f"{BY_PIXEL[2]} x {BY_PIXEL[0]} pixels of {RAYS} x {RAYS} rays",
    )
