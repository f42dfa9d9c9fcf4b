"""Runs that are killed at random moments and made again end with the same bits.

KILLS=50 in the environment makes so many of each solver, in place of two of one.
"""

import multiprocessing
import os
import shutil
import time

import killed_runs
import numpy as np
import pytest

KILLS = int(os.environ.get("KILLS", 0))
NAMES = list(killed_runs.RUNS)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def context():
    """Processes that have imported everything, and have not started JAX."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed_runs"])
    return context


def begin(context, name, folder):
    """A process in its run."""
    (folder / "begun").unlink(missing_ok=True)
    process = context.Process(target=killed_runs.run, args=(name, folder))
    process.start()
    while process.is_alive() and not (folder / "begun").exists():
        time.sleep(0.01)
    return process


@pytest.mark.parametrize("name", NAMES if KILLS else NAMES[:1])
def test_a_run_that_was_killed_ends_with_the_same_bits(name, context, tmp_path):
    random = np.random.default_rng(NAMES.index(name))
    folder = tmp_path / "whole"
    folder.mkdir()
    seconds = 0.0
    for _ in range(2):  # the second time all is compiled
        shutil.rmtree(folder)
        folder.mkdir()
        whole, started = begin(context, name, folder), time.monotonic()
        whole.join()
        seconds = time.monotonic() - started
    want = (folder / "found").read_bytes()

    kills = taken_up = 0
    folder = tmp_path / "killed"
    folder.mkdir()
    while True:
        process = begin(context, name, folder)
        if kills < (KILLS or 2):
            process.join(random.uniform(0.1, 0.9) * seconds)
            if process.is_alive():
                process.kill()
                kills, taken_up = kills + 1, taken_up + (folder / "run.npz").exists()
        process.join()
        if not (folder / "found").exists():
            assert process.exitcode == -9, process.exitcode
            continue
        assert (folder / "found").read_bytes() == want
        if kills >= (KILLS or 2):
            break
        shutil.rmtree(folder)
        folder.mkdir()
    assert taken_up  # else this tells nothing
