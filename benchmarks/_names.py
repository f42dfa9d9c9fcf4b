"""What each method is called and the line that it has, in every table, figure and page.

Methods of papers are named after their authors, those of other packages after the package's own
word, ours after the solver's class. Ours have warm colours, all others cold ones; all can be told
from both a white and a black ground. Who adds a method adds a line here.
"""

from typing import NamedTuple

SOLID, DASHED, DOTTED, MIXED = "", "6 3", "1.5 2", "7 2 1.5 2"  # as SVG has them


class Named(NamedTuple):
    """A name and a line; `ours` is what this library offers as its own."""

    name: str
    colour: str
    dash: str = SOLID
    ours: bool = False


def _ours(name: str, colour: str, dash: str = SOLID) -> Named:
    return Named(name, colour, dash, ours=True)


OURS = {
    "gauss_newton": _ours("GaussNewton", "#D9400B"),
    "newton_cg": _ours("NewtonCG", "#E88F00"),
    "shortest_call": _ours("shortest call", "#9C3A00"),
    "shortest_call_keys": _ours("shortest call, fresh noise", "#9C3A00", DASHED),
    "first_order": _ours("FirstOrder", "#BF9A00", MIXED),
    "local_gauss_newton": _ours("LocalGaussNewton", "#E0285A"),
    "local_first_order": _ours("FirstOrder, support", "#BF9A00", DASHED),
    "local_gradient": _ours("smooth_grad, support", "#E2725B", DASHED),
    "local_cross_entropy": _ours("Cross-entropy, support", "#B5651D", DOTTED),
    "grey_gauss_newton": _ours("GaussNewton, network", "#D9400B"),
    "grey_ours": _ours("smooth_grad, network", "#E88F00"),
}
OTHERS = {
    "cma_es": Named("CMA-ES", "#1F77C9"),
    "cma_es_diagonal": Named("CMA-ES, diagonal", "#1F77C9", DASHED),
    "bipop_cma_es": Named("BIPOP-CMA-ES", "#1F77C9", MIXED),
    "py_bobyqa": Named("Py-BOBYQA", "#7B61D9"),
    "cobyqa": Named("COBYQA", "#7B61D9", DASHED),
    "dfo_ls": Named("DFO-LS", "#0F9BB8"),
    "dfo_ls_noise": Named("DFO-LS, told of noise", "#0F9BB8", DASHED),
    "least_squares": Named("SciPy least_squares", "#7089A8", DASHED),
    "random_search": Named("Random search", "#7A8896"),
    "nelder_mead": Named("Nelder-Mead", "#008F6B"),
    "finite_differences": Named("Differences, Adam", "#7A9A2E"),
    "grey_differences": Named("Differences, network", "#7A9A2E"),
    "fr22": Named("Fischer-FR22", "#A24FC4"),
    "fr22_keys": Named("Fischer-FR22, fresh noise", "#A24FC4", DOTTED),
    "grey_fr22": Named("Fischer-FR22, network", "#A24FC4"),
    "zerograds": Named("Fischer-ZeroGrads", "#C45BAA", DASHED),
    "wang_g": Named("Wang-G", "#3A9E94", DASHED),
    "wang_h": Named("Wang-H", "#3A9E94", MIXED),
    "wang_hvp": Named("Wang-HVP", "#3A9E94", DOTTED),
    "wang_hvpa": Named("Wang-HVPA", "#3A9E94"),
    "fischer_fr22": Named("Fischer-FR22, constant", "#A24FC4", DASHED),
    "grey_wang_g": Named("Wang-G, network", "#3A9E94", DASHED),
    "grey_aggregate": Named("Wang-G aggregate, network", "#3A9E94", DOTTED),
    "mitsuba_ad": Named("Mitsuba AD, Adam", "#5B7C99"),
    "spsa": Named("SPSA", "#5FA05F", DOTTED),
    "annealing": Named("Simulated annealing", "#7A8896", MIXED),
    "genetic_algorithm": Named("Genetic algorithm", "#9A86C4", DOTTED),
    "evosax_snes": Named("SNES", "#4A90C2", DOTTED),
    "bfgs": Named("BFGS", "#4D8076", DASHED),
    "optimistix_bfgs": Named("BFGS on differences", "#4D8076", MIXED),
    "jaxopt_lbfgs": Named("L-BFGS, smoothed", "#4D8076", DOTTED),
    "optax_perturbations": Named("optax.perturbations", "#8F6FB0", DASHED),
}
NAMES = OURS | OTHERS


def is_ours(method: str) -> bool:
    """Whether a method is this library's own."""
    return method in OURS


def name_of(method: str, title: str = "") -> str:
    """The name of a method, or else the title that it had when it ran."""
    return NAMES[method].name if method in NAMES else title or method
