"""Updates of the corrections from the scene, for `make bench`."""

from __future__ import annotations

import os
import time

import numpy as np

from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneCorrection
from equipix.simulate import MovingScene

SHAPE, FRAMES, PASSES = (512, 640), 24, 8
FAST = ("local-mean", "gated")
"""Methods of which more frames a second are wanted than of the others."""


def rows(
    *, shape: tuple[int, int] = SHAPE, frames: int = FRAMES, passes: int = PASSES
) -> list[tuple[str, str, str, str]]:
    """Measure an update of each method, and give the table's rows: work, wanted, got, how.

    The larger frames are four of a scene beside one another, since scenes have a largest size.
    """
    moving = MovingScene(seed=1, shape=shape)
    values = [
        np.clip(2**14 + 2**13 * frame.values, 0, 2**16 - 1).astype(np.uint16)
        for frame in moving.frames(frames)
    ]
    larger = [np.tile(frame, (2, 2)) for frame in values]
    return [
        *_rows(values, passes, fast=500, others=100),
        *_rows(larger, passes, fast=60, others=60),
    ]


def _rows(
    values: list[np.ndarray], passes: int, *, fast: int, others: int
) -> list[tuple[str, str, str, str]]:
    threads, shape = len(os.sched_getaffinity(0)), values[0].shape
    found = []
    for name, method in METHODS.items():
        made = method(shape, data_range=(2**14, 2**14 + 2**13))  # type: ignore[call-arg]
        seconds = [_seconds(made, frame) for _ in range(passes) for frame in values]
        median = float(np.median(seconds))
        found.append(
            (
                f"an update of scene {name}, {shape[1]}×{shape[0]}, 16 bits",
                f">= {fast if name in FAST else others} frames/s",
                f"{1 / median:.0f} frames/s",
                f"median of {len(seconds)}, {median * 1e3:.2f} ms, {threads} threads",
            )
        )
    return found


def _seconds(method: SceneCorrection, frame: np.ndarray) -> float:
    start = time.perf_counter()
    method.update(frame)
    return time.perf_counter() - start
