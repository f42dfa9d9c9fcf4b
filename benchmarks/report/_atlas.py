"""Pictures of a scene: the start, what each method found from it, the reference; in one small file.

All are from the first start: none is picked by hand. The file is written when a scene is run, so
that a report renders nothing.
"""

import base64
import io
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from PIL import Image

from benchmarks._report import able, display
from benchmarks._task import Task

NAME = "pictures.png"
WHITE = 99.5  # percent of the start's differences that are less than white


class Pictures(NamedTuple):
    """As a screen shows them, (H, W, 3), from 0 to 1."""

    start: np.ndarray
    found: dict[str, np.ndarray]
    reference: np.ndarray


def store(task: Task, results: dict[str, Any], folder: Path) -> None:
    """Renders the pictures and writes them below one another, in the order of the results."""
    assert task.image is not None
    _, unravel = ravel_pytree(task.reference)
    found = [unravel(jnp.asarray(ran["runs"][0]["found"])) for ran in able(results).values()]
    tiles = [display(task.image(y)) for y in (task.start(0), *found, task.reference)]
    _image(np.concatenate(tiles)).save(folder / NAME, optimize=True)


def load(results: dict[str, Any], folder: Path) -> Pictures | None:
    """The pictures, or None where there are none, or none of these results."""
    names = list(able(results))
    if not (folder / NAME).exists():
        return None
    with Image.open(folder / NAME) as stored:
        whole = np.asarray(stored.convert("RGB")) / 255
    if len(whole) % (len(names) + 2):
        return None
    start, *found, reference = np.split(whole, len(names) + 2)
    return Pictures(start, dict(zip(names, found, strict=True)), reference)


def differences(pictures: Pictures) -> dict[str, np.ndarray]:
    """How far each is from the reference, (H, W); white is as far as the start is, at most."""
    away = lambda picture: np.abs(picture - pictures.reference).mean(axis=2)
    white = max(np.percentile(away(pictures.start), WHITE), 1 / 255)
    return {
        name: np.clip(away(picture) / white, 0, 1)
        for name, picture in {"": pictures.start, **pictures.found}.items()
    }


def data_uri(picture: np.ndarray) -> str:
    """The picture as the source of an <img>."""
    written = io.BytesIO()
    _image(picture).save(written, "png", optimize=True)
    return png_uri(written.getvalue())


def png_uri(png: bytes) -> str:
    """A PNG as the source of an <img>."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _image(picture: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(255 * picture).astype(np.uint8))
