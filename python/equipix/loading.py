"""Reading back what equipix has saved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.calibration.result import FORMAT, Calibration, History
from equipix.errors import FileError
from equipix.io import check_format, check_pages, load_pages

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import NDArray

_MAPS: dict[str, type] = {
    "sensitivity": np.floating,
    "flags": np.uint32,
    "component_labels": np.integer,
}
_OPTIONAL = {"dark", "sensitivity_std"}


def load(path: str | PathLike[str]) -> Calibration:
    """Read a calibration that `Calibration.save` wrote.

    Parameters
    ----------
    path : str or path
        The file; its suffix, .tif or .npz, names the format.

    Returns
    -------
    Calibration
        As it was saved, bit by bit.

    Raises
    ------
    FileError
        If the file cannot be read, holds something else, or was written in a newer format.
    """
    pages, content = load_pages(path)
    check_format(path, content, "calibration", FORMAT)
    check_pages(path, pages, _MAPS | dict.fromkeys(_OPTIONAL & pages.keys(), np.floating))
    check_pages(path, pages, {"beam": np.floating})
    try:
        return _calibration(pages, content)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path}: damaged or incomplete calibration: {error!r}") from error


def _calibration(pages: dict[str, NDArray[Any]], content: dict[str, Any]) -> Calibration:
    numbers = content["calibration"]
    history = numbers["history"]
    row, col = numbers["beam_origin"]
    chi2 = numbers["reduced_chi2"]
    tilt_std, shift_std = numbers.get("tilt_std"), numbers.get("shift_std")
    rejected = pages.get("rejected")
    return Calibration(
        sensitivity=pages["sensitivity"],
        beam=pages["beam"],
        beam_origin=(row, col),
        beam_coefficients=None,
        rotation=np.array(content["metadata"]["options"]["rotation"]),
        dark_is_fitted=content["metadata"]["options"]["dark"] == "fit",
        flags=pages["flags"],
        shifts=np.array(numbers["shifts"], dtype=np.float64),
        flux=np.array(numbers["flux"], dtype=np.float64),
        objective=numbers["objective"],
        reduced_chi2=float("nan") if chi2 is None else chi2,
        components=numbers["components"],
        component_labels=pages["component_labels"],
        sweeps=numbers["sweeps"],
        converged=numbers["converged"],
        error_estimate=numbers["error_estimate"],
        shift_sign=numbers.get("shift_sign", "undetermined"),
        history=History(
            np.array(history["sweep"], dtype=np.uint64),
            np.array(history["objective"]),
            np.array(history["error_estimate"]),
        ),
        dark=pages.get("dark"),
        metadata=content["metadata"],
        sensitivity_std=pages.get("sensitivity_std"),
        tilt_std=None if tilt_std is None else np.array(tilt_std, dtype=np.float64),
        shift_std=None if shift_std is None else np.array(shift_std, dtype=np.float64),
        rejected=None
        if rejected is None
        else rejected.reshape(-1, *pages["sensitivity"].shape).astype(bool),
    )
