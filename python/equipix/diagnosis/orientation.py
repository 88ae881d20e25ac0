"""Which orientation of the axes fits of a window confirm.

In a smooth beam the shifts in another orientation fit with other fluxes and another M. The fluxes
that were given may exclude it, or the orientation as given.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from equipix._check import Array, Floats, ShiftSign
from equipix._native import Fit
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Orientation, Positions
from equipix.fitting.residuals import left_by
from equipix.fitting.windows import WindowFit, if_there_is_light
from equipix.measured.noise import chi2_tail
from equipix.plan.drift import undetermined_fluxes
from equipix.shown import Brief

_MOST_EXPOSURES = 12
"""Most exposures of the test: each has a flux to be fitted."""

_FEWEST = 1000
"""Least number of measurements beyond those of two exposures."""

_WIDE, _LEAST = 4, 80
"""Side of the window in largest shifts, and the pixels that it may have whatever they are."""

_ROUNDS = 4
"""Rounds of finer fits, and of leaving out outliers."""

AS_GIVEN = Orientation()

_QUESTIONS = {
    "rows": "the sign along rows",
    "cols": "the sign along columns",
    "exchanged": "the order of the axes",
    "turned": "the direction of turns",
}

_REMEDY = (
    "compare the axes of the stage once with the figure in docs/shifts.md, or put structure into "
    "the beam"
)


@dataclass(frozen=True)
class OrientationTest(Brief):
    """Outcome of the comparison of orientations.

    Attributes
    ----------
    rows, cols : {"confirmed", "contradicted", "undetermined"}
        The sign of the shifts along rows and columns, as given.
    exchanged : {"confirmed", "contradicted", "undetermined"}
        The order of the two values of a shift, as given.
    turned : {"confirmed", "contradicted", "undetermined"}
        The direction of quarter turns, as given; "confirmed" without any.
    sign : {"confirmed", "contradicted", "undetermined"}
        All of them: whether the orientation as given fits better than every other, or another
        better than it.
    best : Orientation
        The orientation with the lowest F: what is to be changed.
    ratio : float
        F of the given orientation over that of the best; None where nothing was compared.
    reason : str
        Why nothing was concluded; empty where `sign` is not "undetermined".
    hidden : Orientation or None
        Where `sign` is "undetermined": another orientation, with another M, that neither residuals
        nor fluxes exclude.
    difference : float
        Its rms relative difference of M over the sensor; 0 without one.
    is_likely : bool
        Whether the fluxes given agree with that orientation and not with the one as given.
    """

    rows: ShiftSign = "undetermined"
    cols: ShiftSign = "undetermined"
    exchanged: ShiftSign = "undetermined"
    turned: ShiftSign = "undetermined"
    sign: ShiftSign = "undetermined"
    best: Orientation = AS_GIVEN
    ratio: float | None = None
    reason: str = ""
    hidden: Orientation | None = None
    difference: float = 0.0
    is_likely: bool = False

    def among_fluxes(self, *, contradicted: bool) -> Self:
        """Return the test without a likely orientation unless the fluxes given are contradicted."""
        if contradicted or not self.is_likely:
            return self
        return dataclasses.replace(self, hidden=None, difference=0.0, is_likely=False)

    @property
    def words(self) -> str:
        """The outcome, and what to do, as a sentence."""
        if self.sign == "confirmed":
            return "the data confirm the signs and the order of the shifts"
        if self.sign == "contradicted":
            return f"the data contradict the orientation of the shifts: {self.best.words}"
        if self.is_likely and self.hidden is not None:
            return f"the orientation of the shifts is probably wrong: {self.hidden.words}"
        # The direction of turns is "confirmed" without any, which is no news.
        sure = [_QUESTIONS[name] for name in self._that_are("confirmed") if name != "turned"]
        unsure = [_QUESTIONS[name] for name in self._that_are("undetermined")]
        asked = " and ".join(unsure) if sure else "the orientation"
        parts = f" (they do confirm {' and '.join(sure)})" if sure else ""
        return f"the data do not determine {asked}{parts}: {self.reason}"

    def _that_are(self, answer: ShiftSign) -> list[str]:
        return [name for name in _QUESTIONS if getattr(self, name) == answer]


def orientation_test(
    exposures: Exposures, fit: Fit, options: FitOptions, flux: Flux
) -> OrientationTest:
    """Compare the fit with the shifts as given to those in all other orientations.

    Parameters
    ----------
    exposures : Exposures
        The measurements, their weights, and the shifts as they were given.
    fit : Fit
        Their fit: the free fluxes start from its fluxes.
    options : FitOptions
        Number of threads and progress.
    flux : Flux
        The fluxes as they were given, with their own prior.

    Returns
    -------
    OrientationTest
        The findings. Undetermined without a comparison where an offset is sought.

    Notes
    -----
    The orientations are both signs along each axis, with the axes as given and exchanged; where
    exposures are turned by 90 or 270 degrees, also with the opposite turns. Another orientation is
    excluded if its F is higher than that of the best by more than 6·√(2/dof) of itself, in two
    thirds of all blocks of 4×4 pixels, and by a misfit above 0.5 % of the signal, rms. Also, the
    residuals of the best must be white, or the misfit 30 times the part of its own residuals that
    neighbours have in common. F/dof has the standard deviation √(2/dof) of itself. Fluxes are free,
    since in a smooth beam the residuals of a wrong orientation are degenerate with a lamp drift. A
    Gaussian beam leaves none: ln L is quadratic, and other L, M and fluxes fit as well.

    F is accurate where the estimated error of M is below 0.3 of the relative noise that the fit
    leaves (it was then at most 2e-4 of itself above its minimum); else it is reduced by the square
    of error over noise. Only the higher F must be accurate, since the lower one can only decrease.
    Outliers of one of the fits, such as dust, are left out of all.
    """
    if exposures.offset:
        return OrientationTest(reason="it is not tested where the dark is fitted; " + _REMEDY)
    exposures = dataclasses.replace(
        exposures,
        flux=exposures.flux.free(np.array(fit.flux)),
        positions=dataclasses.replace(exposures.positions, std=None),
    )
    asked = chosen_exposures(exposures.positions, _MOST_EXPOSURES)
    turns = bool((exposures.positions.rotation % 180 == 90).any())
    ways = _distinct(exposures.positions.chosen(asked), Orientation.every(quarter_turns=turns))
    side = _side(exposures.positions.chosen(asked), ways, exposures.shape)
    pixels = min(side, exposures.shape[0]) * min(side, exposures.shape[1])
    if len(ways) < 2 or len(asked) < 3 or (len(asked) - 2) * pixels < _FEWEST:
        return OrientationTest(reason="there are too few measurements; " + _REMEDY)
    # The window first: the exposures chosen are copied.
    turned = {way: exposures.at(exposures.positions.oriented(way)) for way in ways}
    windows = {way: each.window(side).chosen(asked) for way, each in turned.items()}
    with if_there_is_light():
        fits = _fits(windows, options)
        best = fits[_best(fits)]
        left = {way for way, fit in fits.items() if fit is best or not fit.is_far_above(best)}
        test = _outcome(fits, left)
        if test.sign != "undetermined" or AS_GIVEN not in left:
            return test
        equal = {way: fits[way] for way in ways if way in left}
        return with_hidden(test, equal, windows, flux.chosen(asked), exposures.shape)
    return OrientationTest(reason="the middle of the sensor has too little light; " + _REMEDY)


def chosen_exposures(positions: Positions, most: int) -> Array:
    """Indices of at most so many exposures, at places as far apart as possible.

    The first is the first exposure. Each of the others is the one that is farthest from all chosen
    before; exposures at a place that is already chosen are not. All are chosen if there are few.
    """
    count = len(positions)
    if count <= most:
        return np.arange(count)
    # A turned exposure is far from one that is not.
    turned = positions.rotation[:, None] / 90 * (1 + np.ptp(positions.shifts))
    places = np.hstack([positions.shifts, turned])
    chosen, nearest = [0], np.full(count, np.inf)
    while len(chosen) < most:
        distance = np.linalg.norm(places - places[chosen[-1]], axis=1)
        nearest = np.minimum(nearest, distance)
        if not nearest.max() > 0:
            break
        chosen.append(int(nearest.argmax()))
    return np.sort(chosen)


def _distinct(positions: Positions, ways: list[Orientation]) -> list[Orientation]:
    """Orientations that differ in more than a move common to all exposures, the simplest first."""
    kept: list[tuple[Orientation, Array]] = []
    for way in ways:
        changed = positions.oriented(way)
        moves = changed.shifts - changed.shifts[0]
        places = np.hstack([moves, changed.rotation[:, None]])
        if not any(np.allclose(places, known, rtol=0, atol=1e-6) for _, known in kept):
            kept.append((way, places))
    return [way for way, _ in kept]


def _side(positions: Positions, ways: list[Orientation], shape: tuple[int, int]) -> int:
    """Pixels along the window: some four times the largest shift s.

    Where that is large, it is the smallest that leaves half a measurement a pixel for the test:
    (n − 1)·w² − (w + s)² ≥ w²/2, the cells being at most (w + s)². 0 if nothing moves.
    """
    middle = (np.array(shape) - 1) / 2
    reach = 0.0
    for way in ways:
        changed = positions.oriented(way)
        # Where the sensor's middle looks: a quarter turn exchanges its coordinates.
        turned = changed.rotation % 180 == 90
        middles = np.where(turned[:, None], middle[::-1], middle)
        reach = max(reach, float(np.ptp(middles + changed.shifts, axis=0).max()))
    enough: float = reach / (max(len(positions) - 1.5, 1.5) ** 0.5 - 1)
    return round(min(_WIDE * reach, max(_LEAST, enough)))


def _fits(
    windows: Mapping[Orientation, Exposures], options: FitOptions
) -> dict[Orientation, WindowFit]:
    """Fits in every orientation, as exact as necessary."""
    fits = {way: WindowFit.of(window, options) for way, window in windows.items()}
    for _ in range(_ROUNDS):
        odd = np.any([fit.outliers() for fit in fits.values()], axis=0)
        if odd.any():
            windows = {way: window.without(odd) for way, window in windows.items()}
            fits = {
                way: WindowFit.of(windows[way], options, fit.fit.start())
                for way, fit in fits.items()
            }
            continue
        unsettled = [way for way in _undecided(fits) if not fits[way].final]
        if not unsettled:
            break
        fits |= {way: fits[way].finer(windows[way], options) for way in unsettled}
    return fits


def _best(fits: Mapping[Orientation, WindowFit]) -> Orientation:
    """The orientation with the lowest F, the simplest of equal ones."""
    return min(fits, key=lambda way: fits[way].left)


def _undecided(fits: Mapping[Orientation, WindowFit]) -> list[Orientation]:
    """Orientations that finer fits may still exclude, with the best if there are any."""
    best = _best(fits)
    low = fits[best]
    others = [
        way
        for way, high in fits.items()
        if way != best and not (high.is_far_above(low) or high.cannot_be_far_above(low))
    ]
    return [best, *others] if others else []


def _outcome(fits: Mapping[Orientation, WindowFit], left: set[Orientation]) -> OrientationTest:
    """The findings on the axes from final fits."""
    best = _best(fits)
    rows, cols, exchanged, turned = (_answer(left, name) for name in _QUESTIONS)
    sign: ShiftSign = "undetermined"
    if AS_GIVEN not in left:
        sign = "contradicted"
    elif left == {AS_GIVEN}:
        sign = "confirmed"
    ratio = fits[AS_GIVEN].left / fits[best].left if fits[best].left > 0 else None
    reason = _reason(fits[best], best) if sign == "undetermined" else ""
    return OrientationTest(rows, cols, exchanged, turned, sign, best, ratio, reason)


def _answer(left: set[Orientation], name: str) -> ShiftSign:
    """Whether all orientations that are left agree in one question."""
    changed = {getattr(way, name) for way in left}
    if len(changed) > 1:
        return "undetermined"
    return "contradicted" if changed == {True} else "confirmed"


def _reason(low: WindowFit, best: Orientation) -> str:
    if low.is_white:  # nothing is wrong
        return f"the beam is too smooth for that, which is no fault; {_REMEDY}"
    return (
        f"in the best orientation ('{best.words}') residuals of neighbours are still correlated by "
        f"{max(abs(each.size) for each in low.neighbours):.0%}: look for another cause, such as "
        f"the scale of the shifts, dust or an illumination that changes; {_REMEDY}"
    )


_RARE = 1e-3
"""Probability of such fluxes below which an orientation does not agree with those given."""

_SMALLER = 0.1
"""How far off its fluxes are, relative to those of the orientation as given, where it is likely."""

_ABOVE = 3.0
"""How many times the noise of a pixel a difference of M must be to be said."""

_PLACES = 33
"""Places along each side of the sensor where the difference of M is evaluated."""


class _Fluxes(NamedTuple):
    """How far fluxes are from those given, rms, and whether they agree with them."""

    distance: float
    agree: bool


def with_hidden(
    test: OrientationTest,
    fits: Mapping[Orientation, WindowFit],
    windows: Mapping[Orientation, Exposures],
    flux: Flux,
    shape: tuple[int, int],
) -> OrientationTest:
    """Add the orientation that no measurement excludes and whose M is farthest from that as given.

    Parameters
    ----------
    test : OrientationTest
        The test whose sign is undetermined.
    fits, windows : mapping
        Fits with free fluxes in the orientations that their residuals do not exclude, the one as
        given among them, and what was fitted.
    flux : Flux
        The fluxes that were given for these exposures.
    shape : tuple of int
        Sizes of the sensor (rows, cols).

    Returns
    -------
    OrientationTest
        With the likely orientation if there is one. Else, where fluxes are free or have a prior,
        with one that agrees with it; as it was where M is the same in all of them within its noise.
    """
    fluxes = {way: _fluxes(fit, windows[way], flux) for way, fit in fits.items()}
    others = [way for way in fits if way != AS_GIVEN]
    given = fluxes[AS_GIVEN]
    likely = [way for way in others if fluxes[way].distance < _SMALLER * given.distance]
    if likely and not given.agree:
        best = min(likely, key=lambda way: fluxes[way].distance)
        size, _ = _difference(fits[best], fits[AS_GIVEN], shape)
        return dataclasses.replace(test, hidden=best, difference=size, is_likely=True)
    if flux.kind not in ("fit", "prior"):
        return test
    found = {}
    for way in (each for each in others if fluxes[each].agree):
        size, noise = _difference(fits[way], fits[AS_GIVEN], shape)
        if size > _ABOVE * noise:
            found[way] = size
    if not found:
        return test
    best = max(found, key=lambda way: found[way])
    return dataclasses.replace(test, hidden=best, difference=found[best])


def _fluxes(fit: WindowFit, window: Exposures, flux: Flux) -> _Fluxes:
    """Compare fitted fluxes with those given, without what the shifts leave undetermined."""
    if flux.kind == "fit":
        return _Fluxes(0.0, agree=True)
    columns = undetermined_fluxes(window.positions, flux.time)
    deviations = np.log(np.array(fit.fit.flux) / flux.values)
    rest, rank = left_by(columns, deviations)
    freedom = len(rest) - rank
    if freedom < 1:
        return _Fluxes(0.0, agree=True)
    pixels = np.isfinite(fit.residuals).sum(axis=(1, 2)).mean()
    # Without noise there is rounding.
    error = max(fit.noise / np.sqrt(pixels), np.finfo(float).eps)
    std = np.hypot(error, 0.0 if flux.std is None else flux.std)
    agree = chi2_tail(float(np.sum((rest / std) ** 2)), freedom) >= _RARE
    return _Fluxes(float(np.sqrt(rest @ rest / freedom)), agree)


def _difference(one: WindowFit, other: WindowFit, shape: tuple[int, int]) -> tuple[float, float]:
    """Rms difference of ln M over the sensor, by its quadratic part, and the error of a pixel.

    Where an orientation is not determined ln L is quadratic, and so is the difference of ln M. The
    window is in the middle of the sensor: there both have their origin. The second is that of
    noise or of the solver.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = np.log(one.fit.sensitivity / other.fit.sensitivity)
    window = difference.shape
    known = np.isfinite(difference).ravel()
    extent = np.array(shape) / window
    columns = _powers(window, np.ones(2))[known]
    found = np.linalg.lstsq(columns, difference.ravel()[known], rcond=None)[0]
    # A sensor may have many pixels, and a quadratic needs few.
    bend = _powers((_PLACES, _PLACES), extent)[:, 3:] @ found[3:]
    noise = other.noise / (len(other.residuals) - 1) ** 0.5
    return float(bend.std()), max(noise, one.error, other.error) * float(extent.prod())


def _powers(counts: tuple[int, ...], extent: Array) -> Floats:
    """1, r, c, r², r c and c² (places, 6) on a grid of that extent about the middle."""
    sides = zip(counts, extent.tolist(), strict=True)
    r, c = (np.linspace(-half, half, count) for count, half in sides)
    rows, cols = (each.ravel() for each in np.meshgrid(r, c, indexing="ij"))
    return np.stack([np.ones(rows.size), rows, cols, rows**2, rows * cols, cols**2], axis=1)
