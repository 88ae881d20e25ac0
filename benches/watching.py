"""`equipix.Running` while the camera works: a frame more, what is determined, the next position."""

from __future__ import annotations

import time

import numpy as np
from commands import Row

import equipix
from equipix import simulate

SHIFTS = np.array([(0, 0), (0, 11), (0, 19), (11, 0), (19, 0), (40, 33)], float)


def rows(
    shape: tuple[int, int] = (582, 782), *, frames: int = 8, repetitions: int = 3
) -> list[Row]:
    """Time each call after the last position, and `calibrate` of the same averages."""
    light = simulate.exposures(
        simulate.paper_sensitivity(shape, rng=1), simulate.gaussian_beam(shape), SHIFTS
    )
    light *= 3000 / light.max()
    found = np.array([timed(light, frames, seed) for seed in range(repetitions)])
    add, estimate, needed, calibrate = np.median(found, axis=0)
    size = f"{shape[1]}×{shape[0]}"
    last = f"six positions of {frames} frames, median of {repetitions}"
    return [
        (f"Running.add of a frame of {size}", "<= 40 ms", f"{1e3 * add:.0f} ms", "the slowest"),
        (
            f"Running.estimate of {size}",
            "<= 1 s",
            f"{estimate:.2f} s",
            f"{last}; calibrate of their averages takes {calibrate:.2f} s",
        ),
        (f"Running.needed of {size}", "<= 5 s", f"{needed:.2f} s", last),
    ]


def timed(light: np.ndarray, frames: int, seed: int) -> tuple[float, float, float, float]:
    """Seconds of the slowest `add`, of `estimate`, `needed` and `calibrate`."""
    rng = np.random.default_rng(seed)
    running = equipix.Running(light.shape[1:], saturation=4095)
    for _ in range(frames):
        running.add(taken(np.zeros(light.shape[1:]), rng), None)
    adding, averages = [], []
    for position, signal in zip(SHIFTS, light, strict=True):
        stack = np.array([taken(signal, rng) for _ in range(frames)])
        averages.append(stack.mean(axis=0) - 100)
        if len(averages) == len(SHIFTS):
            running.estimate()
        for frame in stack:
            started = time.perf_counter()
            running.add(frame, position)
            adding.append(time.perf_counter() - started)
    started = time.perf_counter()
    running.estimate()
    estimated = time.perf_counter()
    running.needed()
    needed = time.perf_counter()
    equipix.calibrate(averages, SHIFTS)
    calibrated = time.perf_counter()
    return (max(adding), estimated - started, needed - estimated, calibrated - needed)


def taken(signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A frame of a camera of 0.3 DN an electron, read noise 2 DN and a pedestal of 100 DN."""
    noise = np.sqrt(0.3 * signal + 4) * rng.standard_normal(signal.shape)
    return np.clip(np.rint(100 + signal + noise), 0, 4095).astype(np.uint16)


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
