"""Shift calibration: sensitivity and beam from exposures of one beam at several positions."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np

from equipix import _native
from equipix._check import (
    as_tolerance,
    check_count,
    check_progress,
    naming_memory,
    per_exposure,
    positive_count,
    positive_workers,
)
from equipix._types import Flagged, FluxModel, Method, Progress, ShiftSign
from equipix.calibration.saved import read_fields, save_fields
from equipix.calibration.sign import shift_sign
from equipix.calibration.weights import Problem, modelled, solve_robustly
from equipix.correction.apply import apply_gain
from equipix.defects import noisy_pixels, odd_responses
from equipix.errors import (
    ConvergenceWarning,
    IdentifiabilityWarning,
    InputError,
    MisfitWarning,
)
from equipix.exposures.checks import (
    Asked,
    as_flux,
    as_mask,
    as_models,
    as_rotation,
    as_saturated,
    as_shift_std,
    as_statistics,
    as_values,
    as_variances,
    moves,
    union,
    warn_of_order,
)
from equipix.flags import Flag, determined
from equipix.frames import FrameStatistics
from equipix.maps import tilt, tilt_weights
from equipix.noise import fit_frames
from equipix.prediction import light, positions, predictions
from equipix.shifts import as_positions, round_shifts
from equipix.uncertainty import (
    JointFit,
    Measurements,
    checked_weights,
    error_map,
    functional_std,
    offset_std,
    shift_std_left,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray

    from equipix.noise import NoiseModel


_MISFIT = 4.0
"""A reduced χ² this large has a cause other than variances that are a little off."""

_NOT_FOUND = 0.1
"""A joint fit that ends with so large an error of M has no errors that noise would make."""

UNTOLD = 1e-4
"""A Ritz value this small stands for a pattern that no measurement tells: noise in it is 100 times
what it is elsewhere."""


@dataclass(frozen=True, eq=False)
class History:
    """How a calibration went, at some moments on its way.

    Attributes
    ----------
    sweep : ndarray, shape (looks,), uint64
        How many sweeps had been made.
    objective : ndarray, shape (looks,), float64
        Objective F, with penalty and priors where a fit has them; it never rises but for rounding,
        and while such a fit still finds their weights.
    error_estimate : ndarray, shape (looks,), float64
        The estimated largest relative error of the sensitivity.
    """

    sweep: NDArray[Any]
    objective: NDArray[Any]
    error_estimate: NDArray[Any]


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """Calibrated sensor: the result of `calibrate`.

    Attributes
    ----------
    sensitivity : ndarray, shape (rows, cols)
        Relative sensitivity M of mean 1 over valid pixels; NaN where undetermined. float32 for
        float32 frames, else float64.
    beam : ndarray, shape of the padded grid, float64
        The beam L in the units of the frames; NaN where unobserved.
    beam_origin : tuple of int
        ``beam[beam_origin + p]`` is the beam at pixel p of a sensor with shift 0.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`; 0 for a good pixel. One whose sensitivity is below half of its
        neighbours', or not above 0, is ``DEAD | DO_NOT_USE``, above twice theirs ``HOT |
        DO_NOT_USE``; their sensitivity is the median of a block of 16×16 pixels. What the
        measurements do not determine is ``NO_FLAT_FIELD | DO_NOT_USE``, what they contradict
        each other about, so that a robust calibration left out most of them,
        ``UNRELIABLE_FLAT | DO_NOT_USE``.
    shifts : ndarray, shape (n, 2), float64
        The shifts (row, col) that were used, in pixels.
    flux : ndarray, shape (n,), float64
        The relative flux of each exposure.
    objective : float
        Objective F at the end.
    reduced_chi2 : float
        F over the degrees of freedom: 1 on average where the variances given are right, and the
        variance of one value where none were given. NaN without any degree of freedom.
    components : int
        Number of connected components: parts of the sensor that the measurements do not compare.
        A pixel that does not respond ties none together; nor does one whose measurements carry
        next to no weight.
    component_labels : ndarray, shape (rows, cols), int32
        The component of each pixel, the largest being 0; −1 for a pixel without measurement.
    sweeps : int
        Sweeps of coordinate descent; of the multiscale method, passes over the data or its weights
        of about a sweep's worth each.
    converged : bool
        Whether `error_estimate` is within the tolerance.
    error_estimate : float
        Estimated largest distance of `sensitivity` from the minimum of F, large scales included.
        It says nothing of noise.
    history : History
        Objective and error estimate along the way.
    dark : ndarray, shape (rows, cols), or None
        The dark frame in DN, if it is part of the calibration.
    metadata : dict
        Versions, options and origin, as JSON values (``options["weights"]``: "equal" where no
        variance was known, else "variances"); under ``uncertainty`` the draws that
        `sensitivity_std` was made of, and its relative standard error; under ``dark``, where it
        was fitted together with fluxes, the standard deviation of b in its error b·M, which
        they hardly tell, and what the noise of its own measurements leaves of a pixel.
    sensitivity_std : ndarray, shape (rows, cols), or None
        Standard deviation of `sensitivity` by noise, and by what fitted fluxes and shifts leave
        uncertain, large scales included, in the gauge mean 1, and slope 0 where free fluxes leave
        a tilt undetermined; NaN where undetermined. In `sensitivity`'s dtype; None unless asked
        for, or where a joint fit did not find M at all.
    tilt_std : ndarray, shape (2,), or None
        Standard deviation of `tilt`; infinite where free fluxes leave it undetermined. None unless
        asked for.
    shift_std : ndarray, shape (n, 2), or None
        Standard deviation of `shifts`, in pixels, where they had one before: of those refined, less
        their mean by the prior's weights, since what moves all exposures alike moves but the beam;
        else that given. None unless asked for.
    measurements : Measurements or None
        References to what the calibration was made from, for `std_of`; None if read from a file.
    rejected : ndarray of bool, shape (n, rows, cols), or None
        The measurements that a robust calibration left out; `metadata` counts them.
    shift_sign : {"confirmed", "contradicted", "undetermined"}
        Whether the data confirm the sign of the shifts, contradict it, or do not tell it, as those
        of a Gaussian beam, whatever its width; see `calibrate`.
    """

    sensitivity: NDArray[Any]
    beam: NDArray[Any]
    beam_origin: tuple[int, int]
    flags: NDArray[Any]
    shifts: NDArray[Any]
    flux: NDArray[Any]
    objective: float
    reduced_chi2: float
    components: int
    component_labels: NDArray[Any]
    sweeps: int
    converged: bool
    error_estimate: float
    history: History
    dark: NDArray[Any] | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    sensitivity_std: NDArray[Any] | None = None
    tilt_std: NDArray[Any] | None = None
    shift_std: NDArray[Any] | None = None
    measurements: Measurements | None = None
    rejected: NDArray[np.bool_] | None = None
    shift_sign: ShiftSign = "undetermined"

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""
        rows, cols = self.sensitivity.shape
        return rows, cols

    def __repr__(self) -> str:
        """Short form: sizes and how far the solver came."""
        state = "converged" if self.converged else "not converged"
        std = self.sensitivity_std
        noise = "" if std is None else f", standard deviation {np.nanmedian(std):.1e}"
        return (
            f"<Calibration of {self.shape[0]} x {self.shape[1]} pixels from {len(self.shifts)} "
            f"exposures: {state}, error estimate {self.error_estimate:.1e}{noise}>"
        )

    @property
    def tilt(self) -> NDArray[Any]:
        """Least-squares slope of ln M over valid pixels, edge to edge (row, col).

        Valid are pixels without ``DO_NOT_USE``; NaN where they tell no slope.
        """
        return tilt(self.sensitivity, self._valid)

    @property
    def _valid(self) -> NDArray[np.bool_]:
        usable = (self.flags & Flag.DO_NOT_USE) == 0
        return np.asarray(usable & determined(self.sensitivity, self.flags))

    def std_of(
        self,
        weights: ArrayLike,
        *,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> float | NDArray[Any]:
        """Standard deviation of Σ weights · ln M by noise, large scales included.

        Parameters
        ----------
        weights : array_like, shape (rows, cols) or (m, rows, cols)
            The weight of each pixel, or a stack of them; 0 where M is undetermined or not above 0.
        workers : int, optional
            Number of threads; unless given, as many as processors may be used.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` now and then.

        Returns
        -------
        float, or ndarray of shape (m,)
            One for each image of weights, in the gauge mean(M) = 1; where free fluxes leave a tilt
            undetermined, in that of slope 0, though a sum that sees the tilt is as uncertain as
            `tilt_std`.

        Raises
        ------
        InputError
            If this calibration was read from a file, which holds no measurements; if the weights
            do not fit; or if no variance was given and no residual tells it.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Notes
        -----
        Errors of pixels are correlated: the variance of a mean over many cannot be had from
        `sensitivity_std`. With w the weights and g = w/M it is gᵀ S⁻¹ g, S being the reduced normal
        matrix: one linear problem, about as much work as the calibration. Changes made since to the
        arrays that were calibrated go unnoticed.

        Examples
        --------
        The mean of ln M over the left half, less that over the right:

        >>> import numpy as np
        >>> import equipix
        >>> shape = (48, 64)
        >>> shifts = equipix.cross_pattern(5, 7)
        >>> beam = equipix.simulate.gaussian_beam(shape)
        >>> frames = equipix.simulate.exposures(np.ones(shape), beam, shifts)
        >>> cal = equipix.calibrate(frames, shifts, variance=np.full(5, 1e-6))
        >>> weights = np.where(np.arange(64) < 32, 1, -1) * np.ones(shape) / (48 * 32)
        >>> print(f"{cal.std_of(weights):.1e}")
        1.3e-04
        """
        measurements = self.measurements
        if measurements is None:
            raise InputError(
                "this calibration was read from a file, which does not hold the measurements: "
                "call std_of on the result of calibrate or Experiment.run"
            )
        check_progress(progress)
        stack = checked_weights(weights, determined(self.sensitivity, self.flags))
        with naming_memory("the standard deviation"):
            std = functional_std(
                measurements,
                self.sensitivity,
                self.beam,
                self.reduced_chi2,
                stack,
                workers=workers,
                progress=progress,
            )
        return float(std[0]) if np.ndim(weights) == 2 else std

    def correct(
        self,
        frames: ArrayLike,
        *,
        dark: Literal["stored"] | FrameStatistics | ArrayLike | None = "stored",
        flagged: Flagged = "nan",
        out: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """Frames as a sensor of equal pixels would have given them: (frame − dark) / M.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols)
            Raw frames, in DN.
        dark : "stored", FrameStatistics, array_like of shape (rows, cols), or None
            The dark frame to subtract, in DN: the one that is part of the calibration, another
            (of averaged frames the mean), or none where it is already subtracted.
        flagged : {"nan", "keep", "replace"}
            What becomes of pixels flagged ``DO_NOT_USE``: NaN, the value that the formula gives
            (NaN still where M is undetermined), or the mean of the nearest good pixels around.
        out : ndarray, optional
            Array for the result, of the frames' shape, float32 or float64.

        Returns
        -------
        ndarray, of the frames' shape
            Of dtype float64 for float64 frames, else float32; or `out`.

        Raises
        ------
        InputError
            If a shape does not fit, `dark` is "stored" and none is stored, or `flagged` is
            unknown.
        """
        if isinstance(dark, str):
            if dark != "stored":
                raise InputError(f"'dark' is {dark!r}, expected 'stored', an array or None")
            if self.dark is None:
                raise InputError(
                    "'dark' is 'stored' but this calibration holds no dark frame: give one, or "
                    "None if it is already subtracted"
                )
            dark = self.dark
        return apply_gain(
            frames, gain=self.sensitivity, dark=dark, flags=self.flags, flagged=flagged, out=out
        )

    @property
    def coefficients(self) -> NDArray[Any]:
        """Coefficients of the corrected frame Σ c_j y^j, shape (2, rows, cols).

        c_0 = −dark/M and c_1 = 1/M, in the dtype of `sensitivity`; NaN where M is undetermined.
        Without a dark frame in the calibration c_0 is 0, for frames whose dark is subtracted.
        """
        with np.errstate(divide="ignore", invalid="ignore"):  # a dead pixel may have M = 0
            gain = 1 / self.sensitivity
            offset = np.zeros_like(gain) if self.dark is None else -self.dark * gain
        offset[np.isnan(gain)] = np.nan
        return np.stack([offset, gain]).astype(self.sensitivity.dtype)

    def predict(self, shift: ArrayLike, *, rotation: int = 0, flux: float = 1.0) -> NDArray[Any]:
        """Frame that the sensor would give at another position: c · L(u) · M(p).

        Parameters
        ----------
        shift : array_like, shape (2,)
            Position (row, col) of the sensor in the beam, in pixels, as for `calibrate`.
        rotation : {0, 90, 180, 270}
            How far the sensor is turned, in degrees.
        flux : float
            Relative flux c of the exposure.

        Returns
        -------
        ndarray, shape (rows, cols)
            Noise-free signal in the units of the frames, the dark subtracted; NaN where the
            sensitivity is undetermined, and where no exposure has observed the beam.

        Raises
        ------
        InputError
            If an argument has a wrong shape or value.

        See Also
        --------
        residuals : How far frames are from it.

        Examples
        --------
        >>> import numpy as np
        >>> from equipix import calibrate, cross_pattern, simulate
        >>> beam, truth = simulate.gaussian_beam((48, 64)), np.ones((48, 64))
        >>> shifts = cross_pattern(5, 7)
        >>> cal = calibrate(simulate.exposures(truth, beam, shifts), shifts)
        >>> held_out = simulate.exposures(truth, beam, [(3, 4)])[0]
        >>> bool(np.nanmax(np.abs(cal.predict((3, 4)) - held_out)) < 1e-6)
        True
        """
        if np.shape(shift) != (2,):
            raise InputError(f"'shift' is {shift!r}, expected two numbers, (row, col) in pixels")
        return self._predictions(np.reshape(shift, (1, 2)), [rotation], [flux])[0]

    def residuals(
        self,
        frames: ArrayLike | Sequence[FrameStatistics],
        *,
        variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
        shifts: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
        flux: ArrayLike | None = None,
    ) -> NDArray[Any]:
        """How far frames are from what the calibration predicts: y − c · L(u) · M(p).

        Parameters
        ----------
        frames : array_like, shape (n, rows, cols), or sequence of FrameStatistics
            Exposures as they were calibrated, with the dark subtracted unless it was fitted: those
            that the calibration was made from, or others, whose `shifts` are given then.
        variance : array_like, shape (n,) or (n, rows, cols), or NoiseModel, optional
            Variance of the values given, as for `calibrate`.
        shifts, rotation, flux : array_like, optional
            Where and how bright the exposures were taken, as for `calibrate`; by default those
            of the calibration.

        Returns
        -------
        ndarray, shape (n, rows, cols)
            Residuals in the units of the frames; where variances are known, in standard
            deviations of a measurement. NaN where nothing is measured or predicted.

        Raises
        ------
        InputError
            If an argument has a wrong shape or value.

        Notes
        -----
        Of the exposures that a calibration was made from M and L have followed some of the
        noise: the mean square of residuals in standard deviations is `reduced_chi2` times the
        degrees of freedom over the number of measurements. Of one held out it is above 1, by
        the variance of the prediction.
        """
        statistics = as_statistics(frames)
        values = as_values(cast("ArrayLike", frames), statistics)
        if values.shape[1:] != self.shape:
            raise InputError(f"'frames' has shape {values.shape}, the sensor {self.shape}")
        if shifts is None:
            check_count("frames", len(values), len(self.shifts))
        predicted = self._predictions(
            self.shifts if shifts is None else shifts,
            self._rotation if shifts is None and rotation is None else rotation,
            self.flux if shifts is None and flux is None else flux,
        )
        check_count("shifts", len(predicted), len(values))
        models = as_models(variance, statistics, len(values))
        residuals: NDArray[Any] = np.where(np.isfinite(values), values, np.nan) - predicted
        if self.metadata["options"]["dark"] == "fit":
            residuals -= self.dark
        if models:
            scales = [model.variance(each) for model, each in zip(models, predicted, strict=True)]
        elif variance is not None:
            given = as_variances(cast("ArrayLike", variance), values)
            scales = list(given if given.ndim == 3 else given[:, None, None])
        else:
            return residuals
        with np.errstate(divide="ignore", invalid="ignore"):
            for residual, scale in zip(residuals, scales, strict=True):
                residual /= np.sqrt(scale)
        return residuals

    @property
    def _rotation(self) -> list[int]:
        rotation: list[int] = self.metadata["options"]["rotation"]
        return rotation

    def _predictions(
        self, shifts: ArrayLike, rotation: ArrayLike | None, flux: ArrayLike | None
    ) -> list[NDArray[Any]]:
        """Frames from these positions, each of shape (rows, cols)."""
        exact = as_positions(shifts)
        turns = as_rotation(rotation, len(exact))
        fluxes = per_exposure("flux", flux, len(exact), default=1)
        places = positions(self.beam_origin, exact, turns, fluxes)
        frames = predictions(self.sensitivity, self.beam, places)
        return [frame.astype(self.sensitivity.dtype) for frame in frames]

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write to a file that `equipix.load` reads.

        Parameters
        ----------
        path : str or path
            The file; its suffix, .tif or .npz, names the format. It appears whole or not at all.
        force : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            If the file exists and `force` is not set, or it cannot be written.
        InputError
            If the suffix is unknown.
        """
        save_fields(path, vars(self), force=force)


