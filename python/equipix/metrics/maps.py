"""Figures of maps and frames: rms, block means, tilt, roughness, NETD, non-uniformity."""

from collections import Counter

import numpy as np

from equipix import _native
from equipix._check import Array, ArrayLike, Bools, Floats, as_array, naming_memory, positive
from equipix.errors import InputError
from equipix.measured.colour import Colours, planes_of
from equipix.measured.noise import BLOCK, nanmedian, scatter_limit
from equipix.measured.part import blocks
from equipix.metrics.frame_noise import stack_of, temporal_of


def rms(values: Array) -> float:
    """Root mean square of the values that are finite."""
    return float(np.sqrt(np.mean(np.square(values[np.isfinite(values)]))))


def rms_at_both_scales(error: Array) -> tuple[float, float]:
    """Root mean square over pixels, and of means over 16×16 pixels: NaN without a whole block."""
    return rms(error), rms(block_means(error)) if min(error.shape) >= BLOCK else np.nan


def relative_error(
    sensitivity: ArrayLike, truth: ArrayLike, *, cfa: ArrayLike | None = None
) -> Floats:
    """Relative error of a measured sensitivity, both in the gauge mean 1.

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        The measured sensitivity; NaN where undetermined.
    truth : array_like, shape (rows, cols)
        The true one; NaN in pixels that are not to count.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`: means are then those of the
        pixel's colour.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        (M − M₀)/M₀ after both are divided by their means over the pixels where both are
        finite; NaN elsewhere.

    Examples
    --------
    >>> from equipix import metrics
    >>> metrics.relative_error([[2.0, 2.0]], [[3.0, 3.0]])
    array([[0., 0.]])
    """
    measured = as_array("sensitivity", sensitivity, ndim=2)
    true = as_array("truth", truth, ndim=2)
    ratio = measured / true
    valid = np.isfinite(ratio)
    error = np.full(ratio.shape, np.nan)
    for plane in planes_of(Colours.of(cfa), ratio.shape):
        counted = valid & plane
        scale = np.mean(measured, where=counted) / np.mean(true, where=counted)
        error[counted] = ratio[counted] / scale - 1
    return error


def block_means(image: ArrayLike, size: int = BLOCK) -> Floats:
    """Average over square blocks: what is left of an error at large scales.

    Parameters
    ----------
    image : array_like, shape (rows, cols)
        The image; NaN pixels do not count.
    size : int
        Edge of a block in pixels.

    Returns
    -------
    ndarray, shape (rows // size, cols // size), float64
        The means of all whole blocks, counted from the first row and column; NaN for a block
        without a valid pixel.

    Raises
    ------
    InputError
        If the image holds no whole block.
    """
    pixels = as_array("image", image, ndim=2).astype(np.float64)
    rows, cols = pixels.shape[0] // size, pixels.shape[1] // size
    if rows == 0 or cols == 0:
        raise InputError(f"'image' has shape {pixels.shape}, smaller than one block of {size}")
    blocks = pixels[: rows * size, : cols * size].reshape(rows, size, cols, size)
    valid = np.isfinite(blocks)
    count = valid.sum(axis=(1, 3))
    total = np.sum(blocks, axis=(1, 3), where=valid)
    means: Floats = np.divide(total, count, where=count > 0, out=np.full((rows, cols), np.nan))
    return means


def slope_pixels(sensitivity: Array, flags: Array) -> Bools:
    """Find the pixels that count for the slope of ln M.

    They are those of which M is determined, that are not flagged ``UNRELIABLE_FLAT``, and whose M
    is from half to twice the mean of such.

    Parameters
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M; NaN where undetermined.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Where a pixel counts.
    """
    return _native.slope_pixels(
        np.ascontiguousarray(sensitivity, np.float64), np.ascontiguousarray(flags, np.uint32)
    )


def tilt_weights(valid: Bools) -> Floats:
    """Weights whose sums with ln M are its least-squares slopes, edge to edge.

    Parameters
    ----------
    valid : ndarray of bool, shape (rows, cols)
        The pixels that count; at least three, not in one line.

    Returns
    -------
    ndarray, shape (2, rows, cols), float64
        For the slopes along rows and columns, each times the size of the sensor along it. NaN
        where the valid pixels determine no slope.
    """
    plane = _plane(valid)
    if plane is None:
        return np.full((2, *valid.shape), np.nan)
    rows, cols, normal = plane
    centred = [np.where(valid, each, 0) for each in (rows[:, None], cols)]
    return np.asarray(np.einsum("ab,brc->arc", np.linalg.inv(normal), centred))


