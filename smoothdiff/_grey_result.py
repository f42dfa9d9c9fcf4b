"""What the training of a network through a renderer gives: a record of each round, and a result."""

import dataclasses
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PyTree


class GreyRecord(NamedTuple):
    """One round of `train_grey_box`.

    Attributes:
        round: which round, from 1.
        evaluations: renders so far.
        seconds: time since the start, compilation included; a resumed run counts on.
        fun: the loss of the network's answers: the mean squared difference between their renders
            and the pictures, over the cases of this round. The network is that of before this
            round's lessons.
        known: the lowest loss of any render, averaged over all cases.
        misfit: what the network learns to make small, in the last lesson: Huber's loss of its
            answers, each parameter weighted by the root of how much a picture changes with it.
        model: the network after the round, with averaged weights; None in the history.

    Example:
        >>> import smoothdiff as sd
        >>> last = sd.GreyRecord(1, 160, 2.5, fun=0.31, known=0.12, misfit=0.05)
        >>> f"round {last.round}: {last.fun} by the network, {last.known} by the best renders"
        'round 1: 0.31 by the network, 0.12 by the best renders'

    Source: own.
    """

    round: int
    evaluations: int
    seconds: float
    fun: float
    known: float
    misfit: float
    model: Any = None


@dataclasses.dataclass(frozen=True)
class GreyResult:
    """What `train_grey_box` found.

    Attributes:
        model: the trained network; its weights are averaged over the late lessons.
        parameters: for each case, the parameters of the best render, which the network is to
            answer. Like its output, with the cases as the first axis of each leaf.
        losses: for each case, the mean squared difference between that render and the picture;
            infinite if the case had no turn.
        fun: the loss of the network's answers in the last round, as in its `GreyRecord`; NaN before
            the first one.
        evaluations: how many renders were made.
        reason: why the training stopped: "target", "max_evaluations", "max_seconds", "callback" or
            "interrupted"; in an error "failed".
        history: a `GreyRecord` of each round.
        state: all of it, the renders that are kept included.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.linspace(0, 1, 16)
        >>> render = lambda x: jnp.where(jnp.abs(pixels - x) < 0.2, 1.0, 0.0)
        >>> pictures = jax.vmap(render)(jnp.linspace(0.2, 0.8, 32))
        >>> network = eqx.nn.MLP(16, "scalar", 8, 1, key=jax.random.key(2))
        >>> result = sd.train_grey_box(
        ...     network, render, pictures, key=jax.random.key(0), sigma=0.2,
        ...     max_evaluations=200, cases=8, lessons=8,
        ... )
        >>> result.reason, result.parameters.shape, result.evaluations <= 200
        ('max_evaluations', (32,), True)

    Source: own.
    """

    model: Any = dataclasses.field(repr=False)
    parameters: PyTree[Array] = dataclasses.field(repr=False)
    losses: Float[Array, " cases"] = dataclasses.field(repr=False)
    fun: float
    evaluations: int
    reason: str
    history: list[GreyRecord] = dataclasses.field(repr=False)
    state: Any = dataclasses.field(repr=False)


class GreyBoxError(RuntimeError):
    """A training failed: `result` is what it had found, `__cause__` what a black box raised.

    Args:
        message: what failed, and what to do.
        result: the `GreyResult` until then.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp, smoothdiff as sd
        >>> def draw(x):
        ...     raise ArithmeticError("no light")
        >>> render = sd.black_box(draw, jax.ShapeDtypeStruct((16,), jnp.float32))
        >>> network = eqx.nn.MLP(16, "scalar", 8, 1, key=jax.random.key(2))
        >>> try:
        ...     sd.train_grey_box(
        ...         network, render, jnp.ones((32, 16)), key=jax.random.key(0), sigma=0.2,
        ...         max_evaluations=200, cases=8, lessons=8,
        ...     )
        ... except sd.GreyBoxError as error:
        ...     print(error.result.reason, error.result.evaluations)
        failed 0

    Source: own.
    """

    def __init__(self, message: str, result: GreyResult):
        super().__init__(message)
        self.result = result
