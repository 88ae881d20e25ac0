"""Error of the sensitivity by random noise alone, pixel by pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._types import Floats
from equipix.exposures.front import exposures_of
from equipix.exposures.options import FitOptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


_BLOCK = 64
"""Rows at a time, at least."""

_SMALLEST, _SPANS = 256, 8
"""The part of a large sensor that is drawn: so many pixels, or spans of the shifts, wide. Of four
spans the error of five positions near the corners of a square came out 9 % too large."""

_FEWEST, _MOST, _PIXELS = 3, 24, 200_000
"""Draws of noise: as many as have so many pixels in all, between two bounds."""

_NOISE, _TOLERANCE = 1e-3, 1e-4
"""Of the draws: small enough to be linear. A tolerance of 1e-5 changes the rms by 0.1 %."""


def local_variance(
    shape: tuple[int, int], positions: NDArray[np.int64], powers: Floats, width: float | None
) -> Iterator[Floats]:
    """Variance of M for noise of variance 1, but for a factor near 1 over the whole sensor.

    With M = 1 and unit weights the least-squares problem S g = b has S = D_M − B·D_L⁻¹·Bᵀ, and
    noise of variance 1 leaves g of covariance S⁻¹. With S = D_M − K D_M, the probability that a
    walk from pixel p to a cell, and from there to a pixel of that cell, returns is the diagonal

        K_p = Σ_k c_k⁴ L(u_k)² / C(u_k) / D_M(p),   D_M(p) = Σ_k c_k² L(u_k)²,

    C(u) being the sum of c² of the exposures that cover cell u: fewer of them near the edges. So
    (S⁻¹)_pp ≈ 1 / (D_M (1 − K)); longer paths are included by `factor`.
    """
    rows, cols = shape
    places = positions - positions.min(axis=0)
    spans = places.max(axis=0)
    seen_by = [_seen_by(size, places[:, axis]) for axis, size in enumerate(shape)]
    light = [_light(size, positions[:, axis], width) for axis, size in enumerate(shape)]
    powers2 = powers**2
    # As many rows as the exposures are apart: then few cells belong to two blocks.
    height = max(_BLOCK, int(spans[0]))
    for start in range(0, rows, height):
        part = slice(start, min(start + height, rows))
        cells = slice(part.start, part.stop + spans[0])
        seen = (seen_by[0][cells] * powers2) @ seen_by[1].T
        weights: Floats = np.zeros((part.stop - part.start, cols))
        returning = np.zeros_like(weights)
        for k, (row, col) in enumerate(places):
            weight = powers2[k] * np.outer(light[0][k, part], light[1][k])
            weights += weight
            returning += powers2[k] * weight / seen[row : row + len(weight), col : col + cols]
        # Alone in all its cells, a pixel is compared with nothing.
        rest = weights - returning
        yield np.divide(1, rest, where=rest > 1e-9 * weights, out=np.full_like(rest, np.inf))


def _seen_by(size: int, places: NDArray[np.int64]) -> Floats:
    """Whether exposure l covers row (or column) i of the beam, counted from the first: (i, l)."""
    away = np.arange(size + places.max())[:, None] - places
    return ((away >= 0) & (away < size)).astype(np.float64)


def _light(size: int, positions: NDArray[np.int64], width: float | None) -> Floats:
    """Square of a Gaussian beam's factor along one axis, at each row (or column): (k, i)."""
    places = np.arange(size) + positions[:, None] - (size - 1) / 2
    return np.ones(places.shape) if width is None else np.exp(-2 * (places / width) ** 2)


def factor(shape: tuple[int, int], positions: NDArray[np.int64], powers: Floats) -> float:
    """What `local_variance` must be multiplied by, from draws of noise.

    It counts the longer ways, and nearly periodic waves with them. It falls with the size of the
    sensor, in spans of the shifts, to a limit; of a large one a part is solved, under an even beam.
    """
    spans = np.ptp(positions, axis=0).tolist()
    rows, cols = (
        min(size, max(_SMALLEST, _SPANS * span)) for size, span in zip(shape, spans, strict=True)
    )
    rng = np.random.default_rng(0)
    local = np.concatenate(list(local_variance((rows, cols), positions, powers, None)))
    light = powers[:, None, None] * np.ones((1, rows, cols))
    ratios: list[float] = []
    for _ in range(min(max(_PIXELS // local.size, _FEWEST), _MOST)):
        frames = light + _NOISE * rng.standard_normal(light.shape)
        # A bare fit, without the test of the sign. One thread: on so small a part two are slower.
        options = FitOptions(tolerance=_TOLERANCE, workers=1)
        solved = exposures_of(frames, positions, flux=powers).fit(options)
        error = (solved.sensitivity - np.nanmean(solved.sensitivity)) / _NOISE
        valid = np.isfinite(error) & np.isfinite(local)
        ratios.append(float(np.sum(error**2, where=valid) / np.sum(local, where=valid)))
    return float(np.mean(ratios))
