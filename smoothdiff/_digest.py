"""Short texts that say what a Python value is: other ones for other code, closures or numbers."""

import copyreg
import dataclasses
import functools
import hashlib
import re
import sys
import sysconfig
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

# names of parts have so many dots at most; what lies deeper counts as a piece of the last one
_DOTS = 4
_PLAIN = type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented)
_Facts = Iterator[tuple[str, bytes | None]]


class Unknown:
    """In place of a value that is not known yet, and so differs from none."""


class _Met(NamedTuple):
    """The objects that were met, by which cycles end, and JAX's arrays with their digests.

    Both by id; kept alive here, so that no other object gets the same one.
    """

    objects: dict[int, tuple[Any, str]]
    arrays: dict[int, tuple[jax.Array, bytes]]


def parts(values: dict[str, Any], arrays: dict | None = None) -> dict[str, str | None]:
    """Digests of the values and, under names with a dot, of what each is made of.

    Numbers, texts, arrays and containers count by value. A function counts by its code, constants
    and defaults, by what it closes over, and, unless it belongs to an installed package, by what it
    uses of its module and of others that are not installed. Other objects count by their class and
    by what pickle or a dataclass would compare, so without fields that have `compare=False`; what
    cannot be pickled, such as a lock or a scene in C++, by its class alone. Where the code stands
    and what is said in comments does not count. Another version of Python has other code.

    Args:
        values: any Python values, by the names that their parts begin with.
        arrays: a dictionary for the next call with the same values, in which those arrays that
            cannot change are not read again.

    Returns:
        For each name of a part its digest. The closure variable `scale` of a function that is given
        as `fun` is "fun.scale". After a colon stands what can change in place: the attribute
        `count` of an ordinary object there is "fun.scale:count", the items of a list or a dict
        "fun.scale:". Of what is `Unknown` it is None.
    """
    unknown: dict[str, str | None] = {}
    hashes: dict[str, Any] = {}
    for name, value in values.items():
        for part, fact in _facts(name, value, _Met({}, {} if arrays is None else arrays)):
            if fact is None:
                unknown[part] = None
                continue
            digest = hashes.setdefault(part, hashlib.blake2b(digest_size=16))
            digest.update(len(fact).to_bytes(8, "little") + fact)
    # what is unknown deep down counts as a piece, as all that is known there does
    return unknown | {part: digest.hexdigest() for part, digest in hashes.items()}


def digest_of(array: np.ndarray) -> bytes:
    """Says the shape, the dtype and every bit of an array."""
    digest = hashlib.blake2b(f"{array.dtype} {array.shape} ".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.digest()


def custom_nodes(tree: Any) -> Iterator[tuple[type, Any]]:
    """The nodes of a tree that are not of Python's types: each type, and its static data."""
    node = tree.node_data()
    if node is not None and node[0] not in (tuple, list, dict, type(None)):
        yield node
    for child in tree.children():
        yield from custom_nodes(child)


def _facts(name: str, value: Any, met: _Met) -> _Facts:
    """What makes up a value, each fact with the name of the part that it belongs to."""
    kind = type(value)
    if kind in _PLAIN:
        yield name, f"{kind.__name__} {value!r}".encode()
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        yield from _array(name, value, met)
    elif kind is tuple:
        yield name, f"tuple {len(value)}".encode()
        for item in value:
            yield from _facts(name, item, met)
    elif kind in (set, frozenset):
        # in an order of their own, as that of a set differs between processes
        part = name if kind is frozenset else _inside(name)
        yield part, " ".join([kind.__name__, *sorted(map(_whole, value))]).encode()
    elif kind is types.CodeType:
        yield from _code(name, value, met)
    elif kind is Unknown:
        yield name, None
    elif isinstance(value, types.ModuleType):
        yield name, value.__name__.encode()
    elif isinstance(value, jax.tree_util.PyTreeDef):
        yield name, _without_addresses(value).encode()
        for node in custom_nodes(value):
            yield from _facts(name, node, met)
    elif id(value) in met.objects:
        yield name, f"see {met.objects[id(value)][1]}".encode()
    else:
        met.objects[id(value)] = value, name
        yield from _object(name, value, met)


def _object(name: str, value: Any, met: _Met) -> _Facts:
    """The facts of what can be part of itself."""
    kind: Any = type(value)
    inside = lambda items: _named(name, items, met)
    if kind is list or kind is dict:
        yield name, kind.__name__.encode()
        items = tuple(value.items() if kind is dict else value)
        yield from _facts(_inside(name), items, met)
    elif kind is types.FunctionType:
        yield from _function(name, value, met)
    elif kind is types.MethodType:
        yield from inside({"": value.__func__, "self": value.__self__})
    elif isinstance(value, type):
        yield name, f"class {value.__module__}.{value.__qualname__}".encode()
        if _edited(value.__module__):
            yield from _facts(name, value.__bases__, met)
            yield from inside(_written(value))
    elif isinstance(value, functools.partial):
        yield from inside({"": value.func, **dict(enumerate(value.args)), **value.keywords})
    elif isinstance(value, tuple) and hasattr(kind, "_fields"):
        yield from inside({"": kind, **dict(zip(kind._fields, value, strict=True))})
    elif dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value) if field.compare]
        # a field of a module of equinox may be missing
        its = {"": kind, **{field: getattr(value, field, None) for field in fields}}
        frozen = kind.__dataclass_params__.frozen or isinstance(value, eqx.Module)
        yield from _named(name if frozen else _inside(name), its, met)
    elif (wrapped := getattr(value, "__wrapped__", None)) and not _edited(kind.__module__):
        yield from inside({"": wrapped})  # jax.jit and the like
    else:
        yield from _facts(name, kind, met)
        kept = _pickled(value)
        if isinstance(kept, str):
            yield name, kept.encode()
        else:
            yield from _named(_inside(name), kept, met)


