"""Type aliases, each once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called as ``progress(done, total, stage)``; an exception in it stops the work."""

Rng: TypeAlias = np.random.Generator | int
"""A generator of random numbers, or its seed."""

Method = Literal["multiscale", "coordinate-descent"]
FluxModel = Literal["fit", "linear"]
ShiftSign = Literal["confirmed", "contradicted", "undetermined"]
Flagged = Literal["nan", "keep", "replace"]
"""The values of pixels flagged ``DO_NOT_USE`` in corrected frames."""
Display = Literal["linear", "histogram"]
"""Tone laws of pictures."""

OutputType = Literal["float32", "uint16", "uint8"]
"""Types of corrected frames."""

By = Literal["offset", "gain"]
"""What a one-point correction changes."""

Order = Literal[0, 1, 2, 3, "auto"]
"""Order of response curves, or that which predicts a held-out level best."""
