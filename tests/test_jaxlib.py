"""What is said of versions of jaxlib that can hang, and that our own programs keep clear of it."""

import os
import re
import subprocess
import sys
import warnings
from collections import Counter

import jax
import jax.numpy as jnp
import pytest
from pages import ROOT

import smoothdiff as sd
from smoothdiff import _jaxlib

LAPACK = "triangular_solve|cholesky|geqrf|householder_product|lu"


def warned(monkeypatch, version, plugin=False, platforms=None, nproc="2"):
    monkeypatch.setattr(_jaxlib, "_JAXLIB", version)
    monkeypatch.setenv("NPROC", nproc)
    monkeypatch.setattr(_jaxlib, "_ACCELERATORS", ("json",) if plugin else ("no_such_plugin",))
    with warnings.catch_warnings(record=True) as caught, jax_platforms(platforms):
        warnings.simplefilter("always")
        _jaxlib.warn_if_it_can_hang()
    return len(caught)


class jax_platforms:
    """As set by the user; None is not set."""

    def __init__(self, platforms):
        self.platforms = platforms

    def __enter__(self):
        self.before = getattr(jax.config, "jax_platforms")  # noqa: B009
        jax.config.update("jax_platforms", self.platforms)

    def __exit__(self, *_):
        jax.config.update("jax_platforms", self.before)


@pytest.mark.parametrize(
    ("versions", "says"),
    [
        (("0.8.0", "0.9.2", "0.11.1", "1.0.0"), 0),
        (("0.10.0", "0.10.2", "0.10.1.dev20260101", "0.11.0"), 1),
    ],
)
def test_versions_that_can_hang_are_named(versions, says, monkeypatch):
    assert [warned(monkeypatch, version) for version in versions] == [says] * 4


def test_no_warning_where_jax_runs_elsewhere(monkeypatch):
    assert warned(monkeypatch, "0.10.2", plugin=True) == 0
    assert warned(monkeypatch, "0.10.2", plugin=True, platforms="cpu") == 1
    assert warned(monkeypatch, "0.10.2", platforms="cuda,cpu") == 0


def test_no_warning_where_xla_has_many_threads(monkeypatch):
    assert warned(monkeypatch, "0.10.2", nproc="32") == 0
    cores = set(range(64))
    monkeypatch.setattr("os.sched_getaffinity", lambda _: cores, raising=False)
    assert warned(monkeypatch, "0.10.2", nproc="") == 0
    cores -= set(range(60))
    assert warned(monkeypatch, "0.10.2", nproc="") == 1


def test_programs_of_this_repository_take_threads_where_they_are_needed(monkeypatch):
    for version, nproc in (("0.9.2", None), ("0.10.2", "32")):
        monkeypatch.setattr(_jaxlib, "_JAXLIB", version)
        monkeypatch.setattr(_jaxlib, "_ACCELERATORS", ("no_such_plugin",))
        monkeypatch.setenv("NPROC", "")  # so that it is as it was in the end
        monkeypatch.delenv("NPROC")
        _jaxlib.take_threads()
        assert os.environ.get("NPROC") == nproc


@pytest.mark.parametrize("baseline", ["linear", "quadratic", sd.GaussianProcess()], ids=str)
def test_a_fit_to_several_outputs_has_one_solve(baseline):
    """Several that do not depend on each other can hang under vmap with some versions of jaxlib."""

    def fun(x):
        return {"a": jnp.sum(jnp.abs(x)), "b": jnp.floor(x), "c": jnp.sum(x)}

    def solves(fun):
        g = sd.smooth(fun, 0.1, num_samples=64, baseline=baseline)
        text = str(jax.make_jaxpr(g)(jax.random.key(0), jnp.ones(2)))
        return Counter(re.findall(rf"= ({LAPACK})\b", text))

    assert solves(fun) == solves(lambda x: jnp.sum(jnp.abs(x))) != {}


@pytest.mark.slow
def test_benchmarks_take_threads_and_do_not_warn():
    """Whatever jaxlib is installed: where it can hang, with more threads than there are cores."""
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    asked = [sys.executable, "-W", "error::RuntimeWarning", "-c", "import benchmarks._task"]
    subprocess.run(asked, env=environment, cwd=ROOT, check=True)
