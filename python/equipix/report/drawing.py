"""The picture of a result: its maps, its flags, and how its values are distributed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import Array, Floats
from equipix.calibration.result import Calibration
from equipix.measured.noise import nanmedian
from equipix.nuc.response import Response
from equipix.pictures import new_figure
from equipix.report.maps import Map, flagged, maps_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CMAPS = {"level": "gray", "deviation": "RdBu_r", "size": "viridis"}

_SHARES = (0.1, 99.9)
"""Percentiles of a map that its colours span."""

_MOST_BINS = 1024

_MOST_STEPS = 2**16
"""Values of a map that tell the step between them."""

_ROUNDING = 1e-6
"""Differences of values, over their range, that are of rounding."""

_ENOUGH = 2**24
"""Pixels of a map whose lines tell medians, quartiles and spectra of all."""

_MOST_MARKS = 20_000
"""Most flagged pixels of a kind that are marked one by one: more look like an area."""


def draw_result(result: Any) -> Figure:
    """Show what a result holds.

    Parameters
    ----------
    result : Calibration, Response, DynamicCorrection, FrameStatistics, SceneCorrection, Correction
        What `equipix.load` reads.

    Returns
    -------
    matplotlib.figure.Figure
        A map of each value, with the smallest and the largest one; the flagged pixels by kind; the
        histogram, the profiles and the spectrum of the first map, of a response also of the second;
        of a calibration also its convergence and its shifts.

    Raises
    ------
    EquipixError
        If matplotlib is not installed.
    """
    maps, flags = maps_of(result), getattr(result, "flags", None)
    drawn: list[Callable[[Axes], None]] = [partial(draw_map, shown=each) for each in maps]
    if flags is not None:
        drawn.append(partial(draw_flags, flags=flags))
    drawn += curves_of(result, maps)
    cols = min(3, len(drawn))
    rows = -(-len(drawn) // cols)
    figure = new_figure(5.2 * cols, 4.2 * rows)
    places = figure.subplots(rows, cols, squeeze=False).ravel()
    for axes, draw in zip(places, drawn, strict=False):
        draw(axes)
    for axes in places[len(drawn) :]:
        axes.set_axis_off()
    return figure


def curves_of(result: Any, maps: list[Map]) -> list[Callable[[Axes], None]]:
    """Functions that draw the curves of a result: of its first map, of a response also of K."""
    shown = maps[: 2 if isinstance(result, Response) and result.order else 1]
    drawn: list[Callable[[Axes], None]] = [
        partial(draw, shown=each)
        for each in shown
        for draw in (draw_histogram, draw_profiles, draw_spectrum)
    ]
    if isinstance(result, Calibration):
        of_fit = (draw_convergence, draw_shifts)
        drawn += [partial(draw, calibration=result) for draw in of_fit]
    return drawn


def limits_of(shown: Map, values: Floats, step: int = 1) -> tuple[float, float]:
    """Ends of the colours: two percentiles of what is shown, even around 0 for deviations.

    `values` are those of blocks of `step` pixels. Blocks with a pixel that must not be used do not
    count, if there are others.
    """
    known = shown.usual(values, step)
    if not known.size:
        return 0.0, 1.0
    low, high = (float(end) for end in np.percentile(known, _SHARES))
    if high <= low:  # most values are one, as of flagged pixels
        low, high = float(known.min()), float(known.max())
    if shown.scale == "deviation":
        high = max(-low, high)
        low = -high
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def draw_map(axes: Axes, shown: Map) -> None:
    """Draw a map with its scale, its smallest and its largest value."""
    values, step = shown.reduced()
    low, high = limits_of(shown, values, step)
    rows, cols = (step * size for size in values.shape)
    extent = (-0.5, cols - 0.5, rows - 0.5, -0.5)
    image = axes.imshow(
        values, vmin=low, vmax=high, cmap=CMAPS[shown.scale], extent=extent, interpolation="none"
    )
    # Blocks at the edges may be smaller.
    last_row, last_col = (shown.cell * size - 0.5 for size in shown.values.shape)
    axes.set(title=shown.title, xlabel=f"column\n{shown.words(step)}")
    axes.set(xlim=(-0.5, last_col), ylim=(last_row, -0.5))
    axes.set_ylabel("row")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def draw_flags(axes: Axes, flags: Array) -> None:
    """Mark the flagged pixels, a colour for each kind, with their numbers."""
    rows, cols = flags.shape
    found = flagged(flags)
    for number, (flag, (row, col)) in enumerate(found.items()):
        every = -(-len(row) // _MOST_MARKS)
        name = (flag.name or "").replace("_", " ").lower()
        axes.plot(
            col[::every],
            row[::every],
            linestyle="",
            marker="os^Dv"[number % 5],
            fillstyle="none",
            markersize=max(3, 10 - 2 * number),  # a pixel may have several flags
            color=f"C{number}",
            label=f"{name}: {len(row)}",
            rasterized=True,  # thousands of marks are smaller as an image
        )
    axes.set(
        title=f"Flagged pixels: {np.count_nonzero(flags)} of {flags.size}",
        xlabel="column",
        ylabel="row",
        xlim=(-0.5, cols - 0.5),
        ylim=(rows - 0.5, -0.5),
        aspect="equal",
    )
    if found:
        # Below the map: on it, it would hide pixels.
        axes.legend(
            fontsize="small",
            ncols=2,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
            borderaxespad=0.0,
        )


def draw_histogram(axes: Axes, shown: Map) -> None:
    """Draw the logarithmic histogram of a map, with the normal distribution of its spread.

    As in EMVA 1288, release 4.0, section 8.4: single pixels far out show on a logarithmic scale.
    """
    low, high = shown.extremes
    if high <= low:
        low, high = low - 0.5, high + 0.5
    middle, quarter, three = np.nanpercentile(_some(shown.values, 0), (50, 25, 75))
    spread = (three - quarter) / 1.349
    # Rice's rule: the bins of few pixels are wide. Single pixels far out do not widen them.
    count = int(np.isfinite(shown.values).sum())
    bins = round(2 * np.cbrt(count))
    if spread > 0:
        bins = max(bins, round(min(3 * (high - low) / spread, _MOST_BINS)))
    # Bins of whole steps between values: others would hold now one value, now two.
    step = _step(shown)
    width = step * np.ceil((high - low) / min(bins, _MOST_BINS) / step)
    bins = int(np.floor((high - low + step / 2) / width)) + 1
    counts, edges = np.histogram(
        shown.values, bins, (low - step / 2, low - step / 2 + bins * width)
    )
    axes.stairs(counts, edges, fill=True, alpha=0.6)
    if spread > 0:
        at = np.linspace(low, high, _MOST_BINS)
        away = np.clip((at - middle) / spread, -40, 40)  # further out the normal is 0
        normal = np.exp(-0.5 * away**2) / (spread * np.sqrt(2 * np.pi))
        # A bin that is far wider than the spread holds no more than all pixels.
        expected = count * np.minimum(normal * (edges[1] - edges[0]), 1)
        axes.plot(at, expected, color="black", linewidth=0.8)
    axes.set(
        title=f"Histogram of {shown.name[0].lower()}{shown.name[1:]}",
        xlabel=f"{shown.unit or 'relative'}; line: normal, by the quartiles",
        ylabel="pixels",
        yscale="log",
        ylim=(0.5, 2 * counts.max()),
    )
    axes.locator_params("x", nbins=6)  # numbers of three decimals would touch


def _step(shown: Map) -> float:
    """Smallest difference between distinct values, of a choice of them; tiny if they have none."""
    values = shown.values
    # With the extremes: a choice of equal values lacks the one that is far out.
    known = np.unique(np.append(values.flat[:: -(-values.size // _MOST_STEPS)], shown.extremes))
    known = known[np.isfinite(known)]
    steps = np.diff(known)
    rounding = max(_ROUNDING * float(np.ptp(known)) if known.size else 0.0, 1e-300)
    return float(steps[steps > rounding].min(initial=np.inf)) if steps.size else rounding


def _some(values: Array, axis: int) -> Array:
    """Even choice of lines of a large map: rows for axis 0, columns for axis 1."""
    step = -(-values.size // _ENOUGH)
    return values[::step] if axis == 0 else values[:, ::step]


def draw_profiles(axes: Axes, shown: Map) -> None:
    """Draw the medians of rows and of columns, which show stripes and slopes."""
    for axis, name in ((1, "of each row"), (0, "of each column")):
        axes.plot(nanmedian(_some(shown.values, axis), axis=axis), linewidth=0.8, label=name)
    axes.set(title=f"Medians: {shown.title}", xlabel="row, column")
    axes.legend(fontsize="small")


def draw_shifts(axes: Axes, calibration: Calibration) -> None:
    """Draw the positions of the sensor, numbered by exposure, with refined standard deviations."""
    rows, cols = calibration.shifts.T
    std = calibration.shift_std
    down, right = (None, None) if std is None else std.T
    axes.errorbar(cols, rows, yerr=down, xerr=right, fmt="o", capsize=3)
    for number, (row, col) in enumerate(calibration.shifts):
        axes.annotate(str(number), (col, row), xytext=(5, 3), textcoords="offset points")
    known = "" if std is None else f"\nlargest standard deviation {np.nanmax(std):.2g} pixel"
    axes.set(title="Shifts, pixels", xlabel=f"column{known}", ylabel="row")
    axes.margins(0.15)
    axes.invert_yaxis()
    axes.set_aspect("equal", "datalim")


def draw_spectrum(axes: Axes, shown: Map) -> None:
    """Draw the spectrum of the pattern along rows and columns: stripes are peaks.

    The root of the mean power of the Fourier transforms of all rows, and of all columns, over the
    root of the number of pixels along them, as in the spectrograms of EMVA 1288, release 4.0,
    section 8.2. Pixels without a value count as the mean.
    """
    drawn = []
    for axis, name in ((1, "along rows"), (0, "along columns")):
        values = _some(shown.values, 1 - axis).astype(np.float64)
        values = np.nan_to_num(values - np.nanmean(values))
        largest = np.abs(values).max() or 1.0  # the squares of values from 1e154 on overflow
        power = np.abs(np.fft.rfft(values / largest, axis=axis)) ** 2
        size = values.shape[axis]
        line = largest * np.sqrt(power.mean(axis=1 - axis) / size)
        axes.plot(np.fft.rfftfreq(size)[1:], line[1:], linewidth=0.8, label=name)
        drawn.append(line[1:])
    axes.set(
        title=f"Spectrum of {shown.name[0].lower()}{shown.name[1:]}",
        xlabel="cycles per pixel",
        ylabel=shown.unit or "relative",
    )
    positive = np.concatenate(drawn)
    positive = positive[positive > 0]
    if positive.size:
        # Whole decades: ticks at less would be crowded, and a flat spectrum looks flat.
        decades = np.log10([0.9 * positive.min(), 1.1 * positive.max()])
        axes.set(yscale="log", ylim=10.0 ** np.array([np.floor(decades[0]), np.ceil(decades[1])]))
    axes.legend(fontsize="small")


def draw_convergence(axes: Axes, calibration: Calibration) -> None:
    """Draw the estimated error of M over the passes of the solver."""
    history = calibration.history
    axes.semilogy(history["sweep"], history["error_estimate"], marker="o", markersize=3)
    axes.set(title="Convergence", xlabel="pass over the data", ylabel="estimated error of M")
    axes.grid(alpha=0.3)
