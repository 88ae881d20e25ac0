"""A virtual camera: photons to digital numbers, one frame at a time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix._check import Array, Floats, Rng, as_array, check_bit_depth, check_shape, positive
from equipix.errors import InputError
from equipix.shown import Brief

Pixels: TypeAlias = "NDArray[np.int64]"

DEAD_RESPONSE = 0.02
"""Sensitivity of a dead pixel."""

HOT_LEVEL = 0.915
"""Dark level of a hot pixel, as a fraction of full scale: with light it saturates."""

MANY_E = 1000.0
"""Electrons from which on a Poisson number is drawn as a normal one."""

WELL_MARGIN = 10.0
"""Standard deviations by which such a number stays below the full well."""


def _no_pixels() -> Pixels:
    return np.empty(0, np.int64)


class Digitised(Brief):
    """What all virtual cameras share: the ADC, and the loop that makes frames."""

    bit_depth: int

    @property
    def full_scale(self) -> int:
        """Largest digital number."""
        return int(2**self.bit_depth - 1)

    def _frames(
        self, drawn: Callable[[np.random.Generator], Array], count: int, rng: Rng
    ) -> Iterator[Array]:
        """Make frames one at a time: values in DN, which may be overwritten, as whole numbers."""
        random = np.random.default_rng(rng)
        for _ in range(count):
            values = drawn(random)
            np.rint(values, out=values)
            np.clip(values, 0, self.full_scale, out=values)
            yield values.astype(np.uint8 if self.bit_depth == 8 else np.uint16)


class PixelArray(Digitised):
    """A virtual camera that maps describe, each of shape (rows, cols) or one number."""

    shape: tuple[int, int]
    _names: ClassVar[tuple[str, ...]]
    """Names of the maps."""

    def _check_numbers(self, *above_0: str) -> None:
        """Refuse sizes and numbers that no array has."""
        check_shape(self.shape)
        check_bit_depth(self.bit_depth)
        for name in above_0:
            positive(name, getattr(self, name))

    def _check_map(self, name: str, low: float, high: float, wanted: str) -> None:
        """Refuse a map of another shape, or with values beyond limits."""
        values = as_array(name, getattr(self, name), ndim=(0, 1, 2))
        if values.shape not in ((1,), self.shape):
            raise InputError(
                f"'{name}' has shape {values.shape}, expected one number or {self.shape}"
            )
        wrong = values[~(np.isfinite(values) & (values >= low) & (values <= high))]
        if wrong.size:
            raise InputError(f"'{name}' holds {wrong.flat[0]:g}, expected finite numbers{wanted}")

    @cached_property
    def _maps(self) -> dict[str, Floats]:
        """Each map with a value for each pixel."""
        return {
            name: np.broadcast_to(np.asarray(getattr(self, name), np.float64), self.shape)
            for name in self._names
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera(Digitised):
    """A camera with photon and read noise, a dark level, an ADC and bad pixels.

    Attributes
    ----------
    sensitivity : array_like, shape (rows, cols)
        Relative sensitivity of each pixel, were none dead.
    dark : array_like, shape (rows, cols) or a number
        Dark level of each pixel, were none hot, in DN.
    gain_dn_per_e : float
        Digital numbers per photoelectron.
    read_noise_e : float
        Standard deviation of the read noise, in electrons.
    bit_depth : int
        Bits of the ADC, 8 to 16: values are rounded and clipped to 0 .. 2^bits − 1.
    full_well_e : float
        Largest number of electrons a pixel holds.
    dead, hot : ndarray of int64
        Flat indices of pixels of 2 % sensitivity and of pixels that are nearly full in the dark.

    Raises
    ------
    InputError
        If a value is out of its range; the message names it.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import simulate
    >>> camera = simulate.Camera(sensitivity=np.ones((2, 3)), bit_depth=8, gain_dn_per_e=0.01)
    >>> [frame.dtype.name for frame in camera.frames(np.full((2, 3), 9000.0), 2, rng=1)]
    ['uint8', 'uint8']
    """

    sensitivity: ArrayLike
    dark: ArrayLike = 60.0
    gain_dn_per_e: float = 0.2
    read_noise_e: float = 10.0
    bit_depth: int = 12
    full_well_e: float = np.inf
    dead: Pixels = field(default_factory=_no_pixels)
    hot: Pixels = field(default_factory=_no_pixels)

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_bit_depth(self.bit_depth)
        positive("gain_dn_per_e", self.gain_dn_per_e)
        positive("read_noise_e", self.read_noise_e, zero=True)
        if not self.full_well_e > 0:
            raise InputError(f"'full_well_e' is {self.full_well_e!r}, expected a number above 0")
        sensitivity = as_array("sensitivity", self.sensitivity, ndim=2)
        for name, pixels in (("dead", self.dead), ("hot", self.hot)):
            if pixels.size and (pixels.min() < 0 or pixels.max() >= sensitivity.size):
                raise InputError(f"'{name}' holds indices outside 0 to {sensitivity.size - 1}")
        if np.shape(self.dark) not in ((), sensitivity.shape):
            raise InputError(f"'dark' has shape {np.shape(self.dark)}, not {sensitivity.shape}")

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, cols) of the sensor."""
        rows, cols = self.response.shape
        return rows, cols

    @cached_property
    def response(self) -> Floats:
        """Sensitivity with the dead pixels in it, shape (rows, cols)."""
        response = np.array(self.sensitivity, np.float64)
        response.flat[self.dead] = DEAD_RESPONSE
        return response

    @cached_property
    def offset(self) -> Floats:
        """Dark level with the hot pixels in it, shape (rows, cols), in DN."""
        offset = np.array(np.broadcast_to(self.dark, self.shape), np.float64)
        offset.flat[self.hot] = HOT_LEVEL * self.full_scale
        return offset

    @property
    def good(self) -> NDArray[np.bool_]:
        """True in pixels that are neither dead nor hot, shape (rows, cols)."""
        good = np.ones(self.shape, np.bool_)
        good.flat[np.concatenate([self.dead, self.hot])] = False
        return good

    def variance(self, light_e: Floats) -> Floats:
        """Variance of one frame, saturation aside.

        Parameters
        ----------
        light_e : ndarray, shape (rows, cols)
            Mean photoelectrons of a pixel of sensitivity 1.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            In DN²: gain²·(light·M + read noise²) + 1/12; the last term is the rounding.
        """
        return self.gain_dn_per_e**2 * (light_e * self.response + self.read_noise_e**2) + 1 / 12

    def frames(self, light_e: Floats, count: int, *, rng: Rng) -> Iterator[Array]:
        """Make frames of a steady light, one at a time.

        Parameters
        ----------
        light_e : ndarray, shape (rows, cols)
            Mean photoelectrons of a pixel of sensitivity 1; 0 for dark frames.
        count : int
            Number of frames.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.

        Yields
        ------
        ndarray, shape (rows, cols), uint8 up to 8 bits, else uint16
            The next frame, in DN.

        Raises
        ------
        InputError
            If light is below 0 anywhere, or is no number.

        Notes
        -----
        Photons of a Poisson and read noise of a normal distribution. From 1000 electrons on, where
        that is well below the full well, one normal number of the mean and variance of both takes
        their place: a quarter of the time, for a skewness of 0.03 at most. Values are computed in
        float32, which rounds them by less than 0.005 DN at 16 bits.
        """
        electrons = light_e * self.response
        if not (electrons >= 0).all():
            raise InputError(
                f"'light_e' goes down to {np.min(electrons):.3g} electrons, expected 0 or more "
                "everywhere: is the beam below 0, as one of a large contrast?"
            )
        room = self.full_well_e - electrons
        normal = (electrons >= MANY_E) & (room > WELL_MARGIN * np.sqrt(electrons))
        mean = np.where(normal, electrons, 0.0)
        level = np.float32(self.gain_dn_per_e * mean + self.offset)
        noise = np.float32(self.gain_dn_per_e * np.sqrt(mean + self.read_noise_e**2))
        counted = np.flatnonzero((electrons != 0) & ~normal)

        def drawn(random: np.random.Generator) -> NDArray[np.float32]:
            frame = random.standard_normal(self.shape, dtype=np.float32)
            frame *= noise
            frame += level
            collected = np.minimum(random.poisson(electrons.flat[counted]), self.full_well_e)
            frame.flat[counted] += self.gain_dn_per_e * collected
            return frame

        return self._frames(drawn, count, rng)
