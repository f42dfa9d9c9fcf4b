"""Node graph: which of 24 edges does the graph of a procedural texture have?

An edge is there where its entry rounds to 1. Three nodes make patterns, four change or join what
they are given, and the last colours it. Of several edges to one input the first counts, so an edge
may have no effect, and more than one graph has the sought texture. Sigma is that of ZeroGrads
(supplement, Table 1).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from benchmarks._task import Effort
from benchmarks.tasks._drawn import program

PIXELS = 32
# input -> the nodes from which an edge to it can come; the patterns are nodes 0 to 2
INPUTS = {
    "3a": (0, 1, 2),
    "3b": (0, 1, 2),
    "4a": (0, 1, 2),
    "4b": (0, 1, 2),
    "5a": (3, 4),
    "5b": (3, 4),
    "6": (2, 3, 4, 5),
    "7": (3, 4, 5, 6),
}
SOUGHT = {"3a": 0, "3b": 1, "4a": 2, "4b": 1, "5a": 3, "5b": 4, "6": 5, "7": 6}
EDGES = [(where, source) for where, sources in INPUTS.items() for source in sources]
REFERENCE = np.array([0.75 if SOUGHT[where] == source else 0.25 for where, source in EDGES])
NOTHING = 0.3  # what an input without an edge is given
DARK, LIGHT = (0.1, 0.05, 0.2), (0.95, 0.8, 0.5)


Y, X = np.mgrid[0:PIXELS, 0:PIXELS] / PIXELS
BRICKS = (4 * Y % 1 > 0.25) & (2 * (X + np.floor(4 * Y) % 2 / 4) % 1 > 0.125)
RINGS = 0.5 + 0.5 * np.cos(8 * np.pi * np.hypot(X - 0.5, Y - 0.5))
PATTERNS = np.stack([BRICKS, RINGS, (X + Y) * 3 % 1])


def edges(y: Float[Array, "24"]) -> Bool[Array, "24"]:
    """Which edges are there."""
    return jnp.round(y) == 1


def draw(y: Float[Array, "24"]) -> Float[Array, "32 32 3"]:
    """The texture that the graph makes."""
    there = dict(zip(EDGES, edges(y), strict=True))
    nodes = dict(enumerate(jnp.asarray(PATTERNS, y.dtype)))

    def given(where: str) -> Array:
        picture = jnp.full_like(nodes[0], NOTHING)
        for source in reversed(INPUTS[where]):
            picture = jnp.where(there[where, source], nodes[source], picture)
        return picture

    nodes[3] = (given("3a") + given("3b")) / 2
    nodes[4] = given("4a") * given("4b")
    nodes[5] = jnp.maximum(given("5a"), given("5b"))
    nodes[6] = 1 - given("6") ** 2
    shade = given("7")[..., None]
    dark, light = (jnp.asarray(colour, y.dtype)[None, None] for colour in (DARK, LIGHT))
    return dark + (light - dark) * shade


# starts are anywhere in the domain, so each edge is there or not by chance
TASKS = program(
    "node-graph",
    "Node graph: the edges of a procedural texture",
    parameters=24,
    plateaus=True,
    draw=draw,
    reference=REFERENCE,
    sigma=0.2,
    effort=(Effort(2000, 60, seeds=3), Effort(10_000, 240, seeds=10)),
    image=draw,
    meaning=edges,
    optimum=0.0,
    notes=f"{PIXELS} x {PIXELS} pixels; an edge may have no effect",
)
