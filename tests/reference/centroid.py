"""Centroid of a spot in its plainest form: NumPy, whole arrays, no speed.

The docs of the compiled core's module ``centroid`` describe the method; the steps here bear the
same names and stand in the same order.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Image = NDArray[np.float64]
    Box = tuple[int, int, int, int]  # first row, last row + 1, first column, last column + 1

BLOCKS = 16
SPOT_PIXELS = 16
DETECTION = 8.0
COMPARABLE = 0.25
CLIPPING = 5.0
NORMAL_MAD = 1.4826022185056018
NORMAL_MEDIAN_SQUARE = 0.454936423119572
OUTLIER = 4.0


class Spot(NamedTuple):
    """Centroid of a spot and its standard error, (row, column) in pixels."""

    position: Image
    std: Image


class Shift(NamedTuple):
    """Move of the sensor and its standard error, (row, column) in pixels."""

    shift: Image
    std: Image
    before: Spot
    after: Spot


def measure_shift(before: ArrayLike, after: ArrayLike, *, saturation: float | None = None) -> Shift:
    """Move of the sensor between two images of a spot that stands still in the beam."""
    first, second = locate(before, saturation=saturation), locate(after, saturation=saturation)
    shift = first.position - second.position
    return Shift(shift, np.hypot(first.std, second.std), first, second)


def locate(frames: ArrayLike, *, saturation: float | None = None) -> Spot:
    """Centroid of the one spot in `frames`, shape (rows, cols) or (n, rows, cols)."""
    raw = np.asarray(frames)
    if saturation is None:
        saturation = np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else np.inf
    stack = raw.astype(np.float64)
    stack = stack[np.newaxis] if stack.ndim == 2 else stack
    stack = without_hot(stack, saturation, whole=raw.dtype.kind in "iu")
    mean = stack.sum(axis=0) / len(stack)
    window, level, departure = find_window(mean)
    patch = widen(window, max(3, 3 * min(window[1] - window[0], window[3] - window[2]) // 8))
    patch = clip(patch, mean.shape)
    values, replaced = clean(cut(mean, patch), departure)
    inside = in_window(values.shape, patch, window)
    if np.any(cut(stack.max(axis=0), patch)[inside & ~replaced] >= saturation):
        raise ValueError("saturated")
    rows, cols = np.indices(values.shape, dtype=np.float64)
    rows += patch[0] - (window[0] + window[1] - 1) / 2  # from the window's centre
    cols += patch[2] - (window[2] + window[3] - 1) / 2
    basis = powers(rows / values.shape[0], cols / values.shape[1])
    surface, ring = fit_clipped(basis[:, ~inside], values[~inside])
    signal = values - np.tensordot(surface, basis, axes=1)
    if len(stack) > 1:
        variance = cut(stack.var(axis=0, ddof=1) / len(stack), patch)
        variance = np.where(replaced, predicted(variance), variance)
    else:
        variance = variance_of_one(values, signal, inside, level)
    if signal[inside].sum() <= 0:
        raise ValueError("missing")
    centroid, std = moments(rows, cols, basis, signal, variance, inside, ring)
    centre = np.array([window[0] + window[1] - 1, window[2] + window[3] - 1]) / 2
    return Spot(centre + centroid, std)


def without_hot(stack: Image, level: float, *, whole: bool) -> Image:
    """Isolated pixels that saturate in every frame, darker light around them, replaced."""
    ever, mean = np.any(stack >= level, axis=0), stack.mean(axis=0)
    base = np.median(mean)
    hot = []
    for row, col in np.argwhere(ever).tolist():
        inside = 2 <= row < ever.shape[0] - 2 and 2 <= col < ever.shape[1] - 2
        if not inside or ever[row - 1 : row + 2, col - 1 : col + 2].sum() > 1 or base >= level:
            continue
        light = base + light_around(mean - base, row, col, 0.01 * (level - base))
        if light < 0.9 * level and np.all(stack[:, row, col] >= level):
            hot.append((row, col))
    result = stack.copy()
    for image, values in zip(result, stack, strict=True):
        good = np.ones(values.shape, dtype=bool)
        for place in hot:
            good[place] = False
        floor = 0.01 * float(np.ptp(values[good])) + float(np.finfo(np.float32).tiny)
        for row, col in hot:
            light = np.median(values) + light_around(values - np.median(values), row, col, floor)
            image[row, col] = np.rint(light) if whole else light
    return result


def light_around(signal: Image, row: int, col: int, floor: float) -> float:
    """Cubic interpolation along the direction in which ln of the light changes least."""
    found = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        far, near, after, beyond = (signal[row + k * down, col + k * right] for k in (-2, -1, 1, 2))
        logs = np.log(np.maximum([far, near, after, beyond], floor))
        change = abs(logs[2] - logs[1]) + abs(logs[3] - logs[0])
        value = (4 * (near + after) - (far + beyond)) / 6
        if min(far, near, after, beyond) > 2 * floor:
            value = np.exp((4 * (logs[1] + logs[2]) - (logs[0] + logs[3])) / 6)
        found.append((change, value))
    return float(min(found, key=lambda each: each[0])[1])


def moments(
    rows: Any,
    cols: Any,
    basis: Image,
    signal: Image,
    variance: Image,
    inside: Any,
    ring: Any,
) -> tuple[Image, Image]:
    """First moments of the signal in the window, and their standard errors."""
    flux = signal[inside].sum()
    kept = basis[:, ~inside][:, ring]
    normal = kept @ kept.T
    centroid, std = np.empty(2), np.empty(2)
    for axis, place in enumerate((rows, cols)):
        centroid[axis] = (place * signal)[inside].sum() / flux
        lever = np.where(inside, place - centroid[axis], 0.0)
        through = np.linalg.solve(normal, (basis * lever).sum(axis=(1, 2)))
        own = (lever**2 * variance).sum()
        background = ((through @ kept) ** 2 * variance[~inside][ring]).sum()
        std[axis] = np.sqrt(own + background) / flux
    return centroid, std


def variance_of_one(values: Image, signal: Image, inside: Any, level: float) -> Image:
    """Variance per pixel, background + factor * signal, from the roughness of a single image."""
    rough = roughness(values)
    inner = np.zeros_like(inside)
    inner[1:-1, 1:-1] = True
    background = np.median(rough[inner & ~inside])
    bright = inside & (signal > level / 2)
    factor = np.median((rough[bright] - background) / signal[bright])
    variance: Image = background + max(factor, 0.0) * np.maximum(signal, 0.0)
    return variance


def roughness(values: Image) -> Image:
    """Square of the second difference along both axes, scaled to have the median of a variance."""
    padded = np.pad(values, 1, mode="edge")
    along = padded[:-2] - 2 * padded[1:-1] + padded[2:]
    both = along[:, :-2] - 2 * along[:, 1:-1] + along[:, 2:]
    return both**2 / (36 * NORMAL_MEDIAN_SQUARE)


def find_window(mean: Image) -> tuple[Box, float, float]:
    """Window of the spot and its blur, its level, and how far light departs from neighbours."""
    excess = median_of_nine(mean) - background(mean)
    centres, noises = [], []
    for block in blocks(excess):
        centres.append(np.median(block))
        noises.append(NORMAL_MAD * np.median(np.abs(block - centres[-1])))
    noise = float(np.median(noises))
    level = float(np.sort(excess, axis=None)[-SPOT_PIXELS])
    if not level > DETECTION * noise:
        raise ValueError("missing")
    labels = label_pixels(excess > level / 2)
    areas = np.bincount(labels.ravel())[1:]
    order = np.argsort(-areas, kind="stable")
    if len(areas) > 1 and areas[order[1]] >= COMPARABLE * areas[order[0]]:
        raise ValueError("doubled")
    rows, cols = np.nonzero(labels == order[0] + 1)
    box = (int(rows.min()), int(rows.max()) + 1, int(cols.min()), int(cols.max()) + 1)
    sigma = blur(excess, box, len(rows), level, noise)
    window = widen(box, int(np.ceil(3.5 * sigma)) + 1)
    if not fits(widen(window, 3), mean.shape):
        raise ValueError("cut")
    with np.errstate(divide="ignore"):  # an outline without any blur departs by any amount
        departure = excess.max() * (0.2 + 0.75 * np.float64(sigma) ** -2) + 15 * noise
    return window, level, departure


def blur(excess: Image, box: Box, area: int, level: float, noise: float) -> float:
    """Width of the spot's edge, as the standard deviation of a Gaussian with that slope."""
    radius = np.sqrt(area / np.pi)
    low = max(level / 10, 3 * noise)
    around = widen(box, int(np.ceil(radius)))
    wide = np.sqrt(np.sum(cut(excess, clip(around, excess.shape)) > low) / np.pi)
    steps = np.sqrt(2 * np.log(level / low)) - np.sqrt(2 * np.log(2))
    return float(max(wide - radius, 0.0) / steps)


