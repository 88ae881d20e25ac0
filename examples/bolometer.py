"""Dynamic correction of an uncooled array: references at six temperatures, frames at a seventh.

A simulated array takes the place of the camera in a climatic chamber. At each state a shutter at
the temperature of the substrate and two black bodies are averaged over 64 frames.
"""

from __future__ import annotations

import numpy as np

import equipix
from equipix import bolometer, simulate

SHAPE, FRAMES = (96, 128), 64
CELSIUS = (-20.0, -12.0, 8.0, 32.0, 52.0, 60.0)
VOLTS = (1.95, 2.05)
NOW = (21.7, 2.02)
"""Temperature of the substrate in °C and bias in volts while the camera works."""


def main() -> None:
    """Take references, fit, and correct frames of an even scene."""
    array = simulate.BolometerArray.of(SHAPE, rng=1)
    states = [(celsius, volts) for celsius in CELSIUS for volts in VOLTS]

    def averages(scene_c: float | None) -> list[equipix.FrameStatistics]:
        seeds = np.random.default_rng(0 if scene_c is None else int(scene_c)).spawn(len(states))
        return [
            equipix.average(array.frames(t, FRAMES, rng=rng, scene_c=scene_c, bias_v=v))
            for (t, v), rng in zip(states, seeds, strict=True)
        ]

    correction = bolometer.fit(
        averages(None), *np.transpose(states), black_bodies=(averages(10.0), averages(50.0))
    )
    print(correction)

    # In operation: the thermometer and the bias give the maps, the maps correct frames.
    now = correction.correction(*NOW)
    corrector = equipix.Corrector(now, "float32")
    raw = np.stack(list(array.frames(NOW[0], 64, rng=9, scene_c=35.0, bias_v=NOW[1])))
    corrected = np.stack([corrector.apply(frame) for frame in raw])
    temporal = corrected.std(axis=0, ddof=1).mean()
    print(f"one frame: {raw[0].std():.1f} DN rms before, {corrected[0].std():.2f} DN after")
    print(f"temporal noise {temporal:.2f} DN, spatial {corrected.mean(axis=0).std():.2f} DN")


if __name__ == "__main__":
    main()
