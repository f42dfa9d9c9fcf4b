"""The harness of the benchmarks: it counts, stops, scores, keeps and resumes; on a tiny task.

This module is itself the task and one of the methods that the command line is given.
"""

import dataclasses
import json
import math
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from benchmarks import __main__ as cli
from benchmarks import _harness, methods, overhead, tasks
from benchmarks._summary import cost_to_level
from benchmarks._task import Budget, Method, NotAble, Task
from benchmarks.tasks.boxes import BOX10_START

TITLE = "A bowl"
HIGH = jnp.asarray(2.0)


def build(full):
    def loss(y):
        return y["a"] ** 2 + jnp.sum(y["b"] ** 2)

    def start(seed):
        y = jax.random.uniform(jax.random.key(seed), (3,), minval=0.5, maxval=1.0)
        return {"a": y[0], "b": y[1:]}

    return Task(
        name="bowl",
        title=TITLE,
        loss=loss,
        exact_loss=loss,
        start=start,
        reference={"a": jnp.zeros(()), "b": jnp.zeros(2)},
        bounds=({"a": -HIGH, "b": -HIGH}, {"a": HIGH, "b": HIGH}),
        sigma=0.5,
        budget=Budget(evaluations=400 if full else 200, seconds=60),
        seeds=2,
        image=lambda y: jnp.full((2, 2, 3), y["a"]),
    )


def prepare(task):
    """Halves y at each iteration, for five evaluations."""

    @jax.jit
    def halve(y):
        many = jax.vmap(lambda s: task.loss(jax.tree.map(lambda leaf: s * leaf, y)))
        used = many(jnp.arange(5.0)) * 0
        return jax.tree.map(lambda leaf: 0.5 * leaf + used.sum(), y)

    def solve(y0, key, record):
        y = y0
        for _ in range(10):
            y = halve(y)
            record(y)

    return solve


HALVING = Method("halving", "Halving", prepare, "1")


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture
def bowl():
    return build(full=False)


def harness(task, method, folder, fresh=False) -> list[_harness.Run]:
    found = _harness.run(task, [method], 2, folder, setting="quick", fresh=fresh, progress=False)
    runs = found[method]
    assert isinstance(runs, list), runs
    return runs


def test_counts_every_evaluation_under_jit_vmap_and_scan(bowl):
    counter = _harness.Counter()
    loss = counter.watch(bowl.loss)
    y = bowl.start(0)
    assert jax.jit(loss)(y) == bowl.loss(y)
    assert counter.evaluations == 1
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 7), y)
    jax.jit(jax.vmap(loss))(many).block_until_ready()
    assert counter.evaluations == 8
    jax.block_until_ready(jax.lax.scan(lambda total, y: (total + loss(y), None), 0.0, many))
    assert counter.evaluations == 15


def test_residuals_are_counted_once_for_each_y(bowl):
    task = dataclasses.replace(bowl, residuals=lambda y: y["b"])
    counter = _harness.Counter()
    residuals = _harness._watched(task, counter).residuals
    assert residuals is not None
    y = bowl.start(0)
    assert np.array_equal(jax.jit(residuals)(y), y["b"])
    assert counter.evaluations == 1
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 7), y)
    jax.jit(jax.vmap(residuals))(many).block_until_ready()
    assert counter.evaluations == 8


def test_a_known_optimum_is_scored_by_the_gap_in_the_precision_of_the_task(tmp_path):
    seeds = []
    with jax.enable_x64(True):
        bowl = build(full=False)

    def loss(y):
        assert y["a"].dtype == "float64"
        return bowl.loss(y) - 3

    def choose(seed):
        seeds.append(seed)
        return jax.tree.map(lambda leaf: leaf + seed, bowl.reference)

    task = dataclasses.replace(
        bowl, loss=loss, exact_loss=loss, precision="float64", optimum=-3.0, choose=choose
    )
    first, second = harness(task, HALVING, tmp_path)
    for run in (first, second):
        assert run["gap"] == pytest.approx([run["gap"][0] * 0.25**i for i in range(11)])
        assert run["image_error"] == pytest.approx([0.25**i for i in range(11)])
    assert first["distance"] < 0.01
    assert second["distance"] == pytest.approx(3**0.5, rel=0.01)
    assert seeds == [0, _harness.WARM_UP_SEED, 0, 0, 1, 1]
    assert jnp.zeros(()).dtype == "float32"


