"""Colours of the filters in front of the pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from equipix._check import Array, ArrayLike, Bools, Floats
from equipix.errors import InputError

LARGEST_PERIOD = 8
"""Most rows and columns after which a pattern repeats."""


@dataclass(frozen=True)
class Colours:
    """A pattern of colour filters that repeats over the sensor from pixel (0, 0) on.

    Attributes
    ----------
    pattern : tuple of tuple of str
        Label of each pixel of one period, by rows. Pixels of one label are of one colour: in RGGB
        both greens.
    """

    pattern: tuple[tuple[str, ...], ...]

    @classmethod
    def of(cls, cfa: ArrayLike | Colours | None) -> Self | None:
        """Read a pattern; see `equipix.calibrate`.

        Parameters
        ----------
        cfa : str, array_like of labels or None
            Four letters are two rows of two: "RGGB". More rows are divided by "/", and one alone
            ends with it: "RGBW/". Or a sequence of texts, or an array of labels (rows, cols).

        Returns
        -------
        Colours or None
            The pattern; None of None.

        Raises
        ------
        InputError
            If it is no such pattern, or its period is above 8.
        """
        if cfa is None:
            return None
        rows = cfa.pattern if isinstance(cfa, Colours) else _rows(cfa)
        if not rows or len(set(map(len, rows))) != 1 or not rows[0] or not all(map(all, rows)):
            raise InputError(
                f"'cfa' is {cfa!r}, expected four letters such as 'RGGB', or rows of one length: "
                "'RRGG/RRGG/GGBB/GGBB', or an array of labels"
            )
        if max(len(rows), len(rows[0])) > LARGEST_PERIOD:
            raise InputError(
                f"'cfa' has a period of {len(rows)}×{len(rows[0])} pixels, expected at most "
                f"{LARGEST_PERIOD}×{LARGEST_PERIOD}"
            )
        return cls(rows)

    @property
    def period(self) -> tuple[int, int]:
        """Rows and columns after which the pattern repeats."""
        return len(self.pattern), len(self.pattern[0])

    @property
    def rows(self) -> list[list[str]]:
        """The pattern as a JSON value, which `of` reads."""
        return [list(row) for row in self.pattern]

    @property
    def written(self) -> str | list[list[str]]:
        """Text that `of` reads, or rows where a label is longer than a letter."""
        return str(self) if set(map(len, self.labels)) == {1} else self.rows

    @property
    def labels(self) -> tuple[str, ...]:
        """Each label once, in the order of reading."""
        return tuple(dict.fromkeys(label for row in self.pattern for label in row))

    def __str__(self) -> str:
        """Write the pattern as `of` reads it, where its labels are letters."""
        rows = ["".join(row) for row in self.pattern]
        if len(rows) == 1:
            return f"{rows[0]}/"
        return ("" if self.period == (2, 2) else "/").join(rows)

    def numbers(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """Number of the label of each pixel of a sensor of that shape (rows, cols)."""
        number = {label: k for k, label in enumerate(self.labels)}
        once = np.array([[number[label] for label in row] for row in self.pattern], np.uint8)
        repeats = [-(-size // step) for size, step in zip(shape, self.period, strict=True)]
        return np.ascontiguousarray(np.tile(once, repeats)[: shape[0], : shape[1]])

    def planes(self, shape: tuple[int, ...]) -> Iterator[tuple[str, Bools]]:
        """Give each label, with a map (rows, cols) of its pixels."""
        numbers = self.numbers(shape)
        for k, label in enumerate(self.labels):
            yield label, numbers == k

    def map_of(self, values: Mapping[str, float], shape: tuple[int, ...]) -> Floats:
        """Return a map (rows, cols) of the value that each pixel's colour has."""
        return np.array([values[label] for label in self.labels])[self.numbers(shape)]

    def means(self, image: Array, counted: Bools) -> dict[str, float]:
        """Mean of each colour over its pixels that are counted; NaN of none."""
        return {
            label: float(image[plane & counted].mean()) if (plane & counted).any() else np.nan
            for label, plane in self.planes(image.shape)
        }


def planes_of(colours: Colours | None, shape: tuple[int, ...]) -> Iterator[Bools]:
    """Give a map of the pixels of each colour; one of all pixels where there are no colours."""
    if colours is None:
        yield np.ones(shape, bool)
        return
    for _, plane in colours.planes(shape):
        yield plane


def _rows(cfa: ArrayLike) -> tuple[tuple[str, ...], ...]:
    """Rows of labels of a pattern as the caller gave it; none of what is no pattern."""
    if isinstance(cfa, str):
        divided = cfa.removesuffix("/").split("/")
        cfa = divided if "/" in cfa else [cfa[:2], cfa[2:]] if len(cfa) == 4 else []
    try:
        given = np.asarray(cfa)
    except ValueError:  # rows of several lengths
        return ()
    if given.ndim == 1 and given.dtype.kind == "U":
        return tuple(tuple(row) for row in given.tolist())
    if given.ndim == 2 and given.dtype.kind in "Uiu":
        return tuple(tuple(map(str, row)) for row in given.tolist())
    return ()
