"""The host loop: its iterates, its budget, what it returns, and how it survives interruptions."""

import errno
import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._black_box import UnknownOutputError
from tests.parts import quick_of

N = 8
ADAM = sd.FirstOrder(optax.adam(0.05), 0.2, num_samples=N)
SCHEDULE = optax.linear_schedule(0.3, 0.1, 100)
ANNEALED = sd.FirstOrder(optax.adam(0.05), SCHEDULE, num_samples=N)
# without noise the lowest again, four candidates and a batch; set aside are three times as many
JUDGING = 5 + N
RESERVED = ADAM.final_evaluations(None)
KEY = jax.random.key(5)
Y0 = jnp.zeros(2)
TARGET = jnp.array([0.6, -0.4])


def plateaus(y, target):
    return jnp.sum(jnp.floor(8 * jnp.abs(y - target)))


def waves(y, target):
    return jnp.sum(jnp.sin(3 * (y - target)) ** 2)


class Host:
    """A black box that counts its evaluations and raises at one of them."""

    def __init__(self):
        self.count, self.at, self.error = 0, 0, BaseException()
        self.points, self.values = [], []
        self.box = sd.black_box(self.call, jax.ShapeDtypeStruct((), jnp.float32))

    def call(self, y):
        self.count += 1
        if self.count == self.at:
            raise self.error
        self.points.append(np.array(y))
        self.values.append(np.sum(np.floor(8 * np.abs(y - np.asarray(TARGET)))))
        return self.values[-1]


HOST = Host()


def host_plateaus(y, edge):
    """NaN beyond an edge, without one nowhere."""
    return jnp.where(y[0] > edge, jnp.nan, HOST.box(y))


NO_EDGE = jnp.asarray(np.inf)


@pytest.fixture
def host():
    """The one black box of this file, so that it is compiled once; made new for each test."""
    HOST.count, HOST.at, HOST.points, HOST.values = 0, 0, [], []
    return HOST


class StopHereError(Exception):
    pass


def stop_at(step, error: type[BaseException] = StopHereError):
    def callback(record):
        if record.step == step:
            raise error

    return callback


def assert_same(one, other):
    """Two results agree to the last bit, but for the seconds."""
    pick = lambda r: (r.fun, r.smoothed, r.stderr, r.evaluations, r.reason)
    assert pick(one) == pick(other)
    np.testing.assert_array_equal(one.y, other.y)
    assert len(one.history) == len(other.history)
    for a, b in zip(one.history, other.history, strict=True):
        assert [*map(type, a)] == [*map(type, b)]
        assert a[:2] + a[3:7] == b[:2] + b[3:7]
        np.testing.assert_array_equal(a.y, b.y)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep" / "run.npz"


# the iterates


@pytest.mark.parametrize(
    ("dtype", "to_the_last_bit"),
    [
        ("float32", False),
        # as users compile them
        pytest.param("float32", True, marks=pytest.mark.slow),
        pytest.param("float64", True, marks=pytest.mark.slow),
    ],
    indirect=["dtype"],
)
def test_iterates_are_those_of_optimistix(dtype, to_the_last_bit):
    y0, target, bounds = jnp.zeros(2, dtype), TARGET.astype(dtype), (-1.0, 0.5)
    options = {"key": KEY, "bounds": bounds}
    solution = optx.minimise(waves, ANNEALED, y0, target, options, max_steps=40, throw=False)
    result = sd.minimise(waves, y0, target, key=KEY, solver=ANNEALED, max_steps=40, bounds=bounds)
    assert result.y.dtype == dtype
    rtol = 0 if to_the_last_bit else 1e-4
    np.testing.assert_allclose(result.y, solution.value, rtol=rtol)
    for name in ("fun", "smoothed", "stderr", "evaluations"):
        np.testing.assert_allclose(getattr(result, name), solution.stats[name], rtol=rtol)
    assert result.evaluations == 40 * N + JUDGING
    np.testing.assert_allclose(
        result.history[-1].smoothed, solution.state.progress.smoothed, rtol=rtol
    )


