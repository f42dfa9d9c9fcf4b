"""Those of other libraries, with their defaults; bounds and the first width are the problem's.

That width is the default of DFO-LS and Py-BOBYQA, a tenth of the largest parameter.
"""

from functools import partial
from inspect import getsource
from itertools import chain, count
from typing import Any

import numpy as np
from scipy import optimize

from benchmarks.methods._flat import package
from benchmarks.studies.profiles.runs import SEED, Method, Seen


def dfo_ls(seen: Seen, noise: bool) -> None:
    """Told, or not, that there is noise: then it restarts."""
    dfols, case = package("dfols", "DFO-LS"), seen.case
    options: dict[str, Any] = {"bounds": case.bounds, "objfun_has_noise": noise}
    dfols.solve(
        seen, case.start, rhobeg=case.width, maxfun=seen.budget, do_logging=False, **options
    )


def differences(seen: Seen) -> None:
    """Two-point ones, for a trust-region Gauss-Newton."""
    bounds = (-np.inf, np.inf) if seen.case.bounds is None else seen.case.bounds
    optimize.least_squares(seen, seen.case.start, bounds=bounds)


def py_bobyqa(seen: Seen) -> None:
    """Told that there is noise where there is."""
    pybobyqa, case = package("pybobyqa", "Py-BOBYQA"), seen.case
    options: dict[str, Any] = {"bounds": case.bounds, "objfun_has_noise": case.kind.noisy}
    pybobyqa.solve(
        seen, case.start, rhobeg=case.width, maxfun=seen.budget, do_logging=False, **options
    )


def cobyqa(seen: Seen) -> None:
    options = {"initial_tr_radius": seen.case.width, "maxfev": seen.budget}
    _scipy(seen, "COBYQA", bounds=_pairs(seen), options=options)


def bfgs(seen: Seen) -> None:
    """On its own differences; it knows no bounds."""
    _scipy(seen, "BFGS", options={"maxiter": seen.budget})


def nelder_mead(seen: Seen) -> None:
    """The first simplex has edges of the width, into the box."""
    case = seen.case
    high = np.inf if case.bounds is None else case.bounds[1]
    edges = np.diag(np.where(case.start + case.width <= high, case.width, -case.width))
    options = {
        "initial_simplex": np.vstack([case.start, case.start + edges]),
        "maxiter": seen.budget,
        "maxfev": seen.budget,
    }
    _scipy(seen, "Nelder-Mead", bounds=_pairs(seen), options=options)


def bipop_cma_es(seen: Seen) -> None:
    """Restarts begin anywhere in the box, or without one at the start."""
    cma, case = package("cma", "cma"), seen.case
    options: dict[str, Any] = {"maxfevals": seen.budget, "seed": SEED + 1, "verbose": -9}
    if case.start.size == 1:  # pycma 4 raises where it would cut the width in 1-D
        options["maxstd"] = np.inf
    start: Any = case.start
    if case.bounds is not None:
        options["bounds"] = list(case.bounds)
        (low, high), random = case.bounds, np.random.default_rng(SEED)
        starts = chain([case.start], (random.uniform(low, high) for _ in count()))
        start = lambda: next(starts)
    cma.fmin2(seen, start, case.width, options, restarts=9, bipop=True)


def random_search(seen: Seen) -> None:
    """Anywhere in the box; without one around the start, so far away as the first width says."""
    case = seen.case
    random = np.random.default_rng(list(case.name.encode()))  # other starts have other points
    seen(case.start)
    while True:
        away = case.width * random.normal(size=case.start.size)
        seen(case.start + away if case.bounds is None else random.uniform(*case.bounds))


def _scipy(seen: Seen, method: str, **how: Any) -> None:
    optimize.minimize(seen, seen.case.start, method=method, **how)


def _pairs(seen: Seen) -> np.ndarray | None:
    return None if seen.case.bounds is None else np.transpose(seen.case.bounds)


def _method(title: str, search: Any, residuals: bool = False) -> Method:
    function = search.func if isinstance(search, partial) else search
    return Method(title, residuals, search, getsource(function) + getsource(_scipy))


METHODS = {
    "dfo_ls": _method("DFO-LS", partial(dfo_ls, noise=False), residuals=True),
    "dfo_ls_noise": _method("DFO-LS, told of noise", partial(dfo_ls, noise=True), residuals=True),
    "least_squares": _method("least_squares (SciPy)", differences, residuals=True),
    "py_bobyqa": _method("Py-BOBYQA", py_bobyqa),
    "cobyqa": _method("COBYQA (SciPy)", cobyqa),
    "bfgs": _method("BFGS (SciPy)", bfgs),
    "nelder_mead": _method("Nelder-Mead (SciPy)", nelder_mead),
    "bipop_cma_es": _method("BIPOP-CMA-ES (pycma)", bipop_cma_es),
    "random_search": _method("random search", random_search),
}
