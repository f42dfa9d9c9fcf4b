"""A training in progress: its state, its rounds, and how it is saved and taken up again."""

import dataclasses
import math
import os
import time
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from smoothdiff._checkpoint import Checkpoint
from smoothdiff._grey_cases import CaseSearches, Known, Rendered, lessons_among
from smoothdiff._grey_lessons import Learner, Lessons, mean_loss
from smoothdiff._grey_result import GreyBoxError, GreyRecord, GreyResult
from smoothdiff._grey_sensitivity import Moved, Sensitivity
from smoothdiff._identity import listed
from smoothdiff._layout import Layout
from smoothdiff._numbers import floating
from smoothdiff._reraise import reraise

# the share of the time that saving may take
_SAVING = 0.05


class Answer(eqx.Module):
    """What a network says of a picture, in units of sigma."""

    static: Any
    sigma: Array
    layout: Layout = eqx.field(static=True)

    def __call__(self, weights: PyTree, picture: Array) -> Array:
        """Of a network with these weights."""
        said = eqx.combine(weights, self.static)(picture)
        return self.layout.vector(jax.tree.leaves(said)) / self.sigma


class Shown(eqx.Module):
    """What is rendered of parameters in units of sigma."""

    render: Any
    sigma: Array
    layout: Layout = eqx.field(static=True)

    def __call__(self, x: Array) -> Array:
        """The picture."""
        return floating(self.render(self.layout.tree(self.sigma * x)))


class GreyState(eqx.Module):
    """The state of a training after so many rounds."""

    rounds: Int[Array, ""]
    learner: Learner
    known: Known
    rendered: Rendered
    sensitivity: Sensitivity


@dataclasses.dataclass
class GreyRun:
    """Where a training stands: at every moment something that can be returned or saved."""

    searches: CaseSearches
    lessons: Lessons
    answer: Answer
    key: Key[Array, ""]
    state: GreyState
    planned: int  # rounds
    each: int  # lessons of a round
    history: list[GreyRecord] = dataclasses.field(default_factory=list)
    start: float = dataclasses.field(default_factory=time.monotonic)
    file: Checkpoint | None = None
    save_due: float = 0.0

    @property
    def rounds(self) -> int:
        return int(self.state.rounds)

    @property
    def evaluations(self) -> int:
        return self.rounds * self.searches.evaluations

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.start

    def round(self) -> GreyRecord:
        """Steps of some cases, and lessons of the network.

        Raises:
            GreyBoxError: it is the first one, and nothing is known after it.
        """
        with reraise():
            new, record = jax.block_until_ready(self._round())
        if self.rounds == 0 and record.known == math.inf:
            raise GreyBoxError(
                "no render of the first round was finite: see what render(model(pictures[0])) is, "
                "and begin with a network whose answers can be rendered, or take a smaller sigma",
                self.found("failed"),
            )
        # Ctrl-C may come between any two lines: the state has the last word on what was done
        self.history = [*self.history[: self.rounds], record]
        self.state = new
        if time.monotonic() >= self.save_due:
            self.save()
        return record._replace(model=self.model())

    def _round(self) -> tuple[GreyState, GreyRecord]:
        key, state = jax.random.fold_in(self.key, self.rounds), self.state
        solving, learning, drawing, moving = jax.random.split(key, 4)
        chosen = self.searches.chosen(state.rounds)
        said = self.lessons.answers(state.learner.mean, self.lessons.pictures[chosen])
        points, before = self.searches.earlier(drawing, state.known, state.rendered)
        moved = Moved.of(moving, points, self.lessons.answers(state.learner.mean, before))
        known, rendered, answered, after = self.searches.step(
            solving, said, chosen, state.known, state.rendered, moved.points
        )
        change = jnp.mean((after - before).reshape(len(after), -1) ** 2, axis=1)
        sensitivity = state.sensitivity.after(moved, change)
        learner, best = state.learner, known.best
        shares = lessons_among(known, rendered).astype(best.dtype)
        counts, misfit = sensitivity.counts(), jnp.nan
        # one by one: to iterate over an array compiles a program of as many outputs, each round
        keys = jax.random.split(learning, self.each)
        for i in range(self.each):
            learner, misfit = self.lessons.teach(keys[i], learner, best, rendered, shares, counts)
        new = GreyState(state.rounds + 1, learner, known, rendered, sensitivity)
        record = GreyRecord(
            round=self.rounds + 1,
            evaluations=self.evaluations + self.searches.evaluations,
            seconds=self.seconds,
            fun=float(jnp.mean(answered)),
            known=float(mean_loss(known)),
            misfit=float(misfit),
        )
        return new, record

    def model(self) -> Any:
        """The network with its mean weights."""
        return eqx.combine(self.state.learner.mean, self.answer.static)

    def found(self, reason: str) -> GreyResult:
        """The result, for which nothing is rendered."""
        known, answer, history = self.state.known, self.answer, self.history[: self.rounds]
        return GreyResult(
            self.model(),
            answer.layout.tree(answer.sigma[None] * known.best),
            known.loss,
            history[-1].fun if history else float("nan"),
            self.evaluations,
            reason,
            history,
            self.state,
        )

    def attach(self, path: str | os.PathLike, **problem: Any) -> None:
        """Keeps the training in a file from now on, and takes up the one that is there.

        Where the renderer has parts that may change in place and did, it has to give the same again
        for the first case that is known.
        """
        file = Checkpoint(path, key=self.key, **problem)
        saved = file.load((self.state, GreyRecord(0, 0, 0.0, 0.0, 0.0, 0.0)))
        if saved is not None:
            if file.doubtful and not self.searches.agree(jax.tree.map(jnp.asarray, saved[0].known)):
                raise file.other(f"its {listed(file.doubtful)} differed, and a render is another")
            self.state = jax.tree.map(jnp.asarray, saved[0])
            rows = zip(*(np.asarray(column).tolist() for column in saved[1][:-1]), strict=True)
            self.history = [GreyRecord(*row) for row in rows]
            self.start -= self.history[-1].seconds
        self.file = file

    def save(self) -> None:
        """Writes the file, if there is one; what was computed is never lost for a full disk."""
        if self.file is None or self.rounds == 0:
            return
        before = time.monotonic()
        columns = jax.tree.map(lambda *leaves: np.stack(leaves), *self.history[: self.rounds])
        try:
            self.file.save((self.state, columns))
        except Exception as error:
            text = f"the checkpoint was not saved, the run goes on: {type(error).__name__}: {error}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        after = time.monotonic()
        self.save_due = after + (after - before) / _SAVING
