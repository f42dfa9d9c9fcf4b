"""Functions for worker processes, which import this file: NumPy only. No tests here."""

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