def test_traces_are_relative_to_the_start_and_counted(bowl, tmp_path):
    for seed, run in enumerate(harness(bowl, HALVING, tmp_path)):
        assert run["seed"] == seed
        assert run["evaluations"] == list(range(0, 55, 5))
        assert run["parameter_error"] == pytest.approx([0.5**i for i in range(11)])
        assert run["image_error"] == pytest.approx([0.25**i for i in range(11)])
        assert run["ended"] == "by the method"
        assert run["seconds"] == sorted(run["seconds"])


def test_the_budget_ends_a_run(bowl, tmp_path):
    short = dataclasses.replace(bowl, budget=Budget(evaluations=12, seconds=60))
    for run in harness(short, HALVING, tmp_path):
        assert run["evaluations"] == [0, 5, 10, 15]
        assert run["ended"] == "by the budget"


def test_a_run_ends_at_the_optimum(bowl, tmp_path):
    lowest = float(bowl.loss(bowl.reference))
    scaled = lambda y: 1e-6 * (bowl.loss(y) - lowest)
    task = dataclasses.replace(bowl, loss=scaled, exact_loss=scaled, optimum=0.0)
    for run in harness(task, HALVING, tmp_path):
        assert run["gap"][-1] <= 1e-8 < run["gap"][-2]
        assert run["ended"] == "at the optimum"
        assert run["evaluations"][-1] == 5 * (len(run["gap"]) - 1) < 50


def test_long_traces_are_thinned_and_keep_their_end(bowl):
    counter = _harness.Counter()
    recorder = _harness.Recorder(counter, Budget(10**6, 60), bowl.start(0))
    for counter.evaluations in range(1, 5001):
        recorder(bowl.reference)
    trace = recorder.finish()
    assert len(trace) < 80
    assert trace[-1][0] == 5000


def test_finished_runs_are_kept_until_something_changes(bowl, tmp_path):
    first = harness(bowl, HALVING, tmp_path)
    assert harness(bowl, HALVING, tmp_path) == first
    assert harness(bowl, HALVING, tmp_path, fresh=True) != first  # seconds differ
    again = harness(bowl, HALVING, tmp_path)
    assert harness(bowl, HALVING._replace(source="2"), tmp_path) != again

    (tmp_path / "halving-1-quick.json").unlink()  # as after an interruption
    resumed = harness(bowl, HALVING._replace(source="2"), tmp_path)
    assert [run["evaluations"] for run in resumed] == [run["evaluations"] for run in again]


def test_a_method_that_is_not_able_is_named_not_raised(bowl, tmp_path):
    native = methods.load("mitsuba_ad")
    found = _harness.run(bowl, [native], 2, tmp_path, setting="quick")[native]
    assert isinstance(found, NotAble)
    assert "no derivative" in str(found)


def test_a_gradient_of_the_renderer_costs_two(bowl, tmp_path):
    task = dataclasses.replace(bowl, native_ad=lambda: jax.value_and_grad(bowl.loss))
    (run, _) = harness(task, methods.load("mitsuba_ad"), tmp_path)
    assert run["evaluations"][1] == 2
    assert run["image_error"][-1] < 1e-2


@pytest.mark.parametrize(
    ("name", "per_step"), [("finite_differences", 6), ("fr22", 2), ("cma_es", 7)]
)
def test_methods_descend_and_are_charged_what_they_use(name, per_step, bowl, tmp_path):
    for run in harness(bowl, methods.load(name), tmp_path):
        assert run["evaluations"][1] == per_step
        assert run["evaluations"][-1] >= 200
        assert run["image_error"][-1] < 0.1


def test_an_interruption_ends_the_benchmark_and_not_only_the_run(bowl):
    def record(y):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        methods.load("fr22").prepare(bowl)(bowl.start(0), jax.random.key(0), record)


