"""Corrections in a camera's electronics: tables of words, their quality, the adaptive loop."""

from equipix.hardware.loop import Adaptive
from equipix.hardware.quality import Quality, Widths, quality, smallest_widths
from equipix.hardware.table import Table, read
from equipix.hardware.words import Format

__all__ = [
    "Adaptive",
    "Format",
    "Quality",
    "Table",
    "Widths",
    "quality",
    "read",
    "smallest_widths",
]
