"""Colours of the filters in front of the pixels, and how pixels behind them respond."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from string import ascii_uppercase
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from equipix._check import Array, ArrayLike, Bools, Floats
from equipix.errors import InputError
from equipix.measured.noise import BLOCK, MEDIAN_SQUARE, block_medians, nanmedian, of_blocks
from equipix.measured.part import median

_LARGEST_PERIOD = 8
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
        if max(len(rows), len(rows[0])) > _LARGEST_PERIOD:
            raise InputError(
                f"'cfa' has a period of {len(rows)}×{len(rows[0])} pixels, expected at most "
                f"{_LARGEST_PERIOD}×{_LARGEST_PERIOD}"
            )
        return cls(rows)

    @property
    def period(self) -> tuple[int, int]:
        """Rows and columns after which the pattern repeats."""
        return len(self.pattern), len(self.pattern[0])

    @property
    def interval(self) -> str:
        """The period in words: "every 2 rows and 4 columns"."""
        counted = zip(self.period, ("rows", "columns"), strict=True)
        return f"every {' and '.join(f'{n} {axis}' for n, axis in counted if n > 1)}"

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

    def agrees(self, other: Colours) -> bool:
        """Whether another pattern is this one; it may divide a colour into several."""
        shape = tuple(np.lcm(self.period, other.period))
        own, given = (np.array(each.labels)[each.numbers(shape)].flat for each in (self, other))
        pairs = set(zip(own, given, strict=True))
        own_names = all(label == colour or label not in self.labels for colour, label in pairs)
        return own_names and len({label for _, label in pairs}) == len(pairs)

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


def planes_of(colours: Colours | None, shape: tuple[int, ...]) -> list[Bools]:
    """Give a map of the pixels of each colour; one of all pixels where there are no colours."""
    planes = [] if colours is None else [plane for _, plane in colours.planes(shape)]
    return planes or [np.ones(shape, bool)]


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


_SAMPLED = 128
"""Rows and columns in the middle of the sensor in which a pattern is looked for."""

_MEASURED = 512
"""Rows and columns in the middle of the sensor in which responses are measured."""

_FEWEST = 16
"""Least number of pixels in each place of the period."""

_FAINTEST = 0.02
"""Variance between the clipped means of places, over the squared scatter, which a pattern exceeds.
The scatter of two levels is at most 1.48 times their distance. With a share f of outliers in both,
means are then (1 − f)·0.67 apart: a variance of 0.028 where f = 1/2. That of noise alone is 1 over
the pixels of a place, some 256."""

_LEFT = 2.0
"""Variance that a pattern of a shorter period may leave, over that which the best one leaves."""

_ROUNDING = 1e-6
"""Relative scatter of an image without noise."""

_SIGMAS = 6.0
"""Standard errors that noise does not reach."""

_CONTRADICTS = 0.1
"""Spread of responses within given colours that two greens of one colour do not have."""

_APART = 0.05
"""Share of the range of responses that divides two colours."""


@dataclass(frozen=True)
class Filters:
    """Colours of the pixels and how they respond to the light of a measurement.

    Attributes
    ----------
    colours : Colours
        The pattern.
    response : dict of str to float
        Response of each colour; the mean over the pixels is 1.
    given : bool
        Whether the caller named the pattern, or the values alone show it.
    shown : Colours or None
        The pattern that the values show, where it contradicts the given one.
    """

    colours: Colours
    response: dict[str, float]
    given: bool = True
    shown: Colours | None = None

    @classmethod
    def of(
        cls, colours: Colours | None, image: Array, corner: tuple[int, int] = (0, 0)
    ) -> Filters | None:
        """Filters of a sensor by an image (rows, cols) of light without structure of few pixels.

        The image may be a part of the sensor that begins at `corner`. Where no colours are given
        those that stand out of the image; None where none do.
        """
        found = pattern_of(image, corner) if colours is None else colours
        if found is None:
            return None
        response = responses(found, image, corner)
        if colours is None:
            return cls(found, response, given=False)
        part, at = _middle(image, _MEASURED, corner)
        row, col = (each % period for each, period in zip(at, found.period, strict=True))
        usual = found.map_of(response, (row + part.shape[0], col + part.shape[1]))
        rest = cls.of(None, part / usual[row:, col:], at)
        contradicts = rest is not None and rest.spread > _CONTRADICTS
        return cls(found, response, shown=pattern_of(image, corner) if contradicts else None)

    @classmethod
    def shown_by(
        cls, colours: Colours | None, values: Array, mask: Bools | None = None
    ) -> Filters | None:
        """Filters of a sensor by the mean of its frames (n, rows, cols)."""
        if colours is None and pattern_of(*mean_signal(values, mask, _SAMPLED)) is None:
            return None
        return cls.of(colours, *mean_signal(values, mask))

    @property
    def words(self) -> str:
        """Name a pattern that only the values show, or other than the given one; or nothing."""
        if self.given and self.shown is None:
            return ""
        repeats = f"the response repeats {(self.shown or self.colours).interval}"
        if self.shown is not None:
            return (
                f"pixels of one colour of 'cfa' differ by more than {_CONTRADICTS:.0%}: {repeats} "
                f"otherwise than '{self.colours}', so colours are mixed: {advice(self.shown)}"
            )
        if min(self.colours.period) == 1:
            return (
                f"{repeats} by {self.spread:.0%}, as channels of the read-out have it, not "
                "colours. No pixel is flagged for it; see whether the gains of the channels are "
                "adjusted"
            )
        return (
            f"{repeats} by {self.spread:.0%}, as under colour filters, and no 'cfa' is given. No "
            "pixel is flagged for it, but M mixes the colours, and a corrected frame loses its "
            f"white balance: {advice(self.colours, self.response)}"
        )

    @property
    def spread(self) -> float:
        """Largest over smallest response, less 1."""
        return max(self.response.values()) / min(self.response.values()) - 1

    def map_of(self, shape: tuple[int, ...]) -> Floats:
        """Return a map (rows, cols) of the response of each pixel's colour."""
        return self.colours.map_of(self.response, shape)


