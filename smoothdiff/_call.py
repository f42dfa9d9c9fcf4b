"""One call of a transform: its options, their checks, and the way to its batch and value."""

import inspect
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import wraps
from typing import Any, Literal, Protocol, TypedDict, Unpack, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._batch import Batch, evaluate
from smoothdiff._estimate import combine, displacement, objective
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params, as_argnums, as_key, choose, replace, take_apart
from smoothdiff._samplers import Sobol, as_sampler
from smoothdiff._support import as_support


class Options(TypedDict, total=False):
    """What every transform takes beside the function and sigma, by keyword.

    Args:
        argnums: which of the function's arguments to smooth and differentiate, an int or a tuple.
        num_samples: evaluations of the function in one call, all included.
        sampler: where to sample, a sampler object such as `Gaussian(antithetic=True)`; or a noise
            object that smooths instead of the Gaussian, see `Noise`.
        baseline: what to subtract: "none", "mean" (of the other samples), "center" (f(theta), one
            evaluation), "linear", "quadratic" or "gp" (fitted), "auto" ("gp" where it gains, else
            "mean"), or a baseline object.
        support: for a function that returns an array of terms whose sum is the objective: a linear
            map from parameter-shaped to term-shaped arrays with entries 0 and 1 that says which
            terms a parameter may influence. See `local_support`.
        bounds: a pair (low, high), each a number or a pytree like the parameters. The function
            sees points clamped to them; the weights see the points as drawn.
        batch_size: evaluate and differentiate at most so many samples at a time, which bounds the
            memory. The estimate is the same but for rounding.
        nonfinite: "propagate" a NaN or infinite sample into the estimate, or "drop" it and
            re-weight the others; NaN if fewer than half are left.
        has_aux: the function returns (value, aux); aux comes back with one row per sample.
        stderr: also return the standard error of the estimate. Do not differentiate what a
            transform returns then: derivatives are lost, silently.
    """

    argnums: int | Sequence[int]
    num_samples: int
    sampler: Any
    baseline: str | AbstractBaseline
    support: Callable[[PyTree], Array] | None
    bounds: tuple[PyTree, PyTree] | None
    batch_size: int | None
    nonfinite: Literal["propagate", "drop"]
    has_aux: bool
    stderr: bool