def test_a_new_key_does_not_trace_the_function_again_and_a_raw_one_gives_the_same_run():
    traces = []

    def fun(y, args):
        traces.append(1)
        return waves(y, TARGET)

    run = lambda key: sd.minimise(fun, Y0, key=key, solver=ADAM, max_steps=3)
    first, before = run(jax.random.key(3)), len(traces)
    second = run(jax.random.key(4))
    assert len(traces) == before
    assert first.fun != second.fun
    assert_same(first, run(jax.random.PRNGKey(3)))


def test_history_says_what_happened():
    records = []
    y0 = {"a": 0.5, "b": [1, jnp.zeros((2, 1))]}
    fun = lambda y, args: sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(y))
    result = sd.minimise(fun, y0, key=KEY, solver=ANNEALED, max_steps=5, callback=records.append)
    for record in records:
        assert fun(record.best, None) == pytest.approx(record.fun)
    assert [record._replace(best=None) for record in records] == result.history
    assert [r.step for r in records] == [1, 2, 3, 4, 5]
    assert [r.evaluations for r in records] == [N, 2 * N, 3 * N, 4 * N, 5 * N]
    assert [r.sigma for r in records] == pytest.approx(
        [float(np.asarray(SCHEDULE(i))) for i in range(5)]
    )
    assert np.all(np.diff([0.0] + [r.seconds for r in records]) > 0)
    # 5 numbers of mean square y^2 + sigma^2; sum y^2 = 1.25
    assert records[0].smoothed == pytest.approx(1.25 + 4 * 0.3**2, abs=4 * records[0].stderr)
    for y in [result.y, *(r.y for r in records)]:
        assert jax.tree.structure(y) == jax.tree.structure(y0)
    assert all(isinstance(leaf, np.ndarray) for r in records for leaf in jax.tree.leaves(r.y))
    # the first update of Adam has the size of its learning rate
    assert records[0].y["a"] == pytest.approx(0.45, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [ADAM, sd.NewtonCG(0.2)])
def test_records_have_the_lowest_value_of_all_that_was_evaluated(solver, host):
    run = sd.minimise(host_plateaus, Y0, NO_EDGE, key=KEY, solver=solver, max_steps=6)
    for record in run.history:
        assert record.fun == min(host.values[: record.evaluations])
        assert np.isnan(record.smoothed) == (solver is not ADAM)
    assert run.fun <= run.history[-1].fun


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "asked", "kept"), [(2, None, True), (2, False, False), (20_000, None, False)]
)
def test_the_history_has_iterates_where_they_are_few_or_asked_for(n, asked, kept, path):
    seen, fun = [], lambda y, args: jnp.sum(y**2)
    run = functools.partial(
        sd.minimise, fun, jnp.ones(n), key=KEY, solver=ADAM, keep_iterates=asked, checkpoint=path
    )
    run(max_steps=2, callback=lambda record: seen.append(record.y))
    size = path.stat().st_size
    history = run(max_steps=12, callback=lambda record: seen.append(record.y)).history
    assert [y.shape for y in seen] == [(n,)] * 12
    for record, y in zip(history, seen, strict=True):
        assert np.array_equal(record.y, y) if kept else record.y is None
    # ten steps of six numbers, and the iterates if they are kept
    assert path.stat().st_size - size < 10 * (8 * 7 + 4 * n * kept) + 100
    with pytest.raises(ValueError, match="keep_iterates differed"):
        run(max_steps=12, keep_iterates=not kept)


# the budget


@pytest.mark.parametrize("budget", [N + RESERVED, 2 * N + RESERVED - 1, 100])
def test_max_evaluations_is_never_exceeded(budget, host):
    result = sd.minimise(host_plateaus, Y0, NO_EDGE, key=KEY, solver=ADAM, max_evaluations=budget)
    assert result.reason == "max_evaluations"
    assert budget - N < host.count + RESERVED - JUDGING <= budget
    assert result.evaluations == host.count
    assert result.history[-1].evaluations == host.count - JUDGING


def test_a_budget_without_room_for_a_step_is_refused():
    with pytest.raises(ValueError, match=rf"Allow {N + RESERVED}"):
        sd.minimise(waves, Y0, TARGET, key=KEY, solver=ADAM, max_evaluations=N + RESERVED - 1)


