"""The study of ZeroGrads: its numbers are what they say; it is shown, it runs, and it resumes."""

import dataclasses
import functools
from argparse import Namespace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from benchmarks import _registry, _study, _style
from benchmarks._grid import to_rich
from benchmarks._task import Budget, Problem, Score, Task, TaskEntry
from benchmarks.methods import zerograds as zerograds_method
from benchmarks.studies import zerograds
from benchmarks.studies.zerograds import (
    _equal,
    _runs,
    ablations,
    control_variate,
    gradients,
    replay,
    samples,
    toy,
)
from benchmarks.studies.zerograds._equal import SCHEDULES
from smoothdiff.surrogates import MLP


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def slope(full: bool = False) -> Task:
    """A linear function of two parameters, whose gradient is known and does not change."""
    problem = Problem(
        loss=lambda y: 3 * y[0] - 4 * y[1],
        bounds=(jnp.full(2, -50.0), jnp.full(2, 50.0)),
        sigma=0.5,
        budget=Budget(400, 100.0),
    )
    start = lambda seed: jnp.asarray([1.0, 1.0])
    score = Score(jnp.asarray([-50.0, 50.0]), optimum=-350.0)
    return Task("slope", "A slope", problem, score, start, seeds=1)


TASK = {"parameters": 3, "evaluations": [10, 20, 40]}


def errors_of(*rows, rate=0.15):
    return {"rate": rate, "tried": 4, "errors": np.array(rows)}


def test_errors_are_compared_where_ours_is_down_to_a_twentieth():
    found = {
        "ours": errors_of((0.5, 0.04, 0.02), (0.2, 0.03, 0.0)),
        "fr22": errors_of((0.8, 0.4, 0.2), (0.8, 0.4, 0.2), rate=0.45),
    }
    of = ablations.compare(found, TASK["evaluations"])
    assert (of["at"], of["reached"]) == (20, True)
    ours, fr22 = of["methods"]["ours"], of["methods"]["fr22"]
    assert (ours["ratio"], ours["ratio_at_end"]) == (1, 1)
    assert fr22["ratio"] == pytest.approx(0.4 / 0.035)
    assert fr22["ratio_at_end"] == pytest.approx(0.2 / 0.01)
    assert fr22["final"][1] == 0.2
    assert fr22["rate"] == 0.45
    assert ours["curve"][1] == pytest.approx([0.35, 0.035, 0.01])

    found = {"ours": errors_of((0.9, 0.8, 0.5)), "fr22": found["fr22"]}
    of = ablations.compare(found, TASK["evaluations"])
    assert (of["at"], of["reached"]) == (40, False)
    assert of["methods"]["fr22"]["ratio"] == pytest.approx(0.4)


def test_what_is_solved_counts_as_the_floor():
    found = {"ours": errors_of((0, 0, 0)), "fr22": errors_of((1, 1, 1))}
    of = ablations.compare(found, TASK["evaluations"])
    assert of["methods"]["fr22"]["ratio"] == pytest.approx(1 / _runs.FLOOR)


def run_of(errors, evaluations=(0, 10, 20, 40)):
    return {"evaluations": list(evaluations), "image_error": list(errors)}


def test_replay_is_read_where_the_error_is_down_to_a_tenth():
    runs = [run_of((1, 0.5, 0.1, 0.02)), run_of((1, 0.09, 0.05, 0.01)), run_of((1, 1, 1, 0.9))]
    found = replay.compare(runs, [10, 40])
    assert found["took"] == {"median": 20, "lower": 20, "upper": None}
    assert found["final"]["median"] == 0.02
    assert found["curves"][1] == pytest.approx([0.5, 0.02])


