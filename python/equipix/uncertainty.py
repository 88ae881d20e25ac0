"""What noise, lamp drift and errors of the shifts leave uncertain in a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix import _native
from equipix._check import as_array, per_exposure, positive_workers
from equipix._types import Floats, Progress
from equipix.drift import slope_std
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class JointFit:
    """What a fit of more than M and L knew before, and found besides.

    Attributes
    ----------
    measured : ndarray, shape (n, 2), float64
        Shifts as they were given.
    shift_std : ndarray, shape (n, 2), float64, or None
        Their standard deviations, if they were to be refined.
    flux_model : tuple of str and list of float
        What was known of the fluxes: its kind, with standard deviations or times.
    offset : bool
        Whether an offset of each pixel was sought.
    shifts : ndarray, shape (n, 2), float64
        Shifts as found.
    refined : bool
        Whether they were refined.
    leaves_tilt : bool
        Whether the fluxes leave a tilt of ln M undetermined.
    coefficients : ndarray, shape of the spline's grid, float64
        Coefficients of the spline that the beam is; its values where all shifts are whole.
    unit : float
        Variance of a value of weight 1.
    """

    measured: NDArray[Any]
    shift_std: NDArray[Any] | None
    flux_model: tuple[str, list[float]]
    offset: bool
    shifts: NDArray[Any]
    refined: bool
    leaves_tilt: bool
    coefficients: NDArray[Any]
    unit: float


@dataclass(frozen=True, eq=False)
class Measurements:
    """What a calibration was made from, in the compiled part's shapes.

    Attributes
    ----------
    frames : ndarray, shape (n, rows, cols)
        Values; what is not finite is not used.
    shifts : ndarray, shape (n, 2), int64
        The nearest whole-pixel shifts (row, col).
    rotation : list of int
        Rotation of each exposure, in degrees.
    flux : list of float
        Relative flux of each exposure, as found.
    variance : ndarray, shape (n,) or (n, rows, cols), or None
        Variance of the values; None: all weights are 1.
    mask : ndarray of bool, shape (rows, cols) or (n, rows, cols), or None
        True = do not use.
    joint : JointFit or None
        What else was sought; None: M and L alone, at whole shifts.
    """

    frames: NDArray[Any]
    shifts: NDArray[np.int64]
    rotation: list[int]
    flux: list[float]
    variance: NDArray[Any] | None
    mask: NDArray[np.bool_] | None
    joint: JointFit | None

    def solution(
        self, sensitivity: NDArray[Any], beam: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """The solution as the compiled part takes it: M, and L or its coefficients."""
        cells = beam if self.joint is None else self.joint.coefficients
        return np.ascontiguousarray(sensitivity, np.float64), np.ascontiguousarray(cells)

    def scale(self, reduced_chi2: float) -> float:
        """What standard deviations of unit weights are multiplied by.

        Raises
        ------
        InputError
            If no variance was given and none can be told from the residuals.
        """
        if self.variance is not None:
            return 1.0
        if not np.isfinite(reduced_chi2):
            raise InputError(
                "'variance' is None and no residual tells the noise, since there are no more "
                "measurements than unknowns: give the variance of the values"
            )
        return float(np.sqrt(reduced_chi2))


def error_map(
    measurements: Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    reduced_chi2: float,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> tuple[Floats, dict[str, Any]]:
    """Standard deviation of M in every pixel, and how exact it is.

    Parameters
    ----------
    measurements : Measurements
        What the calibration was made from.
    sensitivity : ndarray, shape (rows, cols)
        The solution M, of mean 1.
    beam : ndarray, shape of the padded grid
        The solution L; after a joint fit its coefficients stand in `measurements`.
    reduced_chi2 : float
        Of the fit: the variance of a value where none was given.
    workers : int, optional
        Number of threads.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then.

    Returns
    -------
    std : ndarray, shape (rows, cols), float64
        Standard deviation of M in the gauge mean 1; NaN where M is undetermined.
    exactness : dict
        ``draws``, and ``relative_standard_error`` of the map, root mean square over the pixels.

    Raises
    ------
    InputError
        If no variance was given and no residual tells it.
    InsufficientMemoryError
        If the memory that it takes cannot be had.

    Notes
    -----
    Given L the pixels are independent, and given M the cells of L, so two terms of the variance
    are exact; the third, a fifth of the whole with five exposures, is the mean square over draws:
    solutions of the linearised problem for noise alone. After a joint fit only the first term is
    exact, and some 45 % are drawn. There are as many draws as bring the relative standard error to
    2 %.
    """
    scale = measurements.scale(reduced_chi2)
    std, draws, exactness = _native.error_map(
        measurements,
        *measurements.solution(sensitivity, beam),
        workers=positive_workers(workers),
        progress=progress,
    )
    std *= scale
    return std, {"draws": draws, "relative_standard_error": exactness}


def functional_std(
    measurements: Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    reduced_chi2: float,
    weights: NDArray[Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Floats:
    """Standard deviation of the sum of weights · ln M, for each of a stack of weights.

    Parameters
    ----------
    measurements : Measurements
        What the calibration was made from.
    sensitivity : ndarray, shape (rows, cols)
        The solution M, of mean 1.
    beam : ndarray, shape of the padded grid
        The solution L; after a joint fit its coefficients stand in `measurements`.
    reduced_chi2 : float
        Of the fit: the variance of a value where none was given.
    weights : ndarray, shape (m, rows, cols)
        Weights of the pixels; 0 where ln M is undetermined.
    workers : int, optional
        Number of threads.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then.

    Returns
    -------
    ndarray, shape (m,), float64
        The standard deviations.

    Raises
    ------
    InputError
        If no variance was given and no residual tells it.
    InsufficientMemoryError
        If the memory that it takes cannot be had.

    Notes
    -----
    With g = weights/M the variance is gᵀ S⁻¹ g, in the gauge mean(M) = 1: the solution of one
    linear problem, to 1e-4 of the variance.
    """
    scale = measurements.scale(reduced_chi2)
    functionals = np.divide(weights, sensitivity, where=weights != 0, out=np.zeros(weights.shape))
    variances = _native.functional_variances(
        measurements,
        *measurements.solution(sensitivity, beam),
        functionals=functionals,
        workers=positive_workers(workers),
        progress=progress,
    )
    return np.asarray(np.sqrt(variances) * scale)


def shift_std_left(
    measurements: Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    reduced_chi2: float,
    *,
    workers: int | None = None,
) -> Floats | None:
    """Standard deviation of each shift that had one before: of those refined, what is left of it.

    Parameters
    ----------
    measurements : Measurements
        What the calibration was made from.
    sensitivity : ndarray, shape (rows, cols)
        The solution M, of mean 1.
    beam : ndarray, shape of the padded grid
        The solution L; after a joint fit its coefficients stand in `measurements`.
    reduced_chi2 : float
        Of the fit: the variance of a value where none was given.
    workers : int, optional
        Number of threads.

    Returns
    -------
    ndarray, shape (n, 2), float64, or None
        The standard deviations, in pixels; None if the shifts were given as exact.

    Raises
    ------
    InputError
        If no variance was given and no residual tells it.
    InsufficientMemoryError
        If the memory that it takes cannot be had.
    """
    fit = measurements.joint
    if fit is None or fit.shift_std is None:
        return None
    if not fit.refined:
        return fit.shift_std
    scale = measurements.scale(reduced_chi2)
    variances = _native.shift_variances(
        measurements,
        *measurements.solution(sensitivity, beam),
        workers=positive_workers(workers),
        progress=None,
    )
    return np.sqrt(variances) * scale


def offset_std(
    measurements: Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    reduced_chi2: float,
    *,
    workers: int | None = None,
) -> tuple[float, float]:
    """How well fitted offsets O are known: in what their errors have in common, and alone.

    Parameters
    ----------
    measurements : Measurements
        What the calibration was made from.
    sensitivity : ndarray, shape (rows, cols)
        The solution M, of mean 1.
    beam : ndarray, shape of the padded grid
        The solution L; after a joint fit its coefficients stand in `measurements`.
    reduced_chi2 : float
        Of the fit: the variance of a value where none was given.
    workers : int, optional
        Number of threads.

    Returns
    -------
    along : float
        Standard deviation of b, the least-squares part b·M of all errors, in the units of the
        frames.
    alone : float
        Root mean square of what the noise of a pixel's own measurements does to its offset.

    Raises
    ------
    InputError
        If no variance was given and no residual tells it.
    InsufficientMemoryError
        If the memory that it takes cannot be had.

    Notes
    -----
    With fitted ratios of the levels nothing that is measured changes when O → O + b·M, L → L − b
    and the ratios follow, if L is the same at all positions of a pixel: then b is not told.
    """
    scale = measurements.scale(reduced_chi2)
    variances = _native.offset_variances(
        measurements,
        *measurements.solution(sensitivity, beam),
        workers=positive_workers(workers),
        progress=None,
    )
    along, alone = np.sqrt(variances) * scale
    return float(along), float(alone)


def checked_weights(weights: ArrayLike, determined: NDArray[np.bool_]) -> Floats:
    """Weights of a functional as (m, rows, cols), 0 wherever ln M is undetermined.

    Parameters
    ----------
    weights : array_like, shape (rows, cols) or (m, rows, cols)
        Weights of the pixels.
    determined : ndarray of bool, shape (rows, cols)
        Where ln M is known.

    Returns
    -------
    ndarray, shape (m, rows, cols), float64
        The weights.

    Raises
    ------
    InputError
        If they do not fit the sensor, or are not finite, or not 0 in such a pixel.
    """
    array = as_array("weights", weights, ndim=(2, 3)).astype(np.float64, copy=False)
    if array.shape[-2:] != determined.shape:
        raise InputError(f"'weights' has shape {array.shape}, the sensor {determined.shape}")
    if not np.isfinite(array).all():
        raise InputError("'weights' holds values that are not finite")
    stack = array.reshape(-1, *determined.shape)
    wrong = (stack != 0).any(axis=0) & ~determined
    if wrong.any():
        row, col = np.argwhere(wrong)[0].tolist()
        raise InputError(
            f"'weights' is not 0 in {np.count_nonzero(wrong)} pixels whose ln M is undetermined, "
            f"the first at ({row}, {col}): set it to 0 there"
        )
    return stack


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
        Mean slope (row, col) of ln L over the sensor, per pixel: what makes an error of a shift
        look like one of the flux.

    Returns
    -------
    ndarray, shape (2,), float64
        Standard deviation of the slope of ln M, edge to edge, (row, col); infinite along an axis
        that the shifts leave open.

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
    if not (np.isfinite(array) & (array >= 0)).all():
        raise InputError(f"'{name}' holds values that are not 0 or above")
    return np.broadcast_to(array, shape)
