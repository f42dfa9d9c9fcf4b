"""The quadratic model: one batch, arrays only, a Hessian that lineax and every transform take."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from closed_forms import PLAIN, assert_same, assert_unbiased, boxes, keys

import smoothdiff as sd

X = {"a": jnp.array([0.1, 0.2]), "b": jnp.array(0.6)}
V = {"a": jnp.array([1.0, -3.0]), "b": jnp.array(0.5)}
SIGMA = {"a": jnp.array([0.5, 0.4]), "b": 0.3}


def fun(p):
    return boxes(p["a"]) * (1 + jnp.round(p["b"])) + p["b"] ** 2


def flat(tree):
    return np.concatenate([tree["a"], np.reshape(tree["b"], 1)])


@pytest.fixture(scope="module")
def model():
    return jax.jit(sd.smooth_quadratic(fun, SIGMA, **PLAIN, num_samples=32))(jax.random.key(0), X)


@pytest.fixture(scope="module")
def pieces():
    """The same estimates and errors from the other transforms."""
    key, options = jax.random.key(0), {**PLAIN, "num_samples": 32, "stderr": True}

    @jax.jit
    def run():
        return (
            sd.smooth_value_and_grad(fun, SIGMA, **options)(key, X),
            sd.smooth_hessian(fun, SIGMA, **options)(key, X),
            sd.smooth_hvp(fun, SIGMA, **options)(key, X, V),
        )

    return run()


def matrix(blocks):
    rows = [[blocks[i][j].reshape(X[i].size, X[j].size) for j in "ab"] for i in "ab"]
    return np.block([[np.asarray(block) for block in row] for row in rows])


def test_estimates_and_errors_are_those_of_the_other_transforms(model, pieces):
    ((value, grad), errors), (hessian, _), (product, product_error) = pieces
    assert_same((model.value, model.grad), (value, grad))
    assert_same(model.stderr, errors)

    @jax.jit
    def of_hessian(model):
        return model.hessian.as_matrix(), model.hessian.mv(V), model.hessian_stderr(V)

    assert_same(of_hessian(model), (matrix(hessian), product, product_error))


def test_the_operator_is_a_lineax_operator(model):
    operator = model.hessian
    assert isinstance(operator, lx.AbstractLinearOperator)

    @jax.jit
    def run(operator):
        others = operator.transpose(), lx.materialise(operator), lx.linearise(operator)
        matrices = [one.as_matrix() for one in (operator, *others)]
        shifted = 2.0 * operator + lx.IdentityLinearOperator(operator.in_structure())
        products = [one.mv(V) for one in (operator, operator.T, shifted)]
        return matrices, products, lx.diagonal(operator)

    (dense, *others), (product, transposed, shifted), diagonal = run(operator)
    dense = np.asarray(dense)
    assert_same(dense, dense.T)
    assert_same(flat(product), dense @ flat(V), scale=10)
    assert_same(others, [dense] * 3)
    assert_same(transposed, product)
    assert_same(diagonal, np.diagonal(dense))
    assert_same(shifted["b"], 2 * np.asarray(product["b"]) + np.asarray(V["b"]))
    assert lx.is_symmetric(operator)
    assert not lx.is_positive_semidefinite(operator)
    assert not lx.is_diagonal(operator)
    shapes = jax.tree.map(jnp.shape, X)
    assert jax.tree.map(lambda s: s.shape, operator.in_structure()) == shapes
    assert jax.tree.map(lambda s: s.shape, operator.out_structure()) == shapes
    assert operator.in_size() == operator.out_size() == 3


@pytest.mark.parametrize("solver", [lx.AutoLinearSolver(well_posed=True), lx.LU(), lx.SVD()])
def test_linear_solve(model, solver):
    solve = eqx.filter_jit(lambda m: lx.linear_solve(m.hessian, m.grad, solver).value)
    found = solve(model)
    assert jax.tree.structure(found) == jax.tree.structure(X)
    want = np.linalg.solve(np.asarray(model.hessian.as_matrix(), float), flat(model.grad))
    np.testing.assert_allclose(flat(found), want, rtol=1e-3)


def test_conjugate_gradients_on_a_convex_function(key):
    fun = lambda x: jnp.sum(x**2) + x[0] ** 2

    @jax.jit
    def newton(key, x):
        model = sd.smooth_quadratic(fun, 0.5, **PLAIN, num_samples=4096)(key, x)
        hessian = lx.TaggedLinearOperator(model.hessian, lx.positive_semidefinite_tag)
        step = lx.linear_solve(hessian, model.grad, lx.CG(rtol=1e-5, atol=1e-5)).value
        return hessian.mv(step), model.grad

    product, grad = newton(key, jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(product, grad, rtol=1e-3)


def test_calling_the_model_gives_its_quadratic(model):
    p, g, h = flat(V), flat(model.grad), np.asarray(model.hessian.as_matrix())
    want = model.value + g @ p + p @ h @ p / 2
    assert_same(model(V), want, scale=10)
    assert_same(model(jax.tree.map(jnp.zeros_like, X)), model.value)
    # numbers of Python as well
    assert_same(model({**V, "b": 0.5}), want, scale=10)
    slope = jax.jit(jax.grad(lambda step: model(step)))(V)
    assert_same(flat(slope), g + h @ p, scale=10)


def test_it_crosses_jit_and_holds_only_arrays(model):
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(model))
    product = jax.jit(lambda m, v: m.hessian.mv(v))
    assert_same(product(model, V), model.hessian.mv(V))
    again = jax.jit(lambda m: m)(model)
    assert jax.tree.structure(again) == jax.tree.structure(model)
    assert_same(again.hessian.mv(V), model.hessian.mv(V))


def test_it_crosses_vmap_and_scan():
    make = sd.smooth_quadratic(fun, SIGMA, **PLAIN, num_samples=32)
    many = keys(3)
    apply = lambda m: (m.value, m.hessian.mv(V))

    want = jax.jit(lambda: jax.lax.map(lambda k: apply(make(k, X)), many))()
    models = jax.jit(jax.vmap(make, in_axes=(0, None)))(many, X)
    assert_same(jax.jit(jax.vmap(apply))(models), want)

    @jax.jit
    def through_scan():
        def step(model, key):
            return make(key, X), (apply(model), model)  # carried, and stacked as an output

        last, (applied, stacked) = jax.lax.scan(step, make(many[0], X), many)
        return jax.vmap(apply)(stacked), applied, apply(last)

    stacked, applied, last = through_scan()
    want = jax.tree.map(np.asarray, want)
    shifted = jax.tree.map(lambda leaf: np.concatenate([leaf[:1], leaf[:-1]]), want)
    assert_same(stacked, shifted)
    assert_same(applied, shifted)
    assert_same(last, jax.tree.map(lambda leaf: leaf[-1], want))

    first = jax.tree.map(lambda leaf: leaf[0], models)
    power = lambda m: jax.lax.scan(lambda v, _: (m.hessian.mv(v), None), V, None, length=3)[0]
    dense = np.linalg.matrix_power(np.asarray(first.hessian.as_matrix(), float), 3)
    assert_same(flat(jax.jit(power)(first)), dense @ flat(V), scale=10)  # closed over


@pytest.mark.slow
def test_a_model_that_draws_its_points_again_crosses_scan():
    """With a batch_size the model keeps its key in place of the points."""
    make = sd.smooth_quadratic(fun, SIGMA, **PLAIN, num_samples=32, batch_size=10)
    kept = sd.smooth_quadratic(fun, SIGMA, **PLAIN, num_samples=32)
    size = lambda m: sum(leaf.size for leaf in jax.tree.leaves(m))
    stacked = jax.jit(lambda: jax.lax.map(lambda k: make(k, X), keys(3)))()
    assert size(stacked) < 3 * size(jax.eval_shape(lambda: kept(keys(3)[0], X)))
    last = jax.tree.map(lambda leaf: leaf[2], stacked)
    want = jax.jit(lambda: kept(keys(3)[2], X).hessian.mv(V))()
    assert_same(jax.jit(lambda m: m.hessian.mv(V))(last), want)


def test_the_aux_of_the_samples_comes_beside_the_model(key):
    make = sd.smooth_quadratic(lambda x: (boxes(x), x), 0.5, **PLAIN, num_samples=8, has_aux=True)
    model, aux = jax.jit(make)(key, X["a"])
    assert aux.shape == (8, 2)
    assert not any(leaf is aux for leaf in jax.tree.leaves(model))
    assert model.value.shape == ()


def test_indefinite_and_negative_definite_hessians():
    """The negated Gaussian of appendix H: positive definite inside |x| < s, indefinite outside."""
    fun = lambda x: -jnp.exp(-jnp.sum(x**2) / 2)

    def smoothed(x, sigma=0.5):
        width = 1 + sigma**2
        return -jnp.exp(-jnp.sum(x**2) / (2 * width)) / width

    make = sd.smooth_quadratic(fun, 0.5, **PLAIN, num_samples=1024)
    hessians = jax.jit(jax.vmap(lambda k, x: make(k, x).hessian.as_matrix(), in_axes=(0, None)))
    exact_at = jax.jit(jax.hessian(smoothed))
    for x, signs in (([0.0, 0.0], [1, 1]), ([1.5, 0.0], [-1, 1])):
        exact = exact_at(jnp.array(x))
        np.testing.assert_array_equal(np.sign(np.linalg.eigvalsh(exact)), signs)
        assert_unbiased(hessians(keys(512), jnp.array(x)), exact, resolution=0.03)


def test_value_and_gradient_can_be_differentiated(key):
    """In the parameters and sigma, as those of `smooth`; the Hessian is a constant to AD."""
    x, sigma = X["a"], 0.4

    def both(x, sigma):
        make = sd.smooth_quadratic(boxes, sigma, **PLAIN, num_samples=16)
        model = make(key, x)
        return model.value, model.grad, model.hessian.mv(x)

    def want(x, sigma):
        g = lambda x: sd.smooth(boxes, sigma, **PLAIN, num_samples=16)(key, x)
        return g(x), jax.grad(g)(x)

    derivatives = lambda fun: jax.jit(jax.jacfwd(fun, argnums=(0, 1)))(x, sigma)
    value, grad, _ = derivatives(both)
    assert_same((value, grad), derivatives(want))
    frozen = jax.jit(jax.jacfwd(lambda s: both(jax.lax.stop_gradient(x), s)[2]))(sigma)
    np.testing.assert_array_equal(frozen, 0)


@pytest.mark.parametrize("v", [1.0, jnp.ones(3), jnp.ones((1, 2)), X], ids=str)
def test_vectors_are_not_broadcast(v, key):
    operator = sd.smooth_quadratic(boxes, 0.5, **PLAIN, num_samples=8)(key, X["a"]).hessian
    for product in (operator.mv, operator.stderr):
        with pytest.raises(ValueError, match=r"v must have the structure and shapes.*\(2,\)"):
            product(v)
