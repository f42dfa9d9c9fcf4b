"""Spaces: there and back, never out of the range, every whole number as likely, by value."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._checkpoint import Checkpoint
from smoothdiff._unit_space import UnitSpace

# each space with an axis of three, and unit coordinates that it is asked for
SPACES = {
    "range": (sd.Range(-3.0, 0.1), (0, 1)),
    "offset": (sd.Range(999.0, 1001.0), (0, 1)),
    "ranges": (sd.Range([0.0, -1.0, 5.0], 7.0), (0, 1)),
    "log": (sd.Range(1e-5, 0.1, log=True), (0, 1)),
    "widest log": (sd.Range(2e-38, 3e38, log=True), (0, 1)),
    "logs": (sd.Range([1e-3, 0.7, 1.0], [1e3, 0.9, 1e20], log=True), (0, 1)),
    "positive": (sd.Positive(3.0), (-30, 30)),
    "positives": (sd.Positive([1e-30, 1.0, 1e30]), (-5, 5)),
    "real": (sd.Real(1e-4), (-1e3, 1e3)),
    "reals": (sd.Real([1e-20, 1.0, 1e20]), (-1e3, 1e3)),
}
CONTINUOUS = pytest.mark.parametrize("name", SPACES)


def asked(ends, dtype, rows=400):
    """Unit coordinates of three parameters at random, the ends among them."""
    low, high = ends
    u = np.random.default_rng(0).uniform(low, high, (rows, 3))
    return np.concatenate([u, [[low] * 3, [high] * 3]]).astype(dtype)


def slope(space, y):
    """How fast natural values change with unit coordinates."""
    match space:
        case sd.Range(low=low, high=high, log=True):
            return y * (np.log(high) - np.log(low))
        case sd.Range(low=low, high=high):
            return np.subtract(high, low)
        case sd.Positive():
            return y
        case _:
            return np.asarray(space.scale)


@CONTINUOUS
def test_there_and_back(name, dtype):
    space, ends = SPACES[name]
    u = asked(ends, dtype)
    y = jax.jit(space.to_natural)(u)
    again = jax.jit(space.to_unit)(y)
    back = jax.jit(space.to_natural)(again)
    assert y.dtype == again.dtype == dtype
    # either is rounded to its dtype, which the slope turns into an error of the other
    eps = float(jnp.finfo(dtype).eps)
    u, y, again, back = (np.asarray(x, float) for x in (u, y, again, back))
    unit_error = 4 * eps * (1 + np.abs(u) + np.abs(y) / slope(space, y))
    np.testing.assert_array_less(np.abs(again - u), unit_error)
    np.testing.assert_array_less(np.abs(back - y), slope(space, y) * unit_error)
    if isinstance(space, sd.Range):
        np.testing.assert_array_equal(again[-2:], u[-2:])  # the ends exactly


@CONTINUOUS
def test_no_value_leaves_the_range(name, dtype):
    space, ends = SPACES[name]
    beyond = asked((ends[0] - 500, ends[1] + 500), dtype)
    near = np.nextafter(np.asarray(ends, dtype)[:, None], beyond[:1])
    y = np.asarray(jax.jit(space.to_natural)(np.concatenate([beyond, asked(ends, dtype), near])))
    assert np.all(np.isfinite(y))
    if isinstance(space, sd.Range):
        assert np.all(y >= np.asarray(space.low, dtype))
        assert np.all(y <= np.asarray(space.high, dtype))
    if isinstance(space, sd.Positive):
        assert np.all(y > 0)


@pytest.mark.parametrize("name", ["range", "ranges", "log", "logs", "widest log"])
def test_ends_are_exact_and_order_is_kept(name, dtype):
    space, _ = SPACES[name]
    u = np.broadcast_to(np.linspace(0, 1, 1001, dtype=dtype)[:, None], (1001, 3))
    y = np.asarray(jax.jit(space.to_natural)(u))
    np.testing.assert_array_equal(y[0], np.broadcast_to(np.asarray(space.low, dtype), 3))
    np.testing.assert_array_equal(y[-1], np.broadcast_to(np.asarray(space.high, dtype), 3))
    assert np.all(np.diff(y, axis=0) >= 0)
    outside = np.stack([y[0] - 1, y[-1] * dtype.type(1.01) + 1])
    clipped = np.asarray(jax.jit(space.to_unit)(outside))
    np.testing.assert_array_equal(np.clip(clipped, 0, 1), clipped)


def test_scales_are_what_they_say():
    np.testing.assert_allclose(sd.Range(10, 20).to_natural(0.25), 12.5)
    np.testing.assert_allclose(sd.Range(1e-4, 1, log=True).to_natural(0.25), 1e-3, rtol=1e-6)
    np.testing.assert_allclose(sd.Positive(5.0).to_natural(math.log(3)), 15, rtol=1e-6)
    assert sd.Positive(5.0).to_natural(0.0) == 5
    np.testing.assert_allclose(sd.Positive().to_unit(math.e), 1, rtol=1e-6)
    assert sd.Real(4.0).to_unit(6.0) == 1.5


def test_positive_neither_overflows_nor_vanishes_on_the_way(dtype):
    # either factor alone is beyond the dtype
    high, low = (80, 1e-30) if dtype == "float32" else (600, 1e-250)
    for scale, u in ((low, 2 * high), (1 / low, -2 * high)):
        y = sd.Positive(scale).to_natural(jnp.asarray(u * 0.75, dtype))
        np.testing.assert_allclose(np.log(float(y)), math.log(scale) + u * 0.75, rtol=1e-5)
        np.testing.assert_allclose(sd.Positive(scale).to_unit(y), u * 0.75, rtol=1e-5)


def test_natural_values_survive_the_way_there_and_back(dtype):
    y = np.random.default_rng(1).uniform(2, 3, (300, 3)).astype(dtype)
    eps = float(jnp.finfo(dtype).eps)
    for space in (sd.Range(2, 3), sd.Range(2, 3, log=True), sd.Positive(2.5), sd.Real(0.3)):
        back = jax.jit(space.to_natural)(jax.jit(space.to_unit)(y))
        np.testing.assert_allclose(back, y, rtol=4 * eps)


@pytest.mark.parametrize("ends", [(0, 1), (-3, 4), (1, 1000), (10**9, 10**9 + 9)])
def test_whole_numbers_are_equally_likely(ends, dtype):
    space, (low, high) = sd.Integer(*ends), ends
    count = high - low + 1
    cells = 64
    u = jnp.asarray((np.arange(cells * count) + 0.5) / (cells * count), dtype)
    y = jax.jit(space.to_natural)(u)
    assert y.dtype == jnp.asarray(0).dtype
    seen, times = np.unique(y, return_counts=True)
    np.testing.assert_array_equal(seen, np.arange(low, high + 1))
    np.testing.assert_array_equal(times, cells)
    assert space.to_natural(0.0) == low
    assert space.to_natural(1.0) == high
    assert space.to_natural(-9.0) == low
    assert space.to_natural(9.0) == high


@pytest.mark.parametrize("kind", ["int8", "uint8", "int32", "float32"])
def test_every_whole_number_comes_back(kind):
    low, high = (0, 255) if kind == "uint8" else (-128, 127)
    space, y = sd.Integer(low, high), jnp.arange(low, high + 1).astype(kind)
    u = jax.jit(space.to_unit)(y)
    assert u.dtype == jnp.float32
    np.testing.assert_array_equal(jax.jit(space.to_natural)(u), np.asarray(y, int))
    # the middle of its own interval
    np.testing.assert_allclose(u, (np.arange(256) + 0.5) / 256, rtol=1e-6)
    np.testing.assert_allclose(space.to_axis(u), np.asarray(y, float), atol=1e-4)


def test_the_most_whole_numbers_that_a_dtype_tells_apart():
    most = 2**22
    space = UnitSpace.of(jnp.asarray(0.0), sd.Integer(1 - most, 0)).spaces[0]
    assert space is not None
    y = np.concatenate([np.arange(-9999, 1), np.arange(1 - most, 10_000 - most)])
    np.testing.assert_array_equal(jax.jit(space.to_natural)(jax.jit(space.to_unit)(y)), y)
    with pytest.raises(ValueError, match="too many for float32"):
        UnitSpace.of(jnp.asarray(0.0), sd.Integer(0, most))


@pytest.mark.parametrize("low", [0.0, -math.pi, 100.0])
def test_periodic_values_stay_within_one_period(low, dtype):
    space = sd.Periodic(low=low)
    near = np.concatenate([s * np.logspace(-300, 1, 200) for s in (-1, 1)])
    whole = np.round(np.random.default_rng(0).uniform(-99, 99, 400))
    u = jnp.asarray(np.concatenate([near, whole, whole - 1e-7, near + whole]), dtype)
    y = np.asarray(jax.jit(space.to_natural)(u))
    ends = np.asarray([low, low + 2 * math.pi], dtype)
    assert np.all(y >= ends[0])
    assert np.all(y < ends[1])


def test_periodic_goes_round_without_a_jump(dtype):
    space = sd.Periodic(360.0, low=-180.0)
    u = jnp.linspace(-3, 3, 5000, dtype=dtype)
    angle = np.deg2rad(np.asarray(space.to_natural(u), float))
    steps = np.hypot(np.diff(np.cos(angle)), np.diff(np.sin(angle)))
    np.testing.assert_allclose(steps, 2 * np.pi * 6 / 4999, rtol=1e-2)
    # any turn is the same value, and where a search starts is not moved
    assert space.to_unit(540.0) == 2.0
    np.testing.assert_allclose(space.to_natural(space.to_unit(190.0)), -170, rtol=1e-5)
    np.testing.assert_allclose(space.to_natural(space.to_unit(-100.0)), -100, rtol=1e-5)


@pytest.mark.parametrize("count", [2, 3, 4, 50])
def test_within_a_default_width_a_whole_number_has_neighbours(count):
    space = sd.Integer(1, count)
    for start in (1, count):
        u = space.to_unit(start)
        ends = jnp.clip(jnp.asarray([u - space.width(), u + space.width()]), 0, 1)
        assert np.any(space.to_natural(ends) != start)


def test_default_widths():
    assert sd.Range(3, 9).width() == 0.2
    assert sd.Range(1, 9, log=True).width(0.4) == 0.4
    assert sd.Real(7).width(0.4) == 0.2  # has no range
    assert sd.Periodic().width(0.4) == 0.1
    assert sd.Positive().width(0.4) == math.log(2)
    assert sd.Integer(0, 99).width() == 0.2
    assert sd.Integer(0, 1).width() == 0.5  # an interval
    np.testing.assert_array_equal(sd.Integer(0, [1, 99]).width(0.2), [0.5, 0.2])
    np.testing.assert_array_equal(sd.Integer(0, [1, 99]).width(0.4), [0.5, 0.4])
    assert sd.Range(0, 1, sigma=[0.1, 0.3]).width(0.4) == (0.1, 0.3)


Y0 = {"at": jnp.array([0.5, 2.0]), "count": 3, "mass": [jnp.array(2.0), None], "free": 7}
LOOK = {
    "at": sd.Range(0, [1, 4], label=["x (m)", "y (m)"]),
    "count": sd.Integer(0, 5, label="layers"),
    "mass": sd.Positive(),
    "free": None,
}


def test_a_pytree_of_spaces():
    space = UnitSpace.of(Y0, LOOK)
    u = space.unit(Y0)
    assert jax.tree.structure(u) == jax.tree.structure(Y0)
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(u))
    np.testing.assert_allclose(u["at"], [0.5, 0.5])
    np.testing.assert_allclose(u["count"], 3.5 / 6)
    assert u["mass"][0] == 0  # its own start is the scale
    assert u["free"] == 7
    y = space.natural(u)
    assert eqx.tree_equal(jax.tree.map(float, jax.tree.leaves(y)[2:]), [7.0, 2.0])
    assert y["count"].dtype == jnp.asarray(3).dtype
    np.testing.assert_allclose(y["at"], Y0["at"])
    bounds = space.bounds()
    assert bounds is not None
    inf = math.inf
    assert bounds[0] == {"at": 0, "count": 0, "mass": [-inf, None], "free": -inf}
    assert bounds[1] == {"at": 1, "count": 1, "mass": [inf, None], "free": inf}
    widths = space.sigma()
    assert widths["free"] is None
    assert widths["mass"] == [math.log(2), None]
    assert space.labels() == ["x (m)", "y (m)", "layers", "free", "mass.0"]


def test_one_space_for_all():
    space = UnitSpace.of({"a": jnp.zeros((2, 2)), "b": [0.5]}, sd.Range(-1, 1))
    u = space.unit({"a": jnp.zeros((2, 2)), "b": [0.5]})
    np.testing.assert_allclose(u["a"], 0.5)
    np.testing.assert_allclose(u["b"][0], 0.75)
    assert space.labels() == ["a[0, 0]", "a[0, 1]", "a[1, 0]", "a[1, 1]", "b.0"]
    alone = UnitSpace.of(0.5, sd.Range(0, 1))
    assert alone.labels() == ["y"]
    assert alone.natural(jnp.asarray(0.25)) == 0.25
    nothing = UnitSpace.of(Y0, None)
    assert nothing.bounds() is None
    assert eqx.tree_equal(nothing.natural(Y0), Y0)
    assert UnitSpace.of(Y0["at"], sd.Real([1, 2])).bounds() is None


def test_the_function_sees_natural_values_under_jit_and_vmap():
    table = jnp.arange(6.0) ** 2

    def fun(y, args):
        return table[y["count"]] + jnp.sum(y["at"]) * args + y["mass"][0] + y["free"]

    space = UnitSpace.of(Y0, LOOK)
    wrapped = space.wrap(fun)
    u = space.unit(Y0)
    value = fun(jax.tree.map(jnp.asarray, Y0) | {"free": 7.0}, 10.0)
    np.testing.assert_allclose(wrapped(u, 10.0), value, rtol=1e-6)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), u)
    values = jax.jit(jax.vmap(lambda u: wrapped(u, jnp.asarray(10.0))))(many)
    np.testing.assert_allclose(values, [value] * 4, rtol=1e-6)


def test_black_boxes_get_integers():
    out = jax.ShapeDtypeStruct((), jnp.float32)
    names = ["zero", "one", "two"]
    box = sd.black_box(lambda y: np.float32(len(names[y[0]])), out)
    space = UnitSpace.of(np.array([2]), sd.Integer(0, 2))
    assert float(space.wrap(lambda y, _: box(y))(jnp.array([0.5]))) == 3


@pytest.mark.parametrize("start", ["uint8", "int32", "float32"])
def test_integers_have_the_dtype_of_the_start(start):
    space = UnitSpace.of(np.array([1, 2], start), sd.Integer(0, 200))
    seen = jax.jit(space.natural)(jnp.array([0.0, 1.0]))
    assert seen.dtype == ("int32" if start == "float32" else start)
    np.testing.assert_array_equal(seen, [0, 200])


def test_equal_by_value():
    again = {
        "at": sd.Range(0.0, np.array([1.0, 4.0]), label=("x (m)", "y (m)")),
        "count": sd.Integer(0.0, jnp.asarray(5), label="layers"),
        "mass": sd.Positive(None),
        "free": None,
    }
    one, two = UnitSpace.of(Y0, LOOK), UnitSpace.of(Y0, again)
    assert one == two
    assert hash(one) == hash(two)
    assert one != UnitSpace.of(Y0, LOOK | {"count": sd.Integer(0, 6, label="layers")})
    assert sd.Range(0, 1) == sd.Range(0.0, 1.0)
    assert sd.Range(0, 1) != sd.Range(0, 1, sigma=0.2)  # the default depends on the solver
    assert sd.Range(1, 2) != sd.Range(1, 2, log=True)
    fun = lambda y, args: jnp.sum(y["at"])
    assert one.wrap(fun) == two.wrap(fun)
    assert hash(one.wrap(fun)) == hash(two.wrap(fun))


def test_equal_functions_compile_once():
    traced = []

    def fun(y, args):
        traced.append(y)
        return jnp.sum(y)

    call = eqx.filter_jit(lambda wrapped, u: wrapped(u))
    for _ in range(3):
        space = UnitSpace.of(jnp.zeros(2), sd.Range(-1, [1, 2]))
        call(space.wrap(fun), jnp.zeros(2))
    assert len(traced) == 1
    call(UnitSpace.of(jnp.zeros(2), sd.Range(-1, [1, 3])).wrap(fun), jnp.zeros(2))
    assert len(traced) == 2


def test_a_checkpoint_knows_its_space(tmp_path):
    fun = lambda y, args: jnp.sum(y)
    kept = lambda space: Checkpoint(tmp_path / "run", fun=UnitSpace.of(1.0, space).wrap(fun))
    kept(sd.Range(0, 2)).save({"a": jnp.zeros(2)})
    assert kept(sd.Range(0, 2)).load({"a": jnp.ones(2)}) is not None
    for other in (sd.Range(0, 2.5), sd.Range(0, 2, sigma=0.1), sd.Positive()):
        with pytest.raises(ValueError, match=r"its fun\.space\.spaces"):
            kept(other).load({"a": jnp.ones(2)})


@pytest.mark.slow
def test_solvers_can_search_in_unit_coordinates():
    """What the host loop does with a space."""
    y0 = {"n": 2, "gain": 1e-3}
    space = UnitSpace.of(y0, {"n": sd.Integer(0, 9), "gain": sd.Range(1e-6, 1e6, log=True)})

    def fun(y, args):
        return (y["n"].astype(float) - 7) ** 2 / 20 + jnp.abs(jnp.log(y["gain"]) - 5)

    solver = sd.NewtonCG(space.sigma())
    found = []
    for seed in range(5):
        result = sd.minimise(
            space.wrap(fun),
            space.unit(y0),
            key=jax.random.key(seed),
            solver=solver,
            bounds=space.bounds(),
            max_evaluations=300,
        )
        y = space.natural(result.y)
        np.testing.assert_allclose(np.log(y["gain"]), 5, atol=0.1)
        found.append(int(y["n"]))
    # where it looks is by chance
    assert found.count(7) >= 4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sd.Range(1, 0), "low = 1.0 of Range must be below high = 0.0"),
        (lambda: sd.Range(1, 1), "must be below"),
        (lambda: sd.Range([0, 2], [1, 2]), "must be below"),
        (lambda: sd.Range([0, 1], [1, 2, 3]), "shapes"),
        (lambda: sd.Range(0, 1, log=True), "low = 0.0 .* least value that matters"),
        (lambda: sd.Range(0, math.inf), "high = inf .* Real and Positive"),
        (lambda: sd.Range(math.nan, 1), "low = nan of Range must be finite"),
        (lambda: sd.Range("a", 1), "must be a real number"),
        (lambda: sd.Range(0, 1j), "must be a real number"),
        (lambda: sd.Range(0, 1, sigma=0), "sigma = 0 of Range must be positive"),
        (lambda: sd.Range(0, 1, sigma=math.nan), "sigma = nan"),
        (lambda: sd.Integer(0, 2.5), "high = 2.5 of Integer must be a whole number"),
        (lambda: sd.Integer(0, 2**60), "below 2"),
        (lambda: sd.Integer(3, 3), "low = 3 of Integer must be below high = 3"),
        (lambda: sd.Integer(0, math.inf), "large enough"),
        (lambda: sd.Positive(0.0), "scale = 0.0 of Positive must be positive"),
        (lambda: sd.Real(-1), "scale = -1 of Real must be positive"),
        (lambda: sd.Periodic(0.0), "period = 0.0 of Periodic must be positive"),
        (lambda: sd.Periodic(low=math.nan), "low = nan of Periodic must be finite"),
    ],
)
def test_what_is_no_space(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("y0", "space", "message"),
    [
        ({"a": 2.0}, sd.Range(0, 1), r"the parameter\['a'\] = 2.0 lies outside its range \[0.0, 1"),
        ({"a": -1}, sd.Integer(0, 3), r"\['a'\] = -1 lies outside its range \[0, 3\]"),
        ({"a": 1.5}, {"a": sd.Integer(0, 3)}, r"\['a'\] = 1.5 is not a whole number: round it"),
        (0.0, sd.Positive(), "= 0.0 is not positive: start above zero"),
        ([1.0, np.nan], sd.Real(1), r"the parameter\[1\] = nan is not finite"),
        (np.ones(3), sd.Real([1, 2]), r"scale of Real has shape \(2,\).*\(3,\)"),
        (np.ones(3), sd.Range(0, 2, sigma=[1, 2]), "sigma of Range has shape"),
        (np.ones(3), sd.Range(0, 2, label=["a", "b"]), "label of Range has shape"),
        (1.0, sd.Range(1, 1 + 1e-9), "too narrow or too wide for float32"),
        (1.0, sd.Range(-3e38, 3e38), "too narrow or too wide for float32"),
        (1.0, sd.Range(1e-50, 1, log=True), "too narrow or too wide for float32"),
        (1.0, sd.Real(1e-50), "scale = 1e-50 of the parameter is beyond float32"),
        (1.0, sd.Range(0, 1, sigma=1e-50), "sigma = 1e-50 of the parameter is beyond"),
        (np.uint8(1), sd.Integer(0, 300), "too large for uint8"),
        (1.0, sd.Integer(0, 2**40), "too many"),
        ({"a": 1.0, "b": 1.0}, {"a": sd.Range(0, 1)}, "structure of the parameters"),
        (1.0, (0, 1), "one space, such as Range"),
    ],
)
def test_a_start_that_does_not_fit(y0, space, message):
    with pytest.raises(ValueError, match=message):
        UnitSpace.of(y0, space)


def test_what_is_no_space_for_parameters():
    with pytest.raises(TypeError, match=r"space has 1 in it: write a space"):
        UnitSpace.of([0.0, 0.0], [sd.Range(0, 1), 1])
    with pytest.raises(TypeError, match="is complex"):
        UnitSpace.of({"a": 1j}, sd.Real(1))


def test_a_traced_start():
    space = sd.Range(0, 1)
    assert jax.jit(lambda y: UnitSpace.of(y, space).unit(y))(jnp.asarray(0.25)) == 0.25
    with pytest.raises(ValueError, match="is traced"):
        jax.jit(lambda y: UnitSpace.of(y, sd.Positive()).unit(y))(jnp.asarray(0.25))
    unit = jax.jit(lambda y: UnitSpace.of(y, sd.Positive(0.5)).unit(y))(jnp.asarray(0.5))
    np.testing.assert_allclose(unit, 0, atol=3e-7)
