"""Executable specification: what equipix computes, in plain NumPy.

Nothing here is fast. The fast code is checked against it, so it imports NumPy alone and shares no
line with the package.
"""

from reference.average import average
from reference.connectivity import components
from reference.descent import Solution, coordinate_descent
from reference.fixed_point import adapt_words, apply_words
from reference.joint import JointSolution, joint
from reference.least_squares import solve_dense
from reference.model import exposures, grid_cells, objective
from reference.response import inverse, response
from reference.uncertainty import covariance
from reference.weak_light import weak_light_prior

__all__ = [
    "JointSolution",
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
    "objective",
    "response",
    "solve_dense",
    "weak_light_prior",
]
