"""Functions that draw random numbers: one fixed key against fresh ones, as `takes_key=True` has it.

What is left of the error, without noise, of the way from the start to the minimum: with a fixed key
a run ends at the minimum of these numbers alone. Two functions have an exact mean, a decay whose
rate is random and a newsvendor's cost; on shadow the error is that of the picture without noise.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._grid import Grid
from benchmarks._style import COLOURS, figure
from benchmarks._task import NotAble
from benchmarks.scenes import shadow
from benchmarks.studies._listed import listed

HELP = "functions with noise: one fixed key against fresh ones"
OPTIONS = ("full", "seeds")
STARTS = {False: 10, True: 20}
DRAWS = 16
# of the decay: times, the spread of its rate, and what is to be found
TIMES, SPREAD, RATE = jnp.linspace(0, 4, 20), 0.3, jnp.array([0.8, 1.5])
# of the newsvendor: demands and their spreads, and what a copy costs and brings
DEMAND, SPREADS = jnp.array([10.0, 20.0, 5.0]), jnp.array([3.0, 2.0, 2.0])
COST, PRICE = jnp.array([1.0, 1.0, 2.0]), jnp.array([3.0, 1.5, 2.5])
BEST = DEMAND + SPREADS * jax.scipy.stats.norm.ppf(1 - COST / PRICE)


class Case(NamedTuple):
    """A function `fun(y, args, key)`, where it starts, and its error without noise."""

    title: str
    minimise: Callable[..., sd.Result]
    fun: Callable[[Any, Any, jax.Array], jax.Array]
    start: Callable[[int], jax.Array]
    solver: Any
    error: Callable[[jax.Array], Any]
    evaluations: tuple[int, ...]
    bounds: Any = None


def around(middle: jax.Array, width: Any) -> Callable[[int], jax.Array]:
    """Starts that are uniform around a point."""

    def start(seed: int) -> jax.Array:
        return middle + width * jax.random.uniform(jax.random.key(seed), middle.shape, minval=-1)

    return start


def decay(y: jax.Array, args: None, key: jax.Array) -> jax.Array:
    """Residuals: each time has random rates of its own."""
    rates = y[0] + SPREAD * jax.random.normal(key, (DRAWS, TIMES.size))
    return y[1] * jnp.mean(jnp.exp(-TIMES[None] * rates), axis=0) - expected(RATE)


def expected(y: jax.Array) -> jax.Array:
    """The mean of the decay."""
    return y[1] * jnp.exp(-TIMES * y[0] + (TIMES * SPREAD) ** 2 / 2)


def newsvendor(y: jax.Array, args: None, key: jax.Array) -> jax.Array:
    """What copies cost, less what those bring that are asked for."""
    demands = DEMAND[None] + SPREADS[None] * jax.random.normal(key, (DRAWS, DEMAND.size))
    sold = jnp.mean(jnp.minimum(y[None], demands), axis=0)
    return jnp.sum(COST * y - PRICE * sold)


def expected_cost(y: jax.Array) -> jax.Array:
    """The mean of the newsvendor's cost."""
    z = (y - DEMAND) / SPREADS
    normal = jax.scipy.stats.norm
    left_over = SPREADS * (z * normal.cdf(z) + normal.pdf(z))
    return jnp.sum(COST * y - PRICE * (y - left_over))


def cases(full: bool) -> Iterator[Case]:
    """All that can be run here."""
    square = jax.jit(lambda y: jnp.sum((expected(y) - expected(RATE)) ** 2))
    first = jnp.array([0.4, 0.9])
    start, solver = around(first, 0.2), sd.GaussNewton(0.2)
    yield Case("decay", sd.least_squares, decay, start, solver, square, (100, 300))
    error = jax.jit(lambda y: expected_cost(y) - expected_cost(BEST))
    start = around(BEST + 3 * SPREADS, SPREADS)
    for solver, evaluations in (
        (sd.NewtonCG(SPREADS), (100, 300)),
        (sd.FirstOrder(optax.adam(0.2), SPREADS), (300, 1200)),
    ):
        yield Case("newsvendor", sd.minimise, newsvendor, start, solver, error, evaluations)
    try:
        (task,) = _registry.family("shadow", full)
    except NotAble:
        return
    render, photo = shadow.make(64 if full else 32, 4)
    low, high = map(jnp.asarray, shadow.START_BOX)
    yield Case(
        title="shadow",
        minimise=sd.least_squares,
        fun=lambda y, args, key: render(y, key) - photo,
        start=around((low + high) / 2, (high - low) / 2),
        solver=sd.GaussNewton(2 * shadow.SIGMA),
        error=jax.jit(task.score.loss or task.problem.loss),
        evaluations=(100, 300),
        bounds=tuple(map(jnp.asarray, shadow.BOUNDS)),
    )


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What is left of the error of each start, and how many evaluations that took."""
    starts = range(options.seeds or STARTS[options.full])
    lines = []
    for case in cases(options.full):
        for most in case.evaluations:
            line = {"function": case.title, "solver": type(case.solver).__name__, "at most": most}
            for name, run in (("fixed", fixed(case)), ("fresh", fresh(case))):
                left, evaluations = zip(
                    *(one(case, run, seed, most) for seed in tqdm(starts, leave=False)), strict=True
                )
                line[name] = [float(share) for share in np.quantile(left, (0.25, 0.5, 0.75))]
                line[f"{name}, evaluations"] = int(np.median(evaluations))
            lines.append(line)
    return {"starts": len(starts), "lines": lines}


def fixed(case: Case) -> Callable[..., sd.Result]:
    """Runs with one key, as a part of args."""
    fun = lambda y, key: case.fun(y, None, key)
    return lambda y0, key, **rest: case.minimise(fun, y0, key, key=key, **rest)


def fresh(case: Case) -> Callable[..., sd.Result]:
    """Runs with keys that come from one."""
    return lambda y0, key, **rest: case.minimise(case.fun, y0, key=key, takes_key=True, **rest)


def one(case: Case, run: Callable[..., sd.Result], seed: int, most: int) -> tuple[float, int]:
    """What a run leaves of the error, and its evaluations."""
    y0, rest = case.start(seed), {"bounds": case.bounds, "max_evaluations": most}
    result = run(y0, jax.random.key(seed), solver=case.solver, **rest)
    return float(case.error(result.y) / case.error(y0)), result.evaluations


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each function and budget."""
    yield listed(
        "Functions with noise",
        f"What is left of the error at the start, without noise: medians and quartiles of "
        f"{results['starts']} starts, each with a key of its own, which is fixed, or from which "
        "fresh ones come. A fixed one can end early.",
        results["lines"],
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """A pair of bars from quartile to quartile for each line."""
    lines = results["lines"]
    with figure(folder / "noise.png", 1, 1, (7, 1 + 0.4 * len(lines))) as (drawn, axes):
        axis = axes[0, 0]
        for i, name in enumerate(("fixed", "fresh")):
            low, middle, high = np.array([line[name] for line in lines]).T
            places = np.arange(len(lines)) + 0.3 * i - 0.15
            axis.hlines(places, low, high, color=COLOURS[i], lw=5, alpha=0.4)
            axis.plot(middle, places, "o", color=COLOURS[i], label=f"{name} numbers")
        names = [f"{n['function']}, {n['solver']}, {n['at most']}" for n in lines]
        axis.set(xscale="log", xlabel="What is left of the error")
        axis.set(yticks=range(len(lines)), yticklabels=names, ylim=(len(lines) - 0.5, -0.5))
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
