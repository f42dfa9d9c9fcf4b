"""The renderer's own automatic differentiation, with Adam: what one uses where it works."""

from jax.flatten_util import ravel_pytree

from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._adam import adam
from benchmarks.methods._flat import Flat


def prepare(problem: Problem) -> Solve:
    """Takes the gradient that the problem's renderer gives, if it gives one."""
    if problem.native_ad is None:
        raise NotAble("this task has no derivative of its own")
    flat, value_and_grad = Flat(problem), problem.native_ad()
    gradient = lambda key, i, x: ravel_pytree(value_and_grad(flat.tree(x))[1])[0]
    return adam(flat, gradient, evaluations_per_step=2)


METHODS = {"mitsuba_ad": MethodEntry("Mitsuba AD, Adam", ("scene",), prepare)}
