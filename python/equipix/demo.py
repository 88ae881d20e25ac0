"""A calibration with a virtual camera, compared with the truth and with a flat field."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from equipix._check import Array, Progress
from equipix.calibration.result import Calibration
from equipix.experiment.experiment import Experiment
from equipix.exposures.spots import cross_pattern
from equipix.measured.average import average
from equipix.metrics.maps import relative_error, rms_at_both_scales
from equipix.shown import Brief
from equipix.simulate.beams import cosine_sensitivity, gaussian_beam
from equipix.simulate.camera import Camera
from equipix.simulate.rig import VirtualExperiment, experiment

RMS_LIMIT, BLOCK_RMS_LIMIT = 1.1, 1.5
"""Factors by which the errors may exceed the value that noise predicts."""

ARMS = {200: (23, 41), 96: (11, 19), 0: (5, 7)}
"""Shifts in pixels by the least size of a sensor: the sweeps needed fall with the square of shifts,
to some 2800 at 782×582, but the image of the hole must stay on the sensor."""

EXPOSURE_E = 14_000.0
"""Electrons in a frame, of an ADC range of 20 000."""

UNDER_HOLE = 1e-4
"""Share of the light that still counts as the image of the hole."""

SOURCE_UNEVENNESS = 0.01
"""By how much the source of the flat field is brighter in one corner than in the opposite one."""


@dataclass(frozen=True, eq=False)
class Demo(Brief):
    """Errors of a calibration and of a flat field against the same truth.

    Attributes
    ----------
    calibration : Calibration
        The result of the experiment.
    truth, flat_field : ndarray, shape (rows, cols), float64
        The true sensitivity, NaN in dead and hot pixels, and that by the uneven source.
    predicted : tuple of float
        Root mean square of the error that the camera's noise alone leaves: of pixels, and of
        means over 16×16 pixels.
    """

    calibration: Calibration
    truth: Array
    flat_field: Array
    predicted: tuple[float, float]

    @property
    def error(self) -> Array:
        """Relative error of the calibration, shape (rows, cols)."""
        return relative_error(self.calibration.sensitivity, self.truth)

    @property
    def flat_field_error(self) -> Array:
        """Relative error of the flat field, shape (rows, cols)."""
        return relative_error(self.flat_field, self.truth)

    @property
    def passed(self) -> bool:
        """Whether the errors are within 1.1 and 1.5 times what the noise predicts."""
        rms, block_rms = rms_at_both_scales(self.error)
        return (
            rms <= RMS_LIMIT * self.predicted[0]
            and block_rms <= BLOCK_RMS_LIMIT * self.predicted[1]
        )

    def figures(self) -> dict[str, Any]:
        """Give the figures of merit as JSON values."""
        rms, block_rms = rms_at_both_scales(self.error)
        flat_rms, flat_block_rms = rms_at_both_scales(self.flat_field_error)
        return {
            "rms": rms,
            "predicted_rms": self.predicted[0],
            "block_rms": block_rms,
            "predicted_block_rms": self.predicted[1],
            "flat_field_rms": flat_rms,
            "flat_field_block_rms": flat_block_rms,
            "converged": self.calibration.converged,
            "error_estimate": self.calibration.error_estimate,
            "sweeps": self.calibration.sweeps,
            "passed": self.passed,
        }


def virtual_experiment(
    shape: tuple[int, int], *, frames: int, bit_depth: int = 12, cfa: str | None = None, rng: int
) -> VirtualExperiment:
    """Prepare the demo's experiment: the hard case of plain coordinate descent.

    The sensor carries white spread of 5 % and a cosine of 5 % over its whole size; the beam is
    Gaussian, the positions make a cross, (23, 41) from 200 pixels on. The hole's image falls on
    good pixels, as one would choose its place.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    frames : int
        Frames of each exposure and of the dark.
    bit_depth : int
        Bits of the ADC.
    cfa : str, optional
        Colour filters of the camera.
    rng : int
        Seed of the simulation.

    Returns
    -------
    VirtualExperiment
        The experiment, in memory.
    """
    generator = np.random.default_rng(rng)
    arms = next(arms for size, arms in ARMS.items() if min(shape) >= size)
    virtual = experiment(
        cosine_sensitivity(shape, rng=generator),
        gaussian_beam(shape, width=1000 * max(1, shape[1] / 782)),
        cross_pattern(*arms),
        frames=frames,
        exposure_e=EXPOSURE_E,
        bit_depth=bit_depth,
        cfa=cfa,
        rng=generator,
    )
    camera = virtual.camera
    dead, hot = (bad[~_under_hole(virtual, bad)] for bad in (camera.dead, camera.hot))
    return replace(virtual, camera=replace(camera, dead=dead, hot=hot))


def _under_hole(virtual: VirtualExperiment, pixels: Array) -> Array:
    """Whether the image of the hole falls on these pixels in any exposure."""
    rows, cols = np.divmod(pixels, virtual.camera.shape[1])
    light = [virtual.hole(rows + row, cols + col) for row, col in virtual.positions]
    return np.asarray(np.max(light, axis=0) > UNDER_HOLE * EXPOSURE_E)


def run_demo(
    folder: Path,
    *,
    shape: tuple[int, int] = (582, 782),
    frames: int = 40,
    tolerance: float = 1e-5,
    workers: int | None = None,
    progress: Progress | None = None,
    rng: int = 1,
    force: bool = False,
) -> Demo:
    """Write an experiment into `folder`, calibrate from its files, and compare with the truth.

    Parameters
    ----------
    folder : Path
        Folder to make for the experiment.
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    frames : int
        Frames of each exposure, of the dark and of the flat field.
    tolerance : float
        Largest relative error of the sensitivity, noise apart, at which the solver stops.
    workers : int, optional
        Number of threads; by default one for each processor.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then.
    rng : int
        Seed of the simulation.
    force : bool
        Whether an experiment in `folder` may be replaced.

    Returns
    -------
    Demo
        The calibration, the truth and the flat field.
    """
    virtual = virtual_experiment(shape, frames=frames, rng=rng)
    camera = virtual.camera
    manifest = virtual.write(folder, force=force, progress=progress)
    experiment = Experiment.load(manifest)
    calibration = experiment.run(tolerance=tolerance, workers=workers, progress=progress)
    report: Progress = progress or (lambda *_: None)
    report(0, 1, "flat field")
    flat_field = _flat_field(camera, virtual.truth.dark, frames, rng)
    report(0, 1, "prediction")
    return Demo(
        calibration=calibration,
        truth=np.where(camera.good, camera.response, np.nan),
        flat_field=flat_field,
        predicted=virtual.noise_prediction(rng=rng),
    )


def _flat_field(camera: Camera, dark: Array, frames: int, rng: int) -> Array:
    """Sensitivity as the mean of frames of a source that is assumed uniform but is not."""
    rows, cols = camera.shape
    slope = np.add.outer(np.linspace(-0.25, 0.25, rows), np.linspace(-0.25, 0.25, cols))
    light = EXPOSURE_E * (1 + SOURCE_UNEVENNESS * slope)
    signal = average(camera.frames(light, frames, rng=rng)).mean - dark
    signal[~camera.good] = np.nan
    return np.asarray(signal / np.nanmean(signal))
