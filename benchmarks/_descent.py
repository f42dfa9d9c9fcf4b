"""What a descent is: a task that comes with its gradients, and the optimisers that descend on it.

All of them see the same gradients, noisy or not, so what counts is how good the answer is after so
many iterations.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax

import smoothdiff as sd
from benchmarks._cache import fingerprint
from benchmarks._task import Budget, Key, Method, Problem, Record, Solve, Task, Y
from benchmarks._tuning import Axis, Rates, Settings

Rate: TypeAlias = Any  # a number, traced or not
Scene: TypeAlias = Any  # a pytree of arrays
Filter: TypeAlias = Callable[[Any, Any], Any]
Build: TypeAlias = Callable[..., optax.GradientTransformation]
Pictures: TypeAlias = Mapping[str, Any]  # arrays: (n,) a line, (H, W) grey, (H, W, 3) linear RGB

EPS = 1e-12  # less than any gradient here, so that only the direction and the filters count
POINTS_A_DECADE = 10  # of iterations at which a run is looked at
# the grid of all descents beside the rate: the decay of the first moment, and the power of
# 1 - b2 = (1 - b1)^tie. 2 is that of Chang et al. 2024, section 5.1, 3 has (0.9, 0.999)
LARGEST = 1 - 1e-6  # in float32 there is little between it and 1
B1S, TIES = (0.0, 0.2, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995), (1, 2, 3, 4)


class Configuration(NamedTuple):
    """A way to descend, whose settings are tuned.

    Args:
        name: In names of files.
        title: In tables and figures.
        build: (rate, b1, b2, **others) -> an optimiser. Settings that are whole numbers are known
            when it is compiled, all others are traced.
        axes: What is tuned beside rate, b1 and b2, and its values in their order.
        remembers: With False b1 and b2 are zero.
    """

    name: str
    title: str
    build: Build
    axes: Mapping[str, Sequence[Any]] = {}
    remembers: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class Descent(Task):
    """A task on which configurations are compared, by the errors that its score has levels of.

    The first of them is that for which the rates are tuned, on seeds that are not scored.

    Args:
        configurations: Who is compared. The first is the one whose time others are compared with.
        rate: The learning rate that tuning begins with.
        b1: Likewise.
        marks: The iterations that tables show, rising; the last is the budget. A configuration is
            tuned for each of them.
        tuning_seeds: How many seeds settings are tried on.
        pictures: (y, scene) -> pictures by name, or None.
        target: scene -> the same pictures of what is sought, as far as there are any.
        pictured: The marks that pictures show; none means the last.
    """

    configurations: Sequence[Configuration]
    rate: float
    marks: Sequence[int]
    b1: float = 0.5
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
    make: Callable[..., Filter] | None,
    rate: Rate,
    b1: Any,
    b2: Any,
    *,
    where: Sequence[str] = ("postfilter",),
    **strength: Any,
) -> optax.GradientTransformation:
    """Adam with its moments filtered by `make(**strength)`, or its gradients too; or Adam."""
    filter = make(**strength) if make else None
    filters: dict[str, Any] = dict.fromkeys(where, filter)
    return sd.filtered_adam(rate, b1, b2, eps=EPS, **filters)


def adam() -> Configuration:
    """Without any filter."""
    return Configuration("adam", "Adam", partial(filtered, None))


def axes(descent: Descent, configuration: Configuration) -> tuple[dict[str, Axis], Settings]:
    """What is tuned of a configuration, and where that begins."""
    found: dict[str, Axis] = {"rate": Rates(descent.rate)}
    start: Settings = {"rate": descent.rate}
    if configuration.remembers:
        found |= {"b1": B1S, "tie": TIES}
        start |= {"b1": descent.b1, "tie": 2}
    middles = {name: of[len(of) // 2] for name, of in configuration.axes.items()}
    return {**found, **configuration.axes}, {**start, **middles}


def method(
    descent: Descent, configuration: Configuration, settings: Settings, seen: Sequence[int]
) -> Method:
    """The method that a configuration is with settings, looked at after `seen` iterations."""
    known, traced = _split(settings)
    program = _program(descent, configuration.build, known, tuple(traced))
    source = fingerprint(program, sorted(traced.items()), list(seen))
    said = (f"{name}{value:g}" for name, value in settings.items())
    name = "-".join([configuration.name, *said, source[:8]])
    prepare = partial(_prepare, seen, (configuration.build, known), traced)
    return Method(name, configuration.title, prepare, source)


def observed(last: int, marks: Sequence[int]) -> list[int]:
    """The iterations at which a run is looked at: evenly in the logarithm, and the marks."""
    number = max(2, round(POINTS_A_DECADE * np.log10(last)))
    points = np.geomspace(1, last, number).round().astype(int).tolist()
    return sorted({*points, *(mark for mark in marks if mark <= last)})


Known: TypeAlias = tuple[tuple[str, int], ...]


def _split(settings: Settings) -> tuple[Known, dict[str, float]]:
    """What is known when it is compiled, and what is traced."""
    given = {"b1": 0.0, "tie": 2} | settings
    given["b2"] = min(1 - (1 - given["b1"]) ** given.pop("tie"), LARGEST)
    known = tuple((name, value) for name, value in given.items() if isinstance(value, int))
    return known, {name: value for name, value in given.items() if not isinstance(value, int)}


def _prepare(
    seen: Sequence[int], of: tuple[Build, Known], traced: dict[str, float], problem: Problem
) -> Solve:
    build, known = of
    # as arrays: a b1 that is the number 0 has a state of its own
    given = {name: jnp.asarray(value) for name, value in traced.items()}

    def solve(y0: Y, key: Key, record: Record) -> None:
        run = y0, build(**given, **dict(known)).init(y0)
        inputs = given, key, problem.scene(), problem.bounds
        for first, last in itertools.pairwise([0, *seen]):
            run = _advance((build, known, problem.gradient), run, inputs, first, last)
            record(run[0], last)

    return solve


@partial(jax.jit, static_argnums=0)
def _advance(
    of: tuple[Build, Known, Callable], run: Any, inputs: Any, first: int, last: int
) -> Any:
    """From one iteration to another, within the bounds: one program for all that is traced."""
    build, known, gradient = of
    traced, key, scene, bounds = inputs
    transform = optax.with_extra_args_support(build(**traced, **dict(known)))

    def step(i, run):
        y, state = run
        slope = gradient(y, jax.random.fold_in(key, i), scene)
        updates, state = transform.update(slope, state, y)
        return jax.tree.map(jnp.clip, optax.apply_updates(y, updates), *bounds), state

    return jax.lax.fori_loop(first, last, step, run)


@cache
def _program(descent: Descent, build: Build, known: Known, names: tuple[str, ...]) -> str:
    """What is compiled for an optimiser: changes when its runs would."""
    y, traced = descent.start(0), {name: jnp.asarray(0.5) for name in names}
    run = y, build(**traced, **dict(known)).init(y)
    inputs = traced, jax.random.key(0), descent.scene(0), descent.problem.bounds
    of = build, known, descent.problem.gradient
    return _advance.lower(of, run, inputs, 0, 0).as_text()
