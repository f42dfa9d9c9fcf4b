"""A host function of which it is known what it returns, as JAX calls it back."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from smoothdiff._digest import Unknown, parts
from smoothdiff._host_calls import HostFunction
from smoothdiff._host_samples import BlackBoxError, Samples, wait_for
from smoothdiff._outputs import Outputs
from smoothdiff._reraise import was_raised


@dataclasses.dataclass(frozen=True)
class Calls:
    """The box as JAX functions: the one that `out` promises, or those of arguments that were met.

    To a checkpoint only the promise says which box it is, and where there is none, nothing.
    """

    promise: str | Unknown
    promised: Callable[..., Any] | None = dataclasses.field(default=None, compare=False)
    found: dict[Any, Callable[..., Any]] = dataclasses.field(default_factory=dict, compare=False)

    @staticmethod
    def of(host: HostFunction, out: PyTree) -> "Calls":
        """Those of a host function of which `out` may say what it returns."""
        if out is None:
            return Calls(Unknown())
        outputs = Outputs.like(out)
        return Calls(str(parts({"": outputs})), jax_function(host, outputs))


def jax_function(host: HostFunction, outputs: Outputs) -> Callable[..., Any]:
    """The host function, of which it is known what it returns, as a JAX function."""
    for option in ("on_error", "on_nonfinite"):
        if getattr(host, option) == "nan" and not outputs.have_nan():
            raise ValueError(
                f'{option}="nan" needs every output to be of floats, as integers have no NaN: '
                f'return floats, or write {option}="raise"'
            )

    @jax.custom_jvp
    def call(*args):
        leaves, tree = jax.tree.flatten(args)
        ndims, shapes = tuple(leaf.ndim for leaf in leaves), outputs.shapes()
        callback = _Callback(host, tree, ndims, outputs.tree, shapes, _is_x64())
        # Under vmap, however nested, one callback gets the whole batch.
        results = jax.pure_callback(callback, shapes, *leaves, vmap_method="expand_dims")
        return outputs.tree.unflatten(results)

    # Only a tangent that arrives gets here; where the arguments are stopped, none does.
    @call.defjvp
    def no_derivative(primals, tangents):
        raise TypeError(
            f"the black box {host.name!r} has no derivative: smooth the function that calls it, "
            "for example with sd.smooth(fun, sigma) or sd.smooth_grad(fun, sigma), "
            "or stop the derivative with jax.lax.stop_gradient. A leaf whose sigma is None and "
            'baseline="ad" need one, too'
        )

    return call


@dataclasses.dataclass(frozen=True)
class _Callback:
    """What JAX calls. Equal for equal fields, so that calls outside of jit compile only once."""

    host: HostFunction
    tree: Any
    ndims: tuple[int, ...]
    out_tree: Any
    shapes: tuple[jax.ShapeDtypeStruct, ...]
    x64: bool

    def __call__(self, *leaves: Any) -> list[np.ndarray]:
        try:
            if self.x64 and not _is_x64():  # JAX would round arguments to float32
                raise BlackBoxError(_X64.format(self.host.name))
            wait_for(leaves, self.host.name)
            samples = Samples(leaves, self.ndims, self.tree)
            outs = [np.empty((len(samples), *out.shape), out.dtype) for out in self.shapes]
            self.host(samples, outs, self.out_tree)
            return [out.reshape(samples.batch_shape + out.shape[1:]) for out in outs]
        except BaseException as error:
            told = was_raised(error)
            raise told from told.__cause__  # JAX logs the causes too


_X64 = (
    "the black box {!r} is part of a program in float64, but JAX calls it from another thread, and "
    "jax.enable_x64(True) holds in one thread alone: write "
    'jax.config.update("jax_enable_x64", True) instead, at the start of the program'
)


def _is_x64() -> bool:
    """Whether float64 is on in this thread."""
    return jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
