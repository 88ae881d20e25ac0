"""What limits a result, as findings; what limits a pixel, as flags."""

import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntFlag
from typing import Generic, Literal, TypeVar

import numpy as np

from equipix import errors
from equipix._check import Array, Bools, Floats
from equipix.shown import Brief

Concern = Literal["input", "identifiability", "misfit", "convergence"]
"""What a finding concerns: the values given, what they determine, the model, or the solver."""

Severity = Literal["note", "warning", "failure"]
"""The result is right, may be wrong, or is none."""

WARNINGS: dict[Concern, type[errors.EquipixWarning]] = {
    "input": errors.InputWarning,
    "identifiability": errors.IdentifiabilityWarning,
    "misfit": errors.MisfitWarning,
    "convergence": errors.ConvergenceWarning,
}
"""The class of the warning of each concern."""

_Evidence = TypeVar("_Evidence")


@dataclass(frozen=True)
class Finding(Brief):
    """A finding that limits a result.

    Attributes
    ----------
    kind : str
        Its subject, such as "saturation" or "drift".
    message : str
        What is wrong, the value, the limit and the remedy.
    concern : {"input", "identifiability", "misfit", "convergence"}
        What it concerns: the values given, what they determine, the model, or the solver. It sets
        the class of the warning.
    severity : {"note", "warning", "failure"}
        "note" where the result is right and the next measurement can be better, "failure" where
        less than half of it is determined.
    """

    kind: str
    message: str
    concern: Concern
    severity: Severity = "warning"


Findings = tuple[Finding, ...]


@dataclass(frozen=True)
class Rule(Generic[_Evidence]):
    """A question that may give a finding: an entry in a table of them.

    Attributes
    ----------
    kind, concern, severity : str
        Those of the finding.
    ask : callable
        Answers from evidence with the message of the finding, or with nothing.
    unless : frozenset of str
        Kinds that explain the finding: beside one of them the question is not asked.
    instead : frozenset of str
        Kinds in whose place the finding stands.
    """

    kind: str
    concern: Concern
    ask: Callable[[_Evidence], str | None]
    unless: frozenset[str] = frozenset()
    instead: frozenset[str] = frozenset()
    severity: Severity = "warning"


def ask(
    rules: Iterable[Rule[_Evidence]], evidence: _Evidence, before: Iterable[Finding] = ()
) -> tuple[Finding, ...]:
    """Ask the questions of a table in its order; `before` are findings that may explain others."""
    explained, found = {each.kind for each in before}, list[Finding]()
    for rule in rules:
        if rule.unless & (explained | {each.kind for each in found}):
            continue
        if message := rule.ask(evidence):
            found = [each for each in found if each.kind not in rule.instead]
            found.append(Finding(rule.kind, message, rule.concern, rule.severity))
    return tuple(found)


def say(*findings: Finding) -> tuple[Finding, ...]:
    """Warn of each finding, at the line outside of the package that called it; return all."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] == "equipix":
        level, frame = level + 1, frame.f_back
    for each in findings:
        warning = WARNINGS[each.concern](each.message)
        warning.kind = each.kind
        warnings.warn(warning, stacklevel=level)
    return findings


class Flag(IntFlag):
    """Defects of a pixel: bits of ``flags`` arrays, with JWST's bit numbers.

    A pixel without any bit set is good. ``DO_NOT_USE`` accompanies every flag that makes the
    pixel's corrected value worthless.
    """

    DO_NOT_USE = 1 << 0
    SATURATED = 1 << 1
    DEAD = 1 << 10
    HOT = 1 << 11
    TELEGRAPH = 1 << 15
    NONLINEAR = 1 << 16
    NO_FLAT_FIELD = 1 << 18
    UNRELIABLE_FLAT = 1 << 25
    OTHER_BAD_PIXEL = 1 << 30


BITS = {
    "saturated": Flag.SATURATED,
    "dead": Flag.DEAD | Flag.DO_NOT_USE,
    "hot": Flag.HOT | Flag.DO_NOT_USE,
    "noisy": Flag.HOT | Flag.DO_NOT_USE,
    "contradictory": Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE,
    "faint": Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE,
    "undetermined": Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE,
    "falling": Flag.NONLINEAR | Flag.DO_NOT_USE,
    "nonlinear": Flag.NONLINEAR | Flag.DO_NOT_USE,
    "non_responding": Flag.DEAD | Flag.DO_NOT_USE,
    "flickering": Flag.TELEGRAPH | Flag.DO_NOT_USE,
    "out_of_range": Flag.OTHER_BAD_PIXEL | Flag.DO_NOT_USE,
}
"""Bits that each finding sets; a saturated value is left out of its exposure, and the pixel keeps
the sensitivity that the others determine. The last six are on response curves."""


def set_bits(flags: Array, finding: str, pixels: Bools | None) -> None:
    """Set the bits of a finding in `flags` where `pixels` is true."""
    if pixels is not None:
        flags[pixels] |= np.uint32(BITS[finding])


def usable(flags: Array) -> Bools:
    """Pixels without ``DO_NOT_USE``."""
    return np.asarray((flags & Flag.DO_NOT_USE) == 0)


def mean_of_usable(sensitivity: Floats, flags: Array) -> float:
    """Mean sensitivity of pixels without ``DO_NOT_USE``; 1 if it is but for rounding, or none."""
    counted = usable(flags) & np.isfinite(sensitivity)
    mean = float(np.mean(sensitivity, where=counted)) if counted.any() else 1.0
    return mean if abs(mean - 1) > counted.size * np.finfo(float).eps else 1.0


def determined(sensitivity: Array, flags: Array) -> Bools:
    """Where ln M is known: M is above 0, and its measurements carry weight."""
    weak = (flags & Flag.UNRELIABLE_FLAT) != 0
    return np.asarray((sensitivity > 0) & ~weak)
