r"""BFGS on finite differences whose width follows from the noise (HODR, appendix F).

The noise is estimated from a table of differences along a random line (ECnoise of Moré and Wild);
with it, and a rough second derivative, the best width of a forward difference is

$$ h = 8^{1/4} \sqrt{\epsilon_f / \nu_2} $$

A step backtracks until it has gained what the slope promises, but for twice the noise. Where no
step does, the noise and the width are estimated anew, which is the recovery of the source, cut
short; after a few of those in a row the search has converged.

Source: Berahas, Byrd, Nocedal, Derivative-free optimization of noisy functions via quasi-Newton
methods (2019).
"""

import math

import jax
import numpy as np

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat
from benchmarks.methods.quasi_newton import RADIUS, Dense, cut

TITLE = "BFGS, adaptive finite differences"
SPACING = 0.01  # of the points of the table and of the first second difference, in sigma
TABLE = 7  # points of the table
NARROWEST, WIDEST = 1e-4, 1.0  # widths, in sigma
ARMIJO, HALVINGS = 1e-4, 10
PATIENCE = 5  # recoveries in a row


def prepare(task: Task) -> Solve:
    """Compiles the loss of a batch of points."""
    flat = Flat(task)
    low, high = np.asarray(flat.low, float), np.asarray(flat.high, float)

    def losses(points):
        return np.asarray(flat.values(np.asarray(points, flat.dtype)), float)

    def widths(random, x):
        """The noise, and the width of the differences that suits it."""
        line = random.normal(size=flat.size)
        line *= SPACING * task.sigma / np.linalg.norm(line)
        values = losses(x + np.arange(TABLE)[:, None] * line)
        rounding = float(np.finfo(flat.dtype).eps) * max(np.max(np.abs(values)), 1e-30)
        noise = max(_noise(values), rounding)
        second = abs(values[0] - 2 * values[TABLE // 2] + values[-1])
        # half the table is the distance of the three points
        curvature = max(second, noise) / (SPACING * task.sigma * (TABLE // 2)) ** 2
        width = 8**0.25 * math.sqrt(noise / curvature)
        return noise, float(np.clip(width, NARROWEST * task.sigma, WIDEST * task.sigma))

    def slope(x, value, width):
        inward = np.where(x + width <= high, width, -width)
        return (losses(x + np.diag(inward)) - value) / inward

    def backtrack(x, value, g, p, noise):
        """The first halving of the step that gains enough, and its loss; or None."""
        for share in 0.5 ** np.arange(HALVINGS):
            new = np.clip(x + share * p, low, high)
            (found,) = losses(new[None])
            if found <= value + ARMIJO * share * (g @ p) + 2 * noise and (new != x).any():
                return new, found
        return None

    def solve(y0, key, record):
        random = np.random.default_rng(int(jax.random.randint(key, (), 0, 2**31 - 1)))
        x = flat.start(y0)
        (value,) = losses(x[None])
        noise, width = widths(random, x)
        g, model, failures = slope(x, value, width), None, 0
        while failures < PATIENCE:
            if model is None and g.any():
                model = Dense(float(np.linalg.norm(g)) / task.sigma, flat.size, damped=False)
            found = None
            if model is not None:
                p = cut(model.newton(g), RADIUS * task.sigma)
                found = backtrack(x, value, g, p, noise)
            if model is None or found is None:
                failures, model = failures + 1, None
                noise, width = widths(random, x)
                g = slope(x, value, width)
            else:
                failures = 0
                new, value = found
                new_g = slope(new, value, width)
                model.learn(new - x, new_g - g)
                x, g = new, new_g
            record(flat.tree(x))

    return solve


def _noise(values: np.ndarray) -> float:
    """ECnoise: the level on which successive orders of the table of differences agree."""
    levels = []
    for order in range(1, len(values)):
        values = np.diff(values)
        scale = math.factorial(order) ** 2 / math.factorial(2 * order)
        signs_differ = values.size < 2 or (np.sign(values[:-1]) != np.sign(values[1:])).any()
        levels.append((math.sqrt(scale * np.mean(values**2)), signs_differ))
    for i in range(len(levels) - 2):
        near = [level for level, _ in levels[i : i + 3]]
        if max(near) <= 4 * min(near) and levels[i][1]:
            return levels[i][0]
    return 0.0
