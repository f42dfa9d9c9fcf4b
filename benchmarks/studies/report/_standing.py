"""What is said of a scene in words, generated: who is first, and where ours loses."""

import math
from typing import Any

from benchmarks._grid import short
from benchmarks._names import name_of
from benchmarks._reached import ERROR, SOLVED, Took, ranked, took
from benchmarks._summary import COSTS, REDUCTIONS
from benchmarks.studies.report._compare import verdict
from benchmarks.studies.report._scene import Scene

UNITS = {"evaluations": "", "seconds": " s"}
FEW_STARTS = 4  # with fewer, a quartile is a single start


def amount(number: float, cost: str) -> str:
    """A cost with its unit."""
    return f"{number:.0f}" if cost == "evaluations" else f"{short(number)}{UNITS[cost]}"


def first(scene: Scene, cost: str) -> str:
    """Who is first to 99 % in a cost; nobody where quartiles overlap."""
    alike = scene.comparable(cost)
    told = _first(scene, cost, {n: took(scene.ran[n], cost) for n in alike})
    if len(alike) == len(scene.ran):
        return told
    return f"{told} That is of the {len(alike)} of {len(scene.ran)} methods run on one machine."


def _first(scene: Scene, cost: str, found: dict[str, Took]) -> str:
    """The same among some methods."""
    order = [name for name in ranked(scene.results) if name in found]
    there = sorted((n for n in order if found[n].reached), key=lambda name: found[name].median)
    if len(found) == 1 < len(scene.ran) and there:
        return f"In {cost}: {name_of(there[0])} {_interval(found[there[0]], cost)}."
    if not there:
        return f"In {cost}, no method gets to {SOLVED} % from more than half of the starts."
    best, *behind = there
    near = [name for name in behind if found[name].lower <= found[best].upper]
    said = f"{name_of(best)} ({_interval(found[best], cost)})"
    if near:
        close = ", ".join(f"{name_of(name)} ({_interval(found[name], cost)})" for name in near[:3])
        more = f" and {len(near) - 3} more" if len(near) > 3 else ""
        told = f"In {cost}, nothing is first: the quartiles of {said} overlap with {close}{more}."
    elif behind:
        after = f"{name_of(behind[0])} ({_interval(found[behind[0]], cost)})"
        told = f"First in {cost}: {said}, before {after}."
    else:
        told = f"First in {cost}: {said}; no other gets there."
    return told + _hangs(scene, cost, best, behind, found)


def _hangs(scene: Scene, cost: str, best: str, behind: list[str], found: dict[str, Took]) -> str:
    """Whether one start more or less would change who is first by the median, where it is known."""
    reasons = []
    if found[best].starts < FEW_STARTS:
        reasons.append(f"It rests on {found[best].starts} starts.")
    second = behind[0] if behind else None
    if _without_one(scene.ran[best], cost, "most") > (found[second].median if second else math.inf):
        reasons.append("That place hangs on one start: without it another is first by the median.")
    elif second and _without_one(scene.ran[second], cost, "least") < found[best].median:
        reasons.append(
            f"That place hangs on one start of {name_of(second)}: without it that is first."
        )
    return "".join(f" {reason}" for reason in reasons)


def _without_one(found: dict[str, Any], cost: str, which: str) -> float:
    """The least or the most that the median is when one start is left out; as it is, if unknown."""
    level = found["took"][ERROR][SOLVED][cost]
    value = level.get(which, level["median"])
    return math.inf if value is None else value


def loses(scene: Scene) -> list[str]:
    """Where ours loses: to which level, in which cost, and at the end. It is never empty."""
    ours = scene.ours
    if ours is None:
        return ["None of ours was run."]
    said = [line for cost in COSTS for line in _ahead(scene, ours, cost)]
    left = _less_left(scene, ours)
    if left:
        mine, theirs = (
            short(100 * scene.ran[name]["final"][ERROR]["median"]) for name in (ours, left[0])
        )
        said.append(
            f"At the end: {name_of(left[0])} leaves {theirs} %, ours {mine} %{_more(left)}."
        )
    said += _surer(scene, ours)
    return said or ["Nowhere beyond the quartiles, on the way or at the end."]


def _ahead(scene: Scene, ours: str, cost: str) -> list[str]:
    """A line for the fastest at each level; one for several levels where it is the same method."""
    lines: list[tuple[str, list[str], list[float], list[str]]] = []
    for level in REDUCTIONS:
        mine = took(scene.ran[ours], cost, level)
        others = {name: took(scene.ran[name], cost, level) for name in scene.comparable(cost)}
        ahead = [name for name in others if verdict(mine, others[name]) == "loss"]
        if not ahead:
            continue
        ahead.sort(key=lambda name: others[name].median)
        times = mine.median / max(others[ahead[0]].median, 1e-9)
        if lines and lines[-1][0] == ahead[0]:
            _, levels, each, most = lines[-1]
            levels.append(level)
            each.append(times)
            most += [name for name in ahead if name not in most]
        else:
            lines.append((ahead[0], [level], [times], ahead))
    return [
        f"In {cost} to {_and(levels)} %: {name_of(best)}, {_times(each)}{_more(most)}."
        for best, levels, each, most in lines
    ]


def _and(words: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _times(each: list[float]) -> str:
    low, high = (short(of) for of in (min(each), max(each)))
    if math.isinf(min(each)):
        return "which gets there where ours does not"
    if math.isinf(max(each)):
        return f"{low} times as fast, and gets further than ours"
    return f"{low} times as fast" if low == high else f"{low} to {high} times as fast"


def _more(ahead: list[str]) -> str:
    """How many others are ahead too."""
    count = len(ahead) - 1
    return f"; {count} other{'s are' if count > 1 else ' is'} ahead too" if count else ""


def _less_left(scene: Scene, ours: str) -> list[str]:
    """Those that leave less at the end, beyond the quartiles, the least first."""
    left = {name: _left(found) for name, found in scene.ran.items()}
    less = [name for name in left if left[name][1] < left[ours][0]]
    return sorted(less, key=lambda name: left[name][1])


def _left(found: dict[str, Any]) -> tuple[float, float]:
    final = found["final"][ERROR]
    low, high = (math.inf if final[q] is None else final[q] for q in ("lower", "upper"))
    return low, high


def _surer(scene: Scene, ours: str) -> list[str]:
    """Who gets to 99 % from more of the starts, as a share."""
    found = {name: took(scene.ran[name], "evaluations") for name in scene.ran}
    share = lambda name: found[name].solved / found[name].starts
    best = max(found, key=share)
    if share(best) <= share(ours):
        return []
    theirs, mine = found[best], found[ours]
    return [
        f"To {SOLVED} % at all: {name_of(best)} from {theirs.solved} of {theirs.starts} starts, "
        f"ours from {mine.solved} of {mine.starts}."
    ]


def _interval(found: Took, cost: str) -> str:
    each = (found.lower, found.median, found.upper)
    low, middle, high = (amount(of, cost) if math.isfinite(of) else "never" for of in each)
    return f"{middle} [{low}, {high}]"
