"""How exact the error map of a joint fit is: ``python docs/error_map.py [ROWS COLS]``.

On larger sensors the map is smoothed over windows. Here it is compared, in single pixels, with the
standard deviation of ln M in that pixel, which is one linear problem each, to 1e-4 of the variance.
Printed for each case: draws, the stated relative standard error, the measured one over random
pixels and over pixels beside a masked one, and the time in fits.
"""

from __future__ import annotations

import sys
import time
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix
from equipix import simulate

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHIFTS = equipix.cross_pattern(11, 19) + np.array(
    [[0, 0], [0.31, 0.27], [-0.42, -0.36], [-0.27, 0.36], [0.38, -0.29]]
)
NOISE = 1e-3
PIXELS = 60
"""Pixels of each kind that are compared."""


def smooth(shape: tuple[int, int]) -> Any:
    """A beam without structure."""
    return simulate.gaussian_beam(shape, width=1000)


def steep(shape: tuple[int, int]) -> Any:
    """Fringes of a period of 12 pixels and a contrast of 40 %, in a narrow beam."""
    envelope = simulate.gaussian_beam(shape, width=0.7 * max(shape))
    return lambda rows, cols: envelope(rows, cols) * (1 + 0.4 * np.sin(0.5 * rows + 0.15 * cols))


def holes(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Single measurements, blocks, and a wall with a gap."""
    mask = rng.random((len(SHIFTS), *shape)) < 0.02
    rows, cols = shape
    mask[:, rows // 4 : rows // 4 + 9, cols // 4 : cols // 4 + 14] = True
    mask[:, rows // 2 : rows // 2 + 3, : 2 * cols // 3] = True
    mask[2, : rows // 3, cols // 2 :] = True
    return mask


def measured(
    shape: tuple[int, int], beam: Any, mask: NDArray[np.bool_] | None, **options: Any
) -> None:
    """Print what one case gives."""
    rng = np.random.default_rng(3)
    truth = simulate.paper_sensitivity(shape, rng=1)
    frames = simulate.exposures(truth, beam, SHIFTS)
    frames += NOISE * rng.standard_normal(frames.shape)
    given = {"variance": np.full(len(SHIFTS), NOISE**2), "mask": mask, **options}
    start = time.perf_counter()
    equipix.calibrate(frames, SHIFTS, **given)
    fit = time.perf_counter() - start
    start = time.perf_counter()
    cal = equipix.calibrate(frames, SHIFTS, uncertainty=True, **given)
    bars = time.perf_counter() - start - fit
    known = np.isfinite(cal.sensitivity_std)
    beside = known & near(mask.any(0)) if mask is not None else np.zeros(shape, bool)
    found = [compared(cal, where, rng) for where in (known, beside)]
    stated = cal.metadata["uncertainty"]
    print(
        f"  draws {stated['draws']:3d}, stated {stated['relative_standard_error']:.2%}, "
        f"random pixels {found[0]}, beside masked ones {found[1]}, "
        f"{bars / fit:.1f} fits of {fit:.2f} s"
    )


def near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels beside a masked one."""
    padded = np.pad(mask, 1)
    around = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    return around & ~mask


def compared(cal: Any, where: NDArray[np.bool_], rng: np.random.Generator) -> str:
    """Mean, rms and largest relative deviation of the map in some of these pixels."""
    pixels = np.argwhere(where)
    if len(pixels) == 0:
        return "-"
    pixels = rng.permutation(pixels)[:PIXELS]
    weights = np.zeros((len(pixels), *cal.shape))
    weights[np.arange(len(pixels)), *pixels.T] = 1
    exact = cal.std_of(weights) * cal.sensitivity[tuple(pixels.T)]
    error = cal.sensitivity_std[tuple(pixels.T)] / exact - 1
    return f"{error.mean():+.2%} ± {error.std():.2%}, at most {np.abs(error).max():.1%}"


def main() -> None:
    """Print all cases."""
    shape = tuple(int(size) for size in sys.argv[1:3]) or (240, 320)
    warnings.simplefilter("ignore", equipix.errors.EquipixWarning)
    rng = np.random.default_rng(5)
    cases = {
        "smooth": (smooth, None, {}),
        "steep": (steep, None, {}),
        "smooth, masks": (smooth, holes(shape, rng), {}),
        "steep, masks": (steep, holes(shape, rng), {}),
        "steep, refined shifts": (steep, None, {"shift_std": 0.02}),
        "smooth, uncertain shifts": (smooth, None, {"shift_std": 0.02}),
        "smooth, prior on fluxes": (smooth, None, {"flux_std": 1e-4}),
        "steep, noisy dark": (steep, None, {"dark_variance": 10 * NOISE**2}),
    }
    for name, (beam, mask, options) in cases.items():
        print(f"{name}:", flush=True)
        measured(shape, beam(shape), mask, **options)


if __name__ == "__main__":
    main()
