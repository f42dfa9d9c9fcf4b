"""The SQLite file of a store: its tables, and how it is opened."""

import contextlib
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

# seconds to wait for another process that writes
_PATIENCE = 60.0
# An array stands there once, however many points share it; points and values name arrays by their
# digests. The order of the rows is that in which they came.
_TABLES = """
create table if not exists function (part text primary key, digest text);
create table if not exists arrays (id text primary key, dtype text, shape text, data blob);
create table if not exists evaluations (point text primary key, value text);
"""


def connected(path: Path) -> sqlite3.Connection:
    """The file, open for any thread."""
    file = sqlite3.connect(path, _PATIENCE, isolation_level=None, check_same_thread=False)
    # what was written outlives a kill
    file.execute("pragma synchronous = normal")
    return file


def make(path: Path) -> None:
    """Makes the tables, if there are none."""
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            with translated(path), contextlib.closing(connected(path)) as file:
                # others read while one writes
                file.execute("pragma journal_mode = wal")
                file.executescript(_TABLES)
                return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_CANTOPEN:
                raise OSError(f"{path} cannot be opened as a store: {error}") from error
            # several begin at once, and SQLite does not wait here
            if time.monotonic() > end:
                raise
            time.sleep(0.01)


@contextlib.contextmanager
def translated(path: Path) -> Iterator[None]:
    """The error of a file that is none of SQLite's says what to do."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError):  # locked, full, gone
            raise
        raise ValueError(f"{path} is not a store of evaluations: name another file") from error
