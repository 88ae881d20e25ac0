"""Measure the correction of a simulated array of bolometers: ``python docs/bolometer.py``.

Prints the average non-uniformity, relative to the range of the output, over 48 temperatures of the
substrate from -20 to 60 °C that no fit used, at three biases with V² between -5 and 5 % of nominal;
the same with noise, beside the temporal noise; and what errors of the thermometer add.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import equipix
from equipix import bolometer, metrics, simulate

SHAPE = (48, 64)
LOW, HIGH = -20.0, 60.0
TESTED = LOW + (HIGH - LOW) * (np.arange(48) + 0.5) / 48
NOMINAL = 2.0
LIMIT = 1 / 250_000
SCENES = (-20.0, 0.0, 20.0, 40.0, 60.0, 100.0)


def nodes(count: int) -> np.ndarray:
    """Temperatures of references, closer together towards the ends of the range."""
    return (LOW + HIGH) / 2 - (HIGH - LOW) / 2 * np.cos(np.pi * np.arange(count) / (count - 1))


def volts(change: float) -> float:
    """Bias whose square differs from the nominal one by a share."""
    return NOMINAL * float(np.sqrt(1 + change))


def states(count: int, changes: tuple[float, ...] = (-0.05, 0.05)) -> np.ndarray:
    """Temperature and bias of each reference, shape (n, 2)."""
    return np.array([(celsius, volts(each)) for celsius in nodes(count) for each in changes])


def means(array: simulate.BolometerArray, at: np.ndarray, **scene: float) -> np.ndarray:
    """Noise-free frames at some states."""
    return np.stack([array.mean(celsius, bias_v=bias, **scene) for celsius, bias in at])


class Tested:
    """Frames at the states that no fit used, and the range of the output."""

    def __init__(self, array: simulate.BolometerArray) -> None:
        """Make all frames, noise free."""
        self.array = array
        self.at = np.array([(celsius, volts(c)) for celsius in TESTED for c in (-0.05, 0.0, 0.05)])
        self.span = array.output_span([LOW, *TESTED, HIGH], [-20.0, 100.0])
        self.shutter = means(array, self.at)

    def frames(self, scene_c: float | None) -> np.ndarray:
        """Frames of the shutter, or of a scene."""
        return self.shutter if scene_c is None else means(self.array, self.at, scene_c=scene_c)

    def left(
        self,
        correction: bolometer.DynamicCorrection,
        *,
        scene_c: float | None = None,
        error_k: float = 0.0,
    ) -> float:
        """Non-uniformity relative to the range, with an error of the thermometer."""
        raw = self.frames(scene_c)
        at = partial(correction.correction, extrapolate=True)
        frames = [
            at(celsius + error_k, bias).correct(frame)
            for (celsius, bias), frame in zip(self.at, raw, strict=True)
        ]
        return metrics.non_uniformity(np.stack(frames), self.span)


def offsets(tested: Tested) -> None:
    """Print the non-uniformity before a shutter by form of the correction."""
    array, at = tested.array, states(6)
    shutter = means(array, at)
    static = bolometer.fit([array.mean(20.0)], [20.0], NOMINAL)
    ignored = bolometer.fit(means(array, states(6, (0.0,))), nodes(6), NOMINAL, order=4)
    rows = {"static, at 20 °C and V²": static, "order 4, bias ignored": ignored}
    for order in (1, 2, 3, 4):
        rows[f"order {order}, linear in V²"] = bolometer.fit(shutter, *at.T, order=order)
    rows["order chosen"] = chosen = bolometer.fit(shutter, *at.T)
    for order in (2, 3):
        rows[f"order {order} in 1/T, linear in V²"] = bolometer.fit(
            shutter, *at.T, order=order, regressor="inverse"
        )
    print(f"range {tested.span:.0f} DN = {1e3 * tested.span / array.dn_per_v:.1f} mV")
    print("before the shutter, 6 temperatures x 2 biases   of the range   below 1/250 000?")
    for name, correction in rows.items():
        found = tested.left(correction)
        print(f"{name:45} {found:.2e}   {'yes' if found < LIMIT else 'no'}")
    print(f"order that predicts held-out temperatures best: {chosen.axes.order}")
    johnson = float(np.mean([array.johnson_v(each).mean() for each in TESTED]))
    print(
        f"Johnson noise of 1 kHz: {1e6 * johnson:.2f} µV, {johnson_share(tested):.2e} of the range"
    )
    for error_k in (1e-3, 1e-2):
        found = tested.left(chosen, error_k=error_k)
        print(f"thermometer off by {1e3 * error_k:.0f} mK: {found:.2e}")


def johnson_share(tested: Tested) -> float:
    """Johnson noise relative to the range, mean over the tested temperatures."""
    array = tested.array
    noise = np.mean([array.johnson_v(each).mean() for each in TESTED])
    return float(array.dn_per_v * noise / tested.span)


def gains(tested: Tested) -> None:
    """Print the non-uniformity of scenes after offset and gain."""
    array, at = tested.array, states(6)
    bodies = tuple(means(array, at, scene_c=each) for each in (0.0, 40.0))
    both = bolometer.fit(means(array, at), *at.T, black_bodies=bodies)
    offset = bolometer.fit(means(array, at), *at.T)
    print("\nscene, °C   offset alone   with gain from black bodies at 0 and 40 °C")
    for scene_c in SCENES:
        alone, found = (tested.left(each, scene_c=scene_c) for each in (offset, both))
        print(f"{scene_c:9.0f}   {alone:.2e}       {found:.2e}")


def noisy(tested: Tested) -> None:
    """Print what the noise of the references adds to the non-uniformity."""
    array = tested.array
    print("\nspatial over temporal noise of a frame                      shutter   20 °C    60 °C")
    for name, changes, frames in (
        ("8 temperatures x 64 frames, V² nominal", (0.0,), 64),
        ("8 temperatures x 2 biases x 32 frames", (-0.05, 0.05), 32),
        ("8 temperatures x 2 biases x 64 frames", (-0.05, 0.05), 64),
    ):
        at = states(8, changes)
        for regressor in ("temperature", "inverse"):
            references = [taken(array, at, frames, scene_c=each) for each in (None, 0.0, 40.0)]
            how = {"regressor": regressor, "black_bodies": tuple(references[1:])}
            correction = bolometer.fit(references[0], *at.T, **how)
            shares = [
                excess(tested, correction, scene_c=each, nominal=len(changes) == 1)
                for each in (None, 20.0, 60.0)
            ]
            variable = "T" if regressor == "temperature" else "1/T"
            orders = f"order {correction.axes.order} ({correction.gain_axes.order}) in {variable}"
            print(f"{name:38}, {orders:18} " + "  ".join(f"{each:8.3f}" for each in shares))


def taken(
    array: simulate.BolometerArray, at: np.ndarray, count: int, scene_c: float | None
) -> list[equipix.FrameStatistics]:
    """Averages of frames with noise at some states."""
    seed = 0 if scene_c is None else int(100 + scene_c)
    return [
        equipix.average(
            array.frames(celsius, count, bias_v=bias, scene_c=scene_c, rng=1000 * seed + k)
        )
        for k, (celsius, bias) in enumerate(at)
    ]


def excess(
    tested: Tested,
    correction: bolometer.DynamicCorrection,
    *,
    scene_c: float | None,
    nominal: bool,
) -> float:
    """Spatial noise that the correction leaves, over the temporal noise of a frame."""
    array, raw, shares = tested.array, tested.frames(scene_c), []
    for (celsius, bias), frame in zip(tested.at, raw, strict=True):
        if nominal and bias != NOMINAL:
            continue
        left = correction.correction(celsius, bias).correct(frame)
        shares.append(np.std(left) / np.sqrt(np.mean(array.temporal_noise(celsius) ** 2)))
    return float(np.mean(shares))


def others() -> None:
    """Print the non-uniformity of arrays of other pixels."""
    found = []
    for seed in range(2, 7):
        tested = Tested(simulate.BolometerArray.of(SHAPE, rng=seed))
        at = states(6)
        found.append(tested.left(bolometer.fit(means(tested.array, at), *at.T)))
    print(f"five other arrays: {min(found):.2e} to {max(found):.2e}")


def main() -> None:
    """Print all tables."""
    tested = Tested(simulate.BolometerArray.of(SHAPE, rng=1))
    offsets(tested)
    others()
    gains(tested)
    noisy(tested)


if __name__ == "__main__":
    main()
