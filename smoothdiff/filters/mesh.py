"""Filters of what lives on the vertices of a triangle mesh: Laplacian smoothing and bilateral."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from smoothdiff._numbers import at_least_float32, floating
from smoothdiff._params import is_concrete
from smoothdiff._products import dot
from smoothdiff.filters._elimination import block_inverse
from smoothdiff.filters._triangles import as_faces, cotangents, edges, vertex_normals
from smoothdiff.filters.grid import Filter, Scale

CG_TOLERANCE = 1e-8  # of the residual, relative to the right-hand side
CG_STEPS = 10_000  # it took 170 at 10,000 vertices and lambda = 100
# There the error is 1e-6 of the signal, in float64 too, and in proportion to lambda: rounding of
# I + lambda L hides the I. Cotangent weights in float32: 3e-4.
MOST_LAM = 1e10


def mesh_laplacian(
    faces: Any,
    lam: int | float,
    *,
    power: int | float = 1,
    weights: str = "uniform",
) -> Callable[[Array, Any], Array]:
    r"""Laplacian smoothing on a mesh, as Large Steps does it.

    $$ \tilde h = (I + \lambda L)^{-p} h, \qquad
       (L h)_i = \sum_{j \sim i} w_{ij} (h_i - h_j) $$

    Uniform weights are 1. They depend on the faces alone, so the matrix is inverted once, on the
    host, by cutting the mesh into parts (`smoothdiff.filters._elimination`); what is left for each
    call are products of dense blocks, which jit, vmap, AD and accelerators take as they are. On
    two cores, 10,242 vertices, float32: 2.5 ms for 3 columns and 19 ms for 128, at any lambda,
    after half a second once. A sparse LU behind a callback took 2.0 and 106 ms; conjugate gradients
    with a Jacobi preconditioner took 17 and 241 ms at lambda = 19, and 29 and 382 ms at 100. The
    memory grows like n^1.5: 17 MB in float32 for that mesh.

    Cotangent weights, (cot α + cot β) / 2 of the angles that face the edge, change with the
    positions, which are the guide. There the solve is by conjugate gradients, and takes 69 ms for
    3 columns at lambda = 19, and 123 ms at 100; a factorisation alone would take 90 ms.

    Args:
        faces: (faces, 3), which vertices each triangle has. Known when the filter is made.
        lam: lambda, how far the filter smooths; about its square root in edges. From 0 to
            1e10; beyond, the filter is the mean of each connected part.
        power: how often the filter is applied.
        weights: "uniform" or "cotangent".

    Returns:
        A filter `filter(signal, guide) -> signal` of arrays (vertices, channels). Only cotangent
        weights look at the guide, the positions (vertices, 3). Vertices without a face stay as
        they are.

    Raises:
        ValueError: faces that are none; a lambda out of range; a power below 1; other weights; in
            the filter, a signal with fewer vertices than the faces have, or not of two axes.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> tetrahedron = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
        >>> smooth = sd.filters.mesh_laplacian(tetrahedron, lam=1.0)
        >>> signal = jnp.array([[5.0], [0.0], [0.0], [0.0]])
        >>> print(smooth(signal, None).round(4)[:, 0])
        [2. 1. 1. 1.]

    Source: Large Steps in Inverse Rendering of Geometry (2021), eq. 10; Spatiotemporal Bilateral
    Gradient Filtering for Inverse Rendering, section 4.3.
    """
    faces = as_faces(faces)
    _check_lam(lam)
    if power < 1 or int(power) != power:
        raise ValueError(f"power says how often the filter is applied, 1 or more: {power}")
    if weights not in ("uniform", "cotangent"):
        raise ValueError(f'weights must be "uniform" or "cotangent", not {weights!r}')
    if weights == "uniform":
        inverse = _uniform_inverse(faces, lam)
        solve = lambda signal, guide: inverse(signal)
    else:
        solve = _cotangent_solve(faces, lam)

    def filter(signal: Array, guide: Any) -> Array:
        signal = floating(signal)
        _check_signal(signal, faces)
        for _ in range(int(power)):
            signal = solve(signal, guide)
        return signal

    return filter


def mesh_bilateral(
    faces: Any, lam: int | float, sigma_d: Scale, sigma_phi: Scale, *, num_directions: int = 32
) -> Filter:
    r"""A cross-bilateral filter on a mesh: smooths, but not from one side of a crease to another.

    $$ \tilde h = \frac{\sum_i \Phi_i (I + \lambda L)^{-1} W_i h}
                       {\sum_i \Phi_i (I + \lambda L)^{-1} W_i 1}, \qquad
       W_i = e^{(n \cdot s_i - 1) / \sigma_d}, \quad \Phi_i = e^{(n \cdot s_i - 1) / \sigma_\phi} $$

    n are the normals of the vertices, from the positions that are the guide: sums over the faces at
    a vertex, weighted by area. s_i are Sobol points on the sphere. All directions and channels
    together take one solve of `mesh_laplacian` with uniform weights. The -1 cancels, and keeps the
    exponentials from overflowing.

    A vertex also counts itself with a weight of 8 machine epsilons. So it keeps its own value
    where the weights vanish, as they do for scales far below the angles between the directions.
    As `sigma_d` grows, the filter becomes `mesh_laplacian`.

    Args:
        faces: (faces, 3), which vertices each triangle has. Known when the filter is made.
        lam: lambda, how far the filter smooths; about its square root in edges. From 0 to
            1e10; beyond, the filter is the mean of each connected part.
        sigma_d: scale of the data term, in units of one minus a cosine. The paper's: 0.5.
        sigma_phi: scale of the partition of directions, likewise. The paper's: 0.4.
        num_directions: how many directions there are. The time is in proportion to it.

    Returns:
        A filter `filter(signal, guide) -> signal` of a signal (vertices, channels), guided by
        positions (vertices, 3). A triangle without an area has no say in a normal.

    Raises:
        ValueError: faces that are none; a lambda out of range; a scale that is not positive; no
            direction; in the filter, a signal or a guide of the wrong shape.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> tetrahedron = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
        >>> positions = jnp.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
        >>> signal = jnp.array([[5.0], [0.0], [0.0], [0.0]])
        >>> smooth = sd.filters.mesh_bilateral(tetrahedron, 1.0, sigma_d=0.5, sigma_phi=0.4)
        >>> bool(smooth(signal, positions)[0, 0] > 2.0)  # of mesh_laplacian
        True

    Source: Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering, eq. 5 and 6, after
    Solomon et al., A general framework for bilateral and mean shift filtering (2014).
    """
    faces = as_faces(faces)
    _check_lam(lam)
    for name, scale in (("sigma_d", sigma_d), ("sigma_phi", sigma_phi)):
        if is_concrete(scale) and not scale > 0:
            raise ValueError(f"{name} must be positive, not {scale}; inf switches its term off")
    if num_directions < 1:
        raise ValueError(f"num_directions must be at least 1, not {num_directions}")
    inverse = _uniform_inverse(faces, lam)
    directions = _sphere_points(num_directions)

    def filter(signal: Array, guide: Any) -> Array:
        signal = floating(signal)
        _check_signal(signal, faces)
        _check_positions(guide, signal)
        normals = vertex_normals(guide, faces).astype(signal.dtype)
        cosines = dot(normals, jnp.asarray(directions.T, signal.dtype))
        near, to = (
            jnp.exp((cosines - 1) / jnp.asarray(scale, signal.dtype))
            for scale in (sigma_d, sigma_phi)
        )
        with_one = jnp.concatenate([signal, jnp.ones_like(signal[:, :1])], axis=1)
        weighted = near[:, :, None] * with_one[:, None, :]
        smoothed = inverse(weighted.reshape(len(signal), -1)).reshape(weighted.shape)
        total = jnp.sum(to[:, :, None] * smoothed, axis=1)
        own = 8 * float(jnp.finfo(signal.dtype).eps)
        return (total[:, :-1] + own * signal) / (jnp.maximum(total[:, -1:], 0) + own)

    return filter


def _uniform_inverse(faces: np.ndarray, lam: int | float) -> Callable[[Array], Array]:
    """(I + λL)⁻¹ for weights of one."""
    n = int(faces.max()) + 1
    (i, j), _ = edges(faces)
    degrees = np.bincount(np.concatenate([i, j]), minlength=n)
    diagonal = np.arange(n)
    inverse = block_inverse(
        n,
        rows=np.concatenate([i, j, diagonal]),
        columns=np.concatenate([j, i, diagonal]),
        values=np.concatenate([np.full(2 * len(i), -float(lam)), 1 + lam * degrees]),
    )
    return lambda signal: jnp.concatenate([inverse(signal[:n]), signal[n:]])


def _cotangent_solve(faces: np.ndarray, lam: int | float) -> Filter:
    """(I + λL)⁻¹ for cotangent weights at the positions that are the guide."""
    (i, j), facing = edges(faces)

    def solve(signal: Array, guide: Any) -> Array:
        _check_positions(guide, signal)
        dtype, signal = signal.dtype, at_least_float32(signal)
        # the squares of its norm could overflow, or be zero
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(signal), axis=0, keepdims=True))
        size = jnp.where(size > 0, size, 1)
        signal = signal / size
        opposite = cotangents(guide, faces).astype(signal.dtype)
        weight = jnp.zeros((len(i), 1), signal.dtype).at[facing, 0].add(lam / 2 * opposite)
        diagonal = jnp.ones_like(signal[:, :1]).at[i].add(weight).at[j].add(weight)

        def matrix(h: Array) -> Array:
            flow = weight * (h[i] - h[j])
            return h.at[i].add(flow).at[j].add(-flow)

        solution, _ = jax.scipy.sparse.linalg.cg(
            matrix, signal, tol=CG_TOLERANCE, maxiter=CG_STEPS, M=lambda h: h / diagonal
        )
        return (solution * size).astype(dtype)

    return solve


def _sphere_points(number: int) -> np.ndarray:
    """Sobol points on the unit sphere, moved to the middles of their cells."""
    from scipy.stats import qmc

    bits = math.ceil(math.log2(number))
    u, v = qmc.Sobol(2, scramble=False).random_base2(bits)[:number].T + 0.5 ** (bits + 1)
    z, angle = 1 - 2 * u, 2 * math.pi * v
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _check_lam(lam: int | float) -> None:
    if not is_concrete(lam) or not 0 <= lam < math.inf:
        raise ValueError(
            f"lam must be a number of at least 0, known when the filter is made: {lam}"
        )
    if lam > MOST_LAM:
        raise ValueError(
            f"lam={lam} is above {MOST_LAM:.0e}, where rounding takes over: such a filter is the "
            "mean of each connected part, so take that mean itself"
        )


def _check_signal(signal: Array, faces: np.ndarray) -> None:
    if signal.ndim != 2:
        raise ValueError(
            f"a mesh filter is for arrays (vertices, channels), not of shape {signal.shape}; write "
            "signal[:, None] for a single channel"
        )
    if len(signal) <= faces.max():
        raise ValueError(
            f"faces has the index {faces.max()}, but there are {len(signal)} vertices: it must be "
            "the faces of this mesh, counted from 0"
        )


def _check_positions(guide: Any, signal: Array) -> None:
    if guide is None or jnp.shape(guide) != (len(signal), 3):
        raise ValueError(
            f"the guide of a mesh filter is the positions of its vertices, {(len(signal), 3)}, not "
            f"{guide if guide is None else jnp.shape(guide)}"
        )
