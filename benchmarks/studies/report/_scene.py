"""A scene's results as the report reads them, and which method is ours there.

Ours is one rule, and not what came out best: least squares where there are residuals, and a support
where parameters act locally, as README advises. It was set before anything was run, and changed
twice: after results of cnn5, suzanne and mlp were seen, as it named grey_ours and local_gradient,
and left gauss_newton out where there were more than 300 parameters; and when local_gauss_newton was
written, whose settings had been chosen on suzanne and banana. Those of grey_gauss_newton were on
cnn5.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import _registry
from benchmarks._study import committed
from benchmarks._summary import able

FEW = 300  # parameters
# in this order, and up to how many parameters; one that needs what a task lacks does not run on it
RULE = {
    "grey_gauss_newton": None,
    "local_gauss_newton": None,
    "gauss_newton": None,
    "local_first_order": None,
    "newton_cg": FEW,
    "first_order": None,
}
# all that are no rivals of ours
OURS = (*RULE, "grey_ours", "local_gradient", "local_cross_entropy")
RULE_TEXT = (
    "Ours is grey_gauss_newton where AD knows a part of the task; else local_gauss_newton where the"
    " task has residuals and a local support; else gauss_newton where it has residuals; else"
    " local_first_order where it has a local support; else newton_cg up to"
    f" {FEW} parameters; else first_order. Each with one setting for all scenes."
)
LEVELS = ("90", "99", "99.9")
ERRORS = ("image_error", "parameter_error")
# an optimiser gets stuck there, or not: by what is seen of what is sought from the starts
NO_PLATEAU = ("bunny", "texture32", "suzanne", "banana", "caustic", "glass-ball", "brdf", "quad")


class Reached(NamedTuple):
    """What a level took: the median over the starts, None where no more than half got there."""

    median: float | None
    solved: int
    starts: int


class Scene(NamedTuple):
    """One scene: its part of results.json, and what stands at the head of that."""

    name: str
    results: dict[str, Any]
    about: dict[str, Any]

    @property
    def ran(self) -> dict[str, Any]:
        """The methods that were able."""
        return able(self.results)

    @property
    def ours(self) -> str | None:
        """By the rule; None where none of ours was run."""
        size = self.results["dimensions"]
        allowed = (name for name, most in RULE.items() if most is None or size <= most)
        return next((name for name in allowed if name in self.ran), None)

    @property
    def plateau(self) -> bool:
        return self.name not in NO_PLATEAU

    def reached(self, method: str, error: str, level: str, cost: str) -> Reached:
        """What a method took to a level, in evaluations or seconds."""
        found = self.ran[method]
        took = found["took"][error][level]
        return Reached(took[cost]["median"], took["solved"], found["starts"])

    def ratio(self, method: str, to: str | None, error: str, level: str, cost: str) -> float | None:
        """How many times as long as `to` a method took; None where one of them did not get there.

        A level that is reached at once, as where the start is solved, gives no ratio.
        """
        if to not in self.ran or method not in self.ran:
            return None
        one, other = (self.reached(name, error, level, cost).median for name in (method, to))
        return one / other if one and other else None


def load(name: str, results: Path) -> Scene | None:
    """What was run on a scene, by the folder of all results; None where nothing was."""
    found = committed(name, results)
    if found is None:
        return None
    scene = Scene(name, next(iter(found.pop("tasks").values())), found)
    return scene if scene.ran else None


def title(method: str, scenes: Sequence[Scene]) -> str:
    """The title of a method, as it was when it ran."""
    return next(scene.ran[method]["title"] for scene in scenes if method in scene.ran)


def all_methods(scenes: Sequence[Scene]) -> list[str]:
    """All that ran on any scene, in one order."""
    return [name for name in _registry.methods() if any(name in scene.ran for scene in scenes)]
