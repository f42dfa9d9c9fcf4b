"""The page: HTML with everything in it, made by templates from results; it needs no other file."""

import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from benchmarks import _atlas, _registry
from benchmarks._grid import short
from benchmarks._names import NAMES, name_of
from benchmarks._reached import machines, not_able, others, ran_on, ranked, reached, took
from benchmarks._summary import COSTS
from benchmarks.studies.report import _chart, _finder
from benchmarks.studies.report._compare import in_one_line, ratio
from benchmarks.studies.report._overall import overall
from benchmarks.studies.report._parts import Part, Sub, parts
from benchmarks.studies.report._scene import RULE_TEXT, Scene
from benchmarks.studies.report._standing import amount, first, loses

TEMPLATES = Path(__file__).with_name("templates")
SIX = 6  # lines that have a name
NARROW, WIDE = 0.2, 50.0  # the ends of a bar: times as fast
SCALE = {0.2: "5× worse", 1: "1×", 10: "10×", 50: "50× better"}
IN_PROFILES = ("cma-es", "bobyqa", "dfo-ls", "nelder-mead")  # peers
WORDS = {"evaluations": ("fewer", "more"), "seconds": ("faster", "slower")}


def page(scenes: Sequence[Scene], results: Path, whole: bool) -> str:
    """The page of some scenes; with all that is beside them if it is the `whole`."""
    beside = list(parts(results)) if whole else []
    tables = Part("methods", "All methods together", [Sub("Tables", overall(scenes), open=True)])
    return (
        _environment()
        .get_template("page.html")
        .render(
            css=Markup((TEMPLATES / "style.css").read_text()),
            js=Markup((TEMPLATES / "page.js").read_text()),
            names=NAMES,
            finder=finder(scenes, {part.key for part in beside}),
            summary=in_one_line(scenes),
            rule=RULE_TEXT,
            scenes=[of_scene(scene) for scene in scenes],
            parts=[tables, *beside],
            machines=sorted({machine for scene in scenes for machine in ran_on(scene.results)}),
        )
    )


@cache
def _environment() -> jinja2.Environment:
    loader = jinja2.FileSystemLoader(TEMPLATES)
    strict: Any = jinja2.StrictUndefined
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=strict, trim_blocks=True, lstrip_blocks=True
    )
    made.filters["code"] = _code
    return made


