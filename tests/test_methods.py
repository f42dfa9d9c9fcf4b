"""The methods of the benchmarks: each makes progress, stays within bounds, and is counted right."""

import dataclasses
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks import _harness, methods
from benchmarks._task import Budget, NotAble, Task, precision_of
from benchmarks.methods import _published
from benchmarks.methods._flat import Flat
from benchmarks.methods.adaptive_differences import _noise
from benchmarks.methods.nonlinear_cg import _move, _turn
from benchmarks.methods.quasi_newton import Dense, Limited

REFERENCE = np.array([0.7, -0.4])
LOW, HIGH = -1.0, 1.0
MATRIX = np.array([[10.0, 7.5], [7.5, 10.0]])  # eigenvalues 2.5 and 17.5

# the budget, what must be left of the loss at its end, and the evaluations of the first iteration
EXPECTED = {
    "cma_es": (600, 1e-6, 6),
    "evosax_snes": (600, 1e-3, 6),
    "nelder_mead": (200, 1e-6, 1),
    "powell": (200, 1e-3, 1),
    "py_bobyqa": (200, 1e-6, 1),
    "annealing": (600, 1e-2, 1),
    "genetic_algorithm": (600, 1e-2, 99),
    "spsa": (600, 1e-2, 5 * 2),
    "first_order": (600, 1e-2, 8),
    "zerograds": (600, 1e-2, 2),
    "optax_perturbations": (600, 1e-2, 4),
    # the slope that sets the unit, then the value and the gradient of the first step
    "optimistix_bfgs": (200, 1e-6, 4 + 1 + 4),
    "jaxopt_lbfgs": (1600, 1e-2, None),
    "our_gradient": (2000, 1e-2, 4 * 2),
    # the first gradient, some steps of a gradient and a product each, the gradient at their end
    "our_h": (2000, 0.5, 4 * 2 + 2 * (4 * 2 + 4 * 3) + 4 * 2),
    "our_hvp": (2000, 0.3, 4 * 2 + 2 * (4 * 2 + 2 * 4 * 2) + 4 * 2),
    "our_hvpa": (2000, 0.3, 12 + 3 * (12 + 2 * 12) + 12),
    # without safeguards it need not converge: only bounds and counts are asked of it
    "newton": (500, math.inf, 4 * 2 + 4 * 3),
    "newton_modified": (2000, 0.5, 4 * 2 + 4 * 3),
    "bfgs": (2000, 0.1, 4 * 2),
    "lbfgs": (2000, 0.1, 4 * 2),
    "bfgs_wolfe": (2000, 0.1, None),
    "bfgs_damped": (2000, 0.1, 4 * 2),
    "bfgs_adaptive": (200, 1e-3, None),
}


