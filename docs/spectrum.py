"""Take a sweep and the preconditioner apart for docs/method.md: ``python docs/spectrum.py``.

- spectrum.png: what one sweep removes of a wave, and what many leave along a row
- eigenvalues.png: what the second level does to the eigenvalues
- nearly periodic waves, and what damping does: printed
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from convergence import ARMS, hard_case, stopped
from figures import AFTER, BEFORE, FOLDER, INK, LIGHT, SAVED
from matplotlib.figure import Figure

import equipix
from equipix import metrics, simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

FULL = (582, 782)
CROSSES = ((5, 7), ARMS, (23, 41), (97, 160))
"""Of which the nearly periodic waves are sought, and the products are counted."""
PROFILES = {0: LIGHT, 20: BEFORE, 1000: AFTER, 5000: INK}
"""Sweeps after which a row of the error is drawn, at 782×582."""
DAMPINGS = (1.0, 0.5, 0.25)
DAMPED = (240, 320)
"""The sensor on which they are compared."""
SMALL, SMALL_ARMS = (48, 64), (5, 7)
"""A sensor whose eigenvalues can all be had."""


def symbol(q: NDArray, arms: tuple[int, int]) -> NDArray:
    """λ(q)/n of waves along a row."""
    shifts = equipix.cross_pattern(*arms)[:, 1]
    waves = np.exp(1j * np.multiply.outer(q, shifts))
    return 1 - np.abs(waves.mean(axis=-1)) ** 2


def removed(q: float, arms: tuple[int, int]) -> float:
    """Measure the share of a small wave along the rows that one sweep removes, off the borders."""
    shifts, wave = equipix.cross_pattern(*arms), np.exp(1j * q * np.arange(1024))
    truth = np.tile(1 + 1e-6 * wave.real, (64, 1))
    frames = np.array([truth] * len(shifts))
    found = stopped(frames, shifts, "coordinate-descent", 1).sensitivity
    inside = slice(shifts.max(), -shifts.max())
    basis = np.stack([np.ones(1024), wave.real, wave.imag], axis=1)[inside]
    return float(np.linalg.lstsq(basis, found[32, inside], rcond=None)[0][1] / 1e-6)


def dip(arms: tuple[int, int]) -> tuple[float, float, float]:
    """Cycles per pixel along rows and columns of the nearly periodic wave, and λ(q)/n there."""
    rows, cols = np.linspace(-0.5, 0.5, 2001)[:, None], np.linspace(0, 0.5, 1001)
    turns = (down * rows + right * cols for down, right in equipix.cross_pattern(*arms))
    values = 1 - np.abs(sum(np.exp(2j * np.pi * turn) for turn in turns) / 5) ** 2
    # Waves longer than the arms are the coarse space's.
    values[np.hypot(rows, cols) < 1 / arms[1]] = 1
    row, col = np.unravel_index(values.argmin(), values.shape)
    return float(rows[row, 0]), float(cols[col]), float(values.min())


def draw_spectrum(truth: NDArray, frames: NDArray) -> Figure:
    """Draw λ(q)/n with what one sweep removed, and a row of the error after many sweeps."""
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    frequencies = np.geomspace(1e-3, 0.5, 4000)
    for arms, colour in ((ARMS, BEFORE), (SMALL_ARMS, AFTER)):
        left.loglog(frequencies, symbol(2 * np.pi * frequencies, arms), color=colour, lw=1)
        marks = np.geomspace(2e-3, 0.47, 24)
        shares = [removed(2 * np.pi * mark, arms) for mark in marks]
        left.plot(marks, shares, "o", ms=4, color=colour, label=f"cross {arms}")
    left.set(xlabel="cycles per pixel", ylabel="share that a sweep removes", xlim=(1e-3, 0.5))
    left.set_title("λ(q)/n of waves along a row; dots: measured in one sweep")
    draw_profiles(right, truth, frames)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend(loc="lower right")
    right.legend(loc="upper left")
    return figure


def draw_profiles(axes: Axes, truth: NDArray, frames: NDArray) -> None:
    """Draw a row of the error of M after some sweeps."""
    row = len(truth) // 2
    for sweeps, colour in PROFILES.items():
        found = np.ones_like(truth)
        if sweeps:
            shifts = equipix.cross_pattern(*ARMS)
            found = stopped(frames, shifts, "coordinate-descent", sweeps).sensitivity
        error = metrics.relative_error(found, truth)[row]
        axes.plot(error, color=colour, lw=1.5 if sweeps else 0.7, label=f"{sweeps} sweeps")
    axes.set(xlabel="column", ylabel="relative error of M", xlim=(0, truth.shape[1] - 1))
    axes.set_title(f"row {row} of 782×582")


@dataclass(frozen=True)
class Operator:
    """S at the true M and L of a sensor: exposures of one weight and flux, without noise."""

    sensitivity: NDArray
    shifts: NDArray
    beam: NDArray

    @classmethod
    def of(cls, shape: tuple[int, int], arms: tuple[int, int]) -> Operator:
        """S of the sensor of `docs/method.md`, for a cross of positions."""
        shifts = equipix.cross_pattern(*arms)
        truth = simulate.cosine_sensitivity(shape, rng=1)
        beam = np.ones(np.add(shape, shifts.max(axis=0)))
        operator = cls(truth, shifts, beam)
        light = simulate.exposures(np.ones(shape), simulate.gaussian_beam(shape), shifts)
        for seen, exposure in zip(operator.views(beam), light, strict=True):
            seen[:] = exposure
        return operator

    def views(self, grid: NDArray) -> list[NDArray]:
        """The part of the beam's grid that each exposure sees."""
        rows, cols = self.sensitivity.shape
        return [grid[r : r + rows, c : c + cols] for r, c in self.shifts]

    def diagonal(self) -> NDArray:
        """D = Σ L²."""
        return np.sum([seen**2 for seen in self.views(self.beam)], axis=0)

    def product(self, x: NDArray) -> NDArray:
        """S·x = Σ L² (x − M h), with h = Σ M x / Σ M² over the pixels that see a cell."""
        above, below = np.zeros_like(self.beam), np.zeros_like(self.beam)
        for sums, values in ((above, self.sensitivity * x), (below, self.sensitivity**2)):
            for seen in self.views(sums):
                seen += values
        h = np.divide(above, below, where=below > 0, out=np.zeros_like(above))
        views = zip(self.views(self.beam), self.views(h), strict=True)
        return np.sum([beam**2 * (x - self.sensitivity * seen) for beam, seen in views], axis=0)