def _code(text: str) -> Markup:
    """What stands between backticks, as code."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def finder(scenes: Sequence[Scene], beside: set[str]) -> dict[str, Any]:
    """What the first screen asks, and all its answers; `beside` are the parts of the page."""
    size = {
        "key": "size",
        "asks": "My problem has",
        "choices": [(size.key, size.name) for size in _finder.SIZES],
        "ends": "parameters",
    }
    plateaus = {"key": "plateaus", "asks": "with", "choices": _finder.PLATEAUS.items(), "ends": ""}
    seen = {"key": "seen", "asks": "and gives", "choices": _finder.SEEN.items(), "ends": ""}
    found = [_answer(answer, "profiles" in beside) for answer in _finder.answers(scenes)]
    scale = [(_place(times), label) for times, label in SCALE.items()]
    groups = [size, plateaus, seen]
    asked = {"peers": _finder.PEERS, "groups": groups, "answers": found}
    return asked | {"one": _place(1), "scale": scale}


def _answer(answer: _finder.Answer, profiles: bool) -> dict[str, Any]:
    plateaus, seen = _finder.PLATEAUS[answer.plateaus], _finder.SEEN[answer.seen]
    told: dict[str, Any] = {
        "key": answer.key,
        "peer": answer.peer,
        "asked": f"{answer.size.name} parameters, {plateaus}, {seen}",
    }
    if not answer.pairs:
        see = profiles and answer.peer.key in IN_PROFILES
        return told | {"bars": [], "why_none": answer.why_none, "see": see}
    count, (ours, theirs) = len(answer.pairs), answer.solved
    a, b, c, d = answer.starts
    return told | {
        "ours": answer.ours,
        "theirs": answer.peer.name,
        "bars": [_bar(answer, cost) for cost in COSTS],
        "solved": f"Solved: {answer.ours} {ours} of {count} ({a} of {b} starts), "
        f"{answer.peer.name} {theirs} of {count} ({c} of {d}).",
        "scenes": [(pair.scene.name, pair.scene.label) for pair in answer.pairs],
    }


def _bar(answer: _finder.Answer, cost: str) -> dict[str, Any]:
    """How many times as fast, as a bar from one, in percent of the track."""
    found = answer.tally(cost)
    of = found.mean
    bar: dict[str, Any] = {"cost": cost, "width": None, "interval": "", "low": None}
    if not answer.comparable(cost):
        return bar | {"told": "not measured on one machine"}
    if of is None:
        ours, theirs = answer.solved
        only = answer.ours if ours else answer.peer.name
        return bar | {"told": f"only {only} gets there" if ours or theirs else "neither gets there"}
    one, at = _place(1), _place(of.value)
    kind = "win" if of.value >= 1 else "lose"
    on = f"{of.scenes} scene{'s' * (of.scenes > 1)}"
    if of.scenes > 1:
        low, high = _place(of.low), _place(of.high)
        bar |= {"low": low, "span": round(high - low, 1)}
        on = f"[{of.low:.2g}, {of.high:.2g}], {on}"
        kind = "even" if of.low < 1 < of.high else kind
    elif answer.close(cost):
        kind, on = "even", f"{on}, quartiles overlap"
    bar |= {"left": min(one, at), "width": round(abs(at - one), 1), "kind": kind, "interval": on}
    return bar | {"told": in_words(of.value, cost)}


def in_words(value: float, cost: str) -> str:
    """How many times as fast, in two digits; what rounds to once as fast is level."""
    better, worse = WORDS[cost]
    times, word = (value, better) if value >= 1 else (1 / value, worse)
    return "level" if f"{times:.2g}" == "1" else f"{times:.2g}× {word}"


def _place(times: float) -> float:
    share = math.log(min(max(times, NARROW), WIDE) / NARROW) / math.log(WIDE / NARROW)
    return round(100 * share, 1)


def of_scene(scene: Scene) -> dict[str, Any]:
    """All that the template says of a scene."""
    named = _named(scene)
    pictures = _pictures(scene)
    results, chosen = scene.results, ("Start", "Reference", *named)
    drawn = lambda error: (_chart.of_scene(scene, named, error, cost) for cost in COSTS)
    curves = lambda error: [chart for chart in drawn(error) if chart is not None]
    return {
        "name": scene.name,
        "label": scene.label,
        "title": results["title"],
        "about": _about(scene),
        "told": _told(scene),
        "notes": results["notes"],
        "remark": results.get("remark", ""),
        "number": _number(scene),
        "rival": _rival(scene),
        "cards": [pictures[k] for k in ("Start", scene.ours, "Reference") if k in pictures],
        "pictures": [pictures[k] for k in ("Reference", "Start", *named) if k in pictures],
        "more_pictures": [shown for key, shown in pictures.items() if key not in chosen],
        "wide": _is_wide(scene),
        "film": _film(scene),
        "standing": [first(scene, cost) for cost in COSTS],
        "loses": loses(scene),
        "charts": curves("image_error"),
        "more_charts": curves("parameter_error"),
        "legend": [NAMES[name] for name in named],
        "more_lines": len(scene.ran) > len(named),
        "table": reached(results, alike=scene.comparable("seconds")),
        "lines": list(filter(None, (others(results), not_able(results), machines(results)))),
        "command": scene.about["command"],
    }


def _named(scene: Scene) -> list[str]:
    """Six: ours, ours where one number is all that is known, the best, and the best peers."""
    best = ranked(scene.results)
    peers = [name for name in best if name in scene.peers]
    known = [scene.ours, scene.with_one_number, best[0], *peers, *best]
    return list(dict.fromkeys(name for name in known if name in NAMES))[:SIX]


def _about(scene: Scene) -> str:
    results, budget = scene.results, scene.results["budget"]
    count = results["dimensions"]
    starts = sorted({found["starts"] for found in scene.ran.values()})
    return (
        f"{count:,} parameter{'s' * (count != 1)}; {'' if scene.plateaus else 'no '}plateaus; "
        f"ours here is {name_of(scene.ours or 'none')}; {' or '.join(map(str, starts))} starts; at "
        f"most {budget['evaluations']:,} evaluations or {budget['seconds']:g} s a run."
    )


def _told(scene: Scene) -> list[str]:
    """What its module says, beginning with what it says of this one."""
    said = _registry.told(scene.entry)
    own = [part for part in said if part.startswith(f"`{scene.task}`")]
    return own + [part for part in said if part not in own]


def _number(scene: Scene) -> str:
    if scene.ours is None:
        return ""
    median = took(scene.ran[scene.ours], "evaluations").median
    if math.isfinite(median):
        return f"{amount(median, 'evaluations')} evaluations"
    left = scene.ran[scene.ours]["final"]["image_error"]["median"]
    return f"not solved: leaves {short(100 * left)} %"


def _rival(scene: Scene) -> str:
    """The best peer, and how many times as long it takes."""
    best = scene.best_peer("evaluations")
    if best is None or not (theirs := took(scene.ran[best], "evaluations")).reached:
        return "no peer solves it"
    times = ratio(took(scene.ran[scene.ours], "evaluations"), theirs) if scene.ours else None
    so = f", {times:.2g}× as many" if times else ""
    return f"{name_of(best)} {amount(theirs.median, 'evaluations')}{so}"


def _pictures(scene: Scene) -> dict[str, dict[str, str]]:
    """By method, "Start" and "Reference", what is shown and how far it is away."""
    stored = _atlas.stored(scene.results, list(scene.ran))
    if stored is None:
        return {}
    away = _atlas.differences(stored)
    uri = lambda of: _atlas.data_uri(_atlas.png(of))
    found = {"Reference": {"uri": uri(stored.reference), "away": "", "caption": "Reference"}}
    found["Start"] = {"uri": uri(stored.start), "away": uri(away[""]), "caption": "Start"}
    for name, picture in stored.found.items():
        left = short(100 * scene.ran[name]["first"])
        caption = f"{name_of(name, scene.ran[name]['title'])}: {left} % left"
        found[name] = {"uri": uri(picture), "away": uri(away[name]), "caption": caption}
    return found


def _is_wide(scene: Scene) -> bool:
    """Whether pictures are so wide that they need two columns."""
    stored = _atlas.stored(scene.results, list(scene.ran))
    return stored is not None and stored.start.shape[1] > 2 * stored.start.shape[0]


def _film(scene: Scene) -> list[dict[str, Any]]:
    """What some methods had found after so many renders, a line for each."""
    shot = scene.results.get("film")
    if not shot:
        return []
    lines = []
    for name, pictures in _atlas.frames(shot).items():
        each = zip(shot["marks"], pictures, shot["errors"][name], strict=True)
        frames = [
            {
                "uri": _atlas.data_uri(_atlas.png(picture)),
                "away": "",
                "caption": f"{name_of(name)} after {mark}: {short(100 * error)} % left",
            }
            for mark, picture, error in each
        ]
        lines.append({"name": name_of(name), "frames": frames})
    return lines
