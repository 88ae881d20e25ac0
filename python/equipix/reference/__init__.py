"""Executable specification: what equipix computes, in plain NumPy.

Nothing here is fast, and the package itself never imports it: it is what the fast code is
checked against, so it shares no line with it.
"""

from equipix.reference.average import average
from equipix.reference.connectivity import components
from equipix.reference.descent import Solution, coordinate_descent
from equipix.reference.fixed_point import adapt_words, apply_words
from equipix.reference.joint import JointSolution, joint
from equipix.reference.least_squares import solve_dense
from equipix.reference.model import exposures, grid_cells, objective
from equipix.reference.multiscale import MultiscaleSolution, multiscale
from equipix.reference.response import inverse, response
from equipix.reference.uncertainty import covariance
from equipix.reference.weak_light import weak_light_prior

__all__ = [
    "JointSolution",
    "MultiscaleSolution",
    "Solution",
    "adapt_words",
    "apply_words",
    "average",
    "components",
    "coordinate_descent",
    "covariance",
    "exposures",
    "grid_cells",
    "inverse",
    "joint",
    "multiscale",
    "objective",
    "response",
    "solve_dense",
    "weak_light_prior",
]
