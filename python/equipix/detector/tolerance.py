"""The spread of composition of HgCdTe that a correction tolerates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from equipix._check import By, Floats, as_array, check_type, check_word, positive
from equipix.detector.material import HgCdTe
from equipix.detector.photons import LARGEST_X, hgcdte_composition, hgcdte_cutoff
from equipix.errors import InputError
from equipix.shown import Brief

_NODES = 16
"""Compositions of the Gauss-Legendre rule that stands for all pixels."""

_SMALLEST, _EXACT = 1e-10, 1e-6
"""Spread of x at which the search begins, and the relative error at which it ends."""

_COLDEST_K = 100.0
"""Lowest temperature of a black body; what is below is probably in °C."""


@dataclass(frozen=True)
class Tolerance(Brief):
    """Spread of composition that a correction tolerates, the result of `composition_tolerance`.

    Attributes
    ----------
    spread : float
        Standard deviation of x over the pixels at which spatial equals temporal noise.
    half_width : float
        The same as ± half the width of an even distribution: √3 times `spread`.
    electrons : float
        Mean electrons of a pixel in the scene.
    netd_k : float
        Difference of the scene's temperature that equals the temporal noise, in kelvin; the spatial
        noise at `spread` is as large.
    """

    spread: float
    half_width: float
    electrons: float
    netd_k: float


def composition_tolerance(
    material: HgCdTe,
    *,
    references_k: Sequence[float] = (290.0, 310.0),
    scene_k: float = 300.0,
    charge_e: float = 2e7,
    filled_k: float | None = None,
    by: By = "offset",
) -> Tolerance:
    r"""Spread of composition of HgCdTe at which spatial noise equals temporal noise.

    Parameters
    ----------
    material : HgCdTe
        Band, absorption edge and filter.
    references_k : sequence of float
        Temperatures of the black bodies that the array was corrected with, in kelvin: none
        (uncorrected), one (one-point) or two (two-point correction).
    scene_k : float
        Temperature of the scene in kelvin.
    charge_e : float
        Charge capacity: the electrons that a mean pixel collects at `filled_k`.
    filled_k : float, optional
        Temperature at which the integration time fills the capacity; that of the scene unless
        given.
    by : {"offset", "gain"}
        What a one-point correction changes.

    Returns
    -------
    Tolerance
        The spread, in two measures, with the noise of the scene.

    Raises
    ------
    InputError
        If a number is out of its range, a temperature is below 100 K, or no spread that leaves
        every pixel a band gives as much spatial as temporal noise.

    Notes
    -----
    A pixel collects N(x, T) electrons, in proportion to `HgCdTe.photons`. Temporal noise is the
    shot noise √N̄ of the scene. Spatial noise is the rms deviation of corrected values from their
    mean, where a correction takes V to V, V − V₁ + V̄₁, V·V̄₁/V₁ or
    V̄₁ + (V − V₁)(V̄₂ − V̄₁)/(V₂ − V₁). The compositions are evenly distributed; where deviations
    are proportional to that of x, as without a filter, only their standard deviation matters.
    References are free of noise. Dark current and 1/f noise are left out: they make the tolerance
    larger.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian), which states ±0.0006 for 2·10⁷ electrons.

    Examples
    --------
    >>> from equipix import detector
    >>> band = detector.HgCdTe(start_um=3.0, cutoff_um=5.1)
    >>> print(f"{detector.composition_tolerance(band).spread:.1e}")
    6.7e-04
    >>> print(f"{detector.composition_tolerance(band, references_k=()).spread:.1e}")
    4.5e-06
    """
    check_type("material", material, HgCdTe, "a material, such as detector.HgCdTe(...)")
    filled = scene_k if filled_k is None else filled_k
    references = _checked(references_k, scene_k, charge_e, filled, by)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    weights = weights / 2

    def ratio(spread: float) -> float:
        x = material.composition + np.sqrt(3.0) * spread * nodes
        photons = {each: material.photons(x, each) for each in {scene_k, filled, *references}}
        scale = charge_e / float(weights @ photons[filled])
        scene, *values = (scale * photons[each] for each in (scene_k, *references))
        left = _corrected(scene, values, weights, by)
        left = left - weights @ left
        return float(np.sqrt(weights @ left**2) / np.sqrt(weights @ scene))

    spread = _equal_noise(ratio, _largest(material))
    electrons = charge_e / float(material.photons(material.composition, filled))
    electrons *= float(material.photons(material.composition, scene_k))
    netd = 1 / (np.sqrt(electrons) * _contrast(material, scene_k))
    return Tolerance(spread, float(np.sqrt(3.0)) * spread, electrons, float(netd))


def _checked(
    references_k: Sequence[float], scene_k: float, charge_e: float, filled_k: float, by: str
) -> list[float]:
    """Temperatures of the references, after all arguments are checked."""
    given = as_array("references_k", references_k, ndim=1)
    references = [float(each) for each in given]
    if len(references) > 2 or len(set(references)) < len(references):
        raise InputError(f"'references_k' is {references}, expected up to two that differ")
    positive("charge_e", charge_e)
    kelvin = {"scene_k": [scene_k], "filled_k": [filled_k], "references_k": references}
    for name, values in kelvin.items():
        for value in values:
            if positive(name, value) < _COLDEST_K:
                raise InputError(
                    f"'{name}' is {value:g} K, expected {_COLDEST_K:g} or more: give kelvin, which "
                    "is °C + 273.15"
                )
    check_word("by", by, get_args(By))
    if by == "gain" and len(references) != 1:
        raise InputError(f"'by' is 'gain', but there are {len(references)} references, expected 1")
    return references


def _corrected(scene: Floats, values: list[Floats], weights: Floats, by: str) -> Floats:
    """Values of the scene, corrected by those of no, one or two references."""
    if not values:
        return scene
    first, mean = values[0], weights @ values[0]
    if by == "gain":
        return np.asarray(scene * mean / first)
    if len(values) == 1:
        return np.asarray(scene - first + mean)
    rise = weights @ values[1] - mean
    return np.asarray(mean + (scene - first) * rise / (values[1] - first))


def _largest(material: HgCdTe) -> float:
    """Largest spread at which every pixel has a band, and a gap of half that of the mean."""
    x, widest = material.composition, 2 * material.cutoff_um
    shortest = float(hgcdte_cutoff(LARGEST_X, material.detector_k))
    above = hgcdte_composition(max(material.start_um, shortest), material.detector_k) - x
    below = x - hgcdte_composition(widest, material.detector_k)
    return 0.99 * min(above, below) / float(np.sqrt(3.0))


def _equal_noise(ratio: Callable[[float], float], largest: float) -> float:
    """Spread at which a ratio of noises that rises with it reaches 1, by bisection."""
    if not ratio(_SMALLEST) < 1 < ratio(largest):
        raise InputError(
            f"spreads of x from {_SMALLEST:g} to {largest:.2g} leave {ratio(_SMALLEST):.2g} to "
            f"{ratio(largest):.2g} times the temporal noise, expected 1 between: change "
            "'charge_e', 'references_k' or the filter"
        )
    low, high = float(np.log(_SMALLEST)), float(np.log(largest))
    while high - low > _EXACT:
        middle = (low + high) / 2
        if ratio(float(np.exp(middle))) < 1:
            low = middle
        else:
            high = middle
    return float(np.exp((low + high) / 2))


def _contrast(material: HgCdTe, scene_k: float) -> float:
    """Relative rise of the signal per kelvin."""
    step = 1e-3 * scene_k
    low, high = (float(material.photons(material.composition, scene_k + s)) for s in (-step, step))
    return (high - low) / step / (high + low)
