"""Spread of the composition of HgCdTe that a correction tolerates, beside the source's numbers.

The source states ±0.0006 for 2e7 electrons and both bands, and ±0.001 to ±0.003 behind short-pass
filters at 4.7 and 9.6 µm. It names neither the temperatures nor the slope of the filters, nor
whether ± is a standard deviation or a limit. Prints both for two-point correction at 290 and 310 K
and a scene at 300 K, and which of these assumptions lead to the source's numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from equipix import detector

BANDS = {
    "3-5.1 µm": (detector.HgCdTe(start_um=3.0, cutoff_um=5.1), 4.7),
    "8-10.6 µm": (detector.HgCdTe(start_um=8.0, cutoff_um=10.6), 9.6),
}
CORRECTIONS = {
    "uncorrected": {"references_k": ()},
    "one-point, offset": {"references_k": (290.0,)},
    "one-point, gain": {"references_k": (290.0,), "by": "gain"},
    "two-point": {"references_k": (290.0, 310.0)},
}
SLOPES = (0.03, 0.1, 0.2, 0.3, 0.4)
SOURCE, SOURCE_FILTERED = 6e-4, (1e-3, 3e-3)


def spread(material: detector.HgCdTe, **how: object) -> float:
    """Tolerated standard deviation of x."""
    return detector.composition_tolerance(material, **how).spread


def crossing(
    function: Callable[[float], float], wanted: float, low: float, high: float
) -> float | None:
    """Argument at which a falling function has a value, or None where it is not in the range."""
    if not function(low) > wanted > function(high):
        return None
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) > wanted else (low, middle)
    return (low + high) / 2


def corrections() -> None:
    """Print the tolerance by correction."""
    print("tolerated spread of x     std      ± limit  source  std/source")
    for band, (material, _) in BANDS.items():
        for name, how in CORRECTIONS.items():
            found = detector.composition_tolerance(material, **how)
            row = f"{band:10} {name:18} {found.spread:.2e} {found.half_width:.2e}"
            last = name == "two-point"
            print(row + (f"  {SOURCE:g}  {found.spread / SOURCE:.2f}" if last else ""))


def filters() -> None:
    """Print the tolerance, and the longer integration, behind filters of some slopes."""
    print("\nbehind a filter           std      ± limit  longer  NETD, mK   source: 0.001 to 0.003")
    for band, (material, edge) in BANDS.items():
        for slope in SLOPES:
            behind = replace(material, short_pass=detector.ShortPass(edge_um=edge, slope=slope))
            found = detector.composition_tolerance(behind)
            print(
                f"{band:10} {edge} µm, slope {slope:<4} {found.spread:.2e} {found.half_width:.2e}"
                f"  {behind.integration_factor():.2f}    {1e3 * found.netd_k:.1f}"
            )


def assumptions() -> None:
    """Print which assumptions lead to the source's numbers."""
    print("\nstd with one assumption changed")
    for band, (material, _) in BANDS.items():
        changed = {
            "as above": spread(material),
            "edge of 2 meV": spread(replace(material, edge_mev=2.0)),
            "edge of 5 meV": spread(replace(material, edge_mev=5.0)),
            "well full at 310 K": spread(material, filled_k=310.0),
            "scene at 295 K": spread(material, scene_k=295.0),
            "references 280, 320 K": spread(material, references_k=(280.0, 320.0)),
        }
        print(f"{band:10} " + ", ".join(f"{name} {value:.1e}" for name, value in changed.items()))
    for band, (material, edge) in BANDS.items():
        half = crossing(partial(pair, material), SOURCE, 8.0, 60.0)
        limit = crossing(partial(pair, material), SOURCE / np.sqrt(3), 8.0, 60.0)
        print(f"{band:10} 0.0006 as std: references at 300 ± {half:.1f} K; ", end="")
        print(f"as limit: 300 ± {limit:.1f} K")
        for wanted in SOURCE_FILTERED:
            slope = crossing(partial(filtered, material, edge, half), wanted, 0.01, 0.5)
            words = "no slope up to 0.5" if slope is None else f"a slope of {slope:.2f}"
            print(
                f"{band:10} {wanted} as std behind a filter, references at ± {half:.1f} K: {words}"
            )


def pair(material: detector.HgCdTe, half: float) -> float:
    """Tolerance with references on both sides of the scene."""
    return spread(material, references_k=(300.0 - half, 300.0 + half))


def filtered(material: detector.HgCdTe, edge: float, half: float, slope: float) -> float:
    """Tolerance behind a filter, with references on both sides of the scene."""
    short_pass = detector.ShortPass(edge_um=edge, slope=slope)
    return pair(replace(material, short_pass=short_pass), half)


def main() -> None:
    """Print all tables."""
    corrections()
    filters()
    assumptions()


if __name__ == "__main__":
    main()
