"""A file of evaluations: each point and its value as they come, so that none is paid for twice."""

import ast
import contextlib
import json
import os
import re
import sqlite3
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from smoothdiff._database import connected, make, tables, translated
from smoothdiff._digest import digest_of
from smoothdiff._host_samples import Samples
from smoothdiff._identity import Identity, can_change, listed


class Evaluation(NamedTuple):
    """What a function was called with, and what it returned.

    Attributes:
        args: its arguments.
        value: its value there.

    Example:
        >>> import tempfile, numpy as np, smoothdiff as sd
        >>> path = tempfile.mkdtemp() + "/lengths.db"
        >>> f = sd.black_box(lambda x, y: np.hypot(x, y), 0.0, store=path)
        >>> length = f(3.0, 4.0)
        >>> (evaluation,) = sd.load_store(path)
        >>> [float(x) for x in evaluation.args], float(evaluation.value)
        ([3.0, 4.0], 5.0)

    Source: own.
    """

    args: tuple
    value: PyTree[np.ndarray]


def load_store(path: str | os.PathLike) -> list[Evaluation]:
    """The evaluations in the file of a `black_box(..., store=path)`, in the order they came.

    The file can be read while it grows. It is an SQLite database without pickles. An empty file is
    a store that is about to be made, and has no evaluations.

    Args:
        path: the file.

    Returns:
        A list of `Evaluation`: pairs (args, value) of NumPy arrays, in tuples, lists and dicts as
        they were. Nodes of other kinds, such as modules of equinox, become tuples of their arrays.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is another kind of file, or a directory.

    Example:
        >>> import tempfile, jax, jax.numpy as jnp, numpy as np, smoothdiff as sd
        >>> path = tempfile.mkdtemp() + "/distances.db"
        >>> f = sd.black_box(lambda y: np.abs(y - 1).sum(), 0.0, store=path)
        >>> values = jax.vmap(f)(jnp.arange(4.0)[:, None])
        >>> [float(value) for _, value in sd.load_store(path)]
        [1.0, 0.0, 1.0, 2.0]

        A search that begins with them:

        >>> search = sd.Search(jnp.zeros(1), key=jax.random.key(0))
        >>> known = sd.load_store(path)
        >>> search.tell([y for (y,), _ in known], [value for _, value in known])
        >>> search.y
        Array([1.], dtype=float32)

    Source: own.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no store {path}")
    if path.is_dir():
        raise ValueError(f"{path} is a directory: name the file of a store")
    with translated(path), contextlib.closing(connected(path)) as file:
        if "evaluations" not in tables(file, path):
            return []
        rows = file.execute("select point, value from evaluations order by rowid").fetchall()
        return [Evaluation(*(_read(file, text).tree() for text in row)) for row in rows]


class Found(NamedTuple):
    """Arrays, and their places in a tree as the text of a literal, where that is possible."""

    leaves: list[np.ndarray]
    places: str

    def tree(self, flat: bool = True) -> PyTree[np.ndarray]:
        """The arrays in their tree; or all in a tuple, unless a ValueError is to be raised then."""
        try:
            return jax.tree.map(self.leaves.__getitem__, ast.literal_eval(self.places))
        except (ValueError, SyntaxError) as error:
            if flat:
                return tuple(self.leaves)
            raise ValueError(f"no literal: {self.places}") from error


class Store:
    """The evaluations of one function; several processes may have it open."""

    def __init__(self, path: str | os.PathLike, fun: Callable[..., Any]):
        """Names the file, which is made, with its directory, when it is first needed."""
        self._path, self._fun = Path(path), fun
        self._identity: Identity | None = None
        # the parts in which the function differs from that of the file
        self._differ: set[str] = set()
        self._under_way = 0
        # open all the time, as the last one who closes the file waits for the disk; callbacks run
        # in threads of JAX's
        self._connection: sqlite3.Connection | None = None
        self._lock = threading.RLock()

    def check(self) -> None:
        """Makes the file, or sees whether it is of this function; once.

        Raises:
            ValueError: the file is no store, or that of another function.
        """
        if self._identity is not None:
            return
        identity = Identity(fun=self._fun)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        make(self._path)
        with self._opened() as file:
            file.execute("begin immediate")
            kept = dict(file.execute("select part, digest from function"))
            if not kept:
                file.executemany("insert into function values (?, ?)", identity.parts.items())
                kept = identity.parts
            file.execute("commit")
        differ = identity.differing(kept)
        what = f"the store {self._path} was written when {listed(differ)} was another"
        advice = (
            "name another file. If the function still returns the same values, forget what it was: "
            f"with sqlite3.connect({str(self._path)!r}) as file: "
            'file.execute("delete from function")'
        )
        if not all(map(can_change, differ)):
            raise ValueError(f"{what}: {advice}")
        if differ:
            text = f"{what}; its values are taken as they are, and none are added: {advice}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)
        self._identity, self._differ = identity, differ

    @contextlib.contextmanager
    def calls(self) -> Iterator[None]:
        """Around calls of the function.

        What they change in it does not tell it from others. What has changed before them does.
        """
        with self._lock:
            if self._identity is None or (not self._under_way and self._identity.changed()):
                self._identity = None
                self.check()
            self._under_way += 1
        try:
            yield
        finally:
            with self._lock:
                self._under_way -= 1
                self._settle()

    def _settle(self) -> None:
        if self._identity is not None and (changed := self._identity.settle()):
            self._differ -= changed
            query, names = "update function set digest = null where part = ?", zip(changed)
            self._try(lambda file: file.executemany(query, names), "written to")

    def points(self, samples: Samples) -> list[str]:
        """What the samples are called here; the same for those that are the same point."""
        return [_point(samples, i)[0] for i in range(len(samples))]

    def find(self, points: Sequence[str]) -> list[Found | None]:
        """The values of the points that are there, else None."""
        query = "select value from evaluations where point = ?"
        found: list[Found | None] = [None] * len(points)

        def read(file: sqlite3.Connection) -> None:
            for i, point in enumerate(points):
                if row := file.execute(query, (point,)).fetchone():
                    found[i] = _read(file, row[0])

        self._try(read, "read from")
        return found

    def put(self, samples: Samples, i: int, value: Sequence[np.ndarray], out_tree: Any) -> None:
        """Keeps the value of sample `i`, as leaves; it is on the disk when this returns.

        Unless the function differs from that of the file, whose values they then are not.
        """
        if self._differ:
            return
        point, arrays = _point(samples, i)
        text, more = _described(value, out_tree, digest_of)

        def write(file: sqlite3.Connection) -> None:
            for name, array in (arrays | more).items():
                # a look first, as binding a large array takes its time
                if not file.execute("select 1 from arrays where id = ?", (name,)).fetchone():
                    row = name, str(array.dtype), json.dumps(array.shape), array.tobytes()
                    file.execute("insert into arrays values (?, ?, ?, ?)", row)
            file.execute("insert or replace into evaluations values (?, ?)", (point, text))

        self._try(write, "written to")

    def _try(self, use: Callable[[sqlite3.Connection], Any], what: str) -> None:
        """Uses the file; if that fails, values have to be paid for again, and all else goes on."""
        try:
            with self._opened() as file:
                if what == "written to":
                    file.execute("begin immediate")
                use(file)
                if file.in_transaction:
                    file.execute("commit")
        except (sqlite3.Error, ValueError) as error:
            text = f"nothing was {what} the store {self._path}, the calls go on: {error}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """The file, for one thread at a time; what was not committed is undone."""
        with self._lock, translated(self._path):
            if self._connection is None or not self._path.exists():  # deleted, it would be kept
                self._connection = connected(self._path)
                weakref.finalize(self, self._connection.close)
            try:
                yield self._connection
            finally:
                if self._connection.in_transaction:
                    self._connection.rollback()


def _point(samples: Samples, i: int) -> tuple[str, dict[str, np.ndarray]]:
    return _described(samples.leaves(i), samples.tree, samples.digest, samples.nodes)


def _described(
    leaves: Sequence[np.ndarray],
    tree: Any,
    digest: Callable[[np.ndarray], bytes],
    nodes: dict[str, str | None] | None = None,
) -> tuple[str, dict[str, np.ndarray]]:
    """What arguments or a value are, as text that names the arrays, and these by name."""
    names = [digest(leaf).hex() for leaf in leaves]
    places = repr(tree.unflatten(range(len(names))))
    text = [re.sub(r" at 0x[0-9a-f]+", "", places), names, *([nodes] if nodes else [])]
    return json.dumps(text), dict(zip(names, leaves, strict=True))


def _read(file: sqlite3.Connection, text: str) -> Found:
    """What the text describes."""
    places, names, *_ = json.loads(text)
    query = "select dtype, shape, data from arrays where id = ?"
    rows = (file.execute(query, (name,)).fetchone() for name in names)
    return Found([np.frombuffer(c, a).reshape(json.loads(b)) for a, b, c in rows], places)
