"""Evidence on a fit: what residuals, fluxes and other models show of it."""

import dataclasses
from dataclasses import dataclass
from typing import Self

from equipix._check import Array
from equipix._native import Fit
from equipix.diagnosis.gauges import contradiction
from equipix.diagnosis.lamp_drift import Drift, lamp_drift, with_hidden_tilt
from equipix.diagnosis.misfit import Misfit, misfit
from equipix.diagnosis.orientation import OrientationTest, orientation_test
from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.fitting.error_bars import DarkStd, ErrorBars, standard_deviations
from equipix.fitting.pixels import pixel_flags
from equipix.fitting.residuals import Residuals, rms_map, sampled
from equipix.fitting.weighted import Options, Weighted, sampled_arrays


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the rules of a calibration are asked of.

    Attributes
    ----------
    weighted : Weighted
        The exposures with their final weights, and their fit.
    options : Options
        How it was made.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.
    residuals : Residuals
        A sample of the residuals.
    residual_map : ndarray
        Their rms in cells of pixels.
    orientation : OrientationTest
        Which orientation of the shifts the data confirm.
    drift : Drift or None
        What they say of the fluxes given.
    misfit : Misfit or None
        What the residuals show, if anything.
    colours : str or None
        In what the colours contradict one beam for all.
    bars : ErrorBars or None
        Standard deviations, where they were asked for and exist.
    dark : DarkStd or None
        Those of a dark that was fitted together with fluxes.
    """

    weighted: Weighted
    options: Options
    flags: Array
    residuals: Residuals
    residual_map: Array
    orientation: OrientationTest
    drift: Drift | None
    misfit: Misfit | None
    colours: str | None
    bars: ErrorBars | None = None
    dark: DarkStd | None = None

    @classmethod
    def of(cls, weighted: Weighted, options: Options, flux: Flux) -> Self:
        """Collect it; `flux` is that which was given, with its own prior."""
        # Before anything that calls the caller back, who may change the arrays.
        weighted = weighted._replace(sampled=sampled_arrays(weighted.exposures))
        orientation = orientation_test(weighted.exposures, weighted.fit, options.fit, flux)
        flags = pixel_flags(weighted, options.fit)
        residuals = sampled(weighted, workers=options.fit.workers)
        drift = lamp_drift(weighted, residuals)
        contradicted = drift is not None and drift.is_certain
        contradicted |= bool({"flux_std", "shift_std"} & weighted.replaced.keys())
        found = misfit(weighted, flags, residuals, options.fit)
        colours = contradiction(weighted, residuals, flags)
        if found is not None:
            weighted = weighted._replace(excess=found.excess)
        orientation = orientation.among_fluxes(contradicted=contradicted)
        seen = (residuals, rms_map(weighted, options.fit.workers))
        return cls(weighted, options, flags, *seen, orientation, drift, found, colours)

    @property
    def exposures(self) -> Exposures:
        """The exposures with their final weights."""
        return self.weighted.exposures

    @property
    def fit(self) -> Fit:
        """Their fit."""
        return self.weighted.fit

    def with_error_bars(self) -> Self:
        """Add standard deviations, which contain the tilt that a drift of the lamp hides."""
        bars, dark = standard_deviations(self.weighted, self.flags, self.options)
        if bars is not None and self.drift is not None:
            bars = with_hidden_tilt(bars, self.drift, self.fit.sensitivity)
        return dataclasses.replace(self, bars=bars, dark=dark)
