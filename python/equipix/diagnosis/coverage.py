"""How much of the sensor a fit determines, and why it is not more."""

import numpy as np

from equipix import _native
from equipix._check import Bools, union
from equipix._native import Fit
from equipix.diagnosis.evidence import Evidence
from equipix.diagnosis.inputs import wrong_flux
from equipix.exposures.exposures import Exposures
from equipix.exposures.positions import whole_moves
from equipix.findings import Flag, usable
from equipix.fitting.error_bars import fits_noise
from equipix.measured.statistics import FEWEST_USABLE, SATURATED

FAR = 1.0
"""Largest estimated relative error of M: above it, M is not determined to its first digit."""

_OFF_LINE = 0.5
"""Root of the sum of squares of distances from a line, in pixels, up to which positions lie on it.
"""

_FEWEST = 3
"""Fewest exposures that compare pixels along both axes."""


TOO_WEAK = (
    "the light is too weak for its noise, or the measurements contradict each other: use more "
    "light or more frames, mask pixels that receive almost no light, and see that the shifts are "
    "those of the frames"
)


_HEAVY = 100.0
"""Weight of an exposure, over that of all others, up to which single precision compares them well.
"""


def why_far(evidence: Evidence, otherwise: str) -> str:
    """Return why a fit does not come near its minimum: positions, fluxes, weights, or the light.

    Weights where it stalled, light where it fits noise; else what the caller says.
    """
    fit, exposures = evidence.fit, evidence.exposures
    cause = _uncompared(exposures)
    if cause:
        return f"the positions do not determine the sensitivity, since {cause}"
    if not is_limited(evidence) and (cause := wrong_flux(exposures)):
        return f"{cause}: check its frames and its flux, or find the fluxes by flux='fit'"
    if fit.ended == "stalled" and (cause := too_heavy(exposures)):
        return cause
    return TOO_WEAK if fits_noise(fit) else otherwise


def is_limited(evidence: Evidence) -> bool:
    """Whether the fit ended at the caller's limit of sweeps."""
    return evidence.fit.ended == "sweeps used" and evidence.options.fit.max_sweeps is not None


def too_heavy(exposures: Exposures) -> str:
    """Words on an exposure of so much weight that a fit is less exact; none without one."""
    if not exposures.knows_noise:
        return ""
    weights = np.zeros(len(exposures))
    for k in range(len(exposures)):
        relative = np.square(exposures.values[k] / exposures.deviation(k))
        weights[k] = relative[exposures.usable(k)].mean()
    k = int(weights.argmax())
    if not weights[k] > _HEAVY * (weights.sum() - weights[k]):
        return ""
    return (
        f"{exposures.name_of(k)} has more than {_HEAVY:g} times the weight of all others together, "
        "with which a fit is less exact: give it a variance no smaller than a hundredth of theirs; "
        "the sensitivity and its noise stay nearly the same"
    )


def left_out(exposures: Exposures, fit: Fit) -> str:
    """Words on the measurements that a fit lost along masks, another cause of slow convergence.

    None where nothing is masked: a few are lost beside bad pixels too, which need no remedy.
    """
    count = sum(map(len, fit.lost))
    found = union(*vars(exposures.bad_pixels).values())
    masked = exposures.mask if found is None or exposures.mask is None else exposures.mask & ~found
    if not count or masked is None or not masked.any():
        return ""
    return (
        f". Besides, {count} measurement{'s' * (count != 1)} along ragged edges of masks "
        f"{'were' if count != 1 else 'was'} left out: where that is many, use masks with smooth "
        "edges"
    )


def too_far(evidence: Evidence) -> str | None:
    """Say that the fit ended so far from its minimum that it determines no pixel."""
    fit, exposures = evidence.fit, evidence.exposures
    error = float(fit.error_estimate[-1])
    if error <= FAR:  # a NaN is not
        return None
    more = "use larger shifts in a beam with more structure"
    if fit.ended == "sweeps used":
        more = f"allow more sweeps, or {more}"
    return (
        "the fit ended far from its minimum, and determines no pixel (estimated relative error "
        f"{error:.1e}, limit {FAR:g}): {why_far(evidence, more)}{left_out(exposures, fit)}"
    )


