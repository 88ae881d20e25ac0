"""Uncertainty of a calibration by lamp drift and errors of the shifts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import as_array, per_exposure
from equipix._types import Floats
from equipix.drift import slope_std
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def tilt_std(
    shifts: ArrayLike,
    shape: tuple[int, int],
    *,
    flux_std: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    beam_slope: ArrayLike = (0.0, 0.0),
) -> Floats:
    r"""Standard deviation of the tilt that errors of fluxes and shifts cause.

    Parameters
    ----------
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels, all exposures turned alike.
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    flux_std : array_like, shape () or (n,), optional
        Relative standard deviation of the flux of each exposure.
    shift_std : array_like, shape () or (n, 2), optional
        Standard deviation of each shift, in pixels.
    beam_slope : array_like, shape (2,)
        Mean slope (row, col) of ln L over the sensor, per pixel: it converts an error of a shift to
        one of the flux.

    Returns
    -------
    ndarray, shape (2,), float64
        Standard deviation of the slope of ln M, edge to edge, (row, col); infinite along an axis
        that the shifts do not determine.

    Notes
    -----
    An error of ln c that is affine in the shifts, a + s·d, leaves no residual: it becomes the tilt
    s of ln M. Of independent errors ε_k that part is the least-squares one, with D the shifts less
    their mean

    .. math:: \mathrm{Cov}(s) = (D^T D)^{-1} D^T \mathrm{diag}(ε_k^2) D (D^T D)^{-1},

    which is (ε²/n) times the inverse covariance of the shifts where all ε are equal. An error δ of
    a shift counts as one of ln c by δ·∇ln L.

    Examples
    --------
    >>> import equipix
    >>> from equipix.uncertainty import tilt_std
    >>> rows, cols = tilt_std(equipix.cross_pattern(11, 19), (582, 782), flux_std=1e-4)
    >>> print(f"{rows:.1e} {cols:.1e}")
    4.2e-03 5.6e-03
    """
    positions = as_array("shifts", shifts, ndim=2).astype(np.float64)
    count = len(positions)
    variance = np.zeros(count)
    if flux_std is not None:
        variance += np.square(_each("flux_std", flux_std, (count,)))
    if shift_std is not None:
        slope = per_exposure("beam_slope", beam_slope, 2, default=0)
        variance += np.square(_each("shift_std", shift_std, (count, 2)) * slope).sum(axis=1)
    if np.linalg.matrix_rank(positions - positions.mean(axis=0)) < 2:
        return np.full(2, np.inf)
    return np.asarray(slope_std(positions, np.sqrt(variance)) * shape)


def _each(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Standard deviations, one for all or one for each."""
    array = as_array(name, values, ndim=(0, 1, len(shape))).astype(np.float64)
    if array.shape not in ((1,), shape):
        raise InputError(f"'{name}' has shape {array.shape}, expected {shape} or one number")
    wrong = array[~(np.isfinite(array) & (array >= 0))]
    if wrong.size:
        raise InputError(f"'{name}' holds {wrong[0]:g}, expected finite numbers not below 0")
    return np.broadcast_to(array, shape)
