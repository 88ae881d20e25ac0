"""What shifts between pixels cost against whole ones, and error bars after such a fit."""

from __future__ import annotations

import time

import numpy as np
from commands import Row

import equipix
from equipix import simulate

Array = np.ndarray

TOLERANCE = 1e-5

MANY = (25, 60)
"""Exposures of which the times are compared."""

NOISE = 1e-3
MASKED = 0.02
"""Share of masked pixels, in single pixels."""


def rows(shape: tuple[int, int] = (582, 782), repetitions: int = 3) -> list[Row]:
    """Compare calibrations between pixels with others, in turn."""
    rng = np.random.default_rng(0)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.wavy_beam(shape, rng=rng)
    whole = equipix.cross_pattern(11, 19)
    between = whole + rng.uniform(-0.5, 0.5, whole.shape)
    exact = [(shifts, simulate.exposures(truth, beam, shifts)) for shifts in (whole, between)]
    noisy = exact[1][1] + NOISE * rng.standard_normal(exact[1][1].shape)
    masked = rng.random(shape) < MASKED
    return [
        between_row(exact, repetitions),
        many_row(truth, beam, repetitions),
        error_bar_row(noisy, between, None, repetitions),
        error_bar_row(noisy, between, masked, repetitions),
    ]


def between_row(both: list[tuple[Array, Array]], repetitions: int) -> Row:
    """Time calibrations at whole and at fractional shifts, to the same tolerance."""
    times: list[list[float]] = [[], []]
    sweeps = [0, 0]
    for _ in range(repetitions):
        for index, (shifts, frames) in enumerate(both):
            start = time.perf_counter()
            cal = equipix.calibrate(frames, shifts, tolerance=TOLERANCE)
            times[index].append(time.perf_counter() - start)
            sweeps[index] = cal.sweeps
    whole_s, between_s = (float(np.median(each)) for each in times)
    return (
        f"shifts between pixels, {named(both[0][1])} float64, to {TOLERANCE:.0e}",
        "<= 3 x whole shifts",
        f"{between_s / whole_s:.1f} x",
        f"{between_s:.2f} s, {sweeps[1]} passes; {whole_s:.3f} s, {sweeps[0]} passes; medians "
        f"of {repetitions} in turn",
    )


def many_row(truth: Array, beam: Array, repetitions: int) -> Row:
    """Compare a core's time an exposure and pass at many positions with that at fewer."""
    rng = np.random.default_rng(3)
    found: list[list[float]] = [[], []]
    cases = []
    for count in MANY:
        shifts = rng.uniform(-30, 30, (count, 2))
        cases.append((shifts, simulate.exposures(truth, beam, shifts)))
    for _ in range(repetitions):
        for (shifts, frames), times in zip(cases, found, strict=True):
            start = time.process_time()
            sweeps = equipix.calibrate(frames, shifts, tolerance=TOLERANCE).sweeps
            times.append((time.process_time() - start) / len(shifts) / sweeps)
    fewer, many = (float(np.median(each)) for each in found)
    return (
        f"a core's time an exposure and pass between pixels, {truth.shape[1]}×{truth.shape[0]}, "
        f"{MANY[1]} exposures over {MANY[0]}",
        "<= 1.1 x",
        f"{many / fewer:.2f} x",
        f"{many * 1e3:.2f} ms, {fewer * 1e3:.2f} ms; medians of {repetitions} in turn",
    )


def error_bar_row(frames: Array, shifts: Array, mask: Array | None, repetitions: int) -> Row:
    """Time calibrations between pixels with and without error bars."""
    variance = np.full(len(shifts), NOISE**2)
    seconds = []
    for _ in range(repetitions):
        start = time.perf_counter()
        equipix.calibrate(frames, shifts, variance=variance, mask=mask)
        fit = time.perf_counter() - start
        equipix.calibrate(frames, shifts, variance=variance, mask=mask, uncertainty=True)
        seconds.append((fit, time.perf_counter() - start - 2 * fit))
    fit, extra = np.median(seconds, axis=0)
    masked = "" if mask is None else f", {np.mean(mask):.0%} of the pixels masked"
    return (
        f"error map and tilt between pixels, {named(frames)} float64{masked}",
        "<= 4 fits",
        f"{extra / fit:.1f} fits",
        f"{extra:.2f} s, fit {fit:.2f} s; medians of {repetitions}",
    )


def named(frames: Array) -> str:
    """Sizes of some exposures."""
    count, height, width = frames.shape
    return f"{width}×{height}×{count}"


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
