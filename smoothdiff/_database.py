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
_NAMES = {"function", "arrays", "evaluations"}


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
                tables(file, path)
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


def tables(file: sqlite3.Connection, path: Path) -> set[str]:
    """The names of those that are there: not all are while the file is being made.

    Raises:
        ValueError: none of them is ours.
    """
    query = "select name from sqlite_master where type = 'table'"
    names = {name for (name,) in file.execute(query)}
    if names and not names & _NAMES:
        raise _no_store(path)
    return names


@contextlib.contextmanager
def translated(path: Path) -> Iterator[None]:
    """The error of a file that is none of SQLite's, or has other tables, says what to do."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        other = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_ERROR  # in its columns
        if isinstance(error, sqlite3.OperationalError) and not other:  # locked, full, gone
            raise
        raise _no_store(path) from error


def _no_store(path: Path) -> ValueError:
    return ValueError(f"{path} is not a store of evaluations: name another file")
