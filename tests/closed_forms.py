"""Functions whose Gaussian smoothing is known, and how estimates are held to it. No tests here."""

import inspect
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

import smoothdiff as sd
from smoothdiff._baselines import Control
from smoothdiff._named_baselines import as_baseline


class Case(NamedTuple):
    """`smoothed(theta, sigma)` is E fun(theta + sigma z); theta and sigma are vectors."""

    fun: Callable
    smoothed: Callable
    theta: tuple[float, ...]
    sigma: tuple[float, ...]


def step(x):
    """One where the first number is positive."""
    return (x[0] > 0).astype(x.dtype)


def smoothed_step(theta, sigma):
    return norm.cdf(theta[0] / sigma[0])


def _abs(x):
    return jnp.abs(x[0])


def _smoothed_abs(theta, sigma):
    u = theta[0] / sigma[0]
    return theta[0] * (2 * norm.cdf(u) - 1) + 2 * sigma[0] * norm.pdf(u)


def _sin(x):
    return jnp.sin(x[0])


def _smoothed_sin(theta, sigma):
    return jnp.exp(-(sigma[0] ** 2) / 2) * jnp.sin(theta[0])


def half_space(x):
    """One where the coordinates sum to a positive number: a step in any number of dimensions."""
    return (jnp.sum(x) > 0).astype(x.dtype)


def smoothed_half_space(theta, sigma):
    return norm.cdf(jnp.sum(theta) / jnp.sqrt(jnp.sum(sigma**2)))


def _moment(power: int, theta, sigma):
    """E (theta + sigma z)^power."""
    s2 = sigma**2
    return (
        [1.0, theta, theta**2 + s2, theta**3 + 3 * theta * s2][power]
        if power < 4
        else (theta**4 + 6 * theta**2 * s2 + 3 * s2**2)
    )


def polynomial(n: int) -> Case:
    """A polynomial of degree 4 in n variables with fixed random monomials."""
    rng = np.random.default_rng(n)
    terms = []
    for degree in (1, 2, 3, 4, 4):
        powers = np.bincount(rng.integers(n, size=degree), minlength=n)
        monomial = [(j, int(p)) for j, p in enumerate(powers) if p]
        terms.append((float(rng.uniform(0.5, 1.5)), monomial))

    def fun(x):
        return sum(c * jnp.prod(jnp.stack([x[j] ** p for j, p in ps])) for c, ps in terms)

    def smoothed(theta, sigma):
        return sum(
            c * jnp.prod(jnp.stack([_moment(p, theta[j], sigma[j]) for j, p in ps]))
            for c, ps in terms
        )

    theta = tuple(float(v) for v in rng.uniform(0.3, 1.0, size=n))
    sigma = tuple(float(v) for v in rng.uniform(0.6, 1.0, size=n))
    return Case(fun, smoothed, theta, sigma)


# three axis-aligned boxes in the plane: low corner, high corner, height
_LOW = np.array([[-1.0, -0.5], [0.2, -1.0], [-0.3, 0.1]])
_HIGH = np.array([[0.4, 0.9], [1.5, 0.3], [0.8, 1.2]])
_HEIGHT = np.array([1.0, -0.7, 2.0])


def boxes(x):
    """The sum of the heights of the boxes that contain x."""
    low, high, height = (jnp.asarray(a, x.dtype) for a in (_LOW, _HIGH, _HEIGHT))
    inside = jnp.all((x[None] > low) & (x[None] < high), axis=1)
    return jnp.sum(jnp.where(inside, height, jnp.zeros_like(height)))


def smoothed_boxes(theta, sigma):
    low, high, height = (jnp.asarray(a, theta.dtype) for a in (_LOW, _HIGH, _HEIGHT))
    edge = lambda at: norm.cdf((at - theta[None]) / sigma[None])
    return jnp.sum(height * jnp.prod(edge(high) - edge(low), axis=1))


CASES = {
    "step": Case(step, smoothed_step, (0.3,), (0.5,)),
    "abs": Case(_abs, _smoothed_abs, (0.5,), (0.6,)),
    "sin": Case(_sin, _smoothed_sin, (0.4,), (0.8,)),
    "half-space": Case(half_space, smoothed_half_space, (0.1, -0.2, 0.3), (0.4, 0.5, 0.6)),
    "boxes": Case(boxes, smoothed_boxes, (0.1, 0.2), (0.5, 0.4)),
    **{f"polynomial-{n}d": polynomial(n) for n in (1, 3, 8)},
}


# the textbook estimator, which the closed forms of variances hold for; defaults may differ
PLAIN: dict[str, Any] = {"sampler": sd.Gaussian(), "baseline": "mean"}


