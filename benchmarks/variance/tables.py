"""The results as tables for the terminal."""

from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

from benchmarks.variance.descent import BUDGETS, LEVELS
from benchmarks.variance.descent import TARGETS as DESCENT_TARGETS
from benchmarks.variance.estimators import FAIRER, PEER, PUBLISHED, estimators_for

SHOWN = ("64", "256", "1024")  # numbers of samples


def render(results: dict[str, Any]) -> Group:
    """All tables that there is something for."""
    found: list[RenderableType] = [_errors(results, name) for name in results["problems"]]
    if results["targets"]:
        found.append(_targets(results["targets"]))
    found += [_ingredients(results["ingredients"]), _descent(results["descent"])]
    if "replicates" in results:
        found += [_replicates(results["replicates"]), _fits(results["fits"])]
    return Group(*found)


def _table(title: str, caption: str, *columns: str) -> Table:
    shown = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, title_justify="left")
    for i, column in enumerate(columns):
        shown.add_column(column, justify="right" if i else "left", no_wrap=True)
    return shown


def _errors(results: dict[str, Any], name: str) -> Table:
    problem = results["problems"][name]
    estimators = problem["estimators"].values()
    quantities = dict.fromkeys(q for found in estimators for q in found if q != "title")
    shown = _table(
        f"{problem['title']}: relative RMSE at N = {', '.join(SHOWN)}, and ms at N = 256",
        f"{problem['repeats']} positions. {results['setting']} setting.",
        "estimator",
        *(text for quantity in quantities for text in (quantity, "ms")),
    )
    for found in estimators:
        cells = []
        for quantity in quantities:
            column = found.get(quantity, {"samples": []})
            at = {str(num): i for i, num in enumerate(column["samples"])}
            errors = [f"{column['rmse'][at[n]][1]:.2g}" if n in at else "-" for n in SHOWN]
            cells.append(" ".join(f"{text:>6}" for text in errors))
            cells.append(f"{column['ms'][at['256']]:.1f}" if "256" in at else "-")
        shown.add_row(found["title"], *cells)
    return shown


def _targets(targets: list[dict[str, Any]]) -> Table:
    shown = _table(
        "How many times smaller our RMSE is",
        "Ratio \\[95 % interval] / target. Against the papers' aggregate sampler as published, the "
        "same with the mean subtracted, and optax.perturbations.",
        "problem",
        "quantity",
        "N",
        *(estimators_for("box2")[name].title for name in (PUBLISHED, FAIRER, PEER)),
    )
    for line in targets:
        cells = []
        for over in line["over"].values():
            low, middle, high = over["ratio"]
            target = "" if over["target"] is None else f" / {over['target']:g}"
            cells.append(f"{middle:.1f} \\[{low:.1f}, {high:.1f}]{target}")
        last = line["samples"] == 1024
        shown.add_row(
            line["problem"], line["quantity"], str(line["samples"]), *cells, end_section=last
        )
    return shown


def _ingredients(ingredients: dict[str, Any]) -> Table:
    boxes = [name for name in ("box2", "box10") if name in ingredients]
    shown = _table(
        f"What each ingredient gives at N = {', '.join(SHOWN)}",
        "RMSE of the aggregate sampler as published over that of the estimator.",
        "estimator",
        *(f"{name} {quantity}" for name in boxes for quantity in ("gradient", "hessian")),
    )
    for name, estimator in estimators_for("box2").items():
        cells = []
        for problem in boxes:
            for quantity in ("gradient", "hessian"):
                by_num = ingredients[problem].get(name, {}).get(quantity, {})
                found = [f"{by_num[n]:.2g}" if n in by_num else "-" for n in SHOWN]
                cells.append(" ".join(f"{text:>5}" for text in found))
        if any(cell.strip("- ") for cell in cells):
            shown.add_row(estimator.title, *cells)
    return shown


def _descent(descent: dict[str, Any]) -> Table:
    shown = _table(
        "Texture of 1,024 texels by Adam: evaluations to reduce the image error",
        f"Median \\[range] over seeds; - is not reached in {BUDGETS['local']} evaluations (local), "
        f"{BUDGETS['scalar']} (scalar). Tuned on other seeds.",
        "credit",
        *(f"{level} %" for level in LEVELS),
        "lowest error",
        "tuned",
    )
    for credit, found in descent.items():
        cells = []
        for level, costs in found["cost"].items():
            reached = sorted(float("inf") if cost is None else cost for cost in costs)
            low, middle, high = (reached[0], reached[len(reached) // 2], reached[-1])
            target = f" / {DESCENT_TARGETS[level]}" if credit == "local" else ""
            cells.append(f"{middle:g} \\[{low:g}, {high:g}]{target}".replace("inf", "-"))
        tuned = f"N {found['samples']}, {found['sampler']}, {found['rate']}, {found['decays']}"
        shown.add_row(credit, *cells, f"{found['lowest']:.2g}", tuned)
    return shown


def _replicates(replicates: list[dict[str, Any]]) -> Table:
    shown = _table(
        "Sobol points as R sets, Box10, N = 256: gradient",
        "Cover of nominal 95 % intervals of Student's t; of one set the formula for independent "
        "points.",
        "baseline",
        "R",
        "RMSE over R = 1",
        "covers",
        "half width over RMSE",
    )
    for line in replicates:
        cost, cover = line["rmse_over_one_set"], line["coverage"]
        shown.add_row(
            line["baseline"],
            str(line["sets"]),
            f"{cost[1]:.2f} \\[{cost[0]:.2f}, {cost[2]:.2f}]",
            f"{cover[1]:.1%} \\[{cover[0]:.1%}, {cover[2]:.1%}]",
            f"{line['half_width_over_rmse']:.1f}",
        )
    return shown


def _fits(fits: list[dict[str, Any]]) -> Table:
    shown = _table(
        "What a Gaussian process costs, Box10: ms of a call",
        "It pays where one evaluation takes longer than the last columns say.",
        "N",
        *fits[0]["ms"],
        *(f"pays from, {quantity}" for quantity in fits[0]["pays_from_us"]),
    )
    for line in fits:
        pays = ("-" if us is None else f"{us:.2g} us" for us in line["pays_from_us"].values())
        shown.add_row(str(line["samples"]), *(f"{ms:.3g}" for ms in line["ms"].values()), *pays)
    return shown
