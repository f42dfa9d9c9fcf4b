"""One call of a transform: its options, their checks, and the way to its batch and value."""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._batch import Batch, evaluate
from smoothdiff._estimate import combine, displacement, objective
from smoothdiff._named_baselines import as_baseline
from smoothdiff._noise import Noise, as_sampler
from smoothdiff._params import (
    Params,
    as_argnums,
    as_first_key,
    choose,
    is_concrete,
    replace,
    take_apart,
)
from smoothdiff._reraise import reraise
from smoothdiff._samplers import AbstractSampler
from smoothdiff._sharding import as_sharding
from smoothdiff._support import as_support


class Options(TypedDict, total=False):
    """What every transform takes beside the function and sigma, by keyword.

    All transforms have the same defaults, which their signatures show. So they agree with AD of
    `smooth` at the same key. Scrambled points and an interpolation of them are the most accurate
    choice for gradients, Hessians and products wherever `python -m benchmarks variance` looks.

    Args:
        argnums: which of the function's arguments to smooth and differentiate, an int or a tuple.
        num_samples: evaluations of the function in one call, all included.
        sampler: where to sample, a sampler object such as `Gaussian(antithetic=True)`; by default
            `Sobol()`.
        noise: what smooths in place of the Gaussian: an object with `sample` and `log_prob`, see
            `Noise`. It draws its points itself, so leave the sampler out.
        baseline: what to subtract. "none"; "mean" of the other samples; "center", which is f(theta)
            and takes one evaluation; a fit, "linear", "quadratic" or "gp"; "ad", the linear
            function with the slope that AD sees at theta, for losses in which AD lacks only the
            moving edges (one evaluation, with its gradient); "auto", which is "gp" where it gains
            and else "mean"; or a baseline object.
        support: which terms a parameter may influence, for a function that returns an array of
            terms whose sum is the objective. A linear map with entries 0 and 1, from
            parameter-shaped to term-shaped arrays. See `local_support`.
        bounds: a pair (low, high), each a number or a pytree like the parameters. The function
            sees points clamped to them; the weights see the points as drawn.
        batch_size: evaluate and differentiate at most so many samples at a time, which bounds the
            memory. The estimate is the same but for rounding.
        sharding: devices that share the samples: a `jax.sharding.Mesh` of one axis, or a
            `NamedSharding` of one axis of a larger mesh. Under `jax.jit` each device evaluates and
            keeps its part, and the sums over samples are combined. The same key gives the same
            estimate on any number of devices, but for rounding. On several hosts, call
            `jax.distributed.initialize()` first and make the mesh of `jax.devices()`; every process
            then runs the same program. Not for a `black_box`: there an `executor` shares the calls.
        nonfinite: "propagate" a NaN or infinite sample into the estimate, or "drop" it and
            re-weight the others; NaN if fewer than half are left.
        has_aux: the function returns (value, aux); aux comes back with one row per sample.
        stderr: also return the standard error of the estimate, of a complex one that of each part.
            Do not differentiate what a transform returns then: derivatives are lost, silently.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> options: sd.Options = {"num_samples": 32, "baseline": "mean", "bounds": (0.0, 1.0)}
        >>> g = sd.smooth_grad(lambda x: jnp.sum(jnp.round(x)), 0.1, **options)
        >>> g(jax.random.key(0), jnp.full(3, 0.5)).shape
        (3,)

    Source: own.
    """

    argnums: int | Sequence[int]
    num_samples: int
    sampler: AbstractSampler | None
    noise: Noise | None
    baseline: str | AbstractBaseline
    support: Callable[[PyTree], Array] | None
    bounds: tuple[PyTree, PyTree] | None
    batch_size: int | None
    sharding: Mesh | NamedSharding | None
    nonfinite: Literal["propagate", "drop"]
    has_aux: bool
    stderr: bool


@dataclass
class Call:
    """A function with its options checked, ready to be evaluated for given arguments.

    The fields are the arguments of a transform, which begins with `call = Call(**locals())`. They
    may be anything until they are checked.
    """

    fun: Any
    sigma: Any
    argnums: Any
    num_samples: Any
    baseline: Any
    sampler: Any = None
    noise: Any = None
    support: Any = None
    bounds: Any = None
    batch_size: Any = None
    sharding: Any = None
    nonfinite: Any = "propagate"
    has_aux: Any = False
    stderr: Any = False

    def __post_init__(self):
        if not callable(self.fun):
            raise TypeError(f"the first argument must be a function, not {type(self.fun).__name__}")
        if self.nonfinite not in ("propagate", "drop"):
            raise ValueError(f'nonfinite must be "propagate" or "drop", not {self.nonfinite!r}')
        self.num_samples = _positive(self.num_samples, "num_samples")
        if self.batch_size is not None:
            self.batch_size = _positive(self.batch_size, "batch_size")
        self.sharding = as_sharding(self.sharding)
        as_sampler(self.sampler, self.noise)
        extra = as_baseline(self.baseline).evaluations()
        if self.num_samples <= extra:
            raise ValueError(
                f"num_samples={self.num_samples} leaves no samples: baseline={self.baseline!r} "
                f"itself needs {extra}"
            )

    def params(self, key: Any, args: tuple) -> Params:
        as_first_key(
            key
        )  # first, or else what was passed in place of a key is taken for a parameter
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
            as_first_key(key),
            num_samples=self.num_samples,
            sampler=as_sampler(self.sampler, self.noise),
            baseline=as_baseline("mean" if plain else self.baseline),
            batch_size=self.batch_size,
            sharding=self.sharding,
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
        return chosen if isinstance(self.argnums, Sequence) else chosen[0]

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


def _positive(value: Any, name: str) -> int:
    """The value as a Python int, which NumPy's integers are not."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if not 1 <= number < 2**31:
        least = "a positive integer" if number < 1 else "less than 2**31"
        raise ValueError(f"{name} must be {least}, not {value!r}")
    return number


def compiled_once(g: Callable[..., Any]) -> Callable[..., Any]:
    """A transformed function that is compiled once also where it is called outside of `jax.jit`.

    There each call would compile its loop over the batch anew. What JAX cannot trace is static.
    """
    compiled = eqx.filter_jit(g)

    def call(key: Any, *args: Any) -> Any:
        if not all(map(is_concrete, jax.tree.leaves((key, args)))):
            return g(key, *args)
        with reraise():
            return jax.block_until_ready(compiled(key, *args))

    return call
