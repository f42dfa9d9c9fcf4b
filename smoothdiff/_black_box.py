"""`black_box`: a host function of NumPy arrays as a JAX function, with faults that can be read."""

import functools
import inspect
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from smoothdiff._callbacks import Calls, jax_function
from smoothdiff._executors import InTurn, engine
from smoothdiff._host_calls import HostFunction
from smoothdiff._host_samples import BlackBoxError, Samples
from smoothdiff._numbers import check_real, check_whole
from smoothdiff._outputs import Outputs
from smoothdiff._params import is_concrete
from smoothdiff._reraise import reraise
from smoothdiff._store import Store


class UnknownOutputError(TypeError):
    """What a black box returns is not known yet, and it may not be called now."""


def black_box(
    fun: Callable[..., Any] | None = None,
    out: PyTree = None,
    *,
    batched: bool = False,
    executor: Any = None,
    on_error: str = "raise",
    on_nonfinite: str = "raise",
    retries: int = 0,
    timeout: int | float | None = None,
    store: str | os.PathLike | None = None,
) -> Callable[..., Any]:
    """Turns a host function of NumPy arrays, such as a renderer, into a JAX function.

    As a decorator it stands alone, `@sd.black_box`, or with options, `@sd.black_box(batched=True)`.
    The result works under `jax.jit`, `jax.vmap`, `jax.lax.scan`, `jax.lax.while_loop` and so on. It
    has no derivative of its own: smooth it, with `smoothdiff.smooth` or one of its derivatives.

    As for every JAX function, the value must follow from the arguments alone (pass a seed if there
    is noise), and a value that nobody uses may never be computed. `fun` must not call JAX: a JAX
    call inside a callback can hang.

    Args:
        fun: Called with positional arguments of the same structure as those of the JAX function,
            their leaves read-only NumPy arrays. The JAX function also takes them by name.
        out: What `fun` returns: a `jax.ShapeDtypeStruct`, a pytree of them, or an example. For one
            sample, also when `batched`. 64-bit types are narrowed where JAX has them switched off.
            Floats are rounded to these types; any other change of a value raises. If left out, the
            first call finds it, and each first call with arguments of other shapes or types. Such
            a call must come from outside of JAX's transforms, and is an evaluation as any other:
            `fun` is called once, and what it returns is the result.
        batched: Whether `fun` takes a whole batch. Every leaf of its arguments then has one leading
            axis, of the same size everywhere, and its results must have it too. The size is 1
            outside `jax.vmap`; nested `jax.vmap` become one axis. If False, each sample is a call.
        executor: Where single calls run, several at once, each result taken when it comes: a
            `concurrent.futures.Executor`, such as a `ThreadPoolExecutor`; `smoothdiff.Processes`,
            for functions that crash or hang; or the `distributed.Client` of a Dask cluster, for
            many machines. Processes must be spawned, as a fork of JAX can hang, and import `fun` by
            its name, which a decorator would take.
        on_error: "raise", or "nan" so that a sample for which `fun` raises an exception, calls
            `sys.exit`, loses its worker or runs out of time is NaN in every output (the whole batch
            if `batched`). `nonfinite="drop"` in the transforms then leaves it out. A wrong
            structure, shape or dtype always raises, and so does a call that is to find `out`.
        on_nonfinite: "raise", or "nan" so that a sample with a NaN or an infinity in any of its
            outputs is NaN in every output.
        retries: How many times a call that failed is tried again. Takes no part in `on_nonfinite`.
        timeout: Seconds that a call may take. Needs an `executor`. `Processes` kill a worker that
            takes longer, and Dask does, and begin another one. A thread goes on, and is lost to its
            pool, as is a process of another pool, or a worker of Dask's without a nanny; once all
            are lost, an error says so.
        store: A file that keeps each point and its value as it comes. What is there is not
            evaluated again, whether the run went on, failed, was killed or is made once more; so
            `fun` must give the same value again. A point that comes several times in a batch is
            evaluated once. Neither errors nor NaN are kept, as their reason may be gone the next
            time: such a point is evaluated each time that it is asked for. Several processes
            may use the file; it is an SQLite database, so on a disk of this machine. It is of one
            function, as checkpoints are, and each batch sees whether it still is that one. If only
            something that can change in place differs, such as an attribute, a warning says so,
            and no values are added. Large NumPy arrays that `fun` closes over are read for that,
            arrays of JAX only once. `smoothdiff.load_store` reads the file.

    Returns:
        A JAX function with the name and docstring of `fun`.

    Raises:
        BlackBoxError: When it runs, if `fun` fails and this is not to become a NaN. Out of a
            `jax.jit` of your own comes an error of JAX's (JaxRuntimeError or ValueError) with the
            same message. On a GPU that error comes out of any transform, once its result is waited
            for. What was turned into NaN is logged to "smoothdiff" at level INFO. Also if float64
            is on in one thread alone, by `jax.enable_x64`, and JAX calls `fun` from another.
        TypeError: If `fun`, `out` or `executor` is of the wrong type; later, if the function is
            differentiated or called with a typed key, or if JAX traces it before a call has found
            `out`.
        ValueError: If the options contradict each other; later, if the store is of another
            function.
        OSError: When it runs, if the store cannot be opened.

    Example:
        >>> import jax, jax.numpy as jnp, numpy as np
        >>> import smoothdiff as sd
        >>> def stairs(x):
        ...     return np.floor(x).sum()
        >>> f = sd.black_box(stairs, jax.ShapeDtypeStruct((), jnp.float32))
        >>> jax.jit(jax.vmap(f))(jnp.array([[0.5, 1.5], [2.5, 3.5]]))
        Array([1., 5.], dtype=float32)

        As a decorator, where a first call says what comes out:

        >>> @sd.black_box
        ... def clipped(x):
        ...     return np.clip(x, 0, 1)
        >>> x = clipped(jnp.array([-1.0, 0.5]))
        >>> jax.jit(clipped)(x)
        Array([0. , 0.5], dtype=float32)

        On four processes, with what hangs for a minute tried once more and then left out:

        >>> with sd.Processes(4) as workers:  # doctest: +SKIP
        ...     f = sd.black_box(
        ...         simulate, 0.0, executor=workers, timeout=60, retries=1, on_error="nan",
        ...         store="runs/simulate.db",
        ...     )
        ...     result = sd.minimise(lambda y, args: f(y), y0, key=key)

    Source: own.
    """
    if fun is None:
        return functools.partial(
            black_box,
            out=out,
            batched=batched,
            executor=executor,
            on_error=on_error,
            on_nonfinite=on_nonfinite,
            retries=retries,
            timeout=timeout,
            store=store,
        )
    if not callable(fun):
        raise TypeError(
            f"black_box needs a function of NumPy arrays, not {fun!r}; what it returns is out=..."
        )
    name = getattr(fun, "__name__", type(fun).__name__)
    kept = Store(store, fun) if isinstance(store, str | os.PathLike) else None
    nan = on_error, on_nonfinite
    host = HostFunction(fun, name, batched, engine(executor), *nan, retries, timeout, kept)
    _check(host, store)
    calls = Calls.of(host, out)

    @functools.wraps(fun)
    def box(*args, **named):
        if host.store is not None:
            host.store.check()
        args = _positional(host, args, named) if named else args
        args = jax.tree.map(functools.partial(_array, host.name), args)
        leaves, tree = jax.tree.flatten(args)
        shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
        call = calls.promised or calls.found.get((tree, shapes))
        if call is None:
            if not all(map(is_concrete, leaves)):
                raise UnknownOutputError(_unknown(host.name, tree.unflatten(shapes)))
            result, outputs = _first(host, leaves, tree)
            calls.found[tree, shapes] = jax_function(host, outputs)
            return result
        # Outside of jit the error is ours to raise; while jit traces, neither line does anything.
        with reraise():
            return jax.block_until_ready(call(*args))

    return box


