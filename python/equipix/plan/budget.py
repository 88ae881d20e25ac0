"""The error budget of a planned calibration: noise, lamp drift, errors of the shifts."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equipix._check import ArrayLike, Floats, as_shifts, check_shape, per_exposure, positive
from equipix.errors import InputError
from equipix.exposures.positions import whole_moves
from equipix.findings import Finding, Rule, ask, say
from equipix.plan import pattern_errors
from equipix.plan.components import identify
from equipix.plan.drift import distinct_trend, tilt_of_fluxes, tilt_rms
from equipix.plan.pattern_errors import LocalVariance, Spectrum

_WHOLE = 0.02
"""Largest fraction of a pixel at which shifts count as whole, as in `calibrate`'s warning."""

_NOISY = 0.1
"""Error by noise, and light over that of other pixels, from which pixels are looked at one by one:
beside one pixel in a hundred that is not determined the rms is larger."""

_LOOKED_AT = 1000
"""Rows and columns of a larger sensor that are looked at."""

_BLOCK = 64
"""Rows of the map at a time."""

_UNDETERMINED = 1e-4
"""λ of a wave that shifts between pixels do not determine, as in a calibration's finding."""


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBudget:
    """Errors that a calibration will have: the result of `error_budget`.

    Errors are relative ones of the sensitivity M in the gauge mean(M) = 1: standard deviations
    over many such experiments.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : ndarray, shape (n, 2), float64
        The shifts (row, col) in pixels.
    rms : float
        Root mean square over the sensor of all errors, those by cause in quadrature; NaN where that
        by noise is not known, see `error_budget`.
    rms_by_cause : dict
        The same for ``"noise"``, ``"drift"`` and ``"shift_error"`` alone.
    tilt_by_cause : dict
        Standard deviation of the tilt of ln M, edge to edge (row, col), for ``"drift"`` and
        ``"shift_error"``. That of noise is far smaller.
    spectrum : Spectrum
        λ(q) and its worst wave.
    distinct_trend : float
        Share of the variance of a linear trend of the lamp, with the exposures in this order,
        that is distinct from a tilt: see `advise_order`.
    components : int
        Number of connected components; of more than one, the errors are those within each.
    findings : tuple of Finding
        What limits the pattern, each also a warning.
    """

    shape: tuple[int, int]
    shifts: Floats
    rms: float
    rms_by_cause: dict[str, float]
    tilt_by_cause: dict[str, tuple[float, float]]
    spectrum: Spectrum
    distinct_trend: float
    components: int
    _local: LocalVariance
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        """Short form: the errors by cause."""
        causes = ", ".join(f"{rms:.1e} {name}" for name, rms in self.rms_by_cause.items())
        return f"<ErrorBudget of {len(self.shifts)} exposures: {self.rms:.1e} rms ({causes})>"

    @cached_property
    def noise_map(self) -> Floats:
        """Standard deviation of M from noise, shape (rows, cols); inf where not determined.

        By halves of the sensor it is within 10 % of simulation; within 25 % where a few long or
        nearly periodic waves make up most of the error, as with shifts of one pixel.
        """
        rows, cols = map(np.arange, self.shape)
        starts = range(0, len(rows), _BLOCK)
        return np.concatenate([self.noise_at(rows[i : i + _BLOCK], cols) for i in starts])

    def noise_at(self, rows: ArrayLike, cols: ArrayLike) -> Floats:
        """Return the `noise_map` on a grid of some rows and columns, (rows, cols)."""
        shape = self._local.at(np.asarray(rows), np.asarray(cols)) / self._local.mean
        return self.rms_by_cause["noise"] * np.sqrt(shape)


