"""Every public name is documented, and every example in a docstring runs."""

import doctest
import importlib
import inspect
import pkgutil
import re

import jax
import pytest
from pages import ROOT

import smoothdiff as sd
from smoothdiff.renderers import mitsuba

MODULES = sorted(module.name for module in pkgutil.walk_packages(sd.__path__, prefix="smoothdiff."))
TRANSFORMS = sorted(name for name in sd.__all__ if name.startswith("smooth"))
PLACES = (sd, sd.filters, sd.kernels, sd.plot, sd.surrogates, mitsuba)
PUBLIC = {
    f"{place.__name__}.{name}": thing
    for place in PLACES
    for name, thing in vars(place).items()
    if name in getattr(place, "__all__", [n for n in vars(place) if n[0] != "_"])
    and getattr(thing, "__module__", "").startswith("smoothdiff")
}
# modules of optional extras import what the test extra brings
EXAMPLES = ["smoothdiff", *MODULES]
# modules whose examples are whole runs, or take long to compile: the slow part has them
LONG_ONES = (
    "_samplers",
    "_support",
    "_filtered_adam",
    "_importance",
    "_aggregate",
    "filters.mesh",
    "_solvers.",
    "_minimise",
    "_search",
    "_coarse",
    "_grey_",
    "_result",
    "_select",
    "_with_cov",
    "plot",
)
LONG = [name for name in MODULES if name.removeprefix("smoothdiff.").startswith(LONG_ONES)]


@pytest.mark.parametrize("name", sd.__all__)
def test_public_names_are_documented(name):
    thing = getattr(sd, name)
    doc = inspect.getdoc(thing)
    assert doc
    # eqx.Module and NamedTuple make up a docstring where there is none
    assert not doc.startswith(f"{name}(")
    if inspect.isclass(thing):
        for method, value in vars(thing).items():
            if callable(value) and not method.startswith("_"):
                assert inspect.getdoc(getattr(thing, method)), f"{name}.{method}"


@pytest.mark.parametrize("name", PUBLIC)
def test_what_a_public_name_says(name):
    """One line, then the arguments, what comes back, what is raised, an example, the source."""
    thing = PUBLIC[name]
    doc = inspect.getdoc(thing) or ""
    first, blank = doc.splitlines()[:2]
    assert first.endswith(".")
    assert not blank
    sections = ["Example", "Source"]
    if inspect.isfunction(thing):
        sections += ["Args", "Returns"] + ["Raises"] * (thing is not mitsuba.available)
    assert [part for part in sections if f"\n{part}:" not in doc] == []
    assert ">>> " in doc[doc.index("\nExample:") :]


def test_contributing_says_where_each_module_lives():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    names = {name.rpartition(".")[2] for name in MODULES}
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", text)] == []


@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms_say_all_there_is_to_say(name):
    doc = inspect.getdoc(getattr(sd, name)) or ""
    first, blank = doc.splitlines()[:2]
    assert first.endswith(".")
    assert not blank
    for section in ("Args:", "Returns:", "Raises:", "Example:", "Source:"):
        assert f"\n{section}" in doc, section
    assert "\n    >>> " in doc[doc.index("\nExample:") :]
    for parameter in inspect.signature(getattr(sd, name)).parameters:
        if parameter in ("fun", "sigma"):
            assert f"{parameter}: " in doc
        else:
            # the others are the same for all transforms, and described once
            assert f"{parameter}: " in (inspect.getdoc(sd.Options) or ""), parameter


@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms_show_their_arguments_in_their_own_source(name):
    """Which is where an editor looks; all transforms have the same, with the same defaults."""
    function = inspect.unwrap(getattr(sd, name))
    shown = inspect.signature(function).parameters
    assert list(shown) == ["fun", "sigma", *sd.Options.__annotations__]
    assert function.__code__.co_varnames[: len(shown)] == tuple(shown)
    assert [p.default for p in shown.values()] == [
        p.default for p in inspect.signature(sd.smooth).parameters.values()
    ]


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in LONG else []) for n in EXAMPLES],
)
def test_examples_run(name):
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    # an example is what a user types: promotion and ranks as JAX has them by default
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for example in doctest.DocTestFinder(exclude_empty=True).find(module, name):
            assert runner.run(example).failed == 0
