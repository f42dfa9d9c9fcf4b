"""The smoothed parameters of a call as one vector, and back: sigma, bounds and their checks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from smoothdiff._layout import Layout
from smoothdiff._numbers import check_real, check_whole

# raw keys that are not of the default kind, by how many words they have
_KINDS = {2: "threefry2x32", 4: "rbg"}


def is_concrete(x: Any) -> bool:
    """Whether the value can be looked at now, which it cannot while JAX traces it."""
    return not isinstance(x, jax.core.Tracer)


def as_key(key: Any) -> Array:
    """A typed key from a typed or raw one, which was given by keyword.

    Raises:
        TypeError: it is not one key.
    """
    given = f"{type(key).__name__}{list(key.shape) if hasattr(key, 'shape') else ''}"
    return _typed(key, f"key must be one random key: write key=jax.random.key(0), not {given}")


def as_first_key(key: Any) -> Array:
    """As `as_key`, for the first argument of what a transform returns."""
    return _typed(
        key,
        "the first argument must be one random key: call g(jax.random.key(0), *args), "
        f"not g({type(key).__name__}, ...); for many keys use jax.vmap",
    )


def _typed(key: Any, advice: str) -> Array:
    dtype = getattr(key, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if key.ndim == 0:
            return key
    elif dtype == jnp.uint32 and key.ndim == 1 and key.size in _KINDS:
        usual = jax.eval_shape(lambda: jax.random.PRNGKey(0)).size
        return jax.random.wrap_key_data(key, impl=None if key.size == usual else _KINDS[key.size])
    raise TypeError(advice)


def as_argnums(argnums: int | Sequence[int], num_args: int) -> tuple[int, ...]:
    """The chosen positions among `num_args` arguments of the function, as non-negative numbers."""
    chosen = tuple(argnums) if isinstance(argnums, Sequence) else (argnums,)
    for i in chosen:
        check_whole(i, "argnums")
        if not -num_args <= i < num_args:
            raise ValueError(
                f"argnums={argnums} but the function was given {num_args} positional argument(s) "
                "after the key; argnums counts the function's own arguments, from 0"
            )
    chosen = tuple(i % num_args for i in chosen)
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"argnums={argnums} names an argument twice")
    return chosen


@dataclass(frozen=True)
class Params:
    """The arguments of one call, taken apart.

    `theta`, `sigma` and both `bounds`, if there are any, have one entry for each smoothed number.
    `free` holds the leaves whose sigma is None. `sound` is False if traced arguments turn out
    invalid.
    """

    layout: Layout
    theta: Array
    sigma: Array
    sigma_traced: bool
    bounds: tuple[Array, Array] | None
    sound: Array | None
    free: list[Array]

    def check_free(self) -> None:
        """Raises TypeError for a leaf that has no derivative."""
        for leaf in self.free:
            if not jnp.issubdtype(leaf.dtype, jnp.inexact):
                raise TypeError(
                    f"a parameter of dtype {leaf.dtype} has no derivative: make it another "
                    "argument of the function"
                )

    def clip(self, x: Array) -> Array:
        """The point that the function may see: within the bounds, if there are any."""
        return x if self.bounds is None else jnp.clip(x, *self.bounds)

    def reflected(self, x: Array) -> Array:
        """The sample that the function may see: reflected where a bound is crossed."""
        if self.bounds is None:
            return x
        low, high = self.bounds
        return self.clip(jnp.where(x < low, 2 * low - x, jnp.where(x > high, 2 * high - x, x)))


def choose(args: tuple, argnums: int | Sequence[int]) -> PyTree:
    """The chosen argument, or the tuple of chosen arguments if `argnums` is a sequence."""
    chosen = as_argnums(argnums, len(args))
    several = isinstance(argnums, Sequence)
    return tuple(args[i] for i in chosen) if several else args[chosen[0]]


def replace(args: tuple, argnums: int | Sequence[int], new: PyTree) -> tuple:
    """The arguments with the chosen ones replaced; undoes `choose`."""
    chosen = as_argnums(argnums, len(args))
    out = list(args)
    several = isinstance(argnums, Sequence)
    for i, value in zip(chosen, new if several else (new,), strict=True):
        out[i] = value
    return tuple(out)


def take_apart(target: PyTree, sigma: PyTree, bounds: tuple[PyTree, PyTree] | None) -> Params:
    """Checks the parameters of a call and lays the smoothed leaves out as one vector."""
    paths, treedef = jax.tree_util.tree_flatten_with_path(target)
    names = [jax.tree_util.keystr(path) for path, _ in paths]
    # as floats, as JAX has no integers of any size
    sigmas = [float(s) if type(s) is int else s for s in _match(sigma, target, "sigma")]
    smoothed = tuple(s is not None for s in sigmas)
    if not any(smoothed):
        raise ValueError(
            "nothing is smoothed: give at least one leaf of the parameters a positive sigma, or "
            "differentiate the function with jax.grad itself"
        )
    leaves = [
        _as_real(leaf, name) if keep else jnp.asarray(leaf)
        for (_, leaf), name, keep in zip(paths, names, smoothed, strict=True)
    ]
    for s, leaf, name in zip(sigmas, leaves, names, strict=True):
        if s is not None:
            _check_sigma(s, leaf, name)
    layout = Layout(
        treedef, tuple(x.shape for x in leaves), tuple(x.dtype for x in leaves), smoothed
    )
    if not any(leaf.size for leaf, keep in zip(leaves, smoothed, strict=True) if keep):
        raise ValueError(
            "the smoothed parameters are empty, there is no number in them: pass arrays with at "
            "least one entry"
        )
    theta, width = layout.vector(leaves), layout.vector(sigmas)
    sigma_traced = not all(map(is_concrete, sigmas))
    checks = [
        _sigma_fits(s, leaf)
        for s, leaf in zip(sigmas, leaves, strict=True)
        if s is not None and not (is_concrete(s) and is_concrete(leaf))
    ]
    sides = None
    if bounds is not None:
        check_pair(bounds)
        lows = side_leaves(bounds[0], -np.inf, target)
        highs = side_leaves(bounds[1], np.inf, target)
        for lo, hi, leaf, name, keep in zip(lows, highs, leaves, names, smoothed, strict=True):
            if keep:
                _check_bounds(lo, hi, leaf, name)
        low, high = sides = layout.vector(lows), layout.vector(highs)
        if not all(map(is_concrete, (low, high, theta))):
            checks.append(jnp.all((low <= theta) & (theta <= high)))
    sound = jnp.all(jnp.stack(checks)) if checks else None
    free = [leaf for leaf, keep in zip(leaves, smoothed, strict=True) if not keep]
    return Params(layout, theta, width, sigma_traced, sides, sound, free)


def like(value: PyTree, target: PyTree, what: str) -> PyTree:
    """A tree with an entry of `value` for each leaf of `target`; a number stands for all of them.

    Raises:
        ValueError: it has another structure.
    """
    try:
        return jax.tree.broadcast(value, target, is_leaf=lambda v: v is None)
    except ValueError as error:
        raise ValueError(
            f"{what} must be a number or a pytree with the structure of the parameters, "
            f"{jax.tree.structure(target)}, not {jax.tree.structure(value)}"
            + ("; a list is a pytree: use np.array" if isinstance(value, list) else "")
        ) from error


def _match(value: PyTree, target: PyTree, what: str) -> list:
    """One entry of `value` for each leaf of `target`."""
    full = like(value, target, what)
    # a None in the parameters themselves is no leaf, so it needs no entry
    return jax.tree.structure(target).flatten_up_to(full)


def _as_real(leaf: Any, name: str) -> Array:
    leaf = jnp.asarray(leaf)
    if not jnp.issubdtype(leaf.dtype, jnp.floating):
        raise TypeError(
            f"the smoothed parameter{name} has dtype {leaf.dtype}: pass real floating-point "
            "parameters, jnp.asarray(x, float), and round inside the function, or make it another "
            "argument of the function"
        )
    if jnp.finfo(leaf.dtype).bits < 32:
        raise TypeError(
            f"the smoothed parameter{name} has dtype {leaf.dtype}, which is too coarse to sample "
            "around: pass x.astype(jnp.float32), and write x.astype(jnp."
            f"{leaf.dtype}) inside the function"
        )
    return leaf


def _check_shape(value: Any, leaf: Array, what: str, name: str) -> None:
    check_real(value, f"{what}{name}")
    try:
        fits = np.broadcast_shapes(jnp.shape(value), leaf.shape) == leaf.shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(
            f"{what}{name} has shape {jnp.shape(value)}, which does not broadcast to its "
            f"parameter's shape {leaf.shape}"
        )


def _check_sigma(sigma: Any, leaf: Array, name: str) -> None:
    _check_shape(sigma, leaf, "sigma", name)
    if not is_concrete(sigma):
        return
    width = np.asarray(sigma)
    if not np.all((width > 0) & np.isfinite(width)):
        raise ValueError(
            f"sigma{name} = {sigma}: the smoothing width must be positive and finite; "
            "use None for a leaf that is not to be smoothed"
        )
    small, large = (getattr(jnp.finfo(leaf.dtype), end) for end in ("tiny", "max"))
    if np.any((width < small) | (width > large)):
        raise ValueError(
            f"sigma{name} = {sigma} is no normal number in {leaf.dtype}, which has those from "
            f"{small:.3g} to {large:.3g}: use float64, or parameters in other units"
        )
    if is_concrete(leaf):
        # half a spacing either way rounds back to theta: every sample would be the same point
        spacing = np.abs(np.spacing(np.abs(np.asarray(leaf))))
        if np.any(width < spacing):
            raise ValueError(
                f"sigma{name} = {sigma} is below the spacing of {leaf.dtype} at its parameter, so "
                "samples round to the parameter itself: use a larger sigma, float64, or "
                "parameters in other units"
            )


def _sigma_fits(sigma: Any, leaf: Array) -> Array:
    """What `_check_sigma` asks for, of values that are traced."""
    width = jnp.broadcast_to(jnp.asarray(sigma).astype(leaf.dtype), leaf.shape)
    theta = jax.lax.stop_gradient(leaf)
    return jnp.all((theta + width / 2 > theta) & (width < jnp.inf))


def check_pair(bounds: Any) -> None:
    """Raises ValueError unless bounds are two sides."""
    if not (isinstance(bounds, tuple | list) and len(bounds) == 2):
        raise ValueError("bounds must be a pair (low, high) of numbers or pytrees")


def side_leaves(side: PyTree, default: float, target: PyTree) -> list:
    """One side of the bounds for each leaf of `target`; the default where it is None."""
    return [default if s is None else s for s in _match(side, target, "bounds")]


def _check_bounds(low: Any, high: Any, leaf: Array, name: str) -> None:
    for side in (low, high):
        _check_shape(side, leaf, "bounds", name)
    if is_concrete(low) and is_concrete(high) and not np.all(np.asarray(low) <= np.asarray(high)):
        raise ValueError(f"bounds{name}: low = {low} is above high = {high}; give (low, high)")
    if all(map(is_concrete, (low, high, leaf))):
        x = np.asarray(leaf)
        dtype = x.dtype
        if np.any((x < np.asarray(low, dtype)) | (x > np.asarray(high, dtype))):
            raise ValueError(
                f"the parameter{name} = {x} lies outside its bounds ({low}, {high}): clip it "
                "first, or widen the bounds"
            )
