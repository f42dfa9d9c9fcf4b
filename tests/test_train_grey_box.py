"""Networks in front of a renderer: known optima, counting, what is saved, faults, bad input."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from smoothdiff._grey_cases import Known, Rendered, lessons_among, like, usual_range
from smoothdiff._grey_lessons import Lessons, mean_loss
from smoothdiff._grey_sensitivity import Moved, Sensitivity
from tests.parts import quick_of

DRAWING = np.array([[1.0, -2.0], [0.5, 0.3], [0.2, 0.4], [-1.0, 0.1]])
POSES = np.random.default_rng(1).normal(size=(16, 2))
ADAM = optax.adam(0.05)
EACH = 6 + 2  # renders of a search in a round, of two parameters
RENDERED = []


class Linear(eqx.Module):
    """A network without hidden layers, whose answer is a pytree."""

    weight: jax.Array
    name: str = "a field that is no array"

    def __call__(self, picture):
        said = self.weight @ picture.ravel()
        return {"x": said[0], "y": said[1:]}


def render(at):
    """Four pixels of two parameters, so that the exact network is the pseudoinverse."""
    drawing = jnp.asarray(DRAWING, at["x"].dtype)
    return (drawing @ jnp.append(at["x"], at["y"])).reshape(2, 2)


def watched(at):
    jax.debug.callback(lambda x: RENDERED.append(float(x)), at["x"])
    return render(at)


def fails(at):
    """In a corner of its parameters, in which no picture is."""
    bad = at["x"] > np.max(POSES[:, 0]) + 0.1
    return jnp.where(bad, jnp.nan, watched(at))


def train(render=render, dtype: Any = np.float32, **rest):
    pictures = (POSES @ DRAWING.T).reshape(-1, 2, 2).astype(dtype)
    usual: dict[str, Any] = {"key": jax.random.key(0), "sigma": 0.5, "optim": ADAM, "lessons": 16}
    call: dict[str, Any] = usual | {"max_evaluations": 16 * 2 * EACH * 5, "kept": 1024} | rest
    return sd.train_grey_box(Linear(jnp.zeros((2, 4), dtype)), render, pictures, **call)


def loss(model):
    """Of the network, on poses that it was not trained on."""
    poses = np.random.default_rng(2).normal(size=(64, 2))
    said = np.asarray(poses @ DRAWING.T, np.float32) @ np.asarray(model.weight, np.float32).T
    return np.mean((said @ DRAWING.T - poses @ DRAWING.T) ** 2)


@pytest.mark.slow
def test_a_network_is_trained_without_labels():
    records = []
    result = train(callback=lambda record: records.append(record))
    assert loss(result.model) < 1e-2 * loss(Linear(jnp.zeros((2, 4))))
    assert result.model.name == "a field that is no array"
    assert (result.reason, result.evaluations) == ("max_evaluations", 5 * 16 * 2 * EACH)
    # the searches know more than the network
    found = np.column_stack([result.parameters["x"], result.parameters["y"]])
    np.testing.assert_allclose(found, POSES, atol=1e-3)
    assert result.losses.shape == (16,)
    assert np.max(result.losses) < 1e-6
    assert [r.evaluations for r in records] == [k * 16 * 2 * EACH for k in range(1, 6)]
    np.testing.assert_array_equal(records[-1].model.weight, result.model.weight)
    assert [r.model for r in result.history] == [None] * 5
    # the first is that of the network as it came, which says zero of all
    assert records[0].fun == pytest.approx(np.mean((POSES @ DRAWING.T) ** 2), rel=1e-5)
    assert records[-1].fun < 0.1 * records[0].fun


@pytest.mark.slow
@pytest.mark.parametrize("parts", [{"kept": 0}, {"new_parameters": False}])
def test_each_part_can_be_left_out(parts):
    RENDERED.clear()
    result = train(watched, max_evaluations=16 * EACH * 5, **parts)
    jax.effects_barrier()
    assert result.evaluations == len(RENDERED) == 16 * EACH * 5
    assert loss(result.model) < 0.1 * loss(Linear(jnp.zeros((2, 4))))


@pytest.mark.slow
def test_cases_learn_from_each_other_and_not_from_renders_that_failed():
    """One case has a step at a time, and the others see what was rendered for it."""
    RENDERED.clear()
    result = train(fails, cases=1, kept=64, max_evaluations=2 * EACH * 16)
    jax.effects_barrier()
    assert np.max(RENDERED) > np.max(POSES[:, 0]) + 0.1
    assert result.evaluations == 2 * EACH * 16
    assert np.isfinite(result.model.weight).all()
    assert np.isfinite(result.losses).all()
    alone = train(fails, cases=1, kept=0, max_evaluations=EACH * 8)
    assert np.isfinite(alone.losses).sum() == 8


@pytest.mark.slow
def test_float64(x64):
    result = train(dtype=np.float64, max_evaluations=16 * 2 * EACH * 2)
    assert result.model.weight.dtype == np.float64
    assert result.parameters["y"].dtype == np.float64
    # in two rounds most cases are solved, to more digits than float32 has
    assert np.median(result.losses) < 1e-20


@pytest.mark.slow
def test_a_sigma_for_each_parameter_and_a_target():
    result = train(sigma={"x": 0.3, "y": np.array([0.8])}, target=0.5, max_evaluations=4096)
    assert result.reason == "target"
    assert result.fun <= 0.5
    assert result.history[-2].fun > 0.5


@pytest.mark.slow
def test_a_training_that_was_killed_is_taken_up(tmp_path):
    path = tmp_path / "grey.npz"
    whole = train()

    class StopHereError(Exception):
        pass

    def kill(record):
        if record.round == 2:
            raise StopHereError

    with pytest.raises(StopHereError):
        train(checkpoint=path, callback=kill)
    rounds = []
    resumed = train(checkpoint=path, callback=lambda record: rounds.append(record.round))
    assert rounds == [3, 4, 5]
    np.testing.assert_array_equal(resumed.model.weight, whole.model.weight)
    np.testing.assert_array_equal(resumed.losses, whole.losses)
    assert resumed.history[0].fun == whole.history[0].fun
    with pytest.raises(ValueError, match=r"another problem: its [\w, ]*\bsigma\b"):
        train(checkpoint=path, sigma=0.4)
    with pytest.raises(ValueError, match=r"another problem: its [\w, ]*\bsettings\b"):
        train(checkpoint=path, kept=0)
    with np.load(path) as file:
        parts = dict(file)
    del parts[max(parts, key=lambda name: name.isdigit() and int(name))]
    np.savez(path, **parts)
    with pytest.raises(ValueError, match="written by another version"):
        train(checkpoint=path)


@pytest.mark.slow
def test_a_callback_and_ctrl_c_end_it_with_what_there_is():
    result = train(callback=lambda record: record.round == 2)
    assert (result.reason, len(result.history)) == ("callback", 2)
    assert train(max_seconds=0.0).reason == "max_seconds"

    def interrupt(record):
        raise KeyboardInterrupt

    result = train(callback=interrupt)
    assert (result.reason, result.evaluations) == ("interrupted", 16 * 2 * EACH)


@pytest.mark.slow
def test_a_black_box_that_breaks_loses_nothing(tmp_path):
    calls = []

    def host(x, y):
        calls.append(1)
        if len(calls) > 16 * 2 * EACH:
            raise OSError("no more licences")
        return (DRAWING @ np.append(x, y)).reshape(2, 2).astype(np.float32)

    box = sd.black_box(host, jax.ShapeDtypeStruct((2, 2), np.float32))
    with pytest.raises(sd.GreyBoxError, match="no more licences") as error:
        train(lambda at: box(at["x"], at["y"]), checkpoint=tmp_path / "grey.npz")
    assert isinstance(error.value.__cause__, OSError)
    assert error.value.result.evaluations == 16 * 2 * EACH
    assert np.isfinite(error.value.result.losses).all()
    assert (tmp_path / "grey.npz").exists()


@pytest.mark.parametrize("parts", quick_of([{"kept": 64}, {"kept": 0}], [{"kept": 64}]))
def test_a_renderer_that_always_fails_ends_the_training(parts, tmp_path):
    """In the first round, before all renders are spent, and nothing of it is kept."""
    nothing = lambda at: jnp.full((2, 2), jnp.nan, at["x"].dtype)
    path = tmp_path / "grey.npz"
    with pytest.raises(sd.GreyBoxError, match="no render of the first round was finite") as error:
        train(nothing, checkpoint=path, **parts)
    assert error.value.result.reason == "failed"
    assert error.value.result.history == []
    assert not path.exists()


def test_the_loss_of_no_known_case_is_infinite():
    best, loss = jnp.zeros((3, 1)), jnp.array([1.0, jnp.inf, 3.0])
    assert mean_loss(Known(best, loss, best, None)) == 2
    assert mean_loss(Known(best, jnp.full(3, jnp.inf), best, None)) == jnp.inf


def test_new_parameters_are_spread_like_those_found(key):
    scale = np.array([1.0, 20.0, 0.0], np.float32)
    found = scale * np.asarray(jax.random.uniform(key, (256, 3))) + 5
    draw = jax.jit(lambda key, found: like(key, found, (40, 50)))
    new = np.asarray(draw(jax.random.key(1), found)).reshape(-1, 3)
    assert (new >= found.min(0)[None]).all()
    assert (new <= found.max(0)[None]).all()
    np.testing.assert_allclose(new.std(0), found.std(0), rtol=0.15)
    # hardly any is one of those found
    assert len(np.unique(new[:, 0])) > 1500


def test_the_last_renders_are_kept_and_those_within_the_range_count():
    @jax.jit
    def run():
        first = Rendered(jnp.full((3, 1), jnp.nan), jnp.full((3, 2), jnp.nan))
        rendered = first.after(jnp.array([[1.0], [5.0]]), jnp.ones((2, 2)))
        rendered = rendered.after(jnp.array([[2.0]]), jnp.array([[1.0, jnp.nan]]))
        within = rendered.within(jnp.array([[0.0], [3.0]]))
        return rendered, within, rendered.after(jnp.arange(5.0)[:, None], jnp.ones((5, 2)))

    rendered, within, more = run()
    np.testing.assert_array_equal(np.ravel(rendered.points), [1.0, 5.0, 2.0])
    np.testing.assert_array_equal(within, [True, False, False])
    np.testing.assert_array_equal(np.ravel(more.points), [2.0, 3.0, 4.0])


@pytest.mark.parametrize("cases", [1, 2, 19, 40, 256])
def test_the_range_leaves_out_a_few_that_lie_apart(cases):
    bulk = np.linspace([-1.0, 5.0], [1.0, 6.0], cases)
    low, high = jax.jit(usual_range)(jnp.asarray(bulk))
    np.testing.assert_allclose([low, high], [bulk.min(0), bulk.max(0)])
    # half of the pictures may be elsewhere
    two = np.where(np.arange(cases)[:, None] % 2, bulk + 10, bulk)
    np.testing.assert_allclose(usual_range(jnp.asarray(two))[1], two.max(0), rtol=1e-6)
    apart = bulk.copy()
    apart[: cases // 20, 0] += 7
    apart[cases // 2 : cases // 2 + cases // 20, 1] -= 7
    low, high = usual_range(jnp.asarray(apart))
    assert high[0] == pytest.approx(bulk[:, 0].max())
    assert low[1] == pytest.approx(bulk[:, 1].min())


def test_without_renders_all_cases_teach():
    """Where one had a turn it is far from the others, which are as the untrained network is."""
    best = jnp.zeros((40, 2)).at[0].set(5.0)
    known = Known(best, jnp.full(40, jnp.inf).at[0].set(1.0), best, None)
    nothing = Rendered(jnp.zeros((0, 2)), jnp.zeros((0, 3)))
    assert np.all(lessons_among(known, nothing))
    some = Rendered(jnp.array([[0.0, 0.0], [5.0, 5.0]]), jnp.zeros((2, 3)))
    found = lessons_among(known, some)
    np.testing.assert_array_equal(found, [False, *[True] * 39, True, False])


def test_one_parameter_is_moved_by_the_usual_error(key):
    points = jnp.arange(24.0).reshape(8, 3)
    error = np.random.default_rng(3).normal(size=(8, 3)) * [1.0, 2.0, 0.5]
    moved = jax.jit(Moved.of)(key, points, points + error)
    off = np.asarray(moved.points - points)
    assert np.all(np.count_nonzero(off, axis=1) == 1)
    assert set(np.bincount(moved.entry)) <= {2, 3}
    at = np.arange(8), np.asarray(moved.entry)
    usual = np.sqrt(np.mean(error**2, axis=0))
    np.testing.assert_allclose(moved.distance, usual[at[1]], rtol=1e-5)
    np.testing.assert_allclose(off[at], np.sign(error[at]) * usual[at[1]], rtol=1e-4)


def test_what_failed_is_no_lesson(key):
    """Nor what lies outside the range, which has no share either."""
    pictures, best = jnp.arange(12.0).reshape(3, 2, 2), jnp.arange(3.0)[:, None]
    lessons = Lessons(lambda weights, picture: picture[0], pictures, ADAM)
    nothing = Rendered(jnp.full((5, 1), jnp.nan), jnp.full((5, 2, 2), jnp.nan))
    share = jnp.array([1.0, 0, 1, *[0] * 5])
    inputs, targets = lessons._drawn(key, best, nothing, share)
    case = np.asarray(targets[:, 0], int)
    assert set(case) == {0, 2}
    np.testing.assert_array_equal(inputs, pictures[case])


@pytest.mark.slow
def test_pictures_in_float32_of_a_renderer_in_float64(x64):
    def narrow(weight, picture):
        assert weight.dtype == picture.dtype == np.float32
        return weight @ picture.ravel()

    class Narrow(Linear):
        def __call__(self, picture):
            said = narrow(self.weight, picture)
            return {"x": said[0], "y": said[1:]}

    pictures = (POSES @ DRAWING.T).reshape(-1, 2, 2).astype(np.float32)
    with jax.numpy_dtype_promotion("standard"):
        result = sd.train_grey_box(
            Narrow(jnp.zeros((2, 4), np.float32)),
            lambda at: render(jax.tree.map(lambda leaf: leaf.astype(float), at)),
            pictures,
            key=jax.random.key(0),
            sigma=0.5,
            optim=ADAM,
            max_evaluations=16 * 2 * EACH * 2,
        )
    assert result.model.weight.dtype == np.float32
    assert np.all(np.asarray(result.state.sensitivity.pairs) > 0)


def test_parameters_count_as_the_root_of_what_pictures_change(dtype):
    """Of a picture that is 10 x and y and an edge at z, by hand; failed and unknown ones do not."""
    sensitivity = Sensitivity.start(jnp.zeros(3, dtype))
    np.testing.assert_array_equal(sensitivity.counts(), [1, 1, 1])
    edge = 0.01  # it moves by that, and so many pixels change by one
    moved = Moved(jnp.zeros((6, 3)), jnp.arange(6) % 3, jnp.array([0.1, 0.2, edge] * 2, dtype))
    change = jnp.array([(10 * 0.1) ** 2, 0.2**2, edge] * 2, dtype)
    for _ in range(40):
        sensitivity = sensitivity.after(moved, change)
    weights = np.asarray(sensitivity.counts())
    assert weights.dtype == dtype
    assert np.mean(weights) == pytest.approx(1)
    # the root of what is shrunk towards each other, by two pairs to ten
    expected = np.sqrt((np.array([100.0, 1.0, 100.0]) * 10 + 2 * 67) / 12)
    np.testing.assert_allclose(weights, expected / np.mean(expected), rtol=1e-3)
    unknown = Moved(moved.points, moved.entry, jnp.array([jnp.nan, 0, 0.1, jnp.inf] * 2, dtype)[:6])
    after = sensitivity.after(unknown, jnp.array([1.0, 1.0, jnp.nan] * 2, dtype))
    before = np.asarray([sensitivity.total, sensitivity.pairs])
    np.testing.assert_allclose([after.total, after.pairs], 0.8 * before, rtol=1e-6)
    # what a parameter counts has a lower limit
    sensitivity = Sensitivity(jnp.array([1e4, 0.0]), jnp.array([1e4, 1e4]))
    root = np.sqrt([2, 0.01])
    np.testing.assert_allclose(sensitivity.counts(), root / np.mean(root), rtol=1e-3)


@pytest.mark.slow
def test_a_training_finds_how_much_pictures_change():
    scale = np.array([4.0, 1.0], np.float32)
    result = train(lambda at: render({"x": scale[0] * at["x"], "y": scale[1] * at["y"]}))
    # of four pixels, each parameter alone
    expected = scale**2 * np.mean(DRAWING**2, axis=0)
    weights = result.state.sensitivity.counts()
    pairs = np.asarray(result.state.sensitivity.pairs)
    expected = (pairs * expected + 2 * np.average(expected, weights=pairs)) / (pairs + 2)
    expected = np.sqrt(expected)
    np.testing.assert_allclose(weights, expected / np.mean(expected), rtol=1e-2)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, bool])
def test_renders_of_whole_numbers_are_compared_as_floats(dtype):
    """Residuals in their dtype would wrap around."""
    whole = lambda at: (40 * render(at) + 100 > 110).astype(dtype)
    at = {"x": jnp.asarray(POSES[:, 0], jnp.float32), "y": jnp.asarray(POSES[:, 1:], jnp.float32)}
    pictures = jax.vmap(whole)(at).astype(jnp.float32)
    model = Linear(jnp.zeros((2, 4), np.float32))
    found = sd.train_grey_box(
        model, whole, pictures, key=jax.random.key(0), sigma=0.5, max_evaluations=2560, lessons=2
    )
    shown = jax.vmap(whole)(found.parameters).astype(jnp.float32)
    losses = jnp.mean((shown - pictures) ** 2, axis=(1, 2))
    np.testing.assert_allclose(losses, found.losses, atol=1e-6)


def test_bad_arguments():
    for name in ("max_evaluations", "lessons", "cases"):
        with pytest.raises(ValueError, match=f"{name}=0"):
            train(**{name: 0})
    with pytest.raises(TypeError, match="max_evaluations must be a whole number"):
        train(max_evaluations=1500.5)
    with pytest.raises(TypeError, match=r"sd\.black_box"):
        train(lambda at: np.asarray(at["x"]) * np.ones((2, 2)))
    with pytest.raises(ValueError, match="kept=-1"):
        train(kept=-1)
    with pytest.raises(ValueError, match="no room for a round, which takes 256 renders"):
        train(max_evaluations=100)
    with pytest.raises(ValueError, match="both must be alike"):
        train(lambda at: render(at)[0])
    with pytest.raises(ValueError, match="sigma for every parameter"):
        train(sigma={"x": 0.5, "y": None})
    with pytest.raises(ValueError, match="sigma"):
        train(sigma=0.0)
    model, call = Linear(jnp.zeros((2, 4))), {"key": jax.random.key(0), "sigma": 0.5}
    begin = functools.partial(sd.train_grey_box, max_evaluations=9, **call)
    with pytest.raises(TypeError):
        begin(jnp.zeros((2, 4)), render, np.zeros((3, 2, 2), np.float32))  # pyright: ignore
    with pytest.raises(ValueError, match="first axis counts the cases"):
        begin(model, render, np.zeros((0, 2, 2), np.float32))
    with pytest.raises(ValueError, match="not finite"):
        begin(model, render, np.full((3, 2, 2), np.nan, np.float32))
    with pytest.raises(TypeError, match="astype"):
        begin(model, render, np.zeros((3, 2, 2), int))
    with pytest.raises(TypeError, match="key"):
        begin(model, render, np.zeros((3, 2, 2), np.float32), key=0)