def read_calibration(
    path: str | PathLike[str], pages: Mapping[str, NDArray[Any]], content: dict[str, Any]
) -> Calibration:
    """Make a calibration of the arrays and metadata of the file that `Calibration.save` wrote."""
    fields = read_fields(path, pages, content)
    return Calibration(**{**fields, "history": History(**fields["history"])})


def calibrate(
    frames: ArrayLike | Sequence[FrameStatistics],
    shifts: ArrayLike,
    *,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    flux: ArrayLike | FluxModel | None = None,
    flux_std: ArrayLike | None = None,
    time: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    dark: Literal["subtracted", "fit"] = "subtracted",
    robust: bool = False,
    method: Method = "multiscale",
    tolerance: float = 1e-6,
    max_sweeps: int | None = None,
    uncertainty: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    r"""Measure the relative sensitivity of every pixel without a uniform source.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols), or sequence of FrameStatistics
        Mean exposures with the dark subtracted, at least two. NaN or infinite counts as masked.
        `FrameStatistics` bring their variances along: a noise model fitted over all pixels, not
        each pixel's own sample variance, gives the weights. A mean with saturated samples counts
        as masked, and its pixel is flagged; a pixel that scatters more than chance explains in
        every exposure is masked and flagged ``HOT``.
    shifts : array_like, shape (n, 2)
        Position (row, col) of the sensor in the beam in each exposure, in pixels: pixel p of an
        unrotated sensor sees the beam at p + shift. A wrong sign gives a wrong result, in a smooth
        beam without any residual to show it; `Calibration.shift_sign` says whether the data confirm
        it. Where they are not whole numbers the beam is a cubic spline;
        coordinate descent rounds them.
    variance : array_like, shape (n,) or (n, rows, cols), or NoiseModel, optional
        Variance of the values given; without it all weights are 1. A noise model, or one for each
        exposure, is evaluated at what a first fit expects, since with variances taken at the noisy
        values themselves those that happen to be low would weigh more. With `FrameStatistics` it
        is the model of one frame.
    mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
        True = do not use.
    saturation : float, optional
        Level, in the units of frames given as arrays: a value at or above it counts as masked, and
        its pixel is flagged.
    flux : array_like, shape (n,), "fit" or "linear", optional
        Known relative flux of each exposure, 1 unless given; or what is to be found: a flux for
        each exposure, or ln c linear in `time`.
    flux_std : float or array_like, shape (n,), optional
        Relative standard deviations of `flux`, which is then a prior and not taken as exact.
    time : array_like, shape (n,), optional
        When each exposure was taken, in seconds; for ``flux="linear"``.
    rotation : array_like of int, shape (n,), optional
        How far each exposure is turned, in degrees: 0, 90, 180 or 270, as by ``numpy.rot90`` of
        the beam's window; 0 unless given.
    shift_std : float or array_like, shape (n,) or (n, 2), optional
        Standard deviations of `shifts`, in pixels: the shifts are then refined, with this prior.
        What moves all exposures alike stays as given, and so do all where the beam has no
        structure that tells them (``metadata["options"]["shifts"]`` says which).
    dark : {"subtracted", "fit"}
        Whether the dark is already subtracted, or to be found as an offset of each pixel: for
        exposures at two or more levels of the lamp, whose ratio is `flux`, without a dark frame.
    robust : bool
        Whether to leave out measurements that disagree with the others, such as of a particle or
        a reflection that is there in one exposure only: those more than five standard deviations
        from the fit, or whose 3×3 surroundings are, found in rounds of fitting. The scale is that
        of the residuals, so variances need be right but for a factor. Needs three exposures. Give
        variances as a noise model, not as computed from values that a grain has darkened.
    method : {"multiscale", "coordinate-descent"}
        How to minimise the objective: by Gauss-Newton steps on all scales at once, in a number of
        passes that does not depend on the size of the sensor; or by the paper's method, which
        takes some (sensor size / shift)² of them.
    tolerance : float
        Largest relative error of the sensitivity, against the minimum of the objective, at
        which the solver stops; below 1. The estimate includes errors of the sensor's own size.
    max_sweeps : int, optional
        Most passes over the data or its weights, but for a few where a step turns out too long;
        unless given, as many as it takes. It also ends where rounding keeps the error estimate
        from falling. Passes that only estimate the error
        of coordinate descent are not counted.
    uncertainty : bool
        Whether to find `Calibration.sensitivity_std`, `Calibration.tilt_std` and, of shifts that
        were refined, `Calibration.shift_std`: what noise leaves uncertain, and what priors on
        fluxes and shifts do. Takes some ten times as long as the calibration, after a joint fit
        some hundred times. Without `variance` the scatter of the residuals tells the noise.
    workers : int, optional
        Number of threads; unless given, as many as processors may be used. The result is the
        same to the last bit.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then; what it raises stops the work.

    Returns
    -------
    Calibration
        Sensitivity, beam, flags and how far the solver came.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value, or an exposure shows no light.
    InsufficientMemoryError
        If the memory that it takes cannot be had; where the system tells (Linux), before the
        work starts.

    Warns
    -----
    ShiftRoundingWarning
        If coordinate descent rounds a shift by more than 0.02 pixel.
    IdentifiabilityWarning
        If the measurements leave parts of the sensor uncompared or hardly tell some pattern; if
        free fluxes leave a tilt of the sensitivity undetermined; if a fitted dark can hardly be
        told from the sensitivity.
    ConvergenceWarning
        If the tolerance was not reached.
    MisfitWarning
        If residuals are more than twice what the variances given say.
    ShiftSignWarning
        If the data contradict the sign of the shifts.

    Notes
    -----
    Minimises :math:`F = \sum_k \sum_p w_k(p) [y_k(p) - c_k L(u_k(p)) M(p)]^2` over the sensitivity
    M and the beam L, with weights w = 1/variance, fluxes c and the position u of pixel p in the
    beam [1]_. F does not change when M is multiplied and L divided by one number: the gauge is
    mean(M) = 1 over valid pixels. With fitted fluxes the mean of ln c is 0; then a tilt of ln M
    can be told only if exposures are turned against each other (or by `flux_std`, or by `time`):
    else its least-squares slope over valid pixels is set to 0, and a warning says so.

    With shifts between pixels L is a cubic B-spline on the padded grid, with a penalty of 1e-5 of a
    cell's mean weight on its fourth differences [2]_. Fluxes and shifts, like L, are found by
    Gauss-Newton steps in which M follows at its closed form.

    The sign of the shifts is asked of twelve exposures at most and of the central pixels: four
    times as many along each axis as the largest shift, or fewer where that is more than 80. Fitted
    with the shifts as given and with all of them reversed, fluxes free in both, the lower F must be
    lower by 6·√(2/dof) of itself, in two thirds of all places. It is undetermined without a
    question with fewer than three exposures or a thousand degrees of freedom, with
    ``dark="fit"``, where nothing moves, and where the middle of the sensor has no light.

    References
    ----------
    .. [1] S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light
       sensitivity of matrix photo receivers", Radiophysics and Quantum Electronics, 2011.
    .. [2] P. H. C. Eilers, B. D. Marx, "Flexible smoothing with B-splines and penalties",
       Statistical Science 11 (1996) 89-121.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> shape = (48, 64)
    >>> beam = equipix.simulate.gaussian_beam(shape)
    >>> truth = equipix.simulate.paper_sensitivity(shape, rng=1)
    >>> shifts = equipix.cross_pattern(5, 7)
    >>> cal = equipix.calibrate(equipix.simulate.exposures(truth, beam, shifts), shifts)
    >>> bool(np.abs(cal.sensitivity / (truth / truth.mean()) - 1).max() < 1e-6)
    True
    """
    started = datetime.now(UTC)
    if method not in get_args(Method):
        raise InputError(f"'method' is {method!r}, expected one of {get_args(Method)}")
    check_progress(progress)
    tolerance = as_tolerance(tolerance)
    statistics = as_statistics(frames)
    noise = fit_frames(statistics) if variance is None and statistics else None
    noisy = noisy_pixels(statistics, noise) if noise is not None else None
    with naming_memory("calibrating"):
        values = as_values(cast("ArrayLike", frames), statistics)
        count = len(values)
        models = as_models(variance if noise is None else noise, statistics, count)
        variances = None
        if variance is not None and not models:
            variances = as_variances(cast("ArrayLike", variance), values)
        saturated = as_saturated(saturation, values, statistics)
        given = None if mask is None else as_mask(mask, values.shape)
        masked = union(given, saturated, noisy)
    places = as_positions(shifts) if method == "multiscale" else round_shifts(shifts)
    check_count("shifts", len(places), count)
    turns = as_rotation(rotation, count)
    fluxes, flux_model = as_flux(flux, flux_std, time, count)
    warn_of_order(flux_model, places, turns)
    shift_error = None if shift_std is None else as_shift_std(shift_std, count)
    asked = Asked(
        method=method,
        flux=flux_model[0],
        shifts_refined=shift_error is not None,
        shifts_whole=bool((places == np.rint(places)).all()),
        moves=moves(places, turns, values.shape[1:]),
        dark=dark,
        one_level=flux_model[0] in ("known", "prior") and len(set(fluxes.tolist())) == 1,
        modelled=bool(models),
        robust=robust,
        uncertainty=uncertainty,
    )
    asked.check()

    def solve(
        variances: NDArray[Any] | None,
        masked: NDArray[np.bool_] | None,
        tolerance: float = tolerance,
    ) -> _native.Solution:
        return _native.calibrate_frames(
            values,
            places.astype(np.float64),
            shift_std=shift_error,
            rotation=turns.tolist(),
            flux=fluxes.tolist(),
            flux_model=flux_model,
            offset=dark == "fit",
            variance=variances,
            mask=masked,
            method=method,
            tolerance=tolerance,
            max_sweeps=None if max_sweeps is None else positive_count("max_sweeps", max_sweeps),
            workers=positive_workers(workers),
            progress=progress,
        )

    data = Problem(values, masked, places, turns, fluxes, solve)
    rejected = None
    with naming_memory("calibrating"):
        if models:
            variances = modelled(data, models, tolerance)
        if robust:
            result, rejected = solve_robustly(data, models, variances, tolerance)
        else:
            result = solve(variances, masked)
    freedom = result.degrees_of_freedom
    reduced_chi2 = result.misfit / freedom if freedom > 0 else float("nan")
    measurements = Measurements(
        values,
        np.rint(places).astype(np.int64),
        turns.tolist(),
        list(result.flux),
        variances,
        masked if rejected is None else ~data.usable() | rejected,
        None
        if result.coefficients is None
        else JointFit(
            measured=places.astype(np.float64),
            shift_std=shift_error,
            flux_model=flux_model,
            offset=dark == "fit",
            shifts=np.array(result.shifts),
            refined=result.refinement == "refined",
            leaves_tilt=result.leaves_tilt,
            coefficients=result.coefficients,
            unit=1.0 if variances is not None or np.isnan(reduced_chi2) else reduced_chi2,
        ),
    )
    sign: ShiftSign = "undetermined"
    if dark != "fit":
        sign = shift_sign(measurements, places, workers=workers, progress=progress)
    calibration = _wrapped(result, values.dtype, places, measurements, reduced_chi2, rejected, sign)
    options: dict[str, Any] = {
        "method": method,
        "tolerance": tolerance,
        "max_sweeps": max_sweeps,
        "dark": dark,
        "flux": flux_model[0],
        "weights": "equal" if variances is None else "variances",
    }
    if result.refinement:
        options["shifts"] = result.refinement
    calibration.metadata.update(
        versions={"equipix": _native.__version__, "numpy": np.__version__},
        options=options | {"rotation": turns.tolist(), "robust": robust},
        started=started.isoformat(timespec="seconds"),
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    if dark == "fit" and flux_model[0] != "known":
        calibration.metadata["dark"] = _dark_std(calibration, workers)
    _flag(calibration, data, variances)
    _flag_known(calibration, statistics, saturated, noisy)
    _warn(calibration, tolerance, result)
    if uncertainty:
        calibration = _with_std(calibration, workers, progress)
    return calibration


def _with_std(
    calibration: Calibration, workers: int | None, progress: Progress | None
) -> Calibration:
    measurements = calibration.measurements
    assert measurements is not None
    if measurements.joint and calibration.error_estimate > _NOT_FOUND:
        warnings.warn(
            f"no standard deviations: with an estimated error of {calibration.error_estimate:.1e} "
            "the sensitivity is not found",
            ConvergenceWarning,
            stacklevel=3,
        )
        return calibration
    sensitivity = calibration.sensitivity
    with naming_memory("the error map"):
        std, exactness = error_map(
            measurements,
            sensitivity,
            calibration.beam,
            calibration.reduced_chi2,
            workers=workers,
            progress=progress,
        )
    left = shift_std_left(
        measurements, sensitivity, calibration.beam, calibration.reduced_chi2, workers=workers
    )
    return replace(
        calibration,
        sensitivity_std=std.astype(sensitivity.dtype, copy=False),
        tilt_std=_tilt_std(calibration, workers),
        shift_std=left,
        metadata=calibration.metadata | {"uncertainty": exactness},
    )


def _tilt_std(calibration: Calibration, workers: int | None) -> NDArray[Any]:
    measurements = calibration.measurements
    if measurements is not None and measurements.joint and measurements.joint.leaves_tilt:
        return np.full(2, np.inf)
    weights = tilt_weights(calibration._valid)
    if not np.isfinite(weights).all():
        return np.full(2, np.nan)
    return np.asarray(calibration.std_of(weights, workers=workers))


def _dark_std(calibration: Calibration, workers: int | None) -> dict[str, float | None]:
    """How well a fitted dark is known; None where a fit did not converge or no noise is known."""
    measurements = calibration.measurements
    assert measurements is not None
    if measurements.variance is None and not np.isfinite(calibration.reduced_chi2):
        return {"std_along_sensitivity": None, "std_of_a_pixel": None}
    with naming_memory("the standard deviation of the dark"):
        along, alone = offset_std(
            measurements,
            calibration.sensitivity,
            calibration.beam,
            calibration.reduced_chi2,
            workers=workers,
        )
    return {
        "std_along_sensitivity": along if calibration.converged else None,
        "std_of_a_pixel": alone,
    }


def _flag_known(
    calibration: Calibration,
    statistics: list[FrameStatistics],
    saturated: NDArray[np.bool_] | None,
    noisy: NDArray[np.bool_] | None,
) -> None:
    """Set the flags of pixels that were odd before any fit."""
    flagged: list[tuple[NDArray[np.bool_], Flag]]
    flagged = [(each.saturated > 0, Flag.SATURATED) for each in statistics]
    if saturated is not None:
        flagged.append((np.any(saturated, axis=0), Flag.SATURATED))
    if noisy is not None:
        flagged.append((noisy, Flag.HOT | Flag.DO_NOT_USE))
    for pixels, flag in flagged:
        calibration.flags[pixels] |= np.uint32(flag)


def _flag(calibration: Calibration, data: Problem, variances: NDArray[Any] | None) -> None:
    """Set the flags of pixels whose answer is odd, and of those whose measurements disagree."""
    sensitivity, flags = calibration.sensitivity, calibration.flags
    places = positions(calibration.beam_origin, calibration.shifts, data.rotation, calibration.flux)

    def std(pixels: NDArray[Any]) -> NDArray[Any]:
        """Standard deviation of M, that of the beam left out: 1/√(Σ w c²L²)."""
        weight = np.zeros(len(pixels))
        used = data.usable()
        for k, place in enumerate(places):
            seen = np.nan_to_num(light(calibration.beam, place, calibration.shape)).flat[pixels]
            scale = calibration.reduced_chi2 if variances is None else variances[k]
            scale = np.broadcast_to(scale, calibration.shape).flat[pixels]
            weight += used[k].flat[pixels] * seen**2 / scale
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(weight)

    dead, hot = odd_responses(sensitivity, std)
    dead |= sensitivity <= calibration.metadata["options"]["tolerance"]
    flags[dead] |= np.uint32(Flag.DEAD | Flag.DO_NOT_USE)
    flags[hot] |= np.uint32(Flag.HOT | Flag.DO_NOT_USE)
    if calibration.rejected is not None:
        contradictory = 2 * calibration.rejected.sum(axis=0) > data.usable().sum(axis=0)
        flags[contradictory] |= np.uint32(Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE)
        calibration.metadata["rejected"] = calibration.rejected.sum(axis=(1, 2)).tolist()


def _wrapped(
    result: _native.Solution,
    dtype: np.dtype[Any],
    shifts: NDArray[Any],
    measurements: Measurements,
    reduced_chi2: float,
    rejected: NDArray[np.bool_] | None,
    sign: ShiftSign,
) -> Calibration:
    return Calibration(
        sensitivity=result.sensitivity.astype(dtype, copy=False),
        beam=result.beam,
        beam_origin=result.beam_origin,
        flags=result.flags,
        shifts=np.array(shifts if result.shifts is None else result.shifts, dtype=np.float64),
        flux=np.array(result.flux),
        objective=result.misfit,
        reduced_chi2=reduced_chi2,
        components=result.components,
        component_labels=result.component_labels,
        sweeps=int(result.sweeps[-1]),
        converged=result.ended == "converged",
        error_estimate=float(result.error_estimate[-1]),
        history=History(result.sweeps, result.objective, result.error_estimate),
        dark=None if result.offset is None else result.offset.astype(dtype, copy=False),
        measurements=measurements,
        rejected=rejected,
        shift_sign=sign,
    )


def _warn(calibration: Calibration, tolerance: float, result: _native.Solution) -> None:
    if calibration.components > 1:
        left = int(np.count_nonzero(calibration.component_labels > 0))
        warnings.warn(
            f"the measurements leave {calibration.components} parts of the sensor uncompared: "
            f"{left} pixels outside the largest part are NaN; choose other shifts",
            IdentifiabilityWarning,
            stacklevel=3,
        )
    if result.smallest_ritz is not None and result.smallest_ritz < UNTOLD:
        warnings.warn(
            f"the measurements hardly tell some pattern of the sensitivity (smallest Ritz value "
            f"{result.smallest_ritz:.1e}, below {UNTOLD:g}): choose other shifts",
            IdentifiabilityWarning,
            stacklevel=3,
        )
    if result.leaves_tilt:
        warnings.warn(
            "free fluxes leave a tilt of the sensitivity undetermined: its slope is set to 0; turn "
            "one exposure by 90 or 180 degrees, or give 'flux_std' from a monitor of the lamp",
            IdentifiabilityWarning,
            stacklevel=3,
        )
    limited = calibration.metadata["options"]["max_sweeps"] is not None
    used_up = result.ended == "sweeps used"
    dark = calibration.metadata.get("dark")
    if dark:
        along, alone = dark["std_along_sensitivity"], dark["std_of_a_pixel"]
        told = None
        if along is not None and along > alone:
            told = f"has the standard deviation {along:.1e}, where noise leaves a pixel {alone:.1e}"
        elif not calibration.converged and not (used_up and limited):
            told = "is not told at all"
        if told is not None:
            warnings.warn(
                "offset and gain can hardly be told apart: with fitted fluxes the dark may hold "
                f"any multiple b of the sensitivity, and b {told}; give the ratio of the levels as "
                "'flux', or take larger shifts in a beam that varies more",
                IdentifiabilityWarning,
                stacklevel=3,
            )
    measurements = calibration.measurements
    weighted = measurements is not None and measurements.variance is not None
    if weighted and calibration.converged and calibration.reduced_chi2 > _MISFIT:
        warnings.warn(
            f"residuals are {calibration.reduced_chi2**0.5:.1f} times what the variances say: are "
            "the shifts right, and their sign? does the lamp drift (flux='fit')? is there dust "
            "(robust=True)?",
            MisfitWarning,
            stacklevel=3,
        )
    if not calibration.converged:
        stuck = (
            "it falls no further: ask for a larger one, or mask pixels that light hardly reaches"
        )
        remedy = "allow more sweeps" if used_up else stuck
        warnings.warn(
            f"stopped after {calibration.sweeps} sweeps with an estimated error of "
            f"{calibration.error_estimate:.1e}, above the tolerance {tolerance:g}: {remedy}",
            ConvergenceWarning,
            stacklevel=3,
        )
