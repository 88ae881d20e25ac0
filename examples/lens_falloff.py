"""Fall-off of a lens over an array of 2052x2052 pixels, 54x54 mm, and its removal.

The array of the source: its gains are raised towards the edge by cos^4. Prints the illumination of
the corner for some focal lengths, and what is fitted from one flat frame.
"""

from __future__ import annotations

import numpy as np

from equipix import lens, simulate

SHAPE, PITCH_MM = (2052, 2052), 54 / 2052
SIZES_MM = (60, 100, 200)


def main() -> None:
    """Print the table."""
    corner = 2 * 27.0**2
    print("focal length, mm: illumination of the corner, gain")
    for focal in SIZES_MM:
        light = (1 + corner / focal**2) ** -2  # cos^4 of the angle to the axis
        print(f"{focal:4d}: {light:.3f}  {1 / light:.3f}")
    sensitivity = simulate.paper_sensitivity(SHAPE, rng=1)
    rows, cols = np.ogrid[: SHAPE[0], : SHAPE[1]]
    squared = (rows - 1040.0) ** 2 + (cols - 1010.0) ** 2
    flat = 8000 * (1 + squared * (PITCH_MM / 100) ** 2) ** -2 * sensitivity
    found = lens.fit(flat)
    std = found.std["focal_length"] * PITCH_MM
    print(f"fitted: focal length {found.focal_length * PITCH_MM:.3f} mm, std {std:.3f} mm")
    corrected = found.correction().correct(flat / sensitivity)
    print(f"left of the fall-off: {corrected.std() / corrected.mean():.1e}")


if __name__ == "__main__":
    main()
