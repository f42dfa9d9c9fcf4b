"""The study of cheap renders: what it counts, draws and prints, on bars that are drawn in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_costs import shown

import smoothdiff as sd
from benchmarks._task import Budget, Problem, Score, Task
from benchmarks.studies import fidelity

MIDDLE = 0.7


def bar(pixels: int, count: list[int]) -> sd.Level:
    """A bar of which the middle is sought; `count` has one entry for each picture."""
    x = (np.arange(pixels) + 0.5) / pixels
    drawn = lambda middle: (np.abs(x - middle) < 0.1).astype(np.float32)

    def picture(y):
        count.append(pixels)
        return drawn(np.asarray(y)) - drawn(MIDDLE)

    black = sd.black_box(picture, jax.ShapeDtypeStruct((pixels,), jnp.float32))
    return sd.Level(lambda y, args: black(y), pixels)


@pytest.fixture
def bars():
    """The study of a task, and a list of the pictures of each of its levels."""
    counts: list[list[int]] = [[], [], []]
    coarse, fine = bar(32, counts[0]), bar(512, counts[1])
    chosen = bar(64, counts[2])
    problem = Problem(
        bounds=(jnp.float32(0), jnp.float32(1)),
        sigma=0.2,
        budget=Budget(100, 60),
        loss=lambda y: (y - MIDDLE) ** 2,
        residuals=lambda y: chosen.fun(y, None),
    )
    start = lambda seed: jnp.float32(0.45 + 0.01 * seed)
    levels = lambda pixels, samples: [coarse, fine]
    task = Task("bar", "A bar", problem, Score(jnp.float32(MIDDLE)), start, 2, fidelities=levels)
    made = fidelity.Fidelities(task, 512, 1)
    for count in counts:
        count.clear()
    return made, counts


@pytest.mark.slow
def test_seconds_are_those_of_the_pictures_until_then(bars):
    made, counts = bars
    made.times = {id(level): float(level.cost) for level in (*made.levels, made.chosen)}
    seconds = {}
    for way in fidelity.WAYS:
        before = [len(count) for count in counts]
        run = made.run(way, 0)
        coarse, fine, chosen = (len(count) - b for count, b in zip(counts, before, strict=True))
        most = {"full": 512 * fine, "levels": 32 * coarse + 512 * fine, "chosen": chosen}[way]
        assert 0 < run["seconds"] <= most
        assert 0 < run["call"] < np.inf
        assert run["left"] <= fidelity.DONE
        assert (coarse > 0) == (way == "levels")
        assert len(run["milliseconds"]) == (2 if way == "levels" else 1)
        seconds[way] = run["seconds"]
    assert seconds["levels"] < seconds["full"]


def test_results_are_drawn_and_printed(tmp_path, capsys):
    three = lambda value: {"lower": value, "median": value, "upper": value}
    line = lambda s, solved=2: {
        "seconds": three(s),
        "call": three(s),
        "left": three(0.001),
        "solved": solved,
    }
    scene = {"title": "A mug", "starts": 2, "full": line(20.0)}
    scene |= {"levels": line(2.0), "chosen": line(1.0)}
    lost = scene | {"levels": line(None, 1)}
    found = {"pixels": 256, "samples": 64, "scenes": {"mug": scene, "bunny": lost}}
    means = fidelity.means(found)
    assert means == {"full over levels": pytest.approx(10), "levels over chosen": pytest.approx(2)}
    text = shown(fidelity, found, tmp_path, capsys)
    assert "full over levels: 10" in text
    assert "(1)" in text
    assert "mug" in text
