"""How many times more accurate ours is meant to be than the papers' estimator and its rivals."""

from typing import Any, TypeAlias

from benchmarks.studies.variance.errors import Row, ratio
from benchmarks.studies.variance.estimators import FAIRER, OURS, PEER, PUBLISHED

Rows: TypeAlias = dict[str, dict[str, dict[int, Row]]]  # by estimator, quantity and samples

# (problem, quantity, samples) -> {opponent: its RMSE over ours, at least}
TARGETS: dict[tuple[str, str, int], dict[str, float]] = {
    ("box2", "gradient", 64): {PUBLISHED: 3},
    ("box2", "gradient", 256): {PUBLISHED: 5},
    ("box2", "gradient", 1024): {PUBLISHED: 10, PEER: 5},
    ("box10", "gradient", 64): {PUBLISHED: 2},
    ("box10", "gradient", 256): {PUBLISHED: 3},
    ("box10", "gradient", 1024): {PUBLISHED: 5, PEER: 5},
    ("box2", "hessian", 64): {PUBLISHED: 15},
    ("box2", "hessian", 256): {PUBLISHED: 25},
    ("box2", "hessian", 1024): {PUBLISHED: 45, FAIRER: 5, PEER: 4},
    ("box10", "hessian", 64): {PUBLISHED: 15},
    ("box10", "hessian", 256): {PUBLISHED: 20},
    ("box10", "hessian", 1024): {PUBLISHED: 23, FAIRER: 2, PEER: 4},
}


def against_targets(measured: dict[str, Rows]) -> list[dict[str, Any]]:
    """For each target: the RMSE of each opponent over ours, with its interval, and the goal."""
    lines = []
    for (problem, quantity, num), least in TARGETS.items():
        line: dict[str, Any] = {"problem": problem, "quantity": quantity, "samples": num}
        ours = measured[problem][OURS][quantity][num]
        for name in (PUBLISHED, FAIRER, PEER):
            line[name] = ratio(ours, measured[problem][name][quantity][num]).tolist()
            line[f"{name}, goal"] = least.get(name)
        lines.append(line)
    return lines
