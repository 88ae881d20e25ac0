"""A table of words: made, applied, written, read."""

from dataclasses import dataclass
from os import PathLike
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from equipix import _native
from equipix._check import Array, ArrayLike, Floats, naming_memory, number, positive_workers
from equipix.correction.apply import Formula, RawCorrection, checked_frames, each_frame
from equipix.correction.protocol import Correction, Dark, check_correction, with_dark
from equipix.errors import InputError
from equipix.findings import Finding, say, usable
from equipix.hardware import c_header, table_files
from equipix.hardware.encode import (
    Steps,
    encode,
    line_of,
    origin,
    refuse_far_lowest,
    refuse_far_offsets,
)
from equipix.hardware.table_files import Content
from equipix.hardware.words import (
    NARROWEST,
    WIDEST,
    WIDTHS,
    check_width,
    chosen_exponent,
    exponent_of,
)
from equipix.io import tiff
from equipix.io.paths import as_path, check_suffix, reading, write_whole
from equipix.measured.colour import Colours

_ADC_BITS = 14
"""Bits of the ADC where those of the sensor are unknown."""

_COARSE = 0.005
"""Largest error of words, over the range of the ADC."""

_KEPT = 0.99
"""Least share of the raw values that the ADC must hold."""

UPLOAD: dict[str, Any] = {"dac_bits": 0, "gain_bits": 12, "gain_step": 2.0**-10}
"""Gains as cameras take them for their own flat-field correction: steps of 1/1024, below 4."""


class Applied(NamedTuple):
    """Corrected words, and how many outputs were limited to 0 and to the largest word."""

    words: Array
    below: int
    above: int


