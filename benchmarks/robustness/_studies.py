"""What is varied: the start, the samples of a step, the samples of a pixel, and the reference.

After appendix I and Fig. 10 of Stochastic Gradient Estimation for Higher-order Differentiable
Rendering. A JPEG's level is its RMS error over the picture's RMS, in linear RGB: the paper does not
say what its 2 to 14 % are; on its scene, the mug, they then are qualities from 97 to 20.
"""

import dataclasses
import io
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import smoothdiff as sd
from benchmarks import methods
from benchmarks._report import display
from benchmarks._task import Method, Task
from benchmarks.methods._host_loop import run_by

USUAL = ("fr22", "newton_cg", "gauss_newton")
SAMPLES = (4, 6, 8, 12, 24)  # evaluations of a step; the defaults are 4 and 6 for 1 and 2 unknowns
SPP = (1, 2, 4, 8, 12)  # 0.25 to 3 times the task's
JPEG = (0, 2, 4, 6, 9, 14)  # percent
ANYWHERE = 0  # the study of starts has no value to vary

Solver = Callable[..., Any]


class Case(NamedTuple):
    """A task with one thing changed, and the methods that run on it."""

    study: str
    value: int
    task: Task
    methods: list[Method]


def cases(task: Task, at_spp: Callable[[int], Task] | None) -> list[Case]:
    """All studies of a task; that of samples per pixel only where `at_spp` makes the task anew."""
    usual = [methods.load(name) for name in USUAL]
    found = [Case("starts", ANYWHERE, _started_anywhere(task), usual)]
    found += [Case("samples", num, task, _sampling(num)) for num in SAMPLES]
    if at_spp is not None:
        found += [Case("spp", spp, at_spp(spp), usual) for spp in SPP]
    return found + [Case("jpeg", level, _compressed(task, level), usual) for level in JPEG]


def _started_anywhere(task: Task) -> Task:
    """Starts uniform within the bounds: also nearer to the reference and farther than usual."""
    low, high = task.bounds

    def start(seed: int) -> jax.Array:
        return jax.random.uniform(jax.random.key(seed), low.shape, low.dtype, low, high)

    return dataclasses.replace(task, start=start)


def _sampling(num: int) -> list[Method]:
    """Ours with so many evaluations in a step, under the names of the usual ones."""

    def newton_cg(task: Task):
        solver = sd.NewtonCG(task.sigma, restarts=2**31 - 1, num_samples=num)
        return run_by(sd.minimise, task, task.loss, solver)

    def gauss_newton(task: Task):
        assert task.residuals is not None
        solver = sd.GaussNewton(task.sigma, num_samples=num)
        return run_by(sd.least_squares, task, task.residuals, solver)

    usual = (methods.load("newton_cg"), newton_cg), (methods.load("gauss_newton"), gauss_newton)
    return [
        method._replace(prepare=prepare, source=f"{method.source}{num}")
        for method, prepare in usual
    ]


def _compressed(task: Task, level: int) -> Task:
    """The task with what a JPEG of this level adds to the photograph."""
    assert task.image is not None
    assert task.residuals is not None
    residuals, exact = task.residuals, np.asarray(task.image(task.reference))
    error, quality = _jpeg(exact, level / 100)

    def with_error(y):
        return residuals(y) - error

    return dataclasses.replace(
        task,
        residuals=with_error,
        loss=lambda y: jnp.mean(with_error(y) ** 2),
        notes=f"{task.notes}, JPEG quality {quality}",
    )


def _jpeg(linear: np.ndarray, level: float) -> tuple[np.ndarray, int | None]:
    """What compression changes, (H, W, 3) in linear RGB, and the quality nearest to the level."""
    if level == 0:
        return np.zeros_like(linear), None
    errors = {quality: _decoded(linear, quality) - linear for quality in range(1, 101)}
    size = np.sqrt(np.mean(linear**2))
    away = {q: abs(np.sqrt(np.mean(error**2)) / size - level) for q, error in errors.items()}
    nearest = min(away, key=lambda quality: away[quality])
    return errors[nearest].astype(linear.dtype), nearest


def _decoded(linear: np.ndarray, quality: int) -> np.ndarray:
    written = io.BytesIO()
    shown = np.rint(255 * display(linear)).astype(np.uint8)
    Image.fromarray(shown).save(written, "jpeg", quality=quality)
    with Image.open(written) as compressed:
        shown = np.asarray(compressed) / 255
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
