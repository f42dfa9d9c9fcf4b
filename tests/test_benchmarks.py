"""The loop, the registry and the command line of the benchmarks, on tiny tasks."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from stripes import REFERENCE, build, halving, registered

from benchmarks import __main__ as cli
from benchmarks import _loop, _registry, _study, _style
from benchmarks._cache import cached
from benchmarks._summary import cost_to_level, quartiles
from benchmarks._task import Budget, Method, NotAble, Problem, Score, Task
from benchmarks._timing import in_turns


def bowl_loss(y):
    return y["a"] ** 2 + jnp.sum(y["b"] ** 2)


def bowl_start(seed):
    y = jax.random.uniform(jax.random.key(seed), (3,), minval=0.5, maxval=1.0)
    return {"a": y[0], "b": y[1:]}


def like(value, dtype: type = np.float32):
    return {"a": np.full((), value, dtype), "b": np.full(2, value, dtype)}


BOWL = Task(
    name="bowl",
    title="A bowl",
    problem=Problem(
        loss=bowl_loss,
        bounds=(like(-2), like(2)),
        sigma=0.5,
        budget=Budget(evaluations=200, seconds=60),
    ),
    score=Score(like(0)),
    start=bowl_start,
    seeds=2,
)


def prepare(problem):
    """Halves y at each iteration, for five evaluations."""

    @jax.jit
    def halve(y):
        many = jax.vmap(lambda s: problem.loss(jax.tree.map(lambda leaf: s * leaf, y)))
        used = many(jnp.arange(5, dtype=y["a"].dtype)) * 0
        return jax.tree.map(lambda leaf: 0.5 * leaf + used.sum(), y)

    def solve(y0, key, record):
        y = y0
        for _ in range(10):
            y = halve(y)
            record(y)

    return solve


HALVING = Method("halving", "Halving", prepare, "1")


def changed(task, score=None, **problem):
    return dataclasses.replace(
        task, problem=dataclasses.replace(task.problem, **problem), score=score or task.score
    )


def runs_of(task, method, folder, fresh=False):
    found = _loop.run(task, [method], range(2), folder, fresh=fresh, progress=False)[method]
    assert isinstance(found, list), found
    return found


def test_counts_every_evaluation_under_jit_vmap_and_scan():
    counter = _loop.Counter()
    seen = counter.watched(changed(BOWL, residuals=lambda y: y["b"]).problem)
    assert seen.residuals is not None
    y = bowl_start(0)
    assert jax.jit(seen.loss)(y) == bowl_loss(y)
    assert counter.evaluations == 1
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 7), y)
    jax.jit(jax.vmap(seen.residuals))(many).block_until_ready()
    assert counter.evaluations == 8  # once for each y, whatever the size of the value
    jax.block_until_ready(jax.lax.scan(lambda total, y: (total + seen.loss(y), None), 0.0, many))
    assert counter.evaluations == 15


def test_the_loss_follows_from_the_residuals():
    problem = changed(BOWL, loss=None, residuals=lambda y: y["b"]).problem
    assert problem.loss({"b": jnp.asarray([1.0, 3.0])}) == 5


def test_traces_are_relative_to_the_start_counted_and_kept(tmp_path):
    first = runs_of(BOWL, HALVING, tmp_path)
    for seed, run in enumerate(first):
        assert (run["seed"], run["ended"]) == (seed, "by the method")
        assert run["evaluations"].tolist() == list(range(0, 55, 5))
        assert run["parameter_error"] == pytest.approx([0.5**i for i in range(11)])
        assert run["image_error"] == pytest.approx([0.25**i for i in range(11)])
        assert np.all(np.diff(run["seconds"]) > 0)
    again = runs_of(BOWL, HALVING, tmp_path)
    assert np.array_equal(again[0]["seconds"], first[0]["seconds"])
    fresh = runs_of(BOWL, HALVING, tmp_path, fresh=True)
    assert not np.array_equal(fresh[0]["seconds"], first[0]["seconds"])
    changed_source = HALVING._replace(source="2")
    other = runs_of(BOWL, changed_source, tmp_path)
    assert not np.array_equal(other[0]["seconds"], fresh[0]["seconds"])
    (tmp_path / "halving-1-quick.npz").unlink()  # as after an interruption
    resumed = runs_of(BOWL, changed_source, tmp_path)
    assert np.array_equal(resumed[0]["seconds"], other[0]["seconds"])
    assert np.array_equal(resumed[1]["evaluations"], other[1]["evaluations"])


def test_a_run_ends_with_its_budget_or_at_the_optimum(tmp_path):
    for run in runs_of(changed(BOWL, budget=Budget(12, 60)), HALVING, tmp_path):
        assert run["evaluations"].tolist() == [0, 5, 10, 15]
        assert run["ended"] == "by the budget"
    score = dataclasses.replace(BOWL.score, optimum=0.0)
    small = changed(BOWL, score, loss=lambda y: 1e-6 * bowl_loss(y))
    for run in runs_of(small, HALVING, tmp_path):
        assert run["gap"][-1] <= 1e-8 < run["gap"][-2]
        assert run["ended"] == "at the optimum"
        assert run["evaluations"][-1] == 5 * (len(run["gap"]) - 1) < 50


def test_a_known_optimum_is_scored_by_the_gap_in_the_precision_of_the_task(tmp_path):
    seeds = []

    def loss(y):
        assert y["a"].dtype == "float64"
        return bowl_loss(y) - 3

    def choose(seed):
        seeds.append(seed)
        return like(seed, float)

    task = dataclasses.replace(
        changed(
            BOWL,
            Score(like(0, float), optimum=-3.0),
            loss=loss,
            bounds=(like(-2, float), like(2, float)),
        ),
        precision="float64",
        choose=choose,
        start=lambda seed: jax.tree.map(lambda leaf: leaf.astype(float), bowl_start(seed)),
    )
    first, second = runs_of(task, HALVING, tmp_path)
    for run in (first, second):
        assert run["gap"] == pytest.approx([run["gap"][0] * 0.25**i for i in range(11)])
    assert first["distance"] < 0.01
    assert second["distance"] == pytest.approx(3**0.5, rel=0.01)
    assert seeds == [0, _loop.WARM_UP_SEED, 0, 0, 1, 1]
    assert jnp.zeros(()).dtype == "float32"


def test_errors_of_a_tasks_own_and_iterations_that_a_method_counts(tmp_path):
    def descend(problem):
        def solve(y0, key, record):
            for i in (1, 3, 10):
                record({"a": y0["a"] * 0 + i, "b": y0["b"]}, i)

        return solve

    score = Score(errors=lambda y, scene: {"height": y["a"], "lost": jnp.sqrt(-y["a"])})
    task = changed(BOWL, score)
    method = Method("descend", "", descend, "1")
    found = _loop.run(task, [method], [0], tmp_path, progress=False, keep=(3,))[method]
    assert isinstance(found, list)
    (run,) = found
    assert run["evaluations"].tolist() == [0, 1, 3, 10]
    assert run["height"].tolist()[1:] == [1, 3, 10]
    assert np.all(np.isinf(run["lost"]))
    assert run["found 3"][0] == 3


def test_what_is_compiled_late_is_not_charged(tmp_path):
    def prepare(problem):
        loss = jax.jit(problem.loss)

        def solve(y0, key, record):
            for step in range(20):
                if step == 10 and not late:
                    late.append(time.process_time())
                    while time.process_time() < late[0] + 0.5:
                        pass  # it compiles
                loss(y0).block_until_ready()
                record(y0)

        return solve

    late = []
    run, _ = runs_of(BOWL, HALVING._replace(prepare=prepare), tmp_path)
    assert late
    assert run["seconds"][-1] < 0.5


def test_long_traces_are_thinned_and_keep_their_end():
    counter = _loop.Counter()
    recorder = _loop.Recorder(counter, bowl_start(0), Budget(10**6, 60))
    for counter.evaluations in range(1, 5001):
        recorder(BOWL.score.reference)
    trace = recorder.finish()
    assert len(trace) < 80
    assert trace[-1][0] == 5000


def test_what_is_kept_is_whole_or_not_there(tmp_path):
    path = tmp_path / "a.npz"
    made = cached(path, "1", lambda: {"x": np.arange(3), "said": {"a": [1, None]}})
    found = cached(path, "1", lambda: {})
    assert found["said"] == made["said"]
    assert np.array_equal(found["x"], made["x"])
    assert cached(path, "2", lambda: {"other": 1}) == {"other": 1}
    with pytest.raises(TypeError):
        cached(path, "3", lambda: {"x": object()})
    assert cached(path, "2", lambda: {}) == {"other": 1}


def test_levels_not_reached_cost_infinity():
    assert cost_to_level([1, 0.2, 0.05, 0.3], [0, 5, 9, 12], 0.1) == 9
    assert cost_to_level([1, 0.2], [0, 5], 0.1) == math.inf
    assert quartiles([1, math.inf]) == {"median": None, "lower": None, "upper": None}


def test_calls_are_timed_in_turns():
    seen = []
    calls = {name: lambda turn, name=name: seen.append((turn, name)) for name in "ab"}
    seconds = in_turns(calls, 2)
    assert {name: len(each) for name, each in seconds.items()} == {"a": 2, "b": 2}
    assert seen == [(0, "a"), (0, "b"), (1, "b"), (1, "a"), (2, "a"), (2, "b")]


def test_the_registry_finds_what_the_readme_names(capsys):
    assert {"shadow", "brdf", "cnn5"} <= set(_registry.scenes())
    assert {"variance", "overhead", "report"} <= set(_registry.studies())
    cli.main([])
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*_registry.tasks(), *_registry.methods()))
    with pytest.raises(SystemExit):
        cli.main(["run", "no-such-task"])
    with pytest.raises(SystemExit, match="There is no method 'x'; choose"):
        _registry.method("x")


def test_another_text_of_a_module_that_a_method_imports_makes_its_runs_stale():
    source = _registry.method("gauss_newton").source
    assert "def run_by" in source


def test_every_task_has_methods_that_run_unasked():
    for name, entry in _registry.tasks().items():
        assert entry.kind == "descent" or "gauss_newton" in "".join(
            _registry.methods(entry.kind)
        ), name


def test_the_command_line_writes_results_pictures_and_tables(monkeypatch, tmp_path, capsys):
    registered(monkeypatch)
    monkeypatch.setattr(_study, "COMMITTED", tmp_path / "committed")
    cli.main(["run", "stripes", "--methods", "halving"], tmp_path / "committed")
    capsys.readouterr()

    def lacking(problem):
        raise NotAble("it lacks light")

    registered(monkeypatch, methods={"halving": halving, "lacking": lacking})
    cli.main(["run", "stripes", "--full", "--compare"], tmp_path)
    printed = capsys.readouterr().out
    assert "Lacking is not able here: it lacks light." in printed
    assert "here and committed" in printed
    results = json.loads((tmp_path / "stripes" / "results.json").read_text())
    assert results["setting"] == "full"
    assert results["command"].startswith("python -m benchmarks run stripes")
    found = results["tasks"]["stripes"]["methods"]
    assert "not_able" in found["lacking"]
    took = found["halving"]["took"]["parameter_error"]["99"]
    assert took["evaluations"] == dict.fromkeys(("median", "lower", "upper", "least", "most"), 7)
    assert took["solved"] == 2
    pictures = ("error-vs-time.png", "error-vs-evaluations.png", "images.png")
    for picture in pictures:
        assert (tmp_path / "stripes" / picture).read_bytes().startswith(b"\x89PNG")
    cli.main(["draw", "stripes"], tmp_path / "again")  # from the numbers alone
    assert all((tmp_path / "again" / "stripes" / picture).exists() for picture in pictures)
    with pytest.raises(SystemExit, match="no committed results"):
        cli.main(["draw", "shadow"], tmp_path)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"start": lambda seed: like(0)}, "is 0 at start 0 of 'bowl'.* Begin elsewhere"),
        ({"loss": lambda y: bowl_loss(y) - 9}, "lowest value is -.*optimum, 0 by default"),
        ({"loss": lambda y: bowl_loss(y) / 0}, "is inf at start"),
        ({"loss": lambda y: bowl_loss(y) * jnp.nan}, "is nan at start"),
    ],
)
def test_a_start_with_nothing_to_reduce_is_refused(tmp_path, changes, match):
    task = changed(BOWL, **changes) if "loss" in changes else dataclasses.replace(BOWL, **changes)
    with pytest.raises(ValueError, match=match):
        runs_of(task, HALVING, tmp_path)


def test_a_method_that_diverges_is_drawn(monkeypatch, tmp_path, capsys):
    """A task without an image, and a run with no finite error but the start's."""

    def diverging(problem):
        def solve(y0, key, record):
            for _ in range(3):
                record(y0 + problem.loss(y0) * jnp.nan)

        return solve

    plain = lambda full: dataclasses.replace(build(full), score=Score(REFERENCE))
    registered(monkeypatch, {"plain": plain}, {"diverging": diverging})
    cli.main(["run", "plain"], tmp_path)
    assert "Not to 90 %" in capsys.readouterr().out
    results = json.loads((tmp_path / "plain" / "results.json").read_text())
    found = results["tasks"]["stripes"]["methods"]["diverging"]
    assert found["final"]["image_error"] == dict.fromkeys(("median", "lower", "upper"))
    for picture in ("error-vs-time.png", "error-vs-evaluations.png"):
        assert (tmp_path / "plain" / picture).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("score", "match"),
    [
        (Score(), r"what is sought: Score\(reference="),
        (Score(REFERENCE, errors=lambda y, scene: {}), "only a Descent"),
    ],
)
def test_a_black_box_is_scored_as_all_are(monkeypatch, tmp_path, score, match):
    registered(monkeypatch, {"odd": lambda full: dataclasses.replace(build(full), score=score)})
    with pytest.raises(ValueError, match=match):
        cli.main(["run", "odd", "--methods", "halving"], tmp_path)