def test_all_parts_are_drawn_and_shown(monkeypatch, tmp_path):
    monkeypatch.setitem(_style.STYLE, "savefig.dpi", 20)
    runs = [run_of((1, 0.5, 0.1, 0.02))]
    row = {name: [[1, 0, 1, 1], [2, 3, 2, 2], [2, 4, 2, 2]] for name in gradients.ROWS}
    along, line = {"evaluations": [5, 15, 25, 35]}, row["cosine"]
    of_replay = {name: replay.compare(runs, TASK["evaluations"]) for name in replay.TITLES}
    each = errors_of((0.5, 0.1, 0.02))
    compared = ablations.compare({"ours": each, "fr22": each}, TASK["evaluations"])
    frame = {"share": 0.5, "y": 0.3, "loss": 0.4, "sigma": 0.1, "smoothed": 0.35}
    frame |= {"evaluations": 80, "samples": [0.2, 0.4], "surrogate": [0.5, 0.3, 0.1]}
    parts = {
        "toy": {"reference": 0.75, "frames": [frame, frame | {"share": 1}]},
        "ablations": {"tasks": {"led": TASK | {"schedules": dict.fromkeys(SCHEDULES, compared)}}},
        "gradients": {"tasks": {"led": along | dict.fromkeys(gradients.TITLES, row)}},
        "samples": {
            "tasks": {
                "led": {"evaluations": 40, "samples": [2, 4], "errors": [[0, 0.1, 0.2]] * 2},
                "wicker": {"evaluations": 40, "samples": [8], "errors": [[0.1, 0.1, 0.2]]},
            }
        },
        "replay": {"tasks": {"led": TASK | of_replay}},
        "control_variate": {
            "samples": 4,
            "repeats": 8,
            "tasks": {"led": along | dict.fromkeys(control_variate.BASELINES, line)},
        },
    }
    assert set(parts) == set(zerograds.PARTS)
    results = _study.rounded({name: {"starts": 2} | part for name, part in parts.items()})
    zerograds.draw(results, tmp_path)
    for name in parts:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    grids = list(zerograds.tables(results))
    shown = {grid.title.split(":")[0]: grid for grid in grids}
    assert len(grids) == len(parts) + len(SCHEDULES)
    for grid in shown.values():
        assert to_rich(grid).row_count == len(grid.rows) > 0
        assert all(len(row.cells) == len(grid.columns) - 1 for row in grid.rows)
    left = shown["Error that is left, in %, by the number of samples in a step"]
    assert [row.cells for row in left.rows] == [("40", "10", "10", ""), ("40", "", "", "10")]
    assert shown["Toy"].rows[0] == ("50%", ("80", "0.300", "0.400", "0.350"), None, False, False)


def test_the_parts_are_of_tasks_that_are_there():
    assert set(_runs.BUDGETS) <= set(_registry.tasks())
    named = {*samples.NUMBERS, *gradients.TASKS, *replay.TASKS, *control_variate.TASKS}
    assert named <= set(_runs.BUDGETS)
    for name, budget in _runs.BUDGETS.items():
        assert _runs.load(name).problem.budget.evaluations == budget
    task = _runs.load("wicker")
    assert _runs.about(task)["parameters"] == 3
    assert len(_runs.about(task)["evaluations"]) <= 40


def test_starts_of_every_part_are_what_was_asked_for(monkeypatch, tmp_path):
    part = SimpleNamespace(measure=lambda starts, folder, fresh: {"runs": (starts, fresh)})
    monkeypatch.setattr(zerograds, "PARTS", {"one": part, "other": part})
    for seeds, starts in ((3, 3), (None, zerograds.SEEDS)):
        found = zerograds.measure(
            Namespace(names=[], methods=None, seeds=seeds, fresh=True), tmp_path
        )
        each = {"starts": starts, "runs": (starts, True)}
        assert found == {"one": each, "other": each}


def test_ablations_are_ours_with_some_settings_changed():
    methods = ablations.methods()
    assert list(methods) == [*ablations.CHANGES, "fd", "fr22"]
    made = {
        name: make(slope().problem, optax.constant_schedule(0.5), optax.adam(0.1))
        for name, make in methods.items()
    }
    settings = ("inner_sigma", "surrogate", "surrogate_steps", "local", "num_samples", "replay")
    for name, changes in ablations.CHANGES.items():
        for setting in settings:
            usual = getattr(made["ours"], setting)
            assert getattr(made[name], setting) == changes.get(setting, usual), name
    assert {solver.evaluations_per_step(jnp.zeros(2)) for solver in made.values()} == {2, 4}
    assert {task for group in ablations.GROUPS.values() for task in group} == set(_runs.BUDGETS)


def hill(full: bool = False) -> Task:
    """A bowl in two parameters."""
    problem = Problem(
        loss=lambda y: jnp.sum(y**2),
        bounds=(jnp.full(2, -9.0), jnp.full(2, 9.0)),
        sigma=0.5,
        budget=Budget(40, 100.0),
    )
    start = lambda seed: jnp.asarray([4.0, 5.0]) + seed
    return Task("hill", "A hill", problem, Score(jnp.zeros(2), optimum=0.0), start, seeds=1)


