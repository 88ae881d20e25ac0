"""Pixels of HgCdTe and the filter before them: which photons they absorb."""

from dataclasses import dataclass, replace

import numpy as np

from equipix._check import ArrayLike, Floats, number, positive
from equipix.detector import photons
from equipix.detector.photons import EV_UM, band_photons
from equipix.errors import InputError
from equipix.shown import Brief

_TAIL = 30.0
"""Widths below the band gap at which the absorption edge ends: e⁻³⁰ of the response."""

_LONGEST_UM = 100.0
"""Longest wavelength that is taken: what is above is probably in nanometres."""

_STEEPEST_MEV, _WIDEST = 0.1, 0.05
"""Least width of the edge that the integral resolves, and the largest relative to the gap."""

_SLOPES = (0.005, 0.5)
"""Slopes of a filter that the integral resolves."""


@dataclass(frozen=True, kw_only=True)
class ShortPass(Brief):
    """Filter that transmits short wavelengths.

    Attributes
    ----------
    edge_um : float
        Wavelength of half the peak transmission, in µm.
    slope : float
        Wavelength of 5 % less that of 80 % of the peak transmission, over `edge_um`: 0.005 to 0.5,
        for an interference filter some 0.03.
    peak : float
        Peak transmission, above 0 and at most 1.

    Raises
    ------
    InputError
        If a number is out of its range.

    Examples
    --------
    >>> from equipix import detector
    >>> float(detector.ShortPass(edge_um=4.7, slope=0.03).transmission(4.7))
    0.5
    """

    edge_um: float
    slope: float = 0.03
    peak: float = 1.0

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        _check_um("edge_um", self.edge_um)
        positive("peak", self.peak)
        if not _SLOPES[0] <= number("slope", self.slope) <= _SLOPES[1]:
            raise InputError(
                f"'slope' is {self.slope!r}, expected {_SLOPES[0]} to {_SLOPES[1]}: wavelength of "
                "5 % less that of 80 % transmission, over that of 50 %"
            )
        if self.peak > 1:
            raise InputError(f"'peak' is {self.peak!r}, expected a transmission of at most 1")

    def transmission(self, wavelength_um: ArrayLike) -> Floats:
        """Transmission at each wavelength in µm: a logistic function."""
        # 80 % lies ln 4 below and 5 % lies ln 19 above the edge, in units of the scale.
        scale = self.slope * self.edge_um / np.log(4 * 19)
        steps = (np.asarray(wavelength_um, np.float64) - self.edge_um) / scale
        return np.asarray(self.peak / (1 + np.exp(np.minimum(steps, 700.0))))


