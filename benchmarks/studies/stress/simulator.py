"""A stiff oscillator with an event as a black box: van der Pol at mu = 1000, solved on the host.

The solution creeps for about 0.8 mu, jumps to the other side within 1/mu, and so on. A loss that
asks whether it has jumped k times by some time is flat on both sides of an edge.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import chebyshev
from scipy.integrate import solve_ivp
from scipy.special import ndtr

import smoothdiff as sd
from benchmarks.studies.stress._check import Check, relative

MU, START = 1000.0, 2.0
SIGMA = np.array([30.0, 0.05])
REACH = 5.5  # widths that the reference covers
CREEP = 0.807  # from jump to jump, in units of mu


class Crossing(NamedTuple):
    """The event that the oscillator passes its middle; the solver stops at the last one wanted."""

    terminal: int

    def __call__(self, t: float, y: np.ndarray) -> float:
        return y[0]


def jump_time(p: np.ndarray, jumps: int) -> float:
    """When the oscillator, p = (mu, where it is at rest at first), jumps for the last time."""
    mu, start = map(float, p)

    found = solve_ivp(
        lambda t, y: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]],
        (0, 2 * CREEP * mu * (jumps + 1)),
        [start, 0.0],
        method="Radau",
        jac=lambda t, y: [[0, 1], [-2 * mu * y[0] * y[1] - 1, mu * (1 - y[0] ** 2)]],
        events=Crossing(jumps),
        rtol=1e-4,
        atol=1e-7,
    )
    return found.t_events[0][-1]


def smoothed(jumps: int, deadline: float) -> Callable[[np.ndarray], np.ndarray]:
    """F(d) = (mean time of the last jump, chance that it is in time), d in widths off the middle.

    The time is smooth in the parameters, so a polynomial through a few solutions knows it; for each
    start the chance is the Gaussian's mass on one side of the mu that just makes it.
    """
    nodes = chebyshev.chebpts1(6)
    times = [[jump_time([MU, START] + REACH * SIGMA * [a, b], jumps) for b in nodes] for a in nodes]
    back = np.linalg.inv(chebyshev.chebvander(nodes, 5))
    fit = back @ np.array(times) @ back.T
    fine = np.linspace(-REACH, REACH, 1001)
    at = np.linspace(-5, 5, 101)
    weight = np.exp(-(at**2) / 2)
    weight /= np.sum(weight)

    def time(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return chebyshev.chebgrid2d(a / REACH, b / REACH, fit)

    def value(d: np.ndarray) -> np.ndarray:
        mean = weight @ time(d[0] + at, d[1] + at) @ weight
        edges = [np.interp(deadline, column, fine) for column in time(fine, d[1] + at).T]
        return np.array([mean, weight @ ndtr(np.array(edges) - d[0])])

    return value


def oscillator(jumps: int = 3, num_samples: int = 256) -> Iterator[Check]:
    """Gradients of the time of the k-th jump, and of the chance that it is in time."""
    deadline = CREEP * jumps * (MU + 0.5 * SIGMA[0])
    box = sd.black_box(
        lambda p: np.float32(jump_time(p, jumps)), jax.ShapeDtypeStruct((), jnp.float32)
    )

    def fun(p):
        time = box(p)
        return jnp.stack([time, (time < deadline).astype(time.dtype)])

    g = sd.smooth_jacobian(fun, SIGMA, num_samples=num_samples)
    found = jax.jit(g)(jax.random.key(0), jnp.array([MU, START], jnp.float32))
    found = np.asarray(found, np.float64) * SIGMA
    reference, step = smoothed(jumps, deadline), 0.01
    exact = [(reference(step * e) - reference(-step * e)) / (2 * step) for e in np.eye(2)]
    for i, what in enumerate(("time of the jump", "whether it is in time")):
        seen = relative(found[i], np.array(exact)[:, i])
        yield Check(f"{what}, jump {jumps}", "relative error", 0.05, seen)