def test_steps_are_limited_by_what_is_given():
    run = functools.partial(sd.minimise, plateaus, Y0, TARGET, key=KEY, solver=ANNEALED)
    default = run()
    assert (len(default.history), default.reason) == (256, "max_steps")
    np.testing.assert_allclose(default.y, TARGET, atol=0.06)
    assert len(run(max_evaluations=300 * N + RESERVED).history) == 300
    assert len(run(max_evaluations=10_000, max_steps=3).history) == 3
    none = run(max_steps=0)
    assert none.history == []
    assert none.evaluations == JUDGING
    assert none.fun == plateaus(none.y, TARGET) <= plateaus(Y0, TARGET)


def test_the_callback_can_stop_the_run():
    stop = lambda record: record.step == 4
    result = sd.minimise(waves, Y0, TARGET, key=KEY, solver=ADAM, callback=stop)
    assert (result.reason, len(result.history)) == ("callback", 4)
    assert result.evaluations == 4 * N + JUDGING


def test_a_solver_that_converges_stops():
    solver = sd.FirstOrder(optax.sgd(0.0), 0.2, atol=1e-6)
    result = sd.minimise(waves, Y0, TARGET, key=KEY, solver=solver)
    assert (result.reason, len(result.history)) == ("converged", 5)


# judging


def test_the_result_is_judged_on_fresh_samples_not_on_luck():
    level, steps, seeds = 10.0, 100, 100
    random = np.random.default_rng(0)

    def noisy(y, args):
        noise = lambda y: level * random.normal(size=y.shape).astype(np.float32)
        return y**2 + jax.pure_callback(noise, y, y, vmap_method="expand_dims")

    solver = sd.FirstOrder(optax.sgd(0.02), 1.0, num_samples=N)

    def run(seed):
        options = {"key": jax.random.key(seed)}
        solution = optx.minimise(noisy, solver, 3.0, None, options, max_steps=steps, throw=False)
        lucky = solution.state.progress
        return solution.value, solution.stats["fun"], lucky.lowest_y, lucky.lowest_fun

    y, fun, lucky_y, lucky_fun = jax.jit(jax.vmap(run))(jnp.arange(seeds))
    # the lowest of 800 values flatters by three times the noise; the lowest of five means of three
    # by 1.2 times their noise
    flattery = lambda fun, y: np.mean(np.asarray(y**2 - fun)) / level
    assert flattery(lucky_fun, lucky_y) > 2.5
    assert flattery(fun, y) < 1.2 / np.sqrt(3)


# interruptions and faults


def test_ctrl_c_in_the_callback_returns_what_has_been_found(host):
    result = sd.minimise(
        host_plateaus, Y0, NO_EDGE, key=KEY, solver=ADAM, callback=stop_at(6, KeyboardInterrupt)
    )
    assert (result.reason, len(result.history)) == ("interrupted", 6)
    assert result.evaluations == host.count == 6 * N
    assert result.fun == min(host.values) == host.call(result.y)
    assert any(np.array_equal(result.y, y) for y in host.points[: 6 * N])
    assert np.isnan([result.smoothed, result.stderr]).all()


