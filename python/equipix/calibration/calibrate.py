"""Shift calibration: sensitivity and beam from exposures of one beam at several positions."""

from collections.abc import Sequence
from typing import Any, Literal

from numpy.typing import ArrayLike

from equipix._check import LOG, FluxModel, Method, Progress, naming_memory
from equipix.calibration.result import Calibration
from equipix.diagnosis.evidence import Evidence
from equipix.diagnosis.inputs import BEFORE
from equipix.diagnosis.rules import AFTER, LAST
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.findings import Finding, ask, say
from equipix.fitting.error_bars import with_bounded_dark, with_dark_misfit
from equipix.fitting.pixels import without_faint_pixels, without_false_pixels
from equipix.fitting.stated_errors import steadied, widened
from equipix.fitting.weighted import Options, is_to_be_fitted, weighted_fit
from equipix.io.record import made, now
from equipix.measured.colour import Colours
from equipix.measured.measured import measured_of
from equipix.measured.noise import NoiseModel
from equipix.measured.statistics import FrameStatistics


def calibrate(
    frames: ArrayLike | Sequence[FrameStatistics],
    shifts: ArrayLike,
    *,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    flux: ArrayLike | FluxModel | None = None,
    flux_std: ArrayLike | None = None,
    time: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    dark: Literal["subtracted", "fit"] = "subtracted",
    dark_variance: ArrayLike | None = None,
    cfa: ArrayLike | None = None,
    robust: bool = False,
    method: Method = "multiscale",
    tolerance: float = 1e-6,
    max_sweeps: int | None = None,
    uncertainty: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    r"""Measure the relative sensitivity of every pixel without a uniform source.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols), or sequence of FrameStatistics
        Mean exposures with the dark subtracted, at least two. NaN or infinite counts as masked.
        Of unsigned whole numbers no dark was subtracted, which is a finding.
        `FrameStatistics` contain their noise: the weights come from a noise model fitted over all
        pixels, not from each pixel's own sample variance; single frames show no noise, and without
        `variance` all their weights are 1. A mean with saturated samples is left
        out of its exposure, and the pixel is flagged ``SATURATED``; it keeps the sensitivity that
        the other exposures determine. Dead, hot and noisy pixels are masked and flagged, the hot
        ones where `equipix.average` was given the dark frames as `FrameStatistics`.
    shifts : array_like, shape (n, 2)
        Position (row, col) of the sensor in the beam in each exposure, in pixels: pixel p of an
        unrotated sensor sees the beam at p + shift. A wrong sign gives a wrong result, and in a
        smooth beam it leaves no residual: see `Calibration.shift_sign`. If shifts differ by parts
        of pixels the beam is a cubic spline; coordinate descent rounds them.
    variance : array_like, shape (n,) or (n, rows, cols), or NoiseModel, optional
        Variance of the values given; without it all weights are 1. A noise model, or one for each
        exposure, is evaluated at the signal of a first fit: evaluated at the noisy values, it
        would give larger weights to values that are low by chance. With `FrameStatistics` it is the
        model of one frame.
    mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
        True = do not use.
    saturation : float, optional
        Level, in the units of frames given as arrays: a value at or above it counts as masked, and
        its pixel is flagged. By default the largest value of a dtype of whole numbers.
    flux : array_like, shape (n,), "fit" or "linear", optional
        Known relative flux of each exposure, 1 unless given; or what is to be found: a flux for
        each exposure, or ln c linear in `time`.
    flux_std : float or array_like, shape (n,), optional
        Relative standard deviations of `flux`, which is then a prior and not taken as exact.
    time : array_like, shape (n,), optional
        When each exposure was taken, in seconds; for ``flux="linear"``.
    rotation : array_like of int, shape (n,), optional
        How far each exposure is turned, in degrees: 0, 90, 180 or 270, as by ``numpy.rot90`` of
        the beam's window; 0 unless given.
    shift_std : float or array_like, shape (n,) or (n, 2), optional
        Standard deviations of `shifts`, in pixels: the shifts are then refined, with this prior.
        A displacement common to all exposures stays as given. All shifts stay as given where the
        beam has no structure that determines them: ``metadata["options"]["shifts"]`` is "refined",
        "undetermined" or "not tried".
    dark : {"subtracted", "fit"}
        Whether the dark is already subtracted, or to be found as an offset of each pixel: for
        exposures at two or more levels of the lamp, whose ratio is `flux`, without a dark frame.
    dark_variance : float or array_like, shape (rows, cols), optional
        Variance of the dark mean that was subtracted from all frames, in the units of the frames
        squared: that of a dark frame over the number of dark frames. Its error is common to all
        exposures, so `variance` must be without it. It enters the error bars and `reduced_chi2`,
        not the weights. `FrameStatistics` with a dark contain it, unless `variance` is given as
        numbers.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, from pixel (0, 0) on: "RGGB", "GRBG", "GBRG" or "BGGR", rows
        of one period divided by "/" ("RRGG/RRGG/GGBB/GGBB"), or an array of labels; the period is
        at most 8×8. All colours see one beam. Neighbours and the gauge are then those of a colour:
        M has the mean 1 within each, and `Calibration.colour_response` the responses.
    robust : bool
        Whether to leave out measurements that disagree with the others, such as a particle or a
        reflection in one exposure only. Left out is what is more than five standard deviations
        from the fit, or whose 3×3 mean is, in rounds of fitting. The scale is that of the
        residuals, so variances may be wrong by a common factor. At least three exposures. Give
        variances as a noise model, not computed from values that a grain of dust has darkened.
    method : {"multiscale", "coordinate-descent"}
        How to minimise the objective: by Gauss-Newton steps on all scales at once, in a number of
        passes that does not depend on the size of the sensor; or by the paper's method, which
        takes some (sensor size / shift)² of them.
    tolerance : float
        Largest relative error of the sensitivity, against the minimum of the objective, at
        which the solver stops; below 1. The estimate includes errors of the sensor's own size.
    max_sweeps : int, optional
        Upper limit on passes over the data or its weights in each fit, of which a calibration may
        take several; a few more are made where a step is too long. By default there is no limit.
        The fit also ends where rounding keeps the error estimate from decreasing. Passes that only
        estimate the error of coordinate descent are not counted.
    uncertainty : bool
        Whether to compute `Calibration.sensitivity_std`, `Calibration.tilt_std` and, for refined
        shifts, `Calibration.shift_std`: the effect of noise and of the priors on fluxes and
        shifts. It takes several times as long as the calibration, with refined shifts
        tens of times. Without `variance` the noise is that of the residuals.
    workers : int, optional
        Number of threads; by default as many as processors may be used. It changes no bit of the
        result.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly; an exception in it stops the work.

    Returns
    -------
    Calibration
        Sensitivity, beam, flags and how far the solver came.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value, or an exposure shows no light.
    InsufficientMemoryError
        If there is not enough memory; on Linux this is checked before the work starts.

    Warns
    -----
    InputWarning
        If coordinate descent rounds a shift by more than 0.02 pixel; if many values are exactly at
        the highest one, and no saturation level is given or a higher one; if no dark was
        subtracted from frames of whole numbers; if the rounding of means is large beside their
        noise.
    IdentifiabilityWarning
        If shifts or masks leave parts of the sensor unconnected; if the shifts barely constrain a
        pattern; if less than half of the pixels that are not masked are determined
        (`Calibration.is_partial`); if free fluxes leave a tilt of the sensitivity undetermined; if
        a fitted dark is nearly degenerate with the sensitivity; if shifts look like millimetres or
        micrometres; if the order of the exposures lets a drift of the lamp look like a tilt.
    ConvergenceWarning
        If the tolerance was not reached, or a fit is too far from its minimum for error bars.
    MisfitWarning
        If the data contradict what was given: the light varied between the frames of an exposure;
        the lamp has drifted, which hides a tilt, or one flux is far off; one exposure is given
        twice; the orientation of the shifts, a sign or the order of the axes, is wrong; colour
        filters are others; reduced χ² deviates from 1 by more than five standard errors and 3 %;
        residuals of neighbouring pixels are correlated, or show a curved response, an offset of all
        values, crosstalk or the pattern of the dark. The message names the likely cause, and
        ``kind`` of the warning is that of the finding.

    Notes
    -----
    The arrays given are viewed, not copied, where their dtype and order allow it: they must not
    change during the call, nor as long as `Calibration.std_of` is asked.

    Minimises :math:`F = \sum_k \sum_p w_k(p) [y_k(p) - c_k L(u_k(p)) M(p)]^2` over the sensitivity
    M and the beam L, with weights w = 1/variance, fluxes c and the position u of pixel p in the
    beam [1]_. F does not change when M is multiplied and L divided by one number: the gauge is
    mean(M) = 1 over valid pixels. With fitted fluxes the mean of ln c is 0; then a tilt of ln M
    is determined only if exposures are turned against each other, or by `flux_std` or `time`:
    else its least-squares slope over valid pixels is set to 0, with a warning.

    Where shifts differ by whole pixels L is a value in each cell of its padded grid: a fraction of
    a pixel that all have in common moves the grid. Else it is a cubic B-spline on the grid, with a
    penalty of 1e-5 of a cell's mean weight on its fourth differences [2]_. Fluxes and shifts, like
    L, are found by Gauss-Newton steps in which M is eliminated by its closed form.

    The orientation of the shifts is tested with at most twelve exposures, as far apart as possible,
    and with the central pixels: four times as many along each axis as the largest shift, or fewer
    where that is more than 80. They are fitted with both signs along each axis and with the axes
    exchanged, where exposures are turned also with the opposite turns; fluxes are free in all. An
    orientation is excluded if its F is higher than the lowest by 6·√(2/dof) of itself, in two
    thirds of all places, and by a misfit of more than 0.5 % of the signal; and only if the
    residuals of the lowest F are white, or the misfit is 30 times what correlates in them. Nothing
    is tested, and all undetermined, with fewer than three exposures or a thousand degrees of
    freedom, with ``dark="fit"``, without shifts, and where the middle of the sensor has no light.

    References
    ----------
    .. [1] S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light
       sensitivity of matrix photo receivers", Radiophysics and Quantum Electronics, 2011.
    .. [2] P. H. C. Eilers, B. D. Marx, "Flexible smoothing with B-splines and penalties",
       Statistical Science 11 (1996) 89-121.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> shape = (48, 64)
    >>> beam = equipix.simulate.gaussian_beam(shape)
    >>> truth = equipix.simulate.paper_sensitivity(shape, rng=1)
    >>> shifts = equipix.cross_pattern(5, 7)
    >>> cal = equipix.calibrate(equipix.simulate.exposures(truth, beam, shifts), shifts)
    >>> bool(np.abs(cal.sensitivity / (truth / truth.mean()) - 1).max() < 1e-6)
    True
    """
    fit_options = FitOptions.of(method, tolerance, max_sweeps, workers, progress)
    with naming_memory("calibrating"):
        measured = measured_of(frames, variance, saturation, colours=Colours.of(cfa))
        exposures = Exposures.of(
            measured,
            Positions.of(shifts, rotation=rotation, std=shift_std, shape=measured.values.shape),
            Flux.of(flux, flux_std, time, len(measured)),
            mask=mask,
            offset=is_to_be_fitted(dark),
            dark_variance=dark_variance,
        )
    if fit_options.whole_shifts:
        exposures = exposures.at(exposures.positions.whole())
    return calibrated(exposures, Options(fit_options, robust=robust, uncertainty=uncertainty))


def calibrated(
    exposures: Exposures,
    options: Options,
    *,
    said: tuple[Finding, ...] = (),
    provenance: dict[str, Any] | None = None,
) -> Calibration:
    """Calibrate from exposures: weights, fit, orientation, flags, error bars, findings.

    `said` are findings before, and `provenance` is added to the metadata.
    """
    started = now()
    said += say(*ask(BEFORE, exposures))
    weighted = steadied(weighted_fit(exposures, options), exposures, options)
    weighted = with_bounded_dark(weighted)
    # Until weights and priors are final.
    for step in (without_false_pixels, without_faint_pixels, widened, with_dark_misfit):
        weighted = step(weighted, options)
    evidence = Evidence.of(weighted, options, exposures.flux)
    sweeps, errors = weighted.fit.sweeps, weighted.fit.error_estimate
    LOG.info("fitted: %d passes over the data, estimated error %.2g", sweeps[-1], errors[-1])
    # Before the error bars, which may be refused or interrupted.
    said += say(*ask(AFTER, evidence, said))
    if options.uncertainty:
        LOG.info("computes standard deviations, which may take most of the time")
    evidence = evidence.with_error_bars()
    said += say(*ask(LAST, evidence))
    return Calibration.of(evidence, said, _metadata(evidence, started) | (provenance or {}))


def _metadata(evidence: Evidence, started: str) -> dict[str, Any]:
    """Versions, options and times, as JSON values."""
    exposures, fit, options = evidence.exposures, evidence.fit, evidence.options
    dark, bars, rejected = evidence.dark, evidence.bars, evidence.weighted.rejected
    chosen: dict[str, Any] = {
        "method": options.fit.method,
        "tolerance": options.fit.tolerance,
        "max_sweeps": options.fit.max_sweeps,
        "dark": "fit" if exposures.offset else "subtracted",
        "flux": exposures.flux.kind,
        "weights": "variances" if exposures.knows_noise else "equal",
        "rotation": exposures.positions.rotation.tolist(),
        "robust": options.robust,
    }
    if exposures.cfa is not None:
        chosen["cfa"] = exposures.cfa.written
    if exposures.positions.std is not None:
        chosen["shifts"] = fit.refinement
    metadata = made(options=chosen, started=started)
    if dark is not None:
        metadata["dark"] = dark._asdict()
    if rejected is not None:
        metadata["rejected"] = rejected.sum(axis=(1, 2)).tolist()
    if bars is not None:
        metadata["uncertainty"] = bars.exactness
    return metadata