def background(mean: Image) -> Image:
    """Smooth background: a cubic surface through the medians of blocks, spots clipped."""
    rows, cols = np.indices(mean.shape, dtype=np.float64)
    rows, cols = (2 * rows + 1) / mean.shape[0] - 1, (2 * cols + 1) / mean.shape[1] - 1
    medians = [
        np.array([np.median(block) for block in blocks(image)]) for image in (rows, cols, mean)
    ]
    surface, _ = fit_clipped(powers(*medians[:2]), medians[2])
    return np.tensordot(surface, powers(rows, cols), axes=1)


def blocks(image: Image) -> list[Image]:
    """Cut the image into 16 by 16 blocks of nearly equal size."""
    row_edges = [image.shape[0] * k // BLOCKS for k in range(BLOCKS + 1)]
    col_edges = [image.shape[1] * k // BLOCKS for k in range(BLOCKS + 1)]
    return [
        image[top:bottom, left:right]
        for top, bottom in pairwise(row_edges)
        for left, right in pairwise(col_edges)
    ]


def fit_clipped(basis: Image, values: Image) -> tuple[Image, Any]:
    """Least-squares polynomial of the points that stand within 5 robust deviations of it."""
    surface = np.zeros(len(basis))
    surface[0] = np.median(values)
    kept = np.ones(len(values), dtype=bool)
    for _ in range(5):
        residual = values - surface @ basis
        kept = np.abs(residual) <= CLIPPING * NORMAL_MAD * np.median(np.abs(residual))
        used = basis[:, kept]
        surface = surface + np.linalg.solve(used @ used.T, used @ residual[kept])
    return surface, kept


def powers(rows: Any, cols: Any) -> Image:
    """Terms r^i c^j of a cubic surface."""
    return np.stack([rows**i * cols**j for i in range(4) for j in range(4 - i)])


def median_of_nine(image: Image) -> Image:
    """Median of every pixel and its eight neighbours; the border repeats the outermost pixels."""
    padded = np.pad(image, 1, mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return np.median(views, axis=(2, 3))


def predicted(image: Image) -> Image:
    """Median of the means of the four pairs of opposite neighbours of every pixel."""
    near = neighbours(image)
    return np.median((near[..., :4] + near[..., :3:-1]) / 2, axis=2)


def neighbours(image: Image) -> Image:
    """Eight neighbours of every pixel along the last axis, row by row."""
    padded = np.pad(image, 1, mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*image.shape, 9)
    return np.delete(views, 4, axis=2)


def clean(values: Image, departure: float) -> tuple[Image, Any]:
    """Hot and dead pixels replaced by what their neighbours predict; the border stays."""
    ranked = np.sort(neighbours(values), axis=2)
    low, high = ranked[..., 1], ranked[..., 6]
    beyond = np.maximum(values - high, low - values) > OUTLIER * (high - low)
    beyond |= np.abs(values - predicted(values)) > departure
    outlier = np.zeros(values.shape, dtype=bool)
    outlier[1:-1, 1:-1] = beyond[1:-1, 1:-1]
    return np.where(outlier, predicted(values), values), outlier


def label_pixels(mask: Any) -> NDArray[np.int64]:
    """Label the 8-connected components of the mask from 1; pixels outside have 0."""
    labels = np.zeros(mask.shape, dtype=np.int64)
    count = 0
    for start in zip(*np.nonzero(mask), strict=True):
        if labels[start]:
            continue
        count += 1
        labels[start] = count
        todo = [start]
        while todo:
            row, col = todo.pop()
            near = (slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2))
            for r, c in zip(*np.nonzero(mask[near] & (labels[near] == 0)), strict=True):
                place = (near[0].start + r, near[1].start + c)
                labels[place] = count
                todo.append(place)
    return labels


def widen(box: Box, margin: int) -> Box:
    """Add `margin` pixels to the box on every side."""
    return (box[0] - margin, box[1] + margin, box[2] - margin, box[3] + margin)


def clip(box: Box, shape: tuple[int, ...]) -> Box:
    """Part of the box that lies in the image."""
    return (max(box[0], 0), min(box[1], shape[0]), max(box[2], 0), min(box[3], shape[1]))


def fits(box: Box, shape: tuple[int, ...]) -> bool:
    """Whether the whole box lies in the image."""
    return clip(box, shape) == box


def cut(image: Image, box: Box) -> Image:
    """Pixels of the box."""
    return image[box[0] : box[1], box[2] : box[3]]


def in_window(shape: tuple[int, ...], patch: Box, window: Box) -> Any:
    """Which pixels of the patch belong to the window."""
    inside = np.zeros(shape, dtype=bool)
    cut(
        inside,
        (window[0] - patch[0], window[1] - patch[0], window[2] - patch[2], window[3] - patch[2]),
    )[...] = True
    return inside
