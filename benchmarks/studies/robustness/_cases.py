"""What is varied: the start, the samples of a step, the samples of a pixel, and the reference.

After appendix I and Fig. 10 of Stochastic Gradient Estimation for Higher-order Differentiable
Rendering. A JPEG's level is its RMS error over the picture's RMS, in linear RGB: the paper does not
say what its 2 to 14 % are; on its scene, the mug, they then are qualities from 97 to 20.
"""

import dataclasses
import io
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._atlas import display
from benchmarks._task import Budget, Method, Problem, Solve, Task, Y
from benchmarks.methods._host_loop import run_by

USUAL = ("fr22", "newton_cg", "gauss_newton")
SAMPLES = (4, 6, 8, 12, 24)  # evaluations of a step; the defaults are 4 and 6 for 1 and 2 unknowns
SPP = (1, 4, 9, 16)  # squares, which spread evenly; 0.25 to 4 times the task's
JPEG = (0, 2, 4, 6, 9, 14)  # percent
BUDGET = Budget(evaluations=240, seconds=60)  # ours are at their end long before


class Case(NamedTuple):
    """A study, one value of what it varies, what is run then, and from how many starts."""

    study: str
    value: int
    task: Task
    methods: list[Method]
    starts: int


def cases(build: Callable[..., Any], starts: int, seeds: int) -> Iterator[Case]:
    """What is run of a scene: anywhere from so many starts, all else from so many of its own."""
    task, methods = scored(build(False)), [_registry.method(name) for name in USUAL]
    yield Case("starts", 0, anywhere(task), methods, starts)
    for spp in SPP:
        yield Case("spp", spp, scored(build(False, spp=spp)), methods, seeds)
    for level in JPEG:
        yield Case("jpeg", level, compressed(task, level / 100), methods, seeds)
    for number in SAMPLES:
        yield Case("samples", number, task, sampling(number), seeds)


def scored(task: Task) -> Task:
    """A task of these runs. It is scored by its parameters only.

    Pictures without noise for a score would take most of a run.
    """
    away = lambda y: jnp.sum((y - task.score.reference) ** 2)
    score = dataclasses.replace(task.score, loss=away)
    problem = dataclasses.replace(task.problem, budget=BUDGET)
    return dataclasses.replace(task, problem=problem, score=score)


def anywhere(task: Task) -> Task:
    """Starts uniform within the bounds: also nearer to the reference and farther than usual."""
    low, high = task.problem.bounds
    uniform = lambda seed: jax.random.uniform(jax.random.key(seed), low.shape, low.dtype, low, high)
    return dataclasses.replace(task, start=uniform)


def sampling(number: int) -> list[Method]:
    """Ours with so many evaluations in a step, under the names of the usual ones."""

    def newton_cg(problem: Problem) -> Solve:
        solver = sd.NewtonCG(problem.sigma, restarts=2**31 - 1, num_samples=number)
        return run_by(sd.minimise, problem, problem.loss, solver)

    def gauss_newton(problem: Problem) -> Solve:
        solver = sd.GaussNewton(problem.sigma, num_samples=number)
        return run_by(sd.least_squares, problem, residuals(problem), solver)

    changed = {"newton_cg": newton_cg, "gauss_newton": gauss_newton}
    usual = {name: _registry.method(name) for name in changed}
    return [usual[name]._replace(prepare=prepare) for name, prepare in changed.items()]


def residuals(problem: Problem) -> Callable[[Y], jax.Array]:
    """Those of a problem that has some."""
    assert problem.residuals is not None
    return problem.residuals


def compressed(task: Task, level: float) -> Task:
    """The task with the JPEG of this level as its reference, instead of the photograph."""
    assert task.score.image is not None
    error = jpeg(np.asarray(task.score.image(task.score.reference)), level)
    exact = residuals(task.problem)
    changed = dataclasses.replace(task.problem, loss=None, residuals=lambda y: exact(y) - error)
    return dataclasses.replace(task, problem=changed)


def jpeg(linear: np.ndarray, level: float) -> np.ndarray:
    """What compression of the quality nearest to the level changes, (H, W, 3) in linear RGB."""
    if level == 0:
        return np.zeros_like(linear)
    size = lambda picture: np.sqrt(np.mean(picture**2))
    errors = [_decoded(linear, quality) - linear for quality in range(1, 101)]
    nearest = min(errors, key=lambda error: abs(size(error) / size(linear) - level))
    return nearest.astype(linear.dtype)


def _decoded(linear: np.ndarray, quality: int) -> np.ndarray:
    written = io.BytesIO()
    shown = np.rint(255 * display(linear)).astype(np.uint8)
    Image.fromarray(shown).save(written, "jpeg", quality=quality)
    with Image.open(written) as compressed:
        shown = np.asarray(compressed) / 255
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