def hats_along(length: int, reach: int) -> NDArray:
    """Hats of one axis, shape (hats, length): three shifts apart, 8 pixels at least."""
    span = max(1, length - 1)
    nodes = np.linspace(0, span, max(1, span // max(8, 3 * reach)) + 1)
    return np.array([np.interp(np.arange(length), nodes, peak) for peak in np.eye(len(nodes))])


def two_levels(operator: Operator, damping: float) -> Callable[[NDArray], NDArray]:
    """P⁻¹ r = r/D + γ Φ A⁺ Φᵀ r, with Φ the hats times M and A = Φᵀ S Φ.

    A is singular: patterns that no shift sees are left out, to begin with the gauge.
    """
    m, diagonal = operator.sensitivity, operator.diagonal()
    reach = np.ptp(operator.shifts, axis=0)
    along = [hats_along(length, int(each)) for length, each in zip(m.shape, reach, strict=True)]
    hats = np.einsum("ir,jc->ijrc", *along).reshape(-1, *m.shape)
    phi = hats * m
    coarse = np.array([np.tensordot(phi, operator.product(hat), 2) for hat in phi])
    values, waves = np.linalg.eigh((coarse + coarse.T) / 2)
    seen = values > 1e-10 * np.tensordot(phi**2, diagonal, 2).max()
    inverse = waves[:, seen] / values[seen] @ waves[:, seen].T

    def precondition(residual: NDArray) -> NDArray:
        wave = np.tensordot(inverse @ np.tensordot(phi, residual, 2), hats, 1)
        return residual / diagonal + damping * m * (wave - wave.mean())

    return precondition


def dense(apply: Callable[[NDArray], NDArray], shape: tuple[int, int]) -> NDArray:
    """Matrix of a linear function of images."""
    size = shape[0] * shape[1]
    return np.array([apply(unit.reshape(shape)).ravel() for unit in np.eye(size)])


def eigenvalues(dampings: Iterable[float]) -> dict[float, NDArray]:
    """All eigenvalues of P⁻¹S for the small sensor, by γ, from the smallest; γ = 0: of D⁻¹S.

    With S = RRᵀ they are those of RᵀP⁻¹R. The gauge's, which is 0, is left out.
    """
    operator = Operator.of(SMALL, SMALL_ARMS)
    values, waves = np.linalg.eigh(dense(operator.product, SMALL))
    root = waves[:, 1:] * np.sqrt(values[1:])
    found = {}
    for damping in dampings:
        inverse = dense(two_levels(operator, damping), SMALL)
        found[damping] = np.linalg.eigvalsh(root.T @ inverse.T @ root)
    return found


def draw_eigenvalues() -> Figure:
    """Draw the eigenvalues without the second level, and with it for some γ."""
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    axes = figure.subplots()
    styles = {0.0: (INK, "-"), 1.0: (AFTER, "--"), 0.25: (BEFORE, "-")}
    for damping, values in eigenvalues(styles).items():
        label = f"γ = {damping:g}" if damping else "diagonal alone"
        label += f": {values[0]:.4f} to {values[-1]:.2f}"
        colour, style = styles[damping]
        axes.loglog(np.arange(1, len(values) + 1), values, color=colour, ls=style, label=label)
    axes.axhline(1, color=INK, lw=0.6)
    axes.set(xlabel="number, from the smallest", ylabel="eigenvalue of P⁻¹S")
    axes.set_title(f"{SMALL[1]}×{SMALL[0]} pixels, cross {SMALL_ARMS}")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return figure


def extremes(shape: tuple[int, int], damping: float) -> tuple[float, float]:
    """Smallest and largest eigenvalue of P⁻¹S but the gauge's: Ritz values after 150 steps.

    Of Lanczos in the inner product of S, in which P⁻¹S is symmetric. It does not see the gauge,
    which would grow out of rounding unless it was taken out.
    """
    operator = Operator.of(shape, ARMS)
    precondition = two_levels(operator, damping)
    v = np.random.default_rng(1).standard_normal(shape)
    before, diagonal, beside = np.zeros(shape), [], []
    image = operator.product(v)
    for _ in range(150):
        norm = np.sqrt(np.vdot(v, image))
        v, image = v / norm, image / norm
        beside.append(norm)
        new = precondition(image)
        diagonal.append(np.vdot(new, image))
        before, v = v, new - diagonal[-1] * v - norm * before
        v -= operator.sensitivity * (v / operator.sensitivity).mean()
        image = operator.product(v)
    matrix = np.diag(diagonal) + np.diag(beside[1:], 1) + np.diag(beside[1:], -1)
    values = np.linalg.eigvalsh(matrix)
    return float(values[0]), float(values[-1])


def main() -> None:
    """Measure, print, and draw into the folder of this file."""
    for arms in CROSSES:
        (row, col, share), (_, frames) = dip(arms), hard_case(FULL, arms)
        needed = equipix.calibrate(frames, equipix.cross_pattern(*arms)).sweeps
        place = f"({row:.3f}, {col:.3f}) cycles per pixel"
        print(f"cross {arms}: λ/n dips to {share:.4f} at {place}; {needed} products to 1e-6")
    for damping in DAMPINGS:
        low, high = extremes(DAMPED, damping)
        print(f"γ = {damping:g}: eigenvalues {low:.4f} to {high:.2f}")
    draw_spectrum(*hard_case(FULL)).savefig(FOLDER / "spectrum.png", **SAVED)
    draw_eigenvalues().savefig(FOLDER / "eigenvalues.png", **SAVED)


if __name__ == "__main__":
    main()
