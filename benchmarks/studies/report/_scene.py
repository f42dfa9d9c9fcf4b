"""A scene's results as the page reads them, and which method is ours there.

Ours is one rule, and not what came out best: least squares where there are residuals, and a support
where parameters act locally, as README advises. It was set before anything was run, and changed
three times: after results of cnn5, suzanne and mlp were seen, as it named grey_ours and
local_gradient, and left gauss_newton out where there were more than 300 parameters; when
local_gauss_newton was written, whose settings had been chosen on suzanne and banana; and as
newton_cg had up to 300 parameters, and the shortest call fewer than 100: no scene lies between.
Settings of grey_gauss_newton were chosen on cnn5.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import _registry
from benchmarks._machine import in_one_line
from benchmarks._names import is_ours
from benchmarks._reached import alike, took
from benchmarks._study import committed
from benchmarks._summary import able
from benchmarks._task import TaskEntry

MANY = 100  # parameters, from which on the shortest call takes a batch a step
# in this order, and below how many parameters; one that needs what a task lacks does not run on it
WITH_RESIDUALS = ("grey_gauss_newton", "local_gauss_newton", "gauss_newton", "local_first_order")
WITH_ONE_NUMBER = {"newton_cg": MANY, "first_order": None}
RULE_TEXT = (
    "Ours is one rule, and not what came out best. Where a function says residuals, GaussNewton:"
    " LocalGaussNewton where a support is known, GaussNewton in front of a network, FirstOrder with"
    " the support where neither can run. Where it says one number, NewtonCG below"
    f" {MANY} parameters, else FirstOrder. Each with one setting for all."
)


class Scene(NamedTuple):
    """One scene: its part of results.json, what stands at the head of that, and its entry."""

    name: str
    results: dict[str, Any]
    about: dict[str, Any]
    entry: TaskEntry
    task: str  # the name on the command line

    @property
    def label(self) -> str:
        """The name, with that of the family where it does not tell."""
        return self.name if self.name.startswith(self.task) else f"{self.task}, {self.name}"

    @property
    def ran(self) -> dict[str, Any]:
        """The methods that were able."""
        return able(self.results)

    @property
    def plateaus(self) -> bool:
        """Whether there are plateaus, by the task's entry."""
        return self.entry.traits is not None and self.entry.traits.plateaus

    @property
    def peers(self) -> list[str]:
        """Those that are not ours."""
        return [name for name in self.ran if not is_ours(name)]

    @property
    def with_residuals(self) -> str | None:
        """Ours where residuals are known; None where the task has none or none was run."""
        return next((name for name in WITH_RESIDUALS if name in self.ran), None)

    @property
    def with_one_number(self) -> str | None:
        """Ours where the loss is all that is known; None where none was run."""
        size = self.results["dimensions"]
        allowed = (n for n, most in WITH_ONE_NUMBER.items() if most is None or size < most)
        return next((name for name in allowed if name in self.ran), None)

    @property
    def ours(self) -> str | None:
        """By the rule; None where none of ours was run."""
        return self.with_residuals or self.with_one_number

    def comparable(self, cost: str, ours: str | None = None) -> list[str]:
        """The methods whose cost can be put beside that of ours: seconds of the same machine."""
        if cost != "seconds":
            return [*self.ran]
        return alike(self.results, ours or self.ours or next(iter(self.ran)))

    def best_peer(self, cost: str) -> str | None:
        """The fastest of those that are not ours, even if it gets there from few starts."""
        alike = self.comparable(cost)
        costs = {name: took(self.ran[name], cost) for name in self.peers if name in alike}
        return min(costs, key=lambda name: costs[name], default=None)


def load(name: str, results: Path) -> Iterator[Scene]:
    """What was run on a task, or on each of a family, by the folder of all results."""
    found = committed(name, results)
    if found is None:
        return
    tasks = found.pop("tasks")
    for member, task in tasks.items():
        for method in able(task).values():
            method.setdefault("machines", [in_one_line(found["machine"])])
        scene = Scene(member, task, found, _registry.task(name), name)
        if scene.ran:
            yield scene
