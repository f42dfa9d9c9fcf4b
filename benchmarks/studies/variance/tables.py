"""The results as tables."""

from collections.abc import Iterator
from typing import Any

from benchmarks._grid import Grid, short
from benchmarks.studies._listed import listed
from benchmarks.studies.variance.descent import GOALS
from benchmarks.studies.variance.estimators import PUBLISHED

SAMPLES = ("64", "256", "1024")
MIDDLE = "256"  # at which gains and times are shown


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """Errors, how many times smaller they are, and what the rest of the study found."""
    yield from map(_errors, results["problems"].values())
    yield listed(
        "How many times smaller our RMSE is",
        "Ratio [95 % interval], and the goal. Against the papers' aggregate sampler as published, "
        "the same with the mean subtracted, and optax.perturbations.",
        results["targets"],
    )
    yield listed(
        "Texture of 1,024 texels by Adam: evaluations to reduce the image error",
        "Median [range] over seeds; - is not reached. Goals with local credit: "
        + ", ".join(f"{goal} to {level} %" for level, goal in GOALS.items()),
        results["descent"],
    )
    if "fits" in results:
        yield listed(
            "Sobol points as R sets, Box10, N = 256: gradient",
            "Cover of nominal 95 % intervals of Student's t; of one set the formula for "
            "independent points.",
            results["replicates"],
        )
        yield listed(
            "What a Gaussian process costs, Box10: ms of a call",
            "It pays where one evaluation takes longer than the last columns say.",
            results["fits"],
        )


def _errors(problem: dict[str, Any]) -> Grid:
    """A gain is at equal evaluations: errors count as if they fell with the root of their number.

    An estimator that draws blocks cannot make any number of them.
    """
    estimators = problem["estimators"]
    lines = []
    for found in estimators.values():
        line = {"estimator": found["title"]}
        for quantity in (name for name in estimators["ours"] if name != "title"):
            curve = found.get(quantity, {})
            errors = (short(curve[num]["rmse"][1]) if num in curve else "-" for num in SAMPLES)
            line[quantity] = "/".join(errors)
            gain = milliseconds = None
            if MIDDLE in curve:
                at, theirs = curve[MIDDLE], estimators[PUBLISHED][quantity][MIDDLE]
                fair = (theirs["evaluations"] / at["evaluations"]) ** 0.5
                gain, milliseconds = fair * theirs["rmse"][1] / at["rmse"][1], at["ms"]
            line |= {f"gain, {quantity}": short(gain), f"ms, {quantity}": short(milliseconds)}
        lines.append(line)
    return listed(
        f"{problem['title']}: relative RMSE at N = {', '.join(SAMPLES)}",
        f"{problem['repeats']} positions. Gain: the RMSE of the aggregate sampler as published "
        f"over that of the estimator, at N = {MIDDLE}; and milliseconds there.",
        lines,
    )
