"""What a descent is: a problem whose gradients are known, noisy or not, and who descends on it.

The other tasks are black boxes and are charged by the evaluation. Here every configuration sees the
same gradients, and what counts is how good the answer is after so many iterations.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

Y: TypeAlias = Any  # the parameters: an array or a pytree of arrays
Scene: TypeAlias = Any  # a pytree of arrays, or None
Key: TypeAlias = jax.Array
Pictures: TypeAlias = Mapping[str, Any]  # arrays: (n,) a line, (H, W) grey, (H, W, 3) linear RGB
Rate: TypeAlias = Any  # a number, traced or not
Optimiser: TypeAlias = Callable[[Rate], optax.GradientTransformation]


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


@dataclass(frozen=True, eq=False)
class Descent:
    """A problem that comes with its gradients, and the configurations that are compared on it.

    Functions get the scene as an argument: it is what the seed decides, or what is too large to be
    a constant of a compiled program. All but `pictures` and `also` are compiled.

    Args:
        name: The name of the folder of results.
        title: What is sought, in one line.
        scene: seed -> scene.
        start: (seed, scene) -> y.
        gradient: (y, key, scene) -> gradient, as noisy as it is.
        errors: (y, scene) -> errors by name, without noise.
        score: The name of the error that counts: rates are tuned for it and levels are of it.
        configurations: Who is compared. The first is the one whose time others are compared with.
        rates: The learning rates that every variant of every configuration is tried with.
        marks: The iterations that tables show, rising; the last is where a run ends.
        levels: Values of the score: in how many iterations are they reached?
        seeds: How many runs are scored.
        tuning_seeds: How many others each variant and rate is tried on.
        pictures: (y, scene) -> pictures by name, or None.
        target: scene -> the same pictures of what is sought, as far as there are any.
        pictured: The marks that pictures show; none means the last.
        also: Draws further pictures into a folder and gives what belongs into the results.
        notes: Facts that belong beside the results, resolution and samples, say.
    """

    name: str
    title: str
    scene: Callable[[int], Scene]
    start: Callable[[int, Scene], Y]
    gradient: Callable[[Y, Key, Scene], Y]
    errors: Callable[[Y, Scene], dict[str, jax.Array]]
    score: str
    configurations: Sequence[Configuration]
    rates: Sequence[float]
    marks: Sequence[int]
    levels: Sequence[float]
    seeds: int
    tuning_seeds: int = 2
    pictures: Callable[[Y, Scene], Pictures] | None = None
    target: Callable[[Scene], Pictures] = lambda scene: {}
    pictured: Sequence[int] = ()
    also: Callable[[Path], dict[str, Any]] | None = None
    notes: str = ""


def keep_within(low: float, high: float) -> optax.GradientTransformation:
    """The last link of a chain: shortens updates so that every parameter stays in [low, high]."""

    def update(updates, state, params=None):
        if params is None:
            raise ValueError("keep_within needs the parameters: update(updates, state, params).")
        clipped = jax.tree.map(lambda u, y: jnp.clip(y + u, low, high) - y, updates, params)
        return clipped, state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)
