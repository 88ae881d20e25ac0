"""The file of a calibration: from its fields to named arrays and JSON, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.colour import Colours
from equipix.io import check_format, check_pages, save_pages
from equipix.shifts import ROUNDING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from numpy.typing import NDArray

KIND = "calibration"
"""The kind in the metadata of the file."""

FORMAT = 2
"""Number of the file format; a file with a higher one is refused. Format 1 held no coefficients of
the beam and no verdicts, rotations only among the options, and the images of ``rejected`` one below
the other in one page."""

_MAPS: dict[str, type] = {
    "sensitivity": np.floating,
    "flags": np.uint32,
    "component_labels": np.integer,
}
_PLAIN = (
    "objective",
    "components",
    "sweeps",
    "converged",
    "error_estimate",
    "dark_is_fitted",
)
"""Fields that are JSON values as they are."""

_MAYBE, _SPLINE = {"dark", "sensitivity_std"}, {"beam_coefficients"}
_OPTIONAL = _MAYBE | _SPLINE


def save_fields(path: str | PathLike[str], fields: Mapping[str, Any], *, force: bool) -> None:
    """Write the attributes of a `Calibration` to a file; see `Calibration.save`."""
    content = {
        "format": FORMAT,
        "kind": KIND,
        "calibration": _numbers(fields),
        "metadata": fields["metadata"],
    }
    save_pages(path, _pages(fields), content, force=force)


def read_fields(
    path: str | PathLike[str], pages: Mapping[str, NDArray[Any]], content: dict[str, Any]
) -> dict[str, Any]:
    """Make the attributes of a `Calibration` of the arrays and metadata that `save_fields` wrote.

    ``history`` holds the attributes of a `History`.

    Raises
    ------
    FileError
        If the format is newer than `FORMAT`, or a page is missing or does not fit.
    KeyError, TypeError, ValueError
        If a number is missing or is something else.
    """
    check_format(path, content, KIND, FORMAT)
    check_pages(path, pages, _MAPS | dict.fromkeys(_MAYBE & pages.keys(), np.floating))
    check_pages(path, pages, dict.fromkeys(["beam", *sorted(_SPLINE & pages.keys())], np.float64))
    if content["format"] == 1 and "rejected" in pages:
        images = pages["rejected"].reshape(-1, *pages["sensitivity"].shape)
        pages = {**pages, "rejected": images}
    stacks = dict.fromkeys({"rejected"} & pages.keys(), np.uint8)
    check_pages(path, pages, {"sensitivity": np.floating}, stacks)
    numbers = content["calibration"]
    if content["format"] == 1:
        options = content["metadata"]["options"]
        former = {"rotation": options["rotation"], "dark_is_fitted": options["dark"] == "fit"}
        numbers = {**numbers, **former, "verdicts": [], "beam_tilt": [0.0, 0.0]}
    chi2, rejected = numbers["reduced_chi2"], pages.get("rejected")
    _check_numbers(numbers, pages["beam"].shape)
    row, col = numbers["beam_origin"]
    return {
        **{name: pages[name] for name in ("sensitivity", "beam", "flags", "component_labels")},
        **{name: pages.get(name) for name in _OPTIONAL},
        **{name: numbers[name] for name in _PLAIN},
        **{name: _array(numbers[name]) for name in ("shifts", "flux", "beam_tilt")},
        **{name: _array(numbers.get(name)) for name in ("tilt_std", "shift_std")},
        "beam_origin": (row, col),
        "rotation": np.array(numbers["rotation"], dtype=np.int64),
        "verdicts": numbers["verdicts"],
        "reduced_chi2": float("nan") if chi2 is None else chi2,
        "shift_sign": numbers.get("shift_sign", "undetermined"),
        "orientation": numbers.get("orientation"),
        "drift": numbers.get("drift"),
        "cfa": Colours.of(numbers.get("cfa")),
        "colour_response": _responses(numbers.get("colour_response")),
        "history": _history(numbers["history"]),
        "rejected": None if rejected is None else rejected.astype(bool),
        "metadata": content["metadata"],
    }


def _check_numbers(numbers: Mapping[str, Any], grid: tuple[int, ...]) -> None:
    """Refuse numbers that cannot be those of a calibration."""
    count = len(numbers["flux"])
    if np.shape(numbers["shifts"]) != (count, 2) or len(numbers["rotation"]) != count:
        raise ValueError(f"shifts and rotations, expected those of {count} exposures")
    if not set(numbers["rotation"]) <= {0, 90, 180, 270}:
        raise ValueError(f"rotation {numbers['rotation']}, expected 0, 90, 180 or 270 degrees")
    origin = np.array(numbers["beam_origin"])
    if origin.shape != (2,) or origin.dtype.kind not in "if" or not _is_inside(origin, grid):
        raise ValueError(f"beam_origin {numbers['beam_origin']}, expected a place on {grid}")
    if not (_are_whole(origin) or _are_whole(origin + numbers["shifts"])):
        raise ValueError(f"beam_origin {numbers['beam_origin']}, expected exposures in cells")
    if np.shape(numbers["beam_tilt"]) != (2,):
        raise ValueError(f"beam_tilt {numbers['beam_tilt']}, expected two numbers")


def _is_inside(place: NDArray[Any], grid: tuple[int, ...]) -> bool:
    """Whether a place is in a cell of a grid, which reaches half of its side around it."""
    return bool(np.all((place >= -0.5) & (place <= np.subtract(grid, 0.5))))


def _are_whole(places: NDArray[Any]) -> bool:
    """Whether places are whole numbers, but for rounding."""
    return bool(np.all(np.abs(places - np.rint(places)) < ROUNDING))


def _pages(fields: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Collect the arrays of the size of the sensor, and the beam."""
    names = ("beam", *_MAPS, *sorted(_OPTIONAL))
    pages = {name: fields[name] for name in names if fields[name] is not None}
    if fields["rejected"] is not None:
        pages["rejected"] = fields["rejected"].astype(np.uint8)
    return pages


