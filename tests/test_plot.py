"""Plots: the right numbers in the lines, without pyplot where axes are given."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import smoothdiff as sd

matplotlib.use("Agg")

NAN = float("nan")


def result(fun, estimates=None, errors=None, answer=0.5, smoothed=NAN, error=NAN):
    unknown = [NAN] * len(fun)
    rows = zip(fun, estimates or unknown, errors or unknown, strict=True)
    history = [
        sd.Record(i, 10 * i, 0.5 * i, *row, 0.1, np.zeros(2)) for i, row in enumerate(rows, start=1)
    ]
    numbers = answer, smoothed, error, 99
    return sd.Result(jnp.zeros(2), *numbers, "converged", history, solver=None, state=None)


POINTS = result([3.0, 1.0, 1.0, 0.5])
BATCHES = result([2.5, 0.5, 0.5], [3.0, 1.0, 2.0], [0.1, 0.2, 0.3], smoothed=1.5, error=0.4)


@pytest.fixture
def ax():
    return Figure().subplots()


@pytest.fixture
def pyplot():
    import matplotlib.pyplot as plt

    yield plt
    plt.close("all")


def lines(ax):
    return {line.get_label(): line for line in ax.get_lines()}


def edges(ax):
    """The corners of the band."""
    return np.concatenate([path.vertices for path in ax.collections[0].get_paths()])


def test_history_of_values_is_the_lowest_so_far(ax):
    assert sd.plot.history(POINTS, ax=ax) is ax
    assert set(lines(ax)) == {"lowest so far", "answer"}
    x, y = lines(ax)["lowest so far"].get_data()
    np.testing.assert_allclose(x, [10, 20, 30, 40, 99])
    np.testing.assert_allclose(y, [3, 1, 1, 0.5, 0.5])
    assert lines(ax)["answer"].get_data() == ([99.0], [0.5])
    assert ax.get_xlabel() == "evaluations"


def test_history_of_batches_is_smoothed_with_a_band(ax):
    sd.plot.history(BATCHES, ax=ax)
    assert set(lines(ax)) == {"smoothed", "lowest so far", "answer"}
    np.testing.assert_allclose(lines(ax)["lowest so far"].get_ydata(), [2.5, 0.5, 0.5, 0.5])
    x, y = lines(ax)["smoothed"].get_data()
    np.testing.assert_allclose(x, [10, 20, 30, 99])
    np.testing.assert_allclose(y, [3, 1, 2, 1.5])
    band = edges(ax)
    for at, low, high in ((10, 2.804, 3.196), (99, 0.716, 2.284)):
        there = band[np.isclose(band[:, 0], at), 1]
        np.testing.assert_allclose((there.min(), there.max()), (low, high))


def test_history_leaves_out_what_is_not_known(ax):
    found = result([np.inf, 2.0, 1.0], [NAN, 3.0, 2.0], [NAN, 0.1, NAN])
    sd.plot.history(found, ax=ax)
    np.testing.assert_allclose(lines(ax)["smoothed"].get_data(), [[20], [3]])
    np.testing.assert_allclose(lines(ax)["lowest so far"].get_data(), [[20, 30, 99], [2, 1, 1]])


def test_history_against_seconds(ax):
    sd.plot.history(POINTS, ax=ax, against="seconds")
    np.testing.assert_allclose(lines(ax)["lowest so far"].get_xdata(), [0.5, 1, 1.5, 2, 2])
    assert ax.get_xlabel() == "time (s)"


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ([3.0, 2.0], "linear"),  # less than a factor of ten
        ([3.0, 0.01], "log"),
        ([3.0, 0.01, 0.0], "log"),
        ([3.0, -0.01], "linear"),
        ([0.0, 0.0], "linear"),
    ],
)
def test_history_is_logarithmic_where_that_helps(ax, values, scale):
    sd.plot.history(result(values, answer=values[-1]), ax=ax)
    assert ax.get_yscale() == scale
    ax.figure.canvas.draw()


@pytest.mark.slow
def test_history_of_a_run(pyplot):
    fun = lambda y, args: jnp.sum((y - 0.3) ** 2) + 0.001
    found = sd.minimise(
        fun, jnp.ones(2), key=jax.random.key(0), solver=sd.NewtonCG(0.1), max_evaluations=40
    )
    ax = sd.plot.history(found)  # new axes
    assert ax.figure in map(pyplot.figure, pyplot.get_fignums())
    np.testing.assert_allclose(lines(ax)["lowest so far"].get_ydata()[-1], found.fun, rtol=1e-5)


def test_what_history_refuses(ax):
    with pytest.raises(ValueError, match="no step"):
        sd.plot.history(result([]), ax=ax)


LOOK = {
    "count": sd.Integer(0, 4, label="layers"),
    "gain": sd.Range(1e-2, 1e2, log=True, label="gain (dB)"),
    "turn": sd.Periodic(label="angle (rad)"),
    "xy": sd.Real(0.5),
}
AT = {"count": 1, "gain": 1.0, "turn": 1.0, "xy": jnp.array([0.3, -0.2])}


def curved(y, args):
    """Quadratic in everything that a space searches, so that the smoothed one is known."""
    x = y["xy"]
    return (
        (y["count"].astype(float) - 2) ** 2
        + jnp.log(y["gain"]) ** 2
        + 1
        - jnp.cos(y["turn"])
        + args * x[0] ** 2
        + 3 * x[1] ** 2
    )


def test_a_slice_has_the_function_and_the_smoothed_one(ax):
    fun = lambda y, args: jnp.sum(jnp.array([1.0, 3.0]) * y**2) + args
    y, sigma = jnp.array([0.5, -1.0]), 0.2
    key = jax.random.key(0)
    got = sd.plot.slice(fun, y, 7.0, sigma=sigma, key=key, parameter=1, points=12, ax=ax)
    assert got is ax
    assert ax.get_xlabel() == "y[1]"
    x, f = lines(ax)["function"].get_data()
    assert len(x) == 12
    np.testing.assert_allclose((x.min(), x.max()), (-1.8, -0.2), rtol=1e-6)
    np.testing.assert_allclose(f, 0.25 + 3 * x**2 + 7, rtol=1e-5)
    at, smoothed = lines(ax)["smoothed"].get_data()
    np.testing.assert_array_equal(at, x)
    # a quadratic is smoothed by the sum of its curvatures
    # and stays within 95 % intervals, times 1.5
    band = edges(ax)
    error = np.ptp(band[np.isclose(band[:, 0], x[3]), 1]) / 2
    np.testing.assert_allclose(smoothed, f + 4 * sigma**2, atol=1.5 * error + 1e-5)
    assert 0 < error < 0.1
    here = lines(ax)["here"].get_data()
    np.testing.assert_allclose(np.ravel(here), [-1.0, 0.25 + 3 + 7], rtol=1e-6)


@pytest.mark.slow
def test_slices_of_all_parameters_in_their_spaces():
    axes = Figure().subplots(1, 5)
    key = jax.random.key(0)
    got = sd.plot.slice(curved, AT, 2.0, key=key, space=LOOK, points=9, num_samples=32, ax=axes)
    assert list(got) == list(axes)
    names = ["layers", "gain (dB)", "angle (rad)", "xy[0]", "xy[1]"]
    assert [axis.get_xlabel() for axis in axes] == names
    assert [axis.get_xscale() for axis in axes] == ["linear", "log", *["linear"] * 3]
    x = [lines(axis)["function"].get_xdata() for axis in axes]
    np.testing.assert_allclose(x[0], np.arange(5), atol=1e-5)  # each whole number once
    np.testing.assert_allclose(x[1][[0, -1]], [1e-2, 1e2])
    np.testing.assert_allclose(x[2][[0, -1]], [0, 2 * np.pi], rtol=1e-6)
    np.testing.assert_allclose(x[3][[0, -1]], [0.3 - 4 * 0.1, 0.3 + 4 * 0.1], rtol=1e-5)
    here = float(curved(jax.tree.map(jnp.asarray, AT), 2.0))
    changes = [
        (x[0] - 2) ** 2 - 1,
        np.log(x[1]) ** 2,
        np.cos(1) - np.cos(x[2]),
        2 * (x[3] ** 2 - 0.09),
        3 * (x[4] ** 2 - 0.04),
    ]
    for axis, change in zip(axes, changes, strict=True):
        np.testing.assert_allclose(lines(axis)["function"].get_ydata(), here + change, rtol=1e-4)
        np.testing.assert_allclose(lines(axis)["here"].get_ydata(), [here], rtol=1e-5)
    axes[0].figure.canvas.draw()


def test_more_whole_numbers_than_points(ax):
    fun = lambda y, args: y.astype(float) ** 2
    key = jax.random.key(0)
    sd.plot.slice(fun, 40, key=key, space=sd.Integer(0, 99), parameter=0, points=11, ax=ax)
    x, f = lines(ax)["function"].get_data()
    np.testing.assert_allclose((x[0], x[-1]), (-0.5, 99.5), atol=1e-4)
    off = np.abs(np.sqrt(f) - x)
    assert np.all(off <= 0.5 + 1e-4)
    np.testing.assert_allclose(np.ravel(lines(ax)["here"].get_data()), [40, 1600], rtol=1e-5)


def test_a_slice_through_whole_numbers_without_a_space_is_of_floats(ax):
    """As `minimise` takes such a start."""
    fun = lambda y, args: jnp.sum((y - 1.5) ** 2)
    key = jax.random.key(0)
    sd.plot.slice(fun, np.array([2, 1]), sigma=0.25, key=key, parameter=0, points=5, ax=ax)
    x, f = lines(ax)["function"].get_data()
    np.testing.assert_allclose(x, [1.0, 5 / 3, 2.0, 7 / 3, 3.0], rtol=1e-5)
    np.testing.assert_allclose(f, (x - 1.5) ** 2 + 0.25, rtol=1e-5)


def test_an_angle_is_shown_in_the_period_that_it_is_in(ax):
    fun = lambda y, args: jnp.cos(y)
    key, angle = jax.random.key(0), 7.0
    sd.plot.slice(fun, angle, key=key, space=sd.Periodic(), parameter=0, points=5, ax=ax)
    x, f = lines(ax)["function"].get_data()
    np.testing.assert_allclose(x[[0, -1]], [2 * np.pi, 4 * np.pi], rtol=1e-5)
    np.testing.assert_allclose(f, np.cos(x), atol=1e-5)
    assert np.any(np.isclose(x, angle))


def test_parameters_without_a_width_are_left_out(pyplot):
    fun = lambda y, args: y["a"] ** 2 + y["b"]
    y = {"a": 1.0, "b": 2.0}
    key = jax.random.key(0)
    axes = sd.plot.slice(fun, y, sigma={"a": 0.1, "b": None}, key=key, points=4, num_samples=8)
    assert [axis.get_xlabel() for axis in axes] == ["a"]
    with pytest.raises(ValueError, match="b is not smoothed"):
        sd.plot.slice(fun, y, sigma={"a": 0.1, "b": None}, key=key, parameter="b")


def test_a_grid_of_new_axes(pyplot):
    fun = lambda y, args: jnp.sum(y**2)
    axes = sd.plot.slice(
        fun, jnp.ones(5), sigma=0.1, key=jax.random.key(0), points=4, num_samples=8
    )
    assert len(axes) == 5
    assert len(axes[0].figure.axes) == 8  # two rows of four, three of them hidden
    assert sum(axis.get_visible() for axis in axes[0].figure.axes) == 5
    assert axes[0].get_shared_y_axes().joined(axes[0], axes[4])


def test_a_black_box_is_called_as_often_as_is_said(ax):
    calls = []

    def host(y):
        calls.append(y)
        return np.float32(np.floor(y).sum())

    box = sd.black_box(host, jax.ShapeDtypeStruct((), jnp.float32))
    key = jax.random.key(0)
    fun = lambda y, args: box(y)
    sd.plot.slice(fun, 0.5, sigma=0.3, key=key, parameter=0, points=5, num_samples=8, ax=ax)
    assert len(calls) == 5 * (8 + 1)


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (ValueError, r"no parameter 2: the parameters are y\[0\], y\[1\]", {"parameter": 2}),
        (ValueError, "no parameter 'mass'", {"parameter": "mass"}),
        (ValueError, "no parameter 0.5", {"parameter": 0.5}),
        (ValueError, "1 labels for 2 parameters", {"labels": ["x"]}),
        (ValueError, "give sigma=", {"sigma": None}),
        (ValueError, "points=2", {"points": 2}),
        (ValueError, "lies outside its range", {"space": sd.Range(-1, 0.5)}),
        (ValueError, "1 axes for 2 parameters", {"ax": [None]}),
    ],
)
def test_what_a_slice_refuses(error, message, options):
    fun = lambda y, args: jnp.sum(y)
    with pytest.raises(error, match=message):
        sd.plot.slice(fun, jnp.ones(2), **{"sigma": 0.1, "key": jax.random.key(0)} | options)


def test_a_slice_of_a_count(ax):
    count = lambda y, args: jnp.sum(y > 0.5)
    sd.plot.slice(
        count, jnp.ones(2), sigma=0.1, key=jax.random.key(0), parameter=0, points=5, ax=ax
    )
    function = ax.get_lines()[1]
    np.testing.assert_array_equal(
        function.get_ydata(), [1 + (x > 0.5) for x in function.get_xdata()]
    )


def test_a_slice_of_no_number_or_of_too_many():
    key = jax.random.key(0)
    words = r"fun returned shape \(2,\) and dtype float32; it must return one number"
    with pytest.raises(TypeError, match=words):
        sd.plot.slice(lambda y, args: y, jnp.ones(2), sigma=0.1, key=key)
    with pytest.raises(ValueError, match="too many for one figure"):
        sd.plot.slice(lambda y, args: jnp.sum(y), jnp.ones(99), sigma=0.1, key=key)


def test_errors_are_intervals(ax):
    values = {"drag": jnp.array([0.3, 1.2]), "lift": 0.9}
    stderrs = {"drag": jnp.array([0.02, 0.3]), "lift": NAN}
    assert sd.plot.errors(values, stderrs, ax=ax) is ax
    (points,) = ax.get_lines()
    np.testing.assert_allclose(points.get_data(), [[0.3, 1.2, 0.9], [0, 1, 2]], rtol=1e-6)
    assert [t.get_text() for t in ax.get_yticklabels()] == ["drag[0]", "drag[1]", "lift"]
    segments = ax.collections[0].get_segments()  # none for what is not known
    ends = [(row[0][0], row[1][0]) for row in segments]
    np.testing.assert_allclose(ends, [(0.2608, 0.3392), (0.612, 1.788)], rtol=1e-5)


def test_errors_with_labels_in_a_new_figure(pyplot):
    ax = sd.plot.errors(np.ones(2), np.ones(2), ["mass (kg)", "length (m)"])
    assert [t.get_text() for t in ax.get_yticklabels()] == ["mass (kg)", "length (m)"]
    assert len(pyplot.get_fignums()) == 1


@pytest.mark.slow
def test_errors_of_a_result(ax):
    data = jnp.arange(20.0) + jax.random.normal(jax.random.key(1), (20,))
    fun = lambda y, data: y["slope"] * jnp.arange(20.0) + y["offset"] - data
    found = sd.least_squares(
        fun,
        {"offset": 0.5, "slope": 0.5},
        data,
        key=jax.random.key(0),
        space={"offset": sd.Real(1.0, label="offset (mm)"), "slope": None},
        max_steps=20,
    )
    sd.plot.errors(found, ax=ax)
    assert [t.get_text() for t in ax.get_yticklabels()] == ["offset (mm)", "slope"]
    low, high = found.parameter_intervals()
    ends = [(row[0][0], row[1][0]) for row in ax.collections[0].get_segments()]
    np.testing.assert_allclose(ends, [(low[k], high[k]) for k in ("offset", "slope")], rtol=1e-6)
    with pytest.raises(ValueError, match="leave out stderrs"):
        sd.plot.errors(found, found.y, ax=ax)
    with pytest.raises(ValueError, match=r"only results of sd\.least_squares"):
        sd.plot.errors(POINTS, ax=ax)


def test_what_errors_refuses(ax):
    with pytest.raises(ValueError, match="1 standard errors for 2 values"):
        sd.plot.errors(np.ones(2), np.ones(1), ax=ax)
    with pytest.raises(ValueError, match="3 labels for 2 values"):
        sd.plot.errors(np.ones(2), np.ones(2), ["a", "b", "c"], ax=ax)


@pytest.mark.slow
def test_given_axes_need_no_pyplot():
    script = """
import sys, numpy as np, smoothdiff as sd
assert "matplotlib" not in sys.modules
from matplotlib.figure import Figure
sd.plot.errors(np.ones(2), np.ones(2), ax=Figure().subplots())
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_slice_with_leaves_of_two_dtypes(x64, ax):
    y = {"a": jnp.ones(2, jnp.float32), "b": jnp.asarray(2.0, jnp.float64)}
    fun = lambda y, args: jnp.sum(y["a"]).astype(jnp.float64) + y["b"] ** 2
    key = jax.random.key(0)
    sd.plot.slice(fun, y, sigma=0.1, key=key, parameter="b", points=5, num_samples=8, ax=ax)
    x, f = lines(ax)["function"].get_data()
    np.testing.assert_allclose(f, 2 + x**2)


@pytest.mark.parametrize(
    ("stderrs", "match"),
    [
        ({"c_drag": 1.0, "a_mass": 0.1}, "like the values"),
        ({"drag": 1.0, "mass": -0.1}, "negative"),
    ],
)
def test_errors_are_those_of_the_parameters(stderrs, match):
    axes = Figure().subplots()
    with pytest.raises(ValueError, match=match):
        sd.plot.errors({"drag": 10.0, "mass": 2.0}, stderrs, ax=axes)
