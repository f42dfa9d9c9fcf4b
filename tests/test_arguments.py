"""Pytrees, argnums, aux, leaves that are not smoothed, keys, and forms of sigma; jit and vmap."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import (
    PLAIN,
    as_users_have_it,
    assert_same,
    assert_unbiased,
    boxes,
    keys,
    smoothed_step,
    step,
)

import smoothdiff as sd


def test_parameters_are_any_pytree(key):
    """A nested tree with a None in it gives what one flat vector gives."""
    flat = lambda x: boxes(x[:2]) * jnp.round(x[2])
    tree = lambda p: flat(jnp.concatenate([p["a"][0], p["b"].reshape(1)]))
    x = jnp.array([0.1, 0.2, 0.6])
    p = {"a": (x[:2], None), "b": x[2]}

    def run(fun, sigma, x):
        options: dict[str, Any] = {**PLAIN, "num_samples": 16}
        return (
            sd.smooth_grad(fun, sigma, **options)(key, x),
            sd.smooth_hvp(fun, sigma, **options)(key, x, x),
            sd.smooth_hessian(fun, sigma, **options)(key, x),
            sd.smooth_hessian(fun, sigma, **options, stderr=True)(key, x),
        )

    want = jax.jit(lambda: run(flat, jnp.array([0.5, 0.4, 0.3]), x))()
    sigma = {"a": (jnp.array([0.5, 0.4]), None), "b": 0.3}
    grad, product, hessian, (same, error) = jax.jit(lambda: run(tree, sigma, p))()
    for found, exact in ((grad, want[0]), (product, want[1])):
        assert jax.tree.structure(found) == jax.tree.structure(p)
        assert_same(jnp.concatenate([found["a"][0], found["b"].reshape(1)]), exact)
    for found, exact in ((hessian, want[2]), (same, want[3][0]), (error, want[3][1])):
        assert_same(found["a"][0]["a"][0], exact[:2, :2])
        assert_same(found["b"]["a"][0], exact[2, :2])
        assert_same(found["a"][0]["b"], exact[:2, 2])
        assert_same(found["b"]["b"], exact[2, 2])


def test_leaves_keep_their_own_dtype(key, x64):
    p = {"wide": jnp.ones(2, jnp.float64), "narrow": jnp.ones(3, jnp.float32)}

    def fun(p):
        assert p["wide"].dtype == jnp.float64
        assert p["narrow"].dtype == jnp.float32
        return jnp.round(jnp.sum(p["wide"])) + jnp.round(jnp.sum(p["narrow"])).astype(jnp.float64)

    def everything(p):
        model = sd.smooth_quadratic(fun, 0.5, **PLAIN)(key, p)
        like_p = (
            sd.smooth_grad(fun, 0.5, **PLAIN)(key, p),
            *sd.smooth_grad(fun, 0.5, **PLAIN, stderr=True)(key, p),
            sd.smooth_hvp(fun, 0.5, **PLAIN)(key, p, p),
            model.hessian.mv(model.grad),
            model.stderr[1],
        )
        return like_p, (model.value, model.stderr[0], model(p))

    like_p, like_out = jax.eval_shape(everything, p)
    for tree in like_p:
        assert jax.tree.map(lambda leaf: leaf.dtype, tree) == {
            "wide": jnp.float64,
            "narrow": jnp.float32,
        }
    assert all(leaf.dtype == jnp.float64 for leaf in like_out)


def test_a_hessian_with_errors_has_the_dtypes_of_one_without(key, x64):
    """A block has that of its rows, and loses no digits to a narrower one of its columns."""
    p = {"wide": jnp.ones(2, jnp.float64), "narrow": jnp.ones(3, jnp.float32)}
    fun = lambda p: jnp.sum(p["wide"]) ** 2 * jnp.sum(p["narrow"]).astype(jnp.float64)

    @jax.jit
    def run():
        plain = sd.smooth_hessian(fun, 0.5, **PLAIN)(key, p)
        by_element = sd.Importance(2)(fun, 0.5, num_samples=2)(key, p)
        return plain, by_element, *sd.smooth_hessian(fun, 0.5, **PLAIN, stderr=True)(key, p)

    dtypes = lambda tree: jax.tree.map(lambda leaf: leaf.dtype, tree)
    with jax.numpy_dtype_promotion("standard"):  # which jax.hessian needs for two dtypes
        plain, *others = run()
    for other in others:
        assert dtypes(other) == dtypes(plain)
    for other in others:
        block = np.asarray(other["wide"]["narrow"])
        assert np.any(block != block.astype(np.float32))


@pytest.mark.parametrize("baseline", ["auto", "mean", "linear"])
@pytest.mark.parametrize("batch_size", [None, 8])
def test_leaves_without_a_number_stay_so(baseline, batch_size, key):
    """Among outputs, and among parameters that are not smoothed."""
    options: dict[str, Any] = {"baseline": baseline, "num_samples": 16}
    p, sigma = {"x": jnp.ones(2), "none": jnp.zeros((0, 3))}, {"x": 0.5, "none": None}
    sizes = lambda tree: jax.tree.map(jnp.shape, tree)

    def run(stderr):
        more: dict[str, Any] = {**options, "stderr": stderr, "nonfinite": "drop"}
        outputs = lambda x: {"square": x**2, "none": jnp.zeros((0, 3))}
        value = sd.smooth(outputs, 0.5, **more, batch_size=batch_size)(key, p["x"])
        jacobian = sd.smooth_jacobian(outputs, 0.5, **more, batch_size=batch_size)(key, p["x"])
        loss = lambda p: jnp.sum(p["x"] ** 2) + jnp.sum(p["none"])
        return value, jacobian, sd.smooth_grad(loss, sigma, **more)(key, p)

    want = (
        {"square": (2,), "none": (0, 3)},
        {"square": (2, 2), "none": (0, 3, 2)},
        {"x": (2,), "none": (0, 3)},
    )
    for shapes, found, pair in zip(
        want, jax.eval_shape(lambda: run(False)), jax.eval_shape(lambda: run(True)), strict=True
    ):
        assert sizes(found) == shapes
        assert sizes(pair) == (shapes, shapes)


@pytest.mark.parametrize("argnums", [0, 1, -1, (0,), (0, 1), (1, 0)])
def test_argnums_mean_what_they_mean_to_jax(argnums, key):
    fun = lambda x, y, z: jnp.sum(x**2) + y * jnp.sum(x) + z * y**2
    args = (jnp.array([1.0, 2.0]), jnp.array(3.0), jnp.array(0.5))
    options: dict[str, Any] = {**PLAIN, "argnums": argnums, "num_samples": 2**15}
    shapes = lambda fun, *args: jax.tree.map(jnp.shape, jax.eval_shape(fun, *args))
    want = jax.grad(fun, argnums)(*args)
    found = jax.jit(sd.smooth_grad(fun, 0.1, **options))(key, *args)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=0.5)  # tells the arguments apart
    assert jax.tree.structure(found) == jax.tree.structure(want)
    assert shapes(sd.smooth_jacobian(fun, 0.1, **options), key, *args) == shapes(lambda: want)
    product = sd.smooth_hvp(fun, 0.1, **options)
    assert shapes(product, key, args[0], want, *args[1:]) == shapes(lambda: want)
    hessian = sd.smooth_hessian(fun, 0.1, **options)
    assert shapes(hessian, key, *args) == shapes(jax.hessian(fun, argnums), *args)


@pytest.mark.parametrize("stderr", [False, True])
def test_other_arguments_can_be_anything(stderr, key):
    def fun(x, name, scale):
        assert name == "a name"
        return jnp.round(scale(jnp.sum(x)))

    x, rest = jnp.ones(2), ("a name", lambda v: 2 * v)
    hvp = lambda *a, **k: lambda key, x, *rest: sd.smooth_hvp(*a, **k)(key, x, x, *rest)
    for make in (
        sd.smooth,
        sd.smooth_grad,
        sd.smooth_value_and_grad,
        sd.smooth_jacobian,
        sd.smooth_hessian,
        hvp,
    ):
        g = make(fun, 0.5, **PLAIN, stderr=stderr)
        jax.eval_shape(lambda g=g: g(key, x, *rest))
    jax.eval_shape(lambda: sd.smooth_quadratic(fun, 0.5, **PLAIN)(key, x, *rest))


@pytest.mark.parametrize(("baseline", "rows"), [("mean", 8), ("center", 7)])
def test_aux_has_one_row_for_each_sample(baseline, rows, key):
    fun = lambda x: (jnp.sum(x), {"x": x, "twice": 2 * jnp.sum(x)})
    x = jnp.array([1.0, 2.0])
    options: dict[str, Any] = {
        "num_samples": 8,
        "sampler": sd.Gaussian(),
        "baseline": baseline,
        "has_aux": True,
    }

    def everything(stderr):
        both: dict[str, Any] = {**options, "stderr": stderr}
        strip = lambda out: out[0] if stderr else out
        return [
            strip(sd.smooth(fun, 0.1, **both)(key, x))[1],
            strip(sd.smooth_grad(fun, 0.1, **both)(key, x))[1],
            strip(sd.smooth_value_and_grad(fun, 0.1, **both)(key, x))[0][1],
            strip(sd.smooth_jacobian(fun, 0.1, **both)(key, x))[1],
            strip(sd.smooth_hessian(fun, 0.1, **both)(key, x))[1],
            strip(sd.smooth_hvp(fun, 0.1, **both)(key, x, x))[1],
            sd.smooth_quadratic(fun, 0.1, **options)(key, x)[1],
        ]

    without, with_errors = jax.jit(lambda: (everything(False), everything(True)))()
    for aux in without + with_errors:
        assert aux["x"].shape == (rows, 2)
        assert_same(aux["x"], without[0]["x"])
        assert_same(aux["twice"], 2 * jnp.sum(aux["x"], axis=1))


@pytest.mark.slow
def test_leaves_with_sigma_none_are_differentiated_by_ad(key):
    """f = y^2 step(x) + y^3 with x smoothed and y left to AD."""
    fun = lambda p: p["y"] ** 2 * step(p["x"]) + p["y"] ** 3
    smooth = lambda p: p["y"] ** 2 * smoothed_step(p["x"], jnp.array([0.5])) + p["y"] ** 3
    p = {"x": jnp.array([0.2]), "y": jnp.array(1.5)}
    sigma = {"x": 0.5, "y": None}
    options: dict[str, Any] = {**PLAIN, "num_samples": 256}
    first_two = lambda k: (
        sd.smooth_grad(fun, sigma, **options)(k, p),
        sd.smooth_hessian(fun, sigma, **options)(k, p),
    )
    found = jax.jit(jax.vmap(first_two))(keys(2048))
    assert_unbiased(found, (jax.grad(smooth)(p), jax.hessian(smooth)(p)), resolution=0.03)
    grad, hessian = jax.jit(first_two)(key)
    # the path for standard errors differentiates sample by sample
    with_errors = jax.jit(sd.smooth_grad(fun, sigma, **options, stderr=True))
    estimate, error = with_errors(key, p)
    assert_same(estimate, grad)
    assert float(error["y"]) > 0
    product = jax.jit(sd.smooth_hvp(fun, sigma, **options))(key, p, p)
    row = lambda h: h["x"] @ p["x"] + h["y"] * p["y"]
    assert_same(product, {i: row(hessian[i]) for i in p})
    # what cannot be differentiated can still be passed
    fun = lambda x, n: step(x) * n.astype(x.dtype)
    count = sd.smooth(fun, (0.5, None), argnums=(0, 1), **PLAIN)
    assert jnp.isfinite(jax.jit(count)(key, p["x"], 3))


# ---------------------------------------------------------------------------------------------
# jit, vmap, keys


def test_jit_changes_nothing(key):
    x = jnp.array([0.1, 0.2])
    g = sd.smooth_grad(boxes, 0.4, **PLAIN, num_samples=32)
    assert_same(jax.jit(g)(key, x), g(key, x))


@pytest.mark.parametrize("axes", [(None, 0, None), (0, None, None), (None, None, 0), (0, 0, 0)])
def test_vmap_is_a_loop_over_parameters_keys_and_sigmas(axes):
    full = (
        keys(3),
        jnp.array([[0.1, 0.2], [0.5, -0.3], [-0.4, 0.8]]),
        jnp.array([0.3, 0.5, 2.0]),
    )
    args = [a if axis == 0 else a[0] for a, axis in zip(full, axes, strict=True)]

    def both(key, x, sigma):
        options: dict[str, Any] = {**PLAIN, "num_samples": 16}
        product = sd.smooth_hvp(boxes, sigma, **options)(key, x, x)
        return sd.smooth_grad(boxes, sigma, **options, stderr=True)(key, x), product

    def one(i):
        return both(*(a[i] if axis == 0 else a for a, axis in zip(args, axes, strict=True)))

    loop = jax.jit(lambda: jax.lax.map(one, jnp.arange(3)))
    assert_same(jax.jit(jax.vmap(both, in_axes=axes))(*args), loop())


def test_kinds_of_keys(key):
    x = jnp.array([0.1, 0.2])
    g = jax.jit(sd.smooth_grad(boxes, 0.4, **PLAIN, num_samples=32))
    want = g(key, x)
    assert_same(g(jax.random.PRNGKey(0), x), want)
    assert_same(g(np.asarray(jax.random.PRNGKey(0)), x), want)
    over_keys = jax.jit(jax.vmap(g, in_axes=(0, None)))
    raw, typed = jax.random.split(jax.random.PRNGKey(1), 3), keys(3, seed=1)
    assert_same(over_keys(raw, x), over_keys(typed, x))
    assert jnp.all(jnp.isfinite(g(jax.random.key(0, impl="rbg"), x)))
    assert not jnp.allclose(g(jax.random.key(1), x), want)


def test_sigma_is_the_same_in_every_form(key):
    x = jnp.array([0.1, 0.2])
    run = lambda sigma: sd.smooth_hessian(boxes, sigma, **PLAIN, num_samples=32)(key, x)
    forms = (np.float64(0.5), jnp.array(0.5), np.array([0.5, 0.5]), jnp.array([0.5]))
    want, *known = jax.jit(lambda: [run(0.5), *map(run, forms)])()
    for found in known:
        assert_same(found, want)
    traced = jax.jit(run)
    assert_same(traced(0.5), want)
    assert_same(traced(jnp.array([0.5, 0.5])), want)


def test_sigma_broadcasts_to_its_leaf(key):
    x = jnp.array([[0.1, 0.2], [0.5, 0.4], [-0.3, 0.0]])
    fun = lambda x: jnp.sum(jax.vmap(boxes)(x))
    run = lambda sigma: sd.smooth_grad(fun, sigma, **PLAIN, num_samples=32)(key, x)
    forms = (jnp.array([0.4, 0.5]), jnp.array([[0.4, 0.5]]), jnp.array([[0.4], [0.5], [0.6]]))
    full = [jnp.broadcast_to(sigma, (3, 2)) for sigma in forms]
    found = jax.jit(lambda *forms: [run(sigma) for sigma in forms])(*forms)
    assert_same(found, jax.jit(lambda: [run(sigma) for sigma in full])())


def test_counts_may_be_integers_of_numpy(key):
    x = jnp.array([0.1, 0.2])
    make = as_users_have_it(sd.smooth_grad)
    g = lambda num, size: make(boxes, 0.5, num_samples=num, batch_size=size, **PLAIN)
    np.testing.assert_array_equal(g(np.int64(16), np.int32(8))(key, x), g(16, 8)(key, x))
    for bad in (np.int64(0), 16.0, np.float64(16), "16", None):
        with pytest.raises(ValueError, match="num_samples must be a positive integer"):
            g(bad, None)


@pytest.mark.parametrize("static", [3, "sum"])
def test_products_in_chunks_take_what_jax_cannot_trace(static, key):
    def fun(how, x):
        assert isinstance(how, int | str)
        return jnp.sum(x**2)

    run = lambda **chunks: sd.smooth_hvp(fun, 0.3, argnums=1, **chunks)(
        key, static, jnp.ones(2), jnp.ones(2)
    )
    np.testing.assert_allclose(run(batch_size=8), run(), rtol=1e-4)
