"""Eight functions of BBOB, as COCO's own package evaluates them on the host.

Each seed is another instance: another optimum, and another rotation. The loss is how far the
function is above its lowest value.

    N. Hansen, S. Finck, R. Ros, A. Auger: Real-Parameter Black-Box Optimization Benchmarking 2009:
    Noiseless Functions Definitions. INRIA RR-6829.
"""

import jax
import numpy as np

import smoothdiff as sd
from benchmarks._task import Budget, Task

TITLE = "BBOB: eight noiseless functions"
FUNCTIONS = {
    1: "sphere",
    2: "separable ellipsoid",
    6: "attractive sector",
    7: "step ellipsoid",
    8: "Rosenbrock",
    10: "rotated ellipsoid",
    13: "sharp ridge",
    14: "sum of different powers",
}


class Function:
    """A function of BBOB in n dimensions, less its lowest value; `choose` says which instance."""

    def __init__(self, number: int, n: int):
        self._number, self._n = number, n
        self.choose(0)

    def choose(self, seed: int) -> np.ndarray:
        """Turns to the instance of a seed, and gives its optimum."""
        import cocoex

        self._problem = cocoex.BareProblem("bbob", self._number, self._n, seed + 1)
        return np.asarray(self._problem.best_parameter(), float)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values at many points, (N, n) -> (N,)."""
        lowest = self._problem.best_value()
        return np.array([self._problem(point) - lowest for point in points])


def build(full: bool) -> list[Task]:
    """Quick: three functions in 5-D; full: all in 2, 5, 10 and 20-D."""
    functions, dimensions = (FUNCTIONS, (2, 5, 10, 20)) if full else ((1, 8, 10), (5,))
    return [_task(number, n, full) for number in functions for n in dimensions]


def _task(number: int, n: int, full: bool) -> Task:
    function = Function(number, n)
    on_host = sd.black_box(function, jax.ShapeDtypeStruct((), np.float64), batched=True)
    return Task(
        name=f"f{number}-{n}d",
        title=f"BBOB f{number}, {FUNCTIONS[number]}, in {n}-D",
        loss=on_host,
        exact_loss=on_host,
        start=lambda seed: jax.random.uniform(jax.random.key(seed), (n,), minval=-4, maxval=4),
        reference=function.choose(0),
        bounds=(np.full(n, -5.0), np.full(n, 5.0)),
        sigma=1.0,
        budget=Budget(2000 * n, 60) if full else Budget(800 * n, 10),
        seeds=20 if full else 2,
        precision="float64",
        optimum=0.0,
        choose=function.choose,
    )
