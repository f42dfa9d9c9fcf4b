"""Functions in closed form, whose lowest value is known: what optimisers are compared on.

`bbob` has those that COCO's own package evaluates on the host; each seed is another instance,
another optimum and another rotation, and the loss is how far it is above its lowest value.

    N. Hansen, S. Finck, R. Ros, A. Auger: Real-Parameter Black-Box Optimization Benchmarking 2009:
    Noiseless Functions Definitions. INRIA RR-6829.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks._task import Budget, Effort, Loss, Problem, Score, Task, entry
from benchmarks.tasks._drawn import uniform

QUAD_REFERENCE = (0.4, -0.7)
CONDITION = 1e6  # of the ellipsoid
BBOB = {
    1: "sphere",
    2: "separable ellipsoid",
    6: "attractive sector",
    7: "step ellipsoid",
    8: "Rosenbrock",
    10: "rotated ellipsoid",
    13: "sharp ridge",
    14: "sum of different powers",
}


def _function(
    full: bool,
    name: str,
    title: str,
    reference: np.ndarray,
    loss: Loss,
    residuals: Callable[[Array], Array] | None = None,
    *,
    start: Callable[[int], Array] | None = None,
    sigma: float = 1.0,
    quick: int = 800,
    choose: Callable[[int], np.ndarray] | None = None,
) -> Task:
    """A function in n dimensions whose lowest value is 0; `quick` evaluations for each of them."""
    n = reference.size
    much = Effort(2000 * n, 60, seeds=20) if full else Effort(quick * n, 10, seeds=2)
    return Task(
        f"{name}-{n}d",
        f"{title} in {n}-D",
        Problem((np.full(n, -5.0), np.full(n, 5.0)), sigma, much.budget, loss, residuals),
        Score(reference, optimum=0.0),
        start or uniform(n, -4, 4),
        much.seeds,
        "float64",
        choose,
    )


def _squares(residuals: Callable[[Array], Array]) -> Loss:
    return lambda y: jnp.sum(residuals(y) ** 2)


def bowl(y: Float[Array, "2"]) -> Float[Array, ""]:
    """The papers' quadratic, 5x² + 5y² + 7.5xy from the reference; six evaluations determine it."""
    d = y - jnp.asarray(QUAD_REFERENCE, y.dtype)
    return 5 * d[0] ** 2 + 5 * d[1] ** 2 + 7.5 * d[0] * d[1]


def quad(full: bool, **named: Any) -> Task:
    """Starts are within 3 of the reference."""
    reference, start = jnp.asarray(QUAD_REFERENCE), uniform(2, -3, 3, around=QUAD_REFERENCE)
    much = Effort(2000, 30, seeds=20) if full else Effort(600, 10, seeds=5)
    problem = Problem((reference - 10, reference + 10), 1.0, much.budget, bowl)
    return Task(problem=problem, score=Score(reference), start=start, seeds=much.seeds, **named)


def valley(y: Float[Array, "n"]) -> Float[Array, "m"]:
    """The residuals of Rosenbrock's function."""
    return jnp.concatenate([10 * (y[1:] - y[:-1] ** 2), 1 - y[:-1]])


def rosenbrock(full: bool, **named: Any) -> list[Task]:
    """A curved valley to where all are 1; all seeds have the classical start, (-1.2, 1, ...)."""

    def in_dimensions(n: int) -> Task:
        start = lambda seed: jnp.asarray(np.resize([-1.2, 1.0], n))
        given = {"reference": np.ones(n), "loss": _squares(valley), "residuals": valley}
        return _function(full, **named, **given, start=start, sigma=0.3)

    return [in_dimensions(n) for n in ((2, 10, 30) if full else (2, 10))]


def well(y: Float[Array, "2"]) -> Float[Array, ""]:
    """A negated Gaussian: indefinite or negative definite outside of its own width."""
    return -jnp.exp(-jnp.sum(y**2) / 2)