def too_few(evidence: Evidence) -> str | None:
    """Say that the fit determines less than half of the pixels that are not masked."""
    wanted = _wanted(evidence.exposures)
    determined = usable(evidence.flags) & wanted
    count, total = int(determined.sum()), int(wanted.sum())
    if count >= FEWEST_USABLE * total:
        return None
    return (
        f"the exposures determine only {count} of {total} unmasked pixels (limit "
        f"{FEWEST_USABLE:.0%}): {_cause(evidence, wanted & ~determined)}"
    )


def _wanted(exposures: Exposures) -> Bools:
    """Pixels that the caller has not masked: with a usable value, or found bad or saturated."""
    wanted = np.zeros(exposures.shape, bool)
    for k in range(len(exposures)):
        wanted |= exposures.usable(k)
    for found in vars(exposures.bad_pixels).values():
        if found is not None:
            wanted |= found
    return wanted


def _cause(evidence: Evidence, missing: Bools) -> str:
    """Return what most of the missing pixels have in common, and the remedy."""
    exposures, flags = evidence.exposures, evidence.flags
    if _most(missing, exposures.bad_pixels.saturated):
        return f"most of the others reach the saturation level: {SATURATED}"
    if _most(missing, (flags & (Flag.DEAD | Flag.HOT)) != 0):
        return (
            "most of the others count as dead, hot or noisy: check the dark frames, and the gain "
            "if it is given"
        )
    if _most(missing, (flags & Flag.UNRELIABLE_FLAT) != 0):
        return "most of the others receive almost no light: mask them, or use more light"
    return why_apart(exposures, evidence.fit)


def _most(missing: Bools, found: Bools | None) -> bool:
    """Whether a finding is of most of the missing pixels."""
    return found is not None and 2 * int((missing & found).sum()) > int(missing.sum())


def why_apart(exposures: Exposures, fit: Fit) -> str:
    """Return why the shifts leave pixels unconnected, and the remedy."""
    result = f"the shifts leave {fit.components} parts of the sensor unconnected"
    if cause := _uncompared(exposures):
        return f"{result}, since {cause}"
    if _mask_separates(exposures, fit.component_labels > 0):
        return (
            f"{result}, since values between them are masked, missing or saturated: use shorter "
            "shifts, or less light where values saturate"
        )
    return f"{result}: choose other shifts, see equipix.plan.identify"


def _uncompared(exposures: Exposures) -> str | None:
    """Say why positions do not compare pixels along both axes, and the remedy; None where they do.

    Measured positions of one line scatter about it.
    """
    shifts, turned = exposures.positions.shifts, exposures.positions.are_turned
    most = float(np.ptp(shifts, axis=0).max())
    if not turned and most == 0:
        return "they are all alike: move the sensor between exposures"
    if not turned and most < _OFF_LINE:
        return f"they differ by {most:.2g} pixel at most: move the sensor farther"
    if len(exposures) < _FEWEST:
        return (
            f"{len(exposures)} exposures compare pixels along one direction only: take "
            f"at least {_FEWEST}, at positions that do not lie on one line"
        )
    rank = np.linalg.matrix_rank(shifts - shifts[0], _OFF_LINE)
    if not turned and rank < 2 <= min(exposures.shape):
        return "they lie on one line: move the sensor along the other axis too"
    return None


def _mask_separates(exposures: Exposures, apart: Bools) -> bool:
    """Whether the shifts connect most of these pixels to the others where every value is usable."""
    rotation = exposures.positions.rotation.tolist()
    whole = whole_moves(exposures.positions.shifts)
    labels, *_ = _native.planned_components(exposures.shape, whole, rotation=rotation, mask=None)
    return _most(apart, labels == 0)
