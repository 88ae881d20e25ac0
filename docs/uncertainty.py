"""Draw docs/uncertainty.png: the error map, and how errors compare with it; `make figures`.

Forty simulated experiments with 2 % of the pixels masked: the map, z-scores of pixels and of means
over 16×16 pixels beside a normal curve.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

import equipix
from equipix import simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

SHAPE = (120, 160)
SHIFTS = equipix.cross_pattern(11, 19)
NOISE, MASKED, EXPERIMENTS = 1e-3, 0.02, 40


def main() -> None:
    """Run the experiments and draw."""
    rng = np.random.default_rng(1)
    used = rng.random(SHAPE) >= MASKED
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    truth /= truth[used].mean()
    clean = simulate.exposures(truth, simulate.gaussian_beam(SHAPE), SHIFTS)
    number = np.add.outer(np.arange(SHAPE[0]) // 16 * 10, np.arange(SHAPE[1]) // 16)
    blocks = (number == np.arange(70)[:, None, None]) * used
    blocks = blocks / blocks.sum(axis=(1, 2), keepdims=True)
    pixels, means = [], []
    for index in range(EXPERIMENTS):
        frames = clean + NOISE * rng.standard_normal(clean.shape)
        options = {"variance": np.full(5, NOISE**2), "mask": ~used}
        cal = equipix.calibrate(frames, SHIFTS, uncertainty=index == 0, **options)
        if index == 0:
            std, std_of_blocks = cal.sensitivity_std, cal.std_of(blocks)
            made = cal.metadata["uncertainty"]
        pixels.append(((cal.sensitivity - truth) / std)[used])
        logarithm = np.where(used, np.log(cal.sensitivity / truth), 0)
        means.append(blocks.reshape(70, -1) @ logarithm.ravel() / std_of_blocks)
    figure = Figure(figsize=(12.4, 3.9), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.25, 1, 1))
    image = left.imshow(std / NOISE, cmap="viridis")
    figure.colorbar(image, ax=left, shrink=0.8)
    left.set_title(f"standard deviation of M over the noise\n{made['draws']} draws, exact to "
                   f"{made['relative_standard_error']:.1%}", fontsize=10)  # fmt: skip
    histogram(middle, np.concatenate(pixels), "pixels")
    histogram(right, np.concatenate(means), "means over 16×16 pixels")
    figure.savefig(Path(__file__).parent / "uncertainty.png", dpi=90, facecolor="white")


def histogram(axes: Axes, scores: NDArray[np.float64], what: str) -> None:
    """Draw z-scores beside a normal curve of standard deviation 1."""
    z = np.linspace(-4.5, 4.5, 200)
    axes.hist(scores, bins=60, range=(-4.5, 4.5), density=True, color="#9ecae1")
    axes.plot(z, np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi), color="#1f2430", lw=1)
    rms = np.sqrt(np.mean(scores**2))
    axes.set_title(f"(estimate − truth)/std, {what}\nrms {rms:.3f}", fontsize=10)
    axes.set_yticks([])


if __name__ == "__main__":
    main()
