"""The figures of a camera as EMVA 1288 lists them, and the curves beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix._check import Floats
from equipix.experiment.camera import CameraFigures
from equipix.metrics.emva import (
    QUANTISED,
    TIMES,
    TRANSFER,
    Split,
    dark_lines,
    high_passed,
    linear_levels,
)
from equipix.report.drawing import draw_histogram, draw_spectrum
from equipix.report.limits import CameraLimits, Check, checked
from equipix.report.maps import Map
from equipix.report.page import LARGEST, Part, Table, drawn, mapped, provenance_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_WHOLE = 1e4
"""Values from here on are written as whole numbers."""

_NO_TIMES = f"not measured (add levels and darks of {TIMES} exposure times)"

_FINE: Any = {"linewidth": 0.8}


class Figure(NamedTuple):
    """A figure: its key, its name and unit for people, and its value, NaN where it is not known.

    `note` says that the value is a bound, "below" or "above"; of none, why it is not known.
    """

    key: str
    name: str
    unit: str
    value: float
    note: str = ""

    @property
    def number(self) -> str:
        """The value in digits."""
        if not np.isfinite(self.value):
            return self.note or "not known"
        number = f"{self.value:{'.0f' if abs(self.value) >= _WHOLE else '.4g'}}"
        return f"{self.note} {number}".strip()


def bounds_of(found: CameraFigures) -> dict[str, str]:
    """Keys of the figures that are bounds, "below" or "above", for programs."""
    return {
        each.key: each.note for each in figures_of(found) if each.note and np.isfinite(each.value)
    }


def figures_of(found: CameraFigures) -> Iterator[Figure]:
    """List all figures, those of the non-uniformity where it was measured."""
    t, of_noise, of_light = found.transfer, "", ""
    known = np.nan if found.contradicts_times else 1.0
    dark_dn, dark_e = known * t.dark_noise_dn, known * t.read_noise_e
    if found.is_quantised:
        of_noise = "below"
        dark_dn, dark_e = np.sqrt([QUANTISED, QUANTISED - 1 / 12]) / (1, t.gain_dn_per_e)
    if not found.is_saturated:
        of_light = "above"
    of_range = of_light or ("above" if of_noise else "")
    yield Figure("gain_dn_per_e", "system gain K", "DN/e⁻", t.gain_dn_per_e)
    yield Figure("inverse_gain_e_per_dn", "1/K", "e⁻/DN", 1 / t.gain_dn_per_e)
    key, unit = "responsivity_dn_per_photon", "DN/photon"
    yield _in_photons(found, Figure(key, "responsivity R", unit, t.responsivity))
    key, efficiency = "quantum_efficiency_percent", 100 * t.quantum_efficiency
    yield _in_photons(found, Figure(key, "quantum efficiency η", "%", efficiency))
    name = "temporal dark noise with quantisation"
    yield Figure("dark_noise_dn", name, "DN", float(dark_dn), of_noise)
    yield Figure("dark_noise_e", "temporal dark noise σ_d", "e⁻", float(dark_e), of_noise)
    yield from _with_logarithms("snr_max", "largest SNR", t.snr_max, of_light)
    name, inverse = "inverse of the largest SNR", 100 / t.snr_max
    yield Figure("inverse_snr_max_percent", name, "%", inverse, "below" if of_light else "")
    least, least_e = known * t.threshold_light, known * t.threshold_e
    for key, name, photons, electrons, note in (
        ("threshold", "absolute sensitivity threshold", least, least_e, of_noise),
        ("saturation", "saturation capacity", t.saturation_light, t.saturation_e, of_light),
    ):
        yield _in_photons(found, Figure(f"{key}_photons", name, "photons", photons, note))
        yield Figure(f"{key}_e", name, "e⁻", electrons, note)
    yield from _with_logarithms("dynamic_range", "dynamic range", known * t.dynamic_range, of_range)
    if found.spatial is not None:
        dsnu, prnu = found.spatial.dsnu, found.spatial.prnu
        yield Figure("dsnu_dn", "DSNU", "DN", dsnu.total * t.gain_dn_per_e)
        yield from _parts("dsnu", "_e", "e⁻", dsnu)
        yield from _parts("prnu", "_percent", "%", Split(*(100 * each for each in prnu)))
    yield Figure("linearity_error_percent", "linearity error", "%", 100 * t.linearity_error)
    yield from _dark_currents(found)


def _dark_currents(found: CameraFigures) -> Iterator[Figure]:
    """Dark currents; an upper bound of one that may be 0 by its error."""
    t, few = found.transfer, len(np.unique(found.exposure_s)) < TIMES
    gains = t.gain_dn_per_e, t.gain_dn_per_e**2
    below = np.full(2, np.nan) if few else dark_lines(found.exposure_s, found.off).below / gains
    if found.off[:, 1].min() < QUANTISED:
        below[1] = np.nan
    for by, bound in zip(("mean", "variance"), below.tolist(), strict=True):
        value, note = getattr(t, f"dark_current_{by}"), ""
        if np.isnan(value) and few:
            note = _NO_TIMES
        elif np.isnan(value) and bound > 0:  # 0 of equal darks, which tell nothing
            value, note = bound, "below"
        yield Figure(f"dark_current_{by}_e_per_s", f"dark current by the {by}", "e⁻/s", value, note)


def _parts(kind: str, ending: str, unit: str, split: Split) -> Iterator[Figure]:
    yield Figure(kind + ending, kind.upper(), unit, split.total)
    for part in ("row", "column", "pixel"):
        value = getattr(split, part)
        yield Figure(f"{kind}_{part}{ending}", f"{kind.upper()}, {part}", unit, value)


def _with_logarithms(key: str, name: str, ratio: float, note: str) -> Iterator[Figure]:
    yield Figure(key, name, "", ratio, note)
    yield Figure(f"{key}_db", name, "dB", float(20 * np.log10(ratio)), note)
    yield Figure(f"{key}_bits", name, "bit", float(np.log2(ratio)), note)


def _has_photons(found: CameraFigures) -> bool:
    """Whether the light can be in photons: otherwise there is no quantum efficiency."""
    return bool(np.isfinite(found.transfer.quantum_efficiency))


def _in_photons(found: CameraFigures, figure: Figure) -> Figure:
    """Return a figure; without a value where the light is in another unit than photons."""
    known = _has_photons(found)
    return figure if known else figure._replace(value=np.nan, note="needs photons")


def _light(found: CameraFigures) -> str:
    """Name of the light, for axes."""
    return "photons per pixel" if _has_photons(found) else "light in the unit given"


def _words_of(found: CameraFigures) -> list[tuple[str, str]]:
    """Figures in words, by their names; one in several units is one entry."""
    words: dict[str, list[str]] = {}
    for each in figures_of(found):
        words.setdefault(each.name, []).append(f"{each.number} {each.unit}".strip())
    return [(name, ", ".join(values)) for name, values in words.items()]


def rows_of(planes: dict[str, CameraFigures]) -> list[tuple[str, ...]]:
    """Rows of names, units and the values of all planes."""
    rows = zip(*map(figures_of, planes.values()), strict=True)
    return [(each[0].name, each[0].unit, *(figure.number for figure in each)) for each in rows]


def _side_by_side(planes: dict[str, CameraFigures]) -> Table:
    return Table("Planes side by side", ("Figure", "Unit", *planes), rows_of(planes))


def camera_checks(found: CameraFigures, limits: CameraLimits) -> list[Check]:
    """Judge the figures of a plane by limits."""
    figures = {each.key: each for each in figures_of(found)}
    notes = {key: each.note for key, each in figures.items()}
    if found.spatial is None:
        notes |= dict.fromkeys(("dsnu_e", "prnu_percent"), "not measured (add [spatial])")
    return checked(
        limits, {key: each.value for key, each in figures.items()}, found.findings, notes
    )


def camera_parts(
    name: str, planes: dict[str, CameraFigures], judged: Iterable[list[Check]]
) -> list[Part]:
    """Collect what a page says of a camera: a part for each plane of its colour filters.

    `judged` has the checks of each.
    """
    largest, (first, *_), last = int(LARGEST / len(planes) ** 0.5), planes, [*planes][-1]
    parts = []
    for (plane, found), checks in zip(planes.items(), judged, strict=True):
        maps = _maps(found)
        part = Part(
            name=f"{name}, plane {plane}" if plane else name,
            what=f"EMVA 1288 release 4.0 linear, {len(found.photons)} levels",
            findings=found.findings,
            checks=checks,
            figures=_words_of(found),
            maps=[mapped(each, largest) for each in maps],
            plots=[*map(drawn, _curves(found, maps))],
            tables=[*([_side_by_side(planes)] if plane == first and plane else []), _levels(found)],
            provenance=provenance_of(found.metadata) if plane == last else [],
        )
        parts.append(part)
    return parts


def _maps(found: CameraFigures) -> list[Map]:
    """Deviations of pixels from the mean: of the dark signal, and of the response to light."""
    if found.bright is None or found.dark is None:
        return []
    # float32 suffices for pictures, and these maps are as large as the sensor.
    dark = np.subtract(found.dark, found.dark.mean(), dtype=np.float32)
    response = np.subtract(found.bright, found.dark, dtype=np.float32)
    response *= np.float32(100 / response.mean(dtype=np.float64))
    response -= 100
    return [
        Map("Dark signal", "DN", dark, "deviation"),
        Map("Photo response", "%", response, "deviation"),
    ]


def _levels(found: CameraFigures) -> Table:
    """Means and variances, level by level."""
    columns = (found.photons, found.exposure_s, *found.on.T, *found.off.T, _ratio(found))
    rows = [
        tuple(f"{each:.5g}" if np.isfinite(each) else "none" for each in row)
        for row in zip(*columns, strict=True)
    ]
    light = "Photons" if _has_photons(found) else "Light"
    head = (light, "Exposure, s", "Mean, DN", "Variance, DN²", "Dark, DN", "Its variance, DN²")
    return Table("Levels", (*head, "SNR"), rows, "Variances are temporal, of one frame.")


def _signal(found: CameraFigures) -> Floats:
    return np.asarray(found.on[:, 0] - found.off[:, 0])


def _ratio(found: CameraFigures) -> Floats:
    """Signal over noise of each level, NaN above saturation, where noise is cut off."""
    below = (found.photons <= found.transfer.saturation_light) & (found.on[:, 1] > 0)
    return np.where(below, _signal(found) / np.sqrt(np.where(below, found.on[:, 1], 1)), np.nan)


def _curves(found: CameraFigures, maps: list[Map]) -> Iterator[Callable[[Axes], None]]:
    """Functions that draw the curves."""
    for draw in (_draw_responsivity, _draw_transfer, _draw_linearity, _draw_snr):
        yield partial(draw, found=found)
    for column in (0, 1) if len(np.unique(found.exposure_s)) > 1 else ():
        yield partial(_draw_dark, found=found, column=column)
    for shown in maps:
        yield partial(draw_spectrum, shown=shown)
        for axis in (0, 1):
            yield partial(_draw_profiles, shown=shown, axis=axis)
        if shown.unit == "%":  # light that changes slowly over the sensor hides single pixels
            shown = Map(f"{shown.name}, high-passed", "%", high_passed(shown.values))
        yield partial(draw_histogram, shown=shown)


def _draw_line(axes: Axes, x: Floats, y: Floats, slope: float, unit: str) -> None:
    """Draw points with a line through 0, and where the points end that it was fitted to."""
    axes.plot(x, y, "o", markersize=3, label="measured")
    axes.axline((0, 0), slope=slope, color="C1", label=f"fit: {slope:.5g} {unit}", **_FINE)
    axes.set_ylim(0, 1.1 * y.max())
    axes.legend(fontsize="small", loc="upper left")  # above the line, which begins at 0


def _draw_responsivity(axes: Axes, found: CameraFigures) -> None:
    t = found.transfer
    unit = "DN/photon" if _has_photons(found) else "DN over that"
    _draw_line(axes, found.photons, _signal(found), t.responsivity, unit)
    axes.axhline(TRANSFER * t.saturation_dn, color="gray", **_FINE)
    axes.set(title="Responsivity", ylabel="mean less dark, DN")
    axes.set_xlabel(f"{_light(found)}; line: {TRANSFER:.0%} of saturation, end of the fit")


def _draw_transfer(axes: Axes, found: CameraFigures) -> None:
    t, variance = found.transfer, found.on[:, 1] - found.off[:, 1]
    _draw_line(axes, _signal(found), variance, t.gain_dn_per_e, "DN/e⁻")
    axes.axvline(TRANSFER * t.saturation_dn, color="gray", **_FINE)
    axes.set(title="Photon transfer", ylabel="variance less dark, DN²")
    axes.set_xlabel(f"mean less dark, DN; line: {TRANSFER:.0%} of saturation, end of the fit")


def _draw_linearity(axes: Axes, found: CameraFigures) -> None:
    """Draw deviations from the line of the linearity error, over the levels that it counts."""
    (offset, slope), counts = (
        found.transfer.line,
        linear_levels(_signal(found), found.transfer.saturation_dn),
    )
    photons, signal = found.photons[counts], _signal(found)[counts]
    deviation = 100 * (signal / (offset + slope * photons) - 1)
    axes.plot(photons, deviation, "o-", markersize=3, **_FINE)
    axes.axhline(0, color="gray", **_FINE)
    axes.set(title="Deviation from linearity", xlabel=_light(found), ylabel="%")


def _draw_snr(axes: Axes, found: CameraFigures) -> None:
    """Draw signal over noise: measured, by the model, and of an ideal sensor."""
    t, ratio = found.transfer, _ratio(found)
    axes.loglog(found.photons[ratio > 0], ratio[ratio > 0], "o", markersize=3, label="measured")
    at = np.geomspace(t.threshold_light / 2, t.saturation_light, 200)
    axes.loglog(at, t.snr(at), label="model", **_FINE)
    if found.spatial is not None:
        total = t.snr(at, found.spatial.dsnu.total, found.spatial.prnu.total)
        axes.loglog(at, total, "--", label="with DSNU and PRNU", **_FINE)
    if _has_photons(found):
        axes.loglog(at, np.sqrt(at), ":", color="gray", label="ideal sensor", **_FINE)
    axes.axvline(t.threshold_light, color="gray", **_FINE)
    axes.axvline(t.saturation_light, color="gray", **_FINE)
    axes.set(title="Signal-to-noise ratio", ylabel="signal over noise")
    axes.set_xlabel(f"{_light(found)}; lines: threshold, saturation")
    axes.legend(fontsize="small")


def _draw_dark(axes: Axes, found: CameraFigures, column: int) -> None:
    """Draw means, or variances, of the darks over the exposure time, with their line if known."""
    times, values, t = found.exposure_s, found.off[:, column], found.transfer
    axes.plot(times, values, "o", markersize=3)
    if np.isfinite((t.dark_current_mean, t.dark_current_variance)[column]):
        axes.plot(times, np.polyval(np.polyfit(times, values, 1), times), **_FINE)
    name, unit = (("Mean", "DN"), ("Variance", "DN²"))[column]
    axes.set(title=f"{name} of the dark", xlabel="exposure time, s", ylabel=unit)


def _draw_profiles(axes: Axes, shown: Map, axis: int) -> None:
    """Draw largest, middle, mean and smallest value of the columns, or of the rows."""
    values = shown.values
    middle = values.take(values.shape[axis] // 2, axis)
    axes.plot(values.max(axis), label="largest", **_FINE)
    axes.plot(middle, label="middle", **_FINE)
    axes.plot(values.mean(axis), label="mean", **_FINE)
    axes.plot(values.min(axis), label="smallest", **_FINE)
    along = ("rows", "columns")[axis]
    axes.set(title=f"Profiles of {shown.name.lower()} along {along}")
    axes.set(xlabel=("column", "row")[axis])
    axes.set_ylabel(shown.unit)
    axes.margins(y=0.2)
    axes.legend(fontsize="small", loc="upper center", ncols=4)
