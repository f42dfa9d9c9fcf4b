"""The parameters of a run in unit coordinates: a pytree of spaces beside its start."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from smoothdiff._numbers import floating
from smoothdiff._ranges import Integer
from smoothdiff._spaces import SIGMA, AbstractSpace

_LEAF = jax.tree.structure(0)


@dataclasses.dataclass(frozen=True)
class UnitSpace:
    """Takes parameters to unit coordinates and back; equal to another of the same values.

    `spaces` has an entry for each leaf of the parameters, None where a leaf is passed as it is.
    """

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[np.dtype, ...]
    names: tuple[str, ...]
    spaces: tuple[AbstractSpace | None, ...]

    @staticmethod
    def of(y0: PyTree, spaces: PyTree) -> "UnitSpace":
        """The unit coordinates of parameters that start at `y0`.

        Args:
            y0: where to start, a pytree of numbers and arrays, in natural values.
            spaces: a pytree like `y0` of spaces and None; one of them stands for all leaves below.

        Raises:
            TypeError: parameters that are not real; spaces that are none.
            ValueError: another structure; a start that its space does not hold.
        """
        paths, treedef = jax.tree_util.tree_flatten_with_path(y0)
        entries = _entries(spaces, y0, treedef)
        leaves = [jnp.asarray(leaf) for _, leaf in paths]
        keys = [jax.tree_util.keystr(path) for path, _ in paths]
        for leaf, space, key in zip(leaves, entries, keys, strict=True):
            if space is not None and jnp.iscomplexobj(leaf):
                raise TypeError(
                    f"the parameter{key} is complex: pass its real and imaginary part, each with "
                    "a space, or None for a space"
                )
        return UnitSpace(
            treedef,
            tuple(leaf.shape for leaf in leaves),
            tuple(leaf.dtype for leaf in leaves),
            tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths),
            tuple(
                None if space is None else space.starting_at(leaf, key)
                for leaf, space, key in zip(leaves, entries, keys, strict=True)
            ),
        )

    def unit(self, y: PyTree) -> PyTree[Array]:
        """The unit coordinates of natural values, as floating-point arrays."""
        to_unit = lambda space, leaf: floating(leaf) if space is None else space.to_unit(leaf)
        return self._map(to_unit, y)

    def natural(self, u: PyTree) -> PyTree:
        """The natural values at unit coordinates, as the function sees them.

        Whole numbers have the integer dtype of the start, or the default one if it was a float.
        """

        def seen(space: AbstractSpace | None, leaf: Any, dtype: np.dtype) -> Any:
            if space is None:
                return leaf
            y = space.to_natural(leaf)
            whole = jnp.issubdtype(y.dtype, jnp.integer) and jnp.issubdtype(dtype, jnp.integer)
            return y.astype(dtype) if whole else y

        return self._map(seen, u, self.dtypes)

    def axis(self, u: PyTree) -> PyTree:
        """Where plots show unit coordinates."""
        return self._map(lambda space, leaf: leaf if space is None else space.to_axis(leaf), u)

    def bounds(self) -> tuple[PyTree[float], PyTree[float]] | None:
        """The pair (low, high) in unit coordinates, for all leaves; None if none has an end."""
        ends = [(-np.inf, np.inf) if s is None else s.unit_bounds for s in self.spaces]
        if not np.any(np.isfinite(ends)):
            return None
        low, high = zip(*ends, strict=True)
        return self.treedef.unflatten(low), self.treedef.unflatten(high)

    def count(self) -> int | None:
        """How many points there are, if all parameters are whole numbers."""
        counts = []
        for space, shape in zip(self.spaces, self.shapes, strict=True):
            if not isinstance(space, Integer):
                return None
            counts += np.broadcast_to(space.count(), shape).reshape(-1).tolist()
        return math.prod(counts)

    def sigma(self, share: PyTree | None = None) -> PyTree:
        """The smoothing width in unit coordinates, None where there is no space to say it.

        Args:
            share: of each range whose space does not say its own, like the parameters; by default
                a fifth.
        """
        count = len(self.spaces)
        shares = [SIGMA] * count if share is None else self.treedef.flatten_up_to(share)
        width = lambda space, part: np.asarray(space.width(part), float)
        widths = [
            None if space is None else width(space, part)
            for space, part in zip(self.spaces, shares, strict=True)
        ]
        return self.treedef.unflatten(widths)

    def labels(self) -> list[str]:
        """A name for each number of the parameters, in the order of `jax.flatten_util`."""
        return [
            label
            for space, name, shape in zip(self.spaces, self.names, self.shapes, strict=True)
            for label in _labels(None if space is None else space.label, name, shape)
        ]

    def wrap(self, fun: Callable[[PyTree, PyTree], Any]) -> "InUnits":
        """The function of unit coordinates, `wrapped(u, args)`."""
        return InUnits(fun, self)

    def _map(self, fun: Callable[..., Any], tree: PyTree, *rest: Iterable) -> PyTree:
        leaves = self.treedef.flatten_up_to(tree)
        return self.treedef.unflatten(map(fun, self.spaces, leaves, *rest))


class InUnits(eqx.Module):
    """A function of unit coordinates from one of natural values, equal by value."""

    fun: Callable[[PyTree, PyTree], Any]
    space: UnitSpace = eqx.field(static=True)

    def __call__(self, u: PyTree, args: PyTree = None) -> Any:
        """What the function returns at the natural values of `u`."""
        return self.fun(self.space.natural(u), args)


def _entries(spaces: PyTree, y0: PyTree, treedef: Any) -> list[AbstractSpace | None]:
    is_entry = lambda s: s is None or isinstance(s, AbstractSpace)
    try:
        full = jax.tree.broadcast(spaces, y0, is_leaf=is_entry)
    except ValueError as error:
        one_array = treedef == _LEAF and np.ndim(y0) > 0
        if one_array and isinstance(spaces, list | tuple) and len(spaces) > 1:
            raise ValueError(
                f"space has {len(spaces)} entries, and y0 is one array: for numbers of one kind "
                f"write one space, {_together(spaces)}; where kinds differ make y0 a dict of "
                'parameters, and space too, such as y0={"a": 1.0, "b": 2}, space={"a": '
                'sd.Range(0, 2), "b": sd.Integer(1, 3)}'
            ) from error
        raise ValueError(
            "space must be one space, such as Range(0, 1), or a pytree of spaces and None with the "
            f"structure of the parameters, {treedef}, not "
            f"{jax.tree.structure(spaces, is_leaf=is_entry)}"
        ) from error
    # a None in the parameters themselves is no leaf, so it needs no entry
    entries = treedef.flatten_up_to(full)
    for entry in entries:
        if not is_entry(entry):
            raise TypeError(
                f"space has {entry!r} in it: write a space, such as Range(low, high), or None for "
                "a parameter that is passed as it is"
            )
    return entries


def _together(spaces: Sequence) -> str:
    """How to write spaces of one kind as one; an example where they are not."""
    first = spaces[0]
    kind, log = type(first), getattr(first, "log", False)
    same = all(type(s) is kind and getattr(s, "log", False) == log for s in spaces)
    if not (same and hasattr(first, "low") and hasattr(first, "high")):
        return "such as sd.Range(jnp.array([0, 0]), jnp.array([2, 3]))"
    low, high = ([getattr(s, end) for s in spaces] for end in ("low", "high"))
    more = ", log=True" if log else ""
    return f"sd.{kind.__name__}(jnp.array({low}), jnp.array({high}){more})"


def _labels(label: Any, name: str, shape: tuple[int, ...]) -> list[str]:
    if label is not None and not isinstance(label, str):
        return np.broadcast_to(label, shape).reshape(-1).tolist()
    label = label or name or "y"
    if not shape:
        return [label]
    return [f"{label}[{', '.join(map(str, index))}]" for index in np.ndindex(shape)]
