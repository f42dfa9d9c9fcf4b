"""Who is faster: ratios of medians, quartiles that overlap, and a mean over scenes with its interval.

Where the quartiles of two methods overlap neither is called faster. A ratio is of medians, where
both get there from more than half of the starts; where only one does there is a winner and no ratio.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from benchmarks._reached import Took, took
from benchmarks.studies.report._scene import Scene

RESAMPLES, SEED, COVERED = 10_000, 0, 95  # of the bootstrap over scenes; percent
Verdict = Literal["win", "tie", "loss", "neither"]


class Mean(NamedTuple):
    """A geometric mean of ratios with its interval, and of how many."""

    value: float
    low: float
    high: float
    count: int


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
    return Mean(*(math.exp(each) for each in (logs.mean(), low, high)), len(ratios))


def tally(pairs: Sequence[tuple[Took, Took]]) -> Tally:
    """The mean and the verdicts of pairs of ours and another."""
    ratios = [each for pair in pairs if (each := ratio(*pair)) is not None]
    verdicts: dict[Verdict, int] = {"win": 0, "tie": 0, "loss": 0, "neither": 0}
    for pair in pairs:
        verdicts[verdict(*pair)] += 1
    return Tally(mean(ratios), verdicts)


def against_best(scenes: Sequence[Scene], cost: str) -> Tally:
    """Ours against whichever peer is best on each scene, after the fact."""
    pairs = []
    for scene in scenes:
        if scene.ours is None or not scene.peers:
            continue
        best = scene.best_peers.get(cost, scene.peers[0])
        pairs.append((took(scene.ran[scene.ours], cost), took(scene.ran[best], cost)))
    return tally(pairs)


def in_one_line(scenes: Sequence[Scene]) -> str:
    """All scenes, in one line."""
    told = []
    for cost in ("evaluations", "seconds"):
        found = against_best(scenes, cost)
        wins, ties, losses = (found.verdicts[each] for each in ("win", "tie", "loss"))
        so_much = "no scene that both solve"
        if (of := found.mean) is not None:
            so_much = f"{of.value:.2g}× [{of.low:.2g}, {of.high:.2g}] on {of.count} that both solve"
        told.append(f"{cost} {so_much}, {wins} wins, {ties} ties, {losses} losses")
    unsolved = against_best(scenes, "evaluations").verdicts["neither"]
    nobody = f"; nobody solves {unsolved}" if unsolved else ""
    return (
        f"Ours over {len(scenes)} scenes and programs, to 99 % of the image error, against the best "
        f"peer of each: {'; '.join(told)}{nobody}."
    )
