"""Levels of a uniform source on disk, as levels.toml describes them, and their evaluation."""

from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter

import numpy as np

from equipix._check import ArrayLike, By, Order, Progress, Words
from equipix.experiment.described import Described
from equipix.experiment.manifest import LevelManifest
from equipix.findings import Finding, say
from equipix.measured.defects import SIGMAS
from equipix.nuc.curve_fit import fitted
from equipix.nuc.levels import Levels, levels_of
from equipix.nuc.order import check_order
from equipix.nuc.response import Response


@dataclass(frozen=True)
class LevelExperiment(Described[LevelManifest]):
    """Frames of a uniform source at several levels, as files on disk.

    Attributes
    ----------
    path : Path
        The levels.toml.
    manifest : LevelManifest
        Its checked content.

    See Also
    --------
    equipix.nuc.fit : The same for averages and arrays in memory.

    Notes
    -----
    Frames and dark frames are named relative to the file: one file (a multi-page TIFF holds many
    frames; a saved average stands for the frames that it was made of), a glob or a list.
    ``[sensor]`` is that of an experiment.toml. Without ``[dark]`` the level without light is part
    of the curves.
    """

    _model, _words = LevelManifest, Words("[[level]]", "level")

    def run(
        self,
        *,
        order: Order = 1,
        by: By = "offset",
        mask: ArrayLike | None = None,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Response:
        """Fit the response curves to the files.

        Parameters
        ----------
        order : {0, 1, 2, 3, "auto"}
            Highest power of the array's mean, see `equipix.nuc.fit`.
        by : {"offset", "gain"}
            What a one-point correction changes.
        mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
            True = do not use, besides the pixels that the file excludes.
        workers : int, optional
            Number of threads; by default one for each processor.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` repeatedly.

        Returns
        -------
        Response
            With the dark frame, if there is one, and in `metadata` the sensor, the levels with
            their values and units, the noise and the hashes of the files.

        Raises
        ------
        FileError
            If a file cannot be read, the images differ in size or depth, a level saturates, or two
            files have the same content.
        InputError
            If an option is out of range, or the levels do not determine the curves.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Warns
        -----
        InputWarning
            If the single dark has another exposure time or temperature than levels by the headers
            of the files.
        MisfitWarning
            If the mean of a level is lower than that of a level with a lower value, beside the
            warnings of `equipix.nuc.fit`.
        """
        check_order(order, by)
        excluded, hashes = self._checked(mask)
        darks = self._darks(workers, progress)
        averaged = self._average(darks, workers, progress).counted_from_lowest()
        levels = levels_of(averaged, mask=excluded)
        said = say(*darks.findings)
        levels = replace(levels, findings=said + levels.findings)
        if words := self._falling(levels):
            said = say(Finding("light", words, "misfit"))
            levels = replace(levels, findings=levels.findings + said)
        means = map(float, levels.references)
        named = zip(self.manifest.names, self.manifest.level, means, darks.words, strict=True)
        written = [
            {"name": name, "value": level.value, "unit": level.unit, "mean": mean, "dark": dark}
            for name, level, mean, dark in named
        ]
        origin = self._provenance(hashes, averaged, levels=written)
        del averaged, darks  # their maps, before those of the curves are made
        return fitted(levels, order=order, by=by, workers=workers, provenance=origin)

    def _falling(self, levels: Levels) -> str | None:
        """Say which values of levels do not rise with the means by more than noise explains."""
        values = [level.value for level in self.manifest.level]
        sigmas = np.sqrt(levels.variances)
        entries = zip(values, self.manifest.names, levels.references, sigmas, strict=True)
        known = sorted((each for each in entries if each[0] is not None), key=itemgetter(0))
        for (_, below, least, one), (_, above, most, other) in pairwise(known):
            if most < least - SIGMAS * np.hypot(one, other):
                return (
                    f"{self.path}: the mean of the frames falls from {least:.6g} DN in level "
                    f"'{below}' to {most:.6g} DN in level '{above}', whose 'value' is higher: see "
                    "that each value is that of its frames"
                )
        return None