def _named(name: str, items: dict[Any, Any], met: _Met) -> _Facts:
    """Facts of the items as parts of their own; of the one without a name, of the whole."""
    dot = "" if name.endswith(":") else "."
    for key, item in items.items():
        own = key != "" and name.count(".") < _DOTS
        if not own:
            yield name, f"{key}".encode()
        yield from _facts(f"{name}{dot}{key}" if own else name, item, met)


def _inside(name: str) -> str:
    """The part of what can change in place."""
    return name if ":" in name else f"{name}:"


def _array(name: str, value: Any, met: _Met) -> _Facts:
    if isinstance(value, jax.Array):
        if id(value) not in met.arrays:
            met.arrays[id(value)] = value, _digest_of_jax(value)
        yield name, met.arrays[id(value)][1]
    elif value.dtype == object:
        yield from _facts(name, value.tolist(), met)
    else:
        yield name, digest_of(np.asarray(value))


def _digest_of_jax(array: jax.Array) -> bytes:
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        impl = str(jax.random.key_impl(array)).encode()
        return impl + digest_of(np.asarray(jax.random.key_data(array)))
    return digest_of(np.asarray(array))


def _code(name: str, code: types.CodeType, met: _Met) -> _Facts:
    # neither its name nor the places in the file
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    rest = code.co_code, code.co_exceptiontable, code.co_consts
    yield from _facts(name, (counts, names, rest), met)


def _function(name: str, fun: types.FunctionType, met: _Met) -> _Facts:
    defaults = fun.__defaults__, tuple((fun.__kwdefaults__ or {}).items())
    yield from _facts(name, (fun.__code__, *defaults), met)
    cells = zip(fun.__code__.co_freevars, fun.__closure__ or (), strict=True)
    yield from _named(name, {variable: _content(cell) for variable, cell in cells}, met)
    if _edited(fun.__globals__.get("__name__")):  # __module__ can be that of a function it wraps
        yield from _named(name, _used(fun), met)


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # it is still empty
        return NotImplemented


def _used(fun: types.FunctionType) -> dict[str, Any]:
    """What code names of the module that it stands in, and of others that are not installed."""
    names = sorted(_names(fun.__code__))
    used = {name: fun.__globals__[name] for name in names if name in fun.__globals__}
    todo, done = list(used.items()), set()
    while todo:
        module, value = todo.pop()
        if isinstance(value, types.ModuleType) and _edited(value.__name__) and value not in done:
            done.add(value)
            its = {f"{module}.{name}": vars(value)[name] for name in names if name in vars(value)}
            used |= its
            todo += its.items()
    return used


def _names(code: types.CodeType) -> set[str]:
    nested = (const for const in code.co_consts if isinstance(const, types.CodeType))
    return set(code.co_names).union(*map(_names, nested))


def _written(cls: type) -> dict[str, Any]:
    """The methods and constants of a class."""
    unwrapped = {
        name: getattr(value, "__func__", getattr(value, "fget", value))
        for name, value in vars(cls).items()
    }
    kinds = types.FunctionType, functools.partial, functools.cached_property
    hidden = lambda name: name.startswith("__") and name.endswith("__")
    return {
        name: value.func if isinstance(value, functools.cached_property) else value
        for name, value in unwrapped.items()
        if isinstance(value, kinds) or not hidden(name)
    }


def _pickled(value: Any) -> dict[str, Any] | str:
    """What pickle would keep of an object: attributes, or the name of a global.

    The whole has no name. Of what pickle refuses there is nothing.
    """
    reduce = copyreg.dispatch_table.get(type(value), lambda value: value.__reduce_ex__(4))
    try:
        reduced: Any = reduce(value)
    except Exception:
        return {}
    if isinstance(reduced, str):
        return f"{getattr(value, '__module__', None)}.{reduced}"
    make, args, state, *items = (*reduced, None, None, None)[:5]
    rest = make, args, *(None if part is None else list(part) for part in items)
    # what has slots gives a pair of dictionaries
    states: Any = state if isinstance(state, tuple) and len(state) == 2 else (state,)
    if all(part is None or isinstance(part, dict) for part in states):
        return {"": rest} | {k: v for part in states if part for k, v in part.items()}
    return {"": (rest, state)}


def _whole(value: Any) -> str:
    return " ".join(f"{part} {digest}" for part, digest in parts({"": value}).items())


def _without_addresses(value: Any) -> str:
    return re.sub(r" at 0x[0-9a-f]+", "", str(value))


@functools.cache
def _edited(module: str | None) -> bool:
    """Whether a module is its user's own, and so may be edited between two runs."""
    if module == "__main__":
        return True
    file = getattr(sys.modules.get(module or ""), "__file__", None)
    if file is None:
        return False
    path = Path(file)
    library = map(sysconfig.get_path, ("stdlib", "platstdlib"))
    return not (
        {"site-packages", "dist-packages"} & set(path.parts)
        or any(path.is_relative_to(folder) for folder in (Path(__file__).parent, *library))
    )
