"""A mesh from its pictures, to compare filters of gradients (Fig. 10 to 12 of the paper).

As in the paper: an L1 loss of all views at each iteration, with random samples; Adam with one
second moment for all vertices, its betas (0.9, 0.99), lambda = 19, sigma_d = 0.5, sigma_phi = 0.4,
32 directions, and a learning rate that decays to 0.6 of what it was. A configuration is named after
the filter of the gradient and that of the first moment. Large Steps is laplacian-laplacian, the
paper's own laplacian-bilateral; the last also filters the second moment.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks.descents import Configuration, Descent
from benchmarks.scenes.mesh_renderer import Views, edges_of, render
from benchmarks.scenes.meshes import Faces, Positions

LAM, SIGMA_D, SIGMA_PHI = 19.0, 0.5, 0.4
B1, B2, DECAY = 0.9, 0.99, 0.6
SHOWN = (0, 3)  # views in pictures


def recovery(
    name: str,
    title: str,
    start: tuple[Positions, Faces],
    target: tuple[Positions, Faces],
    distance: Callable[[Float[Array, "points 3"]], Float[Array, " points"]],
    points: Positions,
    views: Views,
    *,
    marks: Sequence[int],
    **others: Any,
) -> Descent:
    """The descent from one mesh to the pictures of another, in all configurations.

    Args:
        name: of the folder of results.
        title: what is sought.
        start: the mesh whose vertices are moved. Its faces stay.
        target: what is sought, as a mesh.
        distance: from points to the surface that is sought.
        points: some of that surface, from which distances back to the mesh are taken.
        views: what pictures are taken.
        marks: the iterations that tables show; the last is where a run ends.
        others: further fields of the descent.
    """
    positions, faces = start
    edges = edges_of(faces)

    def gradient(y: Array, key: Array, scene: dict[str, Array]) -> Array:
        return jax.grad(lambda y: l1(render(y, faces, edges, views, key), scene["pictures"]))(y)

    def errors(y: Array, scene: dict[str, Array]) -> dict[str, Array]:
        there = jnp.max(jnp.abs(distance(y)))
        back = jnp.sqrt(jnp.max(squared_distances(scene["points"], y[faces])))
        return {
            "L1 error of the pictures": l1(render(y, faces, edges, views), scene["pictures"]),
            "Hausdorff distance": jnp.maximum(there, back),
        }

    def pictures(y: Array, scene: dict[str, Array]) -> dict[str, Array]:
        shown = render(y, faces, edges, views._replace(frames=views.frames[list(SHOWN)]))
        return {f"view {i}": picture for i, picture in zip(SHOWN, shown, strict=True)}

    def scene(seed: int) -> dict[str, Array]:
        return {"pictures": sought, "points": jnp.asarray(points, jnp.float32)}

    sought = jax.jit(
        lambda x: render(x, target[1], edges_of(target[1]), views._replace(samples=8))
    )(jnp.asarray(target[0], jnp.float32))
    return Descent(
        name=name,
        title=title,
        scene=scene,
        start=lambda seed, scene: jnp.asarray(positions, jnp.float32),
        gradient=gradient,
        errors=errors,
        score="L1 error of the pictures",
        configurations=configurations(faces, marks[-1]),
        marks=marks,
        pictures=pictures,
        target=lambda scene: {f"view {i}": scene["pictures"][i] for i in SHOWN},
        notes=f"{len(positions)} vertices, {len(views.frames)} views of {views.size}² "
        f"pixels with {views.samples**2} samples each.",
        **others,
    )


def configurations(faces: Faces, iterations: int) -> list[Configuration]:
    """Large Steps first, then the paper's own, then the other filters before and after."""
    filters = {
        "none": None,
        "laplacian": sd.filters.mesh_laplacian(faces, LAM),
        "bilateral": sd.filters.mesh_bilateral(faces, LAM, SIGMA_D, SIGMA_PHI),
    }

    def configuration(before: str, after: str, title: str = "", second_moment: Any = "max"):
        def optimiser(rate: ArrayLike) -> optax.GradientTransformation:
            return sd.filtered_adam(
                lambda step: rate * DECAY ** (step / iterations),
                B1,
                B2,
                prefilter=filters[before],
                postfilter=filters[after],
                second_moment=second_moment,
            )

        name = f"{before}-{after}" + ("-bilateral" if second_moment == "filter" else "")
        return Configuration(name, title or name.replace("-", ", "), {"": optimiser})

    return [
        configuration("laplacian", "laplacian", "Large Steps"),
        configuration("laplacian", "bilateral", "The paper's: laplacian, bilateral"),
        configuration("none", "laplacian"),
        configuration("none", "bilateral"),
        configuration("bilateral", "laplacian"),
        configuration("bilateral", "bilateral"),
        configuration("laplacian", "bilateral", second_moment="filter"),
    ]


def l1(pictures: Array, sought: Array) -> Array:
    return jnp.mean(jnp.abs(pictures - sought))


def squared_distances(points: Float[Array, "p 3"], triangles: Float[Array, "t 3 3"]) -> Array:
    """From each point to the nearest of the triangles."""
    corners = [triangles[:, i] for i in range(3)]
    sides = [corners[(i + 1) % 3] - corners[i] for i in range(3)]
    normal = jnp.cross(sides[0], -sides[2])
    tiny = jnp.finfo(points.dtype).tiny
    area = jnp.maximum(jnp.sum(normal**2, axis=1), tiny)

    def to_all(point: Array) -> Array:
        inside, nearest = jnp.ones(len(triangles), bool), jnp.full(len(triangles), jnp.inf)
        for corner, side in zip(corners, sides, strict=True):
            offset = point[None] - corner
            inside &= jnp.sum(jnp.cross(side, offset) * normal, axis=1) >= 0
            length = jnp.maximum(jnp.sum(side**2, axis=1), tiny)
            along = jnp.clip(jnp.sum(offset * side, axis=1) / length, 0, 1)
            nearest = jnp.minimum(nearest, jnp.sum((offset - along[:, None] * side) ** 2, axis=1))
        above = jnp.sum((point[None] - corners[0]) * normal, axis=1) ** 2 / area
        return jnp.min(jnp.where(inside, above, nearest))

    return jax.lax.map(to_all, points)
