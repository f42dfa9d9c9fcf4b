"""The methods of the benchmarks: each makes progress, stays within bounds, and is counted right."""

import contextlib
import json
import sys
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import smoothdiff as sd
from benchmarks import _registry, _study
from benchmarks._loop import Counter, Recorder, Stop
from benchmarks._task import Budget, Grey, Kind, NotAble, Problem
from benchmarks.methods import _host_loop, grey_box

START, REFERENCE = np.array([-0.8, 0.9]), np.array([0.7, -0.4])
LOW, HIGH = -1.0, 1.0
MATRIX = np.array([[10.0, 7.5], [7.5, 10.0]])  # eigenvalues 2.5 and 17.5

# the budget, what must be left of the loss at its end, and the evaluations of the first iteration
QUICK = {
    "cma_es": (300, 1e-3, 6),
    "nelder_mead": (200, 1e-6, 1),
    "py_bobyqa": (200, 1e-6, 1),
    "annealing": (600, 1e-2, 1),
    "mitsuba_ad": (200, 1e-2, 2),
    "finite_differences": (200, 1e-2, 2 * 2),
}
SLOW = {
    "spsa": (600, 1e-2, 5 * 2),
    "evosax_snes": (600, 1e-3, 6),
    "genetic_algorithm": (600, 1e-2, 99),
    "fr22": (600, 1e-2, 2),
    "first_order": (600, 1e-2, 8),
    "zerograds": (600, 1e-2, 2),
    "newton_cg": (200, 1e-6, 1),
    "gauss_newton": (60, 1e-6, 1),
    "optax_perturbations": (600, 1e-2, 4),
    # the slope that sets the unit, then the value and the gradient of the first step
    "optimistix_bfgs": (200, 1e-6, 4 + 1 + 4),
    "jaxopt_lbfgs": (1600, 1e-2, None),
    "shortest_call": (60, 1e-6, 1),
    "shortest_call_keys": (60, 1e-2, 1),
    "fr22_keys": (600, 1e-2, 2),
    "dfo_ls": (60, 1e-6, 1),
    "dfo_ls_noise": (60, 1e-6, 1),
    "least_squares": (60, 1e-6, 1),
    "fischer_fr22": (2000, 1e-2, 4),
    "wang_g": (2000, 1e-2, 4 * 2),
    # the first gradient, some steps of a gradient and a product each, the gradient at their end
    "wang_h": (2000, 0.3, 8 + 3 * (8 + 3 * 4) + 8),
    "wang_hvp": (2000, 0.3, 8 + 3 * (8 + 2 * 8) + 8),
    "wang_hvpa": (2000, 0.3, 4 + 3 * (4 + 2 * 4) + 4),
}
GPL = {"py_bobyqa": "pybobyqa", "dfo_ls": "dfols", "dfo_ls_noise": "dfols"}
# evaluations, what must be left, and the evaluations of an iteration
MANY = {
    "local_cross_entropy": (320, 1e-3, 32),
    "local_gradient": (480, 0.02, 8),
    "local_first_order": (480, 0.2, 8),
    "local_gauss_newton": (480, 0.2, 72),
    "cma_es_diagonal": (2000, 0.2, 18),
}
GREY = tuple(grey_box.METHODS)
HUGE = Problem(
    bounds=(np.zeros(200_000), np.ones(200_000)),
    sigma=0.1,
    budget=Budget(1000, 60),
    loss=jnp.sum,
)


