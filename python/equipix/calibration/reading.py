"""A calibration from the file that `Calibration.save` wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.calibration.history import History
from equipix.calibration.lamp_drift import Drift
from equipix.calibration.orientation import OrientationTest
from equipix.calibration.result import Calibration
from equipix.calibration.saved import read_fields
from equipix.calibration.verdicts import Verdict
from equipix.exposures.orientation import Orientation

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from numpy.typing import NDArray


def read_calibration(
    path: str | PathLike[str], pages: Mapping[str, NDArray[Any]], content: dict[str, Any]
) -> Calibration:
    """Make a calibration of the arrays and metadata of the file that `Calibration.save` wrote."""
    fields = read_fields(path, pages, content)
    verdicts = tuple(Verdict(**each) for each in fields["verdicts"])
    made = {
        "history": History(**fields["history"]),
        "orientation": _read_orientation(fields["orientation"]),
        "drift": _read_drift(fields["drift"]),
        "verdicts": verdicts,
    }
    return Calibration(**{**fields, **made})


def _read_orientation(content: dict[str, Any] | None) -> OrientationTest | None:
    if content is None:
        return None
    ways = {name: content.get(name) for name in ("best", "hidden")}
    made = {name: Orientation(**way) for name, way in ways.items() if way is not None}
    return OrientationTest(**{**content, **made})


def _read_drift(content: dict[str, Any] | None) -> Drift | None:
    if content is None:
        return None
    names = ("slope_covariance", "tilt_std", "trend_tilt")
    arrays = {name: np.array(content[name]) for name in names}
    return Drift(**{**content, **arrays})
