"""Running averages of several positions: what they determine, and which position helps most."""

import dataclasses
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import (
    Floats,
    as_array,
    as_level,
    as_mask,
    as_shifts,
    check_shape,
    naming_memory,
    positive_workers,
)
from equipix.calibration.calibrate import calibrated
from equipix.calibration.result import Calibration
from equipix.errors import EquipixWarning, InputError
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions, check_reach, whole_moves
from equipix.findings import Findings, usable
from equipix.fitting.weighted import Options
from equipix.measured.average import RunningAverage
from equipix.measured.colour import Colours
from equipix.measured.means import Averaged
from equipix.measured.measured import Measured, measured_of
from equipix.measured.statistics import FrameStatistics, subtracted
from equipix.plan.budget import between_pixels, error_budget
from equipix.plan.components import identify
from equipix.plan.drift import tilt_of_fluxes
from equipix.plan.search import next_position
from equipix.shown import Brief

_TOLERANCE, _MOST_SWEEPS = 1e-4, 60
"""Of a fit between two positions: far below the noise, and an end where few positions take long."""

_TRAVEL = 0.1
"""Share of the sensor within which a next position is sought, unless the travel is given or those
so far have gone farther: five positions so far apart are determined to the noise."""

_USUAL_NOISE = 1e-2
"""Noise with which positions are compared where it is not known: only its ratio to the drift
counts."""


@dataclass(frozen=True, eq=False)
class Estimate(Brief):
    """What the frames so far determine: the result of `Running.estimate`.

    Attributes
    ----------
    positions : ndarray, shape (n, 2), float64
        The positions (row, col) so far, in pixels.
    frames : tuple of int
        Number of frames at each.
    components : int
        Parts of the sensor that the positions do not compare.
    determined : float
        Share of the pixels whose sensitivity is determined up to one common factor.
    rms : float
        Expected root mean square of the relative error of M by noise, by the noise and rounding of
        the dark and, where the positions show it, by the drift of the lamp. Infinite with more than
        one part; NaN where the noise is not known, as of one frame at each of too few positions, or
        where its effect is not, as with positions that, rounded to whole pixels, compare too few
        (see `equipix.plan.error_budget`).
    rms_by_cause : dict of str to float
        The same for ``"noise"``, ``"dark"`` and ``"drift"`` alone. The noise is NaN where `rms` is.
        The dark is 0 where there is none, and NaN where no pixel is known. The drift is NaN where
        the noise is not known, fewer than four positions are, or the fit is too far from its
        minimum, so that no residual shows it. With more than one part noise and dark are infinite,
        the drift is NaN.
    tilt : tuple of float
        Standard deviation of the tilt of ln M, edge to edge (row, col), that noise and drift leave.
        NaN where the noise is not known.
    calibration : Calibration or None
        The result so far; None with more than one part.
    """

    positions: Floats
    frames: tuple[int, ...]
    components: int
    determined: float
    rms: float
    rms_by_cause: dict[str, float]
    tilt: tuple[float, float]
    calibration: Calibration | None = None

    @property
    def findings(self) -> Findings:
        """What limits the calibration so far; none without one."""
        return () if self.calibration is None else self.calibration.findings

    def meets(self, accuracy: float) -> bool:
        """Whether no parts are left, the drift is known, and the expected error is small enough.

        At least half of the pixels that are not masked are determined then; `determined` says how
        many.

        Parameters
        ----------
        accuracy : float
            The largest `rms` that is wanted.

        Returns
        -------
        bool
            False too where the solver has not reached a tenth of `accuracy`.
        """
        calibration = self.calibration
        if calibration is None or calibration.is_partial or math.isnan(self.rms_by_cause["drift"]):
            return False
        return self.rms <= accuracy and calibration.error_estimate <= accuracy / 10


@dataclass(frozen=True, eq=False)
class Needed(Brief):
    """The position that helps most: the result of `Running.needed`.

    Attributes
    ----------
    position : tuple of float
        Where to move (row, col), in pixels.
    components : int
        Parts of the sensor that all positions will not compare, this one among them.
    rms : float
        Expected error of M with as many frames there as at the others on average; infinite with
        more than one part, NaN where the noise or its effect is not known.
    """

    position: tuple[float, float]
    components: int
    rms: float


