"""How much memory a worker needs for one manifest."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from equipix.batch.evaluation import Described
from equipix.experiment.camera import CameraExperiment
from equipix.experiment.experiment import Experiment
from equipix.experiment.image_files import format_of
from equipix.io.arrays import chunk_frames

PROCESS = 300_000_000
"""Bytes of a process with all that it imports."""


def bytes_needed(described: Described, options: Mapping[str, Any]) -> int:
    """Bytes of a worker at the peak.

    Measured at 12 and 48 megapixels beside `PROCESS`: 177 and 185 a pixel for five exposures
    between pixels.
    """
    first = described.files()[0]
    (rows, cols), dtype = format_of(first)
    pixels, count = rows * cols, len(described.manifest.measurements)
    of_pixel = 110 + 16 * count + (112 if options.get("uncertainty") else 0)
    if isinstance(described, CameraExperiment):
        of_pixel = 60
    elif not isinstance(described, Experiment):
        of_pixel = 100 + 16 * count
    # What is read is no longer there when the frames are averaged.
    frame = pixels * np.dtype(dtype).itemsize
    return PROCESS + max(of_pixel * pixels, 20 * pixels + reading(frame, chunk_frames(first)))


def reading(frame: int, chunk: int) -> int:
    """Bytes that a process needs to read frames of so many bytes, and to copy them."""
    return 2 * max(chunk * frame, 2**27)
