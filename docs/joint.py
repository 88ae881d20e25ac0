"""Draw docs/joint.png: the errors of M that four faults of a measurement cause.

The rows are shifts between pixels, a drifting lamp, a grain of dust, and shifts with an error. The
columns are the error of M with the fault ignored, with the option of `calibrate` that models it,
and without the fault (whole shifts, true fluxes, the grain masked, true shifts); `make figures`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from figures import FOLDER, SAVED
from matplotlib.figure import Figure

import equipix
from equipix import metrics, simulate
from equipix.errors import MisfitWarning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix import Calibration

SHAPE = (120, 160)
CROSS = equipix.cross_pattern(11, 19).astype(float)
NOISE = 1e-3
VARIANCE = np.full(5, NOISE**2)
TOLERANCE = 1e-5
HEADINGS = ("the fault ignored", "the fault modelled", "without the fault")


@dataclass(frozen=True)
class Fault:
    """What a row shows: `runs` are calibrations by title, `part` what of the sensor is drawn."""

    title: str
    truth: NDArray[np.float64]
    runs: dict[str, Calibration]
    part: tuple[slice, slice] = (slice(None), slice(None))


def structured(
    shifts: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Make the truth, and exposures of a beam with fine structure."""
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    frames = simulate.exposures(truth, simulate.wavy_beam(SHAPE, rng=rng), shifts)
    return truth, frames + NOISE * rng.standard_normal(frames.shape)


def between(rng: np.random.Generator) -> NDArray[np.float64]:
    """Put the exposures of the cross between pixels, but for the first."""
    fractions = rng.uniform(-0.5, 0.5, CROSS.shape)
    fractions[0] = 0
    return CROSS + fractions


def between_pixels() -> Fault:
    """Shifts that are not whole, rounded and as they are; and whole shifts for comparison."""
    shifts = between(np.random.default_rng(1))
    truth, frames = structured(shifts, np.random.default_rng(2))
    _, whole = structured(CROSS, np.random.default_rng(2))
    options = {"variance": VARIANCE, "tolerance": TOLERANCE}
    return Fault(
        "shifts between pixels\n(a beam with structure)",
        truth,
        {
            "rounded": equipix.calibrate(frames, np.rint(shifts), **options),
            "given as they are": equipix.calibrate(frames, shifts, **options),
            "whole shifts": equipix.calibrate(whole, CROSS, **options),
        },
    )


def drifting_lamp() -> Fault:
    """Lamp drift of 1 %: ignored, found with one more exposure that is turned, and known."""
    rng = np.random.default_rng(3)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    flux = np.exp(0.01 * rng.standard_normal(6))
    shifts, rotation = np.vstack([CROSS, CROSS[:1]]), [0] * 5 + [180]
    beam = simulate.gaussian_beam(SHAPE)
    frames = simulate.exposures(truth, beam, shifts, flux=flux, rotation=rotation)
    frames += NOISE * rng.standard_normal(frames.shape)
    turned = {"rotation": rotation, "variance": np.full(6, NOISE**2), "tolerance": TOLERANCE}
    plain = {"variance": VARIANCE, "tolerance": TOLERANCE}
    return Fault(
        "lamp drift of 1 %\nbetween exposures",
        truth,
        {
            "taken as steady": equipix.calibrate(frames[:5], CROSS, **plain),
            "flux='fit', one exposure turned": equipix.calibrate(
                frames, shifts, flux="fit", **turned
            ),
            "true fluxes": equipix.calibrate(frames, shifts, flux=flux, **turned),
        },
    )


def grain_of_dust() -> Fault:
    """A grain of 20 pixels in one exposure: ignored, left out by `robust`, masked by hand."""
    rng = np.random.default_rng(4)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE), CROSS)
    rows, cols = np.indices(SHAPE)
    dusty = np.zeros(frames.shape, bool)
    dusty[2].flat[np.argsort(np.hypot(rows - 60.2, cols - 80.4), axis=None)[:20]] = True
    frames[dusty] *= 0.9
    frames += NOISE * rng.standard_normal(frames.shape)
    options = {"variance": VARIANCE, "tolerance": TOLERANCE}
    return Fault(
        "dust on 20 pixels in one\nexposure (cut-out, 64×48)",
        truth,
        {
            "taken for signal": equipix.calibrate(frames, CROSS, **options),
            "robust=True": equipix.calibrate(frames, CROSS, robust=True, **options),
            "masked by hand": equipix.calibrate(frames, CROSS, mask=dusty, **options),
        },
        part=(slice(36, 84), slice(48, 112)),
    )


def uncertain_shifts() -> Fault:
    """Shifts that are off by 0.05 pixel: taken as they are, refined, and the true ones."""
    rng = np.random.default_rng(5)
    shifts = between(rng)
    truth, frames = structured(shifts, rng)
    known = shifts + 0.05 * rng.standard_normal(shifts.shape)
    options = {"variance": VARIANCE, "tolerance": TOLERANCE}
    return Fault(
        "shifts known to 0.05 pixel\n(a beam with structure)",
        truth,
        {
            "taken as exact": equipix.calibrate(frames, known, **options),
            "shift_std=0.05": equipix.calibrate(frames, known, shift_std=0.05, **options),
            "true shifts": equipix.calibrate(frames, shifts, **options),
        },
    )


def main() -> None:
    """Calibrate and draw: in a row one scale, so that what is left can be compared."""
    faults = [between_pixels(), drifting_lamp(), grain_of_dust(), uncertain_shifts()]
    figure = Figure(figsize=(11, 10.8), layout="constrained")
    figure.suptitle(
        f"Error of the sensitivity M, in %: {SHAPE[1]}×{SHAPE[0]} pixels, noise of an exposure "
        f"{100 * NOISE:g} %; in a row one colour scale"
    )
    grid = figure.subplots(len(faults), 3)
    for place, heading in zip(grid[0], HEADINGS, strict=True):
        place.annotate(
            heading, (0.5, 1.17), xycoords="axes fraction", ha="center", weight="bold", fontsize=12
        )
    for axes, fault in zip(grid, faults, strict=True):
        errors = [
            100 * metrics.relative_error(run.sensitivity, fault.truth)[fault.part]
            for run in fault.runs.values()
        ]
        limit = float(np.percentile(np.abs(errors[0]), 99.5))
        for place, title, error in zip(axes, fault.runs, errors, strict=True):
            image = place.imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
            rms = np.sqrt(np.mean(error**2))
            place.set_title(f"{title}: rms {rms:.2g} %", fontsize=10)
            place.set(xticks=[], yticks=[])
        axes[0].set_ylabel(fault.title, fontsize=10)
        figure.colorbar(image, ax=axes, label="error of M, %", pad=0.01)
    figure.savefig(FOLDER / "joint.png", **SAVED)


if __name__ == "__main__":
    with warnings.catch_warnings():
        # The left column is the effect of a fault that is ignored.
        warnings.simplefilter("ignore", MisfitWarning)
        main()
