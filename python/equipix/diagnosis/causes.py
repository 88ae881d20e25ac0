"""Likely causes of a misfit, from what residuals have in common.

Pure functions of residuals in standard deviations, shape (n, rows, cols), NaN where there are none.
Each gives the part of their squares that one cause explains, less what white noise would give.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Floats
from equipix.fitting.residuals import in_blocks
from equipix.fitting.windows import mean_squares

_BLOCK = 16
"""Edge of the blocks of a region, in pixels."""

_REGION = 0.1
"""Share of the blocks that a region has at most."""

_BINS = 16
"""Groups of measurements of one signal."""

_FAINT = 0.1
"""Spread of the signals, relative to their mean, below which nothing can grow with them."""

_WORST, _EXCHANGED, _PAIRS = 6, 1.25, 4
"""Exposures that are compared as exchanged; how many times their squares those of such are at most
when they are exchanged in the beam that was fitted to both; how many pairs are fitted so."""


class Part(NamedTuple):
    """What a cause explains of the sum of squares.

    `explained` is the part of the sum of squares, `remaining` the residuals without it.
    """

    explained: float
    remaining: Floats


def by_patterns(residuals: Floats, patterns: list[Floats], noise: float) -> Part:
    """Part proportional to patterns (n, rows, cols), with a factor of its own in each exposure.

    The signal is the pattern of a wrong flux; its slopes are those of a wrong shift.
    """
    explained, remaining = 0.0, residuals.copy()
    for k, (columns, values) in enumerate(_each_exposure(residuals, patterns)):
        fitted = columns @ _least_squares(columns, values)
        explained += float(fitted @ fitted) - noise * len(patterns)
        remaining[k][np.isfinite(residuals[k])] -= fitted
    return Part(explained, remaining)


def coefficients(residuals: Floats, patterns: list[Floats]) -> Floats:
    """Factors of patterns (n, patterns) that explain residuals best: errors of ln c, of shifts."""
    return np.array([_least_squares(*each) for each in _each_exposure(residuals, patterns)])


def by_illumination(residuals: Floats, signal: Floats, slopes: Floats, noise: float) -> Part:
    """Part that a beam explains which changes its shape smoothly: also quadratic in the place."""
    rows, cols = (np.linspace(-1, 1, size) for size in residuals.shape[1:])
    places = (rows[:, None], cols, rows[:, None] ** 2, rows[:, None] * cols, cols**2)
    return by_patterns(residuals, [signal, *slopes, *(signal * place for place in places)], noise)


def maybe_exchanged(residuals: Floats, light: Floats, response: Floats) -> list[tuple[int, int]]:
    """Find pairs of exposures each of which may fit at the place of the other, the likeliest first.

    Squares of residuals of both, each at the place of the other, are compared with those at their
    own. The beam was fitted to the wrong places, so they need not be fewer. Pairs of the six
    exposures with the most residuals are compared.
    """
    squares = np.nansum(residuals**2, axis=(1, 2))
    worst = np.sort(np.argsort(squares)[::-1][:_WORST])

    def at_the_other(k: int, other: int) -> float:
        return float(np.nansum((residuals[k] + (light[k] - light[other]) * response[k]) ** 2))

    shares = {
        (int(i), int(j)): (at_the_other(i, j) + at_the_other(j, i)) / (squares[i] + squares[j])
        for i, j in combinations(worst, 2)
    }
    likeliest = sorted(shares, key=lambda each: shares[each])
    return [pair for pair in likeliest[:_PAIRS] if shares[pair] < _EXCHANGED]


def by_lines(residuals: Floats, axis: int, noise: float) -> Part:
    """Part common to the pixels of a row (axis 2 is averaged) or of a column (axis 1)."""
    known = np.isfinite(residuals)
    count = known.sum(axis=axis, keepdims=True)
    total = np.sum(residuals, axis=axis, where=known, keepdims=True)
    means = np.divide(total, count, where=count > 0, out=np.zeros(total.shape))
    explained = float(np.sum(count * means**2)) - noise * np.count_nonzero(count)
    return Part(explained, residuals - means)


def by_exposure(residuals: Floats, noise: float) -> tuple[float, int]:
    """What one exposure has beyond the median of all, and which: the worst."""
    mean, count = mean_squares(residuals)
    worst = int(mean.argmax())
    usual = max(float(np.median(mean)), noise)
    return float((mean[worst] - usual) * count[worst]), worst


def by_region(residuals: Floats, noise: float) -> tuple[float, tuple[int, int]]:
    """What the worst tenth of all blocks has beyond noise, and the worst pixel (row, col)."""
    known = np.isfinite(residuals)
    excess = np.where(known, residuals**2 - noise, 0).sum(axis=0)
    blocks = np.sort(in_blocks(excess, _BLOCK).ravel())[::-1]
    number = max(1, int(_REGION * len(blocks)))
    smooth = in_blocks(excess, _BLOCK // 4)
    row, col = np.unravel_index(int(smooth.argmax()), smooth.shape)
    size = _BLOCK // 4
    # A misfit that is everywhere has its share in these blocks too.
    beyond = blocks[:number] - max(0.0, float(np.median(blocks)))
    return float(beyond.sum()), (int(row) * size + size // 2, int(col) * size + size // 2)


def by_signal(residuals: Floats, signal: Floats) -> float:
    """How much of the excess of mean squares over the faintest signals grows with the signal.

    Returns
    -------
    float
        Share of the variance of the mean squares of measurements of one signal, in 16 groups, that
        a line through them explains; 0 where it does not rise to at least 1.5 times its start.
    """
    known = np.isfinite(residuals) & np.isfinite(signal)
    if np.count_nonzero(known) < _BINS:
        return 0.0
    order = np.argsort(signal[known])
    groups = np.array_split(order, _BINS)
    squares = np.array([np.mean(residuals[known][group] ** 2) for group in groups])
    levels = np.array([np.mean(signal[known][group]) for group in groups])
    spread = levels - levels.mean()
    if not np.ptp(levels) > _FAINT * abs(levels.mean()):
        return 0.0
    slope = float(spread @ squares / (spread @ spread))
    line = squares.mean() + slope * spread
    if not line[-1] > 1.5 * max(line[0], 0.0):
        return 0.0
    left = float(np.sum((squares - line) ** 2))
    return 1 - left / float(np.sum((squares - squares.mean()) ** 2))


def _each_exposure(residuals: Floats, patterns: list[Floats]) -> list[tuple[Array, Array]]:
    """Patterns as columns, and residuals, of the measurements of each exposure."""
    known = np.isfinite(residuals)
    result = []
    for k, used in enumerate(known):
        columns = np.stack([pattern[k][used] for pattern in patterns], axis=1)
        result.append((np.nan_to_num(columns), residuals[k][used]))
    return result


def _least_squares(columns: Array, values: Array) -> Floats:
    """Least-squares coefficients; 0 of a pattern that there is not."""
    normal = columns.T @ columns
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (columns.T @ values))
