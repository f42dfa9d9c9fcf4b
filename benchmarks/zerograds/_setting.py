"""How much of the report is run, and the tasks at that size."""

import dataclasses
from typing import NamedTuple

from benchmarks import tasks
from benchmarks._task import Budget, Task

PLENTY = 3600.0  # seconds: what ends a run is its evaluations


class Setting(NamedTuple):
    """How much is run.

    Args:
        name: "quick" or "full", a part of the files' names.
        seeds: Starts of the ablations and of the numbers of samples.
        budgets: Evaluations of a run, by task. What is not here is not run.
        samples: The numbers of samples that are compared, and on which tasks.
        gradients: The tasks on which gradients are looked at.
        gradient_seeds: Starts there.
        truth: Samples of a true gradient.
        replay: The tasks on which earlier batches are seen again, or not.
        replay_seeds: Starts there.
        control: The tasks on which the surrogate is a control variate; gradient_seeds starts.
        repeats: Estimates of which a variance is taken.
    """

    name: str
    seeds: int
    budgets: dict[str, int]
    samples: dict[str, tuple[int, ...]]
    gradients: tuple[str, ...]
    gradient_seeds: int
    truth: int
    replay: tuple[str, ...]
    replay_seeds: int
    control: tuple[str, ...]
    repeats: int

    def with_starts(self, number: int) -> "Setting":
        """The same from so many starts, in every study."""
        return self._replace(seeds=number, gradient_seeds=number, replay_seeds=number)


QUICK = Setting(
    name="quick",
    seeds=2,
    budgets={
        "brdf": 1000,
        "led": 4000,
        "wicker": 600,
        "node-graph": 2000,
        "rocket10": 2000,
        "gravity": 600,
    },
    samples={"led": (2, 4, 8, 16), "rocket10": (2, 4, 8, 16, 32)},
    gradients=("rocket10", "led"),
    gradient_seeds=2,
    truth=4096,
    replay=("rocket10", "wicker", "node-graph", "led"),
    replay_seeds=5,
    control=("rocket10", "led"),
    repeats=100,
)
FULL = Setting(
    name="full",
    seeds=10,
    budgets={
        "mosaic": 60_000,
        "brdf": 5000,
        "led": 20_000,
        "wicker": 3000,
        "node-graph": 10_000,
        "rocket10": 10_000,
        "gravity": 3000,
        "mlp": 10_000,
        "texture256": 4000,
    },
    samples={"mlp": (2, 4, 8, 16, 20, 32, 64), "rocket10": (2, 4, 8, 16, 32, 64)},
    gradients=("rocket10", "led", "mosaic", "mlp"),
    gradient_seeds=5,
    truth=32_768,
    replay=("rocket10", "wicker", "node-graph", "brdf", "gravity", "led"),
    replay_seeds=10,
    control=("rocket10", "led"),
    repeats=400,
)


def load(name: str, setting: Setting) -> Task:
    """A task with the budget of the setting: of a family the first, at its quick size."""
    built = tasks.module(name).build(False)
    first = built[0] if isinstance(built, list) else built
    return dataclasses.replace(first, budget=Budget(setting.budgets[name], PLENTY))
