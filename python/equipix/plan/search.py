"""Patterns of shifts that leave little error, sought by exchanging one position at a time."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix._check import Floats, Progress, as_array, check_progress, check_shape, positive_count
from equipix.errors import EquipixWarning, InputError
from equipix.findings import say
from equipix.measured.colour import Colours
from equipix.plan.budget import ErrorBudget, check_causes, error_budget
from equipix.plan.components import is_connected
from equipix.plan.drift import advise_order, tilt_of_fluxes, tilt_rms
from equipix.plan.pattern_errors import spectrum, usual_passes

Points = NDArray[np.int64]

Random = np.random.Generator

_STARTS, _FINALISTS = 10, 6
"""Searches from different patterns, and how many of their ends get a full error budget."""

_WAVES = 2048
"""Waves that a pattern is evaluated at during the search."""

_NEAR, _FAR, _TRIED = 32, 16, 4
"""Places that a position might move to, nearby and anywhere; of those how many are checked."""

_GAIN = 1e-3
"""Least relative gain of a move."""

_USUAL = 5
"""Exposures of a pattern unless given: fewer leave no residual that shows a wrong one."""

_NEAR_DISTANCES = np.array([(0, 0), (0, 11), (19, 0), (7, 5), (3, 17)])
"""Positions a few pixels apart, at different distances."""

_PERIODS = 8
"""Waves of this many periods within the travel, and fewer, must be constrained."""

_PERIODIC = 0.02
"""λ of such a wave at which the predicted variance by noise counts twice."""

_MOST_PASSES = 100
"""Expected products above which a pattern counts as worse. Cross (11, 19) takes 32; of 72 patterns
of five to seven positions that were found with this limit none took more than 102."""


_PHASES, _MOVED, _ONE_STEP = 100, 0.5, 0.3
"""Of a sensor with colours: patterns tried for a start, share of the positions moved within the
period, and share of these that are moved by one pixel."""


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion:
    """A pattern of shifts that compares every pixel.

    Attributes
    ----------
    shifts : ndarray, shape (n, 2), int64
        The shifts (row, col) in pixels, the smallest 0, in the order in which a linear drift of
        the lamp is least degenerate with a tilt (`advise_order`).
    budget : ErrorBudget
        Its errors.
    """

    shifts: Points
    budget: ErrorBudget

    def __repr__(self) -> str:
        """Short form: the shifts and the error."""
        return f"<Suggestion {self.shifts.tolist()}: {self.budget.rms:.1e} rms>"


def suggest(
    shape: tuple[int, int],
    exposures: int | None,
    max_shift: ArrayLike,
    *,
    noise: float = 1e-3,
    drift: float | None = None,
    shift_error: float = 0,
    beam_width: float | None = None,
    patterns: int = 3,
    cfa: ArrayLike | None = None,
    rng: int | np.random.Generator = 0,
    progress: Progress | None = None,
) -> list[Suggestion]:
    """Find patterns of shifts within the stage's travel, best first.

    Every one compares all pixels, by the exact test of `identify`; with a `cfa` all pixels of each
    colour where it stands alone.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    exposures : int or None
        How many exposures; None: five, or fewer where the travel has fewer positions.
    max_shift : int or array_like of two
        Travel of the stage, in pixels, along both axes or (row, col): shifts are 0 to that. It is
        cut where the sensor is smaller.
    noise, drift, shift_error, beam_width : float
        As for `error_budget`, whose `rms` and expected passes make a pattern good. Unless given,
        drift is a tenth of the noise; for the order of the patterns only such ratios matter.
    patterns : int
        How many patterns to return, at most.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`: the patterns suffice for each
        colour by itself, with a beam of its own.
    rng : numpy.random.Generator or int
        Source of the random numbers of the search, or its seed: the same one finds the same.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then: hundreds of exposures take minutes.

    Returns
    -------
    list of Suggestion
        The patterns, by rising error; those that take too many passes last.

    Raises
    ------
    InputError
        If an argument has a wrong value, or no pattern of so many exposures is found.

    Warns
    -----
    MisfitWarning
        For each pattern of which the tilt from drift exceeds the error from noise.

    Notes
    -----
    The variance from noise falls with the mean of 1/λ(q) and rises with the number of beam cells;
    the tilt from drift falls with the spread of the shifts. With all positions at the corners of
    the travel, though, waves are nearly periodic in them and barely constrained, which counts as
    noise too. So good patterns have some positions a few pixels apart, at different distances, and
    others as far away as the travel allows. From several starts of this kind, positions are moved
    one by one to where the predicted error is least.

    The farther five or six positions are apart, the more waves are barely constrained, and the more
    products the solver takes between pixels (`budget.spectrum.passes`). Above 100 of them the error
    counts more, by the square of their number: five positions then use a part of a large travel
    only. A sixth or seventh position allows for a larger part of it.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> cross = plan.error_budget((96, 128), cross_pattern(11, 19), noise=1e-3, drift=1e-5)
    >>> best, *others = plan.suggest((96, 128), 5, 19, noise=1e-3, drift=1e-5)
    >>> best.budget.rms < cross.rms
    True
    """
    sizes = check_shape(shape)
    travel = _travel(max_shift, sizes)
    wanted = positive_count("patterns", patterns)
    check_progress(progress)
    report: Progress = progress or (lambda *_: None)
    random = np.random.default_rng(rng)
    colours = Colours.of(cfa)
    period = 1 if colours is None else np.array(colours.period)
    check_causes(sizes, noise, drift or 0, shift_error, beam_width)
    lamp = noise / 10 if drift is None else drift
    score = _Score(sizes, travel, noise, lamp)
    if exposures is None:
        fewest = min(_USUAL, int(np.prod(travel + 1)))
        counts = range(fewest, 1, -1)
    elif positive_count("exposures", exposures) == 1:
        raise InputError("'exposures' is 1, expected two or more: one compares no pixels")
    else:
        counts = range(exposures, exposures + 1)
    for count in counts:
        starts = _starts(count, travel // period, random)
        if colours is not None:
            starts = [_coloured(start, score, colours, random) for start in starts]
        stage = f"searching {count} positions"
        ends = []
        for done, start in enumerate(starts):
            report(done, len(starts), stage)
            ends.append(_improved(start, score, random, colours))
        report(len(starts), len(starts), stage)
        found = _distinct([end for end in ends if end is not None], score)
        if found:
            break
    else:
        raise InputError(
            f"'max_shift' is {travel.tolist()}: no pattern of {exposures or 'two to five'} "
            "exposures within it was found that compares every pixel"
            f"{'' if colours is None else ' of each colour alone'}; allow more of either"
        )
    suggestions = []
    causes: dict[str, Any] = {"noise": noise, "shift_error": shift_error, "beam_width": beam_width}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        finalists = found[: max(wanted, _FINALISTS)]
        for done, points in enumerate(finalists, start=1):
            shifts = points - points.min(axis=0)
            shifts = shifts[advise_order(shifts)]
            budget = error_budget(sizes, shifts, drift=lamp, **causes)
            suggestions.append(Suggestion(shifts, budget))
            report(done, len(finalists), "judging patterns")
    suggestions.sort(key=_weighed_error)
    for number, suggestion in enumerate(suggestions[:wanted], start=1):
        found_of = suggestion.budget.findings
        say(*(replace(each, message=f"pattern {number}: {each.message}") for each in found_of))
    return suggestions[:wanted]


_NEXT, _NEXT_FINALISTS = 1024, 24
"""Places of a next position that are compared, and how many of the best are looked at closely."""


def next_position(
    shape: tuple[int, int],
    shifts: Floats,
    travel: ArrayLike,
    *,
    noise: float,
    drift: float,
    cfa: Colours | None = None,
) -> Floats:
    """Find the position that lowers the error of a pattern most when it is added.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : ndarray, shape (n, 2)
        Positions (row, col) so far, at least one.
    travel : int or array_like of two
        Travel of the stage from the smallest position so far, in pixels.
    noise, drift : float
        As for `error_budget`.
    cfa : Colours, optional
        Colour filters of the pixels.

    Returns
    -------
    ndarray, shape (2,)
        The position, whole pixels from the first: of those that connect the most pixels the one
        of the least predicted error. It is none of the positions so far.
    """
    low = shifts.min(axis=0)
    points = np.rint(shifts - shifts[0]).astype(np.int64)
    corner = points.min(axis=0)
    points = points - corner
    reach = _travel(travel, shape)
    score = _Score(shape, np.maximum(reach, points.max(axis=0)), noise, drift)
    every = int(np.prod(reach + 1))
    taken = {tuple(each) for each in points.tolist()}
    # Spread evenly over the travel, always the same.
    numbers = np.unique(np.linspace(0, every - 1, min(every, _NEXT)).astype(np.int64))
    places = np.stack(np.unravel_index(numbers, reach + 1), axis=1)
    best = _ranked(score, points, places, taken)[:1]
    around = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    near = [np.clip(place + around, 0, reach) for place in (*best, *points)]
    candidates = _ranked(score, points, np.unique(np.concatenate([places, *near]), axis=0), taken)
    if not len(candidates):
        raise InputError(f"'max_shift' is {reach.tolist()}: all positions within it are taken")

    def connected(place: Points) -> bool:
        return is_connected(shape, np.concatenate([points, place[None]]), cfa)

    finalists = candidates[:_NEXT_FINALISTS]
    chosen = next((each for each in finalists if connected(each)), finalists[0])
    return np.asarray(low + chosen, dtype=np.float64)


def _ranked(score: "_Score", points: Points, places: Points, taken: set[Any]) -> Points:
    """Sort places by the error of the pattern with each, without those that are taken."""
    free = np.array([tuple(each) not in taken for each in places.tolist()], dtype=bool)
    places = places[free]
    return np.asarray(places[np.argsort(score(points, places), kind="stable")])


def weighed(error: ArrayLike, passes: ArrayLike) -> Floats:
    """Error that counts in a comparison of patterns: more where the solver takes too long.

    The tilt by drift falls with the spread of the positions, and the passes rise with its square.
    """
    return np.asarray(error * np.maximum(1, np.asarray(passes) / _MOST_PASSES) ** 2)


def _travel(max_shift: ArrayLike, shape: tuple[int, int]) -> Points:
    """Largest shift along each axis: that of the stage, and less than the sensor."""
    values = as_array("max_shift", max_shift, ndim=(0, 1)).astype(np.float64)
    if values.size not in (1, 2) or not (values >= 0).all():
        raise InputError(f"'max_shift' is {max_shift!r}, expected pixels from 0 on, or (row, col)")
    travel = np.minimum(np.broadcast_to(values, 2), np.array(shape) - 1)
    return np.asarray(travel.astype(np.int64))


def _weighed_error(suggestion: Suggestion) -> float:
    budget = suggestion.budget
    return float(weighed(budget.rms, budget.spectrum.passes))


class _Score:
    """Predicts the error of patterns quickly: all places that one position might move to.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    travel : ndarray of int, shape (2,)
        Largest shift along each axis.
    noise, drift : float
        As for `error_budget`.
    """

    def __init__(self, shape: tuple[int, int], travel: Points, noise: float, drift: float) -> None:
        self.shape, self.travel, self._noise, self._drift = shape, travel, noise, drift
        # Points of a Kronecker sequence cover the half plane of waves evenly.
        steps = np.arange(1, _WAVES + 1)[:, None] * np.array([0.7548776662, 0.5698402910])
        waves = (steps % 1 - [0, 0.5]) * [np.pi, 2 * np.pi]
        waves = np.concatenate([waves, _periods(travel)])
        self._phases = [
            np.exp(1j * np.outer(q, np.arange(most + 1))).astype(np.complex64)
            for q, most in zip(waves.T, travel, strict=True)
        ]

    def __call__(self, others: Points, places: Points) -> Floats:
        """Evaluate the error of the patterns of `others` and one of `places` each."""
        count = len(others) + 1
        kept = np.broadcast_to(others, (len(places), *others.shape))
        patterns = np.concatenate([kept, places[:, None]], axis=1)
        spans = np.ptp(patterns, axis=1)
        # Beam cells over pixels: the trace of K of `local_variance`, times n.
        cells = np.prod((np.array(self.shape) + spans) / self.shape, axis=1)
        rest = count / (count - np.minimum(cells, count * (1 - 1e-3)))
        sums = self._waves(others).sum(axis=1)[:, None] + self._waves(places)
        visible = count - (sums.real**2 + sums.imag**2) / count  # λ of the waves of each pattern
        visible = np.maximum(visible, 1e-3).astype(np.float64)
        inverse = np.mean(1 / visible[:_WAVES], axis=0, dtype=np.float64)
        if len(visible) > _WAVES:
            inverse *= 1 + _PERIODIC / visible[_WAVES:].min(axis=0)
        noise = self._noise**2 * inverse * (1 - 1 / count) * rest
        drift = tilt_rms(tilt_of_fluxes(self.shape, patterns, self._drift))
        return weighed(np.sqrt(noise + drift**2), usual_passes(patterns))

    def _waves(self, places: Points) -> NDArray[np.complex64]:
        down, right = self._phases
        return np.asarray(down[:, places[:, 0]] * right[:, places[:, 1]])


def _periods(travel: Points) -> Floats:
    """Waves of a few periods within the travel, along and across it, that few positions repeat."""
    largest = np.where(travel >= 4 * _PERIODS, _PERIODS, 0)
    rows, cols = np.mgrid[0 : largest[0] + 1, -largest[1] : largest[1] + 1]
    numbers = np.stack([rows.ravel(), cols.ravel()], axis=1)
    numbers = numbers[(numbers[:, 0] > 0) | (numbers[:, 1] > 0)]
    return np.asarray(2 * np.pi * numbers / np.maximum(travel, 1))


def _starts(count: int, travel: Points, rng: Random) -> list[Points]:
    """Patterns to begin with: surely connected, a few pixels apart and far, near the corners."""
    nearest = np.array([(0, 0), (0, 1), (1, 0)])[:count]
    far = rng.integers(0, travel, (max(count - 3, 0), 2), endpoint=True)
    starts = [np.minimum(np.concatenate([nearest, far]), travel)]
    for _ in range(_STARTS // 2):
        near = _NEAR_DISTANCES[: max(count - 3, 3)][:count]
        corners = rng.permutation([(1, 0), (0, 1), (1, 1)]) * travel
        others = np.resize(corners, (max(count - len(near), 0), 2))
        others = others - rng.integers(0, travel // 8 + 1, others.shape) * (others > 0)
        starts.append(np.clip(np.concatenate([near, others]), 0, travel))
    while len(starts) < _STARTS:
        corners = rng.permutation(count)[:, None] >> np.array([0, 1]) & 1
        inwards = np.abs(rng.normal(0, 0.08, (count, 2)))
        places = np.where(corners, 1 - inwards, inwards) * travel
        starts.append(np.clip(np.rint(places), 0, travel).astype(np.int64))
    return starts


def _coloured(start: Points, score: _Score, colours: Colours, rng: Random) -> Points:
    """Stretch a pattern to whole periods, and move positions until pixels of all colours meet.

    Positions whole periods apart compare equal places of the period alone. What lies between two
    places of one colour is therefore added to some of them.
    """
    once = colours.numbers(colours.period)
    cells = [np.argwhere(once == label) for label in range(len(colours.labels))]
    apart = np.concatenate([(each[:, None] - each).reshape(-1, 2) for each in cells])
    whole = start * colours.period
    shape, travel = score.shape, score.travel
    points = np.minimum(whole, travel)
    for _ in range(_PHASES):
        if is_connected(shape, points, colours):
            break
        steps = apart[rng.integers(len(apart), size=len(whole))]
        steps[rng.random(len(whole)) < _ONE_STEP] = rng.integers(0, 2, 2)
        points = np.clip(whole + steps * (rng.random((len(whole), 1)) < _MOVED), 0, travel)
    return np.asarray(points)


def _improved(points: Points, score: _Score, rng: Random, colours: Colours | None) -> Points | None:
    """Move positions one by one while the error decreases; None if no pattern is connected."""
    shape = score.shape
    best = _whole_score(points, score) if is_connected(shape, points, colours) else np.inf
    period = 1 if colours is None else np.array(colours.period)
    unmoved, k = 0, 0
    while unmoved < 2 * len(points):
        others = np.delete(points, k, axis=0)
        places = _places(points[k], score.travel, rng)
        # A move by whole periods keeps what each colour has in common with the other positions.
        # They are counted towards the position, which is within the travel.
        places = points[k] + np.fix((places - points[k]) / period).astype(np.int64) * period
        scores = score(others, places)
        unmoved += 1
        for place in np.argsort(scores, kind="stable")[:_TRIED]:
            if not scores[place] < best * (1 - _GAIN):
                break
            moved = points.copy()
            moved[k] = places[place]
            if is_connected(shape, moved, colours):
                points, best, unmoved = moved, scores[place], 0
                break
        k = (k + 1) % len(points)
    return points if np.isfinite(best) else None


def _places(place: Points, travel: Points, rng: Random) -> Points:
    """Places that a position might move to: around it at several distances, and anywhere."""
    distances = rng.choice([1.0, 3.0, 10.0], (_NEAR, 1))
    near = np.rint(place + distances * rng.standard_normal((_NEAR, 2))).astype(np.int64)
    far = rng.integers(0, travel, (_FAR, 2), endpoint=True)
    return np.asarray(np.clip(np.concatenate([near, far]), 0, travel))


def _whole_score(points: Points, score: _Score) -> float:
    return float(score(points[:-1], points[-1:])[0])


def _distinct(found: list[Points], score: _Score) -> list[Points]:
    """Sort patterns by errors and passes, without those that are others moved as a whole."""
    patterns: dict[tuple[Any, ...], Points] = {}
    for points in found:
        moved = points - points.min(axis=0)
        patterns.setdefault(tuple(sorted(map(tuple, moved.tolist()))), points)

    def key(points: Points) -> float:
        passes = spectrum(points, np.ones(len(points))).passes
        return float(weighed(_whole_score(points, score), passes))

    return sorted(patterns.values(), key=key)
