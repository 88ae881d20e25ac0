"""Corrections that follow temperature and bias."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from equipix._check import Floats, number
from equipix.bolometer.states import Axes
from equipix.correction.polynomial import Polynomial
from equipix.errors import InputError
from equipix.findings import Finding, set_bits
from equipix.io.record import Counts, Record
from equipix.io.viewed import Viewed
from equipix.measured.defects import DEAD_RESPONSE

_ROUNDING = 1e-9
"""Relative distance from the calibrated range that counts as in it."""


@dataclass(frozen=True, eq=False, repr=False)
class DynamicCorrection(Record, kind="dynamic correction", version=2):
    """Offset and gain of each pixel against substrate temperature and bias, the result of `fit`.

    Attributes
    ----------
    offset : ndarray, shape (terms, rows, cols), float64
        Coefficients of the deviation d of a pixel before the shutter from the array's mean, in DN,
        for the terms of `axes`; NaN in a pixel that is not determined.
    gain : ndarray, shape (terms, rows, cols), float64, or None
        Coefficients of K, the deviation of a pixel's response from the mean response, relative to
        it, for the terms of `gain_axes`; None without black bodies.
    level : ndarray, shape (terms,), float64
        Coefficients of the array's mean before the shutter, in DN.
    axes, gain_axes : Axes
        Ranges of temperature and bias, and orders, of offset and gain.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.
    metadata : dict
        Versions, options, times and prediction errors, as JSON values.
    findings : tuple of Finding
        What limits the result, each also a warning of the fit.

    Raises
    ------
    InputError
        If the shapes do not fit.

    Notes
    -----
    At the temperature T of the substrate and the bias V a frame y is corrected to

        L + (y − L − d)/(1 + K),

    where L is the array's mean before the shutter, and L, d, K are polynomials of T and V². All
    pixels then have the same value before the shutter and the same response.
    """

    offset: Annotated[Floats, "float64", "terms rows cols"]
    gain: Annotated[Floats, "float64", "gain_terms rows cols"] | None
    level: Annotated[Floats, "float64", "terms"]
    axes: Axes
    gain_axes: Axes
    flags: Counts
    metadata: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        super().__post_init__()
        found = {name: getattr(self, name) for name in ("offset", "gain", "level")}
        wanted = {
            "offset": (self.axes.terms, *self.flags.shape),
            "gain": (self.gain_axes.terms, *self.flags.shape),
            "level": (self.axes.terms,),
        }
        for name, array in found.items():
            if array is not None and array.shape != wanted[name]:
                raise InputError(f"'{name}' has shape {array.shape}, expected {wanted[name]}")

    def __repr__(self) -> str:
        """Short form: sizes, orders and ranges."""
        (rows, cols), (low, high) = self.shape, self.axes.substrate_c
        gain = "no gain" if self.gain is None else f"gain of order {self.gain_axes.order}"
        return (
            f"<DynamicCorrection of {rows} x {cols} pixels, offset of order {self.axes.order}, "
            f"{gain}, {low:g} to {high:g} °C>"
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""
        rows, cols = self.flags.shape
        return rows, cols

    def viewed(self) -> Viewed:
        """Return the gain in the middle of the calibrated range, as other programs show it."""
        low, high = self.axes.substrate_c
        return self.correction((low + high) / 2).viewed()

    def correction(
        self, substrate_c: float, bias_v: float | None = None, *, extrapolate: bool = False
    ) -> Polynomial:
        """Correction at a state: maps of offset and gain for the frames taken there.

        Parameters
        ----------
        substrate_c : float
            Temperature of the substrate in °C.
        bias_v : float, optional
            Bias in volts; the middle of the calibrated range, in V², unless given.
        extrapolate : bool
            Whether a state outside of the calibrated range is allowed. Polynomials soon fail there.

        Returns
        -------
        Polynomial
            Of order 1; `equipix.Corrector` takes it, it can be saved, and its `metadata` hold the
            state. A pixel whose response at this state is below half of that of the array is
            flagged ``DEAD``: where a polynomial crosses 0 gains have no limit.

        Raises
        ------
        InputError
            If the state is not finite, or outside of the range and `extrapolate` is not set.

        Notes
        -----
        Make it anew for every frame, or whenever the thermometer shows another value: typical
        pixels need the temperature to about a millikelvin for 1/250 000 of the range. It takes one
        product and sum for each pixel and term.
        """
        low, high = self.axes.bias_v
        middle = low if low == high else float(np.sqrt((low**2 + high**2) / 2))
        volts = middle if bias_v is None else number("bias_v", bias_v)
        celsius = number("substrate_c", substrate_c)
        _check_inside("substrate_c", celsius, self.axes.substrate_c, "°C", extrapolate)
        _check_inside("bias_v", volts, self.axes.bias_v, "V", extrapolate)
        terms = self.axes.basis(celsius, volts)[0]
        level = float(terms @ self.level)
        deviation = np.tensordot(terms, self.offset, 1)
        response = np.ones(self.shape)
        if self.gain is not None:
            response += np.tensordot(self.gain_axes.basis(celsius, volts)[0], self.gain, 1)
        with np.errstate(divide="ignore", invalid="ignore"):  # in pixels that do not respond
            gain = np.where(response == 0, np.nan, 1 / response)
        state = {"substrate_c": celsius, "bias_v": volts}
        metadata = self.metadata | {"state": state}
        offset = level - (level + deviation) * gain
        # Corrected frames hold the level L.
        planes = np.stack([offset, gain])
        flags = self.flags.copy()
        set_bits(flags, "non_responding", response < DEAD_RESPONSE)
        return Polynomial(planes, flags, metadata, leaves_offset=True, findings=self.findings)


def _check_inside(
    name: str, value: float, ends: tuple[float, float], unit: str, extrapolate: bool
) -> None:
    """Refuse a state outside of the range that the references cover."""
    margin = _ROUNDING * (ends[1] - ends[0] + abs(ends[1]))
    inside = ends[0] - margin <= value <= ends[1] + margin
    if not np.isfinite(value) or not (inside or extrapolate):
        raise InputError(
            f"'{name}' is {value:g} {unit}, but the references cover {ends[0]:g} to {ends[1]:g} "
            f"{unit}: take references there, or set extrapolate=True in Python"
        )
