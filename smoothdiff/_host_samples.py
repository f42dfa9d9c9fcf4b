"""The arguments of calls of a host function, as JAX's callback hands them over.

No call into JAX here, which can hang in a callback, but for asking an array whether it is there.
"""

import functools
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from smoothdiff._digest import custom_nodes, digest_of, parts


class BlackBoxError(RuntimeError):
    """A host function failed. The message names it, its arguments and the original error.

    A `smoothdiff.black_box` raises it; it is what `smoothdiff.minimise` reports in its
    `MinimiseError`. Out of a `jax.jit` of your own comes an error of JAX's, which has the same
    message in its text.

    Example:
        >>> import smoothdiff as sd
        >>> @sd.black_box
        ... def inverse(x):
        ...     return 1 / int(x)
        >>> try:
        ...     inverse(0.0)
        ... except sd.BlackBoxError as error:
        ...     print("division by zero" in str(error))
        True

    Source: own.
    """

    # whether the function failed at its arguments, so that others may do
    at_point = False


def wait_for(leaves: Sequence[Any], name: str, seconds: float = 60.0) -> None:
    """Waits until JAX has handed over the arguments; raises where it seems that it never will.

    Args:
        leaves: What a callback was given. JAX copies arrays of more than 100 kB by a thread of its
            pool. If all of them are busy with callbacks, as the only one of a process on one core
            may be, `numpy.asarray` would wait forever (jax-ml/jax #25861).
        name: Of the host function.
        seconds: How long to wait at most.
    """
    end = time.monotonic() + seconds
    while not all(getattr(leaf, "is_ready", lambda: True)() for leaf in leaves):
        if time.monotonic() > end:
            raise BlackBoxError(
                f"{name}: JAX did not hand over the arguments within {seconds:g} s. Usually that "
                "is because the process has one core, so that JAX has one thread, which cannot "
                "copy large arguments while it waits for a host function: set the environment "
                "variable NPROC=2 before Python starts"
            )
        time.sleep(1e-4)


class Samples:
    """The arguments of a batch of calls: a pytree of arrays that begin with the same batch axes."""

    def __init__(self, leaves: Sequence[Any], ndims: Sequence[int], tree: Any):
        """Takes leaves whose batch axes, before the `ndims` of their own, may have size 1."""
        arrays = [np.asarray(leaf) for leaf in leaves]
        lead = arrays[0].ndim - ndims[0] if arrays else 0
        self.batch_shape = np.broadcast_shapes(*(array.shape[:lead] for array in arrays))
        self._arrays = [
            np.broadcast_to(array, self.batch_shape + array.shape[lead:]) for array in arrays
        ]
        self.tree = tree
        self._digests: dict[tuple, bytes] = {}

    def __len__(self) -> int:
        return math.prod(self.batch_shape)

    def arguments(self, i: int | None) -> tuple:
        """The arguments of sample `i`, or of all, with one leading axis."""
        if i is not None:
            return self.tree.unflatten(self.leaves(i))
        lead = len(self.batch_shape)
        return self.tree.unflatten(
            [array.reshape(len(self), *array.shape[lead:]) for array in self._arrays]
        )

    def leaves(self, i: int) -> list[np.ndarray]:
        """The arrays in the arguments of sample `i`."""
        index = (*np.unravel_index(i, self.batch_shape), ...)
        return [array[index] for array in self._arrays]

    @functools.cached_property
    def nodes(self) -> dict[str, str | None]:
        """Digests of what the tree holds beside the arrays, which its text need not say."""
        return parts({"": self.tree}) if any(custom_nodes(self.tree)) else {}

    def only(self, chosen: np.ndarray) -> "Samples":
        """The samples for which this is true."""
        if chosen.all():
            return self
        lead = len(self.batch_shape)
        count = int(chosen.sum())
        parts = []
        for array in self._arrays:
            if any(array.strides[:lead]):
                parts.append(array.reshape(len(self), *array.shape[lead:])[chosen])
            else:  # the same for all, and perhaps large
                parts.append(np.broadcast_to(array[(0,) * lead], (count, *array.shape[lead:])))
        return Samples(parts, [part.ndim - 1 for part in parts], self.tree)

    def digest(self, array: np.ndarray) -> bytes:
        """A digest of one of these arrays; of those that all samples share it is made once."""
        where = array.ctypes.data, array.shape, array.strides, array.dtype
        if where not in self._digests:
            self._digests[where] = digest_of(array)
        return self._digests[where]
