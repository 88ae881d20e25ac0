"""Samples that deviate from the others of their pixel, left out of a stream of frames."""

from __future__ import annotations

import itertools
import warnings
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import number
from equipix.batches import unmasked
from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from equipix._types import Array, Floats

_START = 9
"""Frames that the first estimates are made of."""

_FEWEST = 5
"""Fewest frames."""

_BINS = 64
"""Most groups of pixels of similar signal, which have their noise in common."""

_ROUNDS = 4
"""Rounds in which the common noise is found without the samples that are left out."""

_OWN = 3.0
"""How many times the common noise a pixel's own must be to take its place."""

_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

_MOST = 0.1
"""Largest share of a frame that may be left out: more is another scene."""

_ROUNDING = 12**-0.5
"""Least noise of whole numbers."""


class Rejection:
    """Sigma clipping in one pass.

    Parameters
    ----------
    sigmas : float
        Deviation at which a sample is left out, in standard deviations, 3 or more.

    Attributes
    ----------
    variance_kept : float
        Variance of a normal distribution cut at ±`sigmas`, over that of the whole one: the variance
        of the samples kept must be divided by it.

    Raises
    ------
    InputError
        If `sigmas` is not a number from 3 on.

    Notes
    -----
    The first nine frames give the median of each pixel and the noise that pixels of similar signal
    have in common; a pixel whose own noise is three times that keeps its own. Each further sample
    is compared with the mean of those kept before. A change of a whole frame, by the median of its
    deviations, does not count. With k the limit, φ and Φ of the normal distribution,
    `variance_kept` is 1 − 2kφ(k)/(2Φ(k) − 1).
    """

    def __init__(self, sigmas: float) -> None:
        self._sigmas = number("reject", sigmas)
        if not 3 <= self._sigmas < np.inf:
            raise InputError(f"'reject' is {sigmas!r}, expected a number of sigmas from 3 on")
        normal = NormalDist()
        inside = 2 * normal.cdf(self._sigmas) - 1
        self.variance_kept = 1 - 2 * self._sigmas * normal.pdf(self._sigmas) / inside

    def cleaned(self, batches: Iterable[Array]) -> Iterator[Floats]:
        """Give batches of frames as float64 with NaN in the place of samples left out.

        Parameters
        ----------
        batches : iterable of ndarray, shape (n, rows, cols)
            Frames of one steady scene.

        Yields
        ------
        ndarray, shape (n, rows, cols), float64
            The frames, in their order.

        Raises
        ------
        InputError
            If there are fewer than five frames, or more than a tenth of one would be left out.
        """
        frames = (frame for batch in batches for frame in batch)
        first = list(itertools.islice(frames, _START))
        if len(first) < _FEWEST:
            raise InputError(
                f"'source' holds {len(first)} frames, expected {_FEWEST} or more to reject samples"
            )
        whole = first[0].dtype.kind in "bui"
        start = np.stack([_floats(frame) for frame in first])
        centre, sigma = self._estimates(start, _ROUNDING if whole else 0.0)
        for index, frame in enumerate(start):
            self._clean(frame, centre, sigma, index)
        count = np.isfinite(start).sum(axis=0)
        with np.errstate(invalid="ignore"):
            mean = np.where(np.isfinite(start), start, 0).sum(axis=0) / count
        yield start
        for index, raw in enumerate(frames, start=len(first)):
            frame = _floats(raw)
            with np.errstate(divide="ignore"):
                self._clean(frame, mean, sigma * np.sqrt(1 + 1 / count), index)
            kept = np.isfinite(frame)
            count += kept
            mean[kept] += (frame[kept] - mean[kept]) / count[kept]
            yield frame[None]

    def _clean(self, frame: Floats, centre: Floats, sigma: Floats, index: int) -> None:
        """Put NaN in the place of samples that deviate."""
        deviation = frame - centre
        known = np.isfinite(deviation)
        if not known.any():
            return
        deviation -= np.median(deviation[known])
        outside = np.abs(deviation) > self._sigmas * sigma
        share = np.count_nonzero(outside) / np.count_nonzero(known)
        if share > _MOST:
            raise InputError(
                f"'source': {share:.0%} of frame {index} deviate by more than {self._sigmas:g} "
                f"standard deviations from those before, expected at most {_MOST:.0%}: is it "
                "another scene? Leave out 'reject', or the frame"
            )
        frame[outside] = np.nan

    def _estimates(self, start: Floats, floor: float) -> tuple[Floats, Floats]:
        """Median of each pixel, and its noise."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "All-NaN", RuntimeWarning)
            centre = np.nanmedian(start, axis=0)
            deviation = start - centre
            deviation -= np.nanmedian(deviation, axis=(1, 2), keepdims=True)
            own = _MAD * np.nanmedian(np.abs(deviation), axis=0)
        common = np.full(centre.shape, np.nan)
        pixels = np.flatnonzero(np.isfinite(centre))
        pixels = pixels[np.argsort(centre.flat[pixels])]
        for group in np.array_split(pixels, min(_BINS, max(1, len(pixels) // _BINS))):
            samples = deviation.reshape(len(start), -1)[:, group]
            common.flat[group] = max(floor, self._noise(samples, float(np.median(own.flat[group]))))
        return centre, np.where(own > _OWN * common, own, common)

    def _noise(self, samples: Floats, sigma: float) -> float:
        """Noise that pixels have in common, without the samples beyond the limit."""
        for _ in range(_ROUNDS):
            inside = np.abs(samples) <= self._sigmas * sigma
            count = inside.sum(axis=0)
            values = np.where(inside, samples, 0)
            squares = np.sum(values**2, axis=0) - values.sum(axis=0) ** 2 / np.maximum(count, 1)
            degrees = np.maximum(count - 1, 0).sum()
            if degrees == 0:
                return sigma
            sigma = float(np.sqrt(squares.sum() / degrees / self.variance_kept))
        return sigma


def _floats(frame: Array) -> Floats:
    """Return a frame as new float64 numbers, masked samples as NaN."""
    values: Any = unmasked(frame.astype(np.float64), np.dtype(np.float64))
    return np.array(values, dtype=np.float64)
