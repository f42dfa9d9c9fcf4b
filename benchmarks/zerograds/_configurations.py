"""ZeroGrads, its ablations and the two older gradients, as methods of the harness.

An ablation is ours with one setting changed. The numbers of the paper are those of its Table 2: how
many times larger than ours an error is where ours is down to 5 %, for rendering, modelling and
animation.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import optax

import smoothdiff as sd
from benchmarks import methods
from benchmarks._task import Method, NotAble, Solve, Task
from benchmarks.methods import fr22, zerograds
from benchmarks.methods._adam import optimiser
from benchmarks.zerograds import _loop
from smoothdiff import surrogates

GROUPS = {
    "rendering": ("mosaic", "brdf"),
    "modelling": ("led", "wicker", "node-graph"),
    "animation": ("rocket10", "gravity"),
    "many parameters": ("mlp", "texture256"),
}
PAPER = {
    "rendering": {"no-smooth": 1.2, "no-nn": 8.9, "no-local": 12.3, "fd": 24.5, "fr22": 11.0},
    "modelling": {"no-smooth": 3.9, "no-nn": 792.4, "no-local": 613.4, "fd": 654.3, "fr22": 323.6},
    "animation": {"no-smooth": 1.5, "no-nn": 16.3, "no-local": 22.4, "fd": 10.2, "fr22": 3.3},
}
LARGEST = 10**7  # entries of a matrix that are worth a try
# a change of these makes earlier runs stale
BENCHMARKS, LIBRARY = Path(__file__).parents[1], Path(sd.__file__).parent
SOURCES = [
    *(BENCHMARKS / "methods" / name for name in ("_adam.py", "fr22.py", "zerograds.py")),
    *(BENCHMARKS / "zerograds" / name for name in ("_configurations.py", "_loop.py")),
    *(LIBRARY / "surrogates.py", *sorted(LIBRARY.glob("_solvers/*.py"))),
]
SOURCE = "".join(path.read_text() for path in SOURCES)
NOTHING, PAIRS = optax.identity(), sd.Gaussian(antithetic=True)


def ours(
    task: Task,
    before: optax.GradientTransformation = NOTHING,
    num_samples: int = zerograds.NUM_SAMPLES,
    **changes: Any,
) -> sd.ZeroGrads:
    """ZeroGrads as the benchmarks have it, but for `changes`; `before` sees the gradients first."""
    optim = optax.chain(before, optax.adam(zerograds.rate(task, num_samples)))
    return sd.ZeroGrads(task.sigma, num_samples=num_samples, optimizer=optim, **changes)


def smoothed_gradient(
    task: Task,
    before: optax.GradientTransformation = NOTHING,
    sampler: sd.AbstractSampler = PAIRS,
) -> sd.FirstOrder:
    """FR22 as the benchmarks have it, likewise."""
    num = fr22.NUM_SAMPLES
    steps = task.budget.evaluations // num
    return sd.FirstOrder(
        optax.chain(before, optimiser(task, num)),
        optax.linear_schedule(task.sigma, fr22.SIGMA_END * task.sigma, steps),
        num_samples=num,
        sampler=sampler,
        baseline="none",
    )


def configuration(name: str, title: str, **changes: Any) -> Method:
    """Ours, but for `changes`, as a method."""
    return _method(name, title, lambda task: ours(task, **changes), sorted(changes.items()))


def _method(name: str, title: str, build: Callable[[Task], Any], *settings: Any) -> Method:
    source = repr((SOURCE, settings))
    return Method(name, title, lambda task: _loop.in_stretches(build, task), source)


def ablations() -> list[Method]:
    """The rows of Table 2, ours first."""
    no_nn = configuration("no-nn", "NoNN", surrogate=surrogates.Quadratic)
    fd = methods.load("finite_differences")
    return [
        configuration("ours", "Ours"),
        configuration("no-smooth", "NoSmooth", inner_sigma=0.0),
        no_nn._replace(prepare=_where(_matrix_fits, no_nn.prepare)),
        configuration("no-local", "NoLocal", local=False),
        fd._replace(name="fd", title="FD", prepare=_where(_a_step_fits, fd.prepare)),
        _method("fr22", "FR22", smoothed_gradient),
    ]


def size(task: Task) -> int:
    """How many parameters a task has."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(task.reference))


def _where(check: Callable[[Task], None], prepare: Callable[[Task], Solve]):
    """`prepare` after a check that may raise NotAble."""

    def checked(task: Task) -> Solve:
        check(task)
        return prepare(task)

    return checked


def _matrix_fits(task: Task) -> None:
    if size(task) ** 2 > LARGEST:
        raise NotAble(f"needs a matrix of {size(task):,} by {size(task):,} numbers")


def _a_step_fits(task: Task) -> None:
    if 2 * size(task) > task.budget.evaluations:
        raise NotAble(f"needs {2 * size(task):,} evaluations for its first step")
