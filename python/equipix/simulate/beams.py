"""Sensors, beams, and the noise-free exposures that a sensor takes of a beam.

A beam is a function of real (row, column) coordinates: those of the pixels of the sensor at
shift 0. Beams are evaluated, never resampled, so fractional shifts are exact.
"""

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np

from equipix._check import ArrayLike, Floats, Rng, as_array, as_shifts, check_shape, per_exposure
from equipix.errors import InputError
from equipix.measured.colour import Colours

Beam: TypeAlias = "Callable[[Floats, Floats], Floats]"

COLOUR_RESPONSE = {"R": 0.35, "G": 1.0, "B": 0.45}
"""Responses of the colours of a camera to a halogen lamp, over that of green."""


def check_beam(beam: object) -> None:
    """Refuse what is no function, such as the values of a beam on a sensor."""
    if not callable(beam):
        given = f"'beam' is of type {type(beam).__name__}, expected a function"
        raise InputError(f"{given} of arrays of row and column coordinates: see gaussian_beam")


def paper_sensitivity(shape: tuple[int, int], *, spread: float = 0.05, rng: Rng) -> Floats:
    """Sensitivity 1 + ξ of the paper's sensor, ξ uniform and white.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    spread : float
        Largest absolute value of ξ.
    rng : numpy.random.Generator or int
        Source of the random numbers, or its seed.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        Relative sensitivity, of mean about 1.

    Examples
    --------
    >>> from equipix import simulate
    >>> bool(abs(simulate.paper_sensitivity((4, 6), rng=1) - 1).max() <= 0.05)
    True
    """
    return 1 + np.random.default_rng(rng).uniform(-spread, spread, check_shape(shape))


def cosine_sensitivity(
    shape: tuple[int, int], *, spread: float = 0.05, amplitude: float = 0.05, rng: Rng
) -> Floats:
    """Sensitivity with a large-scale part, the hard case for a solver.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    spread : float
        Largest absolute value of the white part ξ.
    amplitude : float
        Largest absolute value of the large-scale part.
    rng : numpy.random.Generator or int
        Source of the random numbers, or its seed.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        Relative sensitivity, of mean about 1.

    Notes
    -----
    (1 + ξ)·(1 + amplitude·cos(3v + 1)·cos 2u), where u and v run over ±0.5 along rows and
    columns. Coordinate descent needs (sensor size / shift)² sweeps for the second factor.
    """
    u, v = (np.linspace(-0.5, 0.5, size) for size in shape)
    large_scale = 1 + amplitude * np.cos(2 * u)[:, None] * np.cos(3 * v + 1)
    return paper_sensitivity(shape, spread=spread, rng=rng) * large_scale


def filtered(
    sensitivity: ArrayLike, cfa: ArrayLike, *, response: Mapping[str, float] | None = None
) -> Floats:
    """Sensitivity of a sensor behind colour filters.

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        Relative sensitivity of the pixels without their filters.
    cfa : str or array_like of labels
        Colour filters of the pixels, as for `equipix.calibrate`.
    response : mapping of str to float, optional
        Response of each colour to the light; R 0.35, G 1 and B 0.45 unless given.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        The sensitivity times the response of the pixel's colour.

    Raises
    ------
    InputError
        If `cfa` is no pattern, or a colour of it has no response.

    Examples
    --------
    >>> from equipix import simulate
    >>> simulate.filtered([[1, 1, 1], [1, 1, 1]], "RGGB")
    array([[0.35, 1.  , 0.35],
           [1.  , 0.45, 1.  ]])
    """
    plain = as_array("sensitivity", sensitivity, ndim=2)
    colours, known = Colours.of(cfa), COLOUR_RESPONSE if response is None else response
    if colours is None:
        raise InputError("'cfa' is None, expected a pattern such as 'RGGB'")
    missing = [label for label in colours.labels if label not in known]
    if missing:
        raise InputError(
            f"'cfa' has the colours {missing}, whose response is not known (known: "
            f"{', '.join(known)}): use these alone, or in Python give the response of each"
        )
    return np.asarray(plain * colours.map_of(known, plain.shape), np.float64)


def gaussian_beam(
    shape: tuple[int, int],
    *,
    width: float = 1000.0,
    centre: tuple[float, float] | None = None,
    amplitude: float = 1.0,
) -> Beam:
    """Gaussian beam, amplitude·exp(−r²/width²).

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    width : float
        Distance from the centre, in pixels, at which the beam falls to 1/e.
    centre : tuple of float, optional
        Row and column of the centre; the centre of the sensor at shift 0 unless given.
    amplitude : float
        Value at the centre.

    Returns
    -------
    callable
        The beam, a function of arrays of row and column coordinates.

    Examples
    --------
    >>> from equipix import simulate
    >>> beam = simulate.gaussian_beam((240, 320))
    >>> float(beam(119.5, 159.5))
    1.0
    """
    shape = check_shape(shape)
    row, col = centre if centre is not None else ((shape[0] - 1) / 2, (shape[1] - 1) / 2)

    def beam(rows: Floats, cols: Floats) -> Floats:
        # A product of two exponentials: open grids cost rows + cols of them, not rows * cols.
        falloff = np.exp(-(((rows - row) / width) ** 2)) * np.exp(-(((cols - col) / width) ** 2))
        return np.asarray(amplitude * falloff, np.float64)

    return beam


def _on_gaussian(shape: tuple[int, int], width: float, pattern: Beam) -> Beam:
    """Gaussian beam times a pattern."""
    gaussian = gaussian_beam(shape, width=width)
    return lambda rows, cols: gaussian(rows, cols) * pattern(rows, cols)