def _first(host: HostFunction, leaves: list[jax.Array], tree: Any) -> tuple[PyTree, Outputs]:
    """The result of a call of which nothing is known yet, and what it says of the next ones."""
    samples = Samples(leaves, [leaf.ndim for leaf in leaves], tree)
    value = host.first(samples)
    try:
        outputs = Outputs.like(value)
        outputs = outputs.of_one() if host.batched else outputs
    except (TypeError, ValueError) as error:
        raise BlackBoxError(
            f"black box {host.name!r}: `out` was left out and cannot be what the first call "
            f"returned, {value!r}: {error}"
        ) from error
    rows = [np.empty((1, *out.shape), out.dtype) for out in outputs.shapes()]
    host.accept(samples, None if host.batched else 0, value, rows, outputs.tree)
    return outputs.tree.unflatten([jnp.asarray(row[0]) for row in rows]), outputs


def _unknown(name: str, args: tuple) -> str:
    given = ", ".join(str(jax.tree.map(lambda a: f"{a.dtype}{list(a.shape)}", arg)) for arg in args)
    return (
        f"it is not known yet what the black box {name!r} returns for ({given}), and while JAX "
        "traces (jit, vmap, grad, the transforms smooth_...) it cannot be called to find out: make "
        "it once, outside of the function that is traced, as another box is new each time, and "
        f"call it once before, with arrays of these shapes; or write sd.black_box({name}, "
        "out=jax.ShapeDtypeStruct((), jnp.float32)) with the shape and dtype of what it returns"
    )


