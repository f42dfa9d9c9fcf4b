"""The estimators that are compared, all at about the same number of evaluations.

An estimator is a dataclass whose `repr` says all about it. For a problem it gives parts: calls that
share their evaluations, the quantities that each estimates, and how many evaluations it makes.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

import smoothdiff as sd
from benchmarks.variance.problems import Problem

MOST = 4096  # evaluations in one call
MOST_LEFT_OUT = 1024  # for a Gaussian process that leaves groups out: N^3, twenty times over
STEP = 0.5  # of eq. 23, in units of sigma; a smaller one is noisier, a larger one more biased


class Part(NamedTuple):
    """A call (key, y, v) -> {quantity: estimate}, with the evaluations that it makes.

    `own` says that the target is the function blurred in the differentiated parameter alone.
    """

    quantities: tuple[str, ...]
    evaluations: int
    call: Callable[[Array, Array, Array], dict[str, Array]]
    own: bool = False


class Estimator(Protocol):
    """A way to estimate derivatives from samples."""

    @property
    def title(self) -> str:
        """The name in tables and figures."""
        ...

    def parts(self, problem: Problem, num: int) -> list[Part]:
        """What can be done with at most `num` evaluations for each quantity."""
        ...


def _gradient(grad: Callable) -> Callable:
    return lambda key, y, v: {"gradient": grad(key, y)}


def _second_order(hessian: Callable) -> Callable:
    def call(key: Array, y: Array, v: Array) -> dict[str, Array]:
        h = hessian(key, y)
        return {"hessian": h, "hvp": jnp.matmul(h, v, precision="highest")}

    return call


@dataclass(frozen=True)
class OneBatch:
    """Gradient, Hessian and its product from one batch of evaluations, by `smooth_quadratic`."""

    title: str
    sampler: Any
    baseline: str
    local: bool = False  # whether each parameter is credited with its own terms only
    most: int = MOST

    def parts(self, problem: Problem, num: int) -> list[Part]:
        block = self.sampler.block(num, problem.n)
        num = num // block * block
        if num > self.most:
            return []
        options: dict[str, Any] = {
            "num_samples": num,
            "sampler": self.sampler,
            "baseline": self.baseline,
            "support": problem.support if self.local else None,
        }
        fun = problem.terms if self.local and problem.terms is not None else problem.fun
        if problem.quantities == ("gradient",):
            call = _gradient(sd.smooth_grad(fun, problem.sigma, **options))
            return [Part(problem.quantities, num, call)]
        quadratic = sd.smooth_quadratic(fun, problem.sigma, **options)

        def call(key: Array, y: Array, v: Array) -> dict[str, Array]:
            model = quadratic(key, y)
            return {
                "gradient": model.grad,
                "hessian": model.hessian.as_matrix(),
                "hvp": model.hessian.mv(v),
            }

        return [Part(problem.quantities, num, call)]


@dataclass(frozen=True)
class EachOrder:
    """The aggregate sampler, of order 1 for the gradient and of order 2 for the Hessian."""

    title: str
    baseline: str
    antithetic: bool = True
    quasi: bool = False
    share: float = 0.0
    most: int = MOST

    def parts(self, problem: Problem, num: int) -> list[Part]:
        if num > self.most:
            return []
        found = []
        for order in (1, 2):
            sampler = sd.Aggregate(
                order=order, antithetic=self.antithetic, quasi=self.quasi, share=self.share
            )
            one = OneBatch(self.title, sampler, self.baseline)
            kept = ("gradient",) if order == 1 else ("hessian", "hvp")
            kept = tuple(name for name in kept if name in problem.quantities)
            found += [
                Part(kept, part.evaluations, _only(part.call, kept))
                for part in one.parts(problem, num)
                if kept
            ]
        return found


def _only(call: Callable, names: tuple[str, ...]) -> Callable:
    def kept(key: Array, y: Array, v: Array) -> dict[str, Array]:
        found = call(key, y, v)
        return {name: found[name] for name in names}

    return kept


@dataclass(frozen=True)
class Elementwise:
    """Samples of its own for each element; no element gets fewer than one pair."""

    title: str
    quasi: bool = False
    blur: Literal["all", "own"] = "all"

    def parts(self, problem: Problem, num: int) -> list[Part]:
        n, own = problem.n, self.blur == "own"
        found = []
        orders = (1,) if own or problem.quantities == ("gradient",) else (1, 2)
        for order in orders:
            elements = n if order == 1 else n * (n + 1) // 2
            each = num // elements // 2 * 2
            if not each:
                continue
            options: dict[str, Any] = {
                "num_samples": each,
                "baseline": "none",
                "sampler": sd.Importance(order, not self.quasi, self.quasi, self.blur),
            }
            if order == 1:
                call = _gradient(sd.smooth_grad(problem.fun, problem.sigma, **options))
                found.append(Part(("gradient",), each * elements, call, own))
            else:
                call = _second_order(sd.smooth_hessian(problem.fun, problem.sigma, **options))
                found.append(Part(("hessian", "hvp"), each * elements, call))
        return found


@dataclass(frozen=True)
class Differences:
    """Eq. 23: the difference of two published gradients, with half of the evaluations each."""

    title: str
    shared: bool

    def parts(self, problem: Problem, num: int) -> list[Part]:
        if "hvp" not in problem.quantities:
            return []
        grad = sd.smooth_grad(
            problem.fun,
            problem.sigma,
            num_samples=num // 2,
            sampler=sd.Aggregate(order=1, share=0.0),
            baseline="none",
        )
        hvp = sd.difference_hvp(grad, STEP * problem.sigma, shared=self.shared)
        return [Part(("hvp",), num, lambda key, y, v: {"hvp": hvp(key, y, v)})]


@dataclass(frozen=True)
class Optax:
    """`optax.perturbations`, whose baseline f(y) is one of the evaluations."""

    title: str = "optax.perturbations"

    def parts(self, problem: Problem, num: int) -> list[Part]:
        # its annotations allow Gumbel noise only, and pytrees of any kind
        make: Any = optax.perturbations.make_perturbed_fun
        fun = make(problem.fun, num - 1, problem.sigma, optax.perturbations.Normal())
        found = [Part(("gradient",), num, _gradient(jax.grad(fun, argnums=1)))]
        if "hessian" in problem.quantities:
            call = _second_order(jax.hessian(fun, argnums=1))
            found.append(Part(("hessian", "hvp"), num, call))
        return found


OURS, PUBLISHED, FAIRER, PEER = "ours", "aggregate", "aggregate-mean", "optax"
_DEFAULTS = inspect.signature(sd.smooth_quadratic).parameters
_DEFAULT = _DEFAULTS["sampler"].default, _DEFAULTS["baseline"].default
_GP = "Gaussian process"

ESTIMATORS: dict[str, Estimator] = {
    "uniform": OneBatch("Uniform", sd.Uniform(), "none"),
    "gaussian": OneBatch("Gaussian", sd.Gaussian(), "none"),
    "gaussian-pairs": OneBatch("Gaussian pairs", sd.Gaussian(antithetic=True), "none"),
    "gaussian-mean": OneBatch("Gaussian, mean", sd.Gaussian(), "mean"),
    "gaussian-pairs-mean": OneBatch("Gaussian pairs, mean", sd.Gaussian(antithetic=True), "mean"),
    "gaussian-quadratic": OneBatch("Gaussian, quadratic", sd.Gaussian(), "quadratic"),
    "gaussian-gp": OneBatch(f"Gaussian, {_GP}", sd.Gaussian(), "gp", most=MOST_LEFT_OUT),
    "orthogonal": OneBatch("Orthogonal pairs", sd.Orthogonal(), "none"),
    "orthogonal-mean": OneBatch("Orthogonal pairs, mean", sd.Orthogonal(), "mean"),
    "orthogonal-gp": OneBatch(
        f"Orthogonal pairs, {_GP}", sd.Orthogonal(), "gp", most=MOST_LEFT_OUT
    ),
    "sobol": OneBatch("Sobol", sd.Sobol(), "none"),
    "sobol-mean": OneBatch("Sobol, mean", sd.Sobol(), "mean"),
    "sobol-pairs-mean": OneBatch("Sobol pairs, mean", sd.Sobol(antithetic=True), "mean"),
    "sobol-linear": OneBatch("Sobol, linear", sd.Sobol(), "linear"),
    "sobol-quadratic": OneBatch("Sobol, quadratic", sd.Sobol(), "quadratic"),
    "sobol-gp": OneBatch(f"Sobol, {_GP}", sd.Sobol(), "gp"),
    "aggregate": EachOrder("Aggregate as published", "none"),
    "aggregate-mean": EachOrder("Aggregate, mean", "mean"),
    "aggregate-quasi-mean": EachOrder("Aggregate quasi, mean", "mean", False, True, 0.1),
    "aggregate-quasi-gp": EachOrder(
        f"Aggregate quasi, {_GP}", "gp", False, True, 0.1, most=MOST_LEFT_OUT
    ),
    "importance": Elementwise("Importance"),
    "importance-quasi": Elementwise("Importance quasi", quasi=True),
    "fr22": Elementwise("FR22", blur="own"),
    "eq23-shared": Differences("Eq. 23, shared numbers", shared=True),
    "eq23-independent": Differences("Eq. 23, independent", shared=False),
    "optax": Optax(),
    "ours": OneBatch("Ours: the defaults", *_DEFAULT),
}

# in 1,024 dimensions elements cannot be sampled one by one, and frames are as large as N
TEXTURE_ESTIMATORS: dict[str, Estimator] = {
    name: ESTIMATORS[name]
    for name in (
        "gaussian",
        "gaussian-pairs",
        "gaussian-mean",
        "gaussian-pairs-mean",
        "sobol-mean",
        "aggregate",
        "aggregate-mean",
        "optax",
        "ours",
    )
} | {
    "local-gaussian-mean": OneBatch("Local: Gaussian, mean", sd.Gaussian(), "mean", local=True),
    "local-gaussian-pairs-mean": OneBatch(
        "Local: Gaussian pairs, mean", sd.Gaussian(antithetic=True), "mean", local=True
    ),
    "local-ours": OneBatch("Ours: the defaults, local", *_DEFAULT, local=True),
}


def estimators_for(problem: str) -> dict[str, Estimator]:
    """The estimators of a problem, in the order of tables and figures."""
    return TEXTURE_ESTIMATORS if problem == "texture" else ESTIMATORS
