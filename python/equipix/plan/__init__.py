"""Planning of an experiment: which pixels shifts compare, and which errors remain."""

from equipix.plan.budget import error_budget
from equipix.plan.components import identify
from equipix.plan.drift import advise_order, tilt_std
from equipix.plan.search import suggest

__all__ = ["advise_order", "error_budget", "identify", "suggest", "tilt_std"]
__dir__ = __all__.copy