@dataclass(frozen=True)
class Call:
    """A function with its options checked, ready to be evaluated for given arguments.

    The defaults are the same for all transforms, so that they agree with AD of `smooth` at the
    same key: scrambled points and an interpolation of them are the most accurate for gradients,
    Hessians and products alike wherever `python -m benchmarks variance` looks.
    """

    fun: Callable
    sigma: Any
    argnums: int | Sequence[int] = 0
    num_samples: int = 64
    sampler: Any = Sobol()  # noqa: RUF009 (a frozen module)
    baseline: str | AbstractBaseline = "auto"
    support: Callable[[PyTree], Array] | None = None
    bounds: tuple[PyTree, PyTree] | None = None
    batch_size: int | None = None
    nonfinite: Literal["propagate", "drop"] = "propagate"
    has_aux: bool = False
    stderr: bool = False

    def __post_init__(self):
        if not callable(self.fun):
            raise TypeError(f"the first argument must be a function, not {type(self.fun).__name__}")
        if self.nonfinite not in ("propagate", "drop"):
            raise ValueError(f'nonfinite must be "propagate" or "drop", not {self.nonfinite!r}')
        extra = as_baseline(self.baseline).evaluations()
        if self.num_samples <= extra:
            raise ValueError(
                f"num_samples={self.num_samples} leaves no samples: baseline={self.baseline!r} "
                f"itself needs {extra}"
            )

    def options(self) -> Options:
        """The options as a transform takes them."""
        return {f.name: getattr(self, f.name) for f in fields(self)[2:]}  # pyright: ignore

    def params(self, key: Any, args: tuple) -> Params:
        as_key(key)  # first, or else what was passed in place of a key is taken for a parameter
        return take_apart(choose(args, self.argnums), self.sigma, self.bounds)

    def batch(
        self, key: Any, args: tuple, params: Params, *, scalar: bool, free_rows: list | None = None
    ) -> Batch:
        """One batch of evaluations; everything that a transform returns comes from it."""

        def fun(theta: Array, free: list) -> tuple[PyTree, PyTree]:
            out = self.fun(*replace(args, self.argnums, params.layout.tree(theta, free)))
            if self.has_aux and not (isinstance(out, tuple | list) and len(out) == 2):
                raise TypeError("with has_aux=True the function must return a pair (value, aux)")
            value, aux = out if self.has_aux else (out, None)
            value = jax.tree.map(jnp.asarray, value)
            if (
                scalar
                and self.support is None
                and not (isinstance(value, jax.Array) and value.shape == ())
            ):
                shape = jax.tree.map(jnp.shape, value)
                raise TypeError(
                    f"the function must return a scalar here, not an output of shape {shape}: use "
                    "smooth_jacobian, or return a loss (jnp.sum, jnp.mean) of the output"
                )
            return value, aux

        # a fit knows nothing of which parameter may be blamed for which term
        plain = self.baseline == "auto" and self.support is not None
        return evaluate(
            fun,
            params,
            as_key(key),
            num_samples=self.num_samples,
            sampler=as_sampler(self.sampler),
            baseline=as_baseline("mean" if plain else self.baseline),
            batch_size=self.batch_size,
            nonfinite=self.nonfinite,
            support=as_support(self.support),
            free_rows=free_rows,
        )

    def smoothed(self, key: Any, *args: Any, scalar: bool = False) -> tuple[PyTree, PyTree]:
        """(value, aux) of the smoothed function; differentiating it is the whole library."""
        params = self.params(key, args)
        batch = self.batch(key, args, params, scalar=scalar)
        estimate = objective if scalar else combine
        return estimate(batch, *displacement(params)), batch.aux

    def shifted_argnums(self, num_args: int) -> int | tuple[int, ...]:
        """Where the parameters stand among the arguments of the smoothed function, key first."""
        chosen = tuple(i + 1 for i in as_argnums(self.argnums, num_args))
        return chosen[0] if isinstance(self.argnums, int) else chosen

    def only_smoothed(self, params: Params, what: str) -> None:
        if params.free:
            raise ValueError(
                f"{what} needs a sigma for every leaf: leave the leaves with sigma None out of "
                "argnums, or pass them as other arguments"
            )

    def out(self, estimate: PyTree, aux: PyTree, error: PyTree = None) -> PyTree:
        """The estimate in the form that the options ask for."""
        result = (estimate, aux) if self.has_aux else estimate
        return (result, error) if self.stderr else result


@runtime_checkable
class Transform(Protocol):
    def __call__(
        self, fun: Callable[..., Any], sigma: PyTree, **options: Unpack[Options]
    ) -> Callable[..., Any]: ...


def _positive(value: Any, name: str) -> int:
    """The value as a Python int, which NumPy's integers are not."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name} must be a positive integer, not {value!r}")
    return number


def transform(**defaults: Any) -> Callable[[Callable[[Call], Callable]], Transform]:
    """Gives a transform its options: defaults of its own, checks, and a signature that shows them.

    The decorated function receives a `Call` and returns the function that users call.
    """

    def decorate(make: Callable[[Call], Callable]) -> Transform:
        known = {f.name: f.default for f in fields(Call)[2:]} | defaults

        @wraps(make)
        def with_options(fun: Callable, sigma: PyTree, **options: Unpack[Options]) -> Callable:
            unknown = sorted(set(options) - set(known))
            if unknown:
                raise TypeError(f"{make.__name__} has no option {unknown}; it has {sorted(known)}")
            chosen: dict[str, Any] = {**known, **options}
            chosen["num_samples"] = _positive(chosen["num_samples"], "num_samples")
            if chosen["batch_size"] is not None:
                chosen["batch_size"] = _positive(chosen["batch_size"], "batch_size")
            return make(Call(fun, sigma, **chosen))

        hints = Options.__annotations__
        kind = inspect.Parameter
        shown = [kind("fun", kind.POSITIONAL_OR_KEYWORD, annotation=Callable)]
        shown += [kind("sigma", kind.POSITIONAL_OR_KEYWORD, annotation=PyTree)]
        shown += [
            kind(name, kind.KEYWORD_ONLY, default=default, annotation=hints[name])
            for name, default in known.items()
        ]
        signature = inspect.Signature(shown, return_annotation=Callable)
        with_options.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
        return with_options

    return decorate
