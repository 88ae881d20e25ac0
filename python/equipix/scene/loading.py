"""The methods by name, and states read from files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equipix.errors import FileError
from equipix.scene.descent import Gated, LocalMean
from equipix.scene.registered import Registered
from equipix.scene.saved import read_state
from equipix.scene.statistics import ConstantStatistics, Kalman

if TYPE_CHECKING:
    from os import PathLike

    from equipix.scene.adaptive import SceneCorrection

METHODS: dict[str, type[SceneCorrection]] = {
    each.method: each for each in (LocalMean, Gated, Registered, ConstantStatistics, Kalman)
}
"""The class of each method by its name."""


def load(
    path: str | PathLike[str],
    *,
    shape: tuple[int, int] | None = None,
    workers: int | None = None,
) -> SceneCorrection:
    """Read a state of any method from the file that `save` wrote.

    Parameters
    ----------
    path : str or path
        The file; its suffix, .tif or .npz, names the format.
    shape : tuple of int, optional
        Sizes of the sensor; a state of another size is refused.
    workers : int, optional
        Number of threads; by default one for each processor.

    Returns
    -------
    SceneCorrection
        In the state in which it was saved.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, or holds something else or a newer format.
    """
    maps, content = read_state(path, None, shape)
    if content["method"] not in METHODS:
        raise FileError(
            f"{path}: holds a state of '{content['method']}', expected {' or '.join(METHODS)}"
        )
    return METHODS[content["method"]].resumed(path, maps, content, workers)
