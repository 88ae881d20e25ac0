"""Response curves as a correction."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from equipix._check import Array, Bools, Floats, as_array, naming_memory
from equipix.correction.apply import CorrectionBase, Formula, checked_frames
from equipix.correction.protocol import Dark, named_cfa, with_dark
from equipix.errors import InputError
from equipix.findings import Findings, usable
from equipix.io.record import Counts, Doubles, Map, Record
from equipix.measured.colour import Colours
from equipix.measured.noise import median_of_noise
from equipix.measured.part import chosen
from equipix.nuc.curves import counted_from, exact_inverse, response_at, slope_at

_LARGEST = int(np.iinfo(np.uint32).max)
"""Largest number of the flags of a pixel."""


@dataclass(frozen=True, eq=False, repr=False)
class Response(CorrectionBase, Record, kind="response", version=2):
    """Response curves of all pixels, the result of `equipix.nuc.fit`; its arrays are read-only.

    Attributes
    ----------
    deviation : ndarray, shape (order + 1, rows, cols), float64
        Coefficients a, K, c, e of V − V̄ = a + K V̄ + c V̄² + e V̄³ for V̄ in DN; NaN where the levels
        do not determine them. A one-point correction by gain has a = 0 and K.
    variances : ndarray, shape (order + 1, rows, cols), float64
        Variances of these coefficients. Where no noise was known they follow from the residuals of
        all good pixels, and are NaN with as many levels as coefficients.
    inverse : ndarray, shape (2 or 4, rows, cols), float64
        Coefficients of the corrected value Σ c_j V^j: the exact inverse up to order 1, a cubic
        above; NaN where the curve does not rise everywhere in its range.
    inverse_error : ndarray, shape (rows, cols), float64
        Largest difference of that cubic to the exact inverse over the valid range, in DN.
    limits : ndarray, shape (2, rows, cols), float64
        Array's mean V̄ at the lowest and the highest level with a value of the pixel, in DN; with a
        `cfa` that of the pixel's colour, as in `deviation` and `inverse`.
    reduced_chi2 : ndarray, shape (rows, cols), float64
        Goodness of fit: mean square residual per degree of freedom, in units of the variance of a
        value; 1 on average where the noise is right. Where no noise was known, in DN². NaN with as
        many levels as coefficients.
    used : ndarray, shape (rows, cols), uint32
        Number of levels at which the pixel has a value.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`. ``DEAD`` rises by less than half as much as its neighbours, ``HOT``
        by more than twice as much, or saturates at each level, also where its neighbours are far
        below; the dark and the noise set them as in `equipix.calibrate`.
        ``NONLINEAR`` does not rise everywhere, ``NO_FLAT_FIELD`` has too few levels.
    levels : ndarray, shape (n,), float64
        Array's mean V̄ of each level, in DN.
    dark : ndarray, shape (rows, cols), or None
        The dark frame that was subtracted from the levels; None where the offset is in the curves.
    raw : bool
        Whether the levels are known to be raw, so that frames must be raw, too.
    saturation : float or None
        Level of saturation in DN, where it is known.
    metadata : dict
        Versions, options and times, as JSON values. ``next_power`` holds the ratio by which the
        next order was judged, where it was. With ``order="auto"`` the mean square error of
        prediction of each order. ``level_variances`` are those of a value at each level, in DN²; 1
        where no noise was known.
    cfa : Colours or None
        Colour filters of the pixels, where they were given.
    colour_response : dict of str to float, or None
        Response of each colour to the source, of mean 1 over the pixels.
    findings : tuple of Finding
        What limits the result, each also a warning of the fit.

    Notes
    -----
    The corrected value is the mean V̄ that the array, or the pixel's colour, has at the light that
    the pixel sees. K is
    small for a good pixel. A pixel with K = −1 does not respond, and 1/(1 + K) is without bound.
    """

    deviation: Annotated[Floats, "float64", "terms rows cols"]
    variances: Annotated[Floats, "float64", "terms rows cols"]
    inverse: Annotated[Floats, "float64", "terms_of_inverse rows cols"]
    inverse_error: Doubles
    limits: Annotated[Floats, "float64", "2 rows cols"]
    reduced_chi2: Doubles
    used: Counts
    flags: Counts
    levels: Annotated[Floats, "float64", "levels"]
    dark: Map | None = None
    raw: bool = False
    saturation: float | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    cfa: Colours | None = None
    colour_response: dict[str, float] | None = None
    findings: Findings = ()
    takes_dark: ClassVar[bool] = True
    needs_dark: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Refuse numbers of coefficients that do not fit together, and filters that are none."""
        super().__post_init__()
        terms, inverse = len(self.deviation), len(self.inverse)
        if terms not in range(1, 5) or inverse != (2 if terms < 3 else 4):
            raise InputError(
                f"'deviation' has {terms} coefficients and 'inverse' {inverse}, expected 1 or 2 "
                "and 2, or 3 or 4 and 4"
            )
        Colours.of(self.cfa)

    @property
    def leaves_offset(self) -> bool:
        """Whether corrected frames keep the mean offset of raw levels."""
        return self.raw

    @property
    def colours(self) -> Colours | None:
        """Colour filters of the pixels, also where the sensor in `metadata` alone has them."""
        return self.cfa or super().colours

    @property
    def order(self) -> int:
        """Highest power of V̄ in the deviation; 1 also for one point by gain."""
        return len(self.deviation) - 1

    @property
    def freedom(self) -> Array:
        """Degrees of freedom of each pixel's fit: levels used less coefficients, 0 or more."""
        freedom = self.used.astype(np.int64)
        freedom -= self._terms
        return np.maximum(freedom, 0, out=freedom)

    @property
    def _terms(self) -> int:
        """Number of coefficients that were fitted to each pixel."""
        by_gain = self.metadata.get("options", {}).get("order") == 0
        return 1 if by_gain else len(self.deviation)

    @property
    def valid_range(self) -> Floats:
        """Lowest and highest raw value that the levels cover, shape (2, rows, cols), in DN.

        The dark, if there is one, is subtracted.
        """
        return np.stack([response_at(self.deviation, limit) for limit in self.limits])

    @property
    def coefficients(self) -> Floats:
        """Coefficients of the corrected frame Σ c_j y^j of raw y, shape (2 or 4, rows, cols).

        A stored dark is part of them. NaN where the curve is undetermined or does not rise.
        """
        return self.inverse.copy() if self.dark is None else counted_from(self.inverse, self.dark)

    def _planes(self, dtype: DTypeLike) -> Array:
        """The coefficients, rounded to a dtype block by block."""
        if self.dark is None:
            return np.asarray(self.inverse, dtype)
        return counted_from(self.inverse, self.dark, dtype)

    @property
    def largest_inverse_error(self) -> float:
        """Largest difference of the cubic to the exact inverse over usable pixels, in DN."""
        errors = self.inverse_error[usable(self.flags)]
        return float(np.max(errors, initial=0.0))

    def __repr__(self) -> str:
        """Short form: sizes, order and levels."""
        rows, cols = self.shape
        return (
            f"<Response of {rows} x {cols} pixels, order {self.order}, {len(self.levels)} levels>"
        )

    def _formula(self, dark: Dark, exact: bool, /) -> Formula | None:
        """Exact inverse of the curves."""
        if not exact:
            return None
        offset = with_dark(self, dark).dark
        zero = np.zeros(self.shape) if offset is None else offset

        # Curves that have an inverse.
        rising = np.where(np.isnan(self.inverse[0]), np.nan, self.deviation)
        return lambda frame: exact_inverse(rising, frame - zero, self.limits)

    @naming_memory("finding extrapolated values")
    def extrapolated(self, frames: ArrayLike, *, dark: Dark = "stored") -> Bools:
        """Which values lie outside the range that the levels cover, so their correction is a guess.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols)
            Frames in DN, as for `correct`.
        dark : "stored", FrameStatistics, array_like of shape (rows, cols), or None
            As for `correct`.

        Returns
        -------
        ndarray of bool, of the frames' shape
            True below the lowest and above the highest level of the pixel, and where there is no
            value or no curve.

        Raises
        ------
        InputError
            If a shape does not fit.
        """
        raw = checked_frames(frames, self.shape)
        offset = with_dark(self, dark).dark
        low, high = self.valid_range if offset is None else self.valid_range + offset
        return np.asarray(~((raw >= low) & (raw <= high)))

    def with_flags(
        self, flags: Array, *, cfa: ArrayLike | None = None, findings: Findings = ()
    ) -> Self:
        """Return a copy with more flags and findings, such as those of `find_defects`.

        Parameters
        ----------
        flags : ndarray, shape (rows, cols), of whole numbers
            Bits of `equipix.Flag`, combined with those that are there by OR.
        cfa : str or array_like of labels, optional
            Colour filters of the pixels, as for `find_defects`, where the response was fitted
            without: flagged pixels are then replaced within a colour. Curves do not change.
        findings : tuple of Finding
            What limits the flags; those that the response has already are not repeated.

        Returns
        -------
        Response
            The copy; flags and findings survive saving, and so do filters, as ``cfa`` of the
            sensor in `metadata`.

        Raises
        ------
        InputError
            If the shape or dtype does not fit, a number is not one of 32 bits, or `cfa` is no
            pattern or another than that of the response.
        """
        more = as_array("flags", flags, ndim=2)
        if more.shape != self.shape or more.dtype.kind not in "iu":
            raise InputError(
                f"'flags' is {more.dtype} of shape {more.shape}, expected whole numbers of shape "
                f"{self.shape}: bits of equipix.Flag"
            )
        wrong = more[(more < 0) | (more > _LARGEST)]
        if wrong.size:
            raise InputError(
                f"'flags' holds {wrong[0]}, expected bits of equipix.Flag: 0 to {_LARGEST}"
            )
        colours, metadata = named_cfa(self, cfa), self.metadata
        if colours not in (None, self.cfa):
            metadata = {**metadata, "sensor": {**metadata.get("sensor", {}), "cfa": colours.rows}}
        said = tuple(dict.fromkeys(self.findings + findings))
        combined = self.flags | more.astype(np.uint32)
        return replace(self, flags=combined, metadata=metadata, findings=said)


def pattern_variance(response: Response, level: float) -> float:
    """Variance over pixels that the noise of the levels leaves in frames corrected at this V̄.

    With x the powers of V̄ it is xᵀ C x over the square of the slope. C, the covariance of the
    coefficients, is that of the weights of the levels, times what the variance of the highest
    coefficient of a pixel says; of more than 2¹⁹ pixels so many, evenly over the sensor, are asked.
    The noise of a stored dark cancels. NaN behind colour filters,
    whose levels are not stored, and for one point by gain, or by offset with a dark.
    """
    noise, order = response.metadata.get("level_variances"), response.order
    one_point = response.metadata.get("options", {}).get("order") == 0
    if (
        noise is None
        or response.cfa is not None
        or (one_point and (order or response.dark is not None))
    ):
        return float("nan")
    scale = float(np.abs(response.levels).max())
    design = np.vander(response.levels / scale, order + 1, increasing=True)
    covariance = np.linalg.inv(design.T @ (design / np.reshape(noise, (-1, 1))))
    at = (level / scale) ** np.arange(order + 1)
    share = float(at @ covariance @ at / covariance[-1, -1]) * scale ** (2 * order)
    good = chosen(usable(response.flags) & (response.used == len(response.levels)))
    place = np.unravel_index(good, response.shape)
    slope = slope_at(np.stack([each[place] for each in response.deviation])[:, None], level)
    return float(np.mean(share * response.variances[-1][place] / slope**2))


def typical(squares: Floats, freedom: Array) -> float:
    """Median of mean squares of so many degrees of freedom, over the median that noise alone has.

    At most their mean: where rounding is above the noise residuals have few different values, and
    their median may be any of them.
    """
    return float(min(np.median(squares / median_of_noise(freedom)), squares.mean()))


def common_misfit(response: Response) -> float:
    """Reduced χ² that usable pixels have in common, over that of noise alone.

    Of more than 2¹⁹ pixels so many, evenly over the sensor, are asked: with one degree of freedom
    it errs by 0.3 %.
    """
    if response.metadata.get("options", {}).get("weights") != "variances":
        return float("nan")
    judged = chosen(usable(response.flags) & (response.used > response._terms))
    if not judged.size:
        return float("nan")
    freedom = response.used.flat[judged].astype(np.int64) - response._terms
    return typical(response.reduced_chi2.flat[judged], freedom)
