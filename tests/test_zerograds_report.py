"""The report of ZeroGrads: it runs, counts and resumes; and its numbers are what they say."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from benchmarks import zerograds
from benchmarks._harness import Counter
from benchmarks._task import Budget, NotAble, Task
from benchmarks.zerograds import (
    _configurations,
    _loop,
    _setting,
    ablations,
    control_variate,
    gradients,
    replay,
    samples,
    toy,
)
from smoothdiff.surrogates import MLP

TINY = zerograds.Setting(
    name="tiny",
    seeds=1,
    budgets={"wicker": 40},
    samples={"wicker": (4,)},
    gradients=("wicker",),
    gradient_seeds=1,
    truth=64,
    replay=("wicker",),
    replay_seeds=1,
    control=("wicker",),
    repeats=4,
)


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture
def slope() -> Task:
    """A linear function of two parameters, whose gradient is known and does not change."""

    def loss(y):
        return 3 * y[0] - 4 * y[1]

    return Task(
        name="slope",
        title="A slope",
        loss=loss,
        exact_loss=loss,
        start=lambda seed: jnp.asarray([1.0, 1.0]),
        reference=jnp.zeros(2),
        bounds=(jnp.full(2, -50.0), jnp.full(2, 50.0)),
        sigma=0.5,
        budget=Budget(400, 100.0),
        seeds=1,
    )


def run_of(errors, evaluations=(0, 10, 20, 40)):
    return {"evaluations": list(evaluations), "image_error": list(errors)}


def test_runs_writes_and_resumes(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(toy, "BUDGET", 40)
    few = [each for each in _configurations.ablations() if each.name in ("ours", "no-smooth", "fd")]
    monkeypatch.setattr(_configurations, "ablations", lambda: few)
    monkeypatch.setattr(gradients, "TITLES", {"ours": "Ours"})
    monkeypatch.setattr(control_variate, "BASELINES", {"mean": "the mean"})
    monkeypatch.setattr(control_variate, "SHARES", (1.0,))
    zerograds.main(tmp_path, TINY, command="a test")
    assert "NoSmooth" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())
    for part in zerograds.PARTS:
        assert (tmp_path / f"{part}.png").read_bytes().startswith(b"\x89PNG")
    wicker = results["ablations"]["tasks"]["wicker"]
    assert wicker["ratios"]["ours"] == pytest.approx(1)
    assert set(wicker["curves"]) == set(results["ablations"]["titles"])

    def run_again(*_, **__):
        raise AssertionError("run again")

    for name in ("toy", "control_variate"):  # these keep nothing
        kept = results[name]
        monkeypatch.setattr(zerograds.PARTS[name], "measure", lambda *_, kept=kept: kept)
    monkeypatch.setattr(_loop, "Steps", run_again)
    monkeypatch.setattr(gradients.Descent, "__call__", run_again)
    zerograds.main(tmp_path, TINY, command="a test")
    assert json.loads((tmp_path / "results.json").read_text())["samples"] == results["samples"]
    with pytest.raises(AssertionError, match="run again"):
        zerograds.main(tmp_path, TINY, command="a test", fresh=True)


def test_settings_name_tasks_that_are_there():
    groups = {name for members in _configurations.GROUPS.values() for name in members}
    for setting in (zerograds.QUICK, zerograds.FULL):
        assert set(setting.budgets) <= groups
        named = {*setting.samples, *setting.gradients, *setting.replay, *setting.control}
        assert named <= set(setting.budgets)
    assert set(zerograds.FULL.budgets) == groups


def test_starts_of_every_study_are_what_was_asked_for():
    setting = TINY.with_starts(3)
    changed = {name for name in TINY._fields if getattr(setting, name) != getattr(TINY, name)}
    assert changed == {"seeds", "gradient_seeds", "replay_seeds"}
    assert {getattr(setting, name) for name in changed} == {3}


def test_stretches_are_the_steps_of_minimise_and_are_counted(slope):
    counter = Counter()
    watched = dataclasses.replace(slope, loss=counter.watch(slope.loss))
    ours = partial(_configurations.ours, surrogate=partial(MLP, width=4, depth=1))
    solve = _loop.in_stretches(ours, watched)
    ys, key = [], jax.random.key(3)
    counts = []

    def record(y):
        ys.append(np.asarray(y))
        counts.append(counter.evaluations)

    solve(slope.start(0), key, record)
    assert counts[-1] == slope.budget.evaluations
    assert counts[0] == 2
    steps = []
    sd.minimise(
        lambda y, args: slope.loss(y),
        slope.start(0),
        key=key,
        solver=ours(slope),
        bounds=slope.bounds,
        max_steps=20,
        callback=lambda step: steps.append(step.y),
    )
    # one step each at first
    assert np.array(ys[:20]) == pytest.approx(np.array(steps), abs=1e-5)


def test_ablations_are_ours_but_for_one_thing():
    task = _setting.load("wicker", TINY)
    ours = _configurations.ours(task)
    assert _configurations.ours(task, inner_sigma=0.0).inner_sigma == 0
    assert ours.local
    assert not _configurations.ours(task, local=False).local
    names = [method.name for method in _configurations.ablations()]
    assert names == ["ours", *_configurations.PAPER["rendering"]]
    sources = {method.name: method.source for method in _configurations.ablations()}
    assert len(set(sources.values())) == len(sources)


def test_what_is_too_large_is_not_able(slope):
    task = dataclasses.replace(slope, reference=jnp.zeros((300, 20)))
    assert _configurations.size(task) == 6000
    able = {method.name: method for method in _configurations.ablations()}
    with pytest.raises(NotAble, match="6,000 by 6,000"):
        able["no-nn"].prepare(task)
    with pytest.raises(NotAble, match="12,000 evaluations"):
        able["fd"].prepare(task)


def test_ratios_are_taken_where_ours_is_down_to_five_percent():
    runs = {
        "ours": [run_of((1, 0.4, 0.05, 0.01)), run_of((1, 0.2, 0.03, 0.0))],
        "fr22": [run_of((1, 0.8, 0.4, 0.2))] * 2,
        "fd": NotAble("needs more"),
    }
    found = ablations.compare(runs, 40)
    assert (found["at"], found["reached"]) == (20, True)
    assert found["ratios"] == pytest.approx({"ours": 1, "fr22": 10})
    assert found["not_able"] == {"fd": "needs more"}
    assert found["final"]["fr22"] == 0.2

    found = ablations.compare({"ours": [run_of((1, 0.9, 0.8, 0.5))], "fr22": runs["fr22"]}, 40)
    assert (found["at"], found["reached"]) == (40, False)
    assert found["ratios"]["fr22"] == pytest.approx(0.4)


def test_what_is_solved_counts_as_a_thousandth():
    found = ablations.compare({"ours": [run_of((1, 0, 0, 0))], "fr22": [run_of((1, 1, 1, 1))]}, 40)
    assert found["ratios"]["fr22"] == pytest.approx(1000)


def test_groups_have_geometric_means():
    tasks = {
        "led": {"ratios": {"ours": 1.0, "fr22": 2.0}},
        "wicker": {"ratios": {"ours": 1.0, "fr22": 8.0, "no-nn": 3.0}},
        "mlp": {"ratios": {"ours": 1.0}},
    }
    found = ablations.means(tasks)
    assert found["modelling"] == pytest.approx({"ours": 1, "fr22": 4, "no-nn": 3})
    assert found["many parameters"] == {"ours": pytest.approx(1)}


def test_samples_are_compared_at_the_end():
    runs = {2: [run_of((1, 0.5, 0.3, 0.1))], 4: [run_of((1, 0.6, 0.4, 0.2))]}
    found = samples.compare(runs, 40)
    assert found["samples"] == [2, 4]
    assert [each[1] for each in found["errors"]] == [0.1, 0.2]


def test_replay_is_read_where_the_error_is_down_to_a_tenth():
    runs = [run_of((1, 0.5, 0.1, 0.02)), run_of((1, 0.09, 0.05, 0.01)), run_of((1, 1, 1, 0.9))]
    found = replay.compare(runs, np.array([10, 40]))
    assert found["took"] == {"median": 20, "lower": 20, "upper": None}
    assert found["final"]["median"] == 0.02
    assert found["curves"][1] == pytest.approx([0.5, 0.02])


def test_the_control_variate_is_what_the_run_has_learnt(slope):
    # a gp knows a slope from its samples; without one, all variance is what the surrogate leaves
    ratios = control_variate.along(slope, seed=0, repeats=20)
    assert len(ratios["mean"]) == len(ratios["gp"]) == len(control_variate.SHARES)
    assert ratios["mean"][-1] > 10
    assert ratios["mean"][-1] > ratios["mean"][0]


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


@pytest.mark.parametrize("name", gradients.TITLES)
def test_on_a_slope_gradients_point_the_right_way(name, slope):
    found = gradients.Descent(name, slope, 2048)(seed=0)
    assert len(found["cosine"]) == gradients.WINDOWS
    if name == "ours":  # it has learnt the slope
        assert np.median(found["cosine"]) > 0.97
    else:  # a random diagonal
        assert 0 < np.mean(found["cosine"]) < 0.97
    if name == "fr22":  # as many long and short ones as (g.z) |z| of normal z
        z = np.random.default_rng(0).normal(size=(10**5, 2))
        lengths = np.abs(z @ [3, -4]) * np.linalg.norm(z, axis=1)
        assert np.median(found["variance"]) == pytest.approx(lengths.var(), rel=0.7)


def test_true_gradients_by_values_terms_and_ad_agree(slope, key):
    by_ad = dataclasses.replace(slope, name=gradients.SMOOTH[0])
    terms, support = lambda y: y * jnp.asarray([3.0, -4.0]), lambda y: y
    by_terms = dataclasses.replace(slope, terms=terms, support=support)
    for task in (slope, by_ad, by_terms):
        truth = gradients._true_gradient(task, 4096)(key, slope.start(0), jnp.asarray(0.5))
        assert np.asarray(truth) == pytest.approx([3, -4], abs=0.3)


def test_the_toy_is_smoothed_and_solved():
    y = np.array([0.3, 0.75])
    draws = np.random.default_rng(0).normal(size=200_000)
    for at, smooth in zip(y, toy.smoothed(y, 0.1), strict=True):
        values = toy.loss(np.clip(at + 0.1 * draws, 0, 1))
        assert abs(values.mean() - smooth) < 4 * values.std() / len(draws) ** 0.5 + 1e-3
    frames = toy.measure(TINY, None, False)["frames"]  # type: ignore[arg-type]
    assert [frame["evaluations"] for frame in frames] == [0, 80, 280, 800]
    assert frames[-1]["loss"] == 0
    assert frames[1]["surrogate"][0] > frames[1]["surrogate"][-1]  # it leads towards the reference


def test_optimisers_are_chained_after_what_keeps_the_gradient():
    task = _setting.load("wicker", TINY)
    for name in gradients.TITLES:
        steps = _loop.Steps(gradients.solver(name, task), task)
        state = jax.eval_shape(steps.init, task.start(0), jax.random.key(0))
        assert state.opt_state[0].shape == (3,)
    assert isinstance(gradients.kept_gradient(), optax.GradientTransformation)