@pytest.fixture(autouse=True)
def standard_promotion():
    """The competitors do not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def tree(a, b):
    return {"a": jnp.asarray(a, float), "b": jnp.asarray([b], float)}


def bowl(evaluations: int = 1000) -> tuple[Problem, list[np.ndarray]]:
    """A quadratic on the host as a function of a pytree, and the points that it has seen.

    With a key it has noise.
    """
    seen = []
    root = np.linalg.cholesky(MATRIX).T

    def host(a, b):
        points = np.stack(np.broadcast_arrays(a, b[..., 0]), axis=-1)
        seen.extend(points.reshape(-1, 2))
        return ((points - REFERENCE) @ root.T).astype(a.dtype)

    def residuals(y):
        out = jax.ShapeDtypeStruct((2,), y["a"].dtype)
        return jax.pure_callback(host, out, y["a"], y["b"], vmap_method="broadcast_all")

    def native(y):
        point = np.stack([y["a"], y["b"][0]])
        seen.extend([point, point])  # a gradient costs two
        return None, tree(*(MATRIX @ (point - REFERENCE)))

    return Problem(
        bounds=(tree(LOW, LOW), tree(HIGH, HIGH)),
        sigma=0.5,
        budget=Budget(evaluations, 600),
        residuals=residuals,
        keyed=lambda y, key: residuals(y) + 0.05 * jax.random.normal(key, (2,)),
        native_ad=lambda: native,
    ), seen


def stairs(evaluations: int) -> Problem:
    """Many parameters, each with a valley of its own in steps, and a wrong one at its far end."""
    reference = {"a": jnp.linspace(0.2, 0.8, 120), "b": jnp.full((2, 3), 0.3)}
    vector = lambda y: ravel_pytree(y)[0]

    def terms(y):
        away = jnp.abs(vector(y) - vector(reference))
        return jnp.floor(100 * jnp.where(away > 0.6, 1.2 - away, away)) ** 2

    return Problem(
        bounds=(jax.tree.map(jnp.zeros_like, reference), jax.tree.map(jnp.ones_like, reference)),
        sigma=0.1,
        budget=Budget(evaluations, 600),
        loss=lambda y: terms(y).sum(),
        residuals=lambda y: jnp.sqrt(terms(y)),
        terms=terms,
        support=vector,
    )


def linear_grey(evaluations: int = 8 * 4 * 150) -> Problem:
    """A network without hidden layers, which says what was drawn from pictures of four pixels."""
    drawing = jnp.array([[1.0, -2.0], [0.5, 0.3], [0.2, 0.4], [-1.0, 0.1]])
    pictures = jax.random.normal(jax.random.key(1), (16, 2)) @ drawing.T
    solved = jnp.linalg.pinv(drawing).ravel()
    render = lambda x: (drawing @ x).reshape(2, 2, 1)
    white = lambda y, case: y.reshape(2, 4) @ case.ravel()
    return Problem(
        bounds=(solved - 9, solved + 9),
        sigma=0.5,
        budget=Budget(evaluations, 600),
        grey=Grey(white, render, pictures.reshape(-1, 2, 2, 1), 0.5),
    )


def ran(name: str, problem: Problem, y0) -> tuple[list, list, Counter]:
    """Evaluations after each iteration, what was found in each, and the counter."""
    counter = Counter()
    solve = _registry.method(name).prepare(counter.watched(problem))
    recorder = Recorder(counter, y0, problem.budget)
    evaluations, found = [], []

    def record(y):
        evaluations.append(counter.evaluations)
        found.append(y)
        recorder(y)

    with contextlib.suppress(Stop):
        solve(y0, jax.random.key(0), record)
    return evaluations, found, counter


def test_the_registry_knows_every_method():
    ours = [name for name in _registry.methods() if name not in _registry.methods("descent")]
    assert set(ours) == {*QUICK, *SLOW, *MANY, *GREY, "grey_gauss_newton"}
    entries = {name: entry for name, (_, entry) in _registry._entries().items()}
    assert len({entry.title for entry in entries.values()}) == len(entries)
    for entry in entries.values():
        assert set(entry.kinds) <= set(get_args(Kind))
    for kind in get_args(Kind)[:-1]:
        assert len(_registry.methods(kind)) > 5, kind
    assert set(_registry.methods("network")) == {*GREY, "grey_gauss_newton"}


def test_committed_results_name_methods_by_their_titles():
    titles = {}
    for path in _study.COMMITTED.rglob("results.json"):
        for found in json.loads(path.read_text()).get("tasks", {}).values():
            methods = found.get("methods", {})  # descents have configurations
            titles |= {name: method["title"] for name, method in methods.items()}
    assert len(titles) > 25
    assert titles == {name: _registry.method(name).title for name in titles}


JUMPING = {"wang_h", "wang_hvp", "wang_hvpa"}


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_progress_bounds_and_counts(name):
    # GPL, so it is no part of the extra for tests; a method of any other package has to run
    if name in GPL:
        pytest.importorskip(GPL[name], reason='needs pip install -e ".[peers]"')
    budget, left, first = (QUICK | SLOW)[name]
    problem, seen = bowl(budget)
    evaluations, found, counter = ran(name, problem, tree(*START))
    points = np.array([[y["a"], y["b"][0]] for y in found])
    away = points - REFERENCE
    heights = np.einsum("ni,ij,nj->n", away, MATRIX, away)
    # a Hessian from as few pairs as published is now and then one of another sign, to the very end
    reached = np.min(heights) if name in JUMPING else heights[-1]
    assert reached <= left * (START - REFERENCE) @ MATRIX @ (START - REFERENCE)
    assert counter.evaluations == len(seen)
    if name != "finite_differences":  # which look beyond the bounds
        points = np.concatenate([points, seen])
    assert np.all((points >= LOW) & (points <= HIGH))
    if first is not None:
        assert evaluations[0] == first


def test_of_a_search_point_by_point_the_best_that_was_evaluated_is_shown():
    made = lambda y, smoothed: sd.Record(1, 1, 0.0, 3.0, smoothed, np.nan, 1.0, y, best=7.0)
    assert _host_loop._Best(0.0).after(made(1.0, np.nan)) == 7
    # of batches all iterates, until one is at the start again
    best, seen = _host_loop._Best(0.0), [(1, 5), (2, 6), (0, 9), (3, 7), (4, 4), (5, 8)]
    assert [best.after(made(*at)) for at in seen] == [1, 2, 2, 2, 4, 5]


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_many_parameters(name):
    budget, left, batch = MANY[name]
    problem = stairs(budget)
    y0 = jax.tree.map(lambda a: jax.random.uniform(jax.random.key(0), a.shape), problem.like)
    evaluations, found, _ = ran(name, problem, y0)
    assert problem.loss(found[-1]) <= left * problem.loss(y0)
    assert evaluations[0] == batch
    assert abs(evaluations[-1] - budget) < batch
    for leaf in jax.tree.leaves(found[-1]):
        assert np.all((leaf >= 0) & (leaf <= 1))


@pytest.mark.parametrize(
    ("name", "needs"),
    [
        *((name, r"parameters or more|local support") for name in MANY),
        *((name, "AD") for name in (*GREY, "grey_gauss_newton")),
        *(("gauss_newton", "residuals"), ("mitsuba_ad", "derivative")),
        *((name, "parameters") for name in ("cma_es", "newton_cg", "genetic_algorithm")),
        ("finite_differences", "400,000 evaluations"),
    ],
)
def test_a_method_says_what_it_needs(name, needs):
    problem = bowl()[0] if name in MANY else HUGE
    with pytest.raises(NotAble, match=needs):
        _registry.method(name).prepare(problem)


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
        _registry.method(name).prepare(bowl()[0])


@pytest.mark.parametrize(
    "name", ["cma_es", pytest.param("optimistix_bfgs", marks=pytest.mark.slow)]
)
def test_double_precision(name, x64):
    problem, seen = bowl(1)
    _, found, _ = ran(name, problem, tree(*START))
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype("float64")}
    assert seen[0].dtype == np.float64


def test_a_method_is_stale_only_when_what_it_imports_has_changed():
    source = {name: _registry.method(name).source for name in ("wang_hvpa", "zerograds")}
    assert "Wang-HVPA conjugate gradients" in source["wang_hvpa"]
    assert "class Flat" in source["wang_hvpa"]
    assert "def run_by" in source["zerograds"]
    assert "Wang-HVPA conjugate gradients" not in source["zerograds"]


def test_renders_are_counted_in_grey_boxes():
    counter = Counter()
    jax.block_until_ready(jax.jit(counter.watched(linear_grey()).loss)(jnp.zeros(8)))
    assert counter.evaluations == 16


@pytest.mark.slow
@pytest.mark.parametrize("name", GREY)
def test_grey_boxes_train_a_network(name, monkeypatch):
    monkeypatch.setattr(grey_box, "RATE", 0.05)
    problem = linear_grey()
    evaluations, found, _ = ran(name, problem, jnp.zeros(8))
    assert evaluations[0] in (8 * 2, 8 * 4)
    assert evaluations[-1] == len(evaluations) * evaluations[0]
    assert problem.loss(found[-1]) < 0.05 * problem.loss(jnp.zeros(8))


@pytest.mark.slow
def test_gauss_newton_finds_what_a_network_is_to_answer():
    problem = linear_grey()
    evaluations, found, counter = ran("grey_gauss_newton", problem, jnp.zeros(8))
    # all cases at once; a step of each, two to choose between the network and the solver, and as
    # many that are there to be learnt from
    assert evaluations[0] == 16 * 2 * (6 + 2)
    assert counter.evaluations <= problem.budget.evaluations
    assert problem.loss(found[-1]) < 0.1 * problem.loss(jnp.zeros(8))
