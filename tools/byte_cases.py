"""Small calibrations whose results `same_bytes.py` compares between two builds.

The interpreter of one build runs it: ``python byte_cases.py FOLDER [WORD ...]`` writes the results
of the cases whose names hold one of the words, or of all, to ``FOLDER/results.npz`` and
``FOLDER/notes.json``. Only public names are used, so the script runs against any commit.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix
from byte_scenes import (
    BETWEEN,
    BY_TURNS,
    IN_PARTS,
    NOISE,
    REVERSED,
    SIX,
    Scene,
    bad_measurements,
    bad_pixels,
    given_experiment,
    measured_experiment,
    statistics,
    with_dust,
    with_nan,
    with_odd_pixels,
    written_experiment,
)
from same_bytes import COMPARED, REPORTED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Arrays = dict[str, NDArray[Any]]

TURNED = [0, 0, 0, 0, 0, 180]
VARIANCES = NOISE**2 * np.array([1.0, 2.0, 1.0, 0.5, 1.0])
NOISY = equipix.NoiseModel(read_noise=1e-3, gain=3e-6)

WHOLE = Scene()
SINGLE = Scene(dtype="float32")
STRUCTURED = Scene(contrast=0.1)
SPLINE = Scene(shifts=BETWEEN, contrast=0.1)
HALF_TURN = Scene(shifts=SIX, rotation=TURNED, flux=(1.0, 1.01, 0.99, 1.02, 0.98, 1.0))
LEVELS = Scene(flux=(1.0, 0.5, 1.0, 0.5, 1.0), contrast=0.1)
ORDER = Scene(shifts=BY_TURNS, flux=(1.0, 0.999, 0.998, 0.997, 0.996))


def averages() -> Arrays:
    """What `equipix.average` gives of one exposure."""
    found = statistics(WHOLE, full_scale=2540, saturation=2540)[0]
    names = ("mean", "variance", "variance_of_mean", "count", "saturated")
    return {name: getattr(found, name) for name in names}


def simulated() -> Arrays:
    """What `equipix.simulate` makes for the experiment."""
    folder = written_experiment().parent
    truth = np.load(folder / "truth.npz")
    files = sorted(folder.glob("*/*.tif"))
    content = {file.name: np.frombuffer(file.read_bytes(), np.uint8) for file in files}
    return {name: truth[name] for name in truth.files} | content


def applied() -> Arrays:
    """What a calibration makes of frames: corrected, predicted, residuals, a mean's deviation."""
    frames = with_odd_pixels(SPLINE)
    found = SPLINE.fit(frames, variance=VARIANCES)
    ways = ("nan", "keep", "replace")
    weights = np.where(found.flags == 0, 1 / frames[0].size, 0)
    return {way: found.correct(frames, dark=None, flagged=way) for way in ways} | {
        "predicted": found.predict((1.5, 2.25), rotation=180, flux=0.9),
        "residuals": found.residuals(frames, variance=VARIANCES),
        "std_of": np.asarray(found.std_of(weights)),
        "tilt": found.tilt,
    }


def saved() -> Any:
    """A calibration that was written to a file and read again."""
    SPLINE.fit(shift_std=0.02, flux_std=1e-3, robust=True, uncertainty=True).save("saved.tif")
    return equipix.load("saved.tif")


def descent(**options: Any) -> dict[str, Any]:
    """Options of the paper's method."""
    return {"method": "coordinate-descent", "tolerance": 1e-4} | options


