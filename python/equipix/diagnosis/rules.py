"""Rules on a fit and on its error bars: the tables of what is asked of a calibration."""

from collections.abc import Callable

import numpy as np

from equipix.diagnosis.coverage import is_limited, left_out, too_far, too_few, why_apart, why_far
from equipix.diagnosis.evidence import Evidence
from equipix.diagnosis.small_errors import small_errors_found
from equipix.exposures.positions import micrometre_step
from equipix.findings import Rule
from equipix.fitting.error_bars import fits_noise, incomplete_searches, why_none

_UNDETERMINED = 1e-4
"""A Ritz value this small belongs to a pattern that the measurements do not determine: its noise is
100 times that of others."""

_FEW = 0.01
"""Smallest share of faint pixels that gives a finding."""

_WHITE = frozenset({"noise", "signal"})
"""Causes of a misfit that neighbouring residuals do not have in common."""


def _on_micrometres(e: Evidence) -> str | None:
    """Say that shifts look like micrometres, unless the data confirm them as they are."""
    shifts = e.exposures.positions.shifts
    step = micrometre_step(shifts, e.exposures.shape)
    if step is None or (e.orientation.sign == "confirmed" and e.misfit is None):
        return None
    return (
        f"the shifts look like micrometres: they are multiples of {step:g}, and the largest is "
        f"{abs(shifts - shifts[0]).max():g}. Expected are pixels: divide micrometres by the pixel "
        "pitch, see 'From micrometres to pixels' in docs/shifts.md"
    )


def _on_sign(e: Evidence) -> str | None:
    test = e.orientation
    if test.sign != "contradicted":
        return None
    return (
        f"{test.words}; as given and with free fluxes the squared residuals are {test.ratio:.2g} "
        "times as large. A shift grows when the sensor moves towards larger rows and columns: "
        "give 'shifts' so, or exchange the aperture images before and after the moves"
    )


def _on_orientation(e: Evidence) -> str | None:
    """Another orientation, with which the fluxes agree as they do not as given."""
    test = e.orientation
    if test.hidden is None or not test.is_likely:
        return None
    return (
        f"the orientation of the shifts is probably wrong: with {test.hidden.changes} the data "
        "fit equally well, and the fluxes found agree with those given ten times as closely. "
        f"The sensitivity is then wrong by {test.difference:.1%}, rms: {test.hidden.words}, "
        "unless the figure in docs/shifts.md confirms the axes of the stage"
    )


def _on_tilt(e: Evidence) -> str | None:
    if not e.fit.leaves_tilt:
        return None
    words = _hidden(e)
    return (
        "free fluxes leave a tilt of the sensitivity undetermined, and its slope is set to 0: add "
        "an exposure turned by 90 or 180 degrees, or give 'flux_std' from a monitor of the lamp"
        f"{f'. Besides, {words}' if words else ''}"
    )


def _hidden(e: Evidence) -> str | None:
    """Another orientation that neither residuals nor fluxes exclude."""
    test = e.orientation
    if test.hidden is None or test.is_likely:
        return None
    return (
        "neither residuals nor fluxes determine the orientation of the shifts: with "
        f"{test.hidden.changes} the data fit equally well, and the sensitivity differs by "
        f"{test.difference:.1%}, rms, which no error bar contains. Compare the axes of the stage "
        "once with the figure in docs/shifts.md, put an object with structure into the beam, or "
        "give fluxes that a monitor measured"
    )


def _on_components(e: Evidence) -> str | None:
    if e.fit.components <= 1:
        return None
    left = int(np.count_nonzero(e.fit.component_labels > 0))
    return (
        f"the sensitivity of {left} pixel{'s' * (left != 1)} outside the largest part is "
        f"undetermined (NaN): {why_apart(e.exposures, e.fit)}"
    )


def _on_patterns(e: Evidence) -> str | None:
    ritz = e.fit.smallest_ritz
    if ritz is None or ritz >= _UNDETERMINED:
        return None
    return (
        "the shifts barely constrain a spatial pattern of the sensitivity (smallest Ritz value "
        f"{ritz:.1e}, limit {_UNDETERMINED:g}): choose less regular shifts, see "
        "equipix.plan.error_budget"
    )


def _on_faint(e: Evidence) -> str | None:
    faint = e.exposures.bad_pixels.faint
    if faint is None or faint.mean() < _FEW:
        return None
    return (
        f"the noise of the dark leaves M of {np.count_nonzero(faint)} pixels in "
        "weak light known to worse than 4 %, and four times worse than in bright pixels: they are "
        "flagged UNRELIABLE_FLAT; average more dark frames"
    )


def _on_colours(e: Evidence) -> str | None:
    """Colours that differ; one exposure that is flipped, or at a wrong place, explains them."""
    return None if e.misfit is not None and e.misfit.cause == "order" else e.colours


def _on_drift(e: Evidence) -> str | None:
    return e.drift.words if e.drift is not None and e.drift.is_certain else None


def _misfit(e: Evidence) -> str | None:
    if e.misfit is None or (e.misfit.chi2 < 1 and e.exposures.clipped is not None):
        return None  # values that saturate do not scatter
    return e.misfit.words


