"""Grey boxes: a network that learns what a black box is to be given, by `train_grey_box`."""

from typing import Any

import equinox as eqx
import jax

import smoothdiff as sd
from benchmarks._task import MethodEntry, NotAble, Problem, Solve, Y


class Network(eqx.Module):
    """The part that AD knows, with its weights."""

    y: Y
    white: Any = eqx.field(static=True)

    def __call__(self, picture: jax.Array) -> jax.Array:
        """What is to be rendered for a picture."""
        return self.white(self.y, picture)


def prepare(problem: Problem, **settings: Any) -> Solve:
    """Ours by its defaults, or with other settings."""
    grey = problem.grey
    if grey is None:
        raise NotAble("this task has no part that AD knows")

    def solve(y0, key, record):
        result = sd.train_grey_box(
            Network(y0, grey.white),
            grey.render,
            grey.cases,
            key=key,
            sigma=grey.sigma,
            max_evaluations=problem.budget.evaluations,
            callback=lambda round: record(round.model.y),
            **settings,
        )
        if result.reason == "interrupted":
            raise KeyboardInterrupt

    return solve


METHODS = {
    "grey_gauss_newton": MethodEntry(
        "Network by AD, renderer by Gauss-Newton (ours)", ("network",), prepare
    )
}
