"""The problems: CUTEst's as sif2jax has them, with residuals and without, and COCO's BBOB.

N. I. M. Gould, D. Orban, Ph. L. Toint: CUTEst: a Constrained and Unconstrained Testing
Environment with Safe Threads. Computational Optimization and Applications 60 (2015).
N. Hansen, S. Finck, R. Ros, A. Auger: Real-Parameter Black-Box Optimization Benchmarking 2009:
Noiseless Functions Definitions. INRIA RR-6829.
"""

import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.methods._flat import package
from benchmarks.studies.profiles import models
from benchmarks.studies.profiles.kinds import CLEAN, RESIDUALS, SCALARS, Kind

LETTERS, OTHERS = ("A", "L"), ("M", "Z")  # that names begin with: to develop on, to check
MOST_RESIDUALS = 500
MOST = 20  # parameters
STRIDE, SMALL = 10, 5  # quick: every tenth of those with up to five parameters
WIDTH, BOX_WIDTH = 0.1, 2.0  # where to begin: as a share of the largest parameter; in BBOB's box
BOX = 5.0  # of BBOB, to both sides
TARGETS = tuple(np.geomspace(1e2, 1e-8, 51))  # above the lowest value
# by name, what only the other problems of sif2jax need and what takes a minute to import
SLOW = {"sif2jax.cutest._constrained_minimisation.cleuven7": SimpleNamespace(CLEUVEN7=object)}


class Case(NamedTuple):
    """A function and where to begin; residuals are an array, other values have no axis.

    `lowest` is the lowest value, or None where that is not known.
    """

    name: str
    fun: Callable[[np.ndarray], Any]
    start: np.ndarray
    width: float
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    lowest: float | None = None
    kind: Kind = CLEAN


class Panel(NamedTuple):
    """Cases that are counted together. A budget is a number of units, each `n + more` evaluations.

    With targets, the pairs of a case and a target are counted.
    """

    set: str
    title: str
    cases: list[Case]
    budgets: tuple[int, ...]  # where shares are read; the last ends a run
    more: int = 1
    targets: tuple[float, ...] = ()

    def evaluations(self, case: Case, budget: int = 1) -> int:
        return budget * (case.start.size + self.more)


def residuals(full: bool) -> Iterator[Panel]:
    """Least squares: up to 20 parameters and 500 residuals, no fewer than parameters."""
    cases, budgets = _with_residuals(full), (5, 10, 20, 30) if full else (5, 10, 20)
    for kind in RESIDUALS:
        seen = [case._replace(kind=kind) for case in cases]
        yield Panel("residuals", f"Residuals, {kind.title}", seen, budgets)


def scalars(full: bool) -> Iterator[Panel]:
    """Numbers: up to 20 parameters; and sums of absolute residuals, which have kinks."""
    cases, budgets = _numbers(full), (10, 50, 200, 500) if full else (10, 30, 100)
    for kind in SCALARS:
        seen = [case._replace(kind=kind) for case in cases]
        yield Panel("scalars", f"Scalars, {kind.title}", seen, budgets)
    kinks = [_absolute(case) for case in _with_residuals(full)]
    yield Panel("scalars", "Scalars, sums of absolute values", kinks, budgets)


def held_out(full: bool) -> Iterator[Panel]:
    """Numbers with other names, which nothing was chosen on."""
    for kind in (CLEAN, *RESIDUALS[1::2]):
        seen = [case._replace(kind=kind) for case in _numbers(full, letters=OTHERS)]
        yield Panel("held_out", f"Scalars from M to Z, {kind.title}", seen, (10, 50))


def larger(full: bool) -> Iterator[Panel]:
    """Numbers of 21 to 50 parameters, with smaller budgets, as a step of ours takes 15 ms."""
    if full:
        yield Panel("scalars50", "Scalars, clean, 50 parameters", _numbers(True, 21, 50), (10, 50))


def bbob(n: int, full: bool) -> Iterator[Panel]:
    """Each start is drawn within the box. The quick setting has six functions in 5-D."""
    if n > 5 and not full:
        return
    cocoex = package("cocoex", "coco-experiment")
    numbers, instances = (range(1, 25), (1, 2, 3)) if full else ((1, 6, 8, 10, 15, 21), (1,))
    cases = [_bbob(cocoex, f, n, instance) for f, instance in product(numbers, instances)]
    budgets = (10, 30, 100, 300, 1000) if full else (10, 100)
    yield Panel("bbob", f"BBOB, {n}-D", cases, budgets, more=0, targets=TARGETS)


def large(n: int, full: bool) -> Iterator[Panel]:
    """The 24 functions of COCO's large-scale suite, whose rotations are cheap."""
    if not full:
        return
    cocoex = package("cocoex", "coco-experiment")
    suite = cocoex.Suite("bbob-largescale", "", f"dimensions:{n} instance_indices:1")
    cases = []
    for number in range(1, 25):
        problem = suite.get_problem_by_function_dimension_instance(number, n, 1)
        # the lowest value is that of the function and the instance in any dimension
        best = cocoex.BareProblem("bbob", number, 2, 1).best_value()
        cases.append(_case(problem, best, number, n, 1))
    yield Panel(f"bbob{n}", f"BBOB, {n}-D", cases, (10, 30), more=0, targets=TARGETS)


