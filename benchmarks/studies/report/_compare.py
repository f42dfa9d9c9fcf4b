"""Who is faster: ratios of medians, quartiles that overlap, and means over scenes.

Where the quartiles of two methods overlap neither is called faster. A ratio is of medians, where
both get there from more than half of the starts; where one does there is no ratio.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from benchmarks._reached import SOLVED, Took, took
from benchmarks._summary import COSTS
from benchmarks.studies.report._scene import Scene

RESAMPLES, SEED, COVERED = 10_000, 0, 95  # of the bootstrap over scenes; percent
Verdict = Literal["win", "tie", "loss", "neither"]


class Mean(NamedTuple):
    """A geometric mean of ratios with its interval, and of how many."""

    value: float
    low: float
    high: float
    scenes: int


class Tally(NamedTuple):
    """Ours against others over scenes, in one cost."""

    mean: Mean | None  # of how many times as long others take
    verdicts: dict[Verdict, int]


def verdict(ours: Took, theirs: Took) -> Verdict:
    """Whether ours is faster beyond the quartiles, slower, or neither; or nobody gets there."""
    if not (ours.reached or theirs.reached):
        return "neither"
    if ours.upper < theirs.lower:
        return "win"
    return "loss" if theirs.upper < ours.lower else "tie"


def ratio(ours: Took, theirs: Took) -> float | None:
    """How many times as long as ours the other took; None unless both got there."""
    if not (ours.reached and theirs.reached and ours.median and theirs.median):
        return None
    return theirs.median / ours.median


def mean(ratios: Sequence[float]) -> Mean | None:
    """The geometric mean with its bootstrap interval over scenes; of one scene, no interval."""
    if not ratios:
        return None
    logs = np.log(ratios)
    drawn = np.random.default_rng(SEED).choice(logs, (RESAMPLES, len(logs))).mean(axis=1)
    edge = (100 - COVERED) / 2
    low, high = np.percentile(drawn, [edge, 100 - edge])
    value, low, high = (math.exp(each) for each in (logs.mean(), low, high))
    return Mean(value, low, high, len(ratios))


def tally(pairs: Sequence[tuple[Took, Took]]) -> Tally:
    """The mean and the verdicts of pairs of ours and another."""
    ratios = [each for pair in pairs if (each := ratio(*pair)) is not None]
    verdicts: dict[Verdict, int] = {"win": 0, "tie": 0, "loss": 0, "neither": 0}
    for pair in pairs:
        verdicts[verdict(*pair)] += 1
    return Tally(mean(ratios), verdicts)


def against_best(scenes: Sequence[Scene], cost: str) -> Tally:
    """Ours against whichever peer is best on each scene, after the fact.

    It loses where any peer is ahead beyond the quartiles, whether that one is first by the median
    or another, which gets there from fewer starts.
    """
    pairs, verdicts = [], Counter[Verdict]()
    for scene in scenes:
        best = scene.best_peer(cost)
        if scene.ours is None or best is None:
            continue
        ours = took(scene.ran[scene.ours], cost)
        each = {n: took(scene.ran[n], cost) for n in scene.comparable(cost) if n in scene.peers}
        lost = any(verdict(ours, theirs) == "loss" for theirs in each.values())
        verdicts["loss" if lost else verdict(ours, each[best])] += 1
        pairs.append((ours, each[best]))
    found = tally(pairs)
    return found._replace(verdicts={of: verdicts[of] for of in found.verdicts})


def in_one_line(scenes: Sequence[Scene]) -> str:
    """All scenes, in one line."""
    found = {cost: against_best(scenes, cost) for cost in COSTS}
    means = [
        f"{of.value:.2g} times{_interval(of)} the {cost}"
        for cost, each in found.items()
        if (of := each.mean) is not None
    ]
    counts = "; ".join(
        f"{cost} {_counted(of['win'], 'win')}, {_counted(of['tie'], 'tie')}, "
        f"{_counted(of['loss'], 'loss')}"
        for cost, of in ((cost, each.verdicts) for cost, each in found.items())
    )
    unsolved = found["evaluations"].verdicts["neither"]
    who = "The best peer of each scene" if len(scenes) > 1 else "The best peer"
    return (
        f"{who} takes {' and '.join(means) or 'no known share'} of ours: {_over(scenes, found)}, "
        f"to {SOLVED} % of the image error; {counts}; {unsolved} that nobody solves."
    )


def _over(scenes: Sequence[Scene], found: dict[str, Tally]) -> str:
    """What the means are over."""
    if len(scenes) == 1:
        return "on one scene"
    most, fewer = (0 if each.mean is None else each.mean.scenes for each in found.values())
    timed = f" (seconds: on {fewer}, with the peers of one machine)" if fewer < most else ""
    shown = f"{most} of {len(scenes)} scenes and programs that both solve"
    return f"geometric means over the {shown}{timed}"


def _interval(of: Mean) -> str:
    return f" [{of.low:.2g}, {of.high:.2g}]" if of.scenes > 1 else ""


def _counted(number: int, word: str) -> str:
    """One win, two wins; one loss, two losses."""
    more = "es" if word.endswith("s") else "s"
    return f"{number} {word}{'' if number == 1 else more}"
