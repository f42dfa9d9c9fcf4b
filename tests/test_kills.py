"""Runs that are killed at random moments and made again end with the same bits.

A process that was killed takes seconds to begin again. So most are stopped instead: the disk then
holds what a kill would leave. The process, which has compiled all, takes up copies of that later.

KILLS=50 in the environment stops each solver and the benchmarks so often, in place of four times.
"""

import multiprocessing
import os
import shutil
import signal
import time

import killed_runs
import numpy as np
import pytest

KILLS = int(os.environ.get("KILLS", 0))
REAL = 2
NAMES = list(killed_runs.RUNS)

pytestmark = pytest.mark.slow


def begin(context, name, folder):
    """A process in its run."""
    (folder / "begun").unlink(missing_ok=True)
    process = context.Process(target=killed_runs.run, args=(name, folder))
    process.start()
    while process.is_alive() and not (folder / "begun").exists():
        time.sleep(0.01)
    return process


def steps_made(folder):
    """By the last process that went on with the run."""
    return int((folder / "made").read_text())


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
    want, steps = (folder / "found").read_bytes(), steps_made(folder)

    kills, taken_up = 0, False
    folder = tmp_path / "killed"
    folder.mkdir()
    while kills < REAL or not taken_up:
        saved = (folder / "run.npz").exists()
        process = begin(context, name, folder)
        if kills < REAL or not (saved or taken_up):
            process.join(random.uniform(0.1, 0.9) * seconds)
            if process.is_alive():
                process.kill()
                kills += 1
        process.join()
        if not (folder / "found").exists():
            assert process.exitcode == -9, process.exitcode
            continue
        assert (folder / "found").read_bytes() == want
        assert (steps_made(folder) < steps) == saved  # not begun anew
        taken_up |= saved
        shutil.rmtree(folder)
        folder.mkdir()


@pytest.mark.parametrize("name", [*NAMES, "benchmarks"] if KILLS else [NAMES[1], "benchmarks"])
def test_what_a_kill_would_leave_at_any_moment_is_taken_up_to_the_same_bits(name, tmp_path):
    random = np.random.default_rng(len(name))
    context = multiprocessing.get_context("spawn")
    made = {"target": killed_runs.again_and_again, "args": (name, tmp_path), "daemon": True}
    process = context.Process(**made)
    process.start()
    assert process.pid is not None
    running, kept = tmp_path / "running", []
    while len(kept) < (KILLS or 4) or not any(kept):  # once at least with something on the disk
        assert len(kept) < (KILLS or 4) + 20, "nothing is ever on the disk"
        assert process.is_alive()
        time.sleep(random.uniform(0, 1))
        os.kill(process.pid, signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)  # until it has stopped
        try:
            if (running / "begun").exists() and not (running / "found").exists():
                left = tmp_path / f"left{len(kept)}"
                shutil.copytree(running, left)
                kept.append({path: path.read_bytes() for path in left.rglob("*.npz")})
        finally:
            os.kill(process.pid, signal.SIGCONT)
    (tmp_path / "enough").touch()
    process.join()
    assert process.exitcode == 0
    whole = tmp_path / "whole"
    want = (whole / "found").read_bytes()
    for i, files in enumerate(kept):
        left = tmp_path / f"left{i}"
        assert (left / "found").read_bytes() == want
        if name == "benchmarks":  # what was measured is not measured again
            assert all(path.read_bytes() == content for path, content in files.items())
        else:  # not begun anew
            assert (steps_made(left) < steps_made(whole)) == (left / "run.npz" in files)