@pytest.mark.parametrize("at", [3, 6 * N + 3])
def test_ctrl_c_in_the_black_box_returns_what_has_been_found(at, host):
    host.at, host.error = at, KeyboardInterrupt()
    result = sd.minimise(host_plateaus, Y0, NO_EDGE, key=KEY, solver=ADAM)
    assert (result.reason, len(result.history)) == ("interrupted", at // N)
    assert np.all(np.isfinite(result.y))


@pytest.mark.parametrize("at", [6 * N + 3, 10 * N + 3], ids=["in a step", "while judging"])
def test_a_black_box_that_raises_loses_nothing(at, host, path):
    run = functools.partial(
        sd.minimise, host_plateaus, Y0, NO_EDGE, key=KEY, solver=ADAM, max_steps=10
    )
    whole = run()
    host.at, host.error = host.count + at, OverflowError("too bright")
    with pytest.raises(sd.MinimiseError, match="too bright") as caught:
        run(checkpoint=path)
    assert caught.value.__cause__ is host.error
    found = caught.value.result
    assert (found.reason, len(found.history)) == ("failed", at // N)
    assert found.evaluations == at // N * N
    assert np.isfinite(found.fun)
    assert_same(run(checkpoint=path), whole)


def radius(y):
    """As in a drawing, there is none below zero."""
    if y[0] < 0:
        raise ValueError("negative radius")
    return np.sum((y + 1) ** 2)


def root(y):
    with np.errstate(invalid="ignore"):
        return np.sqrt(y[0]) + y[1] ** 2


WHERE = [{}, {"bounds": (-1.0, 2.0)}, {"space": sd.Range(-1.0, 2.0)}]


@pytest.mark.parametrize("where", quick_of(WHERE, [{}]))
@pytest.mark.parametrize("fails", quick_of([radius, root], [root]))
def test_a_point_where_a_black_box_fails_leads_to_bounds_if_there_are_none(fails, where):
    box = sd.black_box(fails, jnp.float32(0))
    with pytest.raises(sd.MinimiseError, match=r"\[-\d") as caught:
        sd.minimise(lambda y, args: box(y), jnp.full(2, 0.1), key=KEY, max_evaluations=40, **where)
    assert ("bounds=(low, high), or a space, keeps it" in str(caught.value)) == (not where)


def test_a_mistake_in_a_black_box_is_not_put_down_to_bounds():
    box = sd.black_box(lambda y: np.zeros(3), jnp.float32(0))
    with pytest.raises(sd.MinimiseError, match="promises") as caught:
        sd.minimise(lambda y, args: box(y), jnp.zeros(2), key=KEY)
    assert "bounds" not in str(caught.value)


@pytest.mark.parametrize(
    ("out", "error"),
    [({}, sd.BlackBoxError), ({"out": jnp.float32(0)}, sd.MinimiseError)],
    ids=["to find what it returns", "of the first step"],
)
def test_what_a_first_evaluation_raises_is_the_cause_of_the_error(out, error):
    """And nothing of ours stands between."""
    raised = OSError("no scene file")

    def host(y):
        raise raised

    box = sd.black_box(host, **out)
    with pytest.raises(error, match="no scene file") as caught:
        sd.minimise(lambda y, args: box(y), jnp.zeros(2), key=KEY)
    assert caught.value.__cause__ is raised
    seen = [caught.value]
    while (context := seen[-1].__context__) is not None:
        seen.append(context)
    assert not any(isinstance(error, UnknownOutputError) for error in seen)


def test_a_step_that_is_not_finite_raises_and_keeps_the_result(host):
    edge = jnp.asarray(0.3)
    solver = sd.FirstOrder(optax.adam(0.05), 0.2, num_samples=N, nonfinite="drop")
    with pytest.raises(sd.MinimiseError, match=r"NaN or infinite.*smaller sigma") as caught:
        sd.minimise(host_plateaus, Y0, edge, key=KEY, solver=solver, max_steps=100)
    assert caught.value.__cause__ is None
    found = caught.value.result
    assert found.reason == "nonfinite"
    allowed = [v for y, v in zip(host.points, host.values, strict=True) if y[0] <= edge]
    assert found.fun == min(allowed)
    assert found.evaluations == host.count == (len(found.history) + 1) * N
    # it went on until about half of the samples failed, where the other stops at the first one
    assert 0.1 < found.history[-1].y[0] < 0.5
    with pytest.raises(sd.MinimiseError, match='give the solver nonfinite="drop"') as caught:
        sd.minimise(host_plateaus, Y0, edge, key=KEY, solver=ADAM, max_steps=100)
    assert len(caught.value.result.history) < len(found.history)


def test_an_error_in_the_callback_is_the_callers():
    with pytest.raises(StopHereError):
        sd.minimise(waves, Y0, TARGET, key=KEY, solver=ADAM, callback=stop_at(2))


def test_a_schedule_that_reaches_zero_is_blamed():
    solver = sd.FirstOrder(optax.adam(0.05), optax.linear_schedule(0.3, 0.0, 6))
    with pytest.raises(sd.MinimiseError, match=r"sigma of step 6 is 0\.0: it must stay above zero"):
        sd.minimise(waves, Y0, TARGET, key=KEY, solver=solver, max_steps=20)


def test_a_target_that_the_judgement_finds_is_reached():
    steps = lambda y, _: jnp.round(16 * (y - 1)) / 16
    result = sd.least_squares(
        steps,
        jnp.zeros(4),
        key=KEY,
        support=sd.local_support(0, ndim=1),
        bounds=(-2.0, 2.0),
        target=1e-3,
        max_evaluations=150,
    )
    assert result.fun <= 1e-3
    assert result.reason == "target"


# checkpoints


def test_a_resumed_run_ends_with_the_same_bits(path):
    bounds = (-1.0, 0.5)
    run = functools.partial(sd.minimise, waves, Y0, TARGET, key=KEY, solver=ANNEALED, bounds=bounds)
    whole = run(max_steps=20)
    for step in (1, 7, 13):
        with pytest.raises(StopHereError):
            run(max_steps=20, checkpoint=path, callback=stop_at(step))
    steps = []
    resumed = run(max_steps=20, checkpoint=path, callback=lambda r: steps.append(r.step))
    assert steps == [14, 15, 16, 17, 18, 19, 20]
    assert_same(resumed, whole)
    assert np.all(np.diff([r.seconds for r in resumed.history]) > 0)
    # once more at the end, and then further
    assert_same(run(max_steps=20, checkpoint=path), whole)
    assert_same(run(max_steps=30, checkpoint=path), run(max_steps=30))
    assert [p.name for p in path.parent.iterdir()] == ["run.npz"]


def test_a_run_that_goes_on_near_its_end_counts_as_before(path):
    """Where an evaluation has told that there is no noise, so that steps have what is left."""
    calls = []

    def host(y):
        calls.append(y)
        return np.float32(np.sum(np.floor(8 * np.abs(y - 1))))

    box = sd.black_box(host, 0.0)
    run = functools.partial(
        sd.minimise, lambda y, _: box(y), jnp.zeros(2), key=KEY, max_evaluations=40
    )
    whole = run()
    assert whole.evaluations == len(calls) == 40
    with pytest.raises(StopHereError):
        run(checkpoint=path, callback=stop_at(37))
    for _ in range(2):  # and once more at the end
        again = run(checkpoint=path)
        assert (again.evaluations, again.fun) == (40, whole.fun)
        np.testing.assert_array_equal(again.y, whole.y)


@pytest.mark.parametrize("out", [None, 0.0])
def test_a_finished_run_that_is_called_again_pays_for_its_check_alone(out, path):
    calls = []
    host = lambda y: np.float32(calls.append(1) or np.sum(np.floor(8 * np.abs(y - 1))))

    def run():
        calls.clear()
        box = sd.black_box(host, out)  # as in a process of its own
        fun, y0 = lambda y, args: box(y), jnp.zeros(2)
        return sd.minimise(fun, y0, key=KEY, max_evaluations=20, checkpoint=path), len(calls)

    (first, paid), (again, more) = run(), run()
    assert (paid, more) == (20, 2 if out is None else 1)
    pick = lambda r: (r.fun, r.smoothed, r.evaluations, r.reason, *r.y.tolist())
    assert pick(again) == pick(first)


def test_a_trial_that_showed_noise_is_of_the_run_that_it_ended(path):
    """A longer run judges the point that is lowest then."""
    rng = np.random.default_rng(0)
    noisy = lambda y: np.float32(np.sum((y - 1) ** 2) + 1e-3 * rng.normal())
    box = sd.black_box(noisy, 0.0)
    run = functools.partial(sd.minimise, lambda y, _: box(y), jnp.full(2, 5.0), key=KEY)
    short = run(checkpoint=path, max_evaluations=14)
    longer = run(checkpoint=path, max_evaluations=60)
    assert longer.fun < 0.1 < short.fun


def test_a_schedule_of_a_pytree_that_meets_nan_keeps_what_was_found():
    widths = lambda step: {"a": 0.1, "b": 0.2}
    fun = lambda y, _: jnp.where(y["a"] < 0.7, jnp.nan, y["a"] ** 2 + y["b"] ** 2)
    solver = sd.FirstOrder(optax.adam(0.2), widths)
    y0 = {"a": jnp.array(1.5), "b": jnp.array(1.0)}
    with pytest.raises(sd.MinimiseError, match="nonfinite"):
        sd.minimise(fun, y0, key=KEY, solver=solver, max_steps=50)


def test_checkpoints_of_pytrees_float64_bfloat16_and_keys(path, x64):
    y0 = {"a": jnp.zeros(2, jnp.float64), "b": jnp.ones((), jnp.float32)}
    fun = lambda y, args: jnp.sum(y["a"] ** 2) + jnp.cos(y["b"]).astype(jnp.float64)
    adam = optax.adam(0.05, mu_dtype=jnp.bfloat16)
    solver = sd.FirstOrder(optax.chain(optax.add_noise(0.01, 0.5, jax.random.key(1)), adam), 0.2)
    run = functools.partial(sd.minimise, fun, y0, key=KEY, solver=solver, max_steps=6)
    with pytest.raises(StopHereError):
        run(checkpoint=path, callback=stop_at(3))
    resumed, whole = run(checkpoint=path), run()
    for one, other in zip(jax.tree.leaves(resumed.y), jax.tree.leaves(whole.y), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("y0", {"y0": Y0 + 1}),
        ("y0", {"y0": jnp.zeros(3), "args": 0.0}),
        ("args", {"args": TARGET + 1}),
        ("key", {"key": jax.random.key(6)}),
        ("bounds", {"bounds": (-1.0, 1.0)}),
        ("fun", {"fun": plateaus}),
        ("solver", {"solver": sd.FirstOrder(optax.adam(0.05), 0.3, num_samples=N)}),
        ("solver", {"solver": sd.FirstOrder(optax.sgd(0.05), 0.2, num_samples=N)}),
    ],
)
def test_the_checkpoint_of_another_problem_is_refused(name, change, path):
    call = {"fun": waves, "y0": Y0, "args": TARGET, "key": KEY, "solver": ADAM, "max_steps": 2}
    sd.minimise(**call, checkpoint=path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=rf"another problem: its [\w, ]*\b{name}\b"):
        sd.minimise(**{**call, **change}, checkpoint=path)
    assert path.read_bytes() == before


def disk_full(path, monkeypatch):
    def savez(file, **arrays):
        file.write(b"some of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("smoothdiff._checkpoint.np.savez", savez)


def directory_gone(path, monkeypatch):
    shutil.rmtree(path.parent)


def directory_is_a_file(path, monkeypatch):
    shutil.rmtree(path.parent)
    path.parent.write_text("")


@pytest.mark.parametrize("fault", [disk_full, directory_gone, directory_is_a_file])
def test_a_save_that_fails_warns_and_the_run_goes_on(fault, path, monkeypatch):
    run = functools.partial(sd.minimise, waves, Y0, TARGET, key=KEY, solver=ADAM, max_steps=4)
    broken = lambda record: fault(path, monkeypatch) if record.step == 2 else None
    with pytest.warns(RuntimeWarning, match=r"not saved, the run goes on: .*(space|No such|dir)"):
        result = run(checkpoint=path, callback=broken)
    assert_same(result, run())
    if fault is disk_full:
        monkeypatch.undo()
        # the file of an earlier step is whole, and nothing lies beside it
        assert_same(run(checkpoint=path), result)
        assert [p.name for p in path.parent.iterdir()] == ["run.npz"]


def shifted(by):
    return lambda y, target: jnp.sum(jnp.floor(8 * jnp.abs(y - target - by)))


ALIKE = {
    "closure": (shifted(0.0), shifted(0.5)),
    "partial": (
        functools.partial(lambda y, target, by: jnp.sum(jnp.abs(y - by)), by=0.1),
        functools.partial(lambda y, target, by: jnp.sum(jnp.abs(y - by)), by=0.2),
    ),
    "lambda": (lambda y, target: jnp.sum(y**2), lambda y, target: jnp.sum(y**4)),
    "black box": (sd.black_box(shifted(0.0), 0.0), sd.black_box(shifted(0.5), 0.0)),
}


@pytest.mark.parametrize("name", ALIKE)
def test_another_function_of_the_same_name_is_refused(name, path):
    one, other = ALIKE[name]
    run = lambda fun: sd.minimise(
        fun, Y0, np.zeros(2, np.float32), key=KEY, solver=ADAM, max_steps=1, checkpoint=path
    )
    run(one)
    with pytest.raises(ValueError, match=r"another problem: its fun\b"):
        run(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (optax.adam(0.05), optax.adam(0.5)),
        (optax.adam(0.05), optax.adam(0.05, b1=0.8)),
        (optax.sgd(SCHEDULE), optax.sgd(optax.linear_schedule(0.3, 0.2, 100))),
    ],
)
def test_other_numbers_of_optax_are_refused(one, other, path):
    run = lambda adam: sd.minimise(
        waves, Y0, TARGET, key=KEY, solver=sd.FirstOrder(adam, 0.2), max_steps=1, checkpoint=path
    )
    run(one)
    with pytest.raises(ValueError, match=r"another problem: its solver\.optim\."):
        run(other)


def test_what_the_function_itself_changes_is_no_part_of_the_problem(path):
    seen, cache = [], {}

    def host(y):
        seen.append(y)
        cache[len(seen)] = y
        return np.sum(np.floor(8 * np.abs(y)))

    box = sd.black_box(host, 0.0)
    run = functools.partial(sd.minimise, lambda y, args: box(y), Y0, key=KEY, solver=ADAM)
    whole = run(max_steps=4)
    for steps in (2, 4):
        seen.clear()
        assert_same(
            run(max_steps=steps, checkpoint=path), whole if steps == 4 else run(max_steps=2)
        )
    # of the steps that were left, of the judgement, and at the lowest point
    assert len(seen) == 2 * N + JUDGING + 1
    cache.clear()
    assert_same(run(max_steps=4, checkpoint=path), whole)


class Hidden:
    """Returns what no digest can see."""

    def __init__(self, values):
        self.values = values

    def __reduce__(self):
        raise TypeError("no pickle")

    def __call__(self, y, args):
        return self.values(y)


@pytest.mark.parametrize(
    "solver", [ADAM, pytest.param(sd.NewtonCG(0.2), marks=pytest.mark.slow)], ids=["adam", "newton"]
)
def test_a_function_with_other_values_is_refused_whatever_the_digest_says(solver, path):
    run = functools.partial(sd.minimise, y0=Y0, key=KEY, solver=solver, max_steps=3)
    square = lambda y: jnp.sum((y - 1) ** 2)
    first = run(Hidden(square), checkpoint=path)
    with pytest.raises(
        ValueError, match=r"another problem: fun at its lowest point is .*, and was"
    ):
        run(Hidden(lambda y: jnp.sum(jnp.abs(y))), checkpoint=path)
    # rounded otherwise it is the same
    run(Hidden(lambda y: jnp.sum(y * y - 2 * y + 1)), checkpoint=path)
    again = run(Hidden(square), checkpoint=path)
    np.testing.assert_array_equal(again.y, first.y)
    assert (again.fun, again.evaluations) == (first.fun, first.evaluations)


def test_a_function_with_noise_is_taken_up_unless_its_state_differs(path):
    random, settings = np.random.default_rng(0), {"samples": 4}
    box = sd.black_box(lambda y: np.sum(np.abs(y)) + random.standard_normal(), 0.0)
    fun = lambda y, args: box(y) * settings["samples"]
    run = functools.partial(sd.minimise, fun, Y0, key=KEY, solver=ADAM, checkpoint=path)
    run(max_steps=2)
    assert run(max_steps=3).history[-1].step == 3
    settings["samples"] = 8
    with pytest.raises(ValueError, match=r"another problem: its fun\.settings differed"):
        run(max_steps=4)


def test_a_nan_where_the_function_was_finite_is_no_verdict(path):
    calls = []

    def host(y):
        calls.append(y)
        return np.sum(np.abs(y)) if len(calls) <= 2 * N + JUDGING else np.nan

    box = sd.black_box(host, 0.0, on_nonfinite="nan")
    run = functools.partial(sd.minimise, lambda y, args: box(y), Y0, key=KEY, solver=ADAM)
    run(max_steps=2, checkpoint=path)
    with pytest.raises(sd.MinimiseError, match="NaN") as caught:
        run(max_steps=3, checkpoint=path)
    assert caught.value.result.history[-1].step == 2


def test_a_failure_of_the_function_while_a_checkpoint_is_compared_loses_nothing(host, path):
    run = functools.partial(sd.minimise, host_plateaus, Y0, NO_EDGE, key=KEY, solver=ADAM)
    run(max_steps=2, checkpoint=path)
    host.at, host.error = host.count + 1, OverflowError("too bright")
    with pytest.raises(sd.MinimiseError, match="too bright") as caught:
        run(max_steps=4, checkpoint=path)
    assert len(caught.value.result.history) == 2
    assert_same(run(max_steps=4, checkpoint=path), run(max_steps=4))


@pytest.mark.parametrize("content", [b"", b"not a run", b"PK\x03\x04 broken"])
def test_a_file_that_is_no_checkpoint_is_refused(content, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="not a checkpoint"):
        sd.minimise(waves, Y0, TARGET, key=KEY, solver=ADAM, max_steps=2, checkpoint=path)
    assert path.read_bytes() == content


# bad input, and the bar


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"solver": optx.BFGS(1e-3, 1e-3)}, TypeError, "such as NewtonCG"),
        ({"key": 0}, TypeError, r"jax\.random\.key\(0\)"),
        ({"key": None}, ValueError, r"jax\.random\.key\(0\)"),
        ({"fun": lambda y, args: y}, TypeError, "one real number"),
        ({"fun": lambda y, args: jnp.any(y > 0)}, TypeError, "one real number"),
        (
            {"y0": {"a": 1.0, "b": np.array([[1, np.nan]])}},
            ValueError,
            r"y0\['b'\]\[0, 1\] = nan is",
        ),
        ({"y0": -np.inf}, ValueError, "y0 = -inf is not finite"),
        ({"bounds": (1.0, 2.0)}, ValueError, "outside its bounds"),
        ({"bounds": (1.0, -1.0)}, ValueError, "above"),
        ({"solver": sd.FirstOrder(optax.sgd(0.1), -0.1)}, ValueError, "positive"),
        ({"solver": sd.FirstOrder(optax.sgd(0.1), {"a": 0.1})}, ValueError, "structure"),
    ],
)
def test_bad_input_is_refused_before_any_evaluation(change, error, match, host):
    call = {"fun": host_plateaus, "y0": Y0, "args": NO_EDGE, "key": KEY, "solver": ADAM, **change}
    with pytest.raises(error, match=match):
        sd.minimise(**call)
    assert host.count == 0