def advice(colours: Colours, response: Mapping[str, float] | None = None) -> str:
    """Say which 'cfa' to write for a pattern that values show, by the responses if known."""
    named = _bayer(colours, response)
    write = " or ".join(f"cfa={each!r}" for each in named or [str(colours)])
    return (
        f"write {write} (in [sensor] of a manifest){', as the data sheet has it' if named else ''}"
    )


def mean_signal(
    values: Array, mask: Bools | None = None, most: int = _MEASURED
) -> tuple[Floats, tuple[int, int]]:
    """Mean over the frames (n, rows, cols) that have a usable value, else NaN, and its corner.

    Of the middle of the sensor, at most so many rows and columns: where responses are measured.
    """
    (row, col), (rows, cols) = _place(values.shape[1:], most)
    middle = np.s_[..., row : row + rows, col : col + cols]
    known = np.isfinite(values[middle])
    if mask is not None:
        known &= ~mask[middle]
    total = np.sum(values[middle], axis=0, dtype=np.float64, where=known)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / known.sum(axis=0)), (row, col)


def mean_rise(values: Array) -> tuple[Floats, tuple[int, int]]:
    """Rise of the middle of the sensor from the frame of lowest to that of highest median."""
    medians = [median(each) for each in values]
    low, high = int(np.argmin(medians)), int(np.argmax(medians))
    image, corner = mean_signal(values[high : high + 1])
    return image if low == high else image - mean_signal(values[low : low + 1])[0], corner


