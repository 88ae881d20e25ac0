"""A virtual staring array: why pixels answer the same light differently, cause by cause."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from equipix._check import Array, ArrayLike, Floats, Rng, check_bit_depth, check_shape
from equipix.detector.photons import band_photons
from equipix.errors import InputError
from equipix.simulate.beams import filtered
from equipix.simulate.camera import PixelArray

_REFERENCE_K = 300.0
"""Temperature of a black body at which the mean light is given."""

_SLOWEST_HZ, _FASTEST_HZ, _WAVES = 1e-6, 1e-2, 9
"""Frequencies of the drift, equally many in each decade, which is a spectrum of 1/f."""

_NOT_BELOW_0 = ("sensitivity", "area", "dark_e", "amplification", "read_noise_e", "drift_dn")
"""Causes that cannot be below 0."""

_STEEPEST = 0.5
"""Curvature at which the response stops rising when the well is full."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StaringArray(PixelArray):
    """A focal plane array whose pixels differ in what they are made of.

    Each cause is a map of shape (rows, cols), or one number for all pixels.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns.
    sensitivity : array_like
        Relative quantum efficiency.
    area : array_like
        Relative light-sensitive area: more light, and more dark current.
    dark_e : array_like
        Electrons of the dark current in one frame.
    curvature : array_like
        Share of the signal that is missing when the well is full: n electrons become
        n·(1 − curvature·n/well). At most 1/2, where the response no longer rises at a full well.
    cutoff_um : array_like
        Cut-off wavelength in µm: the spectrum that the pixel sees of a black body.
    band_start_um : float
        Shortest wavelength that the optics let through, in µm.
    offset_dn : array_like
        Offset of the read-out, in DN.
    amplification : array_like
        Relative gain of the read-out, such as that of a column's amplifier.
    read_noise_e : array_like
        Standard deviation of the read noise, in electrons; large for a noisy pixel.
    drift_dn : array_like
        Standard deviation of a slow drift of the offset with a spectrum of 1/f, in DN.
    doubling_k : float
        Rise of the detector's temperature that doubles the dark current, in kelvin; infinite where
        the temperature changes nothing.
    well_e : float
        Electrons that a pixel holds.
    bit_depth : int
        Bits of the ADC, 8 to 16; a full well is its largest number, less a tenth of the range.
    seed : int
        Of the phases of the drift.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`: each gets the share of the light
        that `filtered` gives its colour.

    Raises
    ------
    InputError
        If a value is out of its range, or a map has another shape.

    Notes
    -----
    The causes are those that [1]_ names: spread of sensitivity, area, dark current and read-out;
    non-linear conversion; dependence on the wavelength together with the band of the optics;
    temperature of the cooler; drift.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian).

    Examples
    --------
    >>> import equipix
    >>> from equipix import simulate
    >>> array = simulate.StaringArray.of("InSb", (24, 32), rng=1)
    >>> levels = [equipix.average(array.frames(e, 16, rng=k)) for k, e in enumerate((4e6, 16e6))]
    >>> response = equipix.nuc.fit(levels, order=1)
    >>> frame = next(array.frames(10e6, 1, rng=9))
    >>> bool(response.correct(frame).std() < 0.05 * frame.std())
    True
    """

    _names = (*_NOT_BELOW_0, "curvature", "cutoff_um", "offset_dn")

    shape: tuple[int, int]
    sensitivity: ArrayLike = 1.0
    area: ArrayLike = 1.0
    dark_e: ArrayLike = 0.0
    curvature: ArrayLike = 0.0
    cutoff_um: ArrayLike = 5.0
    band_start_um: float = 3.0
    offset_dn: ArrayLike = 200.0
    amplification: ArrayLike = 1.0
    read_noise_e: ArrayLike = 500.0
    drift_dn: ArrayLike = 0.0
    doubling_k: float = 6.0
    well_e: float = 2e7
    bit_depth: int = 14
    seed: int = 0
    cfa: ArrayLike | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        self._check_numbers("well_e", "band_start_um")
        if not self.doubling_k > 0:
            raise InputError(f"'doubling_k' is {self.doubling_k!r}, expected a number above 0")
        if self.cfa is not None:
            filtered(np.ones((1, 1)), self.cfa)
        for name in _NOT_BELOW_0:
            self._check_map(name, 0, np.inf, " not below 0")
        self._check_map("offset_dn", -np.inf, np.inf, "")
        self._check_map("curvature", -np.inf, _STEEPEST, f" up to {_STEEPEST}")
        start = self.band_start_um
        above = f" above 'band_start_um', {start:g}"
        self._check_map("cutoff_um", np.nextafter(start, np.inf), np.inf, above)

    @classmethod
    def of(cls, material: str, shape: tuple[int, int], *, rng: Rng) -> Self:
        """Array of a material with typical spreads.

        Parameters
        ----------
        material : {"PtSi", "InSb", "HgCdTe"}
            PtSi and InSb are nearly linear, HgCdTe is curved, and differently in each pixel.
        shape : tuple of int
            Rows and columns.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.

        Returns
        -------
        StaringArray
            The spreads are choices of this package, not data of a product: their order of size
            is that of the three materials.

        Raises
        ------
        InputError
            If the material is unknown.
        """
        if material not in MATERIALS:
            raise InputError(f"'material' is {material!r}, expected one of {tuple(MATERIALS)}")
        rng, (start, means, spreads) = np.random.default_rng(rng), MATERIALS[material]
        rows, cols = check_shape(shape)
        columns = rng.standard_normal(cols)
        maps: dict[str, Any] = {
            name: mean + spread * rng.standard_normal((rows, cols))
            for name, mean, spread in zip(_SPREAD, means, spreads, strict=True)
        }
        maps["amplification"] = np.broadcast_to(1 + 0.005 * columns, (rows, cols))
        maps["dark_e"] = np.maximum(maps["dark_e"], 0)
        seed = int(rng.integers(2**31))
        return cls(shape=(rows, cols), band_start_um=start, seed=seed, **maps)

    def with_causes(self, **causes: Any) -> Self:
        """Return a copy with other values of some attributes.

        With another `bit_depth` the ADC divides the same range into other steps: `offset_dn` and
        `drift_dn` are scaled with their number unless they are given too.
        """
        bits = causes.get("bit_depth", self.bit_depth)
        check_bit_depth(bits)
        finer = 2.0 ** (bits - self.bit_depth)
        names = ("offset_dn", "drift_dn") if finer != 1 else ()
        scaled = {name: finer * np.asarray(getattr(self, name)) for name in names}
        return replace(self, **scaled | causes)

    @property
    def gain_dn_per_e(self) -> float:
        """Digital numbers per electron of a pixel of mean amplification."""
        return 0.9 * self.full_scale / self.well_e

    def black_body(self, temperature_k: float, *, light_e: float) -> Floats:
        """Photoelectrons that each pixel of sensitivity and area 1 gets from a black body.

        Parameters
        ----------
        temperature_k : float
            Temperature in kelvin.
        light_e : float
            Photoelectrons that a pixel of the mean cut-off gets at 300 K.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            In electrons in one frame: pixels differ by their cut-off wavelengths.
        """
        cutoff = self._maps["cutoff_um"]
        mean = band_photons(self.band_start_um, cutoff.mean(), _REFERENCE_K)
        photons = band_photons(self.band_start_um, cutoff, temperature_k)
        return np.asarray(light_e / mean * photons)

    def electrons(self, light_e: ArrayLike, *, warmer_k: float = 0.0) -> Floats:
        """Mean electrons that each pixel collects in one frame.

        Parameters
        ----------
        light_e : array_like, a number or of shape (rows, cols)
            Photoelectrons of a pixel of sensitivity and area 1.
        warmer_k : float
            How much warmer the detector is than the cooler should keep it, in kelvin.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            Of light and dark current, at most a full well.

        Raises
        ------
        InputError
            If light is not finite or below 0.
        """
        light = np.asarray(light_e, np.float64)
        wrong = light[~(np.isfinite(light) & (light >= 0))]
        if wrong.size:
            raise InputError(f"'light_e' holds {wrong.flat[0]:g}, expected finite numbers from 0")
        if self.cfa is not None:
            light = filtered(np.broadcast_to(light, self.shape), self.cfa)
        dark = self._maps["dark_e"] * 2 ** (warmer_k / self.doubling_k)
        collected = self._maps["area"] * (self._maps["sensitivity"] * light + dark)
        return np.asarray(np.clip(collected, 0, self.well_e))

    def mean(
        self, light_e: ArrayLike, *, warmer_k: float = 0.0, time_s: float | None = None
    ) -> Floats:
        """Mean of a frame without noise and without rounding.

        Parameters
        ----------
        light_e : array_like, a number or of shape (rows, cols)
            Photoelectrons of a pixel of sensitivity and area 1.
        warmer_k : float
            How much warmer the detector is, in kelvin.
        time_s : float, optional
            Time in seconds, for the drift; without it there is none.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            In DN.
        """
        n = self.electrons(light_e, warmer_k=warmer_k)
        return self._offset(time_s) + self._converted(n)

    def frames(
        self,
        light_e: ArrayLike,
        count: int,
        *,
        rng: Rng,
        warmer_k: float = 0.0,
        time_s: float | None = None,
    ) -> Iterator[Array]:
        """Make frames of a steady light, one at a time.

        Parameters
        ----------
        light_e : array_like, a number or of shape (rows, cols)
            Photoelectrons of a pixel of sensitivity and area 1.
        count : int
            Number of frames.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.
        warmer_k : float
            How much warmer the detector is, in kelvin.
        time_s : float, optional
            Time in seconds, for the drift; without it there is none.

        Yields
        ------
        ndarray, shape (rows, cols), uint8 up to 8 bits, else uint16
            The next frame, in DN.

        Notes
        -----
        The numbers of electrons are normally distributed with the variance of a Poisson
        distribution: wells of infrared arrays hold millions. A full well loses what exceeds it, so
        only the read noise is left.
        """
        n = self.electrons(light_e, warmer_k=warmer_k)
        sigma, offset = self._noise_e(n), self._offset(time_s)

        def drawn(random: np.random.Generator) -> Floats:
            return offset + self._converted(n + sigma * random.standard_normal(self.shape))

        return self._frames(drawn, count, rng)

    def temporal_noise(self, light_e: ArrayLike) -> Floats:
        """Standard deviation of one frame, in DN, rounding included, curvature left out."""
        gain = self.gain_dn_per_e * self._maps["amplification"]
        return np.sqrt((gain * self._noise_e(self.electrons(light_e))) ** 2 + 1 / 12)

    def _noise_e(self, electrons: Floats) -> Floats:
        """Standard deviation of the electrons that are read."""
        of_light = np.where(electrons < self.well_e, electrons, 0.0)
        return np.asarray(np.hypot(np.sqrt(of_light), self._maps["read_noise_e"]))

    def _converted(self, electrons: Floats) -> Floats:
        """Electrons as DN without the offset."""
        linear = self.gain_dn_per_e * self._maps["amplification"] * electrons
        missing = self._maps["curvature"] * electrons / self.well_e
        return np.asarray(linear * (1 - missing))

    def _offset(self, time_s: float | None) -> Floats:
        """Offset of the read-out with its drift, in DN."""
        offset = self._maps["offset_dn"]
        if time_s is None or not self._maps["drift_dn"].any():
            return offset
        drift = np.zeros(self.shape)
        for frequency, phase in zip(*self._waves, strict=True):
            drift += np.cos(2 * np.pi * frequency * time_s + phase)
        return np.asarray(offset + self._maps["drift_dn"] * np.sqrt(2 / _WAVES) * drift)

    @cached_property
    def _waves(self) -> tuple[Floats, Floats]:
        """Frequencies and phases of the waves of the drift in each pixel."""
        rng, shape = np.random.default_rng(self.seed), (_WAVES, *self.shape)
        steps = np.arange(_WAVES)[:, None, None] + rng.random(shape)
        frequencies = _SLOWEST_HZ * (_FASTEST_HZ / _SLOWEST_HZ) ** (steps / _WAVES)
        return frequencies, rng.uniform(0, 2 * np.pi, shape)


_SPREAD = ("sensitivity", "area", "dark_e", "curvature", "cutoff_um", "offset_dn", "drift_dn")
"""Causes in the order of the columns of `MATERIALS`."""

MATERIALS = {
    "PtSi": (
        3.0,
        (1.0, 1.0, 1e5, 0.002, 5.0, 300.0, 0.2),
        (0.005, 0.002, 2e3, 0.0002, 0.0, 20.0, 0.0),
    ),
    "InSb": (
        3.0,
        (1.0, 1.0, 2e5, 0.005, 5.3, 300.0, 0.6),
        (0.02, 0.005, 1e4, 0.0005, 0.002, 40.0, 0.0),
    ),
    "HgCdTe": (
        8.0,
        (1.0, 1.0, 1e6, 0.04, 10.0, 300.0, 2.0),
        (0.05, 0.01, 1e5, 0.008, 0.03, 60.0, 0.0),
    ),
}
"""Shortest wavelength in µm, then means and standard deviations over the pixels."""
