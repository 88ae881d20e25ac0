"""A calibration experiment on disk, as experiment.toml describes it, and its evaluation."""

from __future__ import annotations

import hashlib
import os
import warnings
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from equipix._check import as_tolerance, naming_memory, positive_count, positive_workers
from equipix._types import Progress
from equipix.calibration.calibrate import calibrate
from equipix.defects import dead_pixels, hot_pixels
from equipix.errors import FileError, InputError
from equipix.experiment.manifest import find_files, read_manifest
from equipix.exposures.positions import in_beam, variance_in_beam
from equipix.flags import Flag, set_bits
from equipix.frames import average
from equipix.io import as_path, frame_format, read_frames
from equipix.noise import NoiseModel, photon_transfer
from equipix.shifts import measure_shift, round_shifts

if TYPE_CHECKING:
    from os import PathLike
    from pathlib import Path

    from numpy.typing import NDArray

    from equipix._types import FluxModel, Method
    from equipix.calibration.result import Calibration
    from equipix.experiment.manifest import Exposure, Manifest
    from equipix.frames import FrameStatistics
    from equipix.shifts import ShiftMeasurement, Spot


_AROUND = 8
"""Pixels to each side of a spot's middle that stand for those under it."""

_ROUGH = 1e-4
"""Tolerance of the calibration that the aperture's images are corrected by: 3e-5 pixel."""

_UNEVEN_PIXELS = 0.008
"""Error of a centroid by unequal pixels under the spot, in pixels: s/(2√π) for a disc of any size
and pixels of relative spread s, here that of a uniform ±5 % as it is usual before a calibration."""


