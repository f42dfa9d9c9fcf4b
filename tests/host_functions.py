"""Functions for worker processes, which import this file: NumPy only. No tests here."""

import hashlib
import os
import sys
import time
from pathlib import Path

import numpy as np


class NoReturnError(Exception):
    """Cannot be unpickled: its constructor takes other arguments."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def fault(x):
    """Twice x; at numbers from 1 on each in its own way a fault."""
    match int(x):
        case 1:
            raise ValueError("negative roughness")
        case 2:
            os._exit(1)
        case 3:
            time.sleep(1000)
        case 4:
            sys.exit("no licence")
        case 5:
            raise NoReturnError("a", "b")
    return 2 * x


def a_while(x):
    """Takes x seconds."""
    time.sleep(float(x))
    return x


def process(x):
    """The process that it is called in; x only makes it another call."""
    return np.int32(os.getpid())


class FirstTime:
    """A function that fails the first time that it is called with a number, in whatever process."""

    def __init__(self, folder, how):
        self.folder, self.how = Path(folder), how

    def __call__(self, x):
        with (self.folder / f"{float(x)}").open("a") as file:
            file.write("x")
            tries = file.tell()
        if tries == 1:
            fault(self.how)
        return 2 * x

    def tries(self):
        """How often it was called with each number."""
        return {float(file.name): len(file.read_text()) for file in self.folder.iterdir()}


def of_an_image(x, scene):
    """The sum of a large array, in a tree."""
    return x + scene["image"].sum()


class Faulty:
    """A bowl with a fault at one point in ten, always the same for a point; none at the start.

    Args:
        folder: where it writes down its calls.
        kinds: of faults.
        residuals: whether it returns three residuals, or the sum of their squares.
    """

    TARGET = (1.0, -0.5)

    def __init__(self, folder, kinds, residuals):
        self.folder, self.kinds, self.residuals = Path(folder), kinds, residuals
        self.folder.mkdir(exist_ok=True)

    def __call__(self, x):
        x = np.asarray(x)
        kind = self._kind(x)
        name = f"{x.tobytes().hex()}-{kind or 'value'}"
        with (self.folder / name).open("a") as file:
            file.write("x")
        match kind:
            case "raise":
                raise ValueError("no convergence")
            case "nan":
                return np.full(3, np.nan) if self.residuals else np.nan
            case "shape":
                return np.zeros(7)
            case "exit" | "unpickled" | "hang" | "die":
                fault({"die": 2, "hang": 3, "exit": 4, "unpickled": 5}[kind])
        away = x - np.array(self.TARGET, x.dtype)
        rows = np.append(away, away.sum())
        return rows if self.residuals else (rows**2).sum()

    def _kind(self, x):
        chance = int.from_bytes(hashlib.blake2b(x.tobytes(), digest_size=4).digest(), "big")
        if chance % 10 or not x.any():
            return None
        return self.kinds[chance // 10 % len(self.kinds)]

    def calls(self):
        """How often each point was called."""
        files = ((file.name.split("-")[0], file) for file in self.folder.iterdir())
        return {self._point(code): len(file.read_text()) for code, file in files}

    def faults(self):
        """The points that had a fault."""
        names = (file.name.split("-") for file in self.folder.iterdir())
        return {self._point(code) for code, kind in names if kind != "value"}

    def _point(self, code):
        return tuple(np.frombuffer(bytes.fromhex(code), np.float32).tolist())
