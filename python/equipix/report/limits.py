"""Limits on the figures of results: PASS or FAIL."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, Field, FiniteFloat

from equipix.errors import EquipixError, InputError
from equipix.experiment.manifest import Table, example_of, key, keys_of, read_manifest
from equipix.experiment.templates import template
from equipix.findings import Finding, Severity

AtMost = Annotated[FiniteFloat, Field(ge=0)] | None
"""Largest value that passes; None where the figure is not judged."""

AtLeast = Annotated[AtMost, "at least"]
"""Smallest value that passes."""

Share = Annotated[FiniteFloat, Field(ge=0, le=1)] | None


def _rising(ends: list[float]) -> list[float]:
    if ends[0] > ends[1]:
        raise ValueError
    return ends


Between = (
    Annotated[list[FiniteFloat], Field(min_length=2, max_length=2), AfterValidator(_rising)] | None
)
"""Ends of what passes."""

SEVERITIES: tuple[Severity, ...] = ("note", "warning", "failure")


_BETWEEN = "[low, high], two ratios, the first not above the second"

_OF_M = "a number from 0 on, relative to M"


def _most(unit: str, meaning: str, usual: float) -> Any:
    """Describe the largest value of a figure that passes."""
    return key(f"a number of {unit} from 0 on", f"largest {meaning}", usual)


def _least(unit: str, meaning: str, usual: float) -> Any:
    """Describe the smallest value of a figure that passes."""
    return key(f"a number of {unit} from 0 on", f"smallest {meaning}", usual)


class FindingLimits(Table):
    """Limits of what has findings."""

    findings: Severity | None = key(
        "note, warning or failure", "severest finding that passes", "note"
    )


class Limits(FindingLimits):
    """Limits of any result."""

    flagged_share: Share = key(
        "a share from 0 to 1", "largest share of pixels that must not be used", 0.01
    )


class CalibrationLimits(Limits):
    """Limits of a calibration."""

    sensitivity_std: AtMost = key(_OF_M, "largest median standard deviation of M", 0.005)
    tilt_std: AtMost = key(_OF_M, "largest standard deviation of the tilt, edge to edge", 0.005)
    reduced_chi2: Between = key(_BETWEEN, "mean square residual over that of noise", [0.8, 1.3])
    error_estimate: AtMost = key(_OF_M, "largest estimated error that the solver left", 1e-4)
    converged: bool | None = key(
        "true or false", "whether the solver must reach its tolerance", True
    )


class ResponseLimits(Limits):
    """Limits of response curves."""

    reduced_chi2: Between = key(_BETWEEN, "median misfit over that of noise", [0.8, 1.3])
    largest_inverse_error: AtMost = _most("DN", "error of the inverse", 1.0)


class CameraLimits(FindingLimits):
    """Limits of a camera, of each plane of its colour filters."""

    quantum_efficiency_percent: AtLeast = _least("percent", "quantum efficiency", 30.0)
    dark_noise_e: AtMost = _most("electrons", "temporal dark noise", 10.0)
    snr_max_db: AtLeast = _least("dB", "value of the largest SNR", 38.0)
    threshold_e: AtMost = _most("electrons", "absolute sensitivity threshold", 12.0)
    saturation_e: AtLeast = _least("electrons", "saturation capacity", 6000.0)
    dynamic_range_db: AtLeast = _least("dB", "dynamic range", 55.0)
    dsnu_e: AtMost = _most("electrons", "DSNU; needs [spatial]", 5.0)
    prnu_percent: AtMost = _most("percent", "PRNU; needs [spatial]", 1.0)
    linearity_error_percent: AtMost = _most("percent", "linearity error", 1.0)
    dark_current_mean_e_per_s: AtMost = _most(
        "electrons per second", "dark current by the mean; needs three exposure times", 100.0
    )


class ComparisonLimits(FindingLimits):
    """Limits of each pair of calibrations, beside what noise predicts."""

    rms: AtMost = key(_OF_M, "largest rms difference of pixels", 0.01)
    block_rms: AtMost = key(_OF_M, "largest rms difference of 16×16 means", 0.002)
    largest: AtMost = key(_OF_M, "largest difference of a pixel", 0.1)


class LimitsFile(Table):
    """The whole limits.toml: a table for each kind of result."""

    calibration: CalibrationLimits = key("a table", default=CalibrationLimits())
    response: ResponseLimits = key("a table", default=ResponseLimits())
    correction: Limits = key("a table", default=Limits())
    camera: CameraLimits = key("a table", default=CameraLimits())
    comparison: ComparisonLimits = key("a table", default=ComparisonLimits())


def read_limits(path: Path | None, *, check: bool = False) -> LimitsFile:
    """Read limits; without a file nothing is judged, which `check` refuses."""
    if check and path is None:
        raise InputError("--check needs --limits: equipix init limits writes a file of usual ones")
    return LimitsFile() if path is None else read_manifest(path, LimitsFile)


class Check(NamedTuple):
    """A figure against its limit, in words; `passed` is None where the result has no such figure.

    What is known only with an option that was not given fails.
    """

    name: str
    value: str
    wanted: str
    passed: bool | None

    @property
    def verdict(self) -> str:
        """PASS, FAIL or not judged."""
        return "not judged" if self.passed is None else "PASS" if self.passed else "FAIL"


def verdict_of(checks: Iterable[Check]) -> str:
    """PASS or FAIL; nothing where nothing is judged."""
    judged = [check.passed for check in checks if check.passed is not None]
    return "" if not judged else "PASS" if all(judged) else "FAIL"


def checked(
    limits: FindingLimits,
    figures: Mapping[str, Any],
    findings: Iterable[Finding] | None,
    notes: Mapping[str, str] | None = None,
) -> list[Check]:
    """Compare figures and findings with limits.

    A figure that is not known fails. None is one that the result does not have: it is not judged.
    The note on a figure is "below" or "above" of a bound, or why it is not known.
    """
    fields = type(limits).model_fields
    return [
        _of_findings(findings, limit)
        if name == "findings"
        else _of_figure(
            name,
            limit,
            figures.get(name, math.nan),
            (notes or {}).get(name, ""),
            least="at least" in fields[name].metadata,
        )
        for name, limit in limits
        if limit is not None
    ]


def _of_findings(findings: Iterable[Finding] | None, severest: Severity) -> Check:
    wanted = f"at most {severest}"
    if findings is None:
        return Check("findings", _NONE, wanted, None)
    worst = max((SEVERITIES.index(each.severity) for each in findings), default=-1)
    words = "none" if worst < 0 else SEVERITIES[worst]
    return Check("findings", words, wanted, worst <= SEVERITIES.index(severest))


def _of_figure(name: str, limit: Any, value: Any, note: str, *, least: bool) -> Check:
    if isinstance(limit, bool):
        return Check(name, _words(value), _words(limit), value is limit)
    low, high = limit if isinstance(limit, list) else (-math.inf, limit)
    wanted = f"{low:g} to {high:g}" if isinstance(limit, list) else f"at most {high:g}"
    if least:
        low, high, wanted = limit, math.inf, f"at least {limit:g}"
    if value is None:
        return Check(name, _NONE, wanted, None)
    values = [*value.values()] if isinstance(value, dict) else [value]
    passed = all(low <= each <= high for each in values)
    words = ", ".join(map(_words, values))
    if note in _OPEN:
        # All values that a bound allows must pass.
        passed, words = passed and low <= _OPEN[note] <= high, f"{note} {words}"
    elif note and not passed:
        words = note
    return Check(name, words, wanted, passed)


_OPEN = {"below": -math.inf, "above": math.inf}
"""The end that a bound leaves open."""


_NONE = "this result has none"


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "not known" if math.isnan(value) else f"{value:.4g}"


def in_json(checks: Iterable[Check]) -> list[dict[str, str]]:
    """Figures with their limits, for programs."""
    return [
        {"figure": each.name, "found": each.value, "wanted": each.wanted, "verdict": each.verdict}
        for each in checks
    ]


def refuse_beyond(judged: Mapping[str, Iterable[Check]], remedy: str) -> None:
    """Refuse results of which a figure is beyond its limit, or none was judged.

    Raises
    ------
    EquipixError
        With each such figure, its value and its limit; or with the `remedy`.
    """
    failed = [
        f"{name}: {check.name} is {check.value}, expected {check.wanted}"
        for name, checks in judged.items()
        for check in checks
        if check.passed is False
    ]
    open_ = [name for name, checks in judged.items() if not verdict_of(checks)]
    if open_:
        failed.append(f"nothing is judged of {', '.join(open_)}: {remedy}")
    if failed:
        raise EquipixError("; ".join(failed))


def limits_template() -> str:
    """Text of a limits.toml with usual limits, each with what it means."""
    usual: dict[str, dict[str, Any]] = {}
    for path, field in keys_of(LimitsFile):
        table, _, name = path.partition(".")
        usual.setdefault(table, {}).update({name: example_of(field)} if name else {})
    title = (
        "Limits for the option --limits of equipix report, batch, emva and compare: a figure "
        "without one may be anything."
    )
    return template(LimitsFile, title, usual)
