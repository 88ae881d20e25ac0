"""The paper's section 3 at full size: `make figures`, or ``python docs/section3.py``.

A virtual CCD of 782×582 pixels, which carries a cosine of 5 % over its whole size, is calibrated
three times with different shifts. Of each position 500 frames go straight to their average; the
shifts are those that the images of the hole show, to whole pixels.

- figure4.png: an exposure, the beam and the sensitivity, and row 50 of each
- figure5.png: row 50 of the sensitivity by three experiments
- what the paper claims, and how close the truth is: printed; exit status 1 if something fails
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from figures import AFTER, BEFORE, FOLDER, INK, LIGHT, SAVED, draw_maps
from matplotlib.figure import Figure

import equipix
from equipix import metrics, simulate

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHAPE = (582, 782)
ROW = 50
FRAMES = 500
ARMS = ((11, 19), (7, 23), (5, 19))
"""Shifts of the three crosses, from those of the paper."""

EXPOSURE_E, FULL_SCALE_E, BIT_DEPTH = 36_000.0, 45_000.0, 12
"""Electrons in a frame and of the range of the ADC, and its bits: 500 frames leave a noise below
3e-4, and the read noise of a step takes the rounding out of the mean of the dark."""

AGREEMENT = 1e-3
"""Largest difference of two sensitivities along the row."""

COLUMNS = slice(60, 121)
"""Of figure 5: the part of the row that is drawn."""

LINES = (
    {"color": LIGHT, "ls": "-", "lw": 5},
    {"color": AFTER, "ls": "--", "lw": 2.5},
    {"color": INK, "ls": ":", "lw": 1.5},
)
"""Of figure 5: each leaves the one below visible, for they coincide."""


@dataclass(frozen=True, eq=False)
class Found:
    """What one experiment found.

    `frame` is the mean of its first exposure in DN; `noise` the largest standard deviation of a
    mean, relative to its signal; `predicted` the rms error of M that this noise leaves.
    """

    frame: NDArray
    calibration: equipix.Calibration
    noise: float
    predicted: float


@dataclass(frozen=True)
class Claim:
    """Values that may not exceed a limit, one for each experiment or pair of them."""

    text: str
    values: list[float]
    limit: float

    @property
    def holds(self) -> bool:
        """Whether none exceeds it."""
        return all(value <= self.limit for value in self.values)

    def __str__(self) -> str:
        """Finding, values and limit on one line."""
        values = "  ".join(f"{value:8.2e}" for value in self.values)
        finding = "holds" if self.holds else "FAILS"
        return f"{finding}  {self.text:<52}  {values}  at most {self.limit:.2e}"


def prepare(rng: int) -> tuple[NDArray, list[simulate.VirtualExperiment]]:
    """Make a sensor and its three experiments."""
    generator = np.random.default_rng(rng)
    truth = simulate.cosine_sensitivity(SHAPE, rng=generator)
    experiments = [
        simulate.experiment(
            truth,
            simulate.gaussian_beam(SHAPE),
            equipix.cross_pattern(*arms),
            frames=FRAMES,
            exposure_e=EXPOSURE_E,
            bit_depth=BIT_DEPTH,
            gain_dn_per_e=(2**BIT_DEPTH - 1) / FULL_SCALE_E,
            dead=0,
            hot=0,
            rng=generator,
        )
        for arms in ARMS
    ]
    return truth, experiments


def calibrate(virtual: simulate.VirtualExperiment) -> Found:
    """Average, subtract the dark, measure the shifts, calibrate; say what the noise predicts."""
    level = virtual.camera.full_scale
    dark = equipix.average(virtual.dark(), saturation=level)
    means = [
        equipix.average(virtual.frames(k), dark=dark, saturation=level)
        for k in range(len(virtual.positions))
    ]
    shifts = np.rint(measured_shifts(virtual))
    return Found(
        frame=means[0].mean,
        calibration=equipix.calibrate(means, shifts, tolerance=1e-5),
        noise=largest_noise(virtual),
        predicted=virtual.noise_prediction(rng=virtual.entropy)[0],
    )


def measured_shifts(virtual: simulate.VirtualExperiment) -> NDArray:
    """Add up the moves that the images of the hole show."""
    shifts = np.zeros((len(virtual.positions), 2))
    for k in range(1, len(shifts)):
        before, after = list(virtual.aperture_before(k)), list(virtual.aperture_after(k))
        move = equipix.measure_shift(before, after, saturation=virtual.camera.full_scale)
        shifts[k] = shifts[k - 1] + move.shift
    return shifts


def largest_noise(virtual: simulate.VirtualExperiment) -> float:
    """Largest standard deviation of a mean over its frames, relative to the signal."""
    camera = virtual.camera
    signal = simulate.exposures(camera.response, virtual.beam, virtual.positions)
    return float(np.max(np.sqrt(virtual.variance_of_mean()) / (camera.gain_dn_per_e * signal)))


def calibrate_all(experiments: list[simulate.VirtualExperiment]) -> list[Found]:
    """Do the experiments side by side: each has random numbers of its own."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(calibrate, experiments))


