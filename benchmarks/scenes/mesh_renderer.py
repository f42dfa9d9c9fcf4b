"""A renderer of triangle meshes in JAX whose gradients see silhouettes.

Views are orthographic. What each sample of a picture hits is found by a z-buffer, without AD. Its
colour is interpolated between the vertices of that triangle, which AD differentiates. That misses
that a silhouette moves: along each edge between a triangle that faces the view and one that does
not, a picture jumps, and its average over a pixel changes at the rate

    d/dθ ∫ I = ∫_edge (I_in - I_out) (n · dx/dθ) ds,

n being the edge's normal in the picture, outwards. `render` adds terms that are zero and have this
derivative, from one point of each edge: unbiased where the point is random and edges are visible
as a whole (after Li et al., Differentiable Monte Carlo Ray Tracing through Edge Sampling, 2018).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from benchmarks.scenes.meshes import Faces, sides_of, spiral
from smoothdiff.filters._triangles import vertex_normals

LIGHTS = np.array([[1.0, 0.6, 0.3], [-0.5, 0.9, -0.6], [-0.4, -0.8, 0.7], [0.5, -0.4, -0.9]])
COLOURS = np.array([[0.55, 0.25, 0.1], [0.1, 0.45, 0.15], [0.1, 0.15, 0.5], [0.25, 0.15, 0.25]])
ALBEDO_FLOOR = 0.1
BACKGROUND = 0.0
FAR = np.float32(1e9)


class Views(NamedTuple):
    """Orthographic views of the box from -extent to extent, `size` pixels wide and high.

    Each pixel is the mean of `samples`² samples. The rows of `frames` are right, down, and away
    from the viewer.
    """

    frames: Float[np.ndarray, "views 3 3"]
    size: int
    samples: int = 2
    extent: float = 1.6


class Edges(NamedTuple):
    """The edges of a closed mesh, with the two triangles at each."""

    ends: Int[np.ndarray, "edges 2"]
    faces: Int[np.ndarray, "edges 2"]


def views_around(number: int, size: int, samples: int = 2) -> Views:
    """Views from directions that are spread evenly over the sphere."""
    away = -spiral(number)[0]
    helper = np.where(abs(away[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(away, helper)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Views(np.stack([right, np.cross(away, right), away], axis=1), size, samples)


def edges_of(faces: Faces) -> Edges:
    """The edges of a closed mesh, each once."""
    sides = sides_of(faces)
    _, which = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    order = np.argsort(which, kind="stable").reshape(-1, 2)  # each edge has two sides
    return Edges(sides[order[:, 0]].astype(np.int32), (order // 3).astype(np.int32))


def render(
    positions: Float[Array, "vertices 3"],
    faces: Faces,
    edges: Edges,
    views: Views,
    key: Key[Array, ""] | None = None,
) -> Float[Array, "views size size 3"]:
    """Pictures of the mesh, in linear RGB.

    The key moves the samples, by the same random fraction of their distance in a view, and chooses
    the points on the edges. Without one, samples are in the middles and so are the points.
    """
    number, size = len(views.frames), views.size * views.samples
    if key is None:
        shift, along = jnp.full((number, 2), 0.5), jnp.full((number, len(edges.ends)), 0.5)
    else:
        for_shift, for_edges = jax.random.split(key)
        shift = jax.random.uniform(for_shift, (number, 2))
        along = jax.random.uniform(for_edges, (number, len(edges.ends)))
    screen = _project(positions, views, size) - jnp.pad(shift, ((0, 0), (0, 1)))[:, None]
    colours = _shade(vertex_normals(positions, faces))
    hit, depth = _visible(jax.lax.stop_gradient(screen), faces, size)
    picture = _interpolate(screen, colours, faces, hit)
    picture += _silhouettes(screen, colours, faces, edges, picture, depth, along, shift[:, None])
    return _pixels(picture, views)


def look(
    positions: Float[Array, "vertices 3"],
    faces: Faces,
    views: Views,
    albedo: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, "views size size 3"]:
    """What `render` shows without a key, but faster and with no derivative: a black box.

    The albedo of the vertices is one, unless it is given; then the lamps are white.
    """

    @jax.custom_batching.sequential_vmap  # at once they take longer, as all wait for the slowest
    def one(positions: Array, colours: Array) -> Array:
        size = views.size * views.samples
        screen = _project(positions, views, size) - jnp.array([[[0.5, 0.5, 0.0]]], positions.dtype)
        hit, _ = _visible(screen, faces, size)
        return _pixels(_interpolate(screen, colours, faces, hit), views)

    colours = _shade(vertex_normals(positions, faces))
    if albedo is not None:
        colours = albedo * jnp.mean(colours, axis=1, keepdims=True)
    return one(positions, colours)


def _pixels(picture: Array, views: Views) -> Array:
    """The means of the samples of each pixel."""
    samples = picture.reshape(-1, views.size, views.samples, views.size, views.samples, 3)
    return jnp.mean(samples, axis=(2, 4))


def _project(positions: Array, views: Views, size: int) -> Array:
    """(views, vertices, 3): across, down and away, in samples."""
    frames = jnp.asarray(views.frames, positions.dtype)
    turned = jnp.einsum("vij,nj->vni", frames, positions, precision="highest")
    middle = jnp.array([size / 2, size / 2, 0.0], positions.dtype)
    return turned * (size / (2 * views.extent)) + middle[None, None]


def _shade(normals: Array) -> Array:
    """Colours under wide lamps around the body, smooth in the normal."""
    lights = jnp.asarray(LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True), normals.dtype)
    lit = (0.5 + 0.5 * jnp.matmul(normals, lights.T, precision="highest")) ** 2
    return ALBEDO_FLOOR + lit @ jnp.asarray(COLOURS, normals.dtype)


def _double_area(a: Array, b: Array, c: Array) -> Array:
    """Of triangles in a picture, positive where they are seen from outside (y points down)."""
    u, v = b - a, c - a
    return u[..., 1] * v[..., 0] - u[..., 0] * v[..., 1]


def _visible(screen: Array, faces: Faces, size: int) -> tuple[Array, Array]:
    """(views, size²): the triangle that each sample hits, or -1, and its depth.

    The triangles that face a view, each with the samples in its bounding box, are one long list of
    candidates. A loop takes a stretch of that list at a time, so no triangle is too large.
    """
    number, total = len(screen), len(screen) * len(faces)
    corners = screen[:, faces].reshape(total, 3, 3)
    low = jnp.clip(jnp.ceil(corners[:, :, :2].min(axis=1)), 0, size).astype(jnp.int32)
    high = jnp.clip(jnp.floor(corners[:, :, :2].max(axis=1)), -1, size - 1).astype(jnp.int32)
    area = _double_area(*(corners[:, i, :2] for i in range(3)))
    spans = jnp.where((area > 0)[:, None], jnp.maximum(high - low + 1, 0), 0)
    counts = spans[:, 0] * spans[:, 1]
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    begins = ends - counts
    stretch = samples = number * size**2

    def take(carry):
        start, hit, depth = carry
        places = start + jnp.arange(stretch, dtype=jnp.int32)
        marks = jnp.zeros(stretch, jnp.int32).at[jnp.maximum(begins - start, 0)]
        triangle = jax.lax.cummax(marks.max(jnp.arange(total, dtype=jnp.int32), mode="drop"))
        inside_box = places - begins[triangle]
        width = jnp.maximum(spans[triangle, 0], 1)
        x: Array = low[triangle, 0] + inside_box % width
        y: Array = low[triangle, 1] + inside_box // width
        a, b, c = (corners[triangle, i] for i in range(3))
        point = jnp.stack([x, y], axis=1).astype(screen.dtype)
        weights = _barycentric(a, b, c, point)
        z = sum(w * corner[:, 2] for w, corner in zip(weights.T, (a, b, c), strict=True))
        inside = (weights.min(axis=1) >= 0) & (places < ends[-1])
        view = triangle // len(faces)
        sample = jnp.where(inside, (view * size + y) * size + x, samples)
        depth = depth.at[sample].min(z, mode="drop")
        nearest = inside & (depth.at[sample].get(mode="fill", fill_value=-FAR) == z)
        hit = hit.at[jnp.where(nearest, sample, samples)].set(triangle % len(faces), mode="drop")
        return start + stretch, hit, depth

    start = jnp.zeros((), jnp.int32)
    nothing = jnp.full(samples, -1, jnp.int32), jnp.full(samples, FAR, screen.dtype)
    _, hit, depth = jax.lax.while_loop(lambda c: c[0] < ends[-1], take, (start, *nothing))
    return hit.reshape(number, size**2), depth.reshape(number, size**2)


def _barycentric(a: Array, b: Array, c: Array, point: Array) -> Array:
    a, b, c = a[..., :2], b[..., :2], c[..., :2]
    weights = [_double_area(point, b, c), _double_area(a, point, c), _double_area(a, b, point)]
    area = _double_area(a, b, c)
    return jnp.stack(weights, axis=-1) / jnp.where(area > 0, area, 1)[..., None]


def _interpolate(screen: Array, colours: Array, faces: Faces, hit: Array) -> Array:
    """(views, size²,  3): the colours of what is hit."""
    size = round(hit.shape[1] ** 0.5)
    vertices = jnp.asarray(faces)[jnp.maximum(hit, 0)]
    corners = jax.vmap(lambda one, of: one[of, :2])(screen, vertices)
    y, x = np.divmod(np.arange(size**2), size)
    point = jnp.asarray(np.stack([x, y], axis=1), screen.dtype)[None]
    weights = _barycentric(corners[:, :, 0], corners[:, :, 1], corners[:, :, 2], point)
    mixed = jnp.sum(weights[..., None] * colours[vertices], axis=2)
    return jnp.where((hit >= 0)[..., None], mixed, BACKGROUND)


def _silhouettes(
    screen: Array,
    colours: Array,
    faces: Faces,
    edges: Edges,
    picture: Array,
    depth: Array,
    along: Array,
    shift: Array,
) -> Array:
    """Zero, with the derivative of the pictures as the silhouettes move."""
    number, samples = depth.shape
    size = round(samples**0.5)
    corners = screen[:, faces]
    facing = _double_area(*(corners[:, :, i, :2] for i in range(3))) > 0
    one, other = facing[:, edges.faces[:, 0]], facing[:, edges.faces[:, 1]]
    first, second = screen[:, edges.ends[:, 0]], screen[:, edges.ends[:, 1]]
    moving = first + along[..., None] * (second - first)
    point, side = jax.lax.stop_gradient((moving, (second - first)[..., :2]))
    # `ends` run counter-clockwise around faces[:, 0]; with y down its inside is to their right
    sign = jnp.where(one, 1.0, -1.0)[..., None].astype(screen.dtype)
    outwards = sign * jnp.stack([-side[..., 1], side[..., 0]], axis=-1)  # as long as the edge
    length = jnp.maximum(jnp.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    behind = _index(jnp.round(point[..., :2] + outwards / length), size)
    at, within = jnp.minimum(behind, samples - 1), behind < samples
    there = jnp.take_along_axis(jax.lax.stop_gradient(picture), at[..., None], axis=1)
    outside = jnp.where(within[..., None], there, BACKGROUND)
    beyond = jnp.take_along_axis(depth, at, axis=1)
    visible = (one != other) & ((beyond > point[..., 2]) | ~within)
    ends = jax.lax.stop_gradient(colours)[edges.ends]
    inside = ends[None, :, 0] + along[..., None] * (ends[:, 1] - ends[:, 0])[None]
    jump = jnp.where(visible[..., None], inside - outside, 0)
    swept = jnp.sum(outwards * (moving[..., :2] - point[..., :2]), axis=-1, keepdims=True)
    where = _index(jnp.floor(point[..., :2] + shift), size)  # whose random place may be there
    add = jax.vmap(lambda zero, at, term: zero.at[at].add(term, mode="drop"))
    return add(jnp.zeros((number, samples, 3), screen.dtype), where, jump * swept)


def _index(place: Array, size: int) -> Array:
    """The index of the sample of a row and a column, size² where there is none."""
    column, row = place[..., 0].astype(jnp.int32), place[..., 1].astype(jnp.int32)
    within = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    return jnp.where(within, row * size + column, size**2)