@pytest.mark.parametrize("solver", [None, ADAM], ids=["points", "batches"])
def test_a_count_is_a_loss_like_any_other(solver):
    count = lambda y, args: jnp.sum(jnp.abs(y[None] - 0.5) > jnp.arange(8)[:, None] / 16)
    result = sd.minimise(count, Y0, key=KEY, solver=solver, max_steps=3)
    assert result.fun == int(count(result.y, None)) < int(count(Y0, None))


def test_the_bar_shows_only_when_asked_for(capsys):
    run = functools.partial(sd.minimise, waves, Y0, TARGET, key=KEY, solver=ADAM, max_steps=3)
    run()
    assert capsys.readouterr() == ("", "")
    run(progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "3/3" in err
    assert f"{3 * N} evaluations" in err


def test_the_bar_says_that_it_compiles(capsys):
    """At the first step, and where a search point by point has its first local one."""
    run = functools.partial(sd.minimise, waves, Y0, TARGET, key=KEY, progress=True)
    run(solver=ADAM, max_steps=3)
    assert capsys.readouterr().err.count("compiling") == 1
    run(solver=sd.NewtonCG(0.3), max_steps=8)
    err = capsys.readouterr().err
    assert err.count("compiling") == 2
    assert "compiling" not in err.split("\r")[-1]
