"""Gradients, Hessians and Hessian-vector products of functions that AD cannot differentiate."""

from smoothdiff import filters, kernels, plot, surrogates
from smoothdiff._aggregate import Aggregate
from smoothdiff._baselines import AbstractBaseline
from smoothdiff._black_box import black_box
from smoothdiff._call import Options
from smoothdiff._check_gradient import GradientCheck, check_gradient
from smoothdiff._coarse_to_fine import coarse_to_fine
from smoothdiff._control_variate import control_variate
from smoothdiff._filtered_adam import filter_updates, filtered_adam, scale_by_filtered_adam
from smoothdiff._gp import GaussianProcess
from smoothdiff._grey_box import train_grey_box
from smoothdiff._grey_result import GreyBoxError, GreyRecord, GreyResult
from smoothdiff._host_samples import BlackBoxError
from smoothdiff._importance import Importance, difference_hvp
from smoothdiff._jaxlib import warn_if_it_can_hang
from smoothdiff._large_steps import large_steps
from smoothdiff._least_squares import LeastSquares
from smoothdiff._levels import CoarseToFine, Level
from smoothdiff._minimise import least_squares, minimise
from smoothdiff._newton_step import newton_step
from smoothdiff._noise import Noise
from smoothdiff._processes import Processes
from smoothdiff._quadratic import HessianOperator, QuadraticModel
from smoothdiff._ranges import Integer, Range
from smoothdiff._recommend import Recommendation, recommend
from smoothdiff._result import MinimiseError, Record, Result
from smoothdiff._samplers import AbstractSampler, Gaussian, Orthogonal, Sobol
from smoothdiff._search import Search
from smoothdiff._smooth import smooth
from smoothdiff._smooth_first import smooth_grad, smooth_jacobian, smooth_value_and_grad
from smoothdiff._smooth_second import smooth_hessian, smooth_hvp, smooth_quadratic
from smoothdiff._solvers.first_order import FirstOrder
from smoothdiff._solvers.gauss_newton import GaussNewton
from smoothdiff._solvers.local_cross_entropy import LocalCrossEntropy
from smoothdiff._solvers.local_gauss_newton import LocalGaussNewton
from smoothdiff._solvers.newton_cg import NewtonCG
from smoothdiff._solvers.zerograds import ZeroGrads
from smoothdiff._spaces import AbstractSpace
from smoothdiff._store import Evaluation, load_store
from smoothdiff._support import local_support, matrix_support, moving_support, probe_support
from smoothdiff._unbounded import Periodic, Positive, Real
from smoothdiff._uniform_sampler import Uniform
from smoothdiff._with_covariance import with_covariance

__version__ = "0.2.0"

__all__ = [
    "AbstractBaseline",
    "AbstractSampler",
    "AbstractSpace",
    "Aggregate",
    "BlackBoxError",
    "CoarseToFine",
    "Evaluation",
    "FirstOrder",
    "GaussNewton",
    "Gaussian",
    "GaussianProcess",
    "GradientCheck",
    "GreyBoxError",
    "GreyRecord",
    "GreyResult",
    "HessianOperator",
    "Importance",
    "Integer",
    "LeastSquares",
    "Level",
    "LocalCrossEntropy",
    "LocalGaussNewton",
    "MinimiseError",
    "NewtonCG",
    "Noise",
    "Options",
    "Orthogonal",
    "Periodic",
    "Positive",
    "Processes",
    "QuadraticModel",
    "Range",
    "Real",
    "Recommendation",
    "Record",
    "Result",
    "Search",
    "Sobol",
    "Uniform",
    "ZeroGrads",
    "black_box",
    "check_gradient",
    "coarse_to_fine",
    "control_variate",
    "difference_hvp",
    "filter_updates",
    "filtered_adam",
    "filters",
    "kernels",
    "large_steps",
    "least_squares",
    "load_store",
    "local_support",
    "matrix_support",
    "minimise",
    "moving_support",
    "newton_step",
    "plot",
    "probe_support",
    "recommend",
    "scale_by_filtered_adam",
    "smooth",
    "smooth_grad",
    "smooth_hessian",
    "smooth_hvp",
    "smooth_jacobian",
    "smooth_quadratic",
    "smooth_value_and_grad",
    "surrogates",
    "train_grey_box",
    "with_covariance",
]

warn_if_it_can_hang()
del warn_if_it_can_hang
