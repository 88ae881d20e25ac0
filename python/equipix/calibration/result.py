"""The result of a calibration."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from equipix._check import (
    Array,
    Bools,
    Floats,
    Progress,
    ShiftSign,
    as_array,
    check_count,
    check_progress,
    per_exposure,
)
from equipix._native import Beam
from equipix.correction.apply import CorrectionBase
from equipix.diagnosis.evidence import Evidence
from equipix.diagnosis.gauges import gauge_of, scaled
from equipix.diagnosis.lamp_drift import Drift
from equipix.diagnosis.orientation import OrientationTest
from equipix.errors import EquipixError, InputError
from equipix.exposures.positions import ROUNDING, Positions, as_rotation
from equipix.findings import Findings, determined
from equipix.fitting.error_bars import functional_std
from equipix.fitting.weighted import Weighted, check_unchanged
from equipix.io.record import UNSAVED, Counts, Map, Record
from equipix.io.viewed import Viewed
from equipix.measured.colour import Colours
from equipix.measured.measured import measured_of
from equipix.measured.noise import NoiseModel
from equipix.measured.statistics import FrameStatistics
from equipix.metrics.maps import slope_pixels, tilt

Grid = Annotated[Floats, "float64", "beam_rows beam_cols"]

Places = Annotated[Floats, "float64", "exposures 2"]

Pair = Annotated[Floats, "float64", "2"]


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(CorrectionBase, Record, kind="calibration", version=4):
    """Calibrated sensor, the result of `calibrate`; its arrays are read-only.

    Attributes
    ----------
    sensitivity : ndarray, shape (rows, cols)
        Relative sensitivity M of mean 1 over valid pixels, with a `cfa` over those of each colour;
        NaN where undetermined. float32 for float32 frames, else float64.
    beam : ndarray, shape of the padded grid, float64
        The beam L in the units of the frames; NaN where unobserved.
    beam_origin : tuple of int or float
        ``beam[beam_origin + p]`` is the beam at pixel p of a sensor with shift 0, and
        ``beam[beam_origin + shift + p]`` at another shift. Whole numbers, but where all shifts have
        the same fraction of a pixel: then shift 0 is between cells, ``beam_origin`` a float, and
        ``beam_origin + shift`` whole, but for rounding, in each exposure.
    beam_coefficients : ndarray, shape of the padded grid, float64, or None
        Coefficients of the cubic B-spline that the beam is where shifts differ by parts of pixels;
        None where it is known at the cells alone: between the cells of such a beam polynomials of
        degree 5 interpolate.
    beam_tilt : ndarray, shape (2,), float64
        Slope β of ln L (row, col) per cell that the gauge put into the coefficients a:
        L(u) = Σ_j a_j exp(β·(u − j)) B(u − j).
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`; 0 for a good pixel. One whose sensitivity is below half of its
        neighbours', or not above 0, is ``DEAD | DO_NOT_USE``, above twice theirs ``HOT |
        DO_NOT_USE``; their sensitivity is the median of a block of 16×16 pixels. An undetermined
        pixel is ``NO_FLAT_FIELD | DO_NOT_USE``, one most of whose measurements a robust
        calibration left out ``UNRELIABLE_FLAT | DO_NOT_USE``.
    shifts : ndarray, shape (n, 2), float64
        The shifts (row, col) that were used, in pixels.
    rotation : ndarray, shape (n,), int64
        How far the sensor was turned in each exposure, in degrees.
    flux : ndarray, shape (n,), float64
        The relative flux of each exposure.
    objective : float
        Objective F at the end.
    reduced_chi2 : float
        F over its expectation, the degrees of freedom and what the noise of the dark adds: 1 on
        average where the variances given are right. Where none were given, the variance of one
        value. NaN without any degree of freedom.
    components : int
        Number of connected components: parts of the sensor that the measurements do not compare.
        A pixel that does not respond connects no parts; nor does one whose measurements have
        almost no weight. Where shifts differ by parts of pixels, neighbours see cells in common,
        so that 1 does not prove that the positions determine the sensitivity: see `is_partial`.
    component_labels : ndarray, shape (rows, cols), int32
        The component of each pixel, the largest being 0; −1 for a pixel without measurement.
    sweeps : int
        Sweeps of coordinate descent; in the multiscale method passes over the data or its weights,
        each of about the cost of a sweep.
    converged : bool
        Whether `error_estimate` is within the tolerance.
    error_estimate : float
        Estimate (not a bound) of the largest remaining solver error of `sensitivity` at any
        spatial scale; noise is not included.
    history : dict of str to ndarray, shape (looks,)
        State after some of the sweeps: ``sweep``, the number of sweeps that had been made (uint64);
        ``objective``, F with penalty and priors where a fit has them, which never rises but for
        rounding, and while such a fit still finds their weights; ``error_estimate``, the estimated
        largest relative error of the sensitivity. In coordinate descent F is that after a sweep;
        `objective` is smaller by the one update of the beam that follows the last.
    dark : ndarray, shape (rows, cols), or None
        The dark frame in DN, if it is part of the calibration.
    dark_is_fitted : bool
        Whether `dark` was fitted, and so is part of the exposures.
    metadata : dict
        Versions, options and origin, as JSON values (``options["weights"]``: "equal" where no
        variance was known, else "variances"); under ``uncertainty`` the draws that
        `sensitivity_std` was made of, and its relative standard error; under ``dark``, where it
        was fitted together with fluxes, the standard deviation of b in its possible error b·M,
        and that of a pixel by the noise of its own values.
    sensitivity_std : ndarray, shape (rows, cols), or None
        Standard deviation of `sensitivity` by noise and by the priors on fluxes and shifts, large
        scales included, in the gauge of mean 1, and of slope 0 where free fluxes leave a tilt
        undetermined; NaN where undetermined. In `sensitivity`'s dtype; None without
        ``uncertainty=True``, or where a joint fit ended too far from its minimum.
    tilt_std : ndarray, shape (2,), or None
        Standard deviation of `tilt`; infinite where free fluxes leave it undetermined. None without
        ``uncertainty=True``.
    shift_std : ndarray, shape (n, 2), or None
        Posterior standard deviation of refined shifts, less their mean, which no measurement
        determines; the prior one of the others, in pixels. None without ``uncertainty=True``.
    weighted : Weighted or None
        The exposures with their weights and the fit, for `std_of`; None if read from a file or
        unpickled.
    findings : tuple of Finding
        What limits the result: `calibrate` has warned of each.
    residual_map : ndarray, shape (rows of cells, columns of cells), float32, or None
        Rms of the residuals over all exposures, in standard deviations of a value, or in DN where
        no variance was known; NaN where none was used. Cells are square, the fewest pixels that
        make at most about 260 000 residuals, which one of their rows represents.
    rejected : ndarray of bool, shape (n, rows, cols), or None
        The measurements that a robust calibration left out; `metadata` counts them.
    shift_sign : {"confirmed", "contradicted", "undetermined"}
        Whether the data confirm the signs and the order of the shifts' axes, contradict them, or do
        neither, as those of a Gaussian beam, whatever its width; see `calibrate`.
    orientation : OrientationTest or None
        The same for each axis, with the best orientation and, in ``words``, what to do.
    drift : Drift or None
        What the data say of fluxes that were given: the size of the lamp's drift about them, its
        standard error, the degrees of freedom, exposures of which one alone would explain it, and
        the tilt that it hides, which is part of
        `sensitivity_std`, `tilt_std` and `std_of`. Errors of the tilt over `tilt_std` are at most
        as far out as Student's t with so many degrees of freedom. None where fluxes were fitted or
        have a prior, and where no combination of them leaves a residual.
    cfa : Colours or None
        Colour filters of the pixels, where they were given.
    colour_response : dict of str to float, or None
        Response of each colour to the light of the beam, of mean 1 over the pixels in use: M times
        it is what pixels give for one light. NaN for a colour that is undetermined.
    """

    sensitivity: Map
    beam: Grid
    beam_origin: tuple[float, float]
    beam_coefficients: Grid | None
    beam_tilt: Pair
    flags: Counts
    shifts: Places
    rotation: Annotated[NDArray[np.int64], "int64", "exposures"]
    flux: Annotated[Floats, "float64", "exposures"]
    objective: float
    reduced_chi2: float
    components: int
    component_labels: Annotated[Array, "int32", "rows cols"]
    sweeps: int
    converged: bool
    error_estimate: float
    history: dict[str, Annotated[Array, "uint64|float64", "looks"]]
    dark: Map | None = None
    dark_is_fitted: bool = False
    metadata: dict[str, Any] = field(default_factory=dict)
    sensitivity_std: Map | None = None
    tilt_std: Pair | None = None
    shift_std: Places | None = None
    weighted: Weighted | None = field(default=None, metadata=UNSAVED)
    residual_map: Annotated[Array, "float32", "cell_rows cell_cols"] | None = None
    rejected: Annotated[Bools, "bool", "exposures rows cols"] | None = None
    shift_sign: ShiftSign = "undetermined"
    orientation: OrientationTest | None = None
    drift: Drift | None = None
    findings: Findings = ()
    cfa: Colours | None = None
    colour_response: dict[str, float] | None = None
    takes_dark: ClassVar[bool] = True
    limits: ClassVar[None] = None
    saturation: ClassVar[None] = None
    leaves_offset: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Refuse places that cannot be those of a calibration, and filters that are none."""
        super().__post_init__()
        grid, origin = self.beam.shape, np.array(self.beam_origin)
        as_rotation(self.rotation, len(self.shifts))
        # A cell reaches half of its side around its place.
        if not np.all((origin >= -0.5) & (origin <= np.subtract(grid, 0.5))):
            raise InputError(f"'beam_origin' is {self.beam_origin}, expected a place on {grid}")
        if not (_are_whole(origin) or _are_whole(origin + self.shifts)):
            raise InputError(f"'beam_origin' is {self.beam_origin}, expected exposures in cells")
        Colours.of(self.cfa)

    @classmethod
    def of(cls, evidence: Evidence, findings: Findings, metadata: dict[str, Any]) -> Self:
        """Make the result from a fit and what was derived from it."""
        exposures, fit, bars = evidence.exposures, evidence.fit, evidence.bars
        dtype, flags, orientation = exposures.values.dtype, evidence.flags, evidence.orientation
        weighted = evidence.weighted
        gauge = gauge_of(weighted, flags)
        std, offset = None if bars is None else bars.sensitivity, fit.offset
        coefficients = fit.beam.coefficients
        row, col = (int(each) if each.is_integer() else each for each in fit.beam.origin)
        return cls(
            sensitivity=scaled(fit.sensitivity, gauge.of_sensitivity, dtype),
            beam=scaled(fit.beam.values, gauge.of_beam),
            beam_origin=(row, col),
            beam_coefficients=None if coefficients is None else scaled(coefficients, gauge.of_beam),
            beam_tilt=np.array(fit.beam.tilt),
            flags=flags,
            shifts=np.array(fit.shifts, dtype=np.float64),
            rotation=exposures.positions.rotation,
            flux=np.array(fit.flux),
            objective=fit.misfit,
            reduced_chi2=weighted.reduced_chi2,
            components=fit.components,
            component_labels=fit.component_labels,
            sweeps=int(fit.sweeps[-1]),
            converged=fit.ended == "converged",
            error_estimate=float(fit.error_estimate[-1]),
            history={
                "sweep": fit.sweeps,
                "objective": fit.objective,
                "error_estimate": fit.error_estimate,
            },
            dark=exposures.dark if offset is None else scaled(offset, exposures.response, dtype),
            dark_is_fitted=exposures.offset,
            metadata=metadata,
            sensitivity_std=None if std is None else scaled(std, gauge.of_sensitivity, dtype),
            tilt_std=None if bars is None else bars.tilt,
            shift_std=None if bars is None else bars.shifts,
            weighted=weighted,
            residual_map=evidence.residual_map,
            rejected=weighted.rejected,
            shift_sign=orientation.sign,
            orientation=orientation,
            drift=evidence.drift,
            findings=findings,
            cfa=exposures.cfa,
            colour_response=gauge.response,
        )

    @property
    def needs_dark(self) -> bool:
        """Whether frames are corrected less a dark, and none is stored."""
        return self.dark is None

    @property
    def colours(self) -> Colours | None:
        """Colour filters of the pixels, also where the sensor in `metadata` alone has them."""
        return self.cfa or super().colours

    @property
    def is_partial(self) -> bool:
        """Whether less than half of the pixels that are not masked are determined.

        The finding of kind ``"partial"`` contains the cause.
        """
        return any(finding.kind == "partial" for finding in self.findings)

    def __repr__(self) -> str:
        """Short form: sizes and how far the solver came."""
        state = "converged" if self.converged else "not converged"
        std = self.sensitivity_std
        noise = "" if std is None else f", standard deviation {np.nanmedian(std):.1e}"
        return (
            f"<Calibration of {self.shape[0]} x {self.shape[1]} pixels from {len(self.shifts)} "
            f"exposures: {state}, error estimate {self.error_estimate:.1e}{noise}>"
        )

    def viewed(self) -> Viewed:
        """Return the sensitivity with its standard deviation, as other programs show them."""
        return Viewed.of("flat", self.sensitivity, self.flags, self.sensitivity_std)

    @property
    def tilt(self) -> NDArray[Any]:
        """Least-squares slope of ln M, edge to edge (row, col); NaN where it is undetermined.

        Pixels count whose M is determined, from half to twice the mean of such, and not flagged
        ``UNRELIABLE_FLAT``. Where free fluxes leave the tilt undetermined it is 0.
        """
        return tilt(self.sensitivity, slope_pixels(self.sensitivity, self.flags))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the compiled fit, which cannot be pickled."""
        return vars(self) | {"weighted": None}

    def __copy__(self) -> Self:
        """Return a copy that keeps the fit."""
        return dataclasses.replace(self)

    def std_of(
        self, weights: ArrayLike, *, workers: int | None = None, progress: Progress | None = None
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
            One for each image of weights, in the gauge of the fit, mean(M) = 1 over all determined
            pixels; where free fluxes leave a tilt undetermined, in that of slope 0, although a sum
            that depends on the tilt is as uncertain as `tilt_std`.

        Raises
        ------
        InputError
            If this calibration was read from a file, which holds no measurements; if the weights
            do not fit; if no variance was given and the residuals do not determine it; or if an
            array that was calibrated has changed.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Notes
        -----
        Errors of pixels are correlated: the variance of a mean over many cannot be had from
        `sensitivity_std`. With w the weights and g = w/M it is gᵀ S⁻¹ g, S being the reduced normal
        matrix: one linear problem, about as much work as the calibration. It reads the arrays that
        were calibrated again, which must not have changed: 4096 values of each are compared, so a
        change of few values is not noticed.

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
        if self.weighted is None:
            raise InputError(
                "this calibration was read from a file or unpickled, which does not keep the "
                "measurements: call std_of on the result of calibrate or Experiment.run"
            )
        check_progress(progress)
        check_unchanged(self.weighted.exposures, self.weighted.sampled)
        stack = checked_weights(weights, determined(self.sensitivity, self.flags))
        std = functional_std(self.weighted, stack, workers=workers, progress=progress)
        if self.drift is not None and self.drift.is_added:
            std = np.hypot(
                std, np.sqrt(self.drift.variance_of(stack, self.weighted.fit.sensitivity))
            )
        return float(std[0]) if np.ndim(weights) == 2 else std

    @property
    def coefficients(self) -> NDArray[Any]:
        """Coefficients of the corrected frame Σ c_j y^j, shape (2, rows, cols).

        c_0 = −dark/M and c_1 = 1/M, in the dtype of `sensitivity`; NaN where M is undetermined.
        Without a dark frame in the calibration c_0 is 0, for frames whose dark is subtracted.
        """
        return self._planes(self.sensitivity.dtype)

    def _planes(self, dtype: DTypeLike) -> NDArray[Any]:
        """The coefficients, found in double precision and rounded once."""
        planes = np.zeros((2, *self.shape), dtype)
        with np.errstate(divide="ignore", invalid="ignore"):  # a dead pixel may have M = 0
            inverse = np.divide(1, self.sensitivity, dtype=np.float64)
            if self.dark is not None:
                planes[0] = -self.dark * inverse
        planes[0, np.isnan(inverse)] = np.nan
        planes[1] = inverse
        return planes

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
            If an argument has a wrong shape or value, or no pixel stands in a part of the beam that
            an exposure has observed.

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
        (signal,) = self._signals(np.reshape(shift, (1, 2)), [rotation], [flux], 1)
        if not np.isfinite(signal).any():
            raise InputError(
                f"'shift' is {np.asarray(shift).tolist()}: no exposure has observed the beam where "
                "a pixel with a sensitivity stands then. Ask for a position between those of the "
                "exposures"
            )
        return signal

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
            Of the exposures, as for `calibrate`; by default those of the calibration.

        Returns
        -------
        ndarray, shape (n, rows, cols)
            Residuals in the units of the frames; where variances are known, in standard
            deviations of a measurement. NaN where nothing is measured or predicted. Measurements
            that the fit left out, along ragged edges of masks, may have residuals beyond their
            noise.

        Raises
        ------
        InputError
            If an argument has a wrong shape or value.

        Notes
        -----
        M and L fit some of the noise of the exposures that the calibration was made from. Where the
        fit used all of their measurements, the mean square of the residuals in standard deviations
        is `reduced_chi2` times the degrees of freedom over the number of measurements. It is not
        that where measurements were left out, along ragged edges of masks or as outliers, or where
        pixels with one or two measurements left the search. For an exposure held out it is above
        1, by the variance of the prediction.
        """
        measured = measured_of(frames, variance)
        values = measured.values
        if values.shape[1:] != self.shape:
            raise InputError(f"'frames' has shape {values.shape}, the sensor {self.shape}")
        if shifts is None:
            check_count("frames", len(values), len(self.shifts))
        signals = self._signals(
            self.shifts if shifts is None else shifts,
            self.rotation if shifts is None and rotation is None else rotation,
            self.flux if shifts is None and flux is None else flux,
            len(values),
        )
        residuals = np.full(values.shape, np.nan, np.result_type(values, self.sensitivity))
        for k, signal in enumerate(signals):
            np.subtract(values[k], signal, out=residuals[k], where=np.isfinite(values[k]))
            if self.dark_is_fitted:
                residuals[k] -= self.dark
            variance = measured.variance_of(k, signal)
            if variance is not None:
                with np.errstate(divide="ignore", invalid="ignore"):
                    residuals[k] /= np.sqrt(variance)
        return residuals

    def _signals(
        self, shifts: ArrayLike, rotation: ArrayLike | None, flux: ArrayLike | None, count: int
    ) -> Iterator[Array]:
        """Frames c · L(u) · M(p) of so many exposures, in the dtype of the sensitivity."""
        positions = Positions.of(shifts, rotation=rotation)
        fluxes = per_exposure("flux", flux, len(positions), default=1)
        check_count("shifts", len(positions), count)
        response, tilt = self._response, self.beam_tilt.tolist()
        beam = Beam(self.beam, self.beam_coefficients, self.beam_origin, tilt=tilt)
        places = positions.shifts.tolist(), positions.rotation.tolist(), fluxes.tolist()
        for (row, col), turn, c in zip(*places, strict=True):
            light = beam.light(self.shape, (row, col), turn, workers=None)
            yield np.asarray(c * light * response, response.dtype)

    @property
    def _response(self) -> NDArray[Any]:
        """What the pixels give for one light: M, times the response of the colour."""
        if self.cfa is None or self.colour_response is None:
            return self.sensitivity
        response = self.cfa.map_of(self.colour_response, self.shape)
        return np.asarray(self.sensitivity * response, self.sensitivity.dtype)


def _are_whole(places: NDArray[Any]) -> bool:
    """Whether places are whole numbers, but for rounding."""
    return bool(np.all(np.abs(places - np.rint(places)) < ROUNDING))


def checked_weights(weights: ArrayLike, determined: Bools) -> Floats:
    """Weights of functionals as (m, rows, cols), which must be 0 where ln M is undetermined."""
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


def refuse_partial(calibration: Calibration, output: Path) -> None:
    """Refuse a result that determines less than half of the unmasked pixels, or none."""
    for finding in calibration.findings:
        if finding.kind == "partial":
            raise EquipixError(
                f"'{output}' is not written (partial=True writes it): {finding.message}"
            )
