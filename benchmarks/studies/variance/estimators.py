"""The estimators that are compared, all at about the same number of evaluations.

An estimator is a dataclass whose `repr` says all about it. For a problem it gives parts: calls that
share their evaluations, the quantities that each estimates, and how many evaluations it makes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

import smoothdiff as sd
from benchmarks.studies.variance.problems import Problem

STEP = 0.5  # of eq. 23, in units of sigma; a smaller one is noisier, a larger one more biased
LEFT_OUT = 1024  # evaluations of a Gaussian process that leaves groups out: N^3, twenty times over
FIRST, SECOND = ("gradient",), ("hessian", "hvp")


class Part(NamedTuple):
    """A call (key, y, v) -> {quantity: estimate}, with the evaluations that it makes.

    `own` says that the target is the function blurred in the differentiated parameter alone.
    """

    quantities: tuple[str, ...]
    evaluations: int
    call: Callable[[Array, Array, Array], dict[str, Array]]
    own: bool = False


def _first(grad: Callable) -> Callable:
    return lambda key, y, v: {"gradient": grad(key, y)}


def _second(hessian: Callable) -> Callable:
    def call(key: Array, y: Array, v: Array) -> dict[str, Array]:
        h = hessian(key, y)
        return {"hessian": h, "hvp": jnp.matmul(h, v, precision="highest")}

    return call


@dataclass(frozen=True)
class Batch:
    """Gradient, Hessian and its product from one batch of evaluations, by `smooth_quadratic`.

    Args:
        title: The name in tables and figures.
        baseline: What is subtracted.
        samplers: One for all quantities, or one for the gradient and one for the Hessian, which
            then have a batch each.
        local: Whether each parameter is credited with its own terms only.
        most: With more evaluations it would take too long.
    """

    title: str
    baseline: str
    samplers: tuple[Any, ...]
    local: bool = False
    most: int = 4096

    def parts(self, problem: Problem, num: int) -> list[Part]:
        """What can be done with at most `num` evaluations for each quantity."""
        if num > self.most:
            return []
        split = (problem.quantities,) if len(self.samplers) == 1 else (FIRST, SECOND)
        pairs = zip(self.samplers, split, strict=True)
        return [self._part(problem, num, sampler, quantities) for sampler, quantities in pairs]

    def _part(self, problem: Problem, num: int, sampler: Any, quantities: tuple) -> Part:
        num -= num % sampler.block(num, problem.n)
        options: dict[str, Any] = {
            "num_samples": num,
            "sampler": sampler,
            "baseline": self.baseline,
            "support": problem.support if self.local else None,
        }
        fun = problem.terms if self.local and problem.terms is not None else problem.fun
        if quantities == FIRST:
            return Part(FIRST, num, _first(sd.smooth_grad(fun, problem.sigma, **options)))
        quadratic = sd.smooth_quadratic(fun, problem.sigma, **options)

        def call(key: Array, y: Array, v: Array) -> dict[str, Array]:
            model = quadratic(key, y)
            hessian = model.hessian
            return {"gradient": model.grad, "hessian": hessian.as_matrix(), "hvp": hessian.mv(v)}

        return Part(quantities, num, call)


@dataclass(frozen=True)
class Elementwise:
    """Samples of its own for each element; no element gets fewer than one pair.

    With `own` only the gradient, of what is blurred in the differentiated parameter alone.
    """

    title: str
    quasi: bool = False
    own: bool = False

    def parts(self, problem: Problem, num: int) -> list[Part]:
        n, found = problem.n, []
        first = (FIRST, n, _first)
        second = (SECOND, n * (n + 1) // 2, _second)
        order: Any
        for order, (quantities, elements, of) in enumerate((first, second), 1):
            each = num // elements // 2 * 2
            if each == 0 or (order == 2 and self.own):
                continue
            blur = "own" if self.own else "all"
            smooth = sd.Importance(order, not self.quasi, self.quasi, blur)
            call = of(smooth(problem.fun, problem.sigma, num_samples=each, baseline="none"))
            found.append(Part(quantities, each * elements, call, self.own))
        return found


@dataclass(frozen=True)
class Differences:
    """Eq. 23: the difference of two published gradients, with half of the evaluations each."""

    title: str
    shared: bool

    def parts(self, problem: Problem, num: int) -> list[Part]:
        sampler = sd.Aggregate(order=1, share=0.0)
        options: Any = {"num_samples": num // 2, "sampler": sampler, "baseline": "none"}
        grad = sd.smooth_grad(problem.fun, problem.sigma, **options)
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
        first, second = _first(jax.grad(fun, argnums=1)), _second(jax.hessian(fun, argnums=1))
        return [Part(FIRST, num, first), Part(SECOND, num, second)]


def _aggregate(title: str, baseline: str, most: int = 4096, **options: Any) -> Batch:
    """Of order 1 for the gradient and of order 2 for the Hessian."""
    samplers = sd.Aggregate(1, **options), sd.Aggregate(2, **options)
    return Batch(title, baseline, samplers, most=most)


Estimator: TypeAlias = Batch | Elementwise | Differences | Optax
OURS, PUBLISHED, FAIRER, PEER = "ours", "aggregate", "aggregate-mean", "optax"
_GAUSSIAN, _ORTHOGONAL, _SOBOL = (sd.Gaussian(),), (sd.Orthogonal(),), (sd.Sobol(),)
_DEFAULT = "auto", _SOBOL
_QUASI: Any = {"antithetic": False, "quasi": True, "share": 0.1}

ANYWHERE: dict[str, Estimator] = {
    PEER: Optax(),
    PUBLISHED: _aggregate("Aggregate as published", "none", share=0.0),
    FAIRER: _aggregate("Aggregate, mean", "mean", share=0.0),
    "gaussian-mean": Batch("Gaussian, mean", "mean", _GAUSSIAN),
    "sobol-mean": Batch("Sobol, mean", "mean", _SOBOL),
    OURS: Batch("Ours: the defaults", *_DEFAULT),
}
# not of a texture, whose elements are too many to be sampled one by one
FEW: dict[str, Estimator] = {
    "uniform": Batch("Uniform", "none", (sd.Uniform(),)),
    "fr22": Elementwise("FR22", own=True),
    "eq23-shared": Differences("Eq. 23, shared numbers", shared=True),
    "eq23-independent": Differences("Eq. 23, independent", shared=False),
    "importance": Elementwise("Importance"),
}
LOCAL: dict[str, Estimator] = {
    "local-gaussian-mean": Batch("Local: Gaussian, mean", "mean", _GAUSSIAN, local=True),
    "local-ours": Batch("Ours: the defaults, local", *_DEFAULT, local=True),
}
INGREDIENTS: dict[str, Estimator] = {
    "gaussian": Batch("Gaussian", "none", _GAUSSIAN),
    "gaussian-gp": Batch("Gaussian, GP", "gp", _GAUSSIAN, most=LEFT_OUT),
    "orthogonal-mean": Batch("Orthogonal pairs, mean", "mean", _ORTHOGONAL),
    "orthogonal-gp": Batch("Orthogonal pairs, GP", "gp", _ORTHOGONAL, most=LEFT_OUT),
    "importance-quasi": Elementwise("Importance quasi", quasi=True),
    "aggregate-quasi-mean": _aggregate("Aggregate quasi, mean", "mean", **_QUASI),
    "aggregate-quasi-gp": _aggregate("Aggregate quasi, GP", "gp", most=LEFT_OUT, **_QUASI),
    "sobol": Batch("Sobol", "none", _SOBOL),
    "sobol-quadratic": Batch("Sobol, quadratic", "quadratic", _SOBOL),
    "sobol-gp": Batch("Sobol, GP", "gp", _SOBOL),
}
PEERS = FEW | ANYWHERE | LOCAL  # what the pictures of the problems show
BOXES = FEW | ANYWHERE | INGREDIENTS
ESTIMATORS = {"box2": BOXES, "box10": BOXES, "texture": ANYWHERE | LOCAL}  # by problem
