"""Small pictures of the first start: where it began, what each method found, what is sought.

They are part of the results, as text, so that pages and figures need to render nothing. None is
picked by hand.
"""

import base64
import io
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from PIL import Image

from benchmarks._loop import Run, within
from benchmarks._task import Method, Task

LARGEST = 128  # pixels along the longer side
STRIP = 4  # a picture so many times as wide as high has square views side by side
MARKS = (10, 20, 40)  # evaluations at which a film has pictures
# the methods in it: what users have, and ours
FILMED = ("fr22", "nelder_mead", "cma_es", "py_bobyqa", "newton_cg", "gauss_newton")
WHITE = 99.5  # percent of the start's differences that are less than white


class Pictures(NamedTuple):
    """As a screen shows them, (H, W, 3), from 0 to 1."""

    start: np.ndarray
    found: dict[str, np.ndarray]
    reference: np.ndarray


def rendered(task: Task, ran: Mapping[Method, list[Run]]) -> str | None:
    """The pictures below one another, a PNG as text; None where the task has no picture."""
    image = task.score.image
    if image is None or not ran:
        return None
    unravel = ravel_pytree(task.problem.like)[1]
    found = [unravel(jnp.asarray(each[0]["found"])) for each in ran.values()]
    shown = [task.start(int(next(iter(ran.values()))[0]["seed"])), *found, task.score.reference]
    return png(np.concatenate([_small(display(image(y))) for y in shown]))


def film(task: Task, ran: Mapping[Method, list[Run]]) -> dict[str, Any] | None:
    """A film of the first start: what some methods had found after so many evaluations.

    A line of pictures for each method, one below another in one PNG as text, and the image errors;
    None where the task has no picture or none of the methods ran.
    """
    image = task.score.image
    chosen = {method.name: runs[0] for method, runs in ran.items() if method.name in FILMED}
    if image is None or not chosen:
        return None
    unravel = ravel_pytree(task.problem.like)[1]
    found = [run[f"found {mark}"] for run in chosen.values() for mark in MARKS]
    shown = [_small(display(image(unravel(jnp.asarray(y))))) for y in found]
    errors = {
        name: [float(run["image_error"][within(run["evaluations"], mark)]) for mark in MARKS]
        for name, run in chosen.items()
    }
    return {"marks": MARKS, "errors": errors, "png": png(np.concatenate(shown))}


def frames(shot: dict[str, Any]) -> dict[str, list[np.ndarray]]:
    """The pictures of a film, by method, one for each of its marks."""
    tiles = np.split(_read(shot["png"]), len(shot["errors"]) * len(shot["marks"]))
    count = len(shot["marks"])
    return {name: tiles[i * count : (i + 1) * count] for i, name in enumerate(shot["errors"])}


def stored(task: dict[str, Any], names: list[str]) -> Pictures | None:
    """The pictures of a task's results, whose methods are `names`; None where there are none."""
    if not task.get("pictures"):
        return None
    shown = np.split(_read(task["pictures"]), len(names) + 2)
    start, *found, reference = map(_folded, shown)  # those of older results are strips
    return Pictures(start, dict(zip(names, found, strict=True)), reference)


def differences(pictures: Pictures) -> dict[str, np.ndarray]:
    """How far each is from the reference, (H, W); white is as far as the start is, at most."""
    away = lambda picture: np.abs(picture - pictures.reference).mean(axis=2)
    white = max(np.percentile(away(pictures.start), WHITE), 1 / 255)
    return {
        name: np.clip(away(picture) / white, 0, 1)
        for name, picture in {"": pictures.start, **pictures.found}.items()
    }


def display(image) -> np.ndarray:
    """Linear RGB as a screen shows it."""
    linear = np.clip(np.asarray(image), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def png(picture: np.ndarray) -> str:
    """A PNG of a picture, as text."""
    written = io.BytesIO()
    _image(picture).save(written, "png", optimize=True)
    return base64.b64encode(written.getvalue()).decode()


def data_uri(text: str) -> str:
    """A PNG as text, as the source of an <img>."""
    return f"data:image/png;base64,{text}"


def _read(text: str) -> np.ndarray:
    """The picture of a PNG as text."""
    with Image.open(io.BytesIO(base64.b64decode(text))) as whole:
        return np.asarray(whole.convert("RGB")) / 255


def _image(picture: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(255 * picture).astype(np.uint8))


def _folded(picture: np.ndarray) -> np.ndarray:
    """Views side by side, as a block about as wide as high; other pictures as they are."""
    count = round(picture.shape[1] / picture.shape[0])
    if count < STRIP:
        return picture
    across = math.ceil(math.sqrt(count))
    width = picture.shape[1] // count
    views = [view[:, :width] for view in np.array_split(picture, count, axis=1)]
    views += [np.zeros_like(views[0])] * (-count % across)
    lines = [views[first : first + across] for first in range(0, len(views), across)]
    return np.concatenate([np.concatenate(line, axis=1) for line in lines])


def _small(picture: np.ndarray) -> np.ndarray:
    image = _image(_folded(picture))
    image.thumbnail((LARGEST, LARGEST), Image.Resampling.LANCZOS)  # no larger than it was
    return np.asarray(image) / 255