def _numbers(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Collect the rest as JSON values, which have neither NaN nor infinity."""
    chi2, tilt_std, shift_std = (fields[name] for name in ("reduced_chi2", "tilt_std", "shift_std"))
    history, orientation, drift = (fields[name] for name in ("history", "orientation", "drift"))
    if orientation is not None:
        changes = {"best": vars(orientation.best)}
        if orientation.hidden is not None:
            changes["hidden"] = vars(orientation.hidden)
        orientation = vars(orientation) | changes
    return {
        "beam_origin": list(fields["beam_origin"]),
        "shifts": fields["shifts"].tolist(),
        "flux": fields["flux"].tolist(),
        **{name: fields[name] for name in _PLAIN},
        "rotation": fields["rotation"].tolist(),
        "beam_tilt": fields["beam_tilt"].tolist(),
        "reduced_chi2": chi2 if np.isfinite(chi2) else None,
        "verdicts": [vars(verdict) for verdict in fields["verdicts"]],
        "shift_sign": fields["shift_sign"],
        "orientation": orientation,
        "drift": None if drift is None else _lists(vars(drift)),
        **_colours(fields),
        "tilt_std": None
        if tilt_std is None
        else [std if np.isfinite(std) else str(std) for std in tilt_std.tolist()],
        "shift_std": None if shift_std is None else shift_std.tolist(),
        "history": {
            "sweep": history.sweep.tolist(),
            "objective": history.objective.tolist(),
            "error_estimate": history.error_estimate.tolist(),
        },
    }


def _colours(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Collect the pattern of the filters and the responses of the colours, where there are any."""
    if fields["cfa"] is None:
        return {}
    found = fields["colour_response"].items()
    return {
        "cfa": fields["cfa"].rows,
        "colour_response": {label: value if value == value else None for label, value in found},
    }


def _responses(content: Mapping[str, float | None] | None) -> dict[str, float] | None:
    if content is None:
        return None
    return {label: float("nan") if value is None else value for label, value in content.items()}


def _lists(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Replace arrays by lists."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in fields.items()
    }


def _history(numbers: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    return {
        "sweep": np.array(numbers["sweep"], dtype=np.uint64),
        "objective": np.array(numbers["objective"]),
        "error_estimate": np.array(numbers["error_estimate"]),
    }


def _array(values: Any) -> NDArray[np.float64] | None:
    return None if values is None else np.array(values, dtype=np.float64)
