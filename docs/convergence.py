"""Follow both methods for docs/method.md: `make figures`, or ``python docs/convergence.py``.

- convergence.png: the error of M against sweeps and products, and its estimate
- the same in figures: printed
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from figures import AFTER, BEFORE, FOLDER, INK, LIGHT, SAVED
from matplotlib.figure import Figure

import equipix
from equipix import metrics, simulate

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

ARMS = (11, 19)
SIZES = {(240, 320): LIGHT, (582, 782): BEFORE, (1164, 1564): AFTER}
"""Sensors, and the colours of their curves."""
SWEEPS = {
    (240, 320): (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 3000),
    (582, 782): (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000),
    (1164, 1564): (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000),
}
"""Where coordinate descent is stopped."""
PRODUCTS = (1, *range(2, 20, 2), *range(20, 73, 4))
"""Where multiscale is stopped, unless it has ended."""


def hard_case(shape: tuple[int, int], arms: tuple[int, int] = ARMS) -> tuple[NDArray, NDArray]:
    """Make a sensor with 5 % of cosine over its whole size, and noise-free exposures of it."""
    truth = simulate.cosine_sensitivity(shape, rng=1)
    beam = simulate.gaussian_beam(shape, width=1000 * max(1, shape[1] / 782))
    return truth, simulate.exposures(truth, beam, equipix.cross_pattern(*arms))


def stopped(frames: NDArray, shifts: NDArray, method: str, limit: int) -> equipix.Calibration:
    """Calibrate with at most so many sweeps: those of a longer run, as far as they go."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", equipix.errors.ConvergenceWarning)
        # Of even light without noise all exposures are equal.
        warnings.simplefilter("ignore", equipix.errors.MisfitWarning)
        return equipix.calibrate(frames, shifts, method=method, max_sweeps=limit)


@dataclass(frozen=True, eq=False)
class Curve:
    """Largest error of M, and its estimate, where a method was stopped."""

    sweeps: list[int]
    error: list[float]
    estimate: list[float]

    def sweeps_to(self, error: float) -> str:
        """Fewest sweeps or products at which the error was found to be that small."""
        enough = [s for s, e in zip(self.sweeps, self.error, strict=True) if e <= error]
        return str(enough[0]) if enough else "-"


def follow(truth: NDArray, frames: NDArray, method: str, limits: Iterable[int]) -> Curve:
    """Stop a method at each limit until it ends by itself."""
    curve = Curve([], [], [])
    for limit in limits:
        found = stopped(frames, equipix.cross_pattern(*ARMS), method, limit)
        error = metrics.relative_error(found.sensitivity, truth)
        curve.sweeps.append(found.sweeps)
        curve.error.append(float(np.abs(error).max()))
        curve.estimate.append(found.error_estimate)
        if found.converged:
            break
    return curve


def draw_convergence(descents: dict[Any, Curve], fast: dict[Any, Curve]) -> Figure:
    """Draw error and estimate against sweeps, and against products."""
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, curves in ((left, descents), (right, fast)):
        for (rows, cols), curve in curves.items():
            line = {"color": SIZES[rows, cols], "marker": "o", "ms": 3}
            axes.semilogy(curve.sweeps, curve.error, **line, label=f"{cols}×{rows}")
            axes.semilogy(curve.sweeps, curve.estimate, color=line["color"], ls=":", lw=2)
        axes.plot([], [], color=INK, ls=":", lw=2, label="the estimate")
        axes.grid(alpha=0.3)
        axes.legend(loc="lower left")
    left.set(xscale="log", xlabel="sweeps", ylabel="largest relative error of M")
    left.set_title("coordinate descent")
    right.set(xlabel="products", title="multiscale, tolerance 1e-6", ylim=(1e-9, 3))
    return figure


def show(name: str, curves: dict[Any, Curve]) -> None:
    """Print the curves of a method."""
    for (rows, cols), curve in curves.items():
        marks = "  ".join(f"{e:g}: {curve.sweeps_to(e):>5}" for e in (1e-3, 1e-4, 1e-6))
        print(f"{name:<18} {cols}×{rows}  error {marks}  ended at {curve.sweeps[-1]}")
        for row in zip(curve.sweeps, curve.error, curve.estimate, strict=True):
            print("    {:6d}  error {:.1e}  estimate {:.1e}".format(*row))


def main() -> None:
    """Measure, print, and draw into the folder of this file."""
    cases = {shape: hard_case(shape) for shape in SIZES}
    descents = {s: follow(*cases[s], "coordinate-descent", SWEEPS[s]) for s in SIZES}
    fast = {s: follow(*cases[s], "multiscale", PRODUCTS) for s in SIZES}
    show("coordinate descent", descents)
    show("multiscale", fast)
    draw_convergence(descents, fast).savefig(FOLDER / "convergence.png", **SAVED)


if __name__ == "__main__":
    main()