CASES: dict[str, Callable[[], Any]] = {
    "whole": lambda: WHOLE.fit(),
    "whole float32": lambda: SINGLE.fit(),
    "whole noise free": lambda: Scene(noise=0.0).fit(tolerance=1e-9),
    "whole structured": lambda: STRUCTURED.fit(variance=VARIANCES),
    "variance of each measurement": lambda: SINGLE.fit(
        variance=1e-6 + 3e-6 * np.abs(SINGLE.frames), uncertainty=True
    ),
    "turned 90": lambda: Scene(shifts=SIX, rotation=[0, 0, 0, 0, 0, 90]).fit(),
    "turned 180": lambda: Scene(shifts=SIX, rotation=TURNED).fit(),
    "turned 270 float32": lambda: Scene(
        shifts=SIX, rotation=[0, 0, 270, 0, 0, 0], dtype="float32"
    ).fit(),
    "turned all ways, masked": lambda: Scene(
        shifts=SIX, rotation=[0, 90, 180, 270, 0, 90], contrast=0.1
    ).fit(mask=bad_pixels(WHOLE), uncertainty=True),
    "masked pixels": lambda: WHOLE.fit(mask=bad_pixels(WHOLE)),
    "masked measurements": lambda: WHOLE.fit(mask=bad_measurements(WHOLE), uncertainty=True),
    "NaN in frames": lambda: SINGLE.fit(with_nan(SINGLE), mask=bad_pixels(SINGLE)),
    "saturation": lambda: STRUCTURED.fit(saturation=1.12),
    "dead and hot pixels": lambda: WHOLE.fit(with_odd_pixels(WHOLE)),
    "narrow beam": lambda: Scene(width=20.0).fit(tolerance=1e-4),
    "parts": lambda: Scene(shifts=IN_PARTS).fit(),
    "parts between pixels": lambda: Scene(shifts=((0, 0.3), *IN_PARTS[1:])).fit(
        variance=VARIANCES, uncertainty=True
    ),
    "known fluxes": lambda: LEVELS.fit(flux=LEVELS.flux, variance=VARIANCES),
    "free fluxes": lambda: WHOLE.fit(flux="fit"),
    "free fluxes, turned": lambda: HALF_TURN.fit(flux="fit", uncertainty=True),
    "prior fluxes": lambda: HALF_TURN.fit(flux=HALF_TURN.flux, flux_std=0.01),
    "prior fluxes, masked float32": lambda: SINGLE.fit(
        flux_std=1e-3, mask=bad_measurements(SINGLE), variance=VARIANCES
    ),
    "linear fluxes": lambda: ORDER.fit(flux="linear", time=[0, 10, 20, 30, 40]),
    "linear fluxes in a poor order": lambda: WHOLE.fit(flux="linear", time=[0, 1, 2, 3, 4]),
    "between pixels": lambda: SPLINE.fit(variance=VARIANCES),
    "between pixels, turned": lambda: Scene(
        shifts=(*BETWEEN, (2.5, 3.25)),
        rotation=[0, 90, 0, 180, 0, 0],
        contrast=0.1,
        dtype="float32",
    ).fit(),
    "refined": lambda: SPLINE.fit(shift_std=0.02, variance=VARIANCES, uncertainty=True),
    "refined, free fluxes": lambda: SPLINE.fit(
        shift_std=[0.0, 0.02, 0.02, 0.03, 0.03], flux="fit", mask=bad_pixels(SPLINE)
    ),
    "refined in a smooth beam": lambda: Scene(shifts=BETWEEN).fit(shift_std=0.01),
    "dark fitted": lambda: LEVELS.fit(LEVELS.frames + 0.1, flux=LEVELS.flux, dark="fit"),
    "dark fitted, prior fluxes": lambda: LEVELS.fit(
        LEVELS.frames + 0.1, flux=LEVELS.flux, flux_std=0.01, dark="fit", variance=VARIANCES
    ),
    "robust": lambda: WHOLE.fit(with_dust(WHOLE), robust=True),
    "robust between pixels": lambda: SPLINE.fit(
        with_dust(SPLINE), robust=True, variance=VARIANCES, tolerance=1e-5
    ),
    "robust with a noise model": lambda: WHOLE.fit(
        with_dust(WHOLE), robust=True, variance=NOISY, mask=bad_pixels(WHOLE)
    ),
    "noise model": lambda: SINGLE.fit(variance=NOISY),
    "noise model of each exposure, free fluxes": lambda: HALF_TURN.fit(
        variance=[NOISY] * 6, flux="fit"
    ),
    "statistics": lambda: WHOLE.fit(statistics(WHOLE), uncertainty=True),
    "statistics of single frames": lambda: WHOLE.fit(statistics(WHOLE, frames=1)),
    "statistics, saturated": lambda: STRUCTURED.fit(
        statistics(STRUCTURED, full_scale=2800, saturation=2800)
    ),
    "statistics, noise model, robust": lambda: WHOLE.fit(
        statistics(WHOLE), variance=equipix.NoiseModel(read_noise=2.1, gain=0.25), robust=True
    ),
    "statistics between pixels": lambda: SPLINE.fit(statistics(SPLINE), shift_std=0.02),
    "coordinate descent": lambda: Scene(shape=(24, 32)).fit(**descent()),
    "coordinate descent, turned": lambda: Scene(
        shape=(24, 32), shifts=SIX, rotation=TURNED, dtype="float32"
    ).fit(**descent(variance=np.full(6, NOISE**2))),
    "coordinate descent, rounded": lambda: Scene(shape=(24, 32), shifts=BETWEEN).fit(**descent()),
    "coordinate descent, too few sweeps": lambda: WHOLE.fit(**descent(max_sweeps=20)),
    "too few sweeps": lambda: SPLINE.fit(max_sweeps=15),
    "reversed shifts": lambda: SPLINE.fit(
        Scene(shifts=REVERSED, contrast=0.1).frames, variance=VARIANCES
    ),
    "applied": applied,
    "saved and loaded": saved,
    "average": averages,
    "simulate": simulated,
    "experiment, measured shifts": lambda: measured_experiment().run(),
    "experiment, measured, robust": lambda: measured_experiment().run(
        robust=True, flux="fit", tolerance=1e-4
    ),
    "experiment, given shifts": lambda: given_experiment().run(uncertainty=True),
    "experiment, 8 bits, saturated": lambda: given_experiment(
        bit_depth=8, exposure_e=18_300.0
    ).run(),
    "experiment, given with errors": lambda: given_experiment(
        "shift_std = [0.01, 0.01]\nflux = 1.0\nflux_std = 0.002", BETWEEN
    ).run(),
    "experiment, linear fluxes": lambda: given_experiment().run(flux="linear"),
    "experiment, coordinate descent": lambda: measured_experiment().run(**descent(max_sweeps=100)),
}


