"""What a task is: the problem that a method sees, and the score that it does not see.

A method prepares itself for a problem once, and is then run from several starts. It tells the loop
where it is after each iteration and is stopped by it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from smoothdiff._support import as_support

Y: TypeAlias = Any  # the parameters: an array or a pytree of arrays
Key: TypeAlias = jax.Array
Loss: TypeAlias = Callable[[Y], jax.Array]
Record: TypeAlias = Callable[..., None]
Solve: TypeAlias = Callable[[Y, Key, Record], None]
NativeAD: TypeAlias = Callable[[Y], tuple[Any, Y]]
Kind: TypeAlias = Literal["function", "program", "scene", "large", "network", "descent"]


class NotAble(Exception):
    """A method cannot run on this task or on this machine; the message says what it needs."""


class Budget(NamedTuple):
    """Where a run ends, whichever comes first. Seconds do not include compilation."""

    evaluations: int
    seconds: float


class Effort(NamedTuple):
    """How much is run of a task: the budget of a run, and from how many starts."""

    evaluations: int
    seconds: float
    seeds: int

    @property
    def budget(self) -> Budget:
        return Budget(self.evaluations, self.seconds)


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
class Problem:
    """What a method sees. Whatever evaluates the black box is counted.

    It is written in coordinates in which one sigma fits all parameters, so that a method needs to
    know nothing else about the units.

    Args:
        bounds: (low, high), each like y.
        sigma: The scale of the parameters: about how far one has to look around.
        budget: Where a run ends.
        loss: The black box, a JAX function y -> scalar. By default the mean of the squared
            residuals, or the grey box's.
        residuals: y -> array, such that the loss is the sum or the mean of its squares, or None: a
            picture minus its reference, say. A call is counted like a call of the loss.
        keyed: (y, key) -> the residuals with the noise of that key, or None where they have none.
            The loss and the residuals have the same noise at every call.
        terms: y -> array, such that the loss is the sum of its entries, with `support`; or None. A
            call is counted likewise. By default from the residuals.
        support: Which of the terms a parameter may influence, as for `smoothdiff.smooth`. Then the
            first axes of the residuals are those of the terms.
        grey: The loss in two parts, for methods that use AD where they can; or None. The loss then
            costs an evaluation for each case.
        native_ad: Gives y -> (loss, gradient) by the renderer's own AD, or None. It raises NotAble
            where that cannot run.
        gradient: (y, key, scene) -> gradient, as noisy as it is, for problems that come with
            gradients; or None. Then an iteration counts as an evaluation.
        scene: Gives what the seed decides, or what is too large to be a constant of a compiled
            program, a pytree of arrays.
    """

    bounds: tuple[Y, Y]
    sigma: float
    budget: Budget
    loss: Loss = None  # type: ignore[assignment]
    residuals: Callable[[Y], jax.Array] | None = None
    keyed: Callable[[Y, Key], jax.Array] | None = None
    terms: Callable[[Y], jax.Array] | None = None
    support: Any = None
    grey: Grey | None = None
    native_ad: Callable[[], NativeAD] | None = None
    gradient: Callable[[Y, Key, Any], Y] | None = None
    scene: Callable[[], Any] = lambda: None

    def __post_init__(self):
        residuals, grey = self.residuals, self.grey
        if self.loss is None and grey is not None:
            object.__setattr__(self, "loss", grey.loss)
        elif self.loss is None and residuals is not None:
            object.__setattr__(self, "loss", lambda y: jnp.mean(residuals(y) ** 2))
        if self.terms is None and self.support is not None and residuals is not None:
            object.__setattr__(self, "terms", partial(_terms, residuals, as_support(self.support)))

    @property
    def like(self) -> Y:
        """Something like y: the lower bounds."""
        return self.bounds[0]


def _terms(residuals: Callable[[Y], jax.Array], support: Any, y: Y) -> jax.Array:
    """The share in their mean square of the residuals that the support does not tell apart."""
    terms, squares = jax.eval_shape(support.at(y), y), residuals(y) ** 2
    return jnp.mean(squares, axis=tuple(range(terms.ndim, squares.ndim))) / terms.size


@dataclass(frozen=True, eq=False)
class Score:
    """How what was found is scored; nothing of it is counted or seen by a method.

    The image error is the loss above its lowest value, relative to that of the start, whether there
    is an image or not. So a start has to be above the lowest value.

    Args:
        reference: The y that is sought.
        loss: The loss without noise, or None where the problem's has none.
        image: A picture of y without noise, y -> (H, W, 3) linear RGB, or None.
        distance: How far y is from what is sought, y -> number, where that is not the length of
            their difference: wrong switches, or the poses that a network says. Or None.
        optimum: The lowest value of the loss, or None, which is 0. With it, runs are also scored by
            how far above it they are.
        errors: Errors by name, (y, scene) -> numbers, in place of those of image and parameters,
            of a `Descent`; or None.
        levels: What runs are asked to get each error down to, by its name; for `errors`.
    """

    reference: Y = None
    loss: Loss | None = None
    image: Callable[[Y], jax.Array] | None = None
    distance: Callable[[Y], jax.Array] | None = None
    optimum: float | None = None
    errors: Callable[[Y, Any], Mapping[str, jax.Array]] | None = None
    levels: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Task:
    """A black box to minimise: what is seen of it, how it is scored, and where runs begin.

    Args:
        name: The name on the command line and of the folder of results.
        title: What is sought, in one line.
        problem: What a method sees.
        score: How what it finds is scored.
        start: The start of a seed, seed -> y.
        seeds: How many starts there are.
        precision: What the task is run in; all of its functions are called in it.
        choose: Makes the black box that of a seed, and returns the y that is sought then; or None
            where it is the same for all seeds.
        dearer: The picture by dearer renders, by the name of the saving that each does without; ""
            is the render as it is. Or None. Made when they are asked for, and not counted.
        fidelities: The render as a user might set it, of so many pixels along a side and so many
            samples of each, and cheaper ones, (pixels, samples) -> levels from the cheapest; or
            None. Made when they are asked for, and not counted.
        notes: Facts that belong beside the results, resolution and variant, say.
    """

    name: str
    title: str
    problem: Problem
    score: Score
    start: Callable[[int], Y]
    seeds: int
    precision: Literal["float32", "float64"] = "float32"
    choose: Callable[[int], Y] | None = None
    dearer: Callable[[], dict[str, Callable[[Y], jax.Array]]] | None = None
    fidelities: Callable[[int, int], list[Any]] | None = None
    notes: str = ""

    @property
    def exact_loss(self) -> Loss:
        """The loss without noise."""
        return self.score.loss or self.problem.loss


class Method(NamedTuple):
    """A way to solve problems: `prepare(problem)` gives `solve(y0, key, record)`.

    What is compiled lives in `prepare`, so that it is compiled once for all starts. `solve` calls
    `record(y)` after each iteration and runs until record ends it, or until it has converged. On
    a problem that comes with gradients it calls `record(y, iterations)`.
    """

    name: str
    title: str
    prepare: Callable[[Problem], Solve]
    source: str  # a change of it makes earlier results stale


class Traits(NamedTuple):
    """What a user would say of a task before running anything.

    Args:
        parameters: How many there are; of a family, how many each of its quick members has.
        plateaus: Whether there are regions where the loss does not tell the way, as it is constant
            there, all but constant, or made of steps.
        residuals: Whether it says residuals, as a picture minus its reference, or only one number.
    """

    parameters: tuple[int, ...]
    plateaus: bool
    residuals: bool = True


class TaskEntry(NamedTuple):
    """A line of a module's TASKS: what is sought, of which kind it is, and how it is built.

    `build(full)` gives a Task, or a list of them where one name stands for a family, such as a
    function in several dimensions; they are named "function-5d". A descent has no traits.
    """

    title: str
    kind: Kind
    build: Callable[..., Task | list[Task]]
    traits: Traits | None = None


def entry(
    kind: Kind,
    build: Callable[..., Task | list[Task]],
    name: str,
    title: str,
    *,
    parameters: int | tuple[int, ...],
    plateaus: bool,
    one_number: bool = False,
    **settings: Any,
) -> dict[str, TaskEntry]:
    """TASKS of one line, which is built by `build(full, name=name, title=title, **settings)`.

    The others are its traits.
    """
    sizes = parameters if isinstance(parameters, tuple) else (parameters,)
    made = partial(build, name=name, title=title, **settings)
    return {name: TaskEntry(title, kind, made, Traits(sizes, plateaus, not one_number))}


class MethodEntry(NamedTuple):
    """A line of a module's METHODS: its title, and the kinds of tasks that it runs on unasked.

    `grid` has values from low to high for settings of `prepare`, by their names; see `_tune`.
    """

    title: str
    kinds: tuple[Kind, ...]
    prepare: Callable[..., Solve]
    grid: Mapping[str, Sequence[float]] = {}


def precision_of(task: Task) -> AbstractContextManager[None]:
    """Inside, JAX has the precision of the task."""
    return precision(task.precision)


@contextmanager
def precision(name: Literal["float32", "float64"]) -> Iterator[None]:
    """Inside, JAX has this precision.

    For the whole process: `with jax.enable_x64(True)` is for one thread, and callbacks run in
    threads of JAX's, where float64 would become float32.
    """
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", name == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)
