"""Small calibrations whose results `same_bytes.py` compares between two builds.

The interpreter of one build runs it: ``python byte_cases.py FOLDER [WORD ...]`` writes the results
of the cases whose names hold one of the words, or of all, to ``FOLDER/results.npz`` and
``FOLDER/notes.json``. Only public names are used. Each build runs the script of its own checkout:
where a public name changes, its use here changes, but no name of a case or of a field.
Uniform sources, scenes, corrections and their files are in `byte_corrections.py`.
"""

from __future__ import annotations

import json
import sys
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix
from byte_corrections import CASES as CORRECTIONS
from byte_corrections import SHAPE, mask, reread
from byte_scenes import (
    BETWEEN,
    BY_TURNS,
    CROSS,
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
from equipix import detector, metrics, plan, simulate
from equipix.detector import photons
from equipix.plan.drift import distinct_trend
from same_bytes import COMPARED, REPORTED, collected, parts

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


def calibration_files() -> Any:
    """Calibrations, as read from files, and how far they agree."""
    spline = Scene(shape=(48, 64), shifts=BETWEEN, contrast=0.1)
    colours = np.where(np.indices(spline.shape).sum(axis=0) % 2 == 1, 1.0, 0.5)
    found = {
        "refined": spline.fit(shift_std=0.02, flux_std=1e-3, uncertainty=True),
        "averages": Scene(shape=(48, 64)).fit(statistics(Scene(shape=(48, 64)))),
        "colours": spline.fit(spline.frames * colours, cfa="RGGB"),
    }
    pair = equipix.compare([*found.values()][:2], predicted=[(2e-3, 3e-4)] * 2)
    read = {name: reread(each) for name, each in found.items()}
    return found | {"files": read, "pair": pair, "difference": pair.difference(0)}


def noise_and_shifts() -> Any:
    """Variances of a noise model, and the shift of a spot."""
    model, signal = equipix.NoiseModel(read_noise=0.4, gain=0.2, step=1.0), np.linspace(0, 50, 101)
    mean, (rows, cols) = model.of_mean(8, dark_variance=0.01), np.indices((48, 64))
    places = ((20.0, 30.0), (20.3, 34.8))
    spots = [100 + 900 * np.exp(-((rows - v) ** 2 + (cols - h) ** 2) / 18) for v, h in places]
    return {
        "variance": [each.variance(signal) for each in (model, mean)],
        "scatter": [each.scatter(signal) for each in (model, mean)],
        "rounding": [each.rounding(signal) for each in (model, mean)],
        "shift": equipix.measure_shift(*spots),
        "cross": equipix.cross_pattern(5, 7),
    }


def plans() -> Any:
    """Plans of experiments."""
    causes = {"drift": 1e-4, "shift_error": 0.02, "beam_width": 60.0}
    known: dict[str, Any] = {"shift_std": 0.01, "beam_slope": (0.01, 0.02)}
    return {
        "whole": plan.error_budget(SHAPE, CROSS, noise=1e-3, **causes),
        "between": plan.error_budget(SHAPE, BETWEEN, noise=1e-3, flux=[1, 0.5, 1, 2, 1]),
        "patterns": plan.suggest(SHAPE, 4, 6, noise=1e-3, patterns=2, rng=1),
        "apart": plan.identify(SHAPE, [(0, 0), (0, 4), (6, 0)]),
        "masked": plan.identify(SHAPE, CROSS, mask(), cfa="RGGB"),
        "turned": plan.identify(SHAPE, CROSS, rotation=[0, 90, 0, 180, 0]),
        "order": [plan.advise_order(CROSS), distinct_trend(CROSS)],
        "tilt": [plan.tilt_std(SHAPE, CROSS, **each) for each in ({"flux_std": 1e-4}, known)],
    }


def simulated_camera() -> Any:
    """Simulated sensors, beams, cameras and experiments."""
    shape, place = (48, 64), 1.5 * np.indices((48, 64))
    paper = simulate.paper_sensitivity(shape, rng=1)
    cosine = simulate.cosine_sensitivity(shape, rng=2)
    beams = {
        "gaussian": simulate.gaussian_beam(shape, width=90),
        "striped": simulate.striped_beam(shape),
        "tilted": simulate.tilted_beam(shape),
        "wavy": simulate.wavy_beam(shape, rng=3),
    }
    bad: dict[str, Any] = {"dead": np.array([[3, 4]]), "hot": np.array([[7, 9]])}
    camera = simulate.Camera(sensitivity=paper, full_well_e=15000, **bad)
    virtual = simulate.experiment(paper, beams["gaussian"], CROSS, frames=4, rng=6)
    light, errors = 9000 * beams["wavy"](*place), metrics.relative_error(cosine, paper)
    return {
        "sensitivity": [paper, cosine, simulate.filtered(paper, "RGGB")],
        "beam": {name: beam(*place) for name, beam in beams.items()},
        "camera": [camera, camera.frames(light, 2, rng=4), camera.variance(light)],
        "exposures": simulate.exposures(paper, beams["wavy"], CROSS, rotation=[90] * 5),
        "experiment": [virtual.truth, virtual.variance_of_mean(), virtual.frames(1)],
        "predicted": [
            virtual.noise_prediction(rng=7),
            simulate.noise_prediction(paper, beams["tilted"], CROSS, 1e-6, mask=paper < 1, rng=8),
        ],
        "errors": [errors, metrics.block_means(errors)],
        "photons": photons.band_photons(3.0, np.linspace(4, 5, 9), 300.0),
        "spectrum": photons.photon_exitance(np.linspace(3, 12, 19), 300.0),
        "HgCdTe": [
            photons.hgcdte_cutoff(np.linspace(0.2, 0.4, 9)),
            photons.hgcdte_gap(np.linspace(0.2, 0.4, 9)),
            photons.hgcdte_composition(5.1),
        ],
    }


def detectors() -> Any:
    """Spreads of composition that corrections tolerate."""
    band = detector.HgCdTe(start_um=3.0, cutoff_um=5.1, edge_mev=4.0)
    short = detector.ShortPass(edge_um=4.8)
    passing = detector.HgCdTe(start_um=3.0, cutoff_um=5.1, short_pass=short)
    one: dict[str, Any] = {"references_k": (295.0,)}
    return {
        "two": detector.composition_tolerance(band),
        "none": detector.composition_tolerance(band, references_k=()),
        "one": [detector.composition_tolerance(band, by=by, **one) for by in ("offset", "gain")],
        "filter": detector.composition_tolerance(passing, filled_k=310.0, charge_e=1e7),
        "band": [band.composition, band.integration_factor(290.0)],
        "photons": band.photons(band.composition + np.linspace(-1e-3, 1e-3, 9), 300.0),
        "transmission": short.transmission(np.linspace(4.0, 6.0, 41)),
    }


def staring(material: str) -> Any:
    """A simulated array of a material."""
    array = simulate.StaringArray.of(material, SHAPE, rng=1)
    return {
        "": array,
        "frames": array.frames(8e6, 2, rng=2, warmer_k=0.1, time_s=30.0),
        "mean": array.mean(8e6, warmer_k=0.2, time_s=60.0),
        "changed": array.with_causes(curvature=0.01, bit_depth=12).mean(8e6),
        "electrons": array.electrons(8e6),
        "noise": array.temporal_noise(8e6),
        "body": array.black_body(300.0, light_e=8e6),
    }


def simulated_scene() -> Any:
    """A simulated moving scene, and errors of its coefficients."""
    moving = simulate.MovingScene(seed=3, shape=SHAPE, stop=(4, 6))
    return {
        "": moving,
        "frames": moving.frames(8),
        "texture": moving.scene([3.2, 4.7]),
        "pattern": moving.residual_pattern(moving.gain, moving.offset, 0.5),
        "gain error": moving.gain_error(moving.gain * 1.01),
    }


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
    "calibrations in files": calibration_files,
    "noise and shifts": noise_and_shifts,
    "plans": plans,
    "detectors": detectors,
    "simulated camera": simulated_camera,
    "simulated scene": simulated_scene,
    **{f"simulated {name}": partial(staring, name) for name in ("PtSi", "InSb", "HgCdTe")},
    **CORRECTIONS,
}


def results(outcome: Any) -> Arrays:
    """The arrays of a case; what a calibration does not have is left out."""
    if isinstance(outcome, dict):
        return collected(outcome)
    found = dict(parts(outcome))
    return collected({name: found[name] for name in COMPARED + REPORTED})


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