def check(truth: NDArray, found: list[Found]) -> list[Claim]:
    """Compare the maps with each other and with the truth."""
    pairs = list(combinations(found, 2))
    errors = [metrics.relative_error(one.calibration.sensitivity, truth) for one in found]
    ratios = [rms(error) / one.predicted for error, one in zip(errors, found, strict=True)]
    blocks = [rms(metrics.block_means(error)) for error in errors]
    largest = [float(abs(_row(one) - _row(other)).max()) for one, other in pairs]
    surplus = [_surplus(one, other) for one, other in pairs]
    return [
        Claim(f"noise of a mean over {FRAMES} frames", [one.noise for one in found], 3e-4),
        Claim(f"largest difference of two maps, row {ROW}", largest, AGREEMENT),
        Claim("rms difference of two maps, off the prediction by", surplus, 0.05),
        Claim("rms error of a map, over the prediction", ratios, 1.1),
        Claim("rms error of 16×16 block means", blocks, 6e-5),
    ]


def rms(values: NDArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _row(found: Found) -> NDArray:
    return found.calibration.sensitivity[ROW]


def _surplus(first: Found, second: Found) -> float:
    """How far the difference of two maps is from what noise predicts, as a share of that."""
    maps = (one.calibration.sensitivity for one in (first, second))
    predicted = np.hypot(first.predicted, second.predicted)
    return float(abs(rms(metrics.relative_error(*maps)) / predicted - 1))


def draw_figure_5(found: list[Found]) -> Figure:
    """Draw a part of row 50 of three sensitivities, and how they differ along all of it."""
    figure = Figure(figsize=(10, 6.6), layout="constrained")
    part, whole = figure.subplots(2, 1)
    columns = np.arange(found[0].frame.shape[1])
    names = [f"{first}, {second}" for first, second in ARMS]
    for name, one, line in zip(names, found, LINES, strict=True):
        part.plot(columns[COLUMNS], _row(one)[COLUMNS], **line, label=f"shifts {name}")
    part.set(title=f"sensitivity M, row {ROW}", xlim=columns[COLUMNS][[0, -1]], ylim=(0.94, 1.09))
    whole.axhspan(-AGREEMENT, AGREEMENT, color=LIGHT, alpha=0.3, lw=0, label="±1e-3")
    for (i, j), colour in zip(combinations(range(3), 2), (INK, BEFORE, AFTER), strict=True):
        label = f"({names[i]}) − ({names[j]})"
        whole.plot(columns, _row(found[i]) - _row(found[j]), color=colour, lw=0.7, label=label)
    whole.set(title=f"differences of M, row {ROW}", xlabel="column", xlim=columns[[0, -1]])
    whole.set_ylim(-1.7 * AGREEMENT, 1.7 * AGREEMENT)
    whole.ticklabel_format(axis="y", scilimits=(-3, -3), useMathText=True)
    for axes in (part, whole):
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", ncols=4)
    return figure


def main() -> int:
    """Do the experiments, draw them into the folder of this file, print the claims."""
    truth, experiments = prepare(50)
    found = calibrate_all(experiments)
    draw_maps(found[0].frame, found[0].calibration, ROW).savefig(FOLDER / "figure4.png", **SAVED)
    draw_figure_5(found).savefig(FOLDER / "figure5.png", **SAVED)
    claims = check(truth, found)
    print(
        f"shifts {' and '.join(map(str, ARMS))}; of two maps: 1st and 2nd, 1st and 3rd, 2nd and 3rd"
    )
    print(*claims, sep="\n")
    return 0 if all(claim.holds for claim in claims) else 1


if __name__ == "__main__":
    sys.exit(main())
