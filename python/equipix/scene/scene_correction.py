"""What all corrections from the scene share: update and state."""

from dataclasses import KW_ONLY, Field, dataclass, field, fields
from os import PathLike
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from equipix._check import (
    Array,
    Bools,
    as_array,
    as_level,
    check_shape,
    is_whole,
    number,
    positive_workers,
)
from equipix._native import SceneCorrection as Native
from equipix.correction.polynomial import Polynomial
from equipix.errors import InputError
from equipix.findings import Rule, ask, say, set_bits
from equipix.io.record import Record, made
from equipix.measured.defects import unresponsive
from equipix.shown import Shown

DataRange = tuple[float, float]
"""Lowest and highest raw value in DN."""

_FEW = 0.1
"""Share of the frames that counted below which it is a finding."""

_FLOOR = 32
"""Frames that count before the compiled part measures the floor."""

_STILL = 0.25
"""Share of the field that never moved above which it is a finding."""

_USED = 0.3
"""Share of the range that frames use below which it is a finding."""

_SPREAD = 0.3
"""Standard deviation of the gains above which it is a finding."""

_FIRST_MASK = 64
"""Frames after which pixels that do not respond are masked for the first time."""

_TAKEN = (np.uint8, np.uint16, np.float32, np.float64)
"""Types that the compiled part takes as they are."""


@dataclass(frozen=True, eq=False)
class SceneState(Record, kind="state of a correction from the scene", version=5):
    """All that a correction from the scene remembers: its options, maps and counts."""

    maps: dict[str, Annotated[Array, "float32", "* *"]]
    mask: Annotated[Bools, "bool", "rows cols"]
    method: str
    shape: tuple[int, int]
    data_range: DataRange
    saturation: float | None
    options: dict[str, Any]
    counts: dict[str, int]
    peak: float | None


