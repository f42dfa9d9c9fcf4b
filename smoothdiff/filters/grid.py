"""Filters of signals on grids of pixels or voxels, which edges in a guide may stop.

The first `ndim` axes of signal and guide are space, the rest channels. Every filter is linear in
the signal, leaves constants as they are and has no eigenvalue larger than one in magnitude.
"""

import itertools
import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from smoothdiff._numbers import at_least_float32, check_whole, floating
from smoothdiff._params import is_concrete

Filter = Callable[[Float[Array, "..."], Float[Array, "..."]], Float[Array, "..."]]
Scale = int | float | Real[Array, ""]

# weights of all taps times a power of two, exactly, so that sums of 27 large values stay finite
_ROOM = 2.0**-5
# degree of the polynomial of 2^f, |f| <= 1/2, whose error is that of rounding in float32
_DEGREE = 6


def cross_bilateral(
    sigma_d: Scale, levels: int, *, ndim: int, sigma_s: Scale = 1.0, log: bool = False
) -> Filter:
    r"""A filter that smooths where the guide is smooth, and stops at the guide's edges.

    It repeats, for levels $l = 0, 1, ...$ and taps $o \in \{-1, 0, 1\}^\mathrm{ndim}$ in the grid,

    $$ h(x) \leftarrow \frac{\sum_o w_o \, h(x + 2^l o)}{\sum_o w_o}, \quad
       w_o = e^{-\|o\| / \sigma_s} \, e^{-\|\theta(x + 2^l o) - \theta(x)\| / \sigma_d} $$

    with the guide $\theta$ in all levels as it is given. The levels set the reach:
    $2^\mathrm{levels} - 1$ pixels to each side.

    Args:
        sigma_d: scale of differences of the guide, in its units, all channels together: 0 filters
            only where the guide is constant, `jnp.inf` in space alone. May be traced, so that
            gradients and `optax.inject_hyperparams` work.
        levels: number of passes, at least 1; the paper has 3 to 5.
        ndim: number of spatial axes: 1, 2 or 3.
        sigma_s: scale of distances in pixels of the dilated grid. With the default a pass has, in
            the plane, about the variance of binomial weights (1, 2, 1) along each axis.
        log: whether the logarithm of the guide's magnitude is the guide, `sigma_d` then being a
            relative difference.

    Returns:
        `filter(signal, guide)`: arrays of the same space, each with axes of channels or without.
        All channels of a signal have the same weights.

    Raises:
        ValueError: for sigma_d below 0, sigma_s not above 0, no levels, another ndim; and, when it
            filters, for arrays that do not match. Traced scales that are invalid give NaN.

    Example:
        >>> import jax.numpy as jnp
        >>> import smoothdiff as sd
        >>> image = jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        >>> gradient = jnp.array([1.0, 2.0, 3.0, 7.0, 8.0, 9.0])
        >>> smooth = sd.filters.cross_bilateral(0.01, 3, ndim=1)(gradient, image)
        >>> [round(float(g)) for g in smooth]  # the edge is kept
        [2, 2, 2, 8, 8, 8]

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    eq. 3 and 4; Dammertz et al. 2010 for the passes.
    """
    _check_ndim(ndim)
    check_whole(levels, "levels")
    if levels < 1:
        raise ValueError(f"levels={levels}: give at least 1, or leave the filter out")
    if is_concrete(sigma_d) and not sigma_d >= 0:
        raise ValueError(f"sigma_d={sigma_d} must not be negative; 0 keeps every edge of the guide")
    if is_concrete(sigma_s) and not sigma_s > 0:
        raise ValueError(f"sigma_s={sigma_s} must be positive, in pixels; jnp.inf is a box")

    def filter(signal: Float[Array, "..."], guide: Float[Array, "..."]) -> Float[Array, "..."]:
        signal, guide = floating(signal), at_least_float32(floating(guide))
        for array in (signal, guide):
            _check_axes(array, ndim)
        if signal.shape[:ndim] != guide.shape[:ndim]:
            raise ValueError(
                f"signal {signal.shape} and guide {guide.shape} must have the same {ndim} leading "
                "axes, which are space"
            )
        if not signal.size:
            return signal
        dtype = guide.dtype
        edges = jnp.log(jnp.maximum(jnp.abs(guide), jnp.finfo(dtype).tiny)) if log else guide
        distance, spatial = jnp.asarray(sigma_d, dtype), jnp.asarray(sigma_s, dtype)
        # halved, no difference overflows; kept from the largest number, which means outside
        edges = jnp.clip(edges / 2, -_largest(dtype) / 4, _largest(dtype) / 4)
        tiny, large = jnp.finfo(dtype).tiny, _largest(dtype) / (2 * _longest(dtype))
        inverse = 2 * math.log2(math.e) / jnp.clip(distance, tiny, large)
        room = jnp.where((distance >= 0) & (spatial > 0), jnp.asarray(_ROOM, dtype), jnp.nan)
        planes, guides = _planes(at_least_float32(signal), ndim), _planes(edges, ndim)
        for level in range(levels):
            planes = _smooth(planes, guides, inverse, spatial, room, 2**level)
        return jnp.stack(planes, axis=-1).reshape(signal.shape).astype(signal.dtype)

    return filter