def settings(full: bool) -> Iterator[Panel]:
    """Of models: those that something was chosen on, and others. The quick setting has two."""
    found, starts = models.models(), models.STARTS if full else 1
    chosen = (
        (models.CHOSEN_ON, models.OTHERS) if full else (models.CHOSEN_ON[-1:], models.OTHERS[-1:])
    )
    for title, names in zip(
        ("Settings of models", "Settings of other models"), chosen, strict=True
    ):
        cases = [
            _setting(f"{name}-{number}", models.error(found[name]), start)
            for name in names
            for number, start in enumerate(models.starts(found[name], starts))
        ]
        yield Panel("settings", title, cases, (5, 10, 20, 30) if full else (5, 10))


def _setting(name: str, fun: Callable[[np.ndarray], float], start: np.ndarray) -> Case:
    return Case(name, fun, start, models.WIDTH, (np.zeros_like(start), np.ones_like(start)))


def _bbob(cocoex: ModuleType, number: int, n: int, instance: int) -> Case:
    problem = cocoex.BareProblem("bbob", number, n, instance)
    return _case(problem, problem.best_value(), number, n, instance)


def _case(problem: Any, best: float, number: int, n: int, instance: int) -> Case:
    box = np.full(n, BOX)
    start = np.random.default_rng((number, n, instance)).uniform(-BOX, BOX, n)
    above = lambda x: problem(x) - best
    return Case(f"f{number}-{n}d-{instance}", above, start, BOX_WIDTH, (-box, box), 0.0)


def _absolute(case: Case) -> Case:
    return case._replace(fun=lambda x: np.sum(np.abs(case.fun(x))))


@cache
def _with_residuals(full: bool) -> list[Case]:
    def residuals(problem: Any) -> Callable[[jax.Array], jax.Array]:
        parts = lambda y: map(jnp.ravel, jax.tree.leaves(problem.constraint(y)))
        return lambda y: jnp.concatenate(list(parts(y)))

    found = _named(_sif2jax().nonlinear_equations_problems, MOST if full else SMALL)
    funs = {name: (problem, residuals(problem)) for name, problem in found.items()}
    sizes = {name: jax.eval_shape(fun, problem.y0).size for name, (problem, fun) in funs.items()}
    # by shape: ours is compiled for each
    shapes = sorted((np.size(found[name].y0), size, name) for name, size in sizes.items())
    chosen = [name for n, size, name in shapes if n <= size <= MOST_RESIDUALS][
        :: 1 if full else STRIDE
    ]
    return _cases({name: funs[name] for name in chosen})


@cache
def _numbers(
    full: bool, least: int = 1, most: int = MOST, letters: tuple[str, str] = LETTERS
) -> list[Case]:
    def value(problem: Any) -> Callable[[jax.Array], jax.Array]:
        return lambda y: problem.objective(y, problem.args)

    problems = _sif2jax().unconstrained_minimisation_problems
    found = _named(problems, most if full else SMALL, letters)
    sized = sorted((np.size(problem.y0), name) for name, problem in found.items())
    chosen = [name for n, name in sized if n >= least][:: 1 if full else STRIDE]
    return _cases({name: (found[name], value(found[name])) for name in chosen})


def _named(problems: Any, most: int, letters: tuple[str, str] = LETTERS) -> dict[str, Any]:
    """Those with such a name, and one array of so many parameters at most."""
    first, last = letters
    named = {type(problem).__name__: problem for problem in problems}
    shapes = {
        name: jax.eval_shape(lambda problem=problem: problem.y0)  # some have millions
        for name, problem in named.items()
        if first <= name[0] <= last
    }
    single = {name: shape for name, shape in shapes.items() if hasattr(shape, "size")}
    return {name: named[name] for name, shape in single.items() if shape.size <= most}


def _cases(funs: dict[str, tuple[Any, Callable]]) -> list[Case]:
    """Those that are finite where they begin."""
    cases = []
    for name, (problem, fun) in funs.items():
        start, compiled = np.asarray(problem.y0, float), jax.jit(fun)
        if np.all(np.isfinite(compiled(start))):
            width = WIDTH * max(1.0, np.max(np.abs(start)))
            cases.append(Case(name, compiled, start, width))
    return cases


def _sif2jax() -> ModuleType:
    """The package; imported in the precision in which it is used, as it has constants."""
    left_out = {} if "sif2jax" in sys.modules else SLOW
    sys.modules.update(left_out)  # type: ignore[arg-type]
    try:
        return package("sif2jax", "sif2jax")
    finally:
        for name in left_out:
            del sys.modules[name]


SETS = {
    "residuals": residuals,
    "scalars": scalars,
    "scalars50": larger,
    "held_out": held_out,
    "settings": settings,
} | {f"bbob{n}": partial(bbob, n) for n in (5, 10, 20)}
SETS["bbob160"] = partial(large, 160)
