"""Fall-off of a lens's illumination: its law fitted to a flat frame, and removed as a gain."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Bools, Floats, ReadOnly, as_array, as_mask, check_shape, check_word
from equipix.correction.polynomial import Polynomial
from equipix.errors import InputError
from equipix.findings import set_bits
from equipix.io.record import made
from equipix.measured.colour import Colours, responses
from equipix.measured.noise import ROBUST
from equipix.metrics.maps import block_means

__all__ = ["LensFalloff", "fit"]
__dir__ = __all__.copy

Law = Literal["cos4", "radial"]

_SIDE = 64
"""Most blocks along a side that the law is fitted to: it is smooth."""

_ROUNDS = 60
"""Most steps of the fit."""

_WORST = 1e7
"""Largest condition of the scaled derivatives at which a law is determined."""

_LEAST = 0.1
"""Illumination up to which a pixel is not corrected: gain and noise would be ten times as large."""

_SETTLED = 1e-4
"""Largest sum of squares that one more step may take away, over the variance of a residual."""

_ROUNDING = 1e-9
"""Error of the model and its numerical derivatives, relative to the values."""

_SHOWN = 3.0
"""Standard errors by which the fall-off by cos⁴ must differ from none."""

_CLIP = 5.0
"""Robust standard deviations beyond which a block is left out."""


@dataclass(frozen=True, eq=False)
class LensFalloff(ReadOnly):
    """Law of the relative illumination, the result of `fit`; 1 at the centre.

    Attributes
    ----------
    law : {"cos4", "radial"}
        cos⁴ω with tan ω = r/focal length, or 1 + k₁ρ² + k₂ρ⁴ with ρ = r/(half the diagonal).
    centre : tuple of float
        Optical axis on the sensor (row, col), in pixels.
    focal_length : float
        In pixels, for "cos4"; NaN for "radial".
    coefficients : ndarray, shape (0,) or (2,)
        k₁ and k₂ of "radial".
    std : dict of str to float
        Standard errors of ``"row"``, ``"col"`` and ``"focal_length"``, or ``"k1"`` and ``"k2"``,
        from the residuals of block means. They hold if these are independent, as a gain without
        large scales leaves them; a smooth gain of the sensor that is not given as `sensitivity`
        adds an error that they do not contain.
    shape : tuple of int
        Sizes of the sensor that it was fitted on.
    reach : float
        Largest distance from the axis at which the flat had values, in pixels.
    """

    law: Law
    centre: tuple[float, float]
    focal_length: float
    coefficients: Floats
    std: dict[str, float]
    shape: tuple[int, int]
    reach: float

    def illumination(self) -> Floats:
        """Relative illumination of each pixel, shape (rows, cols), 1 on the axis."""
        squared = self._squared_distance()
        if self.law == "cos4":
            return cos4(squared, self.focal_length)
        return _radial(squared / _half_diagonal(self.shape) ** 2, *self.coefficients)

    def correction(self) -> Polynomial:
        """Gain 1/illumination of each pixel, as a correction of frames without dark level.

        Pixels are flagged ``NO_FLAT_FIELD`` and ``DO_NOT_USE``, their gain NaN, where the law gives
        less than a tenth of the light, and outside of what a radial law was fitted to: its
        polynomial may fall below 0 there.
        """
        light = self.illumination()
        unknown = ~(light > _LEAST)
        metadata = made(law=self.law, centre=list(self.centre))
        if self.law == "cos4":
            metadata["focal_length"] = self.focal_length
        else:
            unknown |= self._squared_distance() > self.reach**2
            metadata["k1"], metadata["k2"] = map(float, self.coefficients)
        gain = np.where(unknown, np.nan, 1 / np.where(unknown, 1.0, light))
        flags = np.zeros(self.shape, np.uint32)
        set_bits(flags, "undetermined", unknown)
        return Polynomial(np.stack([np.zeros_like(gain), gain]), flags, metadata)

    def _squared_distance(self) -> Floats:
        rows, cols = np.ogrid[: self.shape[0], : self.shape[1]]
        return np.asarray((rows - self.centre[0]) ** 2 + (cols - self.centre[1]) ** 2)


def cos4(squared_distance: ArrayLike, focal_length: float) -> Floats:
    """Relative illumination cos⁴ω = 1/(1 + r²/f²)² at squared distances r² from the axis."""
    return np.asarray((1 + np.asarray(squared_distance) / focal_length**2) ** -2)


def fit(
    frame: ArrayLike,
    *,
    law: Law = "cos4",
    sensitivity: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    cfa: ArrayLike | None = None,
) -> LensFalloff:
    """Fit the fall-off of a lens to a frame of a uniform scene.

    Parameters
    ----------
    frame : array_like, shape (rows, cols)
        Mean frame of a uniform scene through the lens, the dark subtracted. NaN does not count. It
        must be linear in light: frames corrected by a response are so only where the array's mean
        curve is, else f is off beyond its standard error (docs/nuc.md, section 2).
    law : {"cos4", "radial"}
        The law: the natural fall-off, or a polynomial for lenses with vignetting.
    sensitivity : array_like, shape (rows, cols), optional
        The sensor's own gain, measured without the lens, or by shifts: the flat is divided by it.
        Without it, the gain counts as noise about the law, and its large-scale part as fall-off.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`: the flat is divided by the
        response of each colour, so that all show one law. Not beside a `sensitivity` that contains
        the responses.

    Returns
    -------
    LensFalloff
        The law, whose `correction` is the gain 1/cos⁴ω.

    Raises
    ------
    InputError
        If an argument has a wrong shape or dtype, the flat is below 0 or shows no fall-off that
        determines the law, or the fit does not converge.

    Notes
    -----
    Least squares over means of blocks, at most 64 along a side, by Levenberg-Marquardt steps;
    blocks beyond five robust standard deviations, such as those of dust, are left out. The focal
    length is in pixels: times the pitch it is a length.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian): gains raised towards the edge by cos⁴.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import lens
    >>> rows, cols = np.mgrid[:120, :160]
    >>> squared = (rows - 62.0) ** 2 + (cols - 75.0) ** 2
    >>> found = lens.fit(1000 / (1 + squared / 300.0**2) ** 2)
    >>> round(found.focal_length, 1), tuple(round(each, 3) for each in found.centre)
    (300.0, (62.0, 75.0))
    """
    check_word("law", law, get_args(Law))
    image = _image(frame, sensitivity, mask)
    _refuse_negative(image)
    shape = check_shape((image.shape[0], image.shape[1]))
    colours = Colours.of(cfa)
    if colours is not None:
        image /= colours.map_of(responses(colours, image), shape)
    half = _half_diagonal(shape)
    rows, cols, values = _blocks(image)
    start = [0.5] if law == "cos4" else [-0.3, 0.0]

    def model(p: Floats) -> Floats:
        squared = (rows / half - p[1]) ** 2 + (cols / half - p[2]) ** 2
        if law == "cos4":
            return np.asarray(p[0] * (1 + p[3] * squared) ** -2)
        return np.asarray(p[0] * _radial(squared, p[3], p[4]))

    middle = [(size - 1) / 2 / half for size in shape]
    guess = np.array([float(np.median(values)), *middle, *start])
    found, std = _fitted(model, values, guess)
    centre = (float(found[1] * half), float(found[2] * half))
    # A block reaches beyond its centre, and so does the margin that fills no whole block.
    edge = np.sqrt(2.0) * max(1, max(shape) // _SIDE)
    reach = float(np.hypot(rows - centre[0], cols - centre[1]).max() + edge)
    errors = {"row": std[1] * half, "col": std[2] * half}
    if law == "cos4":
        if not found[3] > _SHOWN * std[3]:
            raise InputError(
                f"'frame' shows a fall-off (half diagonal / focal length)² of {found[3]:.3g} "
                f"with a standard error of {std[3]:.2g}, expected {_SHOWN:g} of them above 0: it "
                "is not darker at the edge. Give the flat, not the dark, and less noise"
            )
        focal = float(half / np.sqrt(found[3]))
        errors["focal_length"] = focal * std[3] / float(found[3]) / 2
        return LensFalloff(law, centre, focal, np.empty(0), errors, shape, reach)
    errors |= {"k1": std[3], "k2": std[4]}
    return LensFalloff(law, centre, float("nan"), found[3:], errors, shape, reach)


def _image(frame: ArrayLike, sensitivity: ArrayLike | None, mask: ArrayLike | None) -> Floats:
    """Return the flat as float64 without the sensor's gain, NaN where it does not count."""
    image = as_array("frame", frame, ndim=2).astype(np.float64)
    if sensitivity is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = as_array("sensitivity", sensitivity, ndim=2)
            if gain.shape != image.shape:
                raise InputError(f"'sensitivity' has shape {gain.shape}, expected {image.shape}")
            image = image / gain
    image[~np.isfinite(image)] = np.nan
    if (excluded := as_mask(mask, image.shape)) is not None:
        image[excluded] = np.nan
    if np.count_nonzero(np.isfinite(image)) < 100:
        raise InputError("'frame' has fewer than 100 finite values, expected those of a sensor")
    return image


def _refuse_negative(image: Floats) -> None:
    """Refuse a flat below 0, from which more than its dark was subtracted."""
    median = float(np.nanmedian(image))
    if not median > 0:
        raise InputError(
            f"'frame' has the median {median:.6g}, expected light above 0: see that the dark was "
            "subtracted once, and from the flat"
        )


def _blocks(image: Floats) -> tuple[Floats, Floats, Floats]:
    """Rows, columns and means of square blocks without a missing value."""
    side = max(1, max(image.shape) // _SIDE)
    means = block_means(image, side)
    rows, cols = np.mgrid[: means.shape[0], : means.shape[1]] * side + (side - 1) / 2
    known = np.isfinite(means)
    return rows[known], cols[known], means[known]


def _fitted(
    model: Callable[[Floats], Floats], values: Floats, start: Floats
) -> tuple[Floats, list[float]]:
    """Parameters of least squares without outliers, and their standard errors."""
    used = np.ones(len(values), bool)
    found = start
    for _ in range(3):
        found = _least_squares(model, values, used, found)
        residual = values - model(found)
        spread = ROBUST * np.median(np.abs(residual[used]))
        used = np.abs(residual) <= max(_CLIP * spread, 1e-9 * abs(found[0]))
    found = _least_squares(model, values, used, found)
    jacobian = _jacobian(model, found)[used]
    sizes = np.linalg.norm(jacobian, axis=0)
    if not sizes.all() or np.linalg.cond(jacobian / sizes) > _WORST:
        raise InputError("'frame' does not determine the law: is there any fall-off in it?")
    freedom = int(used.sum()) - len(found)
    variance = float(np.sum((values - model(found))[used] ** 2)) / freedom
    _check_settled(jacobian, (values - model(found))[used], variance, abs(float(found[0])))
    scaled = np.linalg.inv((jacobian / sizes).T @ (jacobian / sizes))
    return found, (np.sqrt(variance * np.diag(scaled)) / sizes).tolist()


def _check_settled(jacobian: Floats, residual: Floats, variance: float, scale: float) -> None:
    """Refuse a fit that one more step would change by more than a part of its standard errors."""
    step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    gain = float(np.sum((jacobian @ step) ** 2))
    if gain > _SETTLED * variance + len(residual) * (_ROUNDING * scale) ** 2:
        raise InputError(
            f"'frame': the fit of the law did not converge in {_ROUNDS} steps: mask what is no "
            "fall-off, such as vignetted corners, or take the other law"
        )


def _least_squares(
    model: Callable[[Floats], Floats], values: Floats, used: Bools, start: Floats
) -> Floats:
    """Levenberg-Marquardt steps from a start."""
    found, damping = start.copy(), 1e-3
    misfit = float(np.sum((values - model(found))[used] ** 2))
    for _ in range(_ROUNDS):
        jacobian = _jacobian(model, found)[used]
        normal, right = jacobian.T @ jacobian, jacobian.T @ (values - model(found))[used]
        damped = normal + damping * np.diag(np.diag(normal))
        step = np.linalg.lstsq(damped, right, rcond=None)[0]
        after = float(np.sum((values - model(found + step))[used] ** 2))
        if after > misfit:
            damping *= 10
            continue
        found, misfit, damping = found + step, after, damping / 10
        if np.all(np.abs(step) <= 1e-12 * (np.abs(found) + 1e-6)):
            break
    return found


def _jacobian(model: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Derivatives by central differences."""
    columns = []
    for index, value in enumerate(at):
        step = np.zeros(len(at))
        step[index] = 1e-5 * max(abs(value), 1e-2)
        columns.append((model(at + step) - model(at - step)) / (2 * step[index]))
    return np.stack(columns, axis=1)


def _radial(squared: Any, first: float, second: float) -> Floats:
    return np.asarray(1 + squared * (first + squared * second))


def _half_diagonal(shape: tuple[int, int]) -> float:
    return float(np.hypot(*shape)) / 2