def _on_common_misfit(e: Evidence) -> str | None:
    """A misfit that neighbours have in common: it makes the fluxes wrong too.

    One that wrong fluxes cause is said of them.
    """
    if e.misfit is None or e.misfit.cause in _WHITE:
        return None
    return None if e.misfit.cause == "flux" and _on_drift(e) else _misfit(e)


def _on_white_misfit(e: Evidence) -> str | None:
    return _misfit(e) if e.misfit is not None and e.misfit.cause in _WHITE else None


def _replaced(name: str) -> Callable[[Evidence], str | None]:
    """Why a variance or a prior was replaced, if it was."""
    return lambda e: e.weighted.replaced.get(name)


def _on_convergence(e: Evidence) -> str | None:
    fit, tolerance = e.fit, e.options.fit.tolerance
    if fit.ended == "converged":
        return None
    if fit.ended == "sweeps used":
        remedy = ": " + why_far(e, "allow more sweeps")
    else:
        remedy = "" if fits_noise(fit) else ", and no longer decreasing"
        remedy += ": " + why_far(
            e,
            "use a larger 'tolerance', more positions or closer ones, or mask pixels that "
            "receive almost no light",
        )
    sweeps, error = int(fit.sweeps[-1]), float(fit.error_estimate[-1])
    most, after = e.options.fit.max_sweeps, f"not converged after {sweeps} sweeps"
    if most is not None and sweeps > most:
        after += f" (limit {most}; the step that was begun is completed)"
    if error <= tolerance:
        few = fit.ended == "sweeps used"
        cause = "allow more" if few else "probably most pixels saturate or have no light"
        return f"{after}, which are too few to estimate the error: {cause}"
    return (
        f"{after}: the estimated error is {error:.1e}, above the tolerance {tolerance:g}{remedy}"
        f"{left_out(e.exposures, fit)}"
    )


def _on_dark(e: Evidence) -> str | None:
    if e.dark is None:
        return None
    along, alone = e.dark.std_along_sensitivity, e.dark.std_of_a_pixel
    if along is not None and alone is not None and along > alone:
        known = f"its standard deviation is {along:.1e}, that of a pixel by noise {alone:.1e}"
    elif e.fit.ended != "converged" and not is_limited(e):
        known = "the fit did not determine it"
    else:
        return None
    return (
        "the fitted dark is nearly degenerate with the sensitivity: with fitted fluxes it may "
        f"contain any multiple b of the sensitivity, and {known}: give the ratio of the levels as "
        "'flux', or use larger shifts in a beam with more structure"
    )


def _on_searches(e: Evidence) -> str | None:
    count = 0 if e.bars is None else e.bars.exactness["incomplete_searches"]
    return incomplete_searches(count) if count else None


_SHIFTS = frozenset({"sign", "unit"})
"""Kinds that explain all that wrong places in the beam do."""

_SOURCES = _SHIFTS | {"flux"}
"""Kinds beside which a cause of residuals is no news."""

_STRONGER = _SOURCES | {"orientation", "variance", "prior", "drift", "colour"}
"""Kinds whose causes leave what looks like a small error."""

AFTER: tuple[Rule[Evidence], ...] = (
    Rule("unit", "identifiability", _on_micrometres),
    Rule("partial", "identifiability", too_far, severity="failure"),
    Rule("sign", "misfit", _on_sign),
    Rule("orientation", "identifiability", _on_orientation, unless=_SHIFTS),
    Rule("components", "identifiability", _on_components),
    Rule(
        "partial",
        "identifiability",
        too_few,
        unless=frozenset({"partial"}),
        instead=frozenset({"components"}),
        severity="failure",
    ),
    Rule("pattern", "identifiability", _on_patterns, unless=_SHIFTS),
    Rule("tilt", "identifiability", _on_tilt),
    Rule("orientation", "identifiability", _hidden, unless=_SHIFTS | {"tilt"}),
    Rule("faint", "identifiability", _on_faint, severity="note"),
    Rule("colour", "misfit", _on_colours, unless=_SOURCES),
    Rule("misfit", "misfit", _on_common_misfit, unless=_SOURCES | {"colour"}),
    Rule("drift", "misfit", _on_drift, unless=_SOURCES | {"colour"}),
    Rule("misfit", "misfit", _on_white_misfit, unless=_SOURCES | {"colour", "saturation"}),
    Rule("prior", "misfit", _replaced("flux_std"), unless=_SOURCES),
    Rule("prior", "misfit", _replaced("shift_std"), unless=_SOURCES),
    Rule("convergence", "convergence", _on_convergence),
    Rule(
        "uncertainty",
        "convergence",
        lambda e: why_none(e.weighted) if e.options.uncertainty else None,
    ),
    Rule("variance", "misfit", _replaced("variance"), severity="note"),
    Rule("misfit", "misfit", small_errors_found, unless=_STRONGER, instead=frozenset({"misfit"})),
)
"""What is asked of a fit, the most important first."""

LAST: tuple[Rule[Evidence], ...] = (
    Rule("dark", "identifiability", _on_dark),
    Rule("uncertainty", "convergence", _on_searches),
)
"""What is asked of standard deviations."""