@dataclass(frozen=True)
class Experiment:
    """Exposures of one steady beam at several sensor positions, as files on disk.

    Attributes
    ----------
    path : Path
        The experiment.toml.
    manifest : Manifest
        Its checked content.

    See Also
    --------
    equipix.calibrate : The same for arrays in memory.

    Notes
    -----
    Frames, dark frames and aperture images are named relative to the file: one file (a
    multi-page TIFF holds many frames), a glob or a list. The position of an exposure is either
    ``shift = [row, col]`` in pixels or follows from the one before it and from images of a small
    aperture in the beam, taken before and after the move.
    """

    path: Path
    manifest: Manifest

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read and check the description of an experiment.

        Parameters
        ----------
        path : str or path
            The experiment.toml.

        Returns
        -------
        Experiment
            What `run` evaluates.

        Raises
        ------
        FileError
            If the file cannot be read, has an unknown key or a wrong value, or names a file that
            does not exist.
        """
        file = as_path("path", path)
        experiment = cls(file, read_manifest(file))
        experiment.files()
        return experiment

    def files(self) -> list[Path]:
        """All image files of the experiment, each once."""
        entries: list[str | list[str] | None] = [self.manifest.dark.frames]
        for exposure in self.manifest.exposure:
            entries += [exposure.frames, exposure.aperture_before, exposure.aperture_after]
        found = [find_files(self.path, entry) for entry in entries if entry is not None]
        return list(dict.fromkeys(file for files in found for file in files))

    def check_formats(self) -> None:
        """Read the files' headers: all images must be of one shape and depth.

        Raises
        ------
        FileError
            If a file cannot be read or differs from the first dark frames.
        """
        first, *others = self.files()
        wanted, wanted_dtype = frame_format(first)
        for file in others:
            shape, dtype = frame_format(file)
            if shape[1:] != wanted[1:] or dtype != wanted_dtype:
                raise FileError(
                    f"{file}: holds {dtype} frames of shape {shape[1:]}, expected {wanted_dtype} "
                    f"of shape {wanted[1:]} as in {first}"
                )

    def measure_shifts(
        self, calibration: Calibration | None = None
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Shift of each exposure and its standard error.

        Parameters
        ----------
        calibration : Calibration, optional
            A first calibration from this experiment, which the images of the aperture are then
            corrected by; its flagged pixels stay as they are.

        Returns
        -------
        shifts : ndarray, shape (n, 2)
            Absolute shifts (row, col) in pixels.
        std : ndarray, shape (n, 2)
            Standard errors; for shifts that the file gives those that it gives, or 0. Those of
            successive moves add in quadrature, and so does what the unequal pixels under a spot do
            to its centroid: 0.008 pixel, or s/(2√π) where a calibration leaves them unequal by s.

        Raises
        ------
        FileError
            If an aperture image cannot be read.
        InputError
            If one shows no usable spot; if the calibration was read from a file, holds no dark, or
            is of another sensor.

        Notes
        -----
        The aperture stands still in the beam, where it has the coordinate u = A p + t + d: with
        its image at p_before and p_after, d_new = d_old + (A_old p_before + t_old) −
        (A_new p_after + t_new).
        """
        shifts, variances = [np.zeros(2)], [np.zeros(2)]
        first, *others = self.manifest.exposure
        if first.shift is not None:
            shifts[0] = np.array(first.shift)
            variances[0] = np.square(first.shift_std or [0.0, 0.0])
        for old, new in zip(self.manifest.exposure, others, strict=False):
            if new.shift is not None:
                shifts.append(np.array(new.shift))
                variances.append(np.square(new.shift_std or [0.0, 0.0]))
                continue
            spots, shape = self._aperture(new, calibration)
            ends = ((spots.before, old.rotation), (spots.after, new.rotation))
            before, after = (in_beam(spot.position, turn, shape) for spot, turn in ends)
            shifts.append(shifts[-1] + before - after)
            noise = [variance_in_beam(np.square(spot.std), turn) for spot, turn in ends]
            uneven = sum(_uneven_pixels(spot, calibration) for spot, _ in ends)
            variances.append(variances[-1] + noise[0] + noise[1] + uneven)
        return np.array(shifts), np.sqrt(variances)

    def run(
        self,
        *,
        flux: FluxModel | None = None,
        robust: bool = False,
        method: Method = "multiscale",
        tolerance: float = 1e-6,
        max_sweeps: int | None = None,
        uncertainty: bool = False,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Calibration:
        """Calibrate the sensor from the files.

        Parameters
        ----------
        flux : {"fit", "linear"}, optional
            Fluxes to find: one for each exposure, or linear in the file's ``time``. Unless given
            they are those of the file, as known or, with ``flux_std``, as a prior.
        robust : bool
            Whether to leave out measurements that disagree with the others.
        method : {"multiscale", "coordinate-descent"}
            How to minimise the objective.
        tolerance : float
            Largest relative error of the sensitivity at which the solver stops.
        max_sweeps : int, optional
            Most passes over the data.
        uncertainty : bool
            Whether to find the standard deviation of every pixel and of the tilt.
        workers : int, optional
            Number of threads; by default one for each processor.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` now and then.

        Returns
        -------
        Calibration
            With the dark frame, the flags of dead, hot and saturated pixels, and in `metadata`
            the names, the options, the hashes of the files and the times.

        Raises
        ------
        FileError
            If a file cannot be read, or the images differ in size or depth.
        InputError
            If an option is out of range, or the exposures do not make a calibration.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Notes
        -----
        Shifts with a standard error are refined, with it as their prior: see `calibrate`. Those
        that images of an aperture tell are measured twice, the second time on images corrected by
        a first calibration.
        """
        started = datetime.now(UTC)
        _check_options(tolerance, max_sweeps, workers)
        self.check_formats()
        shifts, std = self.measure_shifts()
        with naming_memory("averaging"):
            measured = self._average(workers, progress)
            noise = self._noise(measured)
            models = _models(measured, noise)
            flags = _flags(
                dead_pixels(measured.signals, models),
                hot_pixels(measured.dark, noise),
                measured.saturated,
            )

        def solve(tolerance: float, *, uncertainty: bool) -> Calibration:
            refined = method == "multiscale" and bool(std.any())
            solved = calibrate(
                measured.signals,
                shifts if method == "multiscale" else round_shifts(shifts, std),
                shift_std=std if refined else None,
                variance=models,
                mask=flags != 0,
                flux=self._column("flux") if flux is None else flux,
                flux_std=self._column("flux_std") if flux is None else None,
                time=self._column("time") if flux == "linear" else None,
                rotation=[exposure.rotation for exposure in self.manifest.exposure],
                robust=robust,
                method=method,
                tolerance=tolerance,
                max_sweeps=max_sweeps,
                uncertainty=uncertainty,
                workers=workers,
                progress=progress,
            )
            dark = measured.dark.mean.astype(np.float32)
            return replace(solved, dark=dark, flags=solved.flags | flags)

        moved = any(exposure.shift is None for exposure in self.manifest.exposure[1:])
        if moved and method == "multiscale":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the second calibration has them all
                first = solve(max(tolerance, _ROUGH), uncertainty=False)
            shifts, std = self.measure_shifts(first)
        solved = solve(tolerance, uncertainty=uncertainty)
        return replace(
            solved,
            metadata=solved.metadata | self._metadata(started, shifts, std, noise),
        )

    def _aperture(
        self, exposure: Exposure, calibration: Calibration | None
    ) -> tuple[ShiftMeasurement, tuple[int, int]]:
        """Find the spots of the move to `exposure`, and the shape of the sensor."""
        before, after = (
            read_frames(find_files(self.path, entry))
            for entry in (exposure.aperture_before, exposure.aperture_after)
            if entry is not None
        )
        try:
            level = self.manifest.sensor.saturation_level
            if calibration is not None:
                # In other units; the first measurement has seen that nothing saturates.
                before, after = _equalised(before, calibration), _equalised(after, calibration)
                level = None
            return measure_shift(before, after, saturation=level), before.shape[-2:]
        except InputError as error:
            raise type(error)(
                f"{self.path}: move to exposure '{exposure.name}': {error}"
            ) from error

    def _average(self, workers: int | None, progress: Progress | None) -> _Measured:
        """Mean signal of every exposure; the frames' other statistics are reduced at once."""
        dark = self._statistics("dark", self.manifest.dark.frames, workers, progress)
        shape = dark.mean.shape
        exposures = self.manifest.exposure
        measured = _Measured(
            dark=dark,
            signals=np.empty((len(exposures), *shape), dtype=np.float32),
            saturated=dark.saturated > 0,
            frames=[],
            transfer=[_transfer(np.zeros(shape), dark)],
        )
        for k, exposure in enumerate(exposures):
            frames = self._statistics(exposure.name, exposure.frames, workers, progress)
            signal = frames.mean - dark.mean
            measured.signals[k] = signal
            measured.saturated[frames.saturated > 0] = True
            measured.frames.append(int(frames.count.max()))
            measured.transfer.append(_transfer(signal, frames))
        return measured

    def _statistics(
        self, name: str, entry: str | list[str], workers: int | None, progress: Progress | None
    ) -> FrameStatistics:
        def report(done: int, total: int, _: str) -> None:
            if progress is not None:
                progress(done, total, f"averaging {name}")

        level = self.manifest.sensor.saturation_level
        files = find_files(self.path, entry)
        frames = average(files, saturation=level, workers=workers, progress=report)
        if (frames.saturated > 0).all():
            reached = "the largest value" if level is None else f"{level:g} DN"
            raise FileError(
                f"{self.path}: every pixel of '{name}' reaches the saturation level, {reached}: "
                "correct 'bit_depth' or 'saturation' in [sensor], or expose less"
            )
        return frames

    def _noise(self, measured: _Measured) -> NoiseModel | None:
        """Noise model of all frames; None where single frames show no scatter."""
        gain = self.manifest.sensor.gain_dn_per_e
        dark, *exposures = measured.transfer
        if not len(dark) or (gain is None and not any(map(len, exposures))):
            return None
        return NoiseModel.fit(np.concatenate(measured.transfer), gain=gain)

    def _column(self, key: str) -> list[float] | None:
        """The values of a key that all exposures have, or none."""
        values = [getattr(exposure, key) for exposure in self.manifest.exposure]
        return [value for value in values if value is not None] or None

    def _metadata(
        self,
        started: datetime,
        shifts: NDArray[Any],
        std: NDArray[Any],
        noise: NoiseModel | None,
    ) -> dict[str, Any]:
        """Where the calibration comes from, as JSON values."""
        folder = self.path.parent
        files = [self.path, *self.files()]
        return {
            "experiment": str(self.path),
            "sensor": self.manifest.sensor.model_dump(),
            "exposures": [exposure.name for exposure in self.manifest.exposure],
            "measured_shifts": shifts.tolist(),
            "measured_shift_std": std.tolist(),
            "noise": None if noise is None else asdict(noise),
            "inputs": {os.path.relpath(file, folder): _sha256(file) for file in files},
            "started": started.isoformat(timespec="seconds"),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }


@dataclass(frozen=True)
class _Measured:
    """What the solver needs of the frames.

    `signals` (n, rows, cols) are dark-subtracted means, `saturated` (rows, cols) tells pixels that
    ever were, `frames` (n) counts them, `transfer` holds the photon-transfer points of the dark
    frames and of every exposure.
    """

    dark: FrameStatistics
    signals: NDArray[Any]
    saturated: NDArray[Any]
    frames: list[int]
    transfer: list[NDArray[Any]]


def _check_options(tolerance: float, max_sweeps: int | None, workers: int | None) -> None:
    """Refuse before the work starts what the solver would refuse after the averaging."""
    as_tolerance(tolerance)
    if max_sweeps is not None:
        positive_count("max_sweeps", max_sweeps)
    positive_workers(workers)


def _transfer(signal: NDArray[Any], frames: FrameStatistics) -> NDArray[Any]:
    usable = frames.saturated == 0
    return photon_transfer(signal, frames.variance, usable, int(frames.count.max()))


def _models(measured: _Measured, noise: NoiseModel | None) -> list[NoiseModel] | None:
    """Noise model of each dark-subtracted mean."""
    if noise is None:
        return None
    dark = float(noise.variance(0.0)) / int(measured.dark.count.max())
    return [noise.of_mean(frames, dark_variance=dark) for frames in measured.frames]


def _flags(dead: NDArray[Any], hot: NDArray[Any], saturated: NDArray[Any]) -> NDArray[Any]:
    """Flag pixels; what is clipped seems not to answer, and does not count as dead."""
    flags = np.zeros(dead.shape, np.uint32)
    set_bits(flags, "dead", dead & ~hot & ~saturated)
    set_bits(flags, "hot", hot)
    flags[saturated] |= np.uint32(Flag.SATURATED | Flag.DO_NOT_USE)
    return flags


def _equalised(frames: NDArray[Any], calibration: Calibration) -> NDArray[Any]:
    """Frames corrected; of flagged pixels, which the centroid mends, the dark alone."""
    usable = (calibration.flags & Flag.DO_NOT_USE) == 0
    gain = np.where(usable, calibration.sensitivity, 1)
    if calibration.dark is None:
        raise InputError("'calibration' holds no dark frame: give one that Experiment.run has made")
    if frames.shape[-2:] != calibration.shape:
        raise InputError(
            f"'calibration' is of a sensor of {calibration.shape}, the images of the aperture have "
            f"{frames.shape[-2:]} pixels"
        )
    return np.asarray((frames - calibration.dark) / gain)


def _uneven_pixels(spot: Spot, calibration: Calibration | None) -> float:
    """Variance of a centroid by unequal pixels under the spot: s²/4π for a disc of any size.

    After a calibration s is the error of M that noise leaves. A pixel's n measurements tell M with
    the variance 1/Σ w c²L², if the beam is known; it takes about one of them, hence n/(n − 2).
    """
    if calibration is None:
        return _UNEVEN_PIXELS**2
    if calibration.weighted is None:
        raise InputError(
            "'calibration' was read from a file, which does not hold the measurements: give the "
            "result of Experiment.run"
        )
    exposures = calibration.weighted.exposures
    count = len(exposures)
    row, col = np.rint(spot.position).astype(int)
    around = (
        ...,
        slice(max(row - _AROUND, 0), row + _AROUND),
        slice(max(col - _AROUND, 0), col + _AROUND),
    )
    known = np.square(exposures.values[around], dtype=np.float64)
    if exposures.variance is None:
        known /= calibration.reduced_chi2
    elif exposures.variance.ndim == 3:
        known /= exposures.variance[around]
    else:
        known /= exposures.variance[:, None, None]
    told = float(np.median(np.nan_to_num(known).sum(axis=0)))
    if not told > 0:  # no light around the spot, or no noise known
        return _UNEVEN_PIXELS**2
    return min(count / max(count - 2, 1) / told / (4 * np.pi), _UNEVEN_PIXELS**2)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
