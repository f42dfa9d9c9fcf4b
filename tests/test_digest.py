"""A digest changes with what a value does, and with nothing else; also in another process."""

import dataclasses
import functools
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from smoothdiff._digest import parts
from smoothdiff._identity import Identity

SCALE = 3.0


def compiled(source, **names):
    """What `f` is in a module of the user's with this source."""
    namespace = {"__name__": "__main__", "np": np} | names
    exec(compile(source, "<user>", "exec"), namespace)
    return namespace["f"]


def scaled(scale, power=2):
    return lambda y, args: scale * jnp.sum(y**power)


def differing(one, other):
    """The names of the parts in which two values differ."""
    one, other = parts({"fun": one}), parts({"fun": other})
    return sorted(name for name in {**one, **other} if one.get(name) != other.get(name))


class Renderer:
    """With what is usual in such objects: settings, arrays, and things that cannot be compared."""

    gain = 2.0

    def __init__(self, samples, image):
        self.samples, self.image, self.lock = samples, image, threading.Lock()

    def loss(self, y, args):
        return self.gain * self.samples * np.sum(self.image - y)


class Layer(eqx.Module):
    weight: jax.Array
    act: Callable = eqx.field(static=True)

    def loss(self, y, args):
        return jnp.sum(self.act(self.weight * y))


@dataclasses.dataclass
class Settings:
    width: float
    seconds: float = dataclasses.field(default=0.0, compare=False)


def helper(y):
    return y * SCALE


def through_helper(y, args):
    return helper(y)


PAIRS = {
    "constant": (lambda: lambda y: y + 1, lambda: lambda y: y + 2, ["fun"]),
    "operation": (lambda: lambda y: y + 1, lambda: lambda y: y - 1, ["fun"]),
    "sign of zero": (lambda: lambda y: y + 0.0, lambda: lambda y: y + -0.0, ["fun"]),
    "type": (lambda: lambda y: y + 1, lambda: lambda y: y + 1.0, ["fun"]),
    "name": (lambda: lambda y: y.min(), lambda: lambda y: y.max(), ["fun"]),
    "nested": (
        lambda: lambda y: (lambda u: u * 2)(y),
        lambda: lambda y: (lambda u: u * 3)(y),
        ["fun"],
    ),
    "set": (lambda: lambda y: y in {"a", "b"}, lambda: lambda y: y in {"a", "c"}, ["fun"]),
    "closure": (lambda: scaled(1.0), lambda: scaled(2.0), ["fun.scale"]),
    "closed-over array": (
        lambda: scaled(np.zeros(3)),
        lambda: scaled(np.array([0, 0, 1e-9])),
        ["fun.scale"],
    ),
    "closed-over dtype": (
        lambda: scaled(np.zeros(3)),
        lambda: scaled(np.zeros(3, np.float32)),
        ["fun.scale"],
    ),
    "closed-over function": (lambda: scaled(np.sin), lambda: scaled(np.cos), ["fun.scale"]),
    "closed-over dict": (lambda: scaled({"a": 1}), lambda: scaled({"a": 2}), ["fun.scale:"]),
    "key": (
        lambda: scaled(jax.random.key(1)),
        lambda: scaled(jax.random.key(2)),
        ["fun.scale"],
    ),
    "default": (lambda: lambda y, a=1: y, lambda: lambda y, a=2: y, ["fun"]),
    "keyword default": (lambda: lambda y, *, a=1: y, lambda: lambda y, *, a=2: y, ["fun"]),
    "partial": (
        lambda: functools.partial(scaled, power=2),
        lambda: functools.partial(scaled, power=3),
        ["fun.power"],
    ),
    "partial by place": (
        lambda: functools.partial(scaled, 1.0),
        lambda: functools.partial(scaled, 1.5),
        ["fun.0"],
    ),
    "method": (
        lambda: Renderer(4, np.ones(2)).loss,
        lambda: Renderer(8, np.ones(2)).loss,
        ["fun.self:samples"],
    ),
    "object": (
        lambda: Renderer(4, np.ones(2)),
        lambda: Renderer(4, np.zeros(2)),
        ["fun:image"],
    ),
    "jitted": (lambda: jax.jit(scaled(1.0)), lambda: jax.jit(scaled(2.0)), ["fun.scale"]),
    "vmapped": (
        lambda: jax.vmap(scaled(1.0)),
        lambda: jax.vmap(scaled(2.0)),
        ["fun.fun.fun.scale"],
    ),
    "module": (
        lambda: Layer(jnp.ones(2), jnp.tanh).loss,
        lambda: Layer(jnp.zeros(2), jnp.tanh).loss,
        ["fun.__self__.weight"],
    ),
    "static field": (
        lambda: Layer(jnp.ones(2), lambda y: y),
        lambda: Layer(jnp.ones(2), lambda y: -y),
        ["fun.act"],
    ),
    "structure": (
        lambda: jax.tree.structure({"a": Layer(jnp.ones(2), lambda y: y)}),
        lambda: jax.tree.structure({"a": Layer(jnp.ones(2), lambda y: -y)}),
        ["fun"],
    ),
    "dataclass": (lambda: Settings(1.0), lambda: Settings(2.0), ["fun:width"]),
    "adam": (lambda: optax.adam(0.5), lambda: optax.adam(0.05), None),
    "schedule": (
        lambda: optax.sgd(optax.exponential_decay(0.1, 10, 0.9)),
        lambda: optax.sgd(optax.exponential_decay(0.1, 10, 0.8)),
        None,
    ),
    "solver": (
        lambda: sd.FirstOrder(optax.adam(0.1, b1=0.9), 0.1),
        lambda: sd.FirstOrder(optax.adam(0.1, b1=0.8), 0.1),
        None,
    ),
    "black box": (
        lambda: sd.black_box(scaled(1.0), 0.0),
        lambda: sd.black_box(scaled(2.0), 0.0),
        None,
    ),
    "out": (lambda: sd.black_box(np.sin, 0.0), lambda: sd.black_box(np.sin, np.zeros(1)), None),
    "pair": (lambda: (1, (2, 3)), lambda: ((1, 2), 3), ["fun"]),
    "text": (lambda: ["a", "bc"], lambda: ["ab", "c"], ["fun:"]),
}


