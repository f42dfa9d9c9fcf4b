"""The goals that were set before, and what was measured."""

from collections.abc import Sequence

from benchmarks.report._grid import Grid, Row
from benchmarks.report._scene import Scene
from benchmarks.report._tables import amount, fastest_rival, geometric_mean, ratios_to_ours

PLATEAUS = {"fr22": 4.0, "our_hvpa": 2.5}  # times as long as ours on scenes with plateaus
CONVERGE = ("texture32", "suzanne", "banana", "cnn5")
DERIVATIVES = ("mitsuba_ad",)  # does not treat the renderer as a black box

Verdict = tuple[str, str]  # measured; met: yes, no, or - where nothing was run


def table(scenes: Sequence[Scene]) -> Grid:
    """Goal, measured, met."""
    by_name = {scene.name: scene for scene in scenes}
    goals = {
        "Fastest on every scene to 99 % of the image error, in evaluations": _fastest(
            scenes, "evaluations", ()
        ),
        "The same in seconds, against methods that see a black box": _fastest(
            scenes, "seconds", DERIVATIVES
        ),
        **{
            f"Scenes with plateaus: {method} takes at least {goal:g} times as long to 99 %": _times(
                [scene for scene in scenes if scene.plateau], method, goal
            )
            for method, goal in PLATEAUS.items()
        },
        "Bunny: at least as fast as Mitsuba's AD, seconds to 99 %": _bunny(by_name.get("bunny")),
        **{
            f"{name} converges: 99 % of the image error": _converges(by_name.get(name))
            for name in CONVERGE
        },
    }
    return Grid(
        title="Goals",
        caption="Set before anything was run.",
        columns=("goal", "measured", "met"),
        rows=tuple(Row(goal, verdict) for goal, verdict in goals.items()),
        numbers=False,
    )


def _fastest(scenes: Sequence[Scene], cost: str, without: Sequence[str]) -> Verdict:
    lost = []
    for scene in scenes:
        ours, rival = scene.ours, fastest_rival(scene, cost, without)
        if ours is None:
            lost.append(f"{scene.name} (none of ours ran)")
            continue
        reached = scene.reached(ours, "image_error", "99", cost)
        if reached.median is None:
            lost.append(f"{scene.name} (ours does not get there in most runs)")
        elif rival is not None and (rival[1].median or 0) < reached.median:
            lost.append(
                f"{scene.name} ({rival[0]} {amount(rival[1], cost)}, ours {amount(reached, cost)})"
            )
    measured = f"on {len(scenes) - len(lost)} of {len(scenes)}"
    if lost:
        measured += "; not on " + ", ".join(lost)
    return measured, "no" if lost else "yes"


def _times(scenes: Sequence[Scene], method: str, goal: float) -> Verdict:
    scenes = [scene for scene in scenes if method in scene.ran]
    found = {
        cost: ratios_to_ours(scenes, method, "99", cost) for cost in ("seconds", "evaluations")
    }
    if not all(found.values()):
        return f"no scene of {len(scenes)} where both get there", "-"
    means = {cost: geometric_mean(ratios) for cost, ratios in found.items()}
    measured = (
        f"{means['seconds']:.2f} times the seconds, {means['evaluations']:.2f} times the "
        f"evaluations, on {len(found['seconds'])} of {len(scenes)} scenes, where both get there"
    )
    return measured, "yes" if means["seconds"] >= goal else "no"


def _bunny(scene: Scene | None) -> Verdict:
    if scene is None or scene.ours is None:
        return "not run", "-"
    native = scene.results["methods"].get("mitsuba_ad", {})
    if "runs" not in native:
        return f"Mitsuba's AD: {native.get('not_able', 'not run')}", "-"
    ours, theirs = (
        scene.reached(name, "image_error", "99", "seconds") for name in (scene.ours, "mitsuba_ad")
    )
    measured = f"ours {amount(ours, 'seconds')}, Mitsuba's AD {amount(theirs, 'seconds')}"
    if ours.median is None:
        return measured, "no"
    return measured, "yes" if theirs.median is None or ours.median <= theirs.median else "no"


def _converges(scene: Scene | None) -> Verdict:
    if scene is None or scene.ours is None:
        return "not run", "-"
    left = scene.ran[scene.ours]["image_error"]["final"]["median"]
    reached = scene.reached(scene.ours, "image_error", "99", "evaluations")
    end = "nothing finite is" if left is None else f"{100 * left:.2g} % are"
    measured = f"{end} left; {reached.solved} of {reached.starts} runs get there"
    return measured, "yes" if reached.median is not None else "no"
