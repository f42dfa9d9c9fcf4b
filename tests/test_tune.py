"""The best of a grid: it is found, it is inside, and starts that are scored are not looked at."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import _black_boxes, _registry
from benchmarks._levels import LEVELS, Race
from benchmarks._task import Budget, Method, NotAble, Problem, Score, Task
from benchmarks._tune import SEEDS, search, tune


def away(best: dict):
    """A cost that is lowest at the best settings, by the logarithm."""
    return lambda found: sum(abs(np.log2(found[name] / best[name])) for name in best) + 1


def test_the_best_is_found_far_beyond_the_grid_and_is_inside():
    best = {"rate": 6.4, "width": 0.125, "pairs": 8}
    grid = {"rate": (0.1, 0.2, 0.4), "width": (0.5, 1.0, 2.0), "pairs": (1, 2, 4)}
    found = search(away(best), grid)
    assert found.settings == pytest.approx(best)
    assert found.at_the_edge == []
    assert min(found.tried, key=lambda each: each["cost"])["cost"] == pytest.approx(1)


def test_a_winner_at_an_end_is_said_to_be():
    found = search(lambda at: 1 / at["rate"], {"rate": (0.1, 0.2, 0.4)})
    assert found.at_the_edge == ["rate"]
    assert found.settings["rate"] > 20


def test_whole_numbers_end_at_one():
    found = search(lambda at: at["pairs"], {"pairs": (2, 4)})
    assert found.settings == {"pairs": 1}
    assert found.at_the_edge == []


def test_settings_that_depend_on_each_other_take_several_turns():
    cost = lambda at: (np.log2(at["a"] * at["b"])) ** 2 + np.log2(at["a"] / 4) ** 2 / 4
    found = search(cost, {"a": (0.5, 1.0, 2.0), "b": (0.5, 1.0, 2.0)})
    assert found.settings["a"] * found.settings["b"] == 1


def test_nothing_is_tried_twice_and_no_grid_is_a_grid():
    tried = []

    def cost(at):
        tried.append(tuple(at.values()))
        return 1.0

    search(cost, {"a": (1.0, 2.0, 4.0), "b": (1, 2)})
    assert len(tried) == len(set(tried))
    assert search(lambda at: 1.0, {}).settings == {}


def line(budget: int = 200) -> Task:
    """Ten units down a line, which `walk` goes by steps of its rate."""
    ends = np.full(1, -100, np.float32), np.full(1, 100, np.float32)
    problem = Problem(ends, 1.0, Budget(budget, 60), lambda y: jnp.abs(y[0]))
    return Task("line", "Line", problem, Score(np.zeros(1)), lambda seed: jnp.full(1, 10.0), 5)


def walk(problem, *, rate=1.0):
    def solve(y0, key, record):
        y = y0
        while True:
            value = problem.loss(y)
            y = jnp.maximum(y - rate, 0) + 0 * value
            record(y)

    return solve


WALK = Method("walk", "Walk", walk, "source")


def test_a_race_counts_evaluations_to_each_level_and_keeps_them(tmp_path):
    race = Race(line(), tmp_path)
    assert race(WALK, [0, 1], {"rate": 1.0}).tolist() == [[9, 10]] * 2
    fails: Any = lambda problem, rate: 1 / 0
    stopped = Method("walk", "Walk", fails, "source")
    assert race(stopped, [0, 1], {"rate": 1.0}).tolist() == [[9, 10]] * 2  # from their files
    assert np.isinf(Race(line(5), tmp_path / "short")(WALK, [0])).all()


def test_a_run_that_ends_by_itself_is_looked_at(tmp_path):
    def prepare(problem):
        def solve(y0, key, record):
            for share in (0.5, 0.05):
                problem.loss(y0)
                record(share * y0)

        return solve

    took = Race(line(), tmp_path)(Method("ends", "Ends", prepare, ""), [0])
    assert took.tolist() == [[2, np.inf]]
    assert len(LEVELS) == 2


def test_tuning_takes_other_starts_than_those_scored(tmp_path):
    found = tune(Race(line(), tmp_path), WALK, {"rate": (0.5, 1.0, 2.0)}, SEEDS[:1], turns=1)
    assert found.settings["rate"] > 5  # the longest steps are the best
    assert min(SEEDS) > 1000
    assert {path.stem.rpartition("-")[2] for path in tmp_path.glob("*.npz")} == {"10000"}


def test_what_is_fixed_stays(tmp_path):
    fast: Any = lambda problem, *, rate, times: walk(problem, rate=rate * times)
    method = Method("fast", "Fast", fast, "")
    race = Race(line(), tmp_path)
    found = tune(race, method, {"rate": (0.5, 1.0, 2.0)}, SEEDS[:1], 1, {"rate": 9.0, "times": 10})
    assert found.settings == {"rate": 1.0, "times": 10}


def test_a_task_can_be_run_with_the_best_beside_the_one_setting(tmp_path, monkeypatch):
    grids = {"walk": {"rate": (0.5, 1.0, 2.0)}}
    monkeypatch.setattr(_registry, "grid", lambda name: grids.get(name, {}))
    other = Method("other", "Other", walk, "")
    (best,) = _black_boxes._best(line(), [WALK, other], tmp_path)
    assert best.name == "walk-best"
    assert best.title.startswith("Walk, best of a grid: rate ")
    slow, fast = (Race(line(), tmp_path / "runs")(each, [0])[0, -1] for each in (WALK, best))
    assert fast < slow


def test_a_method_that_is_not_able_says_so(tmp_path):
    with pytest.raises(NotAble, match="residuals"):
        tune(Race(line(), tmp_path), _registry.method("least_squares"), {"step": (1.0, 2.0)})


def test_every_grid_names_settings_of_its_method():
    names = [name for name in _registry.methods() if _registry.grid(name)]
    assert {"fr22", "wang_hvpa", "cma_es", "spsa", "nelder_mead", "dfo_ls"} <= set(names)
    for name in names:
        for values in _registry.grid(name).values():
            assert list(values) == sorted(values)
            assert len(values) > 2
