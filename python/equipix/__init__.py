"""Pixel sensitivity of image sensors, measured without a uniform light source."""

from equipix._native import __version__

__all__ = ["__version__"]
