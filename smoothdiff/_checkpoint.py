"""A run on disk: a pytree of arrays in one .npz file, tied to the problem that it belongs to."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from smoothdiff._identity import Identity, can_change, listed


class Checkpoint:
    """Where a run is kept, and what must be the same when it is taken up again."""

    def __init__(self, path: str | os.PathLike, **problem: Any):
        """Names the file, whose directory is created, and the values that make up the problem.

        What counts in these is said at `parts`. What changes while the run goes on, such as a list
        to which the function appends, is no part of the problem. What else can change in place, and
        `fun` uses it, is for the caller to judge: `doubtful` has the parts that differ.
        """
        self.doubtful: set[str] = set()
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._identity = Identity(**problem)

    def load(self, like: PyTree) -> PyTree | None:
        """What was saved, with the structure and dtypes of `like`; None if there is no file.

        Raises:
            ValueError: the file is no checkpoint, or one of another problem or version.
        """
        if not self._path.exists():
            return None
        try:
            with self._path.open("rb") as opened, np.load(opened) as file:
                kept = json.loads(str(file["problem"]))
                arrays = [file[str(i)] for i in range(len(file.files) - 1)]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self._path} is not a checkpoint: name another file") from error
        differ = self._identity.differing(kept)
        self.doubtful = {name for name in differ if name.startswith("fun") and can_change(name)}
        if differ > self.doubtful:
            raise self.other(f"its {listed(differ)} differed")
        self._identity.parts = kept
        leaves, treedef = jax.tree.flatten(like)
        if len(arrays) != len(leaves):
            raise ValueError(
                f"the checkpoint {self._path} was written by another version. Name another file, "
                "or delete this one"
            )
        return treedef.unflatten(map(_restore, arrays, leaves))

    def other(self, how: str) -> ValueError:
        """The error that the file is of another problem, and how it is known."""
        return ValueError(
            f"the checkpoint {self._path} was written for another problem: {how}. Name another "
            "file, delete this one, or make the call as it was"
        )

    def save(self, tree: PyTree) -> None:
        """Replaces the file; a crash in the middle of it leaves the old one."""
        self._identity.settle()
        arrays: dict[str, Any] = {"problem": np.asarray(json.dumps(self._identity.parts))}
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
