"""Sums over frames of one level that pass by one at a time: memory does not grow with them."""

from typing import Self

import numpy as np

from equipix._check import Array, Bools, Floats
from equipix.measured.part import blocks, chosen
from equipix.metrics.frame_noise import Steadiness


class _Moments:
    """Mean of arrays of one shape that pass by, and Σ(x − x̄)² of each value, by Welford."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mean: Floats = np.zeros(shape)
        self.squares: Floats = np.zeros(shape)

    def add(self, values: Floats, count: int) -> None:
        """Add the array that makes so many."""
        deviation = values - self.mean
        self.mean += deviation / count
        self.squares += deviation * (values - self.mean)


class Sums:
    """Sums over frames of one level, over some of their pixels.

    Parameters
    ----------
    used : ndarray of bool, shape (rows, cols)
        The pixels: finite in all frames.

    Attributes
    ----------
    mean : ndarray, shape (rows, cols), float64
        Mean image; 0 in other pixels.
    levels : list of float
        Mean of each frame over the pixels.
    squares : float
        Σ(y − ȳ)² over frames and pixels, ȳ the mean of each pixel, by Welford's recurrence.
    rows, cols : _Moments
        Means of rows and columns of frames of which all pixels are used, over the frames.
    """

    def __init__(self, used: Bools) -> None:
        self.used, self.pixels = used, int(np.count_nonzero(used))
        self.mean: Floats = np.zeros(used.shape)
        self.levels: list[float] = []
        self.squares = 0.0
        self.rows, self.cols = _Moments(used.shape[:1]), _Moments(used.shape[1:])
        part = chosen(used)
        self._part, self._free = np.unravel_index(part, used.shape), _Moments(part.shape)

    def add(self, frame: Array) -> None:
        """Add the next frame, shape (rows, cols)."""
        count, of_rows, of_cols = len(self.levels) + 1, *map(np.zeros, frame.shape)
        for rows in blocks(frame.shape):
            value = frame[rows].astype(np.float64)
            value[~self.used[rows]] = 0.0
            of_rows[rows] = value.sum(axis=1)
            of_cols += value.sum(axis=0)
            deviation = value - self.mean[rows]
            self.mean[rows] += deviation / count
            value -= self.mean[rows]
            value *= deviation
            self.squares += float(value.sum())
        self.rows.add(of_rows / max(1, frame.shape[1]), count)
        self.cols.add(of_cols / max(1, frame.shape[0]), count)
        self.levels.append(float(of_rows.sum()) / max(1, self.pixels))
        self._free.add(frame[self._part].astype(np.float64) - self.levels[-1], count)

    def join(self, places: Bools, other: Self) -> None:
        """Take in the sums over more pixels: those of `other`, one row, lie at these places.

        The steadiness, and the means of rows and columns, stay those of the pixels before.
        """
        self.used[places], self.mean[places] = other.used[0], other.mean[0]
        totals = self.pixels * np.array(self.levels) + other.pixels * np.array(other.levels)
        self.pixels += other.pixels
        self.squares += other.squares
        self.levels = (totals / max(1, self.pixels)).tolist()

    @property
    def noise_squares(self) -> float:
        """Σ(y − ȳ)² over frames and pixels, the drift of the frame means removed."""
        return self.squares - self.pixels * len(self.levels) * float(np.var(self.levels))

    @property
    def steadiness(self) -> Steadiness:
        """Drift of the frame means, and the noise of half of the pixels, of a part of many."""
        squares = self._free.squares
        noise = float(np.sqrt(np.median(squares) / (len(self.levels) - 1))) if squares.size else 0.0
        return Steadiness(float(np.std(self.levels, ddof=1)), noise)

    def spatial_variance(self) -> float:
        """Unbiased variance of the mean image over the pixels."""
        centre, total = self.centre, 0.0
        for rows in blocks(self.mean.shape):
            total += float(np.sum((self.mean[rows][self.used[rows]] - centre) ** 2))
        return total / (self.pixels - 1)

    @property
    def centre(self) -> float:
        """Mean of the mean image over the pixels."""
        every = (float(self.mean[r][self.used[r]].sum()) for r in blocks(self.mean.shape))
        return sum(every) / self.pixels

    def between_lines(self) -> tuple[float, list[tuple[float, int]]]:
        """Sum of squares of the mean image over the pixels, and those between columns and rows.

        Beside these are their degrees of freedom.
        """
        centre, total = self.centre, 0.0
        sums = [np.zeros(size) for size in self.mean.shape[::-1]]
        for rows in blocks(self.mean.shape):
            away = np.where(self.used[rows], self.mean[rows] - centre, 0.0)
            total += float(np.sum(away**2))
            sums[0] += away.sum(axis=0)
            sums[1][rows] = away.sum(axis=1)
        found = []
        for axis, of_lines in enumerate(sums):
            counts = np.count_nonzero(self.used, axis=axis)
            known = counts > 0
            square = float(np.sum(of_lines[known] ** 2 / counts[known]))
            found.append((square, int(np.count_nonzero(known)) - 1))
        return total, found
