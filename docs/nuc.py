"""Draw the correction with a uniform source: `make figures`, or ``python docs/nuc.py``.

nuc.png shows, on simulated arrays whose truth is known:

- the responses of two pixels before and after two-point correction, as figure 10.7 of the source;
- the residual that each order leaves, against the level, beside the temporal noise of a frame;
- the spatial over the temporal noise against the time since the calibration, with and without
  pixels that were made to drift ten times as much.

The script prints the validity intervals of the last panel, and those of the arrays as simulated.
Residuals and ratios have the sign of their variance estimates: the axes are linear around 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

import equipix
from equipix import metrics, nuc
from equipix.simulate import StaringArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

from equipix.metrics.correctability import Correctability as Quality

FILE = Path(__file__).parent / "nuc.png"
SHAPE = (96, 128)
LIGHT = np.linspace(2e6, 14e6, 7)
FRAMES = 64
TIMES_S = np.geomspace(10, 3e5, 24)
SHARE = 0.02
"""Share of the pixels that drift ten times as much as the others."""


def averages(array: StaringArray, lights: NDArray, **how: float) -> list[equipix.FrameStatistics]:
    """Averaged frames of some levels."""
    return [equipix.average(array.frames(e, FRAMES, rng=k, **how)) for k, e in enumerate(lights)]


def quality(response: nuc.Response, array: StaringArray, light: float, **how: object) -> Quality:
    """C and its parts, of frames at a level, corrected by a response."""
    time_s, mask = how.get("time_s"), how.get("mask")
    frames = np.stack(list(array.frames(light, 24, rng=99, time_s=time_s)))
    return metrics.correctability(response.correct(frames), mask=mask)


def intervals(response: nuc.Response, array: StaringArray, mask: NDArray | None) -> tuple:
    """C against time, and the validity interval."""
    ratios = [quality(response, array, 8e6, time_s=t, mask=mask).ratio for t in TIMES_S]
    return ratios, metrics.validity_interval(TIMES_S, ratios)


def draw_responses(axes: Axes, axes_after: Axes) -> None:
    """Two pixels of strong curvature, before and after two-point correction."""
    array = StaringArray(
        shape=(1, 5),
        sensitivity=[[1.0, 1.25, 0.75, 1.02, 0.98]],
        offset_dn=[[400.0, 1500.0, 250.0, 350.0, 450.0]],
        curvature=[[0.15, 0.25, 0.05, 0.15, 0.15]],
    )
    lights = np.linspace(1e6, 14e6, 60)
    points = np.array([3e6, 11e6])
    response = nuc.fit(np.stack([array.mean(light) for light in points]), order=1)
    raw = np.stack([array.mean(light) for light in lights])
    corrected = response.correct(raw, flagged="keep")
    for pixel, name in ((1, "pixel 1"), (2, "pixel 2")):
        for where, values in ((axes, raw), (axes_after, corrected)):
            where.plot(lights / 1e6, values[:, 0, pixel], label=name)
    for where, title in ((axes, "before"), (axes_after, "after two-point correction")):
        for point in points:
            where.axvline(point / 1e6, color="0.7", linewidth=0.8)
        where.set(title=title, xlabel="light, 10⁶ electrons", ylabel="signal, DN")
        where.legend()


def draw_orders(axes: Axes) -> None:
    """Residual of each order against the level."""
    array = StaringArray.of("HgCdTe", SHAPE, rng=1)
    levels = averages(array, LIGHT)
    used = {0: levels[3:4], 1: levels[::6], 2: levels, 3: levels}
    lights = np.linspace(2e6, 14e6, 25)
    for order, name in enumerate(("one-point", "two-point", "quadratic", "cubic")):
        response = nuc.fit(used[order], order=order)
        found = [quality(response, array, light) for light in lights]
        residuals = [each.ratio * np.sqrt(each.temporal_variance) for each in found]
        axes.plot(lights / 1e6, residuals, label=name)
    noise = [np.sqrt(each.temporal_variance) for each in found]
    axes.plot(lights / 1e6, noise, "--", color="0.5", label="temporal noise")
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(title="HgCdTe, by order", xlabel="light, 10⁶ electrons", ylabel="residual, DN")
    axes.set_ylim(0, 5000)
    axes.legend(fontsize="small", ncols=2, loc="upper center")


def draw_time(axes: Axes) -> None:
    """C against time, with and without the pixels that drift most."""
    for material, colour in (("PtSi", "C0"), ("InSb", "C1"), ("HgCdTe", "C2")):
        array = StaringArray.of(material, SHAPE, rng=2)
        response = nuc.fit(averages(array, LIGHT, time_s=0.0), order=2)
        print(f"{material} as simulated: valid for {intervals(response, array, None)[1]:.3g} s")
        bad = np.random.default_rng(3).random(SHAPE) < SHARE
        array = array.with_causes(drift_dn=np.asarray(array.drift_dn) * np.where(bad, 10, 1))
        response = nuc.fit(averages(array, LIGHT, time_s=0.0), order=2)
        for mask, style, name in ((None, "--", "all"), (bad, "-", "good")):
            ratios, valid = intervals(response, array, mask)
            print(f"{material}, {name} pixels: valid for {valid:.3g} s")
            axes.plot(TIMES_S, ratios, style, color=colour, label=f"{material}, {name}")
    axes.axhline(1, color="0.5", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(title="after a quadratic correction", xlabel="time, s", ylabel="C")
    axes.legend(fontsize="small", loc="lower right")


def main() -> None:
    """Draw the figure."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    first, second, third, fourth = figure.subplots(2, 2).ravel()
    draw_responses(first, second)
    draw_orders(third)
    draw_time(fourth)
    figure.savefig(FILE, dpi=110)


if __name__ == "__main__":
    main()