def error_budget(
    shape: tuple[int, int],
    shifts: ArrayLike,
    *,
    noise: float,
    drift: float = 0,
    shift_error: float = 0,
    beam_width: float | None = None,
    flux: ArrayLike | None = None,
) -> ErrorBudget:
    r"""Predict the errors of a calibration that takes its fluxes and shifts as known.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : array_like, shape (n, 2)
        Position (row, col) of the sensor in the beam in each exposure, in pixels; at least two.
        Fractions of a pixel count for drift, errors of shifts and the spectrum; noise is that of
        the nearest whole shifts, which a calibration between pixels has too. Its effect is not
        known, NaN, where these compare at most half of the sensor, as shifts below one pixel do.
    noise : float
        Standard deviation of the random noise of an exposure's mean, the same in every pixel, as
        a share of the signal in the middle of the beam at flux 1.
    drift : float
        Standard deviation of the relative flux of an exposure about the flux that is taken for
        known, independent from exposure to exposure: a lamp's drift, or a monitor's error.
    shift_error : float
        Standard deviation of the error of a shift along each axis, in pixels, independent from
        exposure to exposure. Without `beam_width` it does nothing: an even beam forgives it.
    beam_width : float, optional
        Width D of a beam exp(−r²/D²) that is centred on the sensor at shift 0, in pixels; an even
        beam unless given.
    flux : array_like, shape (n,), optional
        Known relative flux of each exposure; 1 unless given.

    Returns
    -------
    ErrorBudget
        Errors and tilt by cause, the map of errors from noise, the spectrum.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value, or a shift is as large as the sensor.

    Warns
    -----
    MisfitWarning
        If the tilt that drift leaves exceeds the error from noise.
    IdentifiabilityWarning
        If the shifts leave parts of the sensor uncompared, lie on one line, or, between pixels, do
        not constrain a wave or leave the error by noise unknown; if the beam lights only a part of
        the sensor.

    Notes
    -----
    With weights 1 and M = 1, noise σ leaves a covariance of :math:`\sigma^2 S^{-1}`, S being the
    matrix of the linear problem for M: its diagonal is approximated by paths of one step, which
    include edges and the beam, and scaled to draws of noise that `calibrate` solves, of a large
    sensor on a part. It is within some per cent. Drift: the part of ln c that is affine in d leaves
    no residual and becomes a tilt, whose slope has the covariance (drift²/n)·cov(d)⁻¹. Errors of
    shifts: by least squares over polynomials of degree 6. Weights are 1 throughout, as in
    `calibrate` without `variance`.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> budget = plan.error_budget((582, 782), cross_pattern(11, 19), noise=5.8e-4, drift=1e-5)
    >>> budget
    <ErrorBudget of 5 exposures: 3.7e-04 rms (3.1e-04 noise, 2.0e-04 drift, 0.0e+00 shift_error)>
    >>> print(f"{budget.tilt_by_cause['drift'][1]:.1e} from the first column to the last")
    5.6e-04 from the first column to the last
    """
    sizes = check_shape(shape)
    exact = as_shifts(shifts)
    if len(exact) < 2:
        raise InputError(f"'shifts' holds {len(exact)} exposures, expected at least two")
    check_causes(sizes, noise, drift, shift_error, beam_width)
    powers = per_exposure("flux", flux, len(exact), default=1)
    if not (np.isfinite(powers).all() and (powers > 0).all()):
        raise InputError(f"'flux' is {powers.tolist()}, expected numbers above 0")
    positions = whole_moves(exact)
    waves = pattern_errors.spectrum(exact, powers)
    # Between pixels no part of the sensor is unconnected: each is compared with parts of cells.
    parts = identify(sizes, positions)
    components = 1 if between_pixels(exact) else parts.components
    local = LocalVariance(sizes, positions, powers, beam_width)
    by_noise = np.nan
    if components > 1 or 2 * parts.largest > np.prod(sizes):
        by_noise = noise * np.sqrt(pattern_errors.factor(sizes, positions, powers) * local.mean)
    drifted = tilt_of_fluxes(sizes, exact, drift)
    along_rows, along_cols = drifted.tolist()
    moved, tilt = pattern_errors.shift_error_effect(sizes, exact, powers, beam_width, shift_error)
    causes = {"noise": float(by_noise), "drift": float(tilt_rms(drifted)), "shift_error": moved}
    budget = ErrorBudget(
        shape=sizes,
        shifts=exact,
        rms=float(np.linalg.norm(list(causes.values()))),
        rms_by_cause=causes,
        tilt_by_cause={"drift": (along_rows, along_cols), "shift_error": tilt},
        spectrum=waves,
        distinct_trend=distinct_trend(exact),
        components=components,
        _local=local,
    )
    return replace(budget, findings=say(*ask(_RULES, budget)))