def test_levels_not_reached_cost_infinity():
    assert cost_to_level([1, 0.2, 0.05, 0.3], [0, 5, 9, 12], 0.1) == 9
    assert cost_to_level([1, 0.2], [0, 5], 0.1) == math.inf


def test_the_command_line_writes_results_pictures_and_table(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(tasks.TASKS, "bowl", __name__)
    monkeypatch.setitem(methods.METHODS, "halving", __name__)
    monkeypatch.setenv("COLUMNS", "150")
    cli.main(["run", "bowl", "--methods", "halving,mitsuba_ad", "--full"], tmp_path)
    printed = capsys.readouterr().out
    assert "not able here" in printed

    folder = tmp_path / "bowl"
    results = json.loads((folder / "results.json").read_text())
    assert results["setting"] == "full"
    assert results["command"].startswith("python -m benchmarks run bowl")
    assert "not_able" in results["methods"]["mitsuba_ad"]
    levels = results["methods"]["halving"]
    assert levels["parameter_error"]["levels"]["99"]["evaluations"] == {
        "median": 35,
        "lower": 35,
        "upper": 35,
    }
    assert levels["parameter_error"]["levels"]["99"]["solved"] == 2
    for picture in ("error-vs-time.png", "error-vs-evaluations.png", "images.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")


def test_a_family_shares_a_table_and_a_picture(monkeypatch, tmp_path, capsys):
    def members(full):
        return [dataclasses.replace(build(full), name=f"bowl-{n}d", optimum=0.0) for n in (2, 5)]

    family = types.SimpleNamespace(TITLE="Bowls", build=members)
    monkeypatch.setattr(tasks, "module", lambda name: family)
    monkeypatch.setitem(tasks.TASKS, "bowls", "")
    monkeypatch.setitem(methods.METHODS, "halving", __name__)
    monkeypatch.setenv("COLUMNS", "150")
    cli.main(["run", "bowls", "--methods", "halving,mitsuba_ad"], tmp_path)
    printed = capsys.readouterr().out
    assert "bowl-5d" in printed
    assert "- (0/2)" in printed  # to 1e-8

    results = json.loads((tmp_path / "bowls" / "results.json").read_text())
    found = results["tasks"]["bowl-2d"]["methods"]
    assert "not_able" in found["mitsuba_ad"]
    assert "runs" not in found["halving"]
    assert found["halving"]["gap"]["levels"]["1e-3"]["solved"] == 2
    for picture in ("evaluations.png", "bowl-2d/error-vs-time.png"):
        assert (tmp_path / "bowls" / picture).read_bytes().startswith(b"\x89PNG")


def test_the_command_line_names_what_there_is(capsys):
    cli.main(["list"])
    printed = capsys.readouterr().out
    assert "cma_es" in printed
    with pytest.raises(SystemExit):
        cli.main(["run", "no-such-task"])
    with pytest.raises(ValueError, match="no method 'x'"):
        methods.load("x")
    assert np.all([name in printed for name in methods.METHODS])


def test_overhead_is_measured_and_drawn(tmp_path, capsys):
    overhead.main(tmp_path, pairs=2)
    assert "smooth_hessian" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())
    for found in results["transforms"].values():
        assert 0 < found["ratio"][0] <= found["ratio"][1] <= found["ratio"][2]
    assert (tmp_path / "overhead.png").exists()


def test_overhead_compares_at_the_same_points():
    seen = []

    def loss(y):
        jax.debug.callback(lambda y: seen.append(np.asarray(y)), y)
        return jnp.sum(y)

    y = jnp.asarray(BOX10_START)
    key = jax.random.key(0)
    transform = sd.smooth_grad(loss, 0.1, num_samples=4, sampler=overhead.SAMPLER)
    jax.block_until_ready(transform(key, y))
    jax.effects_barrier()
    z, _ = overhead.SAMPLER.draw(key, 0, 4, 4, y.size, y.dtype)
    drawn, used = np.asarray(y) + 0.1 * np.asarray(z), np.stack(seen)
    assert used[used[:, 0].argsort()] == pytest.approx(drawn[drawn[:, 0].argsort()])
