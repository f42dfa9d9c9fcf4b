"""What is varied: the start, the samples of a step, the samples of a pixel, and the reference.

After appendix I and Fig. 10 of Stochastic Gradient Estimation for Higher-order Differentiable
Rendering. A JPEG's level is its RMS error over the picture's RMS, in linear RGB: the paper does not
say what its 2 to 14 % are; on its scene, the mug, they then are qualities from 97 to 20.
"""

import dataclasses
import io
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import smoothdiff as sd
from benchmarks import methods
from benchmarks._report import display
from benchmarks._task import Method, Task, Y
from benchmarks.methods._host_loop import run_by

USUAL = ("fr22", "newton_cg", "gauss_newton")
SAMPLES = (4, 6, 8, 12, 24)  # evaluations of a step; the defaults are 4 and 6 for 1 and 2 unknowns
SPP = (1, 4, 9, 16)  # squares, which spread evenly; 0.25 to 4 times the task's
JPEG = (0, 2, 4, 6, 9, 14)  # percent
ANYWHERE = 0  # the study of starts has no value to vary

Residuals = Callable[[Y], jax.Array]


class Change(NamedTuple):
    """A study, one value of what it varies, and what the methods see then."""

    study: str
    value: int
    residuals: Residuals
    starts: list[Y]


def changes(build: Callable[..., Task], starts: int, seeds: int) -> list[Change]:
    """All that is changed in the task itself.

    Args:
        build: The task, given `full` and, if it is to be other than usual, `spp`.
        starts: How many starts, anywhere within the bounds, the study of starts has.
        seeds: How many of its own starts each value of the others has.
    """
    task = build(False)
    usual = [task.start(seed) for seed in range(seeds)]
    return [
        Change("starts", ANYWHERE, residuals(task), anywhere(task, starts)),
        *(Change("spp", spp, residuals(build(False, spp=spp)), usual) for spp in SPP),
        *(Change("jpeg", level, compressed(task, level), usual) for level in JPEG),
    ]


def residuals(task: Task) -> Residuals:
    """Those of the task, which has some."""
    assert task.residuals is not None
    return task.residuals


def together(task: Task, changed: Sequence[Change]) -> Task:
    """One task for all changes, so that a method compiles once: a seed is a change and a start."""
    runs = [(i, start) for i, change in enumerate(changed) for start in change.starts]
    chosen = [0]  # which change it is now; on the host, as what is compiled stays

    def choose(seed: int) -> Y:
        chosen[0] = runs[seed % len(runs)][0]
        return task.reference

    def of_chosen(y: Y) -> jax.Array:
        index = jax.ShapeDtypeStruct((), jnp.int32)
        which = jax.pure_callback(lambda: np.asarray(chosen[0], np.int32), index)
        return jax.lax.switch(which, [change.residuals for change in changed], y)

    return dataclasses.replace(
        task,
        residuals=of_chosen,
        loss=lambda y: jnp.mean(of_chosen(y) ** 2),
        start=lambda seed: runs[seed % len(runs)][1],
        choose=choose,
        native_ad=None,
        notes=repr([(change.study, change.value, len(change.starts)) for change in changed]),
    )


def anywhere(task: Task, number: int) -> list[Y]:
    """Starts uniform within the bounds: also nearer to the reference and farther than usual."""
    low, high = task.bounds
    uniform = lambda seed: jax.random.uniform(jax.random.key(seed), low.shape, low.dtype, low, high)
    return [uniform(seed) for seed in range(number)]


def sampling(num: int) -> list[Method]:
    """Ours with so many evaluations in a step, under the names of the usual ones."""

    def newton_cg(task: Task):
        solver = sd.NewtonCG(task.sigma, restarts=2**31 - 1, num_samples=num)
        return run_by(sd.minimise, task, task.loss, solver)

    def gauss_newton(task: Task):
        solver = sd.GaussNewton(task.sigma, num_samples=num)
        return run_by(sd.least_squares, task, residuals(task), solver)

    usual = (methods.load("newton_cg"), newton_cg), (methods.load("gauss_newton"), gauss_newton)
    return [
        method._replace(prepare=prepare, source=f"{method.source}{num}")
        for method, prepare in usual
    ]


def compressed(task: Task, level: int) -> Residuals:
    """The task's residuals from the JPEG of this level, instead of the photograph."""
    assert task.image is not None
    error, _ = _jpeg(np.asarray(task.image(task.reference)), level / 100)
    exact = residuals(task)
    return lambda y: exact(y) - error


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
