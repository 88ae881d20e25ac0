"""Limits on the figures of results: PASS or FAIL."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, FiniteFloat

from equipix.experiment.manifest import Table, example_of, key, keys_of, read_manifest
from equipix.experiment.templates import template
from equipix.findings import Finding, Severity

AtMost = FiniteFloat | None
"""Largest value that passes; None where the figure is not judged."""

Between = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None
"""Ends of what passes."""

SEVERITIES: tuple[Severity, ...] = ("note", "warning", "failure")


_BETWEEN = "[low, high], two numbers"

_SEVEREST = "note, warning or failure"


class Limits(Table):
    """Limits of any result."""

    flagged_share: AtMost = key("a number", "largest share of pixels that must not be used", 0.01)
    findings: Severity | None = key(_SEVEREST, "severest finding that passes", "note")


class CalibrationLimits(Limits):
    """Limits of a calibration."""

    sensitivity_std: AtMost = key("a number", "largest median standard deviation of M", 0.005)
    tilt_std: AtMost = key(
        "a number", "largest standard deviation of the tilt, edge to edge", 0.005
    )
    reduced_chi2: Between = key(_BETWEEN, "mean square residual over that of noise", [0.8, 1.3])
    error_estimate: AtMost = key("a number", "largest estimated error of the solver", 1e-4)
    converged: bool | None = key(
        "true or false", "whether the solver must reach its tolerance", True
    )


class ResponseLimits(Limits):
    """Limits of response curves."""

    reduced_chi2: Between = key(_BETWEEN, "median misfit over that of noise", [0.8, 1.3])
    largest_inverse_error: AtMost = key("a number of DN", "largest error of the inverse", 1.0)


class LimitsFile(Table):
    """The whole limits.toml: a table for each kind of result."""

    calibration: CalibrationLimits = key("a table", default=CalibrationLimits())
    response: ResponseLimits = key("a table", default=ResponseLimits())
    correction: Limits = key("a table", default=Limits())


def read_limits(path: Path | None) -> LimitsFile:
    """Read limits; without a file nothing is judged."""
    return LimitsFile() if path is None else read_manifest(path, LimitsFile)


class Check(NamedTuple):
    """A figure against its limit, in words."""

    name: str
    value: str
    wanted: str
    passed: bool


def checked(limits: Limits, figures: Mapping[str, Any], findings: Iterable[Finding]) -> list[Check]:
    """Compare figures and findings with limits; a figure that is not known fails."""
    given = {name: each for name, each in limits if each is not None}
    return [
        _of_findings(findings, limit) if name == "findings" else _of_figure(name, limit, figures)
        for name, limit in given.items()
    ]


def _of_findings(findings: Iterable[Finding], severest: Severity) -> Check:
    worst = max((SEVERITIES.index(each.severity) for each in findings), default=-1)
    told = "none" if worst < 0 else SEVERITIES[worst]
    return Check("findings", told, f"at most {severest}", worst <= SEVERITIES.index(severest))


def _of_figure(name: str, limit: Any, figures: Mapping[str, Any]) -> Check:
    value = figures.get(name)
    if isinstance(limit, bool):
        return Check(name, _words(value), _words(limit), value is limit)
    values = [*value.values()] if isinstance(value, dict) else [value]
    low, high = limit if isinstance(limit, list) else (-math.inf, limit)
    wanted = f"{low:g} to {high:g}" if isinstance(limit, list) else f"at most {high:g}"
    passed = all(isinstance(each, int | float) and low <= each <= high for each in values)
    return Check(name, ", ".join(map(_words, values)), wanted, passed)


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, int | float) else "not known"


def limits_template() -> str:
    """Text of a limits.toml with usual limits, each with what it means."""
    usual: dict[str, dict[str, Any]] = {}
    for path, field in keys_of(LimitsFile):
        table, _, name = path.partition(".")
        usual.setdefault(table, {}).update({name: example_of(field)} if name else {})
    title = "Limits for equipix report --limits: a figure without one may be anything."
    return template(LimitsFile, title, usual)