def bilateral(
    sigma_d: Scale, levels: int, *, ndim: int, sigma_s: Scale = 1.0, log: bool = True
) -> Filter:
    r"""A filter that the edges of the signal itself stop; it ignores the guide.

    $$ h(x) \leftarrow \frac{\sum_o w_o \, h(x + 2^l o)}{\sum_o w_o}, \quad
       w_o = e^{-\|o\| / \sigma_s} \, e^{-\|s(x + 2^l o) - s(x)\| / \sigma_d} $$

    with the signal s as it is given, where h begins.

    It is for comparison, since gradients are noisier than the parameters that they are gradients
    of. The moments of Adam get weights of their own from it, so that steps may be large.

    Args:
        sigma_d: as for `cross_bilateral`, of the signal.
        levels: as for `cross_bilateral`.
        ndim: as for `cross_bilateral`.
        sigma_s: as for `cross_bilateral`.
        log: whether differences are those of the logarithm of the signal's magnitude.

    Returns:
        `filter(signal, guide)`.

    Raises:
        ValueError: as `cross_bilateral`.

    Example:
        >>> import jax.numpy as jnp
        >>> import smoothdiff as sd
        >>> gradient = jnp.array([1.0, 1.1, 0.9, 7.0, 7.1, 6.9])
        >>> smooth = sd.filters.bilateral(0.2, 3, ndim=1)(gradient, gradient)
        >>> [round(float(g), 2) for g in smooth]  # the step from 1 to 7 is kept
        [1.0, 1.06, 0.94, 7.01, 7.04, 6.97]

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    sections 4.1 and 5.1.1.
    """
    cross = cross_bilateral(sigma_d, levels, ndim=ndim, sigma_s=sigma_s, log=log)

    def filter(signal: Float[Array, "..."], guide: Float[Array, "..."]) -> Float[Array, "..."]:
        return cross(signal, signal)

    return filter


def laplacian(lam: Scale, *, ndim: int, power: int | float = 1) -> Filter:
    r"""Laplacian smoothing $(I + \lambda L)^{-p}$, the same everywhere; it ignores the guide.

    $L$ takes from a pixel each of its 2 ndim neighbours, $(L h)_i = \sum_j (h_i - h_j)$. Pixels at
    the border have fewer neighbours: the Neumann boundary, across which nothing flows. Cosine
    transforms diagonalise it exactly.

    Args:
        lam: strength λ, at least 0 and finite; smooths over about sqrt(λ) pixels. May be traced;
            then a negative one gives NaN.
        ndim: number of spatial axes: 1, 2 or 3.
        power: the exponent p.

    Returns:
        `filter(signal, guide)`.

    Raises:
        ValueError: for a negative or infinite lam, a power that is not positive, another ndim.

    Example:
        >>> import jax.numpy as jnp
        >>> import smoothdiff as sd
        >>> gradient = jnp.array([0.0, 0.0, 1.0, 0.0, 0.0])
        >>> smooth = sd.filters.laplacian(1.0, ndim=1)(gradient, gradient)
        >>> [round(float(g), 2) for g in smooth]
        [0.09, 0.18, 0.45, 0.18, 0.09]

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    section 4.3; Osher et al. 2018, Laplacian smoothing gradient descent.
    """
    _check_ndim(ndim)
    if is_concrete(lam) and not (lam >= 0 and np.isfinite(lam)):
        raise ValueError(f"lam={lam} must be finite and not negative")
    if not power > 0:
        raise ValueError(f"power={power} must be positive")

    def filter(signal: Float[Array, "..."], guide: Float[Array, "..."]) -> Float[Array, "..."]:
        signal = floating(signal)
        _check_axes(signal, ndim)
        if not signal.size:
            return signal
        given, signal = signal.dtype, at_least_float32(signal)
        space, dtype = signal.shape[:ndim], signal.dtype
        # sums over all pixels could overflow, and so could the reciprocal of the largest number
        scaled = signal / 4
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(scaled), initial=jnp.finfo(dtype).tiny))
        waves = jax.scipy.fft.dctn(scaled / size, axes=range(ndim), norm="ortho")
        rates = sum(np.ix_(*(2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in space)))
        rates = jnp.asarray(rates, dtype).reshape(*space, *(1,) * (signal.ndim - ndim))
        gain = (1 + jnp.asarray(lam, dtype) * rates) ** -power
        gain = jnp.where(jnp.asarray(lam) >= 0, gain, jnp.nan)
        smooth = jax.scipy.fft.idctn(waves * gain, axes=range(ndim), norm="ortho") * size * 4
        return smooth.astype(given)

    return filter


