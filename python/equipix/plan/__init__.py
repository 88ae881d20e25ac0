"""Planning of an experiment: which pixels shifts compare, and which errors remain."""

from equipix.plan.budget import ErrorBudget, error_budget
from equipix.plan.identifiability import Identifiability, identify
from equipix.plan.order import advise_order, distinct_trend
from equipix.plan.search import Suggestion, suggest
from equipix.plan.spectrum import Spectrum

__all__ = [
    "ErrorBudget",
    "Identifiability",
    "Spectrum",
    "Suggestion",
    "advise_order",
    "distinct_trend",
    "error_budget",
    "identify",
    "suggest",
]
