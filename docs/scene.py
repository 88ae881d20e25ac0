"""Measure the corrections from the scene: ``python docs/scene.py``.

On the standard scene of `simulate.MovingScene`, for each method and seed, the script prints

- how many times smaller the residual pattern is than before correction, after 500 and 2000 moving
  frames, the stop included, and the same of the gain error;
- how many times larger the pattern is after the stop than before it, with the level paused, with it
  running at the level before the stop, and with it running at the level of each moment.

``--check`` ends with an error where a figure misses what is required. ``--long`` prints, of the
first seed alone, the mean of gain times true gain after 20 000 frames, and the pattern then over
that after 2000. ``--noise`` prints the falls in noisy video. scene.png shows the residual pattern
against the frame.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from equipix import scene
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneCorrection
from equipix.simulate import MovingScene

FILE = Path(__file__).parent / "scene.png"
SEEDS = (1, 2, 3)
MOVING = (500, 2000)
LONG = 20_000
REQUIRED = {
    "local-mean": (5, 8, 0),
    "gated": (6, 6, 0),
    "registered": (12, 18, 1.8),
    "constant-statistics": (8, 12, 2.5),
    "kalman": (8, 12, 2.5),
}
"""Least falls of the pattern after 500 and 2000 moving frames, and of the gain error after 2000."""
EVERY = 20
"""Frames between two points of the picture."""


def methods(shape: tuple[int, int]) -> dict[str, SceneCorrection]:
    """Each method with its defaults, and one with the gate off."""
    made = {name: each(shape, data_range=(0, 1)) for name, each in METHODS.items()}  # type: ignore[call-arg]
    made["gate off"] = scene.Gated(shape, data_range=(0, 1), threshold=0)
    return made


class Run:
    """All methods on one sequence, and what is left of the pattern."""

    def __init__(self, moving: MovingScene, frames: int) -> None:
        self.moving = moving
        self.methods = methods(moving.shape)
        self.raw: list[float] = []
        self.left: dict[str, list[float]] = {name: [] for name in self.methods}
        self.gains: dict[str, list[float]] = {name: [] for name in self.methods}
        self.stop: dict[str, list[float]] = {name: [] for name in self.methods}
        before, level = moving.stop[0] - 1, 0.0
        for index, frame in enumerate(moving.frames(frames)):
            for method in self.methods.values():
                method.update(frame.values)
            if index == before:
                self.note_stop(frame.level)
                level = frame.level
            if index == moving.stop[1] - 1:
                self.note_stop(level)
                self.note_stop(frame.level)
            if index % EVERY == EVERY - 1:
                self.note(frame.level)

    def pattern(self, name: str, level: float) -> float:
        """Residual pattern that a method leaves at a level."""
        method = self.methods[name]
        return self.moving.residual_pattern(method.gain, method.offset, level)

    def note_stop(self, level: float) -> None:
        """Keep the pattern of all methods before or after the stop, at a level."""
        for name in self.methods:
            self.stop[name].append(self.pattern(name, level))

    def note(self, level: float) -> None:
        """Keep the pattern and the gain error of all methods."""
        ones = np.ones(self.moving.shape)
        self.raw.append(self.moving.residual_pattern(ones, 0 * ones, level))
        for name, method in self.methods.items():
            self.left[name].append(self.pattern(name, level))
            self.gains[name].append(self.moving.gain_error(method.gain))

    def falls(self, name: str) -> list[float]:
        """Fall of the pattern after so many moving frames, then of the gain error at the last."""
        still = self.moving.stop[1] - self.moving.stop[0]
        points = [(count + still) // EVERY - 1 for count in MOVING]
        falls = [self.raw[i] / self.left[name][i] for i in points]
        first = self.moving.gain_error(np.ones(self.moving.shape))
        return [*falls, first / self.gains[name][points[-1]]]

    def growth(self, name: str) -> tuple[float, float]:
        """Pattern after the stop over that before it: at the level before it, and that of now."""
        before, after, now = self.stop[name]
        return after / before, now / before

    def drift(self, name: str) -> tuple[float, float]:
        """Mean of gain times true gain at the end, and the pattern over that after 2000."""
        still = self.moving.stop[1] - self.moving.stop[0]
        point = (MOVING[-1] + still) // EVERY - 1
        mean = float(np.mean(self.methods[name].gain * self.moving.gain))
        return mean, self.left[name][-1] / self.left[name][point]


def main(*, long: bool, check: bool) -> int:
    """Print the table and draw the picture; give the number of figures that miss."""
    shown, missed = [], 0
    print(f"{'method':20} seed  500   2000  gain  stop paused, running, at its level", end="")
    print("   mean  drift" if long else "")
    for seed in SEEDS[:1] if long else SEEDS:
        paused = Run(MovingScene(seed=seed), LONG if long else MOVING[-1] + 100)
        running = Run(MovingScene(seed=seed, running=True), 350)
        shown.append(paused)
        for name in paused.methods:
            falls = paused.falls(name)
            growth = (paused.growth(name)[0], *running.growth(name))
            drift = paused.drift(name) if long else ()
            print(line(name, seed, falls, growth, drift), flush=True)
            missed += misses(name, falls, growth[:2], drift)
    draw(shown[0])
    return missed if check else 0


def noise() -> None:
    """Print the falls of pattern and gain error in noisy video after 20 000 frames."""
    for spread in (0.01, 0.02, 0.05, 0.1):
        moving = MovingScene(seed=1, shape=(128, 128), noise=spread)
        learning = {name: each(moving.shape, (0, 1)) for name, each in METHODS.items()}  # type: ignore[call-arg]
        for frame in moving.frames(LONG):
            for method in learning.values():
                method.update(frame.values)
        ones = np.ones(moving.shape)
        raw = moving.residual_pattern(ones, 0 * ones, frame.level)
        for name, method in learning.items():
            left = moving.residual_pattern(method.gain, method.offset, frame.level)
            gains = moving.gain_error(ones) / moving.gain_error(method.gain)
            print(f"{name:20} {spread:5.0%} {raw / left:6.2f} {gains:5.2f}", flush=True)


def line(
    name: str, seed: int, falls: list[float], growth: tuple[float, ...], drift: tuple[float, ...]
) -> str:
    """Give a line of the table."""
    first, second, gain = falls
    words = f"{name:20} {seed:3} {first:6.2f} {second:6.2f} {gain:5.2f} "
    words += " ".join(f"{value:8.3f}" for value in growth)
    return words + "".join(f"   {value:.4f}" for value in drift)


def misses(
    name: str, falls: list[float], growth: tuple[float, ...], drift: tuple[float, ...]
) -> int:
    """Count the figures that miss what is required; the level of each moment has no requirement."""
    if name == "gate off":
        return sum(value < 2 for value in growth)
    missed = sum(got < wanted for got, wanted in zip(falls, REQUIRED[name], strict=True))
    if name != "local-mean":
        missed += sum(value >= 1.1 for value in growth)
    if drift:
        missed += (abs(drift[0] - 1) >= 0.01) + (drift[1] > 1.3)
    return missed


def draw(run: Run) -> None:
    """Residual pattern against the frame."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    frames = EVERY * (1 + np.arange(len(run.raw)))
    axes.plot(frames, run.raw, color="0.5", label="raw")
    for name, values in run.left.items():
        axes.plot(frames, values, label=name)
    axes.axvspan(*run.moving.stop, color="0.9")
    axes.set(xlabel="frame", ylabel="residual pattern, rms", yscale="log")
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(FILE, dpi=110)


if __name__ == "__main__":
    if "--noise" in sys.argv[1:]:
        noise()
        sys.exit()
    sys.exit(main(long="--long" in sys.argv[1:], check="--check" in sys.argv[1:]))
