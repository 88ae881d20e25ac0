"""The adaptive loop with memories of whole numbers."""

import numpy as np

from equipix import _native
from equipix._check import Array, ArrayLike, check_shape, positive_workers, read_only
from equipix._native import __version__
from equipix.errors import InputError
from equipix.hardware.table import Table, adc_words
from equipix.hardware.words import STEPS, WIDTHS, Format, check_width, exponent_of

_FINEST = 12
"""The finest step is 2^-12."""


class AdaptiveLoop:
    """Gains and offsets that follow the scene, in memories of whole numbers.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns, each 2 or more.
    adc_bits, gain_bits, offset_bits : int
        Widths of the words, 8 to 16. Gains reach from 0 to 2, offsets over half the range of the
        ADC to either side.
    step : float
        Step η of the loop, a power of two from 2^-12 to 1/2.

    Raises
    ------
    InputError
        If a width or the step is out of range: above 1/2 the loop diverges.

    Notes
    -----
    With y the word of the ADC over its range, X = g·y + o, T the mean of the four neighbours' X and
    E = T − X, each frame changes the gain by η·E·y and the offset by η·E [1]_. Each change is
    rounded half to even to a step of its memory. A change below half a step is lost, so narrow
    memories stop converging. The mean gain is held at 1 and the mean offset at 0, to half a step.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian).

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import hardware
    >>> loop = hardware.AdaptiveLoop((8, 8), adc_bits=12, step=0.25)
    >>> pattern = 2000 + 100 * np.random.default_rng(1).standard_normal((8, 8))
    >>> before, *_, after = loop.update(np.rint([pattern] * 100).astype(np.uint16))
    >>> bool(after.std() < 0.1 * before.std())
    True
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        adc_bits: int = 14,
        gain_bits: int = 16,
        offset_bits: int = 16,
        step: float = 2**-6,
    ) -> None:
        widths = {"adc_bits": adc_bits, "gain_bits": gain_bits, "offset_bits": offset_bits}
        self._widths = [check_width(name, bits) for name, bits in widths.items()]
        exponent = exponent_of("step", step)
        if not -_FINEST <= exponent <= -1:
            raise InputError(
                f"'step' is {step!r}, expected 2^-{_FINEST} to 2^-1: above 1/2 the loop diverges"
            )
        self._step = -exponent
        sizes = check_shape(shape)
        if min(sizes) < 2:
            raise InputError(f"'shape' is {shape!r}, expected 2 or more: pixels have neighbours")
        self._gain = np.full(sizes, 2 ** (gain_bits - 1), np.uint16)
        self._offset = np.zeros(sizes, np.int16)

    def __repr__(self) -> str:
        """Short form: sizes and step."""
        rows, cols = self._gain.shape
        return f"<AdaptiveLoop of {rows} x {cols} pixels, step 2^-{self._step}>"

    @property
    def gain(self) -> Array:
        """Words of the gain, uint16: 1 is 2^(gain_bits − 1)."""
        return read_only(self._gain.copy())

    @property
    def offset(self) -> Array:
        """Words of the offset, int16, in steps of 2^(adc_bits − offset_bits) of the ADC."""
        return read_only(self._offset.copy())

    def update(self, frames: ArrayLike, *, workers: int | None = None) -> Array:
        """Correct frames, and change the memories after each.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols), uint8 or uint16
            Words of the ADC.
        workers : int, optional
            Threads; all processors unless given. The words are the same for any number.

        Returns
        -------
        ndarray, of the frames' shape, uint16
            Corrected words, of as many bits as those of the ADC.

        Raises
        ------
        InputError
            If the shape or the dtype does not fit, or a word exceeds the largest of the ADC; then
            nothing is changed.
        """
        words = adc_words(frames, self._gain.shape)
        largest = 2 ** self._widths[0] - 1
        if words.size and words.max() > largest:
            raise InputError(
                f"'frames' holds {words.max()}, above {largest}, the largest word of the ADC"
            )
        out, stack = np.empty(words.shape, np.uint16), (-1, *self._gain.shape)
        _native.adapt_words(
            words.reshape(stack),
            self._gain,
            self._offset,
            out.reshape(stack),
            self._widths,
            self._step,
            workers=positive_workers(workers),
        )
        return out

    def correction(self) -> Table:
        """Return the memories as a table, without a coarse offset.

        Returns
        -------
        Table
            Its `Table.apply` gives what `update` gives for the next frame.

        Raises
        ------
        InputError
            If a gain has fallen to 0.
        """
        adc, gain, offset = self._widths
        widths = zip(WIDTHS, (adc, 8, offset, gain, adc), strict=True)
        steps = zip(STEPS, (0, 0, adc - offset, 1 - gain, 0), strict=True)
        made = Format(**dict(widths), **dict(steps), base=0)
        blank = np.zeros(self._gain.shape, np.uint16)
        metadata = {
            "equipix": __version__,
            "correction": "adaptive loop",
            "step": 2.0**-self._step,
            "leaves_offset": True,  # the mean offset is 0: that of raw frames stays
        }
        return Table(
            made, blank, self._offset.copy(), self._gain.copy(), blank.astype(np.uint32), metadata
        )
