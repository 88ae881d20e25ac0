"""Corrections in a camera's electronics: tables of words, their quality, the adaptive loop."""

from equipix.hardware.loop import AdaptiveLoop
from equipix.hardware.quality import quality, smallest_widths
from equipix.hardware.table import Table

__all__ = ["AdaptiveLoop", "Table", "quality", "smallest_widths"]
__dir__ = __all__.copy
