"""What is wrong with a call of `minimise` or `least_squares`, and what to write instead."""

import contextlib
import inspect
import math
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float, PyTree

from smoothdiff._params import check_pair, is_concrete, side_leaves
from smoothdiff._solvers import AbstractSmoothSolver
from smoothdiff._solvers._wrapped import wraps_ours

_HOST = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerBoolConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)


def check_start(y0: PyTree) -> None:
    """Raises ValueError if the start has no number, or one that is NaN or infinite."""
    if not sum(map(np.size, jax.tree.leaves(y0))):
        raise ValueError(
            "y0 is empty, there is no number in it: give at least one parameter to search for"
        )
    for path, leaf in jax.tree_util.tree_flatten_with_path(y0)[0]:
        if jnp.issubdtype(getattr(leaf, "dtype", type(leaf)), jnp.inexact):
            numbers = np.asarray(leaf)
            for at in np.argwhere(~np.isfinite(numbers))[:1]:
                entry = f"[{', '.join(map(str, at))}]" if len(at) else ""
                raise ValueError(
                    f"y0{jax.tree_util.keystr(path)}{entry} = {numbers[tuple(at)]} is not finite: "
                    "give a start at finite numbers"
                )


def check_untraced(name: str, solver: str, inputs: PyTree) -> None:
    """Raises TypeError where JAX traces the call, or one of its inputs."""
    # under jit new arrays are traced, and inputs may be hidden in the function
    if not all(map(is_concrete, [*jax.tree.leaves(inputs), jnp.zeros(())])):
        raise TypeError(
            f"sd.{name} runs outside of jit, vmap and grad: inside them call "
            f'optimistix.{name}(fun, solver, y0, args, options={{"key": key}}) with a solver such '
            f"as sd.{solver}(sigma)"
        )


def check_call(fun: Any, y0: Any, bounds: Any, space: Any, takes_key: bool = False) -> None:
    """Raises TypeError or ValueError for arguments in another order or of another library."""
    solvers = AbstractSmoothSolver | optx.AbstractIterativeSolver
    if isinstance(fun, solvers) or callable(y0) or isinstance(y0, solvers):
        raise TypeError(
            "the arguments are (fun, y0, args), and the solver goes by keyword: write "
            "sd.minimise(fun, y0, args, key=key, solver=solver)"
        )
    if not callable(fun):
        raise TypeError(f"fun must be a function of (y, args), not {type(fun).__name__}")
    check_start(y0)
    with contextlib.suppress(ValueError):  # some builtins have no signature
        try:
            inspect.signature(fun).bind(*((y0, None, None) if takes_key else (y0, None)))
        except TypeError as error:
            raise TypeError(
                "with takes_key=True fun is called as fun(y, args, key): leave it out if fun takes "
                "no key, and write lambda y, args, key: fun(y, key) if it takes no args"
                if takes_key
                else "fun is called as fun(y, args): write lambda y, args: fun(y) if it takes y "
                "alone; box = sd.black_box(fun), then lambda y, args: box(y), if it is not JAX; "
                "and takes_key=True if it takes a key: fun(y, args, key)"
            ) from error
    check_bounds(bounds, y0, space)


def check_bounds(bounds: Any, y0: PyTree, space: Any = None) -> None:
    """Raises ValueError for bounds in the form of another library, or with nothing in between."""
    if bounds is None:
        return
    if space is not None:
        raise ValueError(
            "give a space or bounds: a space has bounds of its own, sd.Range(low, high) for each "
            "parameter, and None for one without"
        )
    if _are_pairs(bounds) and not isinstance(y0, tuple | list):
        if len(bounds) == 2 and jnp.shape(y0) == (2,):
            raise ValueError(
                f"bounds={bounds} can be read in two ways. If these are (low, high), write bounds="
                f"{_arrays(*bounds)}. If they are a pair for each parameter, as in SciPy, write "
                f"bounds={_arrays(*zip(*bounds, strict=True))}"
            )
        raise ValueError(
            "bounds must be a pair (low, high), each a number or like y0, not a pair for each "
            "parameter as in SciPy: write low, high = map(jnp.array, zip(*bounds))"
        )
    check_pair(bounds)
    lows, highs = (side_leaves(bounds[0], -np.inf, y0), side_leaves(bounds[1], np.inf, y0))
    sizes = map(np.size, jax.tree.leaves(y0))
    if sum(sizes) and all(map(_equal, lows, highs)):
        raise ValueError(
            "the low and the high bound of every parameter are equal, so there is nothing to "
            "search: write bounds=(low, high) with low below high for at least one of them"
        )


