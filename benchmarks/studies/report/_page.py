"""The page: HTML with everything in it, that a phone shows, a printer prints, and mail carries."""

import base64
import io
from collections.abc import Sequence
from html import escape
from importlib import import_module
from pathlib import Path

from PIL import Image

from benchmarks import _atlas, _registry
from benchmarks._grid import Grid, to_html
from benchmarks._pictures import LABELS, ours_of, panel
from benchmarks._study import committed
from benchmarks._style import STYLE, looks, plt
from benchmarks._summary import COSTS, unable
from benchmarks.studies.report import _tables
from benchmarks.studies.report._scene import ERRORS, OURS, RULE_TEXT, Scene, all_methods

CSS = Path(__file__).with_name("style.css").read_text()
SIZE, DPI = (4.6, 3.3), 110  # of a panel: inches, and dots an inch
COLOURS = 48  # of a picture: lines on white need no more
SVG_DASHES = {"-": "", "--": "6 3", "-.": "6 2 1.5 2", (0, (1, 1)): "1.5 1.5"}
OTHER_DASH = "7 1.5 1.5 1.5 1.5 1.5"
PREAMBLE = (
    "Every method sees the same black box and the same starts, and tells where it is after each "
    "step. Image errors are measured on renders without noise, parameter errors against what is "
    "sought; neither is charged to the method. Both are relative to the start's. Seconds are "
    "without compilation. A gradient of Mitsuba's own costs two evaluations."
)

Look = dict[str, dict]


