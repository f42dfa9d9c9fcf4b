"""Mosaic: 320 cubes on a floor, seen from the front and above. How far is each turned?

Cubes hide parts of those behind, and are drawn by 6 x 6 rays for each pixel, always the same, so
the picture is piecewise constant. A parameter of 1 is a quarter turn, from one side to the next.
Sigma is that of ZeroGrads (supplement, Table 1), in units of the domain.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import sparse

import smoothdiff as sd
from benchmarks._task import Effort
from benchmarks.tasks._drawn import program

ROWS, COLUMNS = 16, 20
SIZE = ROWS * COLUMNS
PIXELS, RAYS = 5, 6  # to the next column of cubes, which are one unit apart; along each axis
HALF = 0.33  # of a side; the diagonal is shorter than 1, so cubes do not touch
UP, AWAY = np.sin(np.radians(35)), np.cos(np.radians(35))  # of the camera's elevation
SHADES = (0.35, 1.0, 0.7)  # of the left side, the right side and the top
FLOOR = 0.15


REACH = np.sqrt(2) * HALF
# where rays meet the screen: from the left, (H, W), and upwards from the floor, (H,)
HEIGHT = (ROWS - 1 + 2 * REACH) * UP + 2 * HALF * AWAY
BY_PIXEL = (int(HEIGHT * PIXELS), RAYS, COLUMNS * PIXELS, RAYS)
LINES = np.arange(BY_PIXEL[0] * RAYS)
# each anywhere in its cell: an upright edge would meet all rays of a straight line at once
ASIDE = np.random.default_rng(0).random((LINES.size, BY_PIXEL[2] * RAYS))
X = (np.arange(ASIDE.shape[1]) + ASIDE) / PIXELS / RAYS
V = (LINES[::-1] + 0.5) / PIXELS / RAYS - REACH * UP
# the rows of cubes that a line of rays may meet, the nearer one first; some are not there
ROW = np.floor(V / UP + REACH).astype(int) - [[1], [0]]
THERE = (ROW >= 0) & (ROW < ROWS)
COLOURS = np.random.default_rng(1).uniform(0.2, 1, (ROWS, COLUMNS, 3))
REFERENCE = np.random.default_rng(2).uniform(0.1, 0.9, SIZE)


def draw(y: Float[Array, "320"]) -> Float[Array, "48 100 3"]:
    """The picture, linear RGB."""
    # axes: nearer or farther cube, line of rays, column of cubes, ray in the column
    number = lambda array: jnp.asarray(array, y.dtype)
    of_line = lambda array: number(array)[..., None, None]
    of_cube = lambda array: array[np.where(THERE, ROW, 0)]
    angle = jnp.pi / 2 * y.reshape(ROWS, COLUMNS)
    cos, sin = of_cube(jnp.cos(angle))[..., None], of_cube(jnp.sin(angle))[..., None]
    # a ray in the coordinates of a cube: turned into its frame, then cut with three pairs of planes
    x = number(X.reshape(len(X), COLUMNS, -1) % 1 - 0.5)[None]
    depth = of_line(V * UP - ROW)
    cuts = []
    for begin, along in ((x * cos + depth * sin, sin), (depth * cos - x * sin, cos)):
        faster = 1 / (AWAY * jnp.maximum(along, 1e-6))
        cuts.append(((-HALF - begin) * faster, (HALF - begin) * faster))
    (left, left_end), (right, right_end) = cuts
    top, floor = of_line((V * AWAY - 2 * HALF) / UP)[None], of_line(V * AWAY / UP)[None]
    side = jnp.maximum(left, right)
    enter = jnp.maximum(side, top)
    leave = jnp.minimum(jnp.minimum(left_end, right_end), floor)
    seen = (enter < leave) & of_line(THERE).astype(bool)
    shade = jnp.where(top > side, SHADES[2], jnp.where(right > left, SHADES[1], SHADES[0]))
    near: Array
    far: Array
    near, far = shade[..., None] * of_cube(number(COLOURS))[..., None, :]
    dark = jnp.where(seen[1, ..., None], far, FLOOR)
    return jnp.where(seen[0, ..., None], near, dark).reshape(*BY_PIXEL, 3).mean((1, 3))


def support():
    """Which values of the picture a parameter may change: those of pixels that may see its cube."""
    height, _, width, _ = BY_PIXEL
    which, line = np.nonzero(THERE)
    row, column = ROW[which, line, None], np.arange(COLUMNS)[None]
    pixel = (line[:, None] // RAYS * COLUMNS + column)[..., None] * PIXELS + np.arange(PIXELS)
    cube = np.broadcast_to((row * COLUMNS + column)[..., None], pixel.shape)
    entries = (np.ones(cube.size), (pixel.ravel(), cube.ravel()))
    seen = sparse.coo_array(entries, (height * width, SIZE))
    return sd.matrix_support(sparse.kron(seen.tocsr(), np.ones((3, 1))), (height, width, 3))


TASKS = program(
    "mosaic",
    "Mosaic: rotations of 320 cubes",
    parameters=320,
    plateaus=False,
    draw=draw,
    reference=REFERENCE,
    support=support,
    sigma=0.025,
    effort=(Effort(8000, 240, seeds=2), Effort(60_000, 900, seeds=10)),
    image=draw,
    notes=f"{BY_PIXEL[2]} x {BY_PIXEL[0]} pixels of {RAYS} x {RAYS} rays",
)
