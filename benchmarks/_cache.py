"""What has been measured stays on disk, so that an interrupted benchmark goes on where it was."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import smoothdiff as sd

JSON, FINGERPRINT = "json", "fingerprint"
LIBRARY = Path(sd.__file__).parent


def cached(
    path: Path, fingerprint: str, make: Callable[[], Mapping[str, Any]], fresh: bool = False
) -> dict[str, Any]:
    """What `make` gives: from its file if that has the same fingerprint, else made and written.

    Args:
        path: The file, ending in .npz.
        fingerprint: Changes when what is made would.
        make: Gives what is to be stored by name: NumPy arrays, and what JSON knows.
        fresh: Make it anew in any case.
    """
    if not fresh and path.exists():
        with np.load(path) as stored:
            found = dict(stored)
        if str(found.pop(FINGERPRINT)) == fingerprint:
            return json.loads(str(found.pop(JSON))) | found
    made = dict(make())
    arrays = {name: value for name, value in made.items() if isinstance(value, np.ndarray)}
    rest = json.dumps({name: value for name, value in made.items() if name not in arrays})
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        content: dict[str, Any] = {**arrays, JSON: rest, FINGERPRINT: fingerprint}
        np.savez_compressed(file, **content)
    os.replace(temporary, path)  # all or nothing: a kill leaves no half file
    return made


def fingerprint(*parts: Any) -> str:
    """Another text for other parts: arrays by their bytes, all else by its repr."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:16]


def library() -> str:
    """Another text for another version of any file of smoothdiff."""
    return fingerprint(*(path.read_text() for path in sorted(LIBRARY.glob("**/*.py"))))