@pytest.fixture(autouse=True)
def standard_promotion():
    """The competitors do not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def bowl(evaluations: int = 1000) -> tuple[Task, list[np.ndarray]]:
    """A quadratic on the host as a function of a pytree, and the points that it has seen."""
    seen = []

    def host(a, b):
        points = np.stack(np.broadcast_arrays(a, b[..., 0]), axis=-1)
        seen.extend(points.reshape(-1, 2))
        away = points - REFERENCE
        return (0.5 * np.einsum("...i,ij,...j", away, MATRIX, away)).astype(a.dtype)

    def loss(y):
        out = jax.ShapeDtypeStruct((), y["a"].dtype)
        return jax.pure_callback(host, out, y["a"], y["b"], vmap_method="broadcast_all")

    def exact(y):
        away = jnp.stack([y["a"], y["b"][0]]) - REFERENCE
        return 0.5 * away @ MATRIX @ away

    tree = lambda a, b: {"a": jnp.asarray(a, float), "b": jnp.asarray([b], float)}
    side = lambda bound: {"a": jnp.asarray(bound), "b": jnp.asarray(bound)}
    return Task(
        name="bowl",
        title="A bowl",
        loss=loss,
        exact_loss=exact,
        start=lambda seed: tree(-0.8, 0.9),
        reference=tree(*REFERENCE),
        bounds=(side(LOW), side(HIGH)),
        sigma=0.5,
        budget=Budget(evaluations, 60),
        seeds=1,
    ), seen


@pytest.mark.parametrize("name", EXPECTED)
def test_progress_bounds_and_counts(name):
    evaluations, left, first = EXPECTED[name]
    task, seen = bowl(evaluations)
    counter = _harness.Counter()
    watched = _harness._watched(task, counter)
    # GPL, so it is no part of the extra for tests; a method of any other package has to run
    if name == "py_bobyqa":
        pytest.importorskip("pybobyqa", reason='needs pip install -e ".[peers]"')
    solve = methods.load(name).prepare(watched)
    run = _harness._solve(watched, solve, 0, counter, task.exact_loss)
    assert run["image_error"][-1] <= left
    assert counter.evaluations == len(seen)
    assert np.all((np.stack(seen) >= LOW) & (np.stack(seen) <= HIGH))
    assert np.all((np.asarray(run["found"]) >= LOW) & (np.asarray(run["found"]) <= HIGH))
    if first is not None:
        assert run["evaluations"][1] == first


def stairs(evaluations: int) -> Task:
    """Many parameters, each with a valley of its own in steps, and a wrong one at its far end."""
    reference = {"a": jnp.linspace(0.2, 0.8, 120), "b": jnp.full((2, 3), 0.3)}
    vector = lambda y: ravel_pytree(y)[0]

    def terms(y):
        away = jnp.abs(vector(y) - vector(reference))
        return jnp.floor(100 * jnp.where(away > 0.6, 1.2 - away, away)) ** 2

    return Task(
        name="stairs",
        title="Stairs",
        loss=lambda y: terms(y).sum(),
        exact_loss=lambda y: terms(y).sum(),
        start=lambda seed: jax.tree.map(
            lambda leaf: jax.random.uniform(jax.random.key(seed), leaf.shape), reference
        ),
        reference=reference,
        bounds=({"a": jnp.array(0.0), "b": jnp.array(0.0)}, jax.tree.map(jnp.ones_like, reference)),
        sigma=0.1,
        budget=Budget(evaluations, 60),
        seeds=1,
        terms=terms,
        residuals=lambda y: jnp.sqrt(terms(y)),
        support=vector,
    )


@pytest.mark.parametrize(
    ("name", "evaluations", "left", "batch"),
    [
        ("local_cross_entropy", 320, 1e-3, 32),
        ("local_gradient", 480, 0.02, 8),
        ("local_first_order", 480, 0.2, 8),
        ("cma_es_diagonal", 2000, 0.2, 18),
    ],
)
def test_many_parameters(name, evaluations, left, batch):
    task = stairs(evaluations)
    counter = _harness.Counter()
    watched = _harness._watched(task, counter)
    solve = methods.load(name).prepare(watched)
    run = _harness._solve(watched, solve, 0, counter, task.exact_loss)
    assert run["image_error"][-1] <= left
    assert run["evaluations"][1] == batch
    assert evaluations <= run["evaluations"][-1] < evaluations + batch
    found = np.asarray(run["found"])
    assert np.all((found >= 0) & (found <= 1))


def test_local_gauss_newton():
    task = stairs(480)
    solve = methods.load("local_gauss_newton").prepare(task)
    run = _harness._solve(task, solve, 0, _harness.Counter(), task.exact_loss)
    assert run["ended"] == "by the method"
    assert run["image_error"][-1] <= 0.2


@pytest.mark.parametrize(
    "name",
    [
        *("local_cross_entropy", "local_gradient", "local_first_order", "local_gauss_newton"),
        "cma_es_diagonal",
    ],
)
def test_methods_for_many_parameters_say_what_they_need(name):
    with pytest.raises(NotAble, match=r"parameters or more|local support"):
        methods.load(name).prepare(bowl()[0])


def test_lists_of_methods_name_methods():
    for chosen in (methods.QUICK, methods.MANY_PARAMETERS, methods.PROGRAMS):
        assert set(chosen) <= set(methods.METHODS)


@pytest.mark.parametrize("name", ["cma_es", "optimistix_bfgs", "newton"])
def test_double_precision(name):
    def record(y):
        assert {leaf.dtype for leaf in jax.tree.leaves(y)} == {np.dtype("float64")}
        raise _harness.Stop("by the budget")

    with precision_of(dataclasses.replace(bowl()[0], precision="float64")):
        task, seen = bowl()
        with pytest.raises(_harness.Stop, match="budget"):
            methods.load(name).prepare(task)(task.start(0), jax.random.key(0), record)
    assert seen[0].dtype == np.float64


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("cma_es", "cma"),
        ("evosax_snes", "evosax.algorithms"),
        ("genetic_algorithm", "pygad"),
        ("py_bobyqa", "pybobyqa"),
        ("jaxopt_lbfgs", "jaxopt"),
    ],
)
def test_a_missing_package_is_named(name, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(NotAble, match="pip install"):
        methods.load(name).prepare(bowl()[0])


def test_every_method_is_found_and_covered():
    titles = [methods.load(name).title for name in methods.METHODS]
    assert len(set(titles)) == len(titles)
    assert set(EXPECTED) <= set(methods.METHODS)


def test_a_method_is_stale_only_when_what_it_imports_has_changed():
    source = {name: methods.load(name).source for name in ("our_h", "bfgs_adaptive", "fr22")}
    assert "Table 3 of Stochastic" in source["our_h"]
    assert "Powell's damping" in source["bfgs_adaptive"]
    assert "Powell's damping" not in source["our_h"]
    assert "def optimiser" in source["fr22"]
    assert "class Flat" not in source["fr22"]


def test_sampled_products_have_the_units_of_the_hessian(monkeypatch, key):
    monkeypatch.setattr(_published, "PER_ELEMENT", 4096)
    monkeypatch.setattr(_published, "AGGREGATE", 8192)
    flat = Flat(bowl()[0])
    v = jnp.array([0.3, -2.0])
    x = jnp.array([0.1, 0.0])  # far from the bounds, in units of sigma
    for aggregate in (False, True):
        found = _published.product(flat, aggregate=aggregate).call(key, 0.1, x, v)
        assert found == pytest.approx(MATRIX @ np.asarray(v), rel=0.1)


def test_conjugate_steps_find_the_minimum_of_a_quadratic_in_as_many_steps_as_dimensions():
    x = jnp.array([-0.8, 0.9])
    gradient = lambda x: jnp.asarray(MATRIX, jnp.float32) @ (x - jnp.asarray(REFERENCE, x.dtype))
    r = v = -gradient(x)
    for _ in range(2):
        x, _ = _move(x, v, gradient(x), jnp.asarray(MATRIX, x.dtype) @ v, 100.0, -10.0, 10.0)
        new = -gradient(x)
        r, v = new, _turn(r, v, new, False)
    assert x == pytest.approx(REFERENCE, abs=1e-5)


def test_without_curvature_the_step_goes_downhill_to_the_edge_of_the_trust_region():
    x, v = jnp.zeros(2), jnp.array([3.0, 4.0])
    for g, way in ((-v, 1), (v, -1)):
        to, moved = _move(x, v, g, -v, 0.5, -1.0, 1.0)
        assert to == pytest.approx(way * 0.1 * np.asarray(v))
        assert moved == pytest.approx(0.5)
    to, moved = _move(x, v, -v, jnp.zeros(2), 10.0, -1.0, 1.0)
    assert to == pytest.approx([1.0, 1.0])  # the bounds


@pytest.mark.parametrize("model", [Dense(2.0, 2, damped=False), Limited(2.0)])
def test_quasi_newton_models_fulfil_the_secant_equation(model):
    for s in np.array([[1.0, 0.2], [-0.3, 0.8]]):
        model.learn(s, MATRIX @ s)
        assert model.newton(MATRIX @ s) == pytest.approx(-s)
        model.learn(s, -MATRIX @ s)  # no curvature: left out
        assert model.newton(MATRIX @ s) == pytest.approx(-s)


def test_damping_keeps_the_matrix_positive_definite():
    model = Dense(2.0, 2, damped=True)
    s = np.array([1.0, 0.2])
    before = -model.newton(s)
    model.learn(s, -MATRIX @ s)
    assert (-model.newton(s) != before).any()
    for g in (s, np.array([-0.2, 1.0])):
        assert model.newton(g) @ g < 0


def test_noise_is_told_from_slope_and_curvature():
    t = np.linspace(0, 0.01, 7)
    smooth = 3 + 2 * t + 5 * t**2
    noise = np.random.default_rng(0).normal(size=(50, 7))
    found = [_noise(smooth + 1e-3 * row) for row in noise]
    assert np.median(found) == pytest.approx(1e-3, rel=0.5)
    assert _noise(smooth) < 1e-12
    assert _noise(np.ones(7)) == 0
