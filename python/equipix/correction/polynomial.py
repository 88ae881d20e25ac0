"""A correction that is its coefficients, and the combination of two corrections."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from equipix._check import Array, check_type
from equipix.correction.apply import RawCorrection
from equipix.correction.protocol import Correction, check_correction, sensor_table
from equipix.errors import InputError
from equipix.findings import Finding
from equipix.io.record import Counts, Record, made

_MOST = 4
"""Most coefficients that the compiled part applies."""


@dataclass(frozen=True, eq=False, repr=False)
class Polynomial(RawCorrection, Record, kind="polynomial", version=2):
    """A correction Σ c_j y^j of raw values y, such as two corrections combined.

    Attributes
    ----------
    coefficients : ndarray, shape (order + 1, rows, cols)
        Coefficients c for y in DN, lowest power first, order 1 to 3; NaN where undetermined.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.
    metadata : dict
        Origin, as JSON values.
    saturation : float or None
        Level of saturation of the raw values in DN, where it is known.
    leaves_offset : bool
        Whether corrected frames hold an offset, such as the mean one of raw levels, which no gain
        may multiply.
    findings : tuple of Finding
        What limits it: of two corrections combined, those of both.

    Raises
    ------
    InputError
        If the shapes do not fit.
    """

    coefficients: Annotated[Array, "float32|float64", "terms rows cols"]
    flags: Counts
    metadata: dict[str, Any] = field(default_factory=dict)
    saturation: float | None = None
    leaves_offset: bool = False
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        for name in ("coefficients", "flags"):
            check_type(name, getattr(self, name), np.ndarray, "an array")
        super().__post_init__()
        planes, shape = self.coefficients.shape[:1], self.coefficients.shape[1:]
        if shape != self.flags.shape or not 2 <= planes[0] <= _MOST or len(shape) != 2:
            raise InputError(
                f"'coefficients' has shape {self.coefficients.shape} and 'flags' "
                f"{self.flags.shape}, expected (2 to {_MOST}, rows, cols) and (rows, cols)"
            )

    def __repr__(self) -> str:
        """Short form: sizes and order."""
        rows, cols = self.shape
        return f"<Polynomial of {rows} x {cols} pixels, degree {len(self.coefficients) - 1}>"


def combine(first: Correction, then: Correction) -> Polynomial:
    """Correction that does what two do one after the other.

    Parameters
    ----------
    first : Correction
        Applied to raw frames: such as response curves, or a lens fall-off.
    then : Correction
        Applied to the result, so measured on frames that `first` has corrected: offset and gain,
        such as a lens fall-off, or a shift calibration of corrected exposures. One of raw exposures
        holds the gain that `first` takes away already, which would be taken away twice. A gain
        needs a `first` that leaves no offset.

    Returns
    -------
    Polynomial
        Of the order of `first`, with its level of saturation and the flags of both; `metadata`
        holds that of both, versions and time, and what is known of the sensor.

    Raises
    ------
    InputError
        If the sensors differ in shape, or in the name or the bit depth where both metadata have
        one, or `then` is of an order above 1, subtracts a dark frame, or is of raw frames: a
        response to averages of raw levels, or the result of a scene method, or has the offsets and
        gains of `first`; or `then` is a gain alone, and `first` leaves an offset in frames that it
        has corrected, as a response to averages of raw levels, a scene method or a correction of
        bolometers: the gain would multiply it.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> gain = np.array([[0.9, 1.0, 1.1]])
    >>> response = equipix.nuc.fit([100 * gain, 1000 * gain], order=1)
    >>> lens = equipix.Polynomial(np.array([[[0.0, 0, 0]], [[1.1, 1, 1.2]]]), response.flags)
    >>> both = equipix.combine(response, lens)
    >>> bool(np.allclose(both.coefficients[1], lens.coefficients[1] * response.coefficients[1]))
    True
    """
    check_correction("first", first)
    check_correction("then", then)
    if first.shape != then.shape:
        raise InputError(f"'first' is of shape {first.shape}, 'then' of {then.shape}")
    sensor = _common_sensor(first, then)
    if then.dark is not None:
        raise InputError(
            f"'then' subtracts a dark frame of {np.nanmean(then.dark):.4g} DN in the mean, which "
            "frames that 'first' has corrected do not hold: expected a correction without one"
        )
    after = np.asarray(then.coefficients, np.float64)
    if len(after) > 2:
        raise InputError(
            f"'then' has degree {len(after) - 1} in the raw value, expected 1, offset and gain: "
            "combine in the other order, or correct frames twice"
        )
    gain = after[1] if len(after) == 2 else 0.0
    _refuse_raw(then)
    before = np.asarray(first.coefficients, np.float64)
    multiplies = np.any(np.nan_to_num(gain, nan=1.0) != 1.0)
    shifts = np.nan_to_num(after[0]).any()
    if (multiplies or shifts) and np.array_equal(before, after, equal_nan=True):
        raise InputError(
            "'then' has the offsets and gains of 'first', which would be applied twice: expected "
            "a correction of frames that 'first' has corrected"
        )
    leaves = first.leaves_offset and not shifts
    if leaves and multiplies:
        raise InputError(
            "'first' leaves an offset in corrected frames, as a response to raw levels, a scene "
            "method or a correction of bolometers does, and the gain of 'then' would multiply it: "
            "average levels with a dark, equipix.average(frames, dark=dark), and fit again, or "
            "subtract a corrected frame without light, such as of a shutter, before 'then'"
        )
    coefficients = before * gain
    coefficients[0] += after[0]
    metadata = made(first=first.metadata, then=then.metadata)
    if sensor:
        metadata["sensor"] = sensor
    flags, findings = first.flags | then.flags, first.findings + then.findings
    return Polynomial(coefficients, flags, metadata, first.saturation, leaves, findings)


def _common_sensor(first: Correction, then: Correction) -> dict[str, Any]:
    """Return the sensor of `first`, with the name and the bits of that of `then` where it has none.

    Levels of `then` are those of corrected frames, so none is taken over.
    """
    one, other = (sensor_table(each.metadata) for each in (first, then))
    for key, words in (("name", "the sensor"), ("bit_depth", "a sensor of the bit depth")):
        known, found = one.get(key), other.get(key)
        if known and found and known != found:
            raise InputError(
                f"'first' is of {words} {known!r}, 'then' of {found!r}: expected one sensor"
            )
    # Without any the bits follow from the level of saturation of `first`.
    taken = ("name",) if first.bits else ("name", "bit_depth")
    added = {key: other[key] for key in taken if other.get(key) and not one.get(key)}
    colours = first.colours or then.colours
    return {**one, **added, **({} if colours is None else {"cfa": colours.rows})}


def _refuse_raw(then: Correction) -> None:
    """Refuse a second correction that holds the offsets of raw frames."""
    if "scene" in then.metadata:
        raise InputError(
            "'then' is the result of a scene method, which does not state whether its frames were "
            "raw or corrected by 'first': correct frames by 'first' and then by 'then'"
        )
    if then.leaves_offset:
        raise InputError(
            "'then' holds the offsets of raw levels, which 'first' takes away already: fit it to "
            "levels that 'first' has corrected"
        )
