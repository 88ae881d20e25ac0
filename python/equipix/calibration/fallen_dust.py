"""Dust that falls on the sensor between two exposures and stays there."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.residual_tests import ROBUST, nanmedian_abs
from equipix.calibration.robust import box_sums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix._native import Fit
    from equipix._types import Bools, Floats
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_BEYOND = 6.0
"""Standard deviations that a step of the residuals of one pixel does not reach by noise."""

_NEAR = 3.0
"""The same where the neighbours have one: grains are larger than a pixel, and have soft edges."""

_LEADING = 0.4
"""Share of the largest step that others must have in a round: through the beam a grain spreads a
part 1/n of its own over other pixels, more where several of its pixels meet."""

_STEP = 0.85
"""Share of the squared residuals of a pixel that one step in time explains. Of a false value in one
exposure it explains at most 0.38 with five exposures, and less with more."""

_TOGETHER = 4
"""Pixels of 3×3 that have their step at one moment. A large reflection in one exposure meets itself
through the beam, in patterns that single pixels may show as a step."""

_MOST_ROUNDS = 10
"""Most rounds of finding and fitting: a large grain hides smaller ones beside it."""


def without_fallen_dust(
    exposures: Exposures, fit: Fit, options: FitOptions
) -> tuple[Exposures, Fit]:
    """Leave out, where dust fell, the values before it did, and fit again.

    Under the grain the sensitivity is then that of the later exposures. The pixels are findings.

    Notes
    -----
    Exposures are in the order of time. For each moment with at least two exposures before and after
    it, the difference of the mean residuals after and before is tested. The
    sensitivity of a pixel takes the mean of both, so that residuals change their sign then.
    """
    moment = np.zeros(exposures.shape, np.int64)
    for _ in range(_MOST_ROUNDS):
        step, first = steps(exposures, fit, options)
        found = _together((step > _BEYOND) & (step > _LEADING * step.max()), first)
        edges = not found.any() and moment.any()
        if edges:
            found, first = _beside(moment, step > _NEAR), _around(moment)
        if not found.any():
            break
        moment = np.where(found, first, moment)
        before = np.arange(len(exposures))[:, None, None] < moment
        findings = dataclasses.replace(exposures.findings, contradictory=moment > 0)
        exposures = dataclasses.replace(exposures.without(before), findings=findings)
        fit = exposures.fit(options, fit)
        if edges:
            break
    return exposures, fit


def steps(exposures: Exposures, fit: Fit, options: FitOptions) -> tuple[Floats, NDArray[np.int64]]:
    """Step of the residuals of each pixel in standard deviations, and the first exposure after it.

    It is the smaller of the pixel's own and of that of the 3×3 pixels around; 0 where something
    other than a step explains most of the residuals.
    """
    residuals = _scaled(exposures, fit, options)
    count, shape = len(residuals), exposures.shape
    largest, moment = np.zeros(shape), np.zeros(shape, np.int64)
    square = np.einsum("krc,krc->rc", residuals, residuals)
    for first in range(2, count - 1):
        contrast = np.where(np.arange(count) < first, -1 / first, 1 / (count - first))
        contrast /= np.linalg.norm(contrast)
        own = np.tensordot(contrast.astype(np.float32), residuals, axes=1)
        # Box sums are linear: those of the step are the step of those of the residuals.
        mean = np.abs(box_sums(own)) / 3
        explains = own**2 > _STEP * square
        step = np.where(explains & (mean > _NEAR), np.abs(own), 0)
        later = step > largest
        moment[later], largest[later] = first, step[later]
    return largest, moment


def _scaled(exposures: Exposures, fit: Fit, options: FitOptions) -> NDArray[np.float32]:
    """Residuals in standard deviations, by their own scale in each exposure; 0 where unknown.

    One exposure after the other, in single precision: they are as many as the data.
    """
    scaled, scale = np.empty(exposures.values.shape, np.float32), np.empty(len(exposures))
    for k, each in enumerate(scaled):
        residual = exposures.residual(fit, k, options.workers)
        usable = exposures.used(fit, k)
        np.divide(residual, exposures.deviation(k), out=residual, where=usable)
        residual[~usable] = np.nan
        scale[k] = ROBUST * nanmedian_abs(residual[None])[0]
        each[:] = residual
    usual = np.maximum(scale, options.tolerance * np.median(scale) + np.finfo(np.float32).tiny)
    scaled /= usual[:, None, None].astype(np.float32)
    return np.nan_to_num(scaled, copy=False)


def _together(found: Bools, first: NDArray[np.int64]) -> Bools:
    """Those that have others beside them, with the step at the same moment."""
    together = np.zeros_like(found)
    for moment in np.unique(first[found]):
        same = found & (first == moment)
        together |= same & (box_sums(same) >= _TOGETHER)
    return together


def _beside(moment: NDArray[np.int64], near: Bools) -> Bools:
    """Pixels that deviate, beside those that were found."""
    return np.asarray((moment == 0) & near & (_around(moment) > 0))


def _around(moment: NDArray[np.int64]) -> NDArray[np.int64]:
    """Largest moment among the 3×3 pixels around each."""
    padded = np.pad(moment, 1)
    rows, cols = moment.shape
    parts = (padded[r : r + rows, c : c + cols] for r in range(3) for c in range(3))
    return functools.reduce(np.maximum, parts)