@dataclass(frozen=True, kw_only=True)
class HgCdTe(Brief):
    r"""Pixels of Hg₁₋ₓCdₓTe behind the optics that limit their band.

    Attributes
    ----------
    start_um : float
        Shortest wavelength that the optics transmit, in µm.
    cutoff_um : float
        Cut-off of a pixel of the mean composition, where it has half its response, in µm.
    edge_mev : float
        Width W of the absorption edge in meV: 0, or 0.1 to a twentieth of the band gap.
    short_pass : ShortPass or None
        Filter before the array.
    detector_k : float
        Temperature of the detector in kelvin.

    Raises
    ------
    InputError
        If a number is out of its range.

    Notes
    -----
    A pixel of composition x has the band gap E_g(x) of `hgcdte_cutoff` [1]_. Its response
    to photons of energy E is

    .. math:: S = 1 - 2^{-\exp((E - E_g)/W)} ,

    which is what a layer absorbs whose absorption coefficient follows Urbach's rule [2]_,
    proportional to exp(E/W), with half its response at E_g. With W = 0 it is 1 above E_g and 0
    below. The quantum efficiency well above the gap does not depend on x. Layers grown by epitaxy
    have W of 1.5 to 4 meV at low temperatures, older ones more [3]_.

    References
    ----------
    .. [1] G. L. Hansen, J. L. Schmit, T. N. Casselman, "Energy gap versus alloy composition and
       temperature in Hg1−xCdxTe", Journal of Applied Physics 53 (1982) 7099-7101.
    .. [2] E. Finkman, S. E. Schacham, "The exponential optical absorption band tail of
       Hg1−xCdxTe", Journal of Applied Physics 56 (1984) 2896-2900.
    .. [3] "Urbach tail and nonuniformity probe of HgCdTe thin films and quantum well
       heterostructures grown by molecular beam epitaxy", which gives 1.5 to 4 meV at 4.2 to 77 K.

    Examples
    --------
    >>> from equipix import detector
    >>> round(detector.HgCdTe(start_um=8.0, cutoff_um=10.6).composition, 4)
    0.221
    """

    start_um: float
    cutoff_um: float
    edge_mev: float = 0.0
    short_pass: ShortPass | None = None
    detector_k: float = 77.0

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        _check_um("start_um", self.start_um)
        _check_um("cutoff_um", self.cutoff_um)
        positive("detector_k", self.detector_k)
        if self.cutoff_um <= self.start_um:
            raise InputError(
                f"'cutoff_um' is {self.cutoff_um!r}, expected more than 'start_um', {self.start_um}"
            )
        most = 1e3 * _WIDEST * float(photons.hgcdte_gap(self.composition, self.detector_k))
        width = number("edge_mev", self.edge_mev)
        if width != 0 and not _STEEPEST_MEV <= width <= most:
            raise InputError(
                f"'edge_mev' is {self.edge_mev!r}, expected 0, or {_STEEPEST_MEV} to {most:.3g}: a "
                "twentieth of the band gap"
            )
        if self.short_pass is not None and self.short_pass.edge_um <= self.start_um:
            raise InputError(
                f"'short_pass' has its edge at {self.short_pass.edge_um:g} µm, expected more than "
                f"'start_um', {self.start_um}"
            )

    @property
    def composition(self) -> float:
        """Mean fraction x of Cd, that of `cutoff_um`."""
        return photons.hgcdte_composition(self.cutoff_um, self.detector_k)

    def photons(self, composition: ArrayLike, temperature_k: float) -> Floats:
        """Photons that pixels of some compositions absorb of a black body.

        Parameters
        ----------
        composition : array_like
            Fraction x of Cd of each pixel.
        temperature_k : float
            Temperature of the black body in kelvin.

        Returns
        -------
        ndarray, of the shape of `composition`
            Per second and area, in the unit of `band_photons`.

        Raises
        ------
        InputError
            If a cut-off lies below `start_um`, or the temperature is not above 0.
        """
        x = np.asarray(composition, np.float64)
        if self.edge_mev == 0:
            cutoffs = photons.hgcdte_cutoff(x, self.detector_k)
            return band_photons(self.start_um, cutoffs, temperature_k, response=self._filtered)
        gaps = 1e3 * photons.hgcdte_gap(x, self.detector_k)
        each = [self._behind_edge(float(gap), temperature_k) for gap in gaps.ravel()]
        return np.reshape(each, x.shape)

    def integration_factor(self, scene_k: float = 300.0) -> float:
        """Integration time with the filter over that without it, for as many electrons.

        Parameters
        ----------
        scene_k : float
            Temperature of the scene in kelvin.

        Returns
        -------
        float
            1 without a filter.
        """
        plain = replace(self, short_pass=None)
        x = self.composition
        return float(plain.photons(x, scene_k) / self.photons(x, scene_k))

    def _filtered(self, wavelength_um: Floats) -> Floats:
        if self.short_pass is None:
            return np.ones_like(wavelength_um)
        return self.short_pass.transmission(wavelength_um)

    def _behind_edge(self, gap_mev: float, temperature_k: float) -> float:
        """Photons of a pixel with an edge of some width."""

        def response(wavelength_um: Floats) -> Floats:
            above = (1e3 * EV_UM / wavelength_um - gap_mev) / self.edge_mev
            absorbed = -np.expm1(-np.log(2.0) * np.exp(np.minimum(above, 700.0)))
            return np.asarray(absorbed * self._filtered(wavelength_um))

        end_um = 1e3 * EV_UM / max(gap_mev - _TAIL * self.edge_mev, gap_mev / 2)
        return float(band_photons(self.start_um, end_um, temperature_k, response=response))


def _check_um(name: str, value: float) -> None:
    """Refuse wavelengths that no HgCdTe has, such as nanometres."""
    if positive(name, value) > _LONGEST_UM:
        raise InputError(
            f"'{name}' is {value!r} µm, expected at most {_LONGEST_UM:g}: divide nm by 1000"
        )
