"""Priors on fluxes and shifts that the data contradict, and fits with wider ones."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.misplaced import misplaced
from equipix.calibration.residuals import sampled
from equipix.calibration.shift_errors import flux_variance
from equipix.calibration.significance import chi2_tail
from equipix.drift import affine_columns
from equipix.exposures.positions import WIDEST

if TYPE_CHECKING:
    from equipix._types import Array, Floats
    from equipix.calibration.options import Options
    from equipix.calibration.weights import Weighted
    from equipix.exposures.exposures import Exposures

_RARE = 1e-3
"""Probability of such deviations from a prior below which it is contradicted."""

_FACTOR = 1.5
"""Least factor by which a prior is widened: error bars scatter by as much with few exposures."""


class Contradiction(NamedTuple):
    """A prior that the data contradict.

    `name` is the keyword, `factor` the deviations in standard deviations, rms, `freedom` the
    number of combinations of the values that the data determine, and `worst` the exposures with the
    largest deviations, the largest first; `remedy` says what to check.
    """

    name: str
    factor: float
    freedom: int
    worst: tuple[int, ...]
    remedy: str = "check how they were measured, and that no exposure is flipped or exchanged"

    @property
    def words(self) -> str:
        """What is wrong, the value, the limit and the remedy."""
        what = {"flux_std": "fluxes", "shift_std": "shifts"}[self.name]
        return (
            f"the data contradict '{self.name}': the {what} found differ from those given by "
            f"{self.factor:.1f} of their standard deviations, rms ({self.freedom} degrees of "
            f"freedom, expected 1). It was multiplied by {self.factor:.1f}, and the fit repeated: "
            f"{self.remedy}"
        )


def widened(weighted: Weighted, options: Options) -> tuple[Weighted, list[Contradiction]]:
    """Repeat a fit with wider priors where the data contradict those given.

    Notes
    -----
    Deviations x of what was found from what was given, in standard deviations of the prior, are
    taken without what the data do not determine: a common factor of the fluxes, where no exposure
    is turned also what is affine in the shifts, and a displacement common to all shifts. Their sum
    of squares follows χ² of the remaining degrees of freedom f where the prior is right, and is
    less where the data hold little beside it. The factor is √(Σ x²/f). A flipped exposure, or two
    that are exchanged, are fitted with shifts far from those given: those furthest are tried.
    """
    found = [_explained(each, weighted, options) for each in contradictions(weighted)]
    if not found:
        return weighted, []
    exposures = weighted.exposures
    for each in found:
        exposures = _wider(exposures, each)
    fit = exposures.fit(options.fit, weighted.fit)
    return weighted._replace(exposures=exposures, fit=fit), found


def contradictions(weighted: Weighted) -> list[Contradiction]:
    """The priors that the data contradict."""
    if weighted.fit.ended != "converged":
        return []
    asked = [_of_fluxes(weighted), _of_shifts(weighted)]
    return [each for each in asked if each is not None]


def _explained(found: Contradiction, weighted: Weighted, options: Options) -> Contradiction:
    """Say which exposure is flipped, or which two are exchanged, where that explains shifts."""
    if found.name != "shift_std":
        return found
    first, second = found.worst
    words = misplaced(weighted.exposures, [(first, second)], first, options.fit)
    return found if words is None else found._replace(remedy=words)


def _of_fluxes(weighted: Weighted) -> Contradiction | None:
    flux, positions = weighted.exposures.flux, weighted.exposures.positions
    if flux.kind != "prior" or flux.std is None:
        return None
    turned = len(set(positions.rotation.tolist())) > 1
    columns = np.ones((len(positions), 1))
    if not turned:
        columns = affine_columns(positions.shifts, None)
    deviations = np.log(np.array(weighted.fit.flux) / flux.values)
    std = flux.std
    if positions.std is not None:
        # Shifts that were not refined leave a flux in a beam with a slope.
        std = np.sqrt(std**2 + flux_variance(weighted, sampled(weighted)))
    return _contradiction("flux_std", deviations[:, None], std[:, None], columns)


def _of_shifts(weighted: Weighted) -> Contradiction | None:
    positions = weighted.exposures.positions
    if positions.std is None or weighted.fit.refinement != "refined":
        return None
    deviations = np.array(weighted.fit.shifts) - positions.shifts
    return _contradiction("shift_std", deviations, positions.std, np.ones((len(positions), 1)))


def _contradiction(
    name: str, deviations: Floats, std: Floats, columns: Floats
) -> Contradiction | None:
    """Test deviations (n, axes), each axis without its part along the columns."""
    total, freedom = np.zeros(len(deviations)), 0
    for values, scale in zip(deviations.T, std.T, strict=True):
        known = scale > 0
        left, unknowns = _rest(columns[known] / scale[known, None], values[known] / scale[known])
        total[known] += left**2
        freedom += len(left) - unknowns
    if freedom < 1:
        return None
    factor = (float(total.sum()) / freedom) ** 0.5
    if chi2_tail(float(total.sum()), freedom) >= _RARE or factor < _FACTOR:
        return None
    return Contradiction(name, factor, freedom, tuple(np.argsort(-total)[:2].tolist()))


def _rest(columns: Array, values: Array) -> tuple[Floats, int]:
    """What least squares along columns leaves, and their rank."""
    found, _, rank, _ = np.linalg.lstsq(columns, values, rcond=None)
    return np.asarray(values - columns @ found), int(rank)


def _wider(exposures: Exposures, found: Contradiction) -> Exposures:
    """Exposures with one prior multiplied by its factor."""
    flux, positions = exposures.flux, exposures.positions
    if found.name == "flux_std" and flux.std is not None:
        flux = dataclasses.replace(flux, std=found.factor * flux.std)
    elif positions.std is not None:
        std = np.minimum(found.factor * positions.std, WIDEST)
        positions = dataclasses.replace(positions, std=std)
    return dataclasses.replace(exposures, flux=flux, positions=positions)
