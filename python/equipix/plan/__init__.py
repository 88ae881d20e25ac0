"""Planning of an experiment: which pixels shifts compare, and which errors remain."""

from equipix.plan.budget import ErrorBudget, error_budget
from equipix.plan.components import Identifiability, identify
from equipix.plan.drift import advise_order, tilt_std
from equipix.plan.pattern_errors import Spectrum
from equipix.plan.search import Suggestion, suggest

__all__ = [
    "ErrorBudget",
    "Identifiability",
    "Spectrum",
    "Suggestion",
    "advise_order",
    "error_budget",
    "identify",
    "suggest",
    "tilt_std",
]