def _are_pairs(bounds: Any) -> bool:
    some = isinstance(bounds, tuple | list) and len(bounds) > 0
    return some and all(isinstance(b, tuple | list) and len(b) == 2 for b in bounds)


def _arrays(low: Sequence, high: Sequence) -> str:
    """How a user writes these sides; None is no bound, as in SciPy."""
    sides = (low, "-jnp.inf"), (high, "jnp.inf")
    lists = (", ".join(end if x is None else str(x) for x in side) for side, end in sides)
    return "({})".format(", ".join(f"jnp.array([{numbers}])" for numbers in lists))


def _equal(low: Any, high: Any) -> bool:
    """Whether two bounds are known to be equal; what is wrong with their shapes is told later."""
    if not (is_concrete(low) and is_concrete(high)):
        return False
    low, high = np.asarray(low), np.asarray(high)
    try:
        return bool(np.all(low == high))
    except ValueError:
        return False


def check_solver(solver: Any, kind: type, example: str, sigma: Any, support: Any) -> None:
    """Raises TypeError or ValueError unless the solver can run here, with its own settings."""
    if not isinstance(solver, AbstractSmoothSolver) and not wraps_ours(solver):
        raise TypeError(
            f"solver must be one of smoothdiff's, such as {example}, or one of optimistix's around "
            f"it, not {type(solver).__name__}: others run under optimistix, on smooth(fun, sigma) "
            "with a fixed key"
        )
    if not isinstance(solver, kind):
        raise TypeError(
            f"{type(solver).__name__} is not for this: functions that return one number go with "
            "sd.minimise and a solver such as FirstOrder, residuals with sd.least_squares and "
            "GaussNewton"
        )
    if sigma is not None or support is not None:
        name = "sigma" if sigma is not None else "support"
        raise ValueError(
            f"{name} is for the default solver: give it to yours, {type(solver).__name__}(...)"
        )


def returned(out: PyTree) -> str:
    """What the function returned, in words."""
    shapes, dtypes = jax.tree.map(lambda a: a.shape, out), jax.tree.map(lambda a: str(a.dtype), out)
    return f"fun returned shape {shapes} and dtype {dtypes}"


def check_number(out: PyTree) -> None:
    leaves = jax.tree.leaves(out)
    if [leaf.shape for leaf in leaves] != [()] or not jnp.issubdtype(leaves[0].dtype, jnp.floating):
        raise TypeError(
            f"{returned(out)}; it must return one real number: use jnp.mean(...) or "
            ".astype(float), or give residuals to sd.least_squares"
        )


def check_residuals(out: PyTree) -> None:
    leaves = jax.tree.leaves(out)
    if not leaves or not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
        raise TypeError(
            f"{returned(out)}; it must return residuals, real floating-point arrays: "
            "use .astype(float)"
        )


def check_squares(row: Float[np.ndarray, " P"]) -> None:
    """Raises ValueError if squares of the first residuals are too small to be compared.

    Below the smallest number over its rounding, half their sum would be nothing before it is as low
    as rounding lets it be, and a run would end there as if it had converged.
    """
    largest, info = float(np.max(np.abs(row), initial=0)), np.finfo(row.dtype)
    if not (np.isfinite(largest) and largest > 0):
        return
    least = math.sqrt(2 * float(info.tiny) / float(info.eps))
    length = largest * float(np.linalg.norm(row / row.dtype.type(largest)))
    if length < least:
        other = "" if info.bits == 64 else ", or use float64"
        factor = 10.0 ** -math.floor(math.log10(largest))
        raise ValueError(
            f"the first residuals are at most {largest:.2g}, and squares of such numbers are too "
            f"small for {row.dtype}: return them times {factor:.0e}, for example{other}"
        )


@contextlib.contextmanager
def explained() -> Iterator[None]:
    """JAX's errors about functions that it cannot trace say what to write instead."""
    try:
        yield
    except _HOST as error:
        raise TypeError(
            "fun does what JAX cannot trace, such as NumPy on its arguments: use jax.numpy, or "
            "wrap it once, box = sd.black_box(fun), and give lambda y, args: box(y), or "
            "box(y, args) if it takes both"
        ) from error
