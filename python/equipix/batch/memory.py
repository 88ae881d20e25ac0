"""How much memory a worker needs for one manifest."""

from collections.abc import Mapping
from typing import Any

from equipix.batch.evaluation import Described
from equipix.experiment.camera import CameraExperiment
from equipix.experiment.experiment import Experiment
from equipix.experiment.image_files import format_of

PROCESS = 300_000_000
"""Bytes of a process with all that it imports."""


def bytes_needed(described: Described, options: Mapping[str, Any]) -> int:
    """Bytes of a worker at the peak.

    Measured at 12 and 48 megapixels: 205 to 220 a pixel for five exposures between pixels.
    """
    (rows, cols), _ = format_of(described.files()[0])
    pixels, count = rows * cols, len(described.manifest.measurements)
    if isinstance(described, CameraExperiment):
        return PROCESS + 60 * pixels
    if not isinstance(described, Experiment):
        return PROCESS + (100 + 16 * count) * pixels
    of_error_map = 112 if options.get("uncertainty") else 0
    return PROCESS + (150 + 16 * count + of_error_map) * pixels
