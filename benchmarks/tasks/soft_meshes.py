"""Meshes fitted to pictures from several sides: a sphere becomes a head, an ellipsoid a banana.

After the meshes of higher-order differentiable rendering (section 4.1) and of ZeroGrads (supplement
2.2): `suzanne` is a head with ears, of 2,562 vertices, `banana` has 2,737 and colours too. The
rasteriser has hard edges, and no derivative of it is used. y are smooth coordinates of what the
vertices have.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Problem, Score, Task, TaskEntry
from benchmarks.scenes.mesh_renderer import look, views_around
from benchmarks.scenes.meshes import Faces, Positions, ball, icosphere
from benchmarks.scenes.soft_mesh import TILE, Soft, support

SUZANNE = "Suzanne: 7,686 coordinates of a mesh"
BANANA = "Banana: 16,422 coordinates and colours of a mesh"

SIGMA, BOUND = 0.03, 0.3
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


def suzanne(full: bool) -> Task:
    """y are coordinates of the positions."""
    directions, faces = icosphere(4)
    positions = Soft(SPHERE * directions, faces), head(directions)
    budget = Budget(40_000, 1200) if full else Budget(8000, 300)
    return mesh_task(full, "suzanne", SUZANNE, faces, {"positions": positions}, budget)


def banana(full: bool) -> Task:
    """y are coordinates of the positions and of the colours, linear RGB."""
    directions, faces = ball(2737)
    rest = directions * ELLIPSOID
    colours = Soft(np.full(rest.shape, GREY), faces, COLOUR_GAIN)
    fields = {
        "positions": (Soft(rest, faces), bent(directions)),
        "albedo": (colours, painted(directions)),
    }
    budget = Budget(40_000, 1200) if full else Budget(16_000, 300)
    return mesh_task(full, "banana", BANANA, faces, fields, budget)


def mesh_task(
    full: bool,
    name: str,
    title: str,
    faces: Faces,
    fields: dict[str, tuple[Soft, np.ndarray]],
    budget: Budget,
) -> Task:
    """Quick: 6 views of 24 x 24 pixels; full: the 13 of ZeroGrads, of 32 x 32.

    Args:
        full: As for all tasks.
        name: Of the task.
        title: What is sought.
        faces: The triangles of the mesh.
        fields: What vertices have, each as a function of its y, and what is sought.
        budget: Where a run ends.
    """
    number, size = (13, 32) if full else (6, 24)
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
        name=name,
        title=title,
        problem=Problem(
            bounds=(jax.tree.map(jnp.negative, ends), ends),
            sigma=SIGMA,
            budget=budget,
            residuals=residuals,
            terms=terms,
            support=support(soft["positions"], faces, views),
        ),
        score=Score(reference, image=lambda y: jnp.concatenate(list(pictures(y)[:4]), axis=1)),
        start=start,
        seeds=5 if full else 1,
        notes=f"{number} views of {size} x {size} pixels. Vertices may slide along the "
        "surface: the parameter error says nothing.",
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


TASKS = {
    "suzanne": TaskEntry(SUZANNE, "large", suzanne),
    "banana": TaskEntry(BANANA, "large", banana),
}
