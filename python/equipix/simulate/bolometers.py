"""A simulated array of uncooled bolometers: bridge, thermal balance, self-heating by the bias."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from equipix._check import Array, ArrayLike, Floats, Rng, check_shape, positive
from equipix.detector.photons import exitance, integrated, kelvin_of
from equipix.errors import InputError
from equipix.simulate.camera import PixelArray

_REFERENCE_K = 300.0
"""Temperature of the resistances that are given."""

_BOLTZMANN = 1.380649e-23
"""In J/K."""

_MOST_PERIODS = 10_000
"""Most frames until the temperature before a pulse no longer changes."""

_SETTLED_K = 1e-9
"""How far the temperature before a pulse may be from its steady state, in K."""

_SPREADS = {
    "resistance_ohm": 0.01,
    "b_k": 0.02,
    "conductance_w_per_k": 0.03,
    "capacity_j_per_k": 0.02,
    "absorption": 0.01,
}
"""Relative standard deviations of typical arrays."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BolometerArray(PixelArray):
    r"""An array of microbolometers, each in a bridge with an arm heat-sunk to the substrate.

    Each property of a pixel is a map of shape (rows, cols), or one number for all pixels.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns.
    resistance_ohm : array_like
        Resistance R₃₀₀ at 300 K in ohms.
    b_k : array_like
        B of R = R₀·exp(B/T) in kelvin; the temperature coefficient is −B/T².
    conductance_w_per_k : array_like
        Thermal conductance G to the substrate in W/K.
    capacity_j_per_k : array_like
        Heat capacity C in J/K.
    absorption : array_like
        Absorbed share of the light.
    reference_ohm : array_like
        Resistance at 300 K of the heat-sunk arm, in ohms; such as one for each column.
    reference_b_k : float
        B of the heat-sunk arm in kelvin.
    bias_v : float
        Nominal bias V₀ across the bridge in volts.
    pulse_s, frame_s : float
        Length of the bias pulse, at whose end the bridge is read, and of a frame, in seconds.
    pitch_m, f_number : float
        Side of a pixel in metres, and f-number of the lens.
    band_um : tuple of float
        Shortest and longest wavelength of the light in µm.
    bandwidth_hz : float
        Bandwidth of the noise in hertz.
    dn_per_v, offset_dn : float
        Digital numbers for a volt of the bridge at V₀, and for a balanced bridge.
    bit_depth : int
        Bits of the ADC, 8 to 16.

    Raises
    ------
    InputError
        If a value is out of its range, or a map has another shape.

    Notes
    -----
    With the substrate at T_s a pixel of temperature T has the resistance
    :math:`R = R_{300} \exp(B/T - B/300)` and the heat-sunk arm R_s(T_s) likewise. During the pulse
    of bias V

    .. math:: C \dot T = -G (T - T_s) + P + V^2 R / (R + R_s)^2 ,

    and P is the light: absorption · pitch² / (4 f² + 1) times the difference of the exitance of the
    scene and of the substrate's temperature within the band. Before a shutter at T_s it is 0. The
    pulse begins at the temperature that the frame before has left.

    The bridge is read as a ratio: the reference of the ADC follows the bias, so the output is
    V₀ (R_s/(R + R_s) − 1/2), and V acts through the heat alone. Noise is white: Johnson noise of a
    pixel's resistance, √(4kTR·bandwidth), and rounding.

    Examples
    --------
    >>> from equipix import simulate
    >>> array = simulate.BolometerArray.of((24, 32), rng=1)
    >>> shutter = array.mean(20.0)
    >>> warm = array.mean(20.0, scene_c=30.0)
    >>> print(f"{(warm - shutter).mean() / array.dn_per_v * 1e6:.0f} µV")
    270 µV
    """

    _names = (*_SPREADS, "reference_ohm")

    shape: tuple[int, int]
    resistance_ohm: ArrayLike = 1e5
    b_k: ArrayLike = 1800.0
    conductance_w_per_k: ArrayLike = 1e-7
    capacity_j_per_k: ArrayLike = 1e-9
    absorption: ArrayLike = 0.8
    reference_ohm: ArrayLike = 1e5
    reference_b_k: float = 1800.0
    bias_v: float = 2.0
    pulse_s: float = 60e-6
    frame_s: float = 1 / 30
    pitch_m: float = 25e-6
    f_number: float = 1.0
    band_um: tuple[float, float] = (8.0, 14.0)
    bandwidth_hz: float = 1e3
    dn_per_v: float = 5e5
    offset_dn: float = 30000.0
    bit_depth: int = 16

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        self._check_numbers("reference_b_k", "bias_v", "pulse_s", "frame_s", "pitch_m", "f_number")
        self._check_numbers("bandwidth_hz", "dn_per_v")
        if self.frame_s <= self.pulse_s:
            raise InputError(
                f"'frame_s' is {self.frame_s!r}, expected more than 'pulse_s', {self.pulse_s}"
            )
        if not 0 < self.band_um[0] < self.band_um[1] < np.inf:
            raise InputError(f"'band_um' is {self.band_um!r}, expected (shortest, longest)")
        for name in self._names:
            self._check_map(name, np.nextafter(0, 1), np.inf, " above 0")

    @classmethod
    def of(cls, shape: tuple[int, int], *, rng: Rng) -> Self:
        """Array of typical spreads.

        Parameters
        ----------
        shape : tuple of int
            Rows and columns.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.

        Returns
        -------
        BolometerArray
            With relative standard deviations of 1 % (resistance), 2 % (B), 3 % (thermal
            conductance), 2 % (heat capacity) and 1 % (absorption), normal and independent. They are
            choices of this package, not data of a product.
        """
        rng, sizes = np.random.default_rng(rng), check_shape(shape)
        maps: dict[str, Any] = {
            name: getattr(cls, name) * (1 + spread * rng.standard_normal(sizes))
            for name, spread in _SPREADS.items()
        }
        return cls(shape=sizes, **maps)

    def with_properties(self, **properties: Any) -> Self:
        """Return a copy with other values of some attributes."""
        known = [each.name for each in fields(self)]
        for name in properties:
            if name not in known:
                raise InputError(
                    f"'{name}' is no attribute of a BolometerArray: expected {', '.join(known)}"
                )
        return replace(self, **properties)

    def mean(
        self, substrate_c: float, *, scene_c: float | None = None, bias_v: float | None = None
    ) -> Floats:
        """Mean of a frame without noise and without rounding.

        Parameters
        ----------
        substrate_c : float
            Temperature of the substrate in °C.
        scene_c : float, optional
            Temperature of an even scene, a black body, in °C; a shutter at the temperature of the
            substrate unless given.
        bias_v : float, optional
            Bias in volts; the nominal one unless given.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            In DN.

        Raises
        ------
        InputError
            If a temperature lies at absolute zero or below, or the bias is not above 0.
        """
        pixel_k = self.temperature(substrate_c, scene_c=scene_c, bias_v=bias_v)
        own, arm = self._resistance(pixel_k), self._arm(kelvin_of("substrate_c", substrate_c))
        bridge = self.bias_v * (arm / (own + arm) - 0.5)
        return np.asarray(self.offset_dn + self.dn_per_v * bridge)

    def temperature(
        self, substrate_c: float, *, scene_c: float | None = None, bias_v: float | None = None
    ) -> Floats:
        """Temperature of each pixel at the end of the pulse; the parameters are those of `mean`.

        Parameters
        ----------
        substrate_c : float
            Temperature of the substrate in °C.
        scene_c : float, optional
            Temperature of an even scene in °C; that of the substrate unless given.
        bias_v : float, optional
            Bias in volts; the nominal one unless given.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            In kelvin.

        Raises
        ------
        InputError
            As `mean`.
        """
        substrate = kelvin_of("substrate_c", substrate_c)
        scene = substrate if scene_c is None else kelvin_of("scene_c", scene_c)
        bias = positive("bias_v", self.bias_v if bias_v is None else bias_v)
        light = self._light(substrate, scene)
        rest = substrate + light / self._maps["conductance_w_per_k"]
        time = self._maps["capacity_j_per_k"] / self._maps["conductance_w_per_k"]
        left = np.exp(-(self.frame_s - self.pulse_s) / time)
        start = rest
        for _ in range(_MOST_PERIODS):
            end = self._pulse(start, substrate, light, bias)
            before, start = start, rest + (end - rest) * left
            if np.abs(start - before).max() <= _SETTLED_K * (1 - left.max()):
                return self._pulse(start, substrate, light, bias)
        raise InputError(
            f"'capacity_j_per_k' over 'conductance_w_per_k' is up to {time.max():.3g} s, which "
            f"reaches no steady state in {_MOST_PERIODS} frames of {self.frame_s:g} s: expected "
            "less"
        )

    def frames(
        self,
        substrate_c: float,
        count: int,
        *,
        rng: Rng,
        scene_c: float | None = None,
        bias_v: float | None = None,
    ) -> Iterator[Array]:
        """Make frames of a steady state, one at a time.

        Parameters
        ----------
        substrate_c : float
            Temperature of the substrate in °C.
        count : int
            Number of frames.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.
        scene_c : float, optional
            Temperature of an even scene in °C; a shutter unless given.
        bias_v : float, optional
            Bias in volts; the nominal one unless given.

        Yields
        ------
        ndarray, shape (rows, cols), uint8 up to 8 bits, else uint16
            The next frame, in DN.
        """
        mean = self.mean(substrate_c, scene_c=scene_c, bias_v=bias_v)
        sigma = self.dn_per_v * self.johnson_v(substrate_c)
        return self._frames(
            lambda random: mean + sigma * random.standard_normal(self.shape), count, rng
        )

    def johnson_v(self, substrate_c: float) -> Floats:
        """Johnson noise √(4kTR·bandwidth) of each pixel at the substrate's temperature, in volts.

        Parameters
        ----------
        substrate_c : float
            Temperature of the substrate in °C.

        Returns
        -------
        ndarray, shape (rows, cols), float64
            Standard deviation, in volts.
        """
        kelvin = kelvin_of("substrate_c", substrate_c)
        resistance = self._resistance(np.full(self.shape, kelvin))
        return np.asarray(np.sqrt(4 * _BOLTZMANN * kelvin * resistance * self.bandwidth_hz))

    def temporal_noise(self, substrate_c: float) -> Floats:
        """Standard deviation of one frame in DN, rounding included, shape (rows, cols)."""
        return np.asarray(np.hypot(self.dn_per_v * self.johnson_v(substrate_c), 1 / np.sqrt(12)))

    def output_span(self, substrate_c: Sequence[float], scene_c: Sequence[float]) -> float:
        """Range that holds all pixels at all given temperatures of substrate and scene.

        Parameters
        ----------
        substrate_c : sequence of float
            Temperatures of the substrate in °C.
        scene_c : sequence of float
            Temperatures of the scene in °C.

        Returns
        -------
        float
            Largest less smallest mean of a pixel at the nominal bias, in DN.
        """
        frames = [self.mean(own, scene_c=scene) for own in substrate_c for scene in scene_c]
        return float(max(each.max() for each in frames) - min(each.min() for each in frames))

    def _resistance(self, kelvin: Floats) -> Floats:
        change = self._maps["b_k"] * (1 / kelvin - 1 / _REFERENCE_K)
        return np.asarray(self._maps["resistance_ohm"] * np.exp(change))

    def _arm(self, substrate: float) -> Floats:
        """Resistance of the heat-sunk arm."""
        change = np.exp(self.reference_b_k * (1 / substrate - 1 / _REFERENCE_K))
        return np.asarray(self._maps["reference_ohm"] * change)

    def _light(self, substrate: float, scene: float) -> Floats:
        """Power that each pixel absorbs of the scene, less that of a shutter, in W."""
        power = exitance(self.band_um, scene) - exitance(self.band_um, substrate)
        share = self.pitch_m**2 / (4 * self.f_number**2 + 1)
        return np.asarray(self._maps["absorption"] * share * power)

    def _pulse(self, start: Floats, substrate: float, light: Floats, bias: float) -> Floats:
        """Temperature after a pulse."""
        arm, capacity = self._arm(substrate), self._maps["capacity_j_per_k"]
        conductance = self._maps["conductance_w_per_k"]

        def rate(kelvin: Floats) -> Floats:
            own = self._resistance(kelvin)
            heat = bias**2 * own / (own + arm) ** 2
            return np.asarray((light + heat - conductance * (kelvin - substrate)) / capacity)

        return integrated(rate, start, self.pulse_s)
