"""A calibration experiment on disk, as experiment.toml describes it, and its evaluation."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from equipix._check import Array, ArrayLike, Floats, FluxModel, Method, Progress, naming_memory
from equipix.calibration.calibrate import calibrated
from equipix.calibration.result import Calibration
from equipix.diagnosis.inputs import wrong_flux
from equipix.errors import InputError
from equipix.experiment.aperture import (
    Equalisation,
    Moves,
    measured_moves,
    region_of_spots,
)
from equipix.experiment.darks import Darks
from equipix.experiment.described import Described
from equipix.experiment.manifest import Manifest
from equipix.exposures.exposures import Exposures, FitOptions, naming_exposures
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.findings import Finding, say
from equipix.fitting.pixels import pixel_flags
from equipix.fitting.weighted import Options, weighted_fit
from equipix.measured.measured import measured_of

_ROUGH = 1e-4
"""Tolerance of the fit that the aperture's images are corrected by: 3e-5 pixel."""


@dataclass(frozen=True)
class Experiment(Described[Manifest]):
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
    multi-page TIFF holds many frames; a saved average stands for the frames that it was made of), a
    glob or a list. ``[sensor]`` may exclude pixels by a mask
    file and by regions. The position of an exposure is either
    ``shift = [row, col]`` in pixels, or computed from the position before it and from images of
    a small aperture in the beam, taken before and after the move.
    """

    _model, _dtype = Manifest, np.float32

    def measure_shifts(self, calibration: Calibration | None = None) -> tuple[Array, Array]:
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
            successive moves add in quadrature, and so does the error of a centroid by the unequal
            pixels under the spot: 0.008 pixel, or s/(2√π) where a calibration leaves them unequal
            by s.

        Raises
        ------
        FileError
            If an aperture image cannot be read.
        InputError
            If one shows no usable spot; if the calibration was read from a file, holds no dark, or
            is of another sensor.

        Notes
        -----
        The aperture is fixed in the beam, at the coordinate u = A p + t + d: with
        its image at p_before and p_after, d_new = d_old + (A_old p_before + t_old) −
        (A_new p_after + t_new).
        """
        if calibration is not None and calibration.weighted is None:
            raise InputError(
                "'calibration' was read from a file, which does not hold the measurements: "
                "give the result of Experiment.run"
            )
        if not self._is_moved():
            return measured_moves(self.path, self.manifest)[:2]
        darks, equalisation = self._darks(), None
        if calibration is not None and calibration.weighted is not None:
            equalisation = Equalisation.of(
                calibration.weighted, calibration.flags, darks=darks.means
            )
        elif self.manifest.sensor.cfa is not None:
            equalisation = Equalisation.of_colours(self._average(darks).filters, darks.means)
        return measured_moves(self.path, self.manifest, equalisation, hot=darks.hot)[:2]

    def _is_moved(self) -> bool:
        """Whether a move is measured from images of the aperture."""
        return any(exposure.shift is None for exposure in self.manifest.exposure[1:])

    def run(
        self,
        *,
        flux: FluxModel | None = None,
        mask: ArrayLike | None = None,
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
        mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
            True = do not use, besides the pixels that the file excludes.
        robust : bool
            Whether to leave out measurements that disagree with the others.
        method : {"multiscale", "coordinate-descent"}
            How to minimise the objective.
        tolerance : float
            Largest relative error of the sensitivity at which the solver stops.
        max_sweeps : int, optional
            Upper limit on passes over the data in each fit.
        uncertainty : bool
            Whether to find the standard deviation of every pixel and of the tilt.
        workers : int, optional
            Number of threads; by default one for each processor.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` repeatedly.

        Returns
        -------
        Calibration
            With the dark frame, the flags of dead, hot and saturated pixels, and in `metadata`
            the names, the options, the hashes of the files and the times.

        Raises
        ------
        FileError
            If a file cannot be read, the images differ in size or depth, or two files have the same
            content.
        InputError
            If an option is out of range, or the exposures do not make a calibration.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Warns
        -----
        InputWarning
            If the file has ``flux`` or ``time`` that `flux` leaves without use, or the single dark
            has another exposure time or temperature than frames by the headers of the files.

        Notes
        -----
        Shifts with a standard error are refined, with it as their prior: see `calibrate`. Those
        measured from images of an aperture are measured twice, the second time on images corrected
        by a first calibration of the part of the sensor around the spots, unless a flux that is
        not as given has spoilt it.
        """
        fit_options = FitOptions.of(method, tolerance, max_sweeps, workers, progress)
        options = Options(fit_options, robust=robust, uncertainty=uncertainty)
        said = say(*self._unused(flux))
        if flux == "linear" and self._column("time") is None:
            raise InputError(
                f"{self.path}: flux='linear' (--flux linear) needs 'time', in seconds, in each "
                "[[exposure]]"
            )
        excluded, hashes = self._checked(mask)
        darks = self._darks(workers, progress)
        said += say(*darks.findings)
        hot = darks.hot
        averaged = self._average(darks, workers, progress)
        colours = Equalisation.of_colours(averaged.filters, darks.means)
        moves = measured_moves(self.path, self.manifest, colours, hot=hot)
        shifts, std = moves.shifts, moves.std
        whole = fit_options.whole_shifts
        names = [exposure.name for exposure in self.manifest.exposure]
        with naming_memory("calibrating"), naming_exposures(names):
            measured = measured_of(averaged)
            positions = Positions.of(
                shifts,
                rotation=[exposure.rotation for exposure in self.manifest.exposure],
                std=std if std.any() and not whole else None,
                shape=measured.values.shape,
            )
            fluxes = Flux.of(
                self._column("flux") if flux is None else flux,
                self._column("flux_std") if flux is None else None,
                self._column("time") if flux == "linear" else None,
                len(measured),
            )
            exposures = Exposures.of(measured, positions, fluxes, mask=excluded)
        words = list(darks.words)
        origin = self._provenance(hashes, averaged, exposures=names, darks=words)
        del averaged, measured  # their variances are as large as the exposures
        if whole:
            exposures = exposures.at(positions.whole(std))
        elif self._is_moved():
            try:
                again = self._measured_again(exposures, moves, darks, options)
                positions = Positions.of(again[0], rotation=positions.rotation, std=again[1])
            except InputError:  # no single spot, or one that is too uncertain
                if not (cause := wrong_flux(exposures)):
                    raise
                said += say(_measured_once(cause))
            else:
                (shifts, std), exposures = again, exposures.at(positions)
        del darks, hot, colours, moves  # maps of the sensor
        origin |= {"measured_shifts": shifts.tolist(), "measured_shift_std": std.tolist()}
        return calibrated(exposures, options, said=said, provenance=origin)

    def _measured_again(
        self, exposures: Exposures, moves: Moves, darks: Darks, options: Options
    ) -> tuple[Floats, Floats]:
        """Shifts and standard errors by images that a first calibration has corrected.

        It is one of the part of the sensor around the spots.
        """
        fit = replace(options.fit, tolerance=max(options.fit.tolerance, _ROUGH))

        def by(part: Exposures, corner: tuple[int, int]) -> tuple[Floats, Floats]:
            first = weighted_fit(part, replace(options, fit=fit))
            flags = pixel_flags(first, fit)
            equal = Equalisation.of(first, flags, fit.workers, darks.means, corner)
            return measured_moves(self.path, self.manifest, equal, hot=darks.hot)[:2]

        period = (1, 1) if exposures.filters is None else exposures.filters.colours.period
        if (region := region_of_spots(moves, exposures.shape, period)) is not None:
            rows, cols = region
            with suppress(InputError):  # a spot that reaches beyond, or exposures without light
                return by(exposures.part(region), (rows.start, cols.start))
        return by(exposures, (0, 0))

    def _unused(self, flux: FluxModel | None) -> list[Finding]:
        """Findings on values in the file that the fluxes to find leave without use."""
        words = []
        if flux is not None and self._column("flux") is not None:
            words.append(
                f"'flux' in {self.path} is not used, since fluxes are to be found (flux='{flux}', "
                f"--flux {flux}): leave one of the two out, or give 'flux_std' too for a prior"
            )
        if flux != "linear" and self._column("time") is not None:
            words.append(
                f"'time' in {self.path} is not used: it is for flux='linear' (--flux linear)"
            )
        return [Finding("unused", each, "input", "note") for each in words]

    def _column(self, key: str) -> list[float] | None:
        """The values of a key that all exposures have, or none."""
        values = [getattr(exposure, key) for exposure in self.manifest.exposure]
        return [value for value in values if value is not None] or None


def _measured_once(cause: str) -> Finding:
    """Finding on images of the aperture that a first calibration has made worse."""
    words = (
        f"{cause}, which has spoilt the first calibration: the images of the aperture are not "
        "corrected by it, and the shifts are as uncertain as unequal pixels make them"
    )
    return Finding("aperture", words, "misfit")