def negated_gaussian(full: bool, **named: Any) -> Task:
    """The minimum is to be found from a grid over (-3, 3)², quick 2 x 2, full 6 x 6.

    Appendix H of the paper on higher-order rendering. Its widths and normalisation are not stated
    there; here function and smoothing have width 1, and the lowest value is -1.
    """
    cells, budget = (6, Budget(2000, 30)) if full else (2, Budget(500, 10))
    line = (np.arange(cells) + 0.5) / cells * 6 - 3  # an even number leaves out the minimum
    grid = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    return Task(
        problem=Problem((np.full(2, -5.0), np.full(2, 5.0)), 1.0, budget, well),
        score=Score(np.zeros(2), optimum=-1.0),
        start=lambda seed: jnp.asarray(grid[seed % len(grid)]),
        seeds=len(grid),
        precision="float64",
        **named,
    )


def ellipsoid(full: bool, **named: Any) -> list[Task]:
    """Rotated, and 10⁶ times as curved along one axis as along another; all drawn once.

    It is f10 of BBOB without the oscillation: what a second-order method is made for.
    """

    def in_dimensions(n: int) -> Task:
        rng = np.random.default_rng(n)
        axes, _ = np.linalg.qr(rng.normal(size=(n, n)))
        reference = rng.uniform(-4, 4, n)
        stretched = np.sqrt(CONDITION) ** (np.arange(n) / (n - 1))

        def residuals(y: Float[Array, "n"]) -> Float[Array, "n"]:
            return jnp.asarray(stretched) * (jnp.asarray(axes) @ (y - reference))

        given = {"reference": reference, "loss": _squares(residuals), "residuals": residuals}
        return _function(full, **named, **given, quick=500)

    return [in_dimensions(n) for n in ((5, 10) if full else (5,))]


class OnHost:
    """A function of BBOB in n dimensions, less its lowest value; `choose` says which instance."""

    def __init__(self, number: int, n: int):
        self._number, self._n = number, n

    def choose(self, seed: int) -> np.ndarray:
        """Turns to the instance of a seed, and gives its optimum."""
        import cocoex

        self._problem = cocoex.BareProblem("bbob", self._number, self._n, seed + 1)
        return np.asarray(self._problem.best_parameter(), float)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values at many points, (N, n) -> (N,)."""
        lowest = self._problem.best_value()
        return np.array([self._problem(point) - lowest for point in points])


def bbob(full: bool, **named: Any) -> list[Task]:
    """Quick: three functions in 5-D; full: all in 2, 5, 10 and 20-D."""

    def in_dimensions(number: int, n: int) -> Task:
        function = OnHost(number, n)
        loss = sd.black_box(function, jax.ShapeDtypeStruct((), np.float64), batched=True)
        title, choose = f"BBOB f{number}, {BBOB[number]},", function.choose
        return _function(full, f"f{number}", title, choose(0), loss, choose=choose)

    numbers, dimensions = (BBOB, (2, 5, 10, 20)) if full else ((1, 8, 10), (5,))
    return [in_dimensions(number, n) for number in numbers for n in dimensions]


TASKS = (
    entry(
        "function",
        quad,
        "quad",
        "Quad: a quadratic in 2-D",
        parameters=2,
        plateaus=False,
        one_number=True,
    )
    | entry(
        "function",
        rosenbrock,
        "rosenbrock",
        "Rosenbrock's valley",
        parameters=(2, 10),
        plateaus=False,
    )
    | entry(
        "function",
        negated_gaussian,
        "negated-gaussian",
        "Negated Gaussian: a minimum among indefinite Hessians",
        parameters=2,
        plateaus=False,
        one_number=True,
    )
    | entry(
        "function",
        ellipsoid,
        "ellipsoid",
        "Ellipsoid of condition number 1e6",
        parameters=(5,),
        plateaus=False,
    )
    | entry(
        "function",
        bbob,
        "bbob",
        "BBOB: eight noiseless functions",
        parameters=(5, 5, 5),
        plateaus=False,
        one_number=True,
    )
)