@dataclass(frozen=True, eq=False, repr=False)
class Table(RawCorrection, Content):
    r"""Words of a correction: a coarse offset ahead of the ADC, fine offset and gain behind it.

    Attributes
    ----------
    format : Format
        Widths of the words and the steps that they stand for.
    coarse : ndarray, shape (rows, cols), uint16
        Words of the DAC, which the amplifier subtracts ahead of the ADC.
    offset : ndarray, shape (rows, cols), int16
        Words of the fine offset.
    gain : ndarray, shape (rows, cols), uint16
        Words of the gain; 0 is the code of a pixel that must not be used.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.
    metadata : dict
        Version, hash of the correction, largest error, as JSON values.

    Raises
    ------
    InputError
        If arrays do not fit together, or words do not fit their widths.

    Notes
    -----
    With the word x of the ADC, the steps s and the gain g and offset o of a pixel,

    .. math:: x = \mathrm{round}((y - D s_D) / s_x), \qquad
        z = b + \mathrm{round}((g s_g x s_x + o s_o) / s_z)

    rounded half to even, and limited to the words of the ADC and of the output. The corrected value
    is zero + z in steps of the output.

    Examples
    --------
    >>> import equipix
    >>> from equipix import hardware, simulate
    >>> array = simulate.StaringArray.of("InSb", (24, 32), rng=1)
    >>> levels = [equipix.average(array.frames(e, 16, rng=k)) for k, e in enumerate((4e6, 16e6))]
    >>> response = equipix.nuc.fit(levels, order=1)
    >>> table = hardware.Table.of(response, offset_bits=12, gain_bits=12)
    >>> frame = next(array.frames(10e6, 1, rng=9))
    >>> words = table.apply(table.digitise(frame))
    >>> difference = words * 2.0**table.format.out - response.correct(frame)
    >>> bool(abs(difference).max() < 2**table.format.out / 2 + table.metadata["largest_error_dn"])
    True
    """

    saturation: ClassVar[None] = None

    def __repr__(self) -> str:
        """Short form: sizes and widths."""
        rows, cols = self.shape
        f = self.format
        return (
            f"<Table of {rows} x {cols} pixels, DAC {f.dac_bits}, ADC {f.adc_bits}, offset "
            f"{f.offset_bits}, gain {f.gain_bits}, output {f.out_bits} bits>"
        )

    @classmethod
    def of(
        cls,
        correction: Correction,
        *,
        adc_bits: int | None = None,
        dac_bits: int = 8,
        offset_bits: int = 12,
        gain_bits: int = 16,
        out_bits: int = 16,
        adc_step: float = 1.0,
        out_step: float | None = None,
        dac_step: float | None = None,
        offset_step: float | None = None,
        gain_step: float | None = None,
        lowest: float = 0.0,
        linearise: tuple[float, float] | None = None,
    ) -> Self:
        """Words of a correction.

        Parameters
        ----------
        correction : Correction
            A calibration, a response of order up to 1, or any other with offset and gain. Pixels
            flagged ``DO_NOT_USE`` or NaN get words of 0.
        adc_bits : int, optional
            Width of the words of the ADC, 8 to 16; the bits of the sensor unless given, 14 where
            they are unknown.
        dac_bits, offset_bits, gain_bits, out_bits : int
            Widths of the other words, 8 to 16. Without a DAC `dac_bits` is 0: the ADC then sees raw
            values, and there is no coarse memory.
        adc_step, out_step : float
            DN of the correction in a step of the ADC and of the output, powers of two. Unless
            given, the output has the range of the ADC.
        dac_step, offset_step : float, optional
            DN in a step of the DAC and of the fine offset, powers of two. Unless given, the finest
            with which the words of all usable pixels fit.
        gain_step : float, optional
            Step of the gain, a power of two; the finest that fits unless given.
        lowest : float
            Corrected value in DN that the ADC must still see: the DAC subtracts no more than
            leaves each pixel a word of 0 there, and the output 0 stands for it. Choose it some
            noise below the darkest scene, within the corrected values of the sensor's raw values.
        linearise : tuple of float, optional
            Two raw values in DN of the sensor's range. Between them a straight line replaces a
            correction of order 2 or 3. It is parallel to the chord, and half of the sag away on
            either side: ``metadata["linearised"]`` has the largest sag, the range of the deviations
            from the chord at 65 raw values.

        Returns
        -------
        Table
            Its ``metadata["largest_error_dn"]`` bounds the error of rounded gains and offsets. Half
            a step of the output, and half a step of the ADC times the gain, come beside it.

        Raises
        ------
        InputError
            If a width, a step or another value is out of range, the correction is curved, or words
            of usable pixels do not fit; the message has their number and the width that would hold
            them.

        Warns
        -----
        InputWarning
            If words are off by more than 0.5 % of the range of the ADC, or the ADC does not hold
            the raw values of the sensor's bit depth, where the metadata have that; or if the line
            of `linearise` leaves a pattern of more than a step of the ADC.
        """
        check_correction("correction", correction)
        if adc_bits is None:
            adc_bits = min(max(correction.bits or _ADC_BITS, NARROWEST), WIDEST)
        if dac_bits == 0 and dac_step is not None:
            raise InputError(f"'dac_step' is {dac_step!r}, but 'dac_bits' is 0: leave it out")
        bits = zip(WIDTHS, (adc_bits, dac_bits, offset_bits, gain_bits, out_bits), strict=True)
        widths = {name: check_width(name, width) for name, width in bits}
        if not np.isfinite(number("lowest", lowest)):
            raise InputError(f"'lowest' is {lowest!r}, expected a corrected value in DN")
        adc, out = exponent_of("adc_step", adc_step), chosen_exponent("out_step", out_step)
        steps = Steps(
            adc,
            chosen_exponent("dac_step", dac_step),
            chosen_exponent("offset_step", offset_step),
            chosen_exponent("gain_step", gain_step),
            adc + widths["adc_bits"] - widths["out_bits"] if out is None else out,
        )
        with naming_memory("making a table"):
            largest = _largest_raw(correction, adc)
            line, (sag, pattern) = line_of(correction, linearise, largest)
            found = encode(line, correction.flags, widths, steps, float(lowest))
            refuse_far_lowest(found, line, largest)
            refuse_far_offsets(found, line, widths, steps, float(lowest))
        colours, source = correction.colours, origin(correction)
        depth = correction.bits if source.get("sensor", {}).get("bit_depth") else 0
        said = say(*_limits(found, depth, sag, pattern))
        metadata = {
            **source,
            **({} if colours is None else {"cfa": colours.rows}),
            **({"leaves_offset": True} if correction.leaves_offset else {}),
            **found.metadata,
            "findings": [vars(each) for each in (*correction.findings, *said)],
        }
        if linearise is not None:
            metadata["linearised"] = {"raw": [float(each) for each in linearise], "sag_dn": sag}
        return cls(**vars(found) | {"metadata": metadata})

    @property
    def leaves_offset(self) -> bool:
        """Whether words were made of a correction that leaves an offset."""
        return bool(self.metadata.get("leaves_offset", False))

    @property
    def colours(self) -> Colours | None:
        """Colour filters of the pixels, where they are known."""
        return Colours.of(self.metadata.get("cfa"))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What limits the correction that it is of, and its words."""
        return tuple(Finding(**each) for each in self.metadata.get("findings", ()))

    @property
    def coefficients(self) -> Floats:
        """Offset and gain that the words stand for, shape (2, rows, cols); NaN where unusable."""
        f = self.format
        gain = np.ldexp(self.gain.astype(np.float64), f.gain)
        offset = np.ldexp(self.offset.astype(np.float64), f.offset)
        offset += np.ldexp(float(f.zero + f.base), f.out)
        offset -= gain * np.ldexp(self.coarse.astype(np.float64), f.coarse)
        return np.where(usable(self.flags), np.stack([offset, gain]), np.nan)

    def digitise(self, frames: ArrayLike) -> Array:
        """Words of the ADC behind the subtracting amplifier, for frames as without the DAC.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols)
            Raw values in DN of the correction, whole or not.

        Returns
        -------
        ndarray, of the frames' shape, uint16
            Rounded half to even and limited to the words of the ADC; 0 for a pixel that must not
            be used.

        Raises
        ------
        InputError
            If a shape does not fit, or a usable pixel is not finite.
        """
        raw, f, used = checked_frames(frames, self.shape), self.format, usable(self.flags)
        pedestal = np.ldexp(self.coarse.astype(np.float64), f.coarse)
        words = np.empty(raw.shape, np.uint16)
        for source, target in zip(each_frame(raw), each_frame(words), strict=True):
            lost = int(np.count_nonzero(~np.isfinite(source) & used))
            if lost:
                raise InputError(f"'frames' holds {lost} usable pixels that are not finite")
            steps = np.rint(np.ldexp(np.where(used, source, 0) - pedestal, -f.adc))
            target[...] = np.clip(steps, 0, f.largest_word)
        return words

    def apply(self, frames: ArrayLike, *, workers: int | None = None) -> Array:
        """Corrected words, bit by bit as the electronics gives them.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols), uint8 or uint16
            Words of the ADC, with the coarse words loaded into the DAC; `digitise` simulates them.
        workers : int, optional
            Threads; all processors unless given. The words are the same for any number.

        Returns
        -------
        ndarray, of the frames' shape, uint16
            Words of the output, 0 for a pixel that must not be used.

        Raises
        ------
        InputError
            If the shape or the dtype does not fit, or a word exceeds the largest of the ADC.
        """
        return self.applied(frames, workers=workers).words

    def applied(self, frames: ArrayLike, *, workers: int | None = None) -> Applied:
        """Like `apply`, with the numbers of outputs that were limited."""
        words = adc_words(frames, self.shape)
        out, stack, f = np.empty(words.shape, np.uint16), (-1, *self.shape), self.format
        below, above = _native.apply_words(
            words.reshape(stack),
            np.ascontiguousarray(self.gain),
            np.ascontiguousarray(self.offset),
            out.reshape(stack),
            (f.adc_bits, f.out_bits, f.adc, f.offset, f.gain, f.out, f.base),
            workers=positive_workers(workers),
        )
        return Applied(out, below, above)

    def _formula(self, dark: Dark, exact: bool, /) -> Formula:
        """Amplifier, ADC and table, in DN: the offsets are words, so no other dark is taken."""
        with_dark(self, dark)
        super()._formula(dark, exact)

        def formula(frame: Array) -> Array:
            words = self.apply(self.digitise(frame))
            return np.ldexp(self.format.zero + words.astype(np.float64), self.format.out)

        return formula

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write to a file that `equipix.load` reads bit by bit.

        Parameters
        ----------
        path : str or path
            The file; its suffix names the format: .bin, .hex (for ``$readmemh``) or .h (C); or
            .tif, which holds the gain words alone, as an image of 16 bits for the flat-field upload
            of a camera, and is not read back.
        force : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            If the file exists and `force` is not set, or it cannot be written.
        InputError
            If the suffix is another.
        """
        file = as_path("path", path)
        if file.suffix.lower() in IMAGES:
            text = "\n".join(self.format.gain_words)
            with write_whole(path, force=force) as temporary:
                tiff.write_frames(temporary, [self.gain], nbytes=0, description=text)
            return
        encode_file, _ = _FORMATS[check_suffix(file, SUFFIXES)]
        data = encode_file(self, file.stem)
        with write_whole(path, force=force) as temporary:
            temporary.write_bytes(data)