def striped_beam(
    shape: tuple[int, int], *, width: float = 1000.0, period: float = 60.0, contrast: float = 0.1
) -> Beam:
    """Gaussian beam crossed by oblique sinusoidal stripes.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    width : float
        Width of the Gaussian, in pixels.
    period : float
        Distance from one stripe to the next, in pixels.
    contrast : float
        Relative amplitude of the stripes.

    Returns
    -------
    callable
        The beam, a function of arrays of row and column coordinates.
    """
    wave = 2 * np.pi / period * np.array([0.6, 0.8])

    def stripes(rows: Floats, cols: Floats) -> Floats:
        return np.asarray(1 + contrast * np.cos(wave[0] * rows + wave[1] * cols))

    return _on_gaussian(shape, width, stripes)


def tilted_beam(
    shape: tuple[int, int], *, width: float = 1000.0, slope: tuple[float, float] = (0.1, 0.2)
) -> Beam:
    """Gaussian beam that grows linearly across the sensor.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    width : float
        Width of the Gaussian, in pixels.
    slope : tuple of float
        Relative increase of the beam from edge to edge of the sensor, along rows and columns.

    Returns
    -------
    callable
        The beam, a function of arrays of row and column coordinates.
    """

    def ramp(rows: Floats, cols: Floats) -> Floats:
        along_rows = slope[0] * ((rows + 0.5) / shape[0] - 0.5)
        return 1 + along_rows + slope[1] * ((cols + 0.5) / shape[1] - 0.5)

    return _on_gaussian(shape, width, ramp)


def wavy_beam(
    shape: tuple[int, int], *, width: float = 1000.0, contrast: float = 0.1, rng: Rng
) -> Beam:
    """Gaussian beam with fine structure, the sum of 40 random waves.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    width : float
        Width of the Gaussian, in pixels.
    contrast : float
        Root mean square of the relative structure.
    rng : numpy.random.Generator or int
        Source of the random numbers, or its seed.

    Returns
    -------
    callable
        The beam, a function of arrays of row and column coordinates.

    Notes
    -----
    The waves fill the disc of spatial frequencies up to 0.1 cycles per pixel evenly and have
    equal amplitudes. Shifts rounded to whole pixels ruin a calibration in such a beam.
    """
    rng = np.random.default_rng(rng)
    waves = 40
    frequency = 0.1 * np.sqrt(rng.random(waves))
    direction, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    k_row = 2 * np.pi * frequency * np.sin(direction)
    k_col = 2 * np.pi * frequency * np.cos(direction)
    amplitude = contrast * float(np.sqrt(2 / waves))

    def waves_at(rows: Floats, cols: Floats) -> Floats:
        structure: Floats = np.zeros(np.broadcast_shapes(np.shape(rows), np.shape(cols)))
        for kr, kc, start in zip(k_row, k_col, phase, strict=True):
            structure += np.cos(kr * rows + kc * cols + start)
        return 1 + amplitude * structure

    return _on_gaussian(shape, width, waves_at)


def exposures(
    sensitivity: ArrayLike,
    beam: Beam,
    shifts: ArrayLike,
    *,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
) -> Floats:
    """Noise-free exposures of a beam, y_k(p) = c_k·L(u_k(p))·M(p).

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        Relative sensitivity M of each pixel.
    beam : callable
        The beam L, a function of arrays of row and column coordinates.
    shifts : array_like, shape (n, 2)
        Shift (row, col) of the sensor in each exposure, in pixels; fractions are exact.
    flux : array_like, shape (n,), optional
        Relative power c of the lamp in each exposure; 1 unless given.
    rotation : array_like, shape (n,), optional
        Rotation of the sensor in each exposure, in degrees: multiples of 90; 0 unless given.

    Returns
    -------
    ndarray, shape (n, rows, cols), float64
        The exposures, in the units of the beam.

    Raises
    ------
    InputError
        If an argument has the wrong shape, or a rotation is no multiple of 90°.

    Notes
    -----
    In exposure k the sensor sees the window of the beam whose smallest (row, col) corner is the
    shift, turned by ``numpy.rot90(window, rotation / 90)``.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import simulate
    >>> ramp = lambda rows, cols: rows + cols
    >>> simulate.exposures(np.ones((1, 3)), ramp, [(0, 0), (0.5, 2)])
    array([[[0. , 1. , 2. ]],
    <BLANKLINE>
           [[2.5, 3.5, 4.5]]])
    """
    response = as_array("sensitivity", sensitivity, ndim=2)
    positions = as_shifts(shifts)
    powers = per_exposure("flux", flux, len(positions), default=1)
    turns = per_exposure("rotation", rotation, len(positions), default=0)
    frames = np.empty((len(positions), *response.shape))
    for frame, power, shift, turn in zip(frames, powers, positions, turns, strict=True):
        np.multiply(power * window(beam, response.shape, shift, turn), response, out=frame)
    return frames


def window(beam: Beam, shape: tuple[int, ...], shift: Floats, rotation: float = 0.0) -> Floats:
    """Evaluate the part of the beam on a sensor of that shape, L(u_k(p))."""
    check_beam(beam)
    turns, rest = divmod(rotation, 90)
    if rest:
        raise InputError(f"'rotation' holds {rotation}°, expected multiples of 90°")
    rows, cols = shape if turns % 2 == 0 else shape[::-1]
    seen = beam(shift[0] + np.arange(rows)[:, None], shift[1] + np.arange(cols))
    return np.rot90(np.broadcast_to(seen, (rows, cols)), int(turns))
