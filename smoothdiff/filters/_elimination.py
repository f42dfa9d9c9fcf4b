"""Solving with a sparse symmetric matrix again and again: block elimination, as matrix products.

The unknowns are cut into compact parts, once and on the host, such that only the unknowns of a
separator see more than one part. With I for the insides of the parts and S for the separator,

    C = A_II⁻¹ A_IS,    x_S = (A_SS - A_SI C)⁻¹ (b_S - Cᵀ b_I),    x_I = A_II⁻¹ b_I - C x_S,

and what is inverted is dense and small: a block for each part, and the Schur complement. With
parts of about 2 √n unknowns on a surface, memory and one solve cost O(n^1.5).
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from smoothdiff._products import dot

LANDMARKS = 8  # distances from so many vertices tell where a vertex is


class BlockInverse(NamedTuple):
    """The inverse of a sparse positive definite matrix, applied by `inverse(b)`.

    p parts have at most m unknowns inside, and at most q neighbours among the s of the separator.
    """

    insides: Int[np.ndarray, "p m"]  # unknowns of each part, padded with n
    borders: Int[np.ndarray, "p q"]  # its neighbours' places in the separator, padded with s
    separator: Int[np.ndarray, " s"]
    blocks: Float[np.ndarray, "p m m"]  # A_II⁻¹
    couplings: Float[np.ndarray, "p m q"]  # C
    schur: Float[np.ndarray, "s s"]  # (A_SS - A_SI C)⁻¹
    places: Int[np.ndarray, " n"]  # where each unknown is among the insides and the separator

    def __call__(self, b: Float[Array, "n columns"]) -> Float[Array, "n columns"]:
        blocks, couplings, schur = (
            jnp.asarray(each, b.dtype) for each in (self.blocks, self.couplings, self.schur)
        )
        inside = b.at[self.insides].get(mode="fill", fill_value=0)
        up = dot(jnp.swapaxes(couplings, 1, 2), inside)
        at_separator = dot(schur, b[self.separator].at[self.borders].add(-up, mode="drop"))
        border = at_separator.at[self.borders].get(mode="fill", fill_value=0)
        inside = dot(blocks, inside) - dot(couplings, border)
        return jnp.concatenate([inside.reshape(-1, b.shape[1]), at_separator])[self.places]


def block_inverse(
    n: int,
    rows: Int[np.ndarray, " entries"],
    columns: Int[np.ndarray, " entries"],
    values: Float[np.ndarray, " entries"],
) -> BlockInverse:
    """The inverse of a symmetric positive definite matrix of n rows, from where it is not zero."""
    from scipy import sparse  # here, as it would be half of what importing smoothdiff costs

    matrix = sparse.csr_array((values, (rows, columns)), shape=(n, n))
    label = _parts(matrix)
    on_separator = np.zeros(n, bool)
    on_separator[rows[label[rows] > label[columns]]] = True
    separator = np.flatnonzero(on_separator)
    insides = [np.flatnonzero((label == i) & ~on_separator) for i in range(label.max() + 1)]
    to_separator = matrix[:, separator]
    borders = [np.unique(to_separator[inside].indices) for inside in insides]

    p, s = len(insides), len(separator)
    m, q = max(map(len, insides)), max(map(len, borders))
    blocks, couplings = np.tile(np.eye(m), (p, 1, 1)), np.zeros((p, m, q))
    for block, coupling, inside, border in zip(blocks, couplings, insides, borders, strict=True):
        block[: len(inside), : len(inside)] = matrix[inside][:, inside].toarray()
        coupling[: len(inside), : len(border)] = to_separator[inside][:, border].toarray()
    blocks, coupled = np.linalg.inv(blocks), couplings
    couplings = blocks @ coupled
    schur = to_separator[separator].toarray()
    for border, removed in zip(borders, np.swapaxes(coupled, 1, 2) @ couplings, strict=True):
        schur[np.ix_(border, border)] -= removed[: len(border), : len(border)]

    padded = _pad(insides, m, n)
    places = np.empty(n + 1, np.int32)  # the last is for the padding
    places[padded] = np.arange(p * m).reshape(p, m)
    places[separator] = p * m + np.arange(s)
    return BlockInverse(
        insides=padded,
        borders=_pad(borders, q, s),
        separator=separator.astype(np.int32),
        blocks=blocks,
        couplings=couplings,
        schur=np.linalg.inv(schur),
        places=places[:n],
    )


def _pad(rows: list[np.ndarray], length: int, fill: int) -> np.ndarray:
    return np.array([np.pad(r, (0, length - len(r)), constant_values=fill) for r in rows], np.int32)


def _parts(matrix: Any) -> np.ndarray:
    """The part of each unknown: halved again and again across where the graph is longest."""
    from scipy.sparse import csgraph

    n = matrix.shape[0]
    nearest, distances = np.full(n, np.inf), []
    for _ in range(LANDMARKS):  # each is as far from the others as can be
        landmark = np.argmax(nearest)
        found = csgraph.dijkstra(abs(matrix), indices=landmark, unweighted=True)
        nearest = np.minimum(nearest, np.where(np.isfinite(found), found, n))
        distances.append(np.where(np.isfinite(found), found, n))
    position = np.stack(distances, axis=1)
    parts = [np.arange(n)]
    for _ in range(max(0, round(math.log2(math.sqrt(n) / 2)))):
        parts = [half for part in parts for half in _halves(part, position[part])]
    label = np.empty(n, int)
    for i, part in enumerate(parts):
        label[part] = i
    return label


def _halves(part: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    centred = position - position.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    order = part[np.argsort(centred @ axes[:, -1], kind="stable")]
    return order[: len(part) // 2], order[len(part) // 2 :]
