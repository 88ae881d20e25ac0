"""Exposures with final weights, their fit, and a sample that tells whether they changed.

Exposures hold views of the caller's arrays, and the compiled fit reads them again for later
questions. A copy would double the memory of a calibration, and a checksum would read all of it.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Self

import numpy as np

from equipix._check import Array, Bools, Floats, union
from equipix._native import Fit, Start
from equipix.errors import InputError
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.fitting.outliers import rejected, without_fallen_dust
from equipix.measured.noise import modelled_variances
from equipix.measured.part import blocks

_FEWEST_FOR_REJECTION = 3
"""Fewest exposures: with two, no residual shows which of two measurements is wrong."""


@dataclass(frozen=True)
class Options:
    """How a calibration is made.

    Attributes
    ----------
    fit : FitOptions
        How each fit is made.
    robust : bool
        Whether to leave out measurements that disagree with the others.
    uncertainty : bool
        Whether to find standard deviations.
    """

    fit: FitOptions
    robust: bool = False
    uncertainty: bool = False

    def __post_init__(self) -> None:
        """Refuse values that are not bool."""
        for name in ("robust", "uncertainty"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"'{name}' is {getattr(self, name)!r}, expected True or False")

    def check(self, exposures: Exposures) -> None:
        """Refuse options that these exposures exclude."""
        if exposures.offset and exposures.noise:
            raise InputError(
                "'dark' is 'fit', but the noise model, that of averages or of 'variance', expects "
                "the signal alone: subtract a dark, or give 'variance' as numbers"
            )
        if exposures.offset and self.robust:
            raise InputError(
                "'dark' is 'fit', but 'robust' expects the signal alone: subtract a dark, or leave "
                "'robust' out"
            )
        if self.robust and len(exposures) < _FEWEST_FOR_REJECTION:
            raise InputError(
                f"'robust' is True with {len(exposures)} exposures, expected at least "
                f"{_FEWEST_FOR_REJECTION}: with fewer no residual shows which measurement is false"
            )


def is_to_be_fitted(dark: object) -> bool:
    """Whether the dark is an unknown of the fit; refuses other values."""
    if not isinstance(dark, str | bool | None):
        raise InputError(
            "'dark' holds values: subtract it from the frames, or give it to equipix.average"
        )
    if dark not in ("subtracted", "fit"):
        raise InputError(f"'dark' is {dark!r}, expected 'subtracted' or 'fit'")
    return dark == "fit"


_ROUGH = 1e-3
"""Tolerance of a fit that only predicts how much signal to expect: its noise is larger."""

_MOST_ROUNDS = 20
"""Most rounds of fitting and leaving out; a grain of dust takes three or four, a thirtieth of false
values beside as many masked ones nine."""

_FEWEST = 2
"""Fewest measurements of a pixel that confirm each other."""


class Weighted(NamedTuple):
    """Exposures with their final weights, their fit, and the measurements left out.

    `dark_misfit` is what the noise of the dark adds to F on average, `sampled` what the arrays held
    that later questions read again. `excess` is the factor by which a beam that is finer than its
    spline raises the variance of residuals above that given. `replaced` says why a variance or a
    prior that was given was replaced, by the name of its argument.
    """

    exposures: Exposures
    fit: Fit
    rejected: Bools | None
    dark_misfit: float = 0.0
    sampled: Mapping[str, Array] = MappingProxyType({})
    excess: float = 1.0
    replaced: Mapping[str, str] = MappingProxyType({})

    def again(self, exposures: Exposures, options: FitOptions) -> Self:
        """Fit other exposures, beginning at this fit."""
        return self._replace(exposures=exposures, fit=exposures.fit(options, self.fit.start()))

    @property
    def reduced_chi2(self) -> float:
        """F over that expected, or the variance of a value of weight 1; NaN where undetermined."""
        freedom = self.fit.degrees_of_freedom
        if freedom <= 0:
            return float("nan")
        if self.exposures.knows_noise:
            return self.fit.misfit / self.expected_misfit
        left = self.fit.misfit - self.dark_misfit
        return left / freedom if left > 0 or self.dark_misfit == 0 else float("nan")

    @property
    def expected_misfit(self) -> float:
        """F where variances are right: degrees of freedom, and what the noise of the dark adds."""
        return self.fit.degrees_of_freedom + self.dark_misfit

    @property
    def chi2_std(self) -> float:
        """Standard error of reduced χ² where variances are known and right.

        In a pixel with f degrees of freedom, of which one has the variance 1 + m by the noise of
        the dark, F has the variance 2f + 4m + 2m². m counts as alike in all pixels: in a beam that
        falls to its edge the standard error is larger, by a fifth in one of width 30 on 48×64.
        """
        added, pixels = self.dark_misfit, int(np.isfinite(self.fit.sensitivity).sum())
        variance = 2 * self.fit.degrees_of_freedom + 4 * added + 2 * added**2 / max(pixels, 1)
        return float(np.sqrt(variance)) / self.expected_misfit

    @property
    def noise_variance(self) -> float:
        """Variance of a value of weight 1: `excess` where variances are known, else reduced χ²."""
        return self.excess if self.exposures.knows_noise else self.reduced_chi2


def weighted_fit(exposures: Exposures, options: Options, start: Start | None = None) -> Weighted:
    """Fit exposures whose weights may depend on the fit.

    Variances by a noise model are evaluated at what a first fit expects. That fit is at the nearest
    whole shifts, which takes a small part of the time and changes a variance as little as half a
    pixel changes the light. It has the variances at the medians over the exposures, pixel by pixel,
    which no single false value moves far. Each fit begins from the one before, the first from
    `start`.
    """
    options.check(exposures)
    middle = exposures.medians() if exposures.noise else None
    if middle is not None:
        tolerance = max(options.fit.tolerance, _ROUGH)
        rough = dataclasses.replace(options.fit, tolerance=tolerance)
        at_medians = (c * middle for c in exposures.flux.values)
        nearest = exposures.at(dataclasses.replace(exposures.positions.whole(), std=None))
        variances = np.empty_like(exposures.values)
        fit = modelled(nearest, at_medians, variances).fit(rough, start)
        signals = expected(exposures, fit, middle, options.fit.workers)
        # Nothing is asked of the rough fit any more that would need its variances.
        exposures = modelled(exposures, signals, variances)
        start = fit.start()
        del nearest, at_medians, variances, signals, fit
        if not options.robust:
            middle = None
    if options.robust:
        return _robust_fit(exposures, options.fit, exposures.fit(options.fit, start), middle)
    return Weighted(exposures, exposures.fit(options.fit, start), None)


def _robust_fit(
    exposures: Exposures, options: FitOptions, fit: Fit, middle: Floats | None
) -> Weighted:
    """Leave out outliers and fit again, until nothing changes.

    A measurement that was used again, and is left out once more, stays so: the search ends.
    """
    given = exposures.usable()
    exposures, fit = without_fallen_dust(exposures, fit, options)
    usable = exposures.usable()
    out, returned = np.zeros_like(usable), np.zeros_like(usable)
    kept = exposures
    for _ in range(_MOST_ROUNDS):
        former, out = out, rejected(exposures, fit, out, options)
        out |= former & returned
        if np.array_equal(former, out):
            break
        returned |= former & ~out
        if middle is not None:
            signals = expected(exposures, fit, middle, options.workers)
            exposures = modelled(exposures, signals, np.empty_like(exposures.values))
        kept = contradictory_found(exposures.without(~usable | out), given)
        start = fit.start()
        del fit
        fit = kept.fit(options, start)
    return Weighted(kept, fit, out | (given & ~usable))


def contradictory_found(kept: Exposures, given: Bools) -> Exposures:
    """Mark pixels whose measurements contradict each other.

    Most of those given are left out, or so many that no two agree.
    """
    before, after = given.sum(axis=0), kept.usable().sum(axis=0)
    contradictory = (before > 2 * after) | ((before > after) & (after < _FEWEST))
    return kept.marked(contradictory=union(kept.bad_pixels.contradictory, contradictory))


def modelled(exposures: Exposures, signals: Iterator[Array], variances: Array) -> Exposures:
    """Exposures with the variances that their noise models have at these signals, in that array."""
    if exposures.filters is None:
        modelled_variances(exposures.noise, signals, variances)
    else:  # the models are of values in DN
        response = exposures.response
        modelled_variances(exposures.noise, (signal * response for signal in signals), variances)
        variances /= np.square(response)
    return exposures.weighted(variances)


def expected(
    exposures: Exposures, fit: Fit, middle: Floats, workers: int | None
) -> Iterator[Array]:
    """Signals c · L · M; c times the medians `middle` where the fit determines none.

    There c is that of the fit too, in the units in which the medians were taken.
    """
    unit = np.median(exposures.flux.values / fit.flux)
    for k, flux in enumerate(unit * np.array(fit.flux)):
        signal = exposures.light(fit, k, workers)
        for rows in blocks(signal.shape):
            signal[rows] *= fit.sensitivity[rows]
            known = np.isfinite(signal[rows])
            np.multiply(flux, middle[rows], out=signal[rows], where=~known)
        yield signal


_SAMPLE = 4096
"""Values kept of each array: a change of one value in a hundred is missed with a probability of
exp(−41), of one in a thousand with exp(−4)."""


def sampled_arrays(exposures: Exposures) -> dict[str, Array]:
    """Values at random places of each array of a caller that is read again, by its argument."""
    arrays = {
        "frames": exposures.values,
        "variance": exposures.variance,
        "mask": exposures.mask,
        "dark_variance": exposures.dark_variance,
    }
    return {name: _sample(array) for name, array in arrays.items() if array is not None}


def _sample(array: Array) -> Array:
    """Values at random places, the same ones at every call; all values of a small array."""
    if array.size <= _SAMPLE:
        return array.copy()
    places = np.random.default_rng(0).integers(array.size, size=_SAMPLE)
    return np.asarray(array[np.unravel_index(places, array.shape)])


def check_unchanged(exposures: Exposures, before: Mapping[str, Array]) -> None:
    """Refuse a question about exposures of whose arrays the samples differ from those before.

    Raises
    ------
    InputError
        If a sample differs; it names the array.
    """
    now = sampled_arrays(exposures)
    changed = [name for name, sample in before.items() if sample.tobytes() != now[name].tobytes()]
    if changed:
        raise InputError(
            f"{' and '.join(map(repr, changed))} of this calibration changed after it was made, "
            "and std_of reads the arrays again: calibrate copies of arrays that change later"
        )
