"""The methods. Each is a module with TITLE and `prepare(task) -> solve`, imported when asked for.

A module of several methods has VARIANTS instead, name -> (title, prepare). To add a method, write
it and name it here; the order is that of tables and figures. A method has one setting for all
tasks: it takes its scale from `task.sigma` and the bounds, and from nothing else.
"""

import importlib
import inspect
import re
from pathlib import Path

from benchmarks._task import Method

METHODS = {
    "finite_differences": "benchmarks.methods.finite_differences",
    "fr22": "benchmarks.methods.fr22",
    "cma_es": "benchmarks.methods.cma_es",
    "cma_es_diagonal": "benchmarks.methods.cma_es_diagonal",
    "mitsuba_ad": "benchmarks.methods.mitsuba_ad",
    "evosax_snes": "benchmarks.methods.evosax_snes",
    "nelder_mead": "benchmarks.methods.scipy_local",
    "powell": "benchmarks.methods.scipy_local",
    "py_bobyqa": "benchmarks.methods.py_bobyqa",
    "annealing": "benchmarks.methods.annealing",
    "genetic_algorithm": "benchmarks.methods.genetic_algorithm",
    "spsa": "benchmarks.methods.spsa",
    "optax_perturbations": "benchmarks.methods.optax_perturbations",
    "optimistix_bfgs": "benchmarks.methods.optimistix_bfgs",
    "jaxopt_lbfgs": "benchmarks.methods.jaxopt_lbfgs",
    "our_gradient": "benchmarks.methods.our_gradient",
    "our_h": "benchmarks.methods.nonlinear_cg",
    "our_hvp": "benchmarks.methods.nonlinear_cg",
    "our_hvpa": "benchmarks.methods.nonlinear_cg",
    "newton": "benchmarks.methods.newton",
    "newton_modified": "benchmarks.methods.newton",
    "bfgs": "benchmarks.methods.quasi_newton",
    "lbfgs": "benchmarks.methods.quasi_newton",
    "bfgs_wolfe": "benchmarks.methods.quasi_newton",
    "bfgs_damped": "benchmarks.methods.quasi_newton",
    "bfgs_adaptive": "benchmarks.methods.adaptive_differences",
    "first_order": "benchmarks.methods.first_order",
    "local_gradient": "benchmarks.methods.local_gradient",
    "local_first_order": "benchmarks.methods.local_gradient",
    "local_cross_entropy": "benchmarks.methods.local_cross_entropy",
    "grey_differences": "benchmarks.methods.grey_box",
    "grey_fr22": "benchmarks.methods.grey_box",
    "grey_our_gradient": "benchmarks.methods.grey_box",
    "grey_aggregate": "benchmarks.methods.grey_box",
    "grey_ours": "benchmarks.methods.grey_box",
    "grey_gauss_newton": "benchmarks.methods.grey_gauss_newton",
    "zerograds": "benchmarks.methods.zerograds",
    "newton_cg": "benchmarks.methods.newton_cg",
    "gauss_newton": "benchmarks.methods.gauss_newton",
    "local_gauss_newton": "benchmarks.methods.local_gauss_newton",
}

# what runs unless more is asked for: the usual choices, the papers' best, and ours
QUICK = (
    "finite_differences",
    "fr22",
    "cma_es",
    "mitsuba_ad",
    "our_hvpa",
    "newton_cg",
    "gauss_newton",
)

# what runs on the scenes of the report: also what else people use, and what else was published
SCENES = (
    "finite_differences",
    "spsa",
    "fr22",
    "our_gradient",
    "our_hvpa",
    "zerograds",
    "cma_es",
    "genetic_algorithm",
    "annealing",
    "nelder_mead",
    "optimistix_bfgs",
    "jaxopt_lbfgs",
    "optax_perturbations",
    "mitsuba_ad",
    "first_order",
    "newton_cg",
    "gauss_newton",
)

# what runs on programs of the ZeroGrads paper: what it compares with, and ours
MANY_PARAMETERS = (
    "fr22",
    "spsa",
    "cma_es_diagonal",
    "evosax_snes",
    "genetic_algorithm",
    "annealing",
    "zerograds",
    "first_order",
    "local_gradient",
    "local_first_order",
    "local_cross_entropy",
    "gauss_newton",
    "local_gauss_newton",
)
# and what takes more for each step, or more memory than a vector, the more parameters there are
PROGRAMS = ("finite_differences", "cma_es", *MANY_PARAMETERS, "newton_cg")


def load(name: str) -> Method:
    """A method by its name."""
    if name not in METHODS:
        raise ValueError(f"There is no method {name!r}; choose from {', '.join(METHODS)}.")
    module = importlib.import_module(METHODS[name])
    if hasattr(module, "VARIANTS"):
        title, prepare = module.VARIANTS[name]
    else:
        title, prepare = module.TITLE, module.prepare
    return Method(name, title, prepare, _source(inspect.getsource(module)))


def _source(text: str) -> str:
    """The text of a module, followed by the text of the modules here that it imports, in turn."""
    found = {"": text}
    waiting = [text]
    while waiting:
        for name in re.findall(r"from benchmarks\.methods(?:\.| import )(\w+)", waiting.pop()):
            path = Path(__file__).with_name(f"{name}.py")
            if name not in found and path.exists():
                found[name] = path.read_text()
                waiting.append(found[name])
    return "".join(text for _, text in sorted(found.items()))