def _positional(host: HostFunction, args: tuple, named: dict[str, Any]) -> tuple:
    """The arguments by their places, some of which were given by name."""
    needs = f"the black box {host.name!r} takes arguments by their places"
    try:
        signature = inspect.signature(host.fun)
        given = signature.bind(*args, **named).arguments
    except ValueError as error:  # as of functions in C
        raise TypeError(f"{needs}, not by names such as {next(iter(named))!r}") from error
    except TypeError as error:
        raise TypeError(f"the black box {host.name!r}: {error}") from error
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    places = {each.name: each for each in signature.parameters.values() if each.kind in kinds}
    if others := [name for name in named if name not in places]:
        raise TypeError(
            f"{needs}, and {', '.join(others)} can only be given by name: leave out the `*` "
            "or `**` in its definition, or make the box of a lambda"
        )
    # what lies between has its default
    count = 1 + max(i for i, name in enumerate(places) if name in given)
    return tuple(given.get(name, each.default) for name, each in list(places.items())[:count])


def _array(name: str, leaf: Any) -> jax.Array:
    try:
        array = jnp.asarray(leaf)
    except TypeError as error:
        advice = ""
        if hasattr(type(leaf), name):
            advice = (
                ". It is the `self` of a method: make the box of the bound method instead, as "
                f"f = sd.black_box({type(leaf).__name__}(...).{name}), with the method as it was"
            )
        raise TypeError(
            f"the black box {name!r} takes numbers, arrays and pytrees of them, not {leaf!r}"
            f"{advice}"
        ) from error
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        raise TypeError(
            "a host function cannot take a typed key: pass jax.random.key_data(key), or a seed"
        )
    return array


def _check(host: HostFunction, store: Any) -> None:
    if not isinstance(store, str | os.PathLike | None):
        raise TypeError(f"store must be a path of a file, not {store!r}")
    for option in ("on_error", "on_nonfinite"):
        value = getattr(host, option)
        if value not in ("raise", "nan"):
            raise ValueError(f'{option} must be "raise" or "nan", not {value!r}')
    pool = not isinstance(host.engine, InTurn)
    if pool and host.batched:
        raise ValueError(
            "batched=True makes one call of a whole batch, which an executor cannot share out: "
            "leave out the executor, or write batched=False"
        )
    if host.timeout is not None:
        check_real(host.timeout, "timeout")
    if host.timeout is not None and not pool:
        raise ValueError(
            "timeout needs an executor that runs the calls, for example executor=sd.Processes(1)"
        )
    if host.timeout is not None and not host.timeout > 0:
        raise ValueError(f"timeout must be a positive number of seconds, not {host.timeout!r}")
    check_whole(host.retries, "retries")
    if host.retries < 0:
        raise ValueError(f"retries must be 0 (a single try) or more, not {host.retries!r}")
