r"""A fit to the samples that are kept: the smoothed function and its derivatives from regression.

Points u are in units of the present width, around the present point. The fit is a Gaussian process
with a free constant and the kernel

$$ k(u, v) = \frac{u \cdot v}{n} + a \left(\frac{u \cdot v}{n}\right)^2
   + b\, e^{-|u - v|^2 / 2n}, $$

so that slopes, curvatures and what is neither have a share each. It is exact for a quadratic, needs
no more samples than there are, and reads n numbers a sample: no n x n array appears. Smoothing with
N(0, I) keeps every term in closed form, and so are the standard errors. Where rounds of samples
have random numbers of their own, a number that all of a round have in common may be noise.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._products import dot

# (share of curvatures, share of the rest): mostly the rest, mostly a quadratic, a quadratic
_SHARES = ((0.1, 1.0), (1.0, 0.1), (1.0, 0.0))
# the variance of the noise: the first is always safe to factorise, the last as small as may be
_RIDGES = {"float32": (1.0, 1e-1, 1e-3, 1e-4), "float64": (1.0, 1e-1, 1e-3, 1e-6, 1e-8)}
# points farther away than this, in widths, count less and less: the fit is a local one
_REACH = 2.0
# values count less where they are so many times the median above the lowest, but never less than
# the second share
_HIGH, _FAINT = 3.0, 1e-3


class ScalarFit(eqx.Module):
    """A fit to samples; its methods take the place `at`, a displacement in units of the width.

    `noise` is the standard deviation of what it leaves of a sample.
    """

    points: Float[Array, "m n"]
    coefficients: Float[Array, " m"]
    constant: Float[Array, ""]
    curved: Float[Array, ""]
    radial: Float[Array, ""]
    amplitude: Float[Array, ""]
    closeness: Float[Array, " m"]
    factor: Float[Array, "m m"]
    noise: Float[Array, ""]

    def _products(self, at: Array) -> Array:
        return dot(self.points, at) / at.size

    def _radial_terms(self, at: Array) -> Array:
        n = at.size
        away = self.points - at[None]
        height = (n / (n + 1)) ** (n / 2)
        return self.radial * height * jnp.exp(-jnp.sum(away * away, axis=1) / (2 * (n + 1)))

    def _value_features(self, at: Array) -> Array:
        product = self._products(at)
        size = jnp.sum(self.points * self.points, axis=1) / at.size**2
        return product + self.curved * (product**2 + size) + self._radial_terms(at)

    def value(self, at: Float[Array, " n"]) -> Float[Array, ""]:
        """The smoothed function."""
        return self.constant + dot(self.coefficients, self._value_features(at))

    def grad(self, at: Float[Array, " n"]) -> Float[Array, " n"]:
        """Its gradient."""
        n = at.size
        radials = self.coefficients * self._radial_terms(at) / (n + 1)
        slopes = self.coefficients * (1 + 2 * self.curved * self._products(at)) / n
        return dot(slopes + radials, self.points) - jnp.sum(radials) * at

    def _bends(self, at: Array) -> tuple[Array, Array, Array]:
        n = at.size
        radials = self.coefficients * self._radial_terms(at) / (n + 1)
        return 2 * self.curved * self.coefficients / n**2, radials, self.points - at[None]

    def curvature(self, at: Float[Array, " n"]) -> Callable[[Array], Array]:
        """Its Hessian as a product with vectors."""
        bends, radials, away = self._bends(at)

        def product(v: Array) -> Array:
            curved = dot(bends * dot(self.points, v), self.points)
            rest = dot(radials / (v.size + 1) * dot(away, v), away)
            return curved + rest - jnp.sum(radials) * v

        return product

    def curvature_diagonal(self, at: Float[Array, " n"]) -> Float[Array, " n"]:
        """The diagonal of its Hessian."""
        bends, radials, away = self._bends(at)
        curved = dot(bends, self.points**2)
        return curved + dot(radials / (at.size + 1), away**2) - jnp.sum(radials)[None]

    def spread(self, at: Float[Array, " n"]) -> Float[Array, ""]:
        """The standard deviation over standard normal points, by slopes and own curvatures."""
        squares = jnp.sum(self.grad(at) ** 2) + jnp.sum(self.curvature_diagonal(at) ** 2) / 2
        return jnp.sqrt(squares)

    # Standard errors: what the prior leaves open of a quantity, less what the samples tell of it.

    def _explained(self, features: Array) -> Array:
        near = self.closeness if features.ndim == 1 else self.closeness[:, None]
        return jax.scipy.linalg.solve_triangular(self.factor, near * features, lower=True)

    def _stderr(self, features: Array, prior: Array) -> Array:
        explained = jnp.sum(self._explained(features) ** 2, axis=0)
        return self.amplitude * jnp.sqrt(jnp.maximum(prior - explained, 0))

    def _covariance(self, a: Array, b: Array) -> Array:
        """Of the smoothed function at two places, before any sample."""
        n = a.size
        product = dot(a, b)
        curved = (product**2 + dot(a, a) + dot(b, b) + n) / n**2
        height = (n / (n + 2)) ** (n / 2)
        rest = height * jnp.exp(-jnp.sum((a - b) ** 2) / (2 * (n + 2)))
        return product / n + self.curved * curved + self.radial * rest

    def value_stderr(self, at: Float[Array, " n"]) -> Float[Array, ""]:
        """The standard error of the smoothed function."""
        explained = self._explained(self._value_features(at))
        ones = self._explained(jnp.ones_like(self.closeness))
        left = self._covariance(at, at) - jnp.sum(explained**2)
        constant = (1 - dot(explained, ones)) ** 2 / jnp.sum(ones**2)
        return self.amplitude * jnp.sqrt(jnp.maximum(left + constant, 0))

    def difference_stderr(self, at: Float[Array, " n"]) -> Float[Array, ""]:
        """The standard error of `value(at) - value(0)`."""
        zero = jnp.zeros_like(at)
        prior = self._covariance(at, at) - 2 * self._covariance(at, zero)
        features = self._value_features(at) - self._value_features(zero)
        return self._stderr(features, prior + self._covariance(zero, zero))

    def _grad_features(self, at: Array) -> tuple[Array, Array]:
        """Weights of the points and of the place in the gradient's features."""
        radials = self._radial_terms(at) / (at.size + 1)
        return (1 + 2 * self.curved * self._products(at)) / at.size + radials, radials

    def grad_stderr(self, at: Float[Array, " n"]) -> Float[Array, " n"]:
        """The standard errors of the gradient's entries."""
        slopes, radials = self._grad_features(at)
        features = slopes[:, None] * self.points - radials[:, None] * at[None]
        return self._stderr(features, self._grad_prior(at, at**2))

    def slope_stderr(self, at: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, ""]:
        """The standard error of the gradient along a unit vector."""
        slopes, radials = self._grad_features(at)
        along = dot(at, v)
        features = slopes * dot(self.points, v) - radials * along
        return self._stderr(features, self._grad_prior(at, along**2))

    def _grad_prior(self, at: Array, along: Array) -> Array:
        n = at.size
        curved = 2 * self.curved / n**2 * (along + dot(at, at))
        return curved + 1 / n + self.radial * (n / (n + 2)) ** (n / 2) / (n + 2)

    def curvature_stderr(self, at: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, ""]:
        """The standard error of v·Hv, for a unit vector."""
        n = at.size
        along = dot(self.points, v)
        away = along - dot(at, v)
        radials = self._radial_terms(at) / (n + 1)
        features = 2 * self.curved * along**2 / n**2 + radials * (away**2 / (n + 1) - 1)
        rest = 3 * self.radial * (n / (n + 2)) ** (n / 2) / (n + 2) ** 2
        return self._stderr(features, 4 * self.curved / n**2 + rest)