def test_a_program_is_adam_whose_rate_and_sigma_follow_the_schedule(tmp_path):
    """Differences of a bowl have its slope, whatever sigma: Adam's own steps from there."""
    task, fd = hill(), ablations.methods()["fd"]
    program = _equal.Program(task, "fd", fd, tmp_path)
    points, steps = _runs.about(task)["evaluations"], 40 // 4
    for name, schedule in SCHEDULES.items():
        found = program(name, 0.3, [1])[0]
        rate = 0.3 * task.problem.sigma
        optim = optax.adam(optax.linear_schedule(rate, schedule.rate * rate, steps))
        y = task.start(1)
        state, errors = optim.init(y), {0: 1.0}
        for i in range(steps):
            updates, state = optim.update(2 * y, state, y)
            y = y + updates
            errors[i + 1] = float(task.problem.loss(y) / task.problem.loss(task.start(1)))
        np.testing.assert_allclose(found, [errors[at // 4] for at in points], rtol=1e-3)


def test_a_program_is_tuned_on_other_starts_and_kept(tmp_path):
    task, fr22 = hill(), ablations.methods()["fr22"]
    program = _equal.Program(task, "fr22", fr22, tmp_path)
    best = program.tuned("annealed")
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert {path.stem.split("-")[-2] for path in files} == {"1000"}
    for rate in (best.settings["rate"] / 3, best.settings["rate"] * 3):
        ends = program("annealed", rate, range(1000, 1002))[:, -1]
        assert np.exp(np.log(ends).mean()) >= best.cost * (1 - 1e-6)
    three, one = program("annealed", 0.45, [0, 1, 2]), program("annealed", 0.45, [2])
    np.testing.assert_allclose(three[2], one[0], rtol=1e-6)  # whoever is beside it
    again = _equal.Program(hill(), "fr22", fr22, tmp_path)
    assert again.tuned("annealed") == best
    assert all(path.stat().st_mtime_ns == when for path, when in files.items())


def test_the_published_network_has_an_activated_output(key):
    network, u = ablations.Published(2, key=key), jnp.ones(2)
    raw = network.network(u)
    assert network(u) == pytest.approx(float(jnp.where(raw > 0, raw, 0.01 * raw)))


def test_parts_are_chosen_by_name(tmp_path, monkeypatch):
    part = SimpleNamespace(measure=lambda starts, folder, fresh: {"runs": starts})
    monkeypatch.setattr(zerograds, "PARTS", {"one": part, "other": part})
    options = Namespace(names=["other"], methods=None, seeds=3, fresh=False)
    assert zerograds.measure(options, tmp_path) == {"other": {"starts": 3, "runs": 3}}
    with pytest.raises(SystemExit, match="choose from one, other"):
        zerograds.measure(Namespace(**vars(options) | {"names": ["none"]}), tmp_path)


def test_signs_are_directions_of_unit_variance(key):
    z, log_ratio = gradients.Signs(antithetic=True).draw(key, 0, 400, 400, 3, jnp.float32)
    assert log_ratio is None
    assert set(np.unique(z)) == {-1.0, 1.0}
    assert np.array_equal(z[0::2], -z[1::2])
    assert np.all(np.abs(z[0::2].mean(0)) < 4 / 200**0.5)


def test_kept_gradient_changes_nothing():
    grad = jnp.asarray([1.0, -2.0])
    keep = gradients.kept_gradient()
    updates, state = keep.update(grad, keep.init(jnp.zeros(2)))
    assert updates is state is grad


@pytest.mark.slow
def test_true_gradients_by_values_and_terms_agree(monkeypatch, key):
    monkeypatch.setattr(gradients, "BATCH", None)
    problem = slope().problem
    by_terms = dataclasses.replace(
        problem, terms=lambda y: y * jnp.asarray([3.0, -4.0]), support=lambda y: y
    )
    for each in (problem, by_terms):
        truth = gradients._true_gradient(each)(key, jnp.ones(2), jnp.asarray(0.5))
        assert np.asarray(truth) == pytest.approx([3, -4], abs=0.3)


def test_the_toy_is_smoothed():
    y = np.array([0.3, 0.75])
    draws = np.random.default_rng(0).normal(size=200_000)
    for at, smooth in zip(y, toy.smoothed(y, 0.1), strict=True):
        values = toy.loss(np.clip(at + 0.1 * draws, 0, 1))
        assert abs(values.mean() - smooth) < 4 * values.std() / len(draws) ** 0.5 + 1e-3


@pytest.mark.slow
def test_the_toy_is_solved(tmp_path):
    frames = toy.measure(1, tmp_path, False)["frames"]
    assert [frame["evaluations"] for frame in frames] == [0, 80, 280, 800]
    assert frames[-1]["loss"] == 0
    assert frames[1]["surrogate"][0] > frames[1]["surrogate"][-1]  # it leads towards the reference


@pytest.mark.slow
@pytest.mark.parametrize("name", gradients.TITLES)
def test_on_a_slope_gradients_point_the_right_way(name):
    found = gradients.following(name, slope())(0)
    assert {len(values) for values in found.values()} == {gradients.WINDOWS}
    if name == "ours":  # it has learnt the slope
        assert np.median(found["cosine"]) > 0.97
    else:  # a random diagonal
        assert 0 < np.mean(found["cosine"]) < 0.97
    if name == "fr22":  # as many long and short ones as (g.z) |z| of normal z
        z = np.random.default_rng(0).normal(size=(10**5, 2))
        lengths = np.abs(z @ [3, -4]) * np.linalg.norm(z, axis=1)
        assert np.median(found["variance"]) == pytest.approx(lengths.var(), rel=0.7)


@pytest.fixture
def of_slope(monkeypatch):
    """Makes the slope the only task of all parts, for so many evaluations."""

    def only(evaluations):
        monkeypatch.setattr(_registry, "task", lambda name: TaskEntry("A slope", "program", slope))
        for name in list(_runs.BUDGETS):
            monkeypatch.delitem(_runs.BUDGETS, name)
        monkeypatch.setitem(_runs.BUDGETS, "slope", evaluations)
        for part in (gradients, replay, control_variate):
            monkeypatch.setattr(part, "TASKS", ("slope",))

    return only


@pytest.mark.slow
def test_the_control_variate_is_what_the_run_has_learnt(monkeypatch, of_slope, tmp_path):
    # a gp knows a slope from its samples; without one, all variance is what the surrogate leaves
    of_slope(400)
    monkeypatch.setattr(control_variate, "REPEATS", 20)
    monkeypatch.setattr(zerograds_method, "OF_FEW", zerograds_method.OF_MANY)  # sigma stays
    ratios = control_variate.measure(1, tmp_path, False)["tasks"]["slope"]
    assert len(ratios["mean"][1]) == len(ratios["gp"][1]) == len(control_variate.SHARES)
    assert ratios["mean"][1][-1] > 10
    assert ratios["mean"][1][-1] > ratios["mean"][1][0]


@pytest.mark.slow
def test_it_runs_and_resumes(monkeypatch, of_slope, tmp_path):
    of_slope(40)
    small = {"surrogate": functools.partial(MLP, width=8, depth=1), "surrogate_steps": 1}
    monkeypatch.setattr(sd, "ZeroGrads", functools.partial(sd.ZeroGrads, **small))
    parts = {"ablations": ablations, "gradients": gradients, "samples": samples, "replay": replay}
    monkeypatch.setattr(zerograds, "PARTS", parts)
    fr22 = {"fr22": ablations.methods()["fr22"]}
    monkeypatch.setattr(ablations, "methods", lambda: {"ours": fr22["fr22"]})
    monkeypatch.setattr(gradients, "TITLES", {"fr22": "FR22"})
    monkeypatch.setattr(samples, "NUMBERS", {"slope": (4,)})
    monkeypatch.setattr(replay, "TITLES", {"0": "none"})
    _study.run(
        zerograds, Namespace(said="a test", names=[], methods=None, seeds=1, fresh=False), tmp_path
    )
    assert {path.stem for path in tmp_path.glob("*.png")} == set(parts)

    files = lambda: {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    kept = files()
    assert len(kept) >= 4  # one of each part, and those that rates are chosen by
    first = {part: part.measure(1, tmp_path / "runs", False) for part in (samples, gradients)}
    assert files() == kept
    assert gradients.measure(1, tmp_path / "runs", True) == first[gradients]
    assert {path.name for path in kept if files()[path] != kept[path]} == {"gradient-fr22-0.npz"}
