"""Gradients, Hessians and Hessian-vector products of functions that AD cannot differentiate."""

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._black_box import black_box
from smoothdiff._host_calls import BlackBoxError
from smoothdiff._quadratic import HessianOperator, QuadraticModel
from smoothdiff._samplers import AbstractSampler, Gaussian
from smoothdiff._smooth import (
    Options,
    smooth,
    smooth_grad,
    smooth_hessian,
    smooth_hvp,
    smooth_jacobian,
    smooth_quadratic,
    smooth_value_and_grad,
)

__version__ = "0.1.0"

__all__ = [
    "AbstractBaseline",
    "AbstractSampler",
    "BlackBoxError",
    "Gaussian",
    "HessianOperator",
    "Options",
    "QuadraticModel",
    "black_box",
    "smooth",
    "smooth_grad",
    "smooth_hessian",
    "smooth_hvp",
    "smooth_jacobian",
    "smooth_quadratic",
    "smooth_value_and_grad",
]
