"""Arguments that cannot work raise an error that says what to write; traced ones give NaN."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from closed_forms import PLAIN, as_users_have_it, boxes

import smoothdiff as sd

KEY = jax.random.key(0)
X = jnp.array([0.1, 0.2])
TREE = {"a": X, "b": jnp.array(1.0)}
SCALAR = (
    sd.smooth_grad,
    sd.smooth_value_and_grad,
    sd.smooth_hessian,
    sd.smooth_quadratic,
    lambda *a, **k: lambda key, x: sd.smooth_hvp(*a, **k)(key, x, x),
)


def grad(
    sigma: Any = 0.5, x: Any = X, fun: Any = boxes, key: Any = KEY, **options: Any
) -> Callable[[], Any]:
    return lambda: as_users_have_it(sd.smooth_grad)(fun, sigma, **options)(key, x)


def tree_fun(p):
    return boxes(p["a"]) * p["b"]


GUMBEL = optax.perturbations.Gumbel()
PAIRS = sd.Gaussian(antithetic=True)
NONE = {"a": 0.5, "b": None}

# what is called, the error, and words that its message must contain
SIGMA = {
    "negative": (grad(-0.1), ValueError, "positive"),
    "zero": (grad(0.0), ValueError, "positive.*None for a leaf"),
    "integer zero": (grad(0), ValueError, "positive"),
    "nan": (grad(np.nan), ValueError, "positive and finite"),
    "infinite": (grad(np.inf), ValueError, "positive and finite"),
    "one zero entry": (grad(jnp.array([0.5, 0.0])), ValueError, "positive"),
    "in one leaf": (grad({"a": 0.5, "b": -1.0}, TREE, tree_fun), ValueError, r"\['b'\].*positive"),
    "complex": (grad(0.5 + 0j), TypeError, "real"),
    "of another structure": (grad({"a": 0.5}), ValueError, "structure of the parameters"),
    "a missing leaf": (grad({"a": 0.5}, TREE, tree_fun), ValueError, "structure"),
    "of another shape": (grad(jnp.ones(3)), ValueError, r"\(3,\).*\(2,\)"),
    "larger than the leaf": (grad(jnp.ones((2, 2))), ValueError, "broadcast"),
    "none at all": (grad(None), ValueError, "nothing is smoothed.*positive sigma"),
    "below the spacing": (grad(1e-9, X + 1), ValueError, "larger sigma, float64"),
    "below it in one entry": (
        grad(1e-3, jnp.array([0.0, 1e6])),
        ValueError,
        "spacing.*larger sigma",
    ),
}
PARAMETERS = {
    "integer": (grad(x=jnp.array([1, 2])), TypeError, r"int32.*jnp\.asarray\(x, float\)"),
    "a Python integer": (grad(x=1, fun=lambda x: x), TypeError, "floating-point.*another argument"),
    "boolean": (grad(x=jnp.array([True])), TypeError, "floating-point"),
    "complex": (grad(x=X.astype(jnp.complex64)), TypeError, "complex64.*real floating-point"),
    "integer in a tree": (
        grad(x={"a": X, "b": jnp.array(1)}, fun=tree_fun),
        TypeError,
        r"\['b'\].*int32",
    ),
    "a string": (grad(x="x"), TypeError, ""),
    "no argument": (lambda: sd.smooth_grad(boxes, 0.5)(KEY), ValueError, "argnums"),
    "argnums too large": (grad(argnums=1), ValueError, "argnums=1.*1 positional"),
    "argnums twice": (
        lambda: sd.smooth_grad(lambda x, y: x, 0.5, argnums=(0, -2))(KEY, 1.0, 2.0),
        ValueError,
        "twice",
    ),
}
KEYS = {
    "missing": (lambda: sd.smooth_grad(boxes, 0.5)(X), TypeError, r"jax.random.key\(0\)"),
    "missing, two arguments": (
        lambda: sd.smooth_grad(lambda x, y: boxes(x) * y, 0.5)(X, 2.0),
        TypeError,
        r"jax.random.key\(0\)",
    ),
    "missing, integer argument": (
        lambda: sd.smooth_grad(lambda x, n: boxes(x) * n, 0.5)(X, 2),
        TypeError,
        r"jax.random.key\(0\)",
    ),
    "missing in hvp": (
        lambda: sd.smooth_hvp(lambda x, y: boxes(x) * y, 0.5)(X, X, 2.0),
        TypeError,
        r"jax.random.key\(0\)",
    ),
    "an integer seed": (grad(key=0), TypeError, r"jax.random.key\(0\)"),
    "none": (grad(key=None), TypeError, "random key"),
    "several": (grad(key=jax.random.split(KEY)), TypeError, "jax.vmap"),
    "several raw": (
        grad(key=jax.random.split(jax.random.PRNGKey(0))),
        TypeError,
        "jax.vmap",
    ),
}
SAMPLES = {
    "zero": (grad(num_samples=0), ValueError, "positive integer"),
    "negative": (grad(num_samples=-4), ValueError, "positive integer"),
    "no integer": (grad(num_samples=4.0), ValueError, "num_samples must be a positive integer"),
    "one of a pair": (grad(num_samples=1, sampler=PAIRS), ValueError, "multiple of 2"),
    "odd pairs": (grad(num_samples=7, sampler=PAIRS), ValueError, "multiple of 2.*7"),
    "only the center": (grad(num_samples=1, baseline="center"), ValueError, "num_samples"),
    "center and pairs": (
        # f(theta) is one of the samples: the pairs have what is left
        grad(num_samples=64, sampler=PAIRS, baseline="center"),
        ValueError,
        "multiple of 2.*1 of num_samples=64 is for the baseline",
    ),
    "batch_size of zero": (grad(batch_size=0), ValueError, "batch_size must be a positive"),
    "batch_size no integer": (grad(batch_size=0.5), ValueError, "batch_size must be a positive"),
}
BOUNDS = {
    "low above high": (grad(bounds=(1.0, -1.0)), ValueError, r"above high.*give \(low, high\)"),
    "low above high somewhere": (
        grad(bounds=(jnp.array([-1.0, 3.0]), 2.0)),
        ValueError,
        "above high",
    ),
    "nan": (grad(bounds=(np.nan, 1.0)), ValueError, "bounds"),
    "outside": (grad(bounds=(0.15, 1.0)), ValueError, "outside.*clip it"),
    "outside in a leaf": (
        grad(x=TREE, fun=tree_fun, bounds=({"a": -1.0, "b": 2.0}, 3.0)),
        ValueError,
        r"\['b'\].*outside",
    ),
    "no pair": (grad(bounds=1.0), (TypeError, ValueError), "bounds"),
    "three": (grad(bounds=(0.0, 1.0, 2.0)), (TypeError, ValueError), "bounds"),
    "another structure": (grad(bounds=({"a": 0.0}, 1.0)), ValueError, "bounds.*structure"),
    "another shape": (grad(bounds=(jnp.zeros(3), 1.0)), ValueError, "bounds.*broadcast"),
}
CHOICES = {
    "function": (grad(fun=3.0), TypeError, "must be a function, not float"),
    "baseline": (grad(baseline="median"), ValueError, "'center'.*'mean'.*'none'.*'median'"),
    "baseline object": (grad(baseline=3), (TypeError, ValueError), "baseline"),
    "sampler": (grad(sampler="gaussian"), TypeError, r"sampler object such as Gaussian\(\)"),
    "sampler class": (grad(sampler=sd.Gaussian), TypeError, "an instance of AbstractSampler"),
    "estimator": (grad(sampler=sd.Importance(1)), TypeError, r"write Importance\(1\)\(fun, sigma"),
    "noise as a sampler": (
        grad(sampler=GUMBEL),
        TypeError,
        r"write noise=\.\.\.",
    ),
    "sampler as noise": (grad(noise=sd.Sobol()), TypeError, r"sample and log_prob.*sampler=\.\.\."),
    "noise class": (grad(noise=optax.perturbations.Gumbel), TypeError, "sample and log_prob"),
    "noise and sampler": (grad(noise=GUMBEL, sampler=PAIRS), ValueError, "leave out the sampler"),
    "nonfinite": (grad(nonfinite="ignore"), ValueError, "propagate.*drop"),
    "option": (grad(samples=3), TypeError, "unexpected keyword argument 'samples'"),
}
OUTPUTS = {
    "integer": (grad(fun=lambda x: 1), TypeError, r"int32.*astype\(float\)"),
    "boolean": (grad(fun=lambda x: x[0] > 0), TypeError, r"bool.*astype\(float\)"),
    "complex": (grad(fun=lambda x: x[0].astype(jnp.complex64)), TypeError, "complex64.*real"),
    "nothing": (
        lambda: sd.smooth(lambda x: {}, 0.5)(KEY, X),
        TypeError,
        "returned {}.*return what is to be smoothed",
    ),
    "no pair for has_aux": (grad(has_aux=True), (TypeError, ValueError), "has_aux"),
}
VECTORS = {
    "other shape": (
        lambda: sd.smooth_hvp(boxes, 0.5)(KEY, X, jnp.ones(3)),
        ValueError,
        r"v must have.*key, x, v",
    ),
    "other structure": (
        lambda: sd.smooth_hvp(tree_fun, 0.5)(KEY, TREE, X),
        ValueError,
        "v must have",
    ),
    "integer": (
        lambda: sd.smooth_hvp(boxes, 0.5)(KEY, X, jnp.ones(2, int)),
        TypeError,
        r"v has dtype int32: pass numbers as jnp\.asarray\(v, float\)",
    ),
    "of the argument that is not chosen": (
        lambda: sd.smooth_hvp(lambda x, y: boxes(x) * y, 0.5, argnums=1)(KEY, X, X, 1.0),
        ValueError,
        "v must have",
    ),
}
WITHOUT_ERRORS: list[tuple[str, Callable, dict[str, Any]]] = [
    ("jacobian", sd.smooth_jacobian, {"stderr": True}),
    ("hessian", sd.smooth_hessian, {"stderr": True}),
    ("hvp", SCALAR[-1], {"stderr": True}),
    ("quadratic", sd.smooth_quadratic, {}),
    ("chunks", sd.smooth_grad, {"stderr": True, "batch_size": 8}),
]
ERRORS_OF_NONE = {
    name: (
        lambda make=make, options=options: make(tree_fun, NONE, **options)(KEY, TREE),
        ValueError,
        "every leaf",
    )
    for name, make, options in WITHOUT_ERRORS
} | {
    "quadratic, stderr": (
        lambda: sd.smooth_quadratic(boxes, 0.5, stderr=True),
        ValueError,
        "model.stderr, hessian_stderr",
    )
}
TABLES = {
    "sigma": SIGMA,
    "parameters": PARAMETERS,
    "key": KEYS,
    "samples": SAMPLES,
    "bounds": BOUNDS,
    "choice": CHOICES,
    "output": OUTPUTS,
    "vector": VECTORS,
    "stderr": ERRORS_OF_NONE,
}
ROWS = {f"{what}, {name}": row for what, table in TABLES.items() for name, row in table.items()}


@pytest.mark.parametrize(("call", "error", "words"), ROWS.values(), ids=ROWS)
def test_a_bad_argument_raises_and_says_what_to_write(call, error, words):
    with pytest.raises(error, match=f"(?s){words}"):
        call()


@pytest.mark.parametrize("transform", SCALAR)
@pytest.mark.parametrize("fun", [lambda x: x, lambda x: x[:1], lambda x: {"loss": x[0]}])
def test_a_scalar_is_asked_for_where_one_is_needed(transform, fun):
    with pytest.raises(TypeError, match=r"scalar.*smooth_jacobian"):
        transform(fun, 0.5)(KEY, X)


@pytest.mark.parametrize("transform", [sd.smooth_grad, sd.smooth_jacobian, sd.smooth_hessian])
def test_integers_that_are_not_smoothed_have_no_derivative(transform):
    p = {"a": X, "b": jnp.array(1)}
    with pytest.raises(TypeError, match=r"int32 has no derivative: make it another argument"):
        transform(tree_fun, NONE)(KEY, p)
    with pytest.raises(TypeError, match=r"int32 has no derivative: make it another argument"):
        sd.smooth_hvp(tree_fun, NONE)(KEY, p, p)


def test_the_same_messages_from_every_transform():
    """Checked before AD hides the values."""
    for transform in (sd.smooth, sd.smooth_jacobian, *SCALAR):
        with pytest.raises(ValueError, match="positive"):
            transform(boxes, -1.0)(KEY, X)
        with pytest.raises(ValueError, match="outside"):
            transform(boxes, 0.5, bounds=(1.0, 2.0))(KEY, X)
        with pytest.raises(TypeError, match=r"jax.random.key\(0\)"):
            transform(boxes, 0.5)(X, X)


# ---------------------------------------------------------------------------------------------
# traced


def everything(sigma, x, bounds=None):
    options: dict[str, Any] = {**PLAIN, "num_samples": 8, "bounds": bounds}
    model = sd.smooth_quadratic(boxes, sigma, **options)(KEY, x)
    return (
        sd.smooth(boxes, sigma, **options)(KEY, x),
        sd.smooth_value_and_grad(boxes, sigma, **options, stderr=True)(KEY, x),
        sd.smooth_hessian(boxes, sigma, **options)(KEY, x),
        (model.value, model.grad, model.hessian.mv(x), model.stderr, model.hessian_stderr(x)),
    )


def leaves_are(predicate, tree):
    return all(bool(jnp.all(predicate(leaf))) for leaf in jax.tree.leaves(tree))


def test_traced_sigmas_that_are_invalid_give_nan():
    run = jax.jit(lambda sigma: everything(sigma, X))
    assert leaves_are(jnp.isfinite, run(0.5))
    for sigma in (0.0, -0.5, np.nan, np.inf, 1e-12):
        assert leaves_are(jnp.isnan, run(sigma)), sigma


def test_a_sigma_below_the_spacing_of_traced_parameters_gives_nan():
    run = jax.jit(lambda x: everything(1e-3, x))
    assert leaves_are(jnp.isfinite, run(X))
    assert leaves_are(jnp.isnan, run(X + 1e6))


def test_traced_bounds_and_parameters_that_are_invalid_give_nan():
    run = jax.jit(lambda low, high, x: everything(0.5, x, (low, high)))
    assert leaves_are(jnp.isfinite, run(-1.0, 1.0, X))
    for low, high, x in (
        (1.0, -1.0, X),
        (0.3, 1.0, X),
        (-1.0, 0.15, X),
        (np.nan, 1.0, X),
        (-1.0, 1.0, X + 2),
    ):
        assert leaves_are(jnp.isnan, run(low, high, x)), (low, high, x)


def test_only_the_invalid_lane_is_nan():
    run = jax.jit(jax.vmap(lambda x, s: everything(s, x, (-1.0, 1.0))))
    out = run(jnp.array([[0.1, 0.2], [0.1, 2.0], [0.1, 0.2]]), jnp.array([0.5, 0.5, -0.5]))
    assert leaves_are(jnp.isfinite, jax.tree.map(lambda leaf: leaf[0], out))
    for lane in (1, 2):
        assert leaves_are(jnp.isnan, jax.tree.map(lambda leaf, i=lane: leaf[i], out))


def test_ad_of_smooth_sees_tracers_and_gives_nan():
    """`jax.grad` hides the value of the parameters, so nothing can be raised."""
    g = sd.smooth(boxes, 0.5, bounds=(0.15, 1.0), **PLAIN, num_samples=8)
    assert leaves_are(jnp.isnan, jax.grad(g, argnums=1)(KEY, X))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_coarse_parameters_are_an_error_that_says_what_to_write(dtype, key):
    x = jnp.ones(2, dtype)
    with pytest.raises(TypeError, match=r"pass x\.astype\(jnp\.float32\)"):
        sd.smooth_grad(jnp.sum, 0.1)(key, x)
    with pytest.raises(TypeError, match=f"x.astype.jnp.{x.dtype}. inside the function"):
        sd.minimise(lambda y, _: jnp.sum(y), x, key=key, sigma=0.1, max_steps=1)


def test_parameters_without_a_number_are_an_error(key):
    for empty in (jnp.zeros(0), {"a": jnp.zeros((2, 0)), "b": jnp.zeros(0)}):
        with pytest.raises(ValueError, match="the smoothed parameters are empty"):
            sd.smooth(lambda x: 1.0, 0.1)(key, empty)
    some = {"a": jnp.zeros(0), "b": jnp.zeros(2)}
    g = sd.smooth_grad(lambda x: jnp.sum(x["b"]), 0.1, num_samples=8, baseline="mean")
    assert jax.tree.map(jnp.shape, g(key, some)) == {"a": (0,), "b": (2,)}


@pytest.mark.parametrize("sigma", [1e-39, 1e39])
def test_a_sigma_that_is_no_normal_number_of_the_parameters_is_an_error(sigma, key):
    with pytest.raises(ValueError, match=r"is no normal number in float32.* use float64"):
        sd.smooth(jnp.sum, sigma)(key, jnp.zeros(2))
