"""What a task is: a black box to minimise, where to start, and what counts as found.

A method sees a task, prepares itself for it once, and is then run from several starts. It tells the
harness where it is after each iteration and is stopped by it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

Y: TypeAlias = Any  # the parameters: an array or a pytree of arrays
Key: TypeAlias = jax.Array
Loss: TypeAlias = Callable[[Y], jax.Array]
Record: TypeAlias = Callable[[Y], None]
Solve: TypeAlias = Callable[[Y, Key, Record], None]
NativeAD: TypeAlias = Callable[[Y], tuple[Any, Y]]


class NotAble(Exception):
    """A method cannot run on this task or on this machine; the message says what it needs."""


class Budget(NamedTuple):
    """Where a run ends, whichever comes first. Seconds do not include compilation."""

    evaluations: int
    seconds: float


class Grey(NamedTuple):
    """A loss in two parts: what AD knows, such as a network, and behind it a renderer.

    Args:
        white: What is to be rendered for a picture, (y, picture) -> array. JAX differentiates it.
        render: array -> picture. Each call is counted.
        cases: Pictures. The loss of one is the mean squared difference to what is rendered for it.
        sigma: The scale of what is between the two.
    """

    white: Callable[[Y, jax.Array], jax.Array]
    render: Callable[[jax.Array], jax.Array]
    cases: jax.Array
    sigma: float

    def black(self, x: jax.Array, case: jax.Array) -> jax.Array:
        """The loss of a case of which the white part says x."""
        return jnp.mean((self.render(x) - case) ** 2)

    def loss(self, y: Y) -> jax.Array:
        """The mean over all cases."""
        each = jax.vmap(lambda case: self.black(self.white(y, case), case))
        return jnp.mean(each(self.cases))


@dataclass(frozen=True, eq=False)
class Task:
    """A black box to minimise.

    A task is written in coordinates in which one sigma fits all parameters, so that a method needs
    to know nothing else about the units.

    Args:
        name: The name on the command line and of the folder of results.
        title: What is sought, in one line.
        loss: The black box that is optimised, a JAX function y -> scalar. Each call is counted.
        exact_loss: The loss without noise, for the score only. Not counted.
        start: The start of a seed, seed -> y.
        reference: The y that is sought.
        bounds: (low, high), each like y.
        sigma: The scale of the parameters: about how far one has to look around.
        budget: Where a run ends.
        seeds: How many starts there are.
        image: A picture of y without noise, y -> (H, W, 3) linear RGB, or None. Not counted.
        native_ad: Gives y -> (loss, gradient) by the renderer's own AD, or None. It raises NotAble
            where that cannot run.
        residuals: y -> array, such that the loss is the sum or the mean of its squares, or None: a
            picture minus its reference, say. A call is counted like a call of the loss.
        terms: y -> array, such that the loss is the sum of its entries, with `support`; or None. A
            call is counted likewise.
        support: Which of the terms a parameter may influence, as for `smoothdiff.smooth`. Then the
            first axes of the residuals are those of the terms.
        grey: The loss in two parts, for methods that use AD where they can; or None. With it, the
            loss is that of these parts, and costs an evaluation for each case.
        distance: How far y is from what is sought, y -> number, where that is not the length of
            their difference: wrong switches, or the poses that a network says. Or None.
        precision: What the task is run in; all of its functions are called in it.
        optimum: The lowest value of the loss, or None. With it, runs are also scored by how far
            above it they are.
        choose: Makes the black box that of a seed, and returns the y that is sought then; or None
            where it is the same for all seeds.
        dearer: The picture by dearer renders, by the name of the saving that each does without; ""
            is the render as it is. Or None. Made when they are asked for, and not counted.
        notes: Facts that belong beside the results, resolution and variant, say.
    """

    name: str
    title: str
    loss: Loss
    exact_loss: Loss
    start: Callable[[int], Y]
    reference: Y
    bounds: tuple[Y, Y]
    sigma: float
    budget: Budget
    seeds: int
    image: Callable[[Y], jax.Array] | None = None
    native_ad: Callable[[], NativeAD] | None = None
    residuals: Callable[[Y], jax.Array] | None = None
    terms: Callable[[Y], jax.Array] | None = None
    support: Callable[[Y], Any] | None = None
    grey: Grey | None = None
    distance: Callable[[Y], jax.Array] | None = None
    precision: Literal["float32", "float64"] = "float32"
    optimum: float | None = None
    choose: Callable[[int], Y] | None = None
    dearer: Callable[[], dict[str, Callable[[Y], jax.Array]]] | None = None
    notes: str = ""


@contextmanager
def precision_of(task: Task) -> Iterator[None]:
    """Inside, JAX has the precision of the task.

    For the whole process: `with jax.enable_x64(True)` is for one thread, and callbacks run in
    threads of JAX's, where float64 would become float32.
    """
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", task.precision == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


class Method(NamedTuple):
    """A way to solve tasks: `prepare(task)` gives `solve(y0, key, record)`.

    What is compiled lives in `prepare`, so that it is compiled once for all starts. `solve` calls
    `record(y)` after each iteration and runs until record ends it, or until it has converged.
    """

    name: str
    title: str
    prepare: Callable[[Task], Solve]
    source: str  # a change of it makes earlier results stale
