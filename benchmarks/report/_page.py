"""The page: HTML with everything in it, that a phone shows, a printer prints, and mail carries."""

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

from benchmarks import tasks
from benchmarks.report import _atlas, _goals, _panels, _savings, _tables
from benchmarks.report._grid import Grid, to_html
from benchmarks.report._scene import RULE_TEXT, Scene

REMARK = "remark.txt"  # of a scene, written by hand: why it was lost, say
STYLE = Path(__file__).with_name("style.css").read_text()


def page(scenes: Sequence[Scene], overall: Sequence[Grid], results: Path) -> str:
    """The whole page.

    Args:
        scenes: What was run.
        overall: The tables of all scenes together.
        results: The folder of results, for pictures and remarks.

    Returns:
        HTML that needs no other file.
    """
    look = _panels.look_of(scenes)
    swatches = _panels.swatches(look)
    links = "".join(f'<a href="#{s.name}">{escape(s.name)}</a>' for s in scenes)
    parts = [
        "<!doctype html><html lang=en><head><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width,initial-scale=1">',
        f"<title>Inverse rendering: every method side by side</title><style>{STYLE}</style></head>",
        "<body><h1>Inverse rendering without derivatives of the renderer: every method side by "
        "side</h1>",
        _preamble(scenes),
        f"<nav>{links}</nav>",
        *(to_html(grid, swatches) for grid in overall),
        _saved(results / "savings", scenes, swatches),
        _robustness(results / "robustness"),
        *(_section(scene, look, swatches, results / scene.name) for scene in scenes),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _preamble(scenes: Sequence[Scene]) -> str:
    machines = {_machine(scene) for scene in scenes}
    commands = {scene.results["command"] for scene in scenes}
    return (
        f"<p><b>{escape(RULE_TEXT)}</b></p>"
        "<p>Every method sees the same black box and the same starts, and tells where it is after "
        "each step. Image errors are measured on renders without noise, parameter errors against "
        "what is sought; neither is charged to the method. Both are relative to the start's. "
        "Seconds are without compilation. A gradient of Mitsuba's own costs two evaluations.</p>"
        f"<p>Run by {escape('; '.join(sorted(commands)))}. "
        f"On {escape('; '.join(sorted(machines)))}.</p>"
    )


def _machine(scene: Scene) -> str:
    machine = scene.results["machine"]
    versions = ("smoothdiff", "jax", "mitsuba")
    packages = ", ".join(
        f"{p} {machine['versions'][p]}" for p in versions if p in machine["versions"]
    )
    return f"{machine['cores']} cores of {machine['cpu']}, Python {machine['python']}, {packages}"


def _section(scene: Scene, look: _panels.Look, swatches: dict[str, str], folder: Path) -> str:
    results = scene.results
    budget = results["budget"]
    parameters = f"{results['dimensions']:,} parameter{'s' * (results['dimensions'] != 1)}"
    remark = folder / REMARK
    not_able = [
        f"{found['title']}: {found['not_able']}."
        for found in results["methods"].values()
        if "not_able" in found
    ]
    parts = [
        f'<section id="{scene.name}"><h2>{escape(results["title"])}</h2>',
        f"<p>{parameters}, sigma {results['sigma']:g}, at most {budget['evaluations']:,} "
        f"evaluations or {budget['seconds']:g} s a run ({results['setting']}). "
        f"Ours here: {escape(scene.ours or 'none was run')}.</p>",
        _told(scene.name),
    ]
    if results["notes"]:
        parts.append(f"<p>{escape(results['notes'])}.</p>")
    if remark.exists():
        parts.append(f"<p class=remark>{escape(remark.read_text().strip())}</p>")
    parts += [
        _pictures(scene, folder),
        _curves(scene, look),
        *(to_html(grid, swatches) for grid in _tables.of_scene(scene)),
    ]
    if not_able:
        parts.append(f"<p>Not able: {escape(' '.join(not_able))}</p>")
    return "\n".join([*parts, "</section>"])


def _told(name: str) -> str:
    """What the task's module says of itself: what is varied, what is left out and why."""
    text = tasks.module(name).__doc__ or ""
    paragraphs = (" ".join(part.split()) for part in text.strip().split("\n\n"))
    return "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)


def _pictures(scene: Scene, folder: Path) -> str:
    pictures = _atlas.load(scene.results, folder)
    if pictures is None:
        return ""
    away = _atlas.differences(pictures)
    cards = [
        _card("Reference", [pictures.reference]),
        _card("Start", [pictures.start, away[""]]),
        *(
            _card(
                f"{scene.ran[name]['title']}: {scene.ran[name]['runs'][0]['image_error'][-1]:.2g}",
                [pictures.found[name], away[name]],
            )
            for name in sorted(scene.ran, key=lambda name: name != scene.ours)
        ),
    ]
    return (
        "<figure><figcaption>The first start: what each method found, how far it is from the "
        "reference (white is as far as the start), and the image error that is left."
        f"</figcaption><div class=pictures>{''.join(cards)}</div></figure>"
    )


def _card(caption: str, pictures: list) -> str:
    shown = "".join(f'<img alt="" src="{_atlas.data_uri(picture)}">' for picture in pictures)
    kind = " class=single" if len(pictures) == 1 else ""
    return f"<figure{kind}>{shown}<figcaption>{escape(caption)}</figcaption></figure>"


def _curves(scene: Scene, look: _panels.Look) -> str:
    shown = "".join(
        f'<img alt="{escape(what)}" src="{source}">' for what, source in _panels.panels(scene, look)
    )
    starts = max(found["starts"] for found in scene.ran.values())
    return (
        f"<figure><figcaption>Medians over {starts} starts. Thick lines are ours; the one "
        "that is compared has its quartiles. The tables name the lines.</figcaption>"
        f"<div class=panels>{shown}</div></figure>"
    )


def _saved(folder: Path, scenes: Sequence[Scene], swatches: dict[str, str]) -> str:
    picture = _picture(folder / "savings.png")
    if not picture:
        return ""
    table = _savings.table(json.loads((folder / "results.json").read_text()), scenes)
    told = (
        "What a scene does not need, it does not pay for; the scenes below say what they leave "
        "out. Here is a render with all savings, and without each of them."
    )
    return f"<h2>Savings</h2><p>{told}</p>{to_html(table, swatches)}{picture}"


def _robustness(folder: Path) -> str:
    picture = _picture(folder / "robustness.png")
    told = "Starts, samples of a step, samples of a pixel, and a reference that was a JPEG."
    return f"<h2>Robustness</h2><p>{told}</p>{picture}" if picture else ""


def _picture(path: Path) -> str:
    if not path.exists():
        return ""
    source = _atlas.png_uri(path.read_bytes())
    return f'<img class=wide alt="{path.stem}" src="{source}">'


def overall(scenes: Sequence[Scene]) -> list[Grid]:
    """The tables of all scenes together."""
    plateaus = [scene for scene in scenes if scene.plateau]
    others = [scene for scene in scenes if not scene.plateau]
    grids = [_goals.table(scenes), _tables.of_scenes(scenes), _tables.over(scenes, "all scenes")]
    if plateaus and others:
        grids += [
            _tables.over(plateaus, "scenes with plateaus"),
            _tables.over(others, "scenes without"),
        ]
    paper = _tables.beside_the_paper(scenes)
    return grids if paper is None else [*grids, paper]
