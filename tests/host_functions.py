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


class Stopped(BaseException):
    """What no function should raise."""


def stops_if_negative(x):
    """Raises what is no Exception."""
    if x < 0:
        raise Stopped("negative")
    return 2 * x


def fails_if_negative(x):
    """Takes |x| seconds."""
    time.sleep(abs(float(x)))
    if x < 0:
        raise ValueError("negative")
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
    """A bent valley with a fault at one point in ten, the same one each time.

    Args:
        folder: where it writes down its calls.
        kinds: of faults, in equal shares.
        residuals: whether it returns two residuals, or half the sum of their squares.
    """

    def __init__(self, folder, kinds, residuals):
        self.folder, self.kinds, self.residuals = Path(folder), kinds, residuals
        self.folder.mkdir()

    def __call__(self, y):
        kind = self.kind(y)
        with (self.folder / y.tobytes().hex()).open("a") as file:
            file.write("x")
        match kind:
            case "raises":
                raise ValueError("no convergence")
            case "hangs":  # nobody can end a thread, so not for ever
                time.sleep(3)
                raise ValueError("too late")
            case "dies":
                os._exit(1)
        r = np.array([2 * (y[1] - y[0] ** 2), 1 - y[0]], y.dtype)
        value = r if self.residuals else np.sum(r**2) / 2
        if kind == "shape":
            return np.zeros(7)
        return value * np.nan if kind == "NaN" else value

    def kind(self, y):
        """The fault at a point, or None."""
        chance = int.from_bytes(hashlib.blake2b(y.tobytes(), digest_size=4).digest(), "big")
        return None if chance % 10 else self.kinds[chance // 10 % len(self.kinds)]

    def calls(self):
        """How often it was called with each point that is no fault, and the points that are one."""
        good, bad = {}, []
        for file in self.folder.iterdir():
            point = np.frombuffer(bytes.fromhex(file.name), np.float32)
            if self.kind(point) is None:
                good[tuple(point.tolist())] = len(file.read_text())
            else:
                bad.append(point)
        return good, bad
