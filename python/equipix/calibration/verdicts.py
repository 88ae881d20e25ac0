"""Findings that limit a result, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration import sample_variances
from equipix.calibration.error_bars import incomplete_searches, is_too_fine, too_fine
from equipix.drift import distinct_trend
from equipix.errors import (
    ConvergenceWarning,
    DriftWarning,
    EquipixWarning,
    IdentifiabilityWarning,
    MisfitWarning,
    MissingDarkWarning,
    SaturationWarning,
    ShiftRoundingWarning,
    ShiftSignWarning,
    warn,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from equipix._native import Fit
    from equipix.calibration.error_bars import DarkStd, ErrorBars
    from equipix.calibration.lamp_drift import Drift
    from equipix.calibration.misfit import Misfit
    from equipix.calibration.options import Options
    from equipix.calibration.orientation import OrientationTest
    from equipix.calibration.priors import Contradiction
    from equipix.calibration.weights import Weighted
    from equipix.exposures.exposures import Exposures

_UNDETERMINED = 1e-4
"""A Ritz value this small belongs to a pattern that the measurements do not determine: its noise is
100 times that of others."""

_NOT_FOUND = 0.1
"""Largest estimated error of M of a joint fit for which noise determines the errors."""

_FEW = 0.01
"""Smallest share of faint pixels that gives a verdict."""

TOO_WEAK = (
    "the light is too weak for its noise, or the measurements contradict each other: use more "
    "light or more frames, mask pixels that receive almost no light, and see that the shifts are "
    "those of the frames"
)

_BY_FLUX = frozenset({"drift", "misfit", "prior", "colour"})
"""Kinds that name a cause, and are no news where the flux of an exposure is wrong."""

_BY_SHIFTS = _BY_FLUX | {"orientation", "pattern"}
"""The same where the sign or the unit of the shifts is wrong."""

_WHITE = frozenset({"noise", "signal"})
"""Causes of a misfit that neighbouring residuals do not have in common."""

_DEGENERATE = 0.1
"""Share of the variance of a drift below which the error of its size is over three times larger."""

_CATEGORIES: dict[str, type[EquipixWarning]] = {
    "rounding": ShiftRoundingWarning,
    "order": IdentifiabilityWarning,
    "saturation": SaturationWarning,
    "unit": IdentifiabilityWarning,
    "raw": MissingDarkWarning,
    "light": DriftWarning,
    "flux": DriftWarning,
    "repeated": MisfitWarning,
    "partial": IdentifiabilityWarning,
    "sign": ShiftSignWarning,
    "orientation": IdentifiabilityWarning,
    "components": IdentifiabilityWarning,
    "pattern": IdentifiabilityWarning,
    "tilt": IdentifiabilityWarning,
    "faint": IdentifiabilityWarning,
    "dark": IdentifiabilityWarning,
    "misfit": MisfitWarning,
    "cfa": MisfitWarning,
    "colour": MisfitWarning,
    "drift": DriftWarning,
    "prior": MisfitWarning,
    "variance": MisfitWarning,
    "convergence": ConvergenceWarning,
    "uncertainty": ConvergenceWarning,
}
"""The warning of each kind of verdict."""


@dataclass(frozen=True)
class Verdict:
    """A finding that limits a result.

    Attributes
    ----------
    kind : str
        Its subject: one of the keys above.
    message : str
        What is wrong, the value, the limit and the remedy.
    """

    kind: str
    message: str

    def __post_init__(self) -> None:
        """Refuse a kind that there is not."""
        if self.kind not in _CATEGORIES:
            raise ValueError(f"verdict of kind {self.kind!r}, expected one of {[*_CATEGORIES]}")


def say(verdicts: Iterable[Verdict]) -> None:
    """Raise the warning of each; no other function warns of a calibration."""
    for verdict in verdicts:
        warn(verdict.message, _CATEGORIES[verdict.kind])


def on_plan(exposures: Exposures) -> list[Verdict]:
    """Verdicts before any fit."""
    found = [_on_rounding(exposures), _on_order(exposures)]
    return [verdict for verdict in found if verdict is not None]


def on_noise(frames: float | None) -> list[Verdict]:
    """Verdict on variances, where those given were sample variances of so many frames."""
    return [] if frames is None else [Verdict("variance", sample_variances.words(frames))]


def unexplained(found: list[Verdict], advice: list[Verdict]) -> list[Verdict]:
    """Verdicts that a wrong sign or unit of the shifts, or a wrong flux, does not explain."""
    kinds = {each.kind for each in (*advice, *found)}
    if {"sign", "unit"} & kinds:
        return [each for each in found if each.kind not in _BY_SHIFTS]
    return [each for each in found if "flux" not in kinds or each.kind not in _BY_FLUX]


def on_standard_deviations(
    weighted: Weighted, options: Options, bars: ErrorBars | None, dark: DarkStd | None
) -> list[Verdict]:
    """Verdicts that need standard deviations: on a fitted dark, and on the error bars."""
    found = [_on_dark(weighted.fit, options, dark), _on_searches(bars)]
    return [verdict for verdict in found if verdict is not None]


def _on_searches(bars: ErrorBars | None) -> Verdict | None:
    count = 0 if bars is None else bars.exactness["incomplete_searches"]
    return Verdict("uncertainty", incomplete_searches(count)) if count else None


def _on_rounding(exposures: Exposures) -> Verdict | None:
    rounding = exposures.positions.rounding
    if rounding is None:
        return None
    remedy = "use method='multiscale', or move the sensor by whole pixels"
    return Verdict("rounding", f"{rounding.words}: {remedy}")


def _on_order(exposures: Exposures) -> Verdict | None:
    """Verdict on an order in which a drift in time is degenerate with a tilt."""
    times, positions = exposures.flux.time, exposures.positions
    if times is None or len(set(positions.rotation.tolist())) > 1:
        return None
    share = distinct_trend(positions.shifts, times)
    if share >= _DEGENERATE:
        return None
    return Verdict(
        "order",
        f"in this order of exposures only {share:.1%} of the variance of a drift linear in time is "
        f"distinguishable from a tilt of the sensitivity (limit {_DEGENERATE:.0%}): take the "
        "exposures in another order, see equipix.plan.advise_order",
    )


def on_fit(
    weighted: Weighted,
    options: Options,
    test: OrientationTest,
    drift: Drift | None,
    misfit: Misfit | None,
    contradictions: Sequence[Contradiction] = (),
    colours: str | None = None,
) -> list[Verdict]:
    """Verdicts on a fit, the most important first.

    `colours` are words on their contradiction, which explains drifts and a misfit. One exposure
    that is flipped explains the contradiction.
    """
    if misfit is not None and misfit.cause == "order":
        colours = None
    if misfit is not None and misfit.chi2 < 1 and weighted.exposures.clipped is not None:
        # Values that saturate do not scatter.
        misfit = None
    found = [
        _on_sign(test),
        _on_orientation(test),
        _on_components(weighted.fit),
        _on_patterns(weighted.fit),
        _on_hidden(weighted.fit, test),
        _on_faint(weighted.exposures),
        None if colours is None else Verdict("colour", colours),
        *([] if colours else _on_residuals(drift, misfit)),
        *(Verdict("prior", each.words) for each in contradictions),
        _on_convergence(weighted.fit, options),
        _on_uncertainty(weighted, options),
    ]
    return [verdict for verdict in found if verdict is not None]


def is_too_far(fit: Fit) -> bool:
    """Whether a fit is too far from its minimum for standard deviations."""
    is_far = not float(fit.error_estimate[-1]) <= _NOT_FOUND
    return fits_noise(fit) or (fit.is_joint and is_far)


def fits_noise(fit: Fit) -> bool:
    """Whether a fit went on without bringing M within its own size."""
    return fit.ended == "stalled" and not float(fit.error_estimate[-1]) < 1


def left_out(fit: Fit) -> str:
    """Words on the measurements that a fit lost, another cause of slow convergence; or none."""
    count = sum(map(len, fit.lost))
    if not count:
        return ""
    return (
        f". Besides, {count} measurement{'s' * (count != 1)} along ragged edges of masks "
        f"{'were' if count != 1 else 'was'} left out: where that is many, use masks with smooth "
        "edges"
    )


def _on_uncertainty(weighted: Weighted, options: Options) -> Verdict | None:
    """Verdict on a fit that is too far from its minimum or its beam for standard deviations."""
    if options.uncertainty and is_too_fine(weighted):
        return Verdict("uncertainty", too_fine(weighted))
    if not (options.uncertainty and is_too_far(weighted.fit)):
        return None
    error = float(weighted.fit.error_estimate[-1])
    return Verdict(
        "uncertainty",
        "no standard deviations: the fit is too far from its minimum (estimated error "
        f"{error:.1e}, limit {_NOT_FOUND:g})",
    )


def _on_sign(test: OrientationTest) -> Verdict | None:
    if test.sign != "contradicted":
        return None
    return Verdict(
        "sign",
        f"{test.words}; as given and with free fluxes the squared residuals are {test.ratio:.2g} "
        "times as large. A shift grows when the sensor moves towards larger rows and columns: "
        "give 'shifts' so, or exchange the aperture images before and after the moves",
    )


def _on_orientation(test: OrientationTest) -> Verdict | None:
    """Verdict on another orientation, with which the fluxes agree as they do not as given."""
    if test.hidden is None or not test.is_likely:
        return None
    return Verdict(
        "orientation",
        f"the orientation of the shifts is probably wrong: with {test.hidden.changes} the data "
        "fit equally well, and the fluxes found agree with those given ten times as closely. "
        f"The sensitivity is then wrong by {test.difference:.1%}, rms: {test.hidden.words}, "
        "unless the figure of shifts in README confirms the axes of the stage",
    )


def _on_hidden(fit: Fit, test: OrientationTest) -> Verdict | None:
    """Verdict on what neither residuals nor fluxes determine: a tilt, the orientation, or both."""
    words = "" if test.hidden is None or test.is_likely else _undetermined(test)
    if not fit.leaves_tilt:
        return Verdict("orientation", words) if words else None
    return Verdict(
        "tilt",
        "free fluxes leave a tilt of the sensitivity undetermined, and its slope is set to 0: turn "
        "one exposure by 90 or 180 degrees, or give 'flux_std' from a monitor of the lamp"
        f"{'. Besides, ' if words else ''}{words}",
    )


def _undetermined(test: OrientationTest) -> str:
    changes = "" if test.hidden is None else test.hidden.changes
    return (
        "neither residuals nor fluxes determine the orientation of the shifts: with "
        f"{changes} the data fit equally well, and the sensitivity differs by "
        f"{test.difference:.1%}, rms, which no error bar contains. Compare the axes of the stage "
        "once with the figure of shifts in README, put an object with structure into the beam, or "
        "give fluxes that a monitor measured"
    )


def _on_components(fit: Fit) -> Verdict | None:
    if fit.components <= 1:
        return None
    left = int(np.count_nonzero(fit.component_labels > 0))
    return Verdict(
        "components",
        f"the shifts leave {fit.components} parts of the sensor unconnected: the sensitivity of "
        f"{left} pixel{'s' * (left != 1)} outside the largest part is undetermined (NaN): choose "
        "other shifts, see equipix.plan.identify",
    )


def _on_patterns(fit: Fit) -> Verdict | None:
    if fit.smallest_ritz is None or fit.smallest_ritz >= _UNDETERMINED:
        return None
    return Verdict(
        "pattern",
        "the shifts barely constrain a spatial pattern of the sensitivity (smallest Ritz value "
        f"{fit.smallest_ritz:.1e}, limit {_UNDETERMINED:g}): choose less regular shifts, see "
        "equipix.plan.error_budget",
    )


def _on_faint(exposures: Exposures) -> Verdict | None:
    faint = exposures.findings.faint
    if faint is None or faint.mean() < _FEW:
        return None
    return Verdict(
        "faint",
        f"the noise of the dark leaves M of {np.count_nonzero(faint)} pixels in "
        "weak light known to worse than 4 %, and four times worse than in bright pixels: they are "
        "flagged UNRELIABLE_FLAT; average more dark frames",
    )


def _on_dark(fit: Fit, options: Options, dark: DarkStd | None) -> Verdict | None:
    if dark is None:
        return None
    along, alone = dark.along_sensitivity, dark.of_a_pixel
    limited = fit.ended == "sweeps used" and options.fit.max_sweeps is not None
    if along is not None and alone is not None and along > alone:
        known = f"its standard deviation is {along:.1e}, that of a pixel by noise {alone:.1e}"
    elif fit.ended != "converged" and not limited:
        known = "the fit did not determine it"
    else:
        return None
    return Verdict(
        "dark",
        "the fitted dark is nearly degenerate with the sensitivity: with fitted fluxes it may "
        f"contain any multiple b of the sensitivity, and {known}: give the ratio of the levels as "
        "'flux', or use larger shifts in a beam with more structure",
    )


def _on_residuals(drift: Drift | None, misfit: Misfit | None) -> list[Verdict]:
    """Verdicts on fluxes and residuals, that which explains the other first.

    A misfit that wrong fluxes cause is said once. Any other that neighbours have in common makes
    the fluxes wrong too.
    """
    of_fluxes = [Verdict("drift", drift.words)] if drift is not None and drift.is_certain else []
    if misfit is None or (of_fluxes and misfit.cause == "flux"):
        return of_fluxes
    of_all = [Verdict("misfit", misfit.words)]
    return of_fluxes + of_all if misfit.cause in _WHITE else of_all + of_fluxes


def _on_convergence(fit: Fit, options: Options) -> Verdict | None:
    if fit.ended == "converged":
        return None
    if fits_noise(fit):
        remedy = f": {TOO_WEAK}"
    elif fit.ended == "sweeps used":
        remedy = ": allow more sweeps"
    else:
        remedy = (
            ", and no longer decreasing: use a larger 'tolerance', or mask pixels that receive "
            "almost no light"
        )
    sweeps, error = int(fit.sweeps[-1]), float(fit.error_estimate[-1])
    if error <= options.fit.tolerance:
        return Verdict(
            "convergence",
            f"not converged after {sweeps} sweeps, which are too few to estimate the error: "
            "probably most pixels saturate or have no light",
        )
    return Verdict(
        "convergence",
        f"not converged after {sweeps} sweeps: the estimated error is {error:.1e}, above the "
        f"tolerance {options.fit.tolerance:g}{remedy}{left_out(fit)}",
    )