def _plane(valid: Bools) -> tuple[Floats, Floats, Floats] | None:
    """Places of rows and columns from their mean over valid pixels, and the sums of their products.

    They are over the size of the sensor along each axis. None where valid pixels are in one line.
    """
    rows, cols = (np.arange(size) / size for size in valid.shape)
    of_rows, of_cols = valid.sum(axis=1), valid.sum(axis=0)
    count = max(int(of_rows.sum()), 1)
    rows, cols = rows - of_rows @ rows / count, cols - of_cols @ cols / count
    mixed = np.einsum("r,rc,c->", rows, valid, cols)
    normal = np.array([[of_rows @ rows**2, mixed], [mixed, of_cols @ cols**2]])
    return (rows, cols, normal) if np.linalg.matrix_rank(normal, tol=1e-12 * count) == 2 else None


def tilt(sensitivity: Array, valid: Bools) -> Floats:
    """Least-squares slope of ln M over valid pixels, edge to edge, (row, col).

    Parameters
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M.
    valid : ndarray of bool, shape (rows, cols)
        The pixels that count.

    Returns
    -------
    ndarray, shape (2,), float64
        How much ln M grows from one edge of the sensor to the other.
    """
    plane = _plane(valid)
    if plane is None:
        return np.full(2, np.nan)
    rows, cols, normal = plane
    logarithm = np.log(sensitivity, where=valid, out=np.zeros(valid.shape))
    pulls = [logarithm.sum(axis=1) @ rows, logarithm.sum(axis=0) @ cols]
    return np.linalg.solve(normal, pulls)


