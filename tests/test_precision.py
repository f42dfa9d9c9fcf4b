"""Products are as precise as their dtype on every device, and the user's as the user has said.

A CPU does not care, so it is read from the programs: each product says how precise it has to be.
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff.surrogates import Quadratic

KEY = jax.random.key(0)
# an axis of this length is in the products of the user's function and in no others
MARK = 1013
EXACT = (jax.lax.Precision.HIGHEST,) * 2
# what computes no product itself
WITHOUT = "terms", "LocalCrossEntropy", "cross_bilateral", "bilateral", "laplacian"
PRODUCTS = "dot_general", "conv_general_dilated", "ragged_dot_general"
CUBE = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
GRID = np.ones((8, 8, 3), np.float32)
CORNERS = jnp.asarray(np.random.default_rng(0).standard_normal((4, 3)), jnp.float32)


def marked(y):
    """A number for each parameter, by a product with an axis of its own."""
    waves = jnp.sin(jnp.ones((MARK, y.size), y.dtype) @ y)
    return jnp.floor(4 * y) + waves[: y.size]


def loss(y, *args):
    return jnp.sum(marked(y) ** 2)


def residuals(y, args):
    return marked(y)


def products(jaxpr: Any) -> Iterator[Any]:
    """All products in a program, with those in what it calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in PRODUCTS:
            yield equation
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns")
        ):
            if hasattr(inner, "eqns"):
                yield from products(getattr(inner, "jaxpr", inner))


def precisions(fun: Any, *args: Any) -> tuple[list, list]:
    """Of the library's products, and of the user's."""
    found: tuple[list, list] = [], []
    for equation in products(eqx.filter_make_jaxpr(fun)(*args)[0].jaxpr):
        shapes = [shape for v in [*equation.invars, *equation.outvars] for shape in v.aval.shape]
        found[MARK in shapes].append(equation.params["precision"])
    return found


def expected(name: str) -> set:
    """All precisions of its products: one, or none where there are none."""
    return set() if name in WITHOUT else {EXACT}


LOOPS = {
    "while": lambda f: lambda y: jax.lax.while_loop(lambda y: jnp.sum(y) < 9, f, y),
    "cond": lambda f: lambda y: jax.lax.cond(jnp.sum(y) < 9, f, lambda y: y, y),
    "scan": lambda f: lambda y: jax.lax.scan(lambda y, _: (f(y), None), y, length=2)[0],
    "jit": jax.jit,
    "checkpoint": jax.checkpoint,
}


@pytest.mark.parametrize("inside", LOOPS)
def test_a_product_that_is_not_exact_is_seen(inside):
    """Wherever it is: the tests below mean nothing if it is not."""
    ours, theirs = precisions(LOOPS[inside](lambda y: jnp.eye(4) @ y), jnp.ones(4))
    assert (ours, theirs) == ([None], [])


def options(**chosen: Any) -> dict[str, Any]:
    return {"num_samples": 32, "sampler": sd.Gaussian(), "baseline": "mean"} | chosen


def model(key, y):
    found = sd.smooth_quadratic(loss, 0.1, **options())(key, y)
    return found(y), found.stderr, found.hessian_stderr(y), found.hessian.as_matrix()