class Widened(sd.AbstractSampler):
    """Points from N(0, 1.3^2 I), wider than the Gaussian that they stand for, hence weighted."""

    gaussian: ClassVar[bool] = False

    def block(self, num_samples, n):
        return 1

    def draw(self, key, start, count, num_samples, n, dtype):
        z, _ = sd.Gaussian().draw(key, start, count, num_samples, n, dtype)
        wide = 1.3 * z
        log_ratio = jnp.sum(z * z - wide * wide, axis=1) / 2 + n * jnp.log(1.3).astype(dtype)
        return wide, log_ratio


class Sides(Control):
    """Several baselines at work side by side."""

    residual: dict
    sides: dict[str, Control]

    def smoothed(self, shift, ratio):
        return {name: control.smoothed(shift, ratio) for name, control in self.sides.items()}


class Several(sd.AbstractBaseline):
    """Several baselines on the same samples: the estimate is a dictionary of theirs.

    For `smooth` and `smooth_jacobian`. One program for all costs a third of one for each.
    """

    baselines: dict[str, sd.AbstractBaseline]

    def __init__(self, *names: str, **baselines: sd.AbstractBaseline):
        self.baselines = {name: as_baseline(name) for name in names} | baselines

    def evaluations(self):
        return max(baseline.evaluations() for baseline in self.baselines.values())

    def __call__(self, values, draws, log_ratio, valid, center):
        made = {n: b(values, draws, log_ratio, valid, center) for n, b in self.baselines.items()}
        return Sides({n: control.residual for n, control in made.items()}, made)


def as_users_have_it(function: Callable[..., Any]) -> Callable[..., Any]:
    """Without the type checker of the tests, which would speak before our own checks do."""
    return inspect.unwrap(function)


def keys(num: int, seed: int = 0):
    return jax.random.split(jax.random.key(seed), num)


def quadratic_model(fun: Callable, sigma, **options):
    """Value, gradient and Hessian of the smoothed function as arrays, for a key and parameters."""

    def g(key, x):
        made = sd.smooth_quadratic(fun, sigma, **options)(key, x)
        return made.value, made.grad, made.hessian.as_matrix()

    return g


def taylor(g: Callable):
    """Value, Jacobian and Hessian of g, forward over reverse, from one evaluation of g."""

    def first(x):
        slope, value = jax.jacrev(lambda x: (value := g(x), value), has_aux=True)(x)
        return slope, (value, slope)

    def at(x):
        hessian, (value, slope) = jax.jacfwd(first, has_aux=True)(x)
        return value, slope, hessian

    return at


def primitives(fun: Callable, *args) -> list[str]:
    """The names of all primitives in the jaxpr of `fun`, nested ones included."""
    return [eqn.primitive.name for eqn in _equations(jax.make_jaxpr(fun)(*args).jaxpr)]


def largest(fun: Callable, *args) -> int:
    """The number of elements of the largest array that the jaxpr of `fun` computes."""
    equations = _equations(jax.make_jaxpr(fun)(*args).jaxpr)
    return max(v.aval.size for eqn in equations for v in eqn.outvars if hasattr(v.aval, "size"))


def inner_jaxprs(eqn):
    """The jaxprs that an equation calls."""
    for value in eqn.params.values():
        for sub in value if isinstance(value, tuple | list) else (value,):
            inner = getattr(sub, "jaxpr", sub)
            if hasattr(inner, "eqns"):
                yield inner


def _equations(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in inner_jaxprs(eqn):
            yield from _equations(inner)


def assert_unbiased(
    estimates, exact, *, resolution: float, errors: float = 4.5, name: str = ""
) -> None:
    """The mean over the leading axis lies within `errors` standard errors of the exact value.

    `resolution` bounds those standard errors relative to the largest exact entry of the leaf, so
    that a test cannot pass because it is blind. `name` says which case it is.
    """
    assert jax.tree.structure(estimates) == jax.tree.structure(exact)
    for found, want in zip(jax.tree.leaves(estimates), jax.tree.leaves(exact), strict=True):
        found, want = np.asarray(found, np.float64), np.asarray(want, np.float64)
        mean = found.mean(axis=0)
        error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
        size = np.max(np.abs(want))
        assert mean.shape == want.shape
        assert np.max(error) <= resolution * size, f"{name} blind: {error} against {size}"
        rounding = 1e-5 * size
        away = np.abs(mean - want) / (error + rounding)
        assert np.max(away) < errors, f"{name} {mean} against {want}: {away} standard errors"


def assert_same(found, want, dtype: Any = np.float32, scale: float = 1.0, name: str = "") -> None:
    """Equal to rounding, relative to the largest entry of each leaf."""
    assert jax.tree.structure(found) == jax.tree.structure(want)
    tolerance = scale * (2e-5 if np.dtype(dtype) == np.float32 else 1e-12)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        assert a.shape == b.shape
        size = max(np.max(np.abs(b), initial=0.0), np.finfo(np.float32).tiny)
        np.testing.assert_allclose(a / size, b / size, rtol=0, atol=tolerance, err_msg=name)