def results(outcome: Any) -> Arrays:
    """The arrays of a case; what a calibration does not have is left out."""
    if isinstance(outcome, dict):
        return outcome
    found = {name: getattr(outcome, name, None) for name in COMPARED + REPORTED}
    return {name: np.asarray(value) for name, value in found.items() if value is not None}


def run(names: list[str]) -> tuple[Arrays, dict[str, Any]]:
    """The results of some cases, and the warnings or the error of each."""
    arrays: Arrays = {}
    notes: dict[str, Any] = {}
    for name in names:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                found, error = results(CASES[name]()), None
            except Exception as raised:  # whatever a build raises is a finding
                found, error = {}, f"{type(raised).__name__}: {raised}"
        arrays |= {f"{name}/{field}": array for field, array in found.items()}
        shown = [(warning.category.__name__, str(warning.message)) for warning in caught]
        notes[name] = {"warnings": shown, "error": error}
    return arrays, notes


def main(folder: str, *words: str) -> None:
    """Write the results of the cases, and which package and NumPy made them."""
    names = [name for name in CASES if not words or any(word in name for word in words)]
    if not names:
        sys.exit(f"no case has any of {words} in its name, expected some of {list(CASES)}")
    arrays, notes = run(names)
    np.savez(Path(folder) / "results.npz", **arrays)  # type: ignore[arg-type]
    about = {"package": str(Path(equipix.__file__).parent), "numpy": np.__version__}
    (Path(folder) / "notes.json").write_text(json.dumps({"about": about, "cases": notes}))


if __name__ == "__main__":
    main(*sys.argv[1:])