@naming_memory("NETD")
def netd(cold: ArrayLike, hot: ArrayLike, delta_k: float) -> Floats:
    """Noise-equivalent temperature difference of each pixel.

    Parameters
    ----------
    cold, hot : array_like, shape (n, rows, cols)
        Frames of an even black body at two temperatures, two or more of each.
    delta_k : float
        Difference of the temperatures, in kelvin.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        ΔT·σ/ΔV in kelvin: σ is the temporal noise of one frame, rms of the two levels, with the
        drift of the frame mean removed, over pixels that have a value in all frames. NaN for a
        pixel that has not, infinite for one that does not respond. The usual figure is the median
        over good pixels. Which level is the colder one does not matter.

    Raises
    ------
    InputError
        If the shapes do not fit, `delta_k` is not above 0, or the means of half of the pixels
        differ between the levels by no more than their noise.

    Notes
    -----
    A sample variance of f degrees of freedom follows χ²/f, whose median is below 1. σ² is divided
    by that median, (1 − 2/(9f))³ after Wilson and Hilferty, so that the median over pixels is
    that of the noise; by 0.7 % too small with two frames. Without it the median was smaller by 16,
    9 and 6 % with 2, 3 and 4 frames of each level.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> noise = np.random.default_rng(1).standard_normal((2, 50, 40, 40))
    >>> cold, hot = noise + np.array([1000, 1200])[:, None, None, None]
    >>> print(f"{np.median(metrics.netd(cold, hot, delta_k=5.0)):.3f}")
    0.025
    """
    positive("delta_k", delta_k)
    low, high = stack_of("cold", cold), stack_of("hot", hot)
    if low.shape[1:] != high.shape[1:]:
        raise InputError(f"'hot' has shape {high.shape}, expected frames of {low.shape[1:]}")
    # A bad pixel, which corrected frames hold as NaN, has no part in the drift of the others.
    first, second = temporal_of(low), temporal_of(high)
    rise = np.abs(second.mean - first.mean)
    # Of the mean of two equal variances (Welch-Satterthwaite).
    freedom = round(4 / (1 / (len(low) - 1) + 1 / (len(high) - 1)))
    variance = (first.variance + second.variance) / 2 / scatter_limit(freedom + 1, sigmas=0)
    error = np.sqrt(first.variance / len(low) + second.variance / len(high))
    if nanmedian(rise - error, axis=(0, 1)) <= 0:
        raise InputError(
            f"'hot' differs from 'cold' by {nanmedian(rise, axis=(0, 1)):.3g} DN in the median, in "
            "half of the pixels by no more than noise: give frames of two levels 'delta_k' apart"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(delta_k * np.sqrt(variance) / rise)


@naming_memory("roughness")
def roughness(frame: ArrayLike) -> float:
    """Roughness of a frame: differences of neighbours over values.

    Parameters
    ----------
    frame : array_like, shape (rows, cols)
        A frame, corrected or not; values that are not finite do not count.

    Returns
    -------
    float
        Of an image without differences 0; an offset lowers it.

    Raises
    ------
    InputError
        If no value is finite, or all are 0.

    Notes
    -----
    Sums of the absolute differences of neighbours along rows and columns, over that of the
    absolute values [1]_.

    References
    ----------
    .. [1] M. M. Hayat, S. N. Torres, E. Armstrong, S. C. Cain, B. Yasuda, "Statistical algorithm
       for nonuniformity correction in focal-plane arrays", Applied Optics 38 (1999) 772-780.

    Examples
    --------
    >>> from equipix import metrics
    >>> metrics.roughness([[1.0, 1.0], [1.0, 2.0]])
    0.4
    """
    image = as_array("frame", frame, ndim=2)
    size, steps = 0.0, [0.0, 0.0]
    for rows in blocks(image.shape):
        # The block, and the row before it: a step lies between two rows.
        part = image[max(0, rows.start - 1) : rows.stop].astype(np.float64)
        own = part[-(rows.stop - rows.start) :]
        for axis, values in enumerate((part, own)):
            away = np.abs(np.diff(values, axis=axis))
            steps[axis] += float(np.sum(away[np.isfinite(away)]))
        size += float(np.sum(np.abs(own[np.isfinite(own)])))
    if not size > 0:
        raise InputError("'frame' holds no finite value other than 0")
    return sum(steps) / size


def planes(frames: ArrayLike, cfa: ArrayLike | Colours) -> dict[str, Array]:
    """Cut frames into one plane for each pixel of a period of the colour filters.

    Parameters
    ----------
    frames : array_like, shape (..., rows, cols)
        Frames, or a map, of up to three dimensions.
    cfa : str or array_like of labels
        Colour filters of the pixels, as for `equipix.calibrate`.

    Returns
    -------
    dict of str to ndarray
        Every so many rows and columns, by the label; where a label stands in the period more than
        once "G1", "G2" and so on, in the order of reading. Views of the frames.

    Raises
    ------
    InputError
        If `cfa` is no pattern, or the frames are smaller than a period of it.

    Notes
    -----
    A plane is an image of one colour on a regular grid, which the figures of a camera, and the
    methods of `equipix.scene`, take as they take that of a monochrome sensor. The EMVA 1288
    standard evaluates colours so, too.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> found = metrics.planes(np.arange(16).reshape(4, 4), "RGGB")
    >>> found["R"].tolist(), [*found]
    ([[0, 2], [8, 10]], ['R', 'G1', 'G2', 'B'])
    """
    array, colours = as_array("frames", frames, ndim=(2, 3)), Colours.of(cfa)
    if colours is None:
        raise InputError("'cfa' is None, expected a pattern such as 'RGGB'")
    (down, right), size = colours.period, array.shape[-2:]
    if size[0] < down or size[1] < right:
        raise InputError(
            f"'frames' has shape {array.shape}, smaller than a period of {down}×{right}"
        )
    return {name: array[..., *place] for name, place in places_of(colours).items()}


def places_of(colours: Colours) -> dict[str, tuple[slice, slice]]:
    """Rows and columns of each plane, by the names of `planes`."""
    (down, right), pattern = colours.period, colours.pattern
    several = Counter(label for row in pattern for label in row)
    found: dict[str, tuple[slice, slice]] = {}
    numbers = Counter[str]()
    for row, col in np.ndindex(down, right):
        label = pattern[row][col]
        numbers[label] += 1
        name = label if several[label] == 1 else f"{label}{numbers[label]}"
        found[name] = np.s_[row::down, col::right]
    return found


def non_uniformity(frames: ArrayLike, span: float) -> float:
    """Average non-uniformity of corrected frames of even scenes, relative to the range.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Corrected frames at n states of operation, in DN; NaN in pixels that do not count.
    span : float
        Range of the output in DN: what holds all pixels in all states and scenes of interest.

    Returns
    -------
    float
        The rms over valid pixels of the difference to the frame's mean, averaged over the frames
        and divided by `span`.

    Raises
    ------
    InputError
        If `span` is not above 0, or a frame has no valid pixel.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian), which states below 1/250 000 for bolometers.

    Examples
    --------
    >>> from equipix import metrics
    >>> metrics.non_uniformity([[[1.0, 3.0]], [[4.0, 8.0]]], 100.0)
    0.015
    """
    values = as_array("frames", frames, ndim=3).astype(np.float64)
    positive("span", span)
    if np.isinf(values).any():
        raise InputError("'frames' holds infinite values, expected finite ones, or NaN where bad")
    empty = np.flatnonzero(~np.isfinite(values).any(axis=(1, 2)))
    if empty.size or not len(values):
        which = f"'frames' has no finite value in frame {empty[0]}" if empty.size else "no 'frames'"
        raise InputError(f"{which}, expected those of the valid pixels")
    return float(np.nanstd(values, axis=(1, 2)).mean() / span)
