"""What a descent is: a task that comes with its gradients, and the optimisers that descend on it.

All of them see the same gradients, noisy or not, so what counts is how good the answer is after so
many iterations.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax

import smoothdiff as sd
from benchmarks._kept import fingerprint
from benchmarks._task import Budget, Key, Method, Problem, Record, Solve, Task, Y

Rate: TypeAlias = Any  # a number, traced or not
Scene: TypeAlias = Any  # a pytree of arrays
Optimiser: TypeAlias = Callable[[Rate], optax.GradientTransformation]
Filter: TypeAlias = Callable[[Any, Any], Any]
Build: TypeAlias = Callable[[float, float, Any, Rate], optax.GradientTransformation]
Pictures: TypeAlias = Mapping[str, Any]  # arrays: (n,) a line, (H, W) grey, (H, W, 3) linear RGB

EPS = 1e-12  # less than any gradient here, so that only the direction and the filters count
POINTS_A_DECADE = 10  # of iterations at which a run is looked at


class Configuration(NamedTuple):
    """A way to descend, in one or more variants that are tuned like the learning rate.

    Args:
        name: In names of files.
        title: In tables and figures.
        variants: Optimisers by name, each a function of the learning rate, which may be traced.
        tuned_at: The iteration whose error the tuning makes least; None is the last one.
    """

    name: str
    title: str
    variants: Mapping[str, Optimiser]
    tuned_at: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Descent(Task):
    """A task on which configurations are compared, by the errors that its score has levels of.

    The first of them is that for which the rates are tuned, on seeds that are not scored.

    Args:
        configurations: Who is compared. The first is the one whose time others are compared with.
        rates: The learning rates that every variant of every configuration is tried with.
        marks: The iterations that tables show, rising; the last is the budget.
        tuning_seeds: How many seeds each variant and rate is tried on.
        pictures: (y, scene) -> pictures by name, or None.
        target: scene -> the same pictures of what is sought, as far as there are any.
        pictured: The marks that pictures show; none means the last.
    """

    configurations: Sequence[Configuration]
    rates: Sequence[float]
    marks: Sequence[int]
    tuning_seeds: int = 2
    pictures: Callable[[Y, Scene], Pictures] | None = None
    target: Callable[[Scene], Pictures] = lambda scene: {}
    pictured: Sequence[int] = ()

    @property
    def scored(self) -> str:
        """The name of the error that counts."""
        return next(iter(self.score.levels))

    def scene(self, seed: int) -> Scene:
        """What the gradient is given for a seed."""
        if self.choose is not None:
            self.choose(seed)
        return self.problem.scene()


def problem(
    gradient: Callable[[Y, Key, Scene], Y],
    scene: Callable[[], Scene],
    start: Y,
    iterations: int,
    low: float = -math.inf,
    high: float = math.inf,
) -> Problem:
    """A problem of which only gradients are known, with the same bounds for all parameters."""
    even = lambda bound: jax.tree.map(lambda leaf: jnp.full_like(leaf, bound), start)
    budget = Budget(iterations, math.inf)
    return Problem((even(low), even(high)), 1.0, budget, gradient=gradient, scene=scene)


def filtered(
    b1: float, b2: float, filter: Filter | None, rate: Rate, where: Sequence[str] = ("postfilter",)
) -> optax.GradientTransformation:
    """Adam with its moments filtered, or its gradients too; without a filter it is Adam."""
    filters: dict[str, Any] = dict.fromkeys(where, filter)
    return sd.filtered_adam(rate, b1, b2, eps=EPS, **filters)


def variants(
    b1s: Sequence[float], filters: Mapping[str, Filter | None], build: Build = filtered
) -> dict[str, Optimiser]:
    """Each b1 with each filter, by name.

    Rates of decay are tied as in Chang et al. 2024, section 5.1: 1 - b1 = sqrt(1 - b2).
    """
    return {
        f"b1={b1:g} {name}".strip(): partial(build, b1, 1 - (1 - b1) ** 2, filter)
        for b1 in b1s
        for name, filter in filters.items()
    }


def methods(descent: Descent, configuration: Configuration) -> dict[tuple[str, float], Method]:
    """The methods that a configuration may be, by variant and rate."""
    found, seen = {}, observed(descent.marks[-1], descent.marks)
    for variant, optimiser in configuration.variants.items():
        source = fingerprint(_program(descent, optimiser), seen)
        for rate in descent.rates:
            name = "-".join([configuration.name, *variant.split(), f"{rate:g}", source[:8]])
            prepare = partial(_prepare, descent.marks, optimiser, rate)
            found[variant, rate] = Method(name, configuration.title, prepare, source)
    return found


def observed(last: int, marks: Sequence[int]) -> list[int]:
    """The iterations at which a run is looked at: evenly in the logarithm, and the marks."""
    number = max(2, round(POINTS_A_DECADE * np.log10(last)))
    points = np.geomspace(1, last, number).round().astype(int).tolist()
    return sorted({*points, *(mark for mark in marks if mark <= last)})


def _prepare(marks: Sequence[int], optimiser: Optimiser, rate: float, problem: Problem) -> Solve:
    def solve(y0: Y, key: Key, record: Record) -> None:
        run = y0, optimiser(rate).init(y0)
        inputs = rate, key, problem.scene(), problem.bounds
        for first, last in itertools.pairwise([0, *observed(problem.budget.evaluations, marks)]):
            run = _advance((optimiser, problem.gradient), run, inputs, first, last)
            record(run[0], last)

    return solve


@partial(jax.jit, static_argnums=0)
def _advance(of: tuple[Optimiser, Callable], run: Any, inputs: Any, first: int, last: int) -> Any:
    """From one iteration to another, within the bounds: one program for all rates and stretches."""
    optimiser, gradient = of
    rate, key, scene, bounds = inputs
    transform = optax.with_extra_args_support(optimiser(rate))

    def step(i, run):
        y, state = run
        slope = gradient(y, jax.random.fold_in(key, i), scene)
        updates, state = transform.update(slope, state, y)
        return jax.tree.map(jnp.clip, optax.apply_updates(y, updates), *bounds), state

    return jax.lax.fori_loop(first, last, step, run)


def _program(descent: Descent, optimiser: Optimiser) -> str:
    """What is compiled for an optimiser: changes when its runs would."""
    y = descent.start(0)
    run = y, optimiser(1.0).init(y)
    inputs = 1.0, jax.random.key(0), descent.scene(0), descent.problem.bounds
    return _advance.lower((optimiser, descent.problem.gradient), run, inputs, 0, 0).as_text()