def fit(
    points: Float[Array, "m n"],
    values: Float[Array, " m"],
    valid: Bool[Array, " m"],
    rounds: Int[Array, " m"] | None = None,
) -> ScalarFit:
    """The fit with the shares and the ridge that make the samples likeliest.

    Samples that are not valid are left out; any values may stand there. Those of one of the
    `rounds` have the same random numbers: what these add to all of them says nothing.
    """
    dtype = points.dtype
    spread = jnp.mean(points * points, axis=1)
    # noise grows with the sixth power of the distance, as the square of a cubic remainder does
    closeness = jnp.maximum(1, spread / _REACH**2) ** -1.5
    closeness = jnp.where(valid, closeness, 0)
    count = jnp.sum(valid).astype(dtype)
    known = jnp.where(valid, values, jnp.nan)
    middle, least = jnp.nanmedian(known), jnp.nanmin(known)
    # what is far above the others says little of where the function is low
    above, high = jnp.where(valid, values - least, 0), _HIGH * (middle - least)
    tall = (above > high) & (high > 0)
    height = jnp.where(tall, high / jnp.where(tall, above, 1), 1)
    closeness *= jnp.maximum(height, _FAINT)
    above = jnp.where(tall, jnp.minimum(above, high / _FAINT), above)
    targets = jnp.where(valid, above - (middle - least), 0)
    mass = jnp.maximum(jnp.sum(closeness**2), jnp.finfo(dtype).tiny)
    scale = jnp.sqrt(jnp.sum((closeness * targets) ** 2) / mass)
    scale = jnp.where(scale > 0, scale, 1)
    targets = targets / scale
    gram = dot(points, points.T) / points.shape[1]
    apart = spread[:, None] + spread[None] - 2 * gram
    radial = jnp.exp(-jnp.maximum(apart, 0) / 2)
    weights = closeness[:, None] * closeness[None]
    size = values.size
    kinds = [gram, gram**2, radial]
    if rounds is not None:
        kinds.append((rounds[:, None] == rounds[None]).astype(dtype))
    parts = jnp.stack(kinds) * weights[None]
    parts = jnp.concatenate([parts, jnp.eye(size, dtype=dtype)[None]]).reshape(-1, size**2)
    sides = closeness[:, None] * jnp.stack([jnp.ones_like(targets), targets], axis=1)

    def solve(choice: Array) -> tuple[Array, ...]:
        # one product, as sums of entries are slow where little is optimised
        kernel = dot(jnp.append(jnp.ones(1, dtype), choice), parts).reshape(size, size)
        factor = jax.lax.linalg.cholesky(kernel, symmetrize_input=False)
        ones, values = jax.scipy.linalg.solve_triangular(factor, sides, lower=True).T
        mass = dot(ones, ones)
        constant = dot(ones, values) / mass
        left = values - constant * ones
        misfit = jnp.maximum(dot(left, left) / count, jnp.finfo(dtype).tiny)
        volume = jnp.sum(jnp.log(jnp.diagonal(factor)))
        volume -= (size - count) / 2 * jnp.log(choice[-1])
        evidence = -(count - 1) / 2 * jnp.log(misfit) - volume - jnp.log(mass) / 2
        return evidence, left, constant, misfit, factor

    # the variance of a round's common number: none, or as much as all values have
    common = ((),) if rounds is None else ((0.0,), (1.0,))
    choices = [
        (*shares, *offset, ridge)
        for ridge in _RIDGES[dtype.name]
        for offset in common
        for shares in _SHARES
    ]
    table = jnp.asarray(choices, dtype)
    # one after the other, as LAPACK takes them anyway: a vmap would hold all matrices at once
    evidence: Array = jax.lax.map(lambda choice: solve(choice)[0], table)
    choice = table[jnp.argmax(jnp.where(jnp.isfinite(evidence), evidence, -jnp.inf))]
    _, left, constant, misfit, factor = solve(choice)
    left = jax.scipy.linalg.solve_triangular(factor, left, lower=True, trans=1)
    return ScalarFit(
        points=points,
        coefficients=scale * closeness * left,
        constant=middle + scale * constant,
        curved=choice[0],
        radial=choice[1],
        amplitude=scale * jnp.sqrt(misfit),
        closeness=closeness,
        factor=factor,
        noise=scale * jnp.sqrt(misfit * choice[-1]),
    )