@pytest.mark.slow
def test_a_family_shares_a_table_and_a_picture(monkeypatch, tmp_path, capsys):
    def members(full):
        score = Score(REFERENCE, optimum=0.0)
        tasks = [dataclasses.replace(build(full), score=score, name=f"bowl-{n}d") for n in (2, 5)]
        return tasks

    registered(monkeypatch, {"bowls": members}, {"halving": halving})
    cli.main(["run", "bowls"], tmp_path)
    printed = capsys.readouterr().out
    assert "bowl-5d" in printed
    assert "- (0/2)" in printed  # to 1e-8
    results = json.loads((tmp_path / "bowls" / "results.json").read_text())
    assert list(results["tasks"]) == ["bowl-2d", "bowl-5d"]
    for picture in ("evaluations.png", "bowl-2d/error-vs-time.png"):
        assert (tmp_path / "bowls" / picture).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_all_scenes_are_run_and_failures_are_named(monkeypatch, tmp_path, capsys):
    def dark(full):
        raise NotAble("it lacks light")

    def broken(full):
        raise ZeroDivisionError("by zero")

    registered(monkeypatch, {"dark": dark, "broken": broken, "stripes": build})
    cli.main(["run", "all", "--methods", "failing,halving"], tmp_path)
    shown = capsys.readouterr()
    assert "dark is not able here: it lacks light." in shown.out
    assert "broken is not able here: failed: ZeroDivisionError: by zero." in shown.out
    assert "Failing is not able here: failed: RuntimeError: no luck." in shown.out
    assert "4/4" in shown.err  # one bar, which forgets what cannot be run
    results = json.loads((tmp_path / "stripes" / "results.json").read_text())["tasks"]["stripes"]
    assert results["methods"]["halving"]["took"]["image_error"]["99.9"]["solved"] == 2
    assert results["pictures"]


