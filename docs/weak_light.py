"""Calibrate in beams that leave a part of the sensor in the dark.

``python docs/weak_light.py`` prints the table of section 6 of docs/method.md.
"""

from __future__ import annotations

import warnings

import numpy as np

import equipix
from equipix import Flag, simulate
from equipix.errors import EquipixWarning
from equipix.simulate.beams import Beam

NOISE = 1e-3
CROSS = equipix.cross_pattern(11, 19).astype(float)
BETWEEN = CROSS + np.array([(0, 0), (0.3, 0.1), (0.2, 0.4), (0.45, 0.3), (0.1, 0.2)])


def narrow(shape: tuple[int, int], width: float) -> Beam:
    """Give a beam that leaves the edges of the sensor in the dark."""
    return simulate.gaussian_beam(shape, width=width)


def dark_corner(rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Give a beam with a hundred-thousandth of the light in a corner."""
    light: np.ndarray = simulate.gaussian_beam((160, 200), width=400)(rows, cols)
    return light * np.where((rows < 50) & (cols < 60), 1e-5, 1)


def measure(name: str, shape: tuple[int, int], beam: Beam, shifts: np.ndarray) -> str:
    """Calibrate once; give a row of the table."""
    rng = np.random.default_rng(0)
    truth = 1 + rng.uniform(-0.05, 0.05, shape)
    frames = simulate.exposures(truth, beam, shifts)
    frames += NOISE * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(frames, shifts)
    used = cal.flags & Flag.DO_NOT_USE == 0
    error = np.abs(cal.sensitivity - truth / truth[used].mean())[used].max()
    passes = f"{cal.sweeps}" if cal.converged else "not converged"
    return f"| {name} | {passes} | {used.sum()} of {used.size} | {error:.1%} |"


def main() -> None:
    """Print all beams."""
    warnings.simplefilter("ignore", EquipixWarning)
    print("| experiment, noise 1e-3 | products | pixels in use | largest error of those |")
    for width in (12, 20, 40):
        name = f"beam of width {width} on 320×240"
        print(measure(name, (240, 320), narrow((240, 320), width), CROSS))
    small = (160, 200)
    print(measure("beam of width 45 on 200×160", small, narrow(small, 45), CROSS))
    print(measure("the same between pixels", small, narrow(small, 45), BETWEEN))
    print(measure("a corner of 1e-5 of the light, 200×160", small, dark_corner, CROSS))


if __name__ == "__main__":
    main()