def _check_ndim(ndim: int) -> None:
    if ndim not in (1, 2, 3):
        raise ValueError(
            f"ndim={ndim} must be 1, 2 or 3: how many leading axes are space, channels not counted"
        )


def _check_axes(x: Array, ndim: int) -> None:
    if x.ndim < ndim:
        raise ValueError(f"an array of shape {x.shape} has fewer than ndim={ndim} axes of space")


def _planes(x: Array, ndim: int) -> list[Array]:
    """The channels, each an array of its own.

    In one array XLA keeps them innermost on a CPU, in loops too short to be fast: ten times slower.
    """
    space = x.shape[:ndim]
    channels = x.reshape(*space, math.prod(x.shape[ndim:]))
    return [channels[..., c] for c in range(channels.shape[-1])]


def _largest(dtype: np.dtype) -> float:
    return float(jnp.finfo(dtype).max)


@partial(jax.jit, static_argnames="step")
def _smooth(
    signals: list[Array],
    guides: list[Array],
    inverse: Array,
    sigma_s: Array,
    room: Array,
    step: int,
) -> list[Array]:
    """One pass of `cross_bilateral` with taps `step` apart.

    Everything but the padding is one expression, which XLA compiles to one loop over the pixels.
    """
    space = guides[0].shape
    # an axis with fewer pixels than a step has no taps
    reach = [step if step < n else 0 for n in space]
    signals_around = [jnp.pad(x, [(r, r) for r in reach]) for x in signals]
    # what is outside is as different as can be, and gets no weight
    outside = _largest(guides[0].dtype) / 2
    guides_around = [jnp.pad(x, [(r, r) for r in reach], constant_values=outside) for x in guides]
    dtype = signals[0].dtype
    totals = [room.astype(dtype) * x for x in signals]
    weights = jnp.broadcast_to(room, space).astype(dtype)
    for tap in itertools.product(*((-1, 0, 1) if r else (0,) for r in reach)):
        if any(tap):
            start = [r + k * r for k, r in zip(tap, reach, strict=True)]
            there = _distance([_window(x, start, space) for x in guides_around], guides, inverse)
            near = room * jnp.exp(-math.hypot(*tap) / sigma_s)
            weight = (near * _decay(there)).astype(dtype)
            weights += weight
            totals = [
                total + weight * _window(x, start, space)
                for total, x in zip(totals, signals_around, strict=True)
            ]
    return [total / weights for total in totals]


def _window(x: Array, start: list[int], space: tuple[int, ...]) -> Array:
    return jax.lax.slice(x, start, [i + n for i, n in zip(start, space, strict=True)])


def _distance(there: list[Array], here: list[Array], inverse: Array) -> Array:
    """The scaled norm of the difference over channels."""
    # beyond twice what has any weight nothing matters, but squares and derivatives would overflow
    most = 2 * _longest(inverse.dtype) / inverse
    difference = [
        jnp.minimum(jnp.abs(a - b), most) * inverse for a, b in zip(there, here, strict=True)
    ]
    if len(difference) == 1:
        return difference[0]
    square = sum((d**2 for d in difference[1:]), difference[0] ** 2)
    # the square root has no derivative at zero
    return jnp.sqrt(jnp.maximum(square, jnp.finfo(inverse.dtype).tiny))


def _longest(dtype: np.dtype) -> float:
    """Where 2^-u is no longer a normal number."""
    return float(-jnp.finfo(dtype).minexp)


@jax.custom_jvp
def _decay(u: Array) -> Array:
    """2^-u for u >= 0, and nothing where that is not a normal number.

    Exponentials are most of the time on a CPU. In float32 this one, a polynomial and an addition
    to the bits of the exponent, makes a pass up to twice as fast as `jnp.exp` does.
    """
    if u.dtype == jnp.float32:
        whole = jnp.round(u)
        x = (whole - u) * math.log(2)
        power = jnp.ones_like(u)
        for k in range(_DEGREE, 0, -1):
            power = 1 + x / k * power
        bits = jax.lax.bitcast_convert_type(power, jnp.int32) - (whole.astype(jnp.int32) << 23)
        power = jax.lax.bitcast_convert_type(bits, jnp.float32)
    else:
        power = jnp.exp2(-u)
    return jnp.where(u < _longest(u.dtype), power, 0)


@_decay.defjvp
def _decay_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    power = _decay(*primals)
    return power, -math.log(2) * power * tangents[0]
