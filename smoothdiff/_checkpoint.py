"""A run on disk: a pytree of arrays in one .npz file, tied to the problem that it belongs to."""

import hashlib
import json
import os
import re
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


class Checkpoint:
    """Where a run is kept, and what must be the same when it is taken up again."""

    def __init__(self, path: str | os.PathLike, **problem: PyTree):
        """Names the file, whose directory is created, and the pytrees that make up the problem.

        In these, numbers, arrays and strings count by value and functions by name; what a function
        closes over cannot be seen.
        """
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._problem = {name: _digest(tree) for name, tree in problem.items()}

    def load(self, like: PyTree) -> PyTree | None:
        """What was saved, with the structure and dtypes of `like`; None if there is no file.

        Raises:
            ValueError: the file is no checkpoint, or one of another problem.
        """
        if not self._path.exists():
            return None
        try:
            with self._path.open("rb") as opened, np.load(opened) as file:
                problem = json.loads(str(file["problem"]))
                arrays = [file[str(i)] for i in range(len(file.files) - 1)]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self._path} is not a checkpoint: name another file") from error
        other = sorted(name for name in self._problem if self._problem[name] != problem.get(name))
        if other:
            raise ValueError(
                f"the checkpoint {self._path} was written for another problem: its "
                f"{', '.join(other)} differed. Name another file, delete this one, or make the "
                "call as it was"
            )
        leaves, treedef = jax.tree.flatten(like)
        return treedef.unflatten(map(_restore, arrays, leaves))

    def save(self, tree: PyTree) -> None:
        """Replaces the file; a crash in the middle of it leaves the old one."""
        arrays: dict[str, Any] = {"problem": np.asarray(json.dumps(self._problem))}
        arrays |= {str(i): _numpy(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
        part = self._path.with_name(f"{self._path.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                np.savez(file, **arrays)
            part.replace(self._path)
        finally:
            part.unlink(missing_ok=True)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _restore(array: np.ndarray, like: Any) -> Any:
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(like))
    # NumPy saves the bits of bfloat16 and its like, but not their names
    return array.view(like.dtype) if array.dtype.kind == "V" else array


def _digest(tree: PyTree) -> str:
    """A short text that changes with the structure of a pytree and with every value in it."""
    leaves, treedef = jax.tree.flatten(tree)
    # the same program has other addresses when it runs again
    digest = hashlib.blake2b(re.sub(r" at 0x[0-9a-f]+", "", str(treedef)).encode(), digest_size=16)
    for leaf in leaves:
        digest.update(_bytes(leaf))
    return digest.hexdigest()


def _bytes(leaf: Any) -> bytes:
    if isinstance(leaf, jax.Array | np.ndarray | np.generic):
        array = _numpy(leaf)
        return f"{array.dtype}{array.shape}".encode() + array.tobytes()
    if callable(leaf):
        return getattr(leaf, "__qualname__", type(leaf).__qualname__).encode()
    return repr(leaf).encode()