LOCAL = sd.local_support(0, ndim=1)
GRADIENTS = {
    **{name: options(baseline=name) for name in ("none", "center", "linear", "quadratic", "gp")},
    "ridge": options(baseline="linear", num_samples=4),
    "ad": options(baseline="ad"),
    "error": options(stderr=True),
    "aggregate": options(sampler=sd.Aggregate(1)),
    "orthogonal": options(sampler=sd.Orthogonal()),
    "sobol": options(sampler=sd.Sobol()),
    "uniform": options(sampler=sd.Uniform()),
    "chunks": options(batch_size=8, nonfinite="drop"),
    "default": {},
}
TRANSFORMS = {
    **{f"grad, {n}": sd.smooth_grad(loss, 0.1, **given) for n, given in GRADIENTS.items()},
    "grad, importance": sd.Importance(1)(loss, 0.1, num_samples=32),
    "smooth": sd.smooth(marked, 0.1, **options()),
    "grad of smooth": lambda key, y: jax.grad(sd.smooth(loss, 0.1, **options()), 1)(key, y),
    "width": lambda key, y: jax.grad(lambda s: sd.smooth(loss, s, **options())(key, y))(0.1),
    "jacobian": sd.smooth_jacobian(marked, 0.1, **options()),
    "terms": sd.smooth_grad(marked, 0.1, support=LOCAL),
    "value and grad": sd.smooth_value_and_grad(loss, 0.1, **options()),
    "hessian": sd.smooth_hessian(loss, 0.1, **options(stderr=True)),
    "hessian, default": sd.smooth_hessian(loss, 0.1),
    "hessian, quadratic": sd.smooth_hessian(loss, 0.1, **options(baseline="quadratic")),
    "hvp": lambda key, y: sd.smooth_hvp(loss, 0.1, **options())(key, y, y),
    "quadratic": model,
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_of_transforms(name):
    ours, theirs = precisions(TRANSFORMS[name], KEY, jnp.zeros(4))
    assert set(ours) == expected(name)
    assert set(theirs) == {None}


ADAM = optax.adam(0.1)
# the solver, how many parameters, and of which function
SOLVERS = {
    "FirstOrder": (sd.FirstOrder(ADAM, 0.1), 4, loss),
    "ZeroGrads": (sd.ZeroGrads(0.1, surrogate=Quadratic), 4, loss),
    "ZeroGrads, newton_step": (
        sd.ZeroGrads(0.1, surrogate=Quadratic, optimizer=sd.newton_step(1.0)),
        4,
        loss,
    ),
    "NewtonCG": (sd.NewtonCG(0.1), 4, loss),
    "NewtonCG, restarts": (sd.NewtonCG(0.1, restarts=2), 4, loss),
    "NewtonCG, batches": (sd.NewtonCG(0.1), 101, loss),
    "NewtonCG, few in batches": (sd.NewtonCG(optax.constant_schedule(0.1)), 4, loss),
    "LocalCrossEntropy": (sd.LocalCrossEntropy(LOCAL, sigma=0.1), 4, residuals),
    "GaussNewton": (sd.GaussNewton(0.1), 4, residuals),
    "GaussNewton, batches": (sd.GaussNewton(0.1), 301, residuals),
    "GaussNewton, few in batches": (sd.GaussNewton(optax.constant_schedule(0.1)), 4, residuals),
    "LocalGaussNewton": (sd.LocalGaussNewton(0.1, LOCAL), 4, residuals),
}


@pytest.mark.parametrize("bounded", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SOLVERS)
def test_of_solvers(name, bounded):
    """From the first step to the judgement of what is returned."""
    solver, n, fun = SOLVERS[name]
    run = optx.minimise if isinstance(solver, optx.AbstractMinimiser) else optx.least_squares
    given = {"key": KEY} | ({"bounds": (-1.0, 1.0)} if bounded else {})
    solve = lambda y: run(fun, solver, y, options=given, max_steps=3, throw=False).value
    ours, theirs = precisions(solve, jnp.zeros(n))
    assert set(ours) == expected(name)
    assert set(theirs) == {None}


FILTERS = {
    "cross_bilateral": (sd.filters.cross_bilateral(0.1, 2, ndim=2), GRID, GRID),
    "bilateral": (sd.filters.bilateral(0.1, 2, ndim=2), GRID, GRID),
    "laplacian": (sd.filters.laplacian(2.0, ndim=2), GRID, GRID),
    "mesh_laplacian": (sd.filters.mesh_laplacian(CUBE, 2.0), CORNERS, CORNERS),
    "mesh_bilateral": (sd.filters.mesh_bilateral(CUBE, 2.0, 0.1, 0.1), CORNERS, CORNERS),
    "cotangents": (sd.filters.mesh_laplacian(CUBE, 2.0, weights="cotangent"), CORNERS, CORNERS),
}


@pytest.mark.parametrize("name", FILTERS)
def test_of_filters(name):
    function, signal, guide = FILTERS[name]
    back = lambda s, g: jax.grad(lambda s: jnp.sum(function(s, g) ** 2))(s)
    ours, _ = precisions(lambda s, g: (function(s, g), back(s, g)), signal, guide)
    assert set(ours) == expected(name)