class Running:
    """Averages of frames at several positions, kept while a script moves the sensor.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    saturation : float, optional
        Samples at or above this level are counted as saturated, in DN; as for `equipix.average`.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`.
    workers : int, optional
        Number of threads; by default one for each processor.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value.

    See Also
    --------
    equipix.calibrate : The calibration of all positions, once they are there.

    Notes
    -----
    Memory does not grow with the number of frames. Each position has 20 bytes a pixel of sums, of
    floating-point numbers 36, and as much again after an estimate.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> shape, shifts = (48, 64), equipix.cross_pattern(5, 7)
    >>> beam = equipix.simulate.gaussian_beam(shape)
    >>> truth = equipix.simulate.paper_sensitivity(shape, rng=1)
    >>> light = 2e4 * equipix.simulate.exposures(truth, beam, shifts)
    >>> rng = np.random.default_rng(2)
    >>> running = equipix.Running(shape)
    >>> for shift, each in zip(shifts, light):
    ...     for _ in range(2):
    ...         running.add(rng.poisson(each).astype(np.uint16), shift)
    >>> estimate = running.estimate()
    >>> estimate.components, estimate.determined
    (1, 1.0)
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        saturation: float | None = None,
        mask: ArrayLike | None = None,
        cfa: ArrayLike | None = None,
        workers: int | None = None,
    ) -> None:
        self._shape = check_shape(shape)
        self._level, self._mask = as_level(saturation), as_mask(mask, self._shape)
        self._colours, self._workers = Colours.of(cfa), positive_workers(workers)
        self._sums: dict[tuple[float, float] | None, RunningAverage] = {}
        self._dtype: np.dtype[Any] | None = None
        self._averaged: Averaged | None = None
        self._reduced: list[int] = []  # frames of the dark and of each position in `_averaged`
        self._dark: FrameStatistics | None = None
        self._estimate: Estimate | None = None
        self._measured: Measured | None = None

    def __repr__(self) -> str:
        """Short form: sizes, positions, frames."""
        rows, cols = self._shape
        count = sum(self._sums[each].count for each in self._places)
        return f"<Running: {rows} x {cols} pixels, {len(self._places)} positions, {count} frames>"

    @property
    def positions(self) -> Floats:
        """The positions so far, shape (n, 2), in pixels."""
        return np.array(self._places, dtype=np.float64).reshape(-1, 2)

    @property
    def has_dark(self) -> bool:
        """Whether there is a frame without light."""
        return None in self._sums

    @property
    def _places(self) -> list[tuple[float, float]]:
        return [each for each in self._sums if each is not None]

    def add(self, frame: ArrayLike, position: ArrayLike | None) -> None:
        """Add a frame, or several of one position.

        Parameters
        ----------
        frame : array_like, shape (rows, cols) or (n, rows, cols)
            What the camera gave, in DN; all frames of one dtype.
        position : array_like, shape (2,), or None
            Shift (row, col) of the sensor in pixels, as for `equipix.calibrate`; None of a frame
            without light. The dark is the mean of these, and may be added before, between or after.

        Raises
        ------
        InputError
            If shape or dtype are not those of the others, no number is finite, or `position` is
            not two finite numbers, each smaller than the sensor along its axis. Nothing is added
            then.
        """
        frames = as_array("frame", frame, ndim=(2, 3))
        frames = frames[None] if frames.ndim == 2 else frames
        if frames.shape[1:] != self._shape or not len(frames):
            raise InputError(f"'frame' has shape {np.shape(frame)}, expected {self._shape}")
        if frames.dtype.kind == "f" and not np.isfinite(frames).any():
            raise InputError("'frame' holds no finite number: give frames with numbers")
        if self._dtype not in (None, frames.dtype):
            raise InputError(
                f"'frame' has dtype {frames.dtype}, expected {self._dtype} like the first"
            )
        place = None if position is None else place_of(position)
        if place is not None:
            check_reach("'position'", np.array(place), self._shape)
        with naming_memory("averaging"):
            sums = self._sums.get(place)
            if sums is None:
                sums = RunningAverage(frames, self._level, None, self._workers)
            sums.add(frames)
        self._sums[place], self._dtype = sums, frames.dtype
        self._estimate = None

    def estimate(self) -> Estimate:
        """Calibrate by the frames so far, and predict the error.

        Returns
        -------
        Estimate
            What is determined, the expected error with its tilt, and the calibration. Findings are
            those of the calibration; none is a warning here, since more frames may come.

        Raises
        ------
        InputError
            If there are fewer than two positions, or the frames make no calibration.

        Notes
        -----
        The calibration is that of `equipix.calibrate`, with a tolerance of 1e-4 and at most 60
        passes in each fit: its ``error_estimate`` says how far it is from the minimum. The expected
        error is that of `equipix.plan.error_budget`, with the noise and the drift that the frames
        show. The error of the dark, common to all exposures, adds the variance v Σw / Σ(w S²) of a
        pixel with signals S of weights w. The tilt is that of fluxes known to the noise of a whole
        frame, and of the drift.
        """
        if self._estimate is None:
            if len(self._places) < 2:
                raise InputError(
                    f"there are frames at {len(self._places)} positions, expected two or more: "
                    "add frames at another position"
                )
            with warnings.catch_warnings(), naming_memory("calibrating"):
                warnings.simplefilter("ignore", EquipixWarning)
                self._estimate = self._estimated()
        return self._estimate

    def needed(self, max_shift: ArrayLike | None = None) -> Needed:
        """Find the position that would help most.

        Parameters
        ----------
        max_shift : int or array_like of two, optional
            Travel of the stage from the smallest position so far, in pixels, along both axes or
            (row, col): the position lies within. Unless given a tenth of the sensor, or as far as
            the positions so far.

        Returns
        -------
        Needed
            The position, and what it will give.

        Raises
        ------
        InputError
            If there is no frame with light, or no other position within the travel.
        """
        if not self._places:
            raise InputError("there are no frames with light: add frames at a first position")
        positions = self.positions
        usual = np.maximum(np.ceil(_TRAVEL * np.array(self._shape)), np.ptp(positions, axis=0))
        travel = usual if max_shift is None else max_shift
        with warnings.catch_warnings(), naming_memory("planning"):
            warnings.simplefilter("ignore", EquipixWarning)
            found = self.estimate().calibration if len(positions) > 1 else None
            noise, dark, drift = self._causes(found)
            used = noise if noise > 0 else _USUAL_NOISE
            causes = {
                "noise": used,
                "drift": math.hypot(drift, used / math.prod(self._shape) ** 0.5),
            }
            best = next_position(self._shape, positions, travel, cfa=self._colours, **causes)
            budget = error_budget(
                self._shape, np.vstack([positions, best]), noise=used, drift=drift
            )
        known = math.hypot(budget.rms, dark) if noise > 0 else math.nan
        rms = math.inf if budget.components > 1 else known
        row, col = best.tolist()
        return Needed((row, col), budget.components, rms)

    def _estimated(self) -> Estimate:
        positions = self.positions
        self._measured = measured = measured_of(self._reduce())
        exposures = Exposures.of(
            measured,
            Positions.of(positions, shape=measured.values.shape),
            Flux.of(None, None, None, len(positions)),
            mask=self._mask,
        )
        found = None
        if not between_pixels(positions):
            found = identify(self._shape, whole_moves(positions), self._mask)
        known = Estimate(
            positions=positions,
            frames=tuple(self._sums[each].count for each in self._places),
            components=1 if found is None else found.components,
            determined=1.0 if found is None else found.largest / math.prod(self._shape),
            rms=math.inf,
            rms_by_cause={"noise": math.inf, "dark": math.inf, "drift": math.nan},
            tilt=(math.inf, math.inf),
        )
        if known.components > 1:
            return known
        fit = FitOptions.of("multiscale", _TOLERANCE, _MOST_SWEEPS, self._workers, None)
        calibration = calibrated(exposures, Options(fit))
        known = dataclasses.replace(
            known,
            calibration=calibration,
            determined=float(np.mean(usable(calibration.flags))),
        )
        noise, dark, drift = self._causes(calibration)
        if not noise > 0:
            causes = {"noise": math.nan, "dark": dark, "drift": math.nan}
            unknown = (math.nan, math.nan)
            return dataclasses.replace(known, rms=math.nan, rms_by_cause=causes, tilt=unknown)
        budget = error_budget(self._shape, positions, noise=noise, drift=drift)
        flux_std = math.hypot(drift, noise / math.sqrt(known.determined * math.prod(self._shape)))
        row, col = tilt_of_fluxes(self._shape, positions, flux_std).tolist()
        shown = math.nan if calibration.drift is None else budget.rms_by_cause["drift"]
        return dataclasses.replace(
            known,
            rms=math.hypot(budget.rms, dark),
            rms_by_cause={"noise": budget.rms_by_cause["noise"], "dark": dark, "drift": shown},
            tilt=(row, col),
        )

    def _reduce(self) -> Averaged:
        """Averages of all positions; those whose frames have not changed are kept."""
        places = self._places
        dark = self._sums.get(None)
        counts = [0 if dark is None else dark.count] + [self._sums[each].count for each in places]
        if self._averaged is not None and counts == self._reduced:
            return self._averaged
        if counts[: len(self._reduced)] != self._reduced or self._averaged is None:
            self._dark = None if dark is None else dark.statistics()
            # The level given, for messages; else each average has that of its dtype.
            averaged = Averaged(
                count=len(places),
                dtype=np.float32,
                saturation=self._level,
                colours=self._colours,
            )
        else:
            averaged = self._averaged.with_room(len(places))
        for each in places[len(averaged.frames) :]:
            averaged.add(subtracted(self._sums[each].statistics(), self._dark))
        self._averaged, self._reduced = averaged, counts
        return averaged

    def _causes(self, calibration: Calibration | None) -> tuple[float, float, float]:
        """Noise of an exposure over its signal, NaN if unknown; error of M by the dark; drift.

        Each pixel counts with the weight of its exposures: its noise is that of equal exposures
        which determine it as well. Of these the root mean square is taken. A pixel of fewer
        exposures is compared with fewer others, too: that is not counted.
        """
        shown = None if calibration is None else calibration.drift
        drift = 0.0 if shown is None else shown.size
        if calibration is not None and calibration.weighted is not None:
            measured: Measured = calibration.weighted.exposures
            alone = calibration.weighted.noise_variance
        else:
            measured, alone = self._measured or measured_of(self._reduce()), math.nan
        weights, information = np.zeros(self._shape), np.zeros(self._shape)
        for k, signal in enumerate(measured.values):
            variance = measured.variance_of(k, signal)
            variance = np.asarray(alone if variance is None else variance)
            # Equal frames have no noise: what they tell of it is unknown, not endless.
            seen = measured.usable(k) & (signal > 0) & (variance != 0)
            weight = np.divide(1, variance, where=seen, out=np.zeros(self._shape))
            weights += weight
            information += np.multiply(weight, signal**2, where=seen, out=np.zeros(self._shape))
        of_dark = measured.dark_variance
        known = np.isfinite(information) & (information > 0)
        if calibration is not None:
            known &= usable(calibration.flags)
        if not known.any():
            return math.nan, 0.0 if of_dark is None else math.nan, drift
        noise = float(np.sqrt(len(measured) * np.mean(1 / information[known])))
        dark = 0.0
        if of_dark is not None:
            added = of_dark[known] * weights[known] / information[known]
            dark = float(np.sqrt(np.mean(added)))
        return noise if noise > 0 else math.nan, dark, drift


def place_of(position: ArrayLike) -> tuple[float, float]:
    """Check one position."""
    row, col = as_shifts(np.reshape(as_array("position", position, ndim=1), (1, -1)))[0].tolist()
    return row + 0.0, col + 0.0  # no negative zeros