def test_an_interruption_ends_all_scenes(monkeypatch, tmp_path):
    def interrupted(problem):
        raise jax.errors.JaxRuntimeError("KeyboardInterrupt: ")

    registered(monkeypatch, methods={"halving": interrupted})
    with pytest.raises(KeyboardInterrupt):
        cli.main(["run", "all", "--methods", "halving"], tmp_path)


@pytest.mark.slow
def test_nothing_is_lost_by_a_kill(monkeypatch, tmp_path):
    script = """
import sys
from pathlib import Path
import pytest
sys.path.insert(0, sys.argv[1])
import test_benchmarks as here
from benchmarks import __main__ as cli
here.registered(pytest.MonkeyPatch(), methods={"killing": here.killing})
cli.main(["run", "all"], Path(sys.argv[2]))
"""
    here = Path(__file__).parent
    command = [sys.executable, "-c", script, str(here), str(tmp_path)]
    killed = subprocess.run(command, cwd=here.parent, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    (path,) = (tmp_path / "stripes" / "raw").glob("*/*.npz")
    before = path.read_bytes()
    registered(monkeypatch, methods={"killing": halving})
    cli.main(["run", "all"], tmp_path)
    assert path.read_bytes() == before
    results = json.loads((tmp_path / "stripes" / "results.json").read_text())["tasks"]["stripes"]
    assert results["methods"]["killing"]["starts"] == 2


def killing(problem):
    """Ends the process, as a kill from outside would, in its second run."""
    solve = halving(problem)

    def killed(y0, key, record):
        if float(y0[1]) == 0.1875:
            os.kill(os.getpid(), signal.SIGKILL)
        solve(y0, key, record)

    return killed


def test_figures_have_few_colours(tmp_path):
    path = tmp_path / "figure.png"
    with _style.figure(path, 1, 1, (3.0, 2.0)) as (_, axes):
        axes[0, 0].imshow(np.linspace(0, 1, 400).reshape(20, 20))
    with Image.open(path) as picture:
        assert picture.mode == "P"
        assert picture.size == (450, 300)


def test_a_rare_colour_is_kept(tmp_path):
    """As that of a method's name beside pictures that have many others."""
    random = np.random.default_rng(0)
    browns = np.array([120, 100, 80]) + random.integers(-60, 60, (300, 300, 3))
    browns[:4, :4], browns[-4:, -4:] = (31, 119, 180), (23, 155, 91)
    Image.fromarray(browns.astype(np.uint8)).save(tmp_path / "film.png")
    _style.in_few_colours(tmp_path / "film.png")
    with Image.open(tmp_path / "film.png") as picture:
        few = np.asarray(picture.convert("RGB")).astype(int)
    assert np.max(np.abs(few - browns)[:4, :4]) < 20
    assert np.max(np.abs(few - browns)[-4:, -4:]) < 20