@pytest.mark.parametrize("name", PAIRS)
def test_what_computes_otherwise_differs_and_the_name_of_the_part_says_where(name):
    one, other, where = PAIRS[name]
    assert differing(one(), one()) == []
    found = differing(one(), other())
    assert found == where if where else found


def test_what_says_nothing_of_values_does_not_tell_a_black_box_from_others(tmp_path):
    identity = lambda **options: Identity(fun=sd.black_box(np.sin, **options))
    plain = identity()
    assert not plain.differing(identity(store=tmp_path / "s.db", retries=2).parts)
    assert not plain.differing(identity(out=0.0).parts)
    assert not identity(out=0.0).differing(plain.parts)
    assert identity(out=0.0).differing(identity(out=np.zeros(1)).parts) == {"fun.calls.promise"}


def test_where_it_stands_what_it_is_called_and_comments_do_not_count():
    plain = "def f(y):\n    return y + 1\n"
    moved = "import os\n\n\ndef g(y):  # adds\n    # one\n    return (\n        y + 1)\n\nf = g\n"
    assert differing(compiled(plain), compiled(moved)) == []


def test_globals_of_modules_that_can_be_edited_count():
    source = "def g(y):\n    return y * {}\n\ndef f(y):\n    return g(y) + A\n"
    f = compiled(source.format(2), A=1.0)
    assert differing(f, compiled(source.format(2), A=1.0, B=7)) == []
    assert differing(f, compiled(source.format(2), A=2.0)) == ["fun.A"]
    assert differing(f, compiled(source.format(3), A=1.0)) == ["fun.g"]
    assert "fun.helper.SCALE" in parts({"fun": through_helper})


def test_functions_of_modules_of_the_users_count(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    seen = []
    for i, power in enumerate((2, 3)):
        (tmp_path / f"tools{i}.py").write_text(f"def helper(y):\n    return y**{power}\n")
        tools = __import__(f"tools{i}")
        seen.append(compiled("def f(y):\n    return tools.helper(y) + np.sin(y)", tools=tools))
    assert "fun.tools.helper" in differing(*seen)
    assert not any("np." in part for part in parts({"fun": seen[0]}))


def test_methods_that_a_method_calls_count():
    source = """
class A:
    gain = {0}

    def factor(self):
        return {1}

    def loss(self, y):
        return self.factor() * y

f = A().loss
"""
    one = compiled(source.format(1, 2))
    assert differing(one, compiled(source.format(1, 2))) == []
    assert differing(one, compiled(source.format(3, 2))) == ["fun.self.gain"]
    assert differing(one, compiled(source.format(1, 3))) == ["fun.self.factor"]


def test_fields_that_are_not_compared_and_how_a_black_box_is_called_do_not_count():
    assert differing(Settings(1.0, 2.0), Settings(1.0, 3.0)) == []
    box = lambda **options: sd.black_box(scaled(1.0), 0.0, **options)
    assert differing(box(), box(retries=3)) == []
    known = box()
    known(jnp.ones(2), None)
    assert differing(box(), known) == []


def test_cycles_end():
    def even(n):
        return n == 0 or odd(n - 1)

    def odd(n):
        return n != 0 and even(n - 1)

    loop: list[Any] = [1.0]
    loop.append(loop)
    renderer: Any = Renderer(1, np.ones(2))
    renderer.me = renderer
    assert all(parts({"a": even, "b": loop, "c": renderer}).values())
    assert differing(even, odd) != []


WAYS = ["0", "7"]


@pytest.mark.slow
def test_another_process_gives_the_same_digests():
    """With other seeds of its hashes, of which sets and addresses depend."""
    script = (
        "import test_digest as t; from smoothdiff._digest import parts\n"
        "for n, (one, *_) in t.PAIRS.items(): print(n, sorted(parts(dict(fun=one())).items()))"
    )
    folders = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    start = lambda seed: subprocess.Popen(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": folders},
        stdout=subprocess.PIPE,
        text=True,
    )
    one, other = (process.communicate(timeout=120)[0] for process in map(start, WAYS))
    assert one == other
    assert len(one.splitlines()) == len(PAIRS)