def page(scenes: Sequence[Scene], overall: Sequence[Grid], results: Path) -> str:
    """The whole page, which needs no other file.

    The folder of results is for what was found about savings and robustness.
    """
    look = _look(scenes)
    swatches = {name: _swatch(line["color"], line["linestyle"]) for name, line in look.items()}
    links = "".join(f'<a href="#{s.name}">{escape(s.name)}</a>' for s in scenes)
    said = "; ".join(sorted({scene.about["command"] for scene in scenes}))
    machines = "; ".join(sorted({_machine(scene) for scene in scenes}))
    parts = [
        "<!doctype html><html lang=en><head><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width,initial-scale=1">',
        f"<title>Inverse rendering: every method side by side</title><style>{CSS}</style></head>",
        "<body><h1>Inverse rendering without derivatives of the renderer: every method side by "
        "side</h1>",
        f"<p><b>{escape(RULE_TEXT)}</b></p><p>{PREAMBLE}</p>",
        f"<p>Run by {escape(said)}. On {escape(machines)}.</p>",
        f"<nav>{links}</nav>",
        *(to_html(grid, swatches) for grid in overall),
        *(_study(name, results) for name in ("savings", "robustness")),
        *(_section(scene, look, swatches) for scene in scenes),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _machine(scene: Scene) -> str:
    machine = scene.about["machine"]
    known = [p for p in ("smoothdiff", "jax", "mitsuba") if p in machine["versions"]]
    packages = ", ".join(f"{p} {machine['versions'][p]}" for p in known)
    return f"{machine['cores']} cores of {machine['cpu']}, Python {machine['python']}, {packages}"


def _section(scene: Scene, look: Look, swatches: dict[str, str]) -> str:
    results = scene.results
    budget = results["budget"]
    parameters = f"{results['dimensions']:,} parameter{'s' * (results['dimensions'] != 1)}"
    not_able = " ".join(f"{title}: {why}." for title, why in unable(results).items())
    parts = [
        f'<section id="{scene.name}"><h2>{escape(results["title"])}</h2>',
        f"<p>{parameters}, sigma {results['sigma']:g}, at most {budget['evaluations']:,} "
        f"evaluations or {budget['seconds']:g} s a run ({scene.about['setting']}). "
        f"Ours here: {escape(scene.ours or 'none was run')}.</p>",
        _told(scene.name),
        f"<p>{escape(results['notes'])}.</p>" if results["notes"] else "",
        f"<p class=remark>{escape(results['remark'])}</p>" if results.get("remark") else "",
        _pictures(scene),
        _curves(scene, look),
        *(to_html(grid, swatches) for grid in _tables.of_scene(scene)),
        f"<p>Not able: {escape(not_able)}</p>" if not_able else "",
    ]
    return "\n".join([*filter(None, parts), "</section>"])


def _told(name: str) -> str:
    """What the task says of itself: what is varied, what is left out and why."""
    build = _registry.task(name).build
    build = getattr(build, "func", build)  # of a partial
    text = import_module(build.__module__).__doc__ or ""
    paragraphs = (" ".join(part.split()) for part in text.strip().split("\n\n"))
    return "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)


def _pictures(scene: Scene) -> str:
    pictures = _atlas.stored(scene.results, list(scene.ran))
    if pictures is None:
        return ""
    away = _atlas.differences(pictures)
    cards = [
        _card("Reference", [pictures.reference]),
        _card("Start", [pictures.start, away[""]]),
    ]
    for name in sorted(scene.ran, key=lambda name: name != scene.ours):
        caption = f"{scene.ran[name]['title']}: {scene.ran[name]['first']:.2g}"
        cards.append(_card(caption, [pictures.found[name], away[name]]))
    return (
        "<figure><figcaption>The first start: what each method found, how far it is from the "
        "reference (white is as far as the start), and the image error that is left."
        f"</figcaption><div class=pictures>{''.join(cards)}</div></figure>"
    )


def _card(caption: str, pictures: list) -> str:
    shown = "".join(f'<img alt="" src="{_atlas.data_uri(_atlas.png(of))}">' for of in pictures)
    kind = " class=single" if len(pictures) == 1 else ""
    return f"<figure{kind}>{shown}<figcaption>{escape(caption)}</figcaption></figure>"


def _look(scenes: Sequence[Scene]) -> Look:
    """The same line for a method in every scene."""
    ran = {name: found for scene in scenes for name, found in scene.ran.items()}
    # a scene has few of ours: those that the rule names have colours of their own there
    ours = sorted(ours_of(ran), key=lambda name: (*OURS, name).index(name))
    return looks(all_methods(scenes), ours)


def _swatch(color: str, linestyle) -> str:
    """A piece of a method's line, as SVG."""
    dash = SVG_DASHES.get(linestyle, OTHER_DASH)
    return (
        '<svg class=swatch viewBox="0 0 30 8" aria-hidden=true><line x1=0 y1=4 x2=30 y2=4 '
        f'stroke="{color}" stroke-width=2.5 stroke-dasharray="{dash}"/></svg>'
    )


def _curves(scene: Scene, look: Look) -> str:
    shown = "".join(
        f'<img alt="{escape(LABELS[error])}, against {cost}" '
        f'src="{_atlas.data_uri(_panel(scene, look, error, cost))}">'
        for error in ERRORS
        for cost in COSTS
    )
    starts = max(found["starts"] for found in scene.ran.values())
    return (
        f"<figure><figcaption>Medians over {starts} starts. Thick lines are ours; the one "
        "that is compared has its quartiles. The tables name the lines.</figcaption>"
        f"<div class=panels>{shown}</div></figure>"
    )


def _panel(scene: Scene, look: Look, error: str, cost: str) -> str:
    """A picture that can be read on a phone, as a PNG of few colours."""
    written, smaller = io.BytesIO(), io.BytesIO()
    with plt.rc_context(STYLE):
        drawn, axis = plt.subplots(figsize=SIZE)
        panel(axis, scene.ran, look, error, cost, {scene.ours})
        drawn.savefig(written, format="png", dpi=DPI)
        plt.close(drawn)
    with Image.open(written) as image:
        image.convert("RGB").quantize(COLOURS).save(smaller, "png", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode()


def _study(name: str, results: Path) -> str:
    """The tables of a study of scenes, where it was run."""
    found = committed(name, results)
    if found is None:
        return ""
    shown = (to_html(grid, {}) for grid in _registry.studies()[name].tables(found))
    return f"<h2>{name.capitalize()}</h2>" + "".join(shown)