def responses(colours: Colours, image: Array, corner: tuple[int, int] = (0, 0)) -> dict[str, float]:
    """Response of each colour, of mean 1 over the pixels: ratios within blocks, their median.

    A colour without a pixel to measure, or without light, counts as 1.
    """
    part, (row, col) = _middle(image, _MEASURED, corner)
    shape = row + part.shape[0], col + part.shape[1]
    planes = {label: plane[row:, col:] for label, plane in colours.planes(shape)}
    of_colours = [np.where(plane, part, np.nan) for plane in planes.values()]
    means = np.array([block_medians(each, _size(part.shape)) for each in of_colours])
    share = np.array([each.mean() for each in planes.values()])[:, None, None]
    known = np.isfinite(means)
    weights = np.where(known, share, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = means * weights.sum(axis=0) / np.sum(weights * np.where(known, means, 0), axis=0)
    medians = nanmedian(np.where(np.isfinite(ratios), ratios, np.nan), axis=(1, 2))
    found = np.where(medians > 0, medians, 1.0)
    mean = sum(found * share.ravel())
    return dict(zip(planes, (found / mean).tolist(), strict=True))


def pattern_of(image: Array, corner: tuple[int, int] = (0, 0)) -> Colours | None:
    """Find a pattern of period 2 to 8 that stands out of an image; None where none does.

    The variance between the places of the period must exceed that of the pixels within a place: a
    smaller pattern flags nothing. Of periods that explain as much the shortest is taken.
    """
    part, corner = _levelled(image, corner)
    if not _may_repeat(part):
        return None
    steps = range(1, _LARGEST_PERIOD + 1)
    periods = [*product(steps, steps)][1:]
    places = {period: found for period in periods if (found := _Places.of(part, period))}
    left = {period: 1 / (1 + found.ratio) for period, found in places.items()}
    least = min(left.values(), default=1.0)
    if not least < 0.5:
        return None
    close = [period for period, rest in left.items() if rest <= _LEFT * least]
    period = min(close, key=lambda each: each[0] * each[1])
    turned = [at % step for at, step in zip(corner, period, strict=True)]
    colours = places[period].labelled(turned)
    return None if colours.period == (1, 1) else colours


def _may_repeat(image: Floats) -> bool:
    """Whether clipped means vary between the places of a period: no median does where they do not.

    Every period up to 8 divides one of 5 to 8, whose means vary no less.
    """
    known = np.isfinite(image)
    values = image[known]
    if not values.size:
        return False
    usual = np.median(values)
    scatter = np.sqrt(np.median((values - usual) ** 2) / MEDIAN_SQUARE) + _ROUNDING
    left = np.where(known, np.clip((image - usual) / scatter, -_SIGMAS, _SIGMAS), 0.0)
    longest = range(_LARGEST_PERIOD // 2 + 1, _LARGEST_PERIOD + 1)
    of_rows, of_cols = (
        [np.equal.outer(np.arange(period), np.arange(size) % period) * 1.0 for period in longest]
        for size in image.shape
    )
    for down, right in product(of_rows, of_cols):
        count = down @ known @ right.T
        if count.min() < _FEWEST or np.var(down @ left @ right.T / count) > _FAINTEST:
            return True
    return False


def _levelled(image: Array, corner: tuple[int, int]) -> tuple[Floats, tuple[int, int]]:
    """The middle of an image over medians of blocks, and where it begins on the sensor."""
    part, corner = _middle(image, _SAMPLED, corner)
    size = _size(part.shape)
    usual = of_blocks(block_medians(part, size), part.shape, size)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(usual > 0, part / usual, np.nan), corner


def _size(shape: Sequence[int]) -> int:
    """Side of the blocks of an image."""
    return min(BLOCK, *shape)


def _place(shape: Sequence[int], most: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corner and size of the middle, of whole blocks and at most so many pixels a side."""
    size = _size(shape)
    rows, cols = (min(most, each) // size * size for each in shape)
    return ((shape[0] - rows) // 2, (shape[1] - cols) // 2), (rows, cols)


def _middle(image: Array, most: int, corner: tuple[int, int]) -> tuple[Floats, tuple[int, int]]:
    """The middle of an image that begins at `corner`, and where the middle begins."""
    (row, col), (rows, cols) = _place(image.shape, most)
    part = np.asarray(image[row : row + rows, col : col + cols], np.float64)
    return np.where(np.isfinite(part), part, np.nan), (corner[0] + row, corner[1] + col)


class _Places(NamedTuple):
    """Medians (rows, cols) of the places of a period, and the scatter about them."""

    medians: Floats
    scatter: float
    error: float

    @classmethod
    def of(cls, image: Floats, period: tuple[int, int]) -> Self | None:
        """Take them from an image; None where pixels are few."""
        down, right = period
        rows, cols = image.shape[0] // down, image.shape[1] // right
        once = (down > 1 and rows < 2) or (right > 1 and cols < 2)
        if once or rows * cols < _FEWEST:
            return None
        cut = image[: rows * down, : cols * right].reshape(rows, down, cols, right)
        stack = cut.transpose(1, 3, 0, 2).reshape(down, right, -1)
        known = np.isfinite(stack)
        if known.sum(axis=2).min() < _FEWEST:
            return None
        medians = np.nanmedian(stack, axis=2)
        away = np.nanmedian(np.abs(stack - medians[..., None]), axis=2)
        scatter = float(np.sqrt(np.mean(away**2) / MEDIAN_SQUARE))
        # The variance of a median of N normal values is π/2 of that of their mean.
        return cls(medians, scatter, scatter * float(np.pi / 2 / known.sum(axis=2).min()) ** 0.5)

    @property
    def ratio(self) -> float:
        """Variance between the places over that within them."""
        between = max(float(self.medians.var()) - self.error**2, 0.0)
        return between / max(self.scatter**2, _ROUNDING**2)

    def labelled(self, turned: Sequence[int]) -> Colours:
        """Give places of about one response one letter, counted from pixel (0, 0)."""
        once = np.roll(self.medians, turned, (0, 1))
        values = np.sort(once.ravel())
        steps = np.diff(values) > max(_APART * (values[-1] - values[0]), _SIGMAS * self.error)
        numbers = np.searchsorted(values[1:][steps], once, side="right")
        rows, cols = (_shortest(numbers, axis) for axis in (0, 1))
        once = numbers[:rows, :cols].tolist()
        return Colours(tuple(tuple(ascii_uppercase[k] for k in row) for row in once))


def _shortest(numbers: Array, axis: int) -> int:
    """Shortest period of a pattern along an axis, which divides that one given."""
    size = numbers.shape[axis]
    steps = (step for step in range(1, size) if size % step == 0)
    return next((s for s in steps if np.array_equal(np.roll(numbers, s, axis), numbers)), size)


def _bayer(colours: Colours, response: Mapping[str, float] | None = None) -> list[str]:
    """Orders of Bayer's pattern that have such a diagonal; none of another pattern.

    The two greens of a sensor differ by some per cent: letters rise with the response, and those
    of a diagonal must follow each other. Of two such diagonals that of less difference counts.
    """
    if colours.period != (2, 2):
        return []
    (a, b), (c, d) = colours.pattern
    of_greens = {(b, c): ["RGGB", "BGGR"], (a, d): ["GRBG", "GBRG"]}
    pairs = [pair for pair in of_greens if pair[0] == pair[1]]
    if not pairs and len({a, b, c, d}) == 4:
        pairs = [pair for pair in of_greens if abs(ord(pair[0]) - ord(pair[1])) == 1]
        if response:
            apart = {pair: abs(np.log(response[pair[0]] / response[pair[1]])) for pair in pairs}
            pairs = [pair for pair in pairs if apart[pair] <= 2 * min(apart.values())]
    elif len(pairs) == 1 and len({a, b, c, d}) < 3:
        pairs = []
    return [name for pair in pairs for name in of_greens[pair]]
