"""Meshes fitted to pictures from several sides: a sphere becomes a head, an ellipsoid a banana.

After the meshes of higher-order differentiable rendering (section 4.1) and of ZeroGrads (supplement
2.2): `suzanne` is a head with ears, of 2,562 vertices, `banana` has 2,737 and colours too. The
rasteriser has hard edges, and no derivative of it is used. What vertices have, their positions
or their colours, is, after Large Steps in Inverse Rendering of Geometry (Nicolet et al. 2021),

    x = x₀ + c (I + λL)⁻¹ y,

so that a step or a perturbation of y bends a surface and does not crumple it. The number c is such
that noise of size 1 in y moves vertices by about 1.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks._task import Effort, Problem, Score, Task, entry
from benchmarks.scenes.mesh_renderer import Views, edges_of, look, views_around
from benchmarks.scenes.meshes import Faces, Positions, ball, icosphere
from smoothdiff.filters._triangles import vertex_normals

SIGMA, BOUND = 0.03, 0.3
LAM = 19.0
TILE = 2  # pixels, along each side of what is one term of the loss
REACH = 0.15  # how far a perturbation is seen around a vertex
BEHIND = 0.3  # the cosine of normals and the view, from where on a vertex is never seen
EXTENT = 1.25  # what a view shows, from its middle

SPHERE = 0.8  # radius at rest
SKULL = 0.75
# where bumps of the skull are, how high, and how wide as an angle
BUMPS = (
    ((1, 0.15, 0.1), 0.45, 0.28),  # ears
    ((-1, 0.15, 0.1), 0.45, 0.28),
    ((0, -0.55, 1), 0.3, 0.4),  # muzzle
    ((0.38, 0.35, 1), 0.16, 0.22),  # brows
    ((-0.38, 0.35, 1), 0.16, 0.22),
    ((0.35, 0.05, 1), -0.15, 0.15),  # eyes
    ((-0.35, 0.05, 1), -0.15, 0.15),
    ((0, 1, -0.2), 0.12, 0.5),  # top
)

ELLIPSOID = (0.4, 0.4, 0.85)  # half axes at rest
GREY = 0.5
COLOUR_GAIN = 5.0  # a colour of 0.15 is like a distance of 0.03
BEND = 0.55
YELLOW, GREEN, BROWN = (0.95, 0.8, 0.1), (0.35, 0.65, 0.15), (0.3, 0.18, 0.08)

Fields = dict[str, Array]  # "positions", and "albedo" where it is sought too


class Soft:
    """Values at vertices, (vertices, channels), as a function of y, which is 0 for `rest`."""

    def __init__(self, rest: np.ndarray, faces: Faces, gain: float = 1.0):
        self._rest, self._faces = np.asarray(rest, np.float32), faces
        self._smooth = sd.filters.mesh_laplacian(faces, LAM)
        noise = self._smooth(jax.random.normal(jax.random.key(0), rest.shape), None)
        self._gain = gain / float(jnp.std(noise))

    def __call__(self, y: Float[Array, "vertices channels"]) -> Float[Array, "vertices channels"]:
        """The values."""
        return jnp.asarray(self._rest) + self._gain * self._smooth(y, None)

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """The y of given values."""
        moved = (values - self._rest) / self._gain
        i, j = edges_of(self._faces).ends.T
        found, flow = moved.copy(), LAM * (moved[i] - moved[j])
        np.add.at(found, i, flow)
        np.add.at(found, j, -flow)
        return found.astype(np.float32)


def support(soft: Soft, faces: Faces, views: Views) -> Callable[[Any], Array]:
    """Which tiles of the views a vertex may change: those near to where it is seen.

    Smoothed perturbations only fade with the distance, so this is an approximation: about two
    fifths of what a vertex changes are there.
    """
    tiles = views.size // TILE
    half = views.extent / tiles
    middles = jnp.asarray(half * (2 * np.arange(tiles) + 1) - views.extent, jnp.float32)
    frames = jnp.asarray(views.frames, jnp.float32)

    def around(y: dict[str, Array]) -> Callable[[dict[str, Array]], Array]:
        positions = soft(y["positions"])
        right, down, _ = jnp.einsum("vin,kn->ivk", frames, positions)
        facing = jnp.einsum("vn,kn->vk", frames[:, 2], vertex_normals(positions, faces)) < BEHIND
        across, along = (
            jnp.maximum(jnp.abs(at[:, None] - middles[None, :, None]) - half, 0)
            for at in (right, down)
        )
        near = along[:, :, None] ** 2 + across[:, None] ** 2 < REACH**2
        matrix = (near & facing[:, None, None]).astype(positions.dtype)

        def blame(y: dict[str, Array]) -> Float[Array, "views tiles tiles"]:
            return matrix @ sum(jnp.sum(field, axis=1) for field in y.values())

        return blame

    return sd.moving_support(around)


def suzanne(full: bool, **named: Any) -> Task:
    """y are coordinates of the positions."""
    directions, faces = icosphere(4)
    fields = {"positions": (Soft(SPHERE * directions, faces), head(directions))}
    return mesh_task(full, faces, fields, 8000, **named)


def banana(full: bool, **named: Any) -> Task:
    """y are coordinates of the positions and of the colours, linear RGB."""
    directions, faces = ball(2737)
    rest = directions * ELLIPSOID
    colours = Soft(np.full(rest.shape, GREY), faces, COLOUR_GAIN)
    fields = {
        "positions": (Soft(rest, faces), bent(directions)),
        "albedo": (colours, painted(directions)),
    }
    return mesh_task(full, faces, fields, 16_000, **named)


def mesh_task(
    full: bool,
    faces: Faces,
    fields: dict[str, tuple[Soft, np.ndarray]],
    evaluations: int,
    **named: Any,
) -> Task:
    """`fields` are what vertices have, each as a function of its y, and what is sought.

    Quick: 6 views of 24 x 24 pixels, `evaluations`; full: the 13 of ZeroGrads, of 32 x 32.
    """
    number, size = (13, 32) if full else (6, 24)
    much = Effort(40_000, 1200, seeds=5) if full else Effort(evaluations, 300, seeds=1)
    views = views_around(number, size)._replace(extent=EXTENT)
    soft = {field: of for field, (of, _) in fields.items()}
    reference = {field: jnp.asarray(of.coordinates(x)) for field, (of, x) in fields.items()}

    def pictures(y: Fields) -> Float[Array, "views size size 3"]:
        return look(faces=faces, views=views, **{field: soft[field](y[field]) for field in y})

    target = jax.jit(pictures)(reference)

    def residuals(y: Fields) -> Float[Array, "views tiles tiles rest"]:
        """The pixels of a tile together."""
        tiles = size // TILE
        found = (pictures(y) - target).reshape(number, tiles, TILE, tiles, TILE, 3)
        return jnp.moveaxis(found, 3, 2).reshape(number, tiles, tiles, -1)

    def terms(y: Fields) -> Float[Array, "views tiles tiles"]:
        return jnp.sum(residuals(y) ** 2, axis=-1) / target.size

    def start(seed: int) -> Fields:
        shape = reference["positions"].shape
        return dict.fromkeys(reference, SIGMA / 3 * jax.random.normal(jax.random.key(seed), shape))

    ends = jax.tree.map(lambda y: jnp.full_like(y, BOUND), reference)
    return Task(
        problem=Problem(
            bounds=(jax.tree.map(jnp.negative, ends), ends),
            sigma=SIGMA,
            budget=much.budget,
            residuals=residuals,
            terms=terms,
            support=support(soft["positions"], faces, views),
        ),
        score=Score(reference, image=lambda y: jnp.concatenate(list(pictures(y)[:4]), axis=1)),
        start=start,
        seeds=much.seeds,
        notes=f"{number} views of {size} x {size} pixels. Vertices may slide along the "
        "surface: the parameter error says nothing.",
        **named,
    )


def head(directions: Positions) -> Positions:
    """Where the rays from the middle leave the head."""
    radius = np.full(len(directions), SKULL)
    for place, height, width in BUMPS:
        cosine = directions @ np.array(place) / np.linalg.norm(place)
        radius += height * np.exp(-0.5 * (np.arccos(np.clip(cosine, -1, 1)) / width) ** 2)
    return radius[:, None] * directions


def bent(directions: Positions) -> Positions:
    """A long body with three blunt edges, bent, thin at its ends."""
    x, y, z = directions.T
    edges = 1 + 0.08 * np.cos(3 * np.arctan2(y, x))
    return np.stack([0.27 * edges * x + BEND * (z**2 - 0.4), 0.27 * edges * y, z], axis=1)


def painted(directions: Positions) -> np.ndarray:
    """Yellow, green towards one end, with brown ends and spots."""
    x, y, z = directions.T
    share = np.clip((z - 0.3) / 0.5, 0, 1)[:, None]
    colour = (1 - share) * np.array(YELLOW) + share * np.array(GREEN)
    spots = np.sin(4 * x + 2) * np.sin(5 * y + 1) * np.sin(5 * z)
    brown = np.clip(4 * np.maximum(spots - 0.3, np.abs(z) - 0.8), 0, 1)[:, None]
    return (1 - brown) * colour + brown * np.array(BROWN)


TASKS = entry(
    "large",
    suzanne,
    "suzanne",
    "Suzanne: 7,686 coordinates of a mesh",
    parameters=7_686,
    plateaus=False,
) | entry(
    "large",
    banana,
    "banana",
    "Banana: 16,422 coordinates and colours of a mesh",
    parameters=16_422,
    plateaus=False,
)
