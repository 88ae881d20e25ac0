"""Limits of the criteria of bad pixels."""

from __future__ import annotations

from dataclasses import dataclass

from equipix._check import number
from equipix.errors import InputError


@dataclass(frozen=True)
class DefectLimits:
    """Limits of `find_defects`, each adjustable.

    Attributes
    ----------
    response : float
        Response below which a pixel is dead, over that of its neighbours: 1/2 in GB/T 17444-2013
        [1]_, over the mean response, of which an uneven source would make dead corners.
    gain : float
        1/(1 + K) above which a pixel does not respond: K → −1 has no bound.
    noise : float
        Noise above which a pixel is noisy (overheated), over that which pixels of its signal have
        in common: 2 in GB/T 17444-2013, over the mean noise.
    correlation : float
        Standard deviations by which von Neumann's ratio of a noisy pixel must lie below that of
        white noise for flicker.
    range : float
        Share of the array's range of levels in which a pixel must have values.
    misfit : float
        Standard deviations beyond which the misfit of a curve is not that of the others: of noise,
        and of what the order lacks in all pixels.

    References
    ----------
    .. [1] GB/T 17444-2013, "Measuring methods for parameters of infrared focal plane arrays".
    """

    response: float = 0.5
    gain: float = 10.0
    noise: float = 2.0
    correlation: float = 5.0
    range: float = 0.5
    misfit: float = 6.0

    def __post_init__(self) -> None:
        """Refuse limits that are not above 0."""
        for name, value in vars(self).items():
            if not number(name, value) > 0:
                raise InputError(f"'{name}' is {value!r}, expected a number above 0")