def check_causes(
    shape: tuple[int, int], noise: float, drift: float, shift_error: float, beam_width: float | None
) -> None:
    """Refuse a sensor of one pixel, and causes of errors that are not numbers.

    The parameters are those of `error_budget`.
    """
    if shape == (1, 1):
        raise InputError(
            f"'shape' is {shape}, expected at least two pixels: one cannot be compared with another"
        )
    positive("noise", noise)
    positive("drift", drift, zero=True)
    positive("shift_error", shift_error, zero=True)
    if beam_width is not None:
        positive("beam_width", beam_width)


def between_pixels(shifts: Floats) -> bool:
    """Whether shifts lie between pixels.

    Such shifts compare each pixel with parts of several cells, so no part of the sensor is
    unconnected; but a wave of the same phase in all exposures is undetermined.
    """
    moves = shifts - shifts[0]
    return bool(np.abs(moves - np.rint(moves)).max() > _WHOLE)


def _on_wave(budget: ErrorBudget) -> str | None:
    """Say that a wave is periodic in all of shifts between pixels."""
    waves = budget.spectrum
    if not (between_pixels(budget.shifts) and np.isfinite(waves.worst).all()):
        return None
    if not pattern_errors.smallest_near(waves, budget.shifts) < _UNDETERMINED:
        return None
    row, col = waves.worst
    return (
        f"the shifts do not constrain a wave of ({row:.3f}, {col:.3f}) cycles per pixel, which "
        "has the same phase in all exposures: choose less regular shifts (equipix.plan.suggest)"
    )


def _on_components(budget: ErrorBudget) -> str | None:
    """Say that shifts of whole pixels leave parts of the sensor unconnected."""
    if budget.components <= 1 or between_pixels(budget.shifts):
        return None
    return (
        f"the shifts leave {budget.components} parts of the sensor unconnected: the errors are "
        "those within a part: choose other shifts (equipix.plan.suggest)"
    )


def _on_noise(budget: ErrorBudget) -> str | None:
    """Say that nothing predicts the effect of noise."""
    if not np.isnan(budget.rms_by_cause["noise"]):
        return None
    return (
        "the error by noise is not known, since the shifts, rounded to whole pixels, compare at "
        "most half of the sensor: choose other shifts (equipix.plan.suggest)"
    )


def _on_line(budget: ErrorBudget) -> str | None:
    """Say that shifts along one line leave a tilt undetermined, whatever the lamp's drift."""
    if np.isfinite(budget.rms_by_cause["drift"]):
        return None
    return (
        "the shifts lie on one line, so that any drift of the lamp leaves the tilt of the "
        "sensitivity across it undetermined: choose shifts along both axes (equipix.plan.suggest)"
    )


def _on_beam(budget: ErrorBudget) -> str | None:
    """Say that the beam lights only a part of the sensor."""
    rows, cols = (np.unique(np.linspace(0, n - 1, _LOOKED_AT).round()) for n in budget.shape)
    noise = budget.noise_at(rows, cols) if budget.rms_by_cause["noise"] > _NOISY else np.zeros(1)
    share = np.mean((noise > max(1, noise.min() / _NOISY)) & np.isfinite(noise))
    width = np.ceil(np.hypot(*budget.shape) / 2 / np.log(1 / _NOISY) ** 0.5)
    words = (
        f"the beam is too weak for {share:.1%} of the pixels, whose sensitivity is not determined, "
        f"since its error by noise exceeds it: take 'beam_width' {width:.0f} or more, which gives "
        "the corners a tenth of the light"
    )
    return words if share else None


def _on_drift(budget: ErrorBudget) -> str | None:
    """Say that the tilt from drift exceeds the noise."""
    drift, noise = (budget.rms_by_cause[cause] for cause in ("drift", "noise"))
    if not np.inf > drift > noise > 0:
        return None
    return (
        f"lamp drift will tilt the sensitivity by {drift:.1e} rms, {drift / noise:.1f} times the "
        "error by noise, and leaves no residual: measure the flux, add a turned exposure, or "
        "use larger shifts of more exposures (equipix.plan.suggest)"
    )


_RULES: tuple[Rule[ErrorBudget], ...] = (
    Rule("pattern", "identifiability", _on_wave),
    Rule("components", "identifiability", _on_components),
    Rule("noise", "identifiability", _on_noise),
    Rule("tilt", "identifiability", _on_line, unless=frozenset({"components"})),
    Rule("beam", "identifiability", _on_beam),
    Rule("drift", "misfit", _on_drift),
)
"""What is asked of a pattern of shifts."""