def _largest_raw(correction: Correction, adc: int) -> float:
    """Largest raw value in DN: of the sensor's bits, where unknown of an ADC of most bits."""
    bits = correction.bits
    return float(2**bits - 1 if bits else np.ldexp(2.0**WIDEST - 1, adc))


def _limits(made: Content, depth: int, sag: float, pattern: float) -> tuple[Finding, ...]:
    """Say what words lose of a correction, of a sensor of so many bits; 0 if that is not known."""
    f, error = made.format, made.metadata["largest_error_dn"]
    full = 2.0 ** (f.adc_bits + f.adc)
    end = full + float(np.mean(made.coarse)) * 2.0**f.coarse
    coarse = (
        f"the words differ from the correction by up to {error:.3g} DN, {error / full:.1%} of the "
        f"range of the ADC (limit {_COARSE:.1%}): leave out 'gain_step' and 'offset_step', or take "
        "more 'gain_bits' and 'offset_bits'"
    )
    beyond = (
        f"the range of the ADC ends at {end:g} DN, and {1 - end / 2**depth:.0%} of the raw values "
        f"of {depth} bits are beyond it: they become the word {f.largest_word}: take 'adc_bits' "
        f"{depth}, or 'adc_step' {2.0 ** (depth - f.adc_bits):g}"
    )
    bent = (
        f"the line that 'linearise' puts in place of curves leaves up to {sag / 2:.3g} DN, and a "
        f"pattern with a standard deviation of {pattern:.3g} DN over the pixels (limit, a step of "
        f"the ADC: {2.0**f.adc:g} DN): name a narrower range, or correct frames by the curves"
    )
    found = (
        ("words", coarse, error > _COARSE * full),
        ("range", beyond, end < _KEPT * 2**depth),
        ("line", bent, pattern > 2.0**f.adc),
    )
    return tuple(Finding(kind, words, "input") for kind, words, is_so in found if is_so)


_FORMATS = {
    ".bin": (table_files.to_binary, table_files.from_binary),
    ".hex": (table_files.to_memory_image, table_files.from_memory_image),
    ".h": (c_header.to_c_header, c_header.from_c_header),
}

SUFFIXES = tuple(_FORMATS)
"""Suffixes of files of tables."""

IMAGES = (".tif", ".tiff")
"""Suffixes of files of gain words alone."""


def read_table(path: str | PathLike[str]) -> Table:
    """Read a table from the file that `Table.save` wrote, bit by bit.

    Raises
    ------
    FileError
        If the file cannot be read, holds something else, or is incomplete, damaged or of another
        version.
    """
    file = as_path("path", path)
    _, decode_file = _FORMATS[check_suffix(file, SUFFIXES)]
    with reading(file):
        return Table(**vars(decode_file(file, file.read_bytes())))


def adc_words(frames: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Words of the ADC of one frame or a stack, uint16."""
    raw = checked_frames(frames, shape)
    if raw.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"'frames' is {raw.dtype}, expected uint8 or uint16 words of the ADC: "
            "table.digitise(frames) makes them of raw values"
        )
    return np.ascontiguousarray(raw, np.uint16)
