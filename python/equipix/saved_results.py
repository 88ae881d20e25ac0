"""Results of all kinds, read from the files that they were saved to."""

from os import PathLike
from pathlib import Path
from typing import Any

from equipix.bolometer.dynamic import DynamicCorrection
from equipix.calibration.result import Calibration
from equipix.correction.polynomial import Polynomial
from equipix.correction.protocol import Correction
from equipix.errors import FileError, InputError
from equipix.hardware import table
from equipix.io import formats
from equipix.io.frames import has_format
from equipix.io.paths import as_path
from equipix.io.record import read_record
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.response import Response
from equipix.scene.methods import resumed
from equipix.scene.scene_correction import SceneCorrection, SceneState

RECORDS = (Calibration, DynamicCorrection, FrameStatistics, Polynomial, Response, SceneState)

SUFFIXES = (*formats.SUFFIXES, *table.SUFFIXES)

READ = f"{formats.SAVED.replace(' or', ',')}, .bin, .hex or .h"
"""In words, what is read: of each format one suffix."""

_NO_CORRECTIONS = (
    (
        DynamicCorrection,
        "a dynamic correction",
        "save its correction(...) of a state, or give the state (--substrate-c)",
    ),
    (FrameStatistics, "frame statistics", "equipix correct subtracts them as --dark"),
    (SceneCorrection, "the state of a scene correction", "save its correction(), equipix scene -o"),
)
"""What is no correction, what a file of it holds, and what can be done with it."""


def load(path: str | PathLike[str]) -> Any:
    """Read a result from the file that its `save` wrote.

    Parameters
    ----------
    path : str or path
        The file; its suffix names the format: .tif, .npz, .fits, .nxs or .asdf, of a table of words
        .bin, .hex or .h.

    Returns
    -------
    Calibration, FrameStatistics, Polynomial, or another class that has a ``save``
        As it was saved, bit by bit. A correction from the scene goes on learning from there, with
        all processors: `workers` is no part of its state, and changes no bit of a result.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, holds something else, or is of another version.
    InputError
        If the suffix is another.
    """
    suffix = as_path("path", path).suffix.lower()
    if suffix not in SUFFIXES:
        frames = ". Images are for equipix average" if has_format(Path(path)) else ""
        raise InputError(f"{path}: ends in '{suffix}', expected the suffix {READ}{frames}")
    if suffix in table.SUFFIXES:
        return table.read_table(path)
    found = read_record(path, *RECORDS)
    return resumed(path, found) if isinstance(found, SceneState) else found


def load_correction(
    path: str | PathLike[str], *, substrate_c: float | None = None, bias_v: float | None = None
) -> Correction:
    """Read a correction, and refuse results that are none.

    The parameters and errors are those of `load`, and of a state those of
    `DynamicCorrection.correction`; the bias must be given where several were calibrated.
    """
    found = load(path)
    state = {"substrate_c": substrate_c, "bias_v": bias_v}
    given = {name: value for name, value in state.items() if value is not None}
    if given and isinstance(found, DynamicCorrection):
        low, high = found.axes.bias_v
        for name in state if low < high else ["substrate_c"]:
            if name not in given:
                raise InputError(f"'{name}' is missing, but {path} follows it: give its value")
        return found.correction(given["substrate_c"], bias_v)
    if given:
        raise InputError(
            f"'{next(iter(given))}' is given, but {path} follows neither temperature nor bias: "
            "leave it out"
        )
    for kind, held, words in _NO_CORRECTIONS:
        if isinstance(found, kind):
            raise FileError(f"{path}: holds {held}, expected a correction: {words}")
    correction: Correction = found
    return correction