@dataclass
class _Seen:
    """What changes with the frames, beside the compiled part.

    `masked_at` is the number of frames after which pixels that do not respond were masked, `peak`
    the largest value.
    """

    masked_at: int = 0
    peak: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class SceneCorrection(Shown):
    """Base of the corrections from the scene: gain and offset that each frame changes.

    Raw values v become y = (v − low) / (high − low) with the ends of `data_range`. The corrected
    frame is X = gain · y + offset, in DN low + (high − low) · X. After every frame the mean of the
    gains is 1 and that of the offsets 0. Coefficients are of single precision.

    Frames with a value that is not finite, and frames of which half of the rows or more hold one
    value each, such as frames that were lost or cut, are corrected but change no state. A value
    more than one span outside of the range is refused.

    Values from `saturation` on, by default the largest whole number of the frames' dtype, do not
    change their pixels, nor the pixels with more than an eighth of such values around them.

    Pixels of `mask` do not learn, and others do not learn from them; from 64 frames on those that
    vary by less than half of what the pixels around them do are masked too. A frame that differs
    from the one before and from the last usable one by more than three times the usual change, as
    one of a shutter, is corrected and changes nothing (`Registered` compares pairs instead).

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    data_range : tuple of float
        Lowest and highest raw value in DN, which become 0 and 1; also of a dtype.
    saturation : float or None
        Saturation level in DN that was given.
    workers : int or None
        Number of threads that was given.
    mask : array_like or None
        Pixels that are not used, as they were given.

    Notes
    -----
    A method is a dataclass, whose own fields are its options. They are checked by their defaults:
    whole numbers, numbers, or weights.
    """

    shape: tuple[int, int]
    data_range: DTypeLike | DataRange
    _: KW_ONLY
    saturation: float | None = None
    workers: int | None = None
    mask: ArrayLike | None = None
    _range: DataRange = field(init=False)
    _native: Native = field(init=False)
    _mask: Bools = field(init=False)
    _seen: _Seen = field(init=False, default_factory=_Seen)

    method: ClassVar[str] = ""
    """Name of the method, as the command line takes it."""

    _UNLEARNED: ClassVar[str] = "take frames first"
    """What to do where no frame counted."""

    def __post_init__(self) -> None:
        """Check what all methods take, and the options of the method."""
        kept = vars(self)
        kept["shape"] = check_shape(self.shape)
        kept["data_range"] = kept["_range"] = _range_of(self.data_range)
        kept["saturation"] = as_level(self.saturation)
        kept["workers"] = positive_workers(self.workers)
        kept |= {each.name: _option(each, kept[each.name]) for each in _options_of(self)}
        kept |= {"_mask": _mask_of(self.mask, self.shape), "_native": self._made()}
        if self._mask.any():
            self._native.mask(self._mask)

    def _made(self) -> Native:
        """Make the compiled correction, which has the name of the method."""
        make = getattr(Native, self.method.replace("-", "_"))
        made: Native = make(self.shape, self._range, **self.options)
        return made

    def __repr__(self) -> str:
        """Short form: method, sizes and frames."""
        rows, cols = self.shape
        return f"<{type(self).__name__} of {rows} x {cols} pixels, {self.frames} frames>"

    @property
    def options(self) -> dict[str, Any]:
        """Keywords of the method, as JSON values."""
        return {each.name: getattr(self, each.name) for each in _options_of(self)}

    @property
    def frames(self) -> int:
        """Number of frames that counted: of methods that need motion, those that moved."""
        return self._native.frames()

    @property
    def frames_taken(self) -> int:
        """Number of usable frames that were given, whether they counted or not."""
        return self._native.taken()

    @property
    def frames_foreign(self) -> int:
        """Number of frames that were refused since they differ from the ones before and after."""
        return self._native.foreign()

    @property
    def floor(self) -> float | None:
        """Upper limit in DN of the rms pattern that the method leaves, measured by itself.

        It follows from how much the pattern still changes, of `Kalman` from its variances, at the
        mean of the frames: None before 32 frames that counted. It is up to 1.5 times what is left,
        and includes nothing that stands still in all frames. While a pattern is still being
        learned, it is larger.
        """
        found = self._native.floor(self.workers)
        return None if found is None else found * (self._range[1] - self._range[0])

    @property
    def gain(self) -> Array:
        """Gain of each pixel, mean 1, shape (rows, cols), float32, read-only."""
        return self._native.coefficients()[0]

    @property
    def offset(self) -> Array:
        """Offset of each pixel in DN, mean 0, shape (rows, cols), float32.

        It is that of the formula corrected = low + gain · (raw − low) + offset.
        """
        low, high = self._range
        return self._native.coefficients()[1] * np.float32(high - low)

    def update(self, frame: ArrayLike) -> Array:
        """Correct a frame by the coefficients so far, then learn from it.

        Parameters
        ----------
        frame : array_like, shape (rows, cols)
            Raw frame in DN.

        Returns
        -------
        ndarray, shape (rows, cols), float32
            The corrected frame in DN.

        Raises
        ------
        InputError
            If the frame has another shape, a finite value more than one span outside of the range,
            or whole numbers of a type that does not reach half of it; then nothing has changed.
        """
        raw = as_array("frame", frame, ndim=2)
        if raw.shape != self.shape or raw.dtype == np.bool_:
            raise InputError(
                f"'frame' is {raw.dtype} of shape {raw.shape}, expected numbers of {self.shape}"
            )
        check_range(self._range, raw.dtype, "'frame'")
        taken = raw if raw.dtype in _TAKEN else raw.astype(np.float64)
        corrected = np.empty(self.shape, np.float32)
        level = self.saturation
        if level is None and raw.dtype.kind in "iu":
            level = float(np.iinfo(raw.dtype).max)
        self._native.update(taken, corrected, saturation=level, workers=self.workers)
        if np.isfinite(top := float(raw.max())):
            peak = self._seen.peak
            self._seen.peak = top if peak is None else max(peak, top)
        self._mask_unresponsive()
        return corrected

    def _mask_unresponsive(self) -> None:
        """Mask pixels that do not respond, after 64 frames and each time that they doubled."""
        taken = self.frames_taken
        if taken < _FIRST_MASK or taken & (taken - 1) or taken == self._seen.masked_at:
            return
        self._seen.masked_at = taken
        weak = unresponsive(np.ones(self.shape), self._native.deviation(), taken)
        if not (self._mask | weak).all():
            self._native.mask(self._mask | weak)

    def _learned(self) -> bool:
        """Whether the coefficients have changed."""
        return self.frames > 0

    def check_learned(self) -> None:
        """Refuse to give a result where no frame counted.

        Raises
        ------
        InputError
            If no frame counted: the scene never moved, or too few frames were taken.
        """
        if not self._learned():
            raise InputError(
                f"{type(self).__name__} has learned nothing, from {self.frames} frames that "
                f"counted: {self._UNLEARNED}"
            )

    def correction(self) -> Polynomial:
        """Correction by the coefficients so far.

        Returns
        -------
        Polynomial
            Corrected frame c_0 + c_1 · raw in DN, with c_1 the gain and c_0 the offset for raw
            values in DN. A pixel that varies over the frames by less than half of what its
            neighbours do is flagged ``DEAD``, from 51 frames on, and one of a gain above 2.

        Raises
        ------
        InputError
            If no frame counted: the scene never moved, or too few frames were taken.

        Warns
        -----
        InputWarning
            If fewer than 32 frames or a tenth of the usable ones counted, a quarter of the field
            never moved, the frames use less than a third of the range, or the gains spread too far.
        """
        self.check_learned()
        gain, offset = (each.astype(np.float64) for each in self._native.coefficients())
        low, high = self._range
        flags = np.zeros(self.shape, np.uint32)
        set_bits(flags, "out_of_range", self._mask)
        set_bits(flags, "dead", unresponsive(gain, self._native.deviation(), self.frames_taken))
        scene = {
            "method": self.method,
            "options": self.options,
            "data_range": list(self._range),
            "saturation": self.saturation,
            "frames": self.frames,
            "frames_taken": self.frames_taken,
            "frames_foreign": self.frames_foreign,
            "floor_dn": self.floor,
        }
        learned = _Learned(self, self._native.still(), self._seen.peak, gain[flags == 0])
        said = say(*ask(_RULES, learned))
        coefficients = np.stack([low * (1 - gain) + (high - low) * offset, gain])
        # The mean of the offsets is 0, so that of raw frames stays.
        # No saturation: bits would follow from it, and frames that `update` takes be refused.
        return Polynomial(coefficients, flags, made(scene=scene), leaves_offset=True, findings=said)

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write the state to a file, from which `equipix.load` goes on with the same bytes.

        Parameters
        ----------
        path : str or path
            The file; its suffix, .tif, .npz, .fits, .nxs or .asdf, names the format.
        force : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            If the file exists and `force` is not set, or it cannot be written.
        """
        maps, counts = self._native.state()
        made_of = (self.method, self.shape, self._range, self.saturation, self.options)
        state = SceneState(dict(maps), self._mask, *made_of, dict(counts), self._seen.peak)
        state.save(path, force=force)

    def restore(self, state: SceneState) -> None:
        """Go on from the maps and counts of a state; the errors are those of `resumed`."""
        self._native.restore([*state.maps.items()], [*state.counts.items()])
        self._seen.masked_at, self._seen.peak = self.frames_taken, state.peak


def check_range(data_range: DataRange, dtype: np.dtype[Any], place: str) -> None:
    """Refuse frames of whole numbers whose type does not reach half of the range.

    Raises
    ------
    InputError
        With the place, the type and the range.
    """
    low, high = data_range
    if dtype.kind in "iu" and np.iinfo(dtype).max < (low + high) / 2:
        raise InputError(
            f"{place}: the range of raw values is {low:g} to {high:g} DN, but the frames are "
            f"{dtype}, up to {np.iinfo(dtype).max}: give frames of the same bits, or their range "
            "as 'data_range' (--data-range)"
        )


def _mask_of(mask: ArrayLike | None, shape: tuple[int, int]) -> Array:
    """Pixels that are not used, where the mask is not 0."""
    if mask is None:
        return np.zeros(shape, bool)
    masked: Array = as_array("mask", mask, ndim=2) != 0
    if masked.shape != shape:
        raise InputError(f"'mask' has shape {masked.shape}, expected {shape}")
    return masked


class _Learned(NamedTuple):
    """What was learned: in which share of the field, up to which value; the gains."""

    method: SceneCorrection
    still: float | None
    peak: float | None
    gain: Array


def _on_few(e: _Learned) -> str | None:
    """Say that few frames counted: the scene moved hardly, or was not seen to."""
    frames, taken = e.method.frames, e.method.frames_taken
    if frames >= _FEW * taken:
        return None
    return (
        f"{frames} of {taken} frames counted: the scene moved hardly, or "
        "its contrast is too low for its motion to be seen beside the pattern"
    )


def _on_floor(e: _Learned) -> str | None:
    """Say that a pattern was learned of so few frames that what it leaves is not known."""
    if e.method.frames >= _FLOOR:
        return None
    return (
        f"only {e.method.frames} of the frames counted (limit {_FLOOR}, from which 'floor' is "
        "measured): which part of the pattern is their scene is not known; take more frames"
    )


def _on_still(e: _Learned) -> str | None:
    """Say that much of the field never moved: its scene became part of the pattern."""
    if e.still is None or e.still <= _STILL:
        return None
    return (
        f"in {e.still:.0%} of the field (limit {_STILL:.0%}) nothing moves from frame to "
        "frame: a scene that stands still there, or frames that do not follow one another, "
        "became part of the pattern; take a scene that moves over the whole field"
    )


def _on_range(e: _Learned) -> str | None:
    """Say that the range is far wider than the frames: thresholds are shares of it."""
    (low, high), peak = e.method._range, e.peak
    if peak is None or peak >= low + _USED * (high - low):
        return None
    bits = max(int(np.ceil(np.log2(max(peak, 1) + 1))), 1)
    return (
        f"the largest value is {peak:g} DN, less than {_USED:.0%} of the range "
        f"({low:g}, {high:g}): thresholds are shares of it. Give data_range=(0, "
        f"{2**bits - 1}), on the command line --bit-depth {bits}"
    )


def _on_spread(e: _Learned) -> str | None:
    """Say that gains spread further than those of cameras."""
    gain = e.gain
    if not gain.size or np.std(gain) <= _SPREAD:
        return None
    return (
        f"the gains spread by {np.std(gain):.2g} (limit {_SPREAD:g}), from {gain.min():.2g} to "
        f"{gain.max():.2g}: the scene does not determine them; take a scene of more contrast, "
        "or less noise"
    )


_RULES: tuple[Rule[_Learned], ...] = (
    Rule("unused", "input", _on_few),
    Rule("few", "input", _on_floor, unless=frozenset({"unused"})),
    Rule("still", "input", _on_still),
    Rule("range", "input", _on_range),
    Rule("spread", "input", _on_spread),
)
"""What is asked of a correction from the scene."""


def _options_of(method: SceneCorrection) -> tuple[Field[Any], ...]:
    """Fields of a method that others do not have."""
    return fields(method)[len(fields(SceneCorrection)) :]


def _option(field: Field[Any], value: Any) -> Any:
    """Check an option by its default: a whole number, a number, or weights."""
    if isinstance(field.default, float):
        return number(field.name, value)
    if not isinstance(field.default, int):
        return as_array(field.name, value, ndim=2).astype(np.float64).tolist()
    if not is_whole(value, 0):
        raise InputError(f"'{field.name}' is {value!r}, expected a whole number")
    return int(value)


def _range_of(data_range: DTypeLike | DataRange) -> DataRange:
    """Lowest and highest raw value: given, or those of whole numbers."""
    if isinstance(data_range, tuple | list) and len(data_range) == 2:
        low, high = (number("data_range", value) for value in data_range)
        if not -np.inf < low < high < np.inf:
            raise InputError(
                f"'data_range' is {data_range!r}, expected (low, high), finite, rising"
            )
        return low, high
    try:
        limits = np.iinfo(np.dtype(data_range))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"'data_range' is {data_range!r}, expected (low, high) in DN, or whole numbers such as "
            "'uint16'"
        ) from error
    return float(limits.min), float(limits.max)
