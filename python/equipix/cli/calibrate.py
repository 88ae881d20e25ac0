"""Commands about calibrations: calibrate, inspect, compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from equipix._types import FluxModel, Method
from equipix.calibration.result import Calibration
from equipix.cli.options import (
    Force,
    Json,
    MaxSweeps,
    Picture,
    Tolerance,
    Uncertainty,
    Workers,
)
from equipix.cli.terminal import check_output, progress_bars, show_result, show_table
from equipix.comparison import compare as compare_calibrations
from equipix.correction.protocol import Correction
from equipix.experiment.run import Experiment
from equipix.flags import Flag
from equipix.io import SUFFIXES, refuse_inputs
from equipix.loading import load, load_calibration
from equipix.pictures.canvas import check_picture, save_figure
from equipix.pictures.comparison import draw_comparison

commands = typer.Typer()


@commands.command(epilog="Example: equipix calibrate experiment.toml -o cal.tif")
def calibrate(
    experiment: Annotated[Path, typer.Argument(help="The experiment.toml.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration: .tif or .npz.")],
    robust: Annotated[
        bool, typer.Option("--robust", help="Leave out measurements that disagree with the others.")
    ] = False,
    method: Annotated[
        Method, typer.Option(help="The solver: the fast one, or the paper's.")
    ] = "multiscale",
    flux: Annotated[
        FluxModel | None,
        typer.Option(help="Fluxes to find: one an exposure, or linear in the file's times."),
    ] = None,
    tolerance: Tolerance = 1e-6,
    max_sweeps: MaxSweeps = None,
    uncertainty: Uncertainty = False,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Calibrate a sensor from the images of an experiment."""
    check_output(output, force=force, suffixes=SUFFIXES)
    loaded = Experiment.load(experiment)
    refuse_inputs([output], [experiment, *loaded.files()])
    with progress_bars() as progress:
        calibration = loaded.run(
            flux=flux,
            robust=robust,
            method=method,
            tolerance=tolerance,
            max_sweeps=max_sweeps,
            uncertainty=uncertainty,
            workers=workers,
            progress=progress,
        )
    calibration.save(output, force=force)
    show_result({"output": str(output), **_summary(calibration)}, as_json=as_json)


@commands.command(epilog="Example: equipix inspect cal.tif")
def inspect(
    file: Annotated[Path, typer.Argument(help="A calibration: .tif or .npz.")],
    as_json: Json = False,
) -> None:
    """Show what a calibration file holds."""
    correction = load(file)
    result: dict[str, Any] = {"file": str(file)}
    if isinstance(correction, Calibration):
        result |= _summary(correction)
    else:
        result |= {
            "shape": list(correction.shape),
            "order": len(correction.coefficients) - 1,
            "flagged_pixels": _flagged(correction),
        }
    if as_json:
        result["metadata"] = correction.metadata
    show_result(result, as_json=as_json)


def _flagged(correction: Correction) -> dict[str, int]:
    """Count the pixels that have each flag."""
    return {
        flag.name or "": int(np.count_nonzero(correction.flags & flag))
        for flag in Flag
        if (correction.flags & flag).any()
    }


def _summary(calibration: Calibration) -> dict[str, Any]:
    """Collect the main figures of a calibration."""
    sensitivity = calibration.sensitivity
    options = calibration.metadata.get("options", {})
    orientation = calibration.orientation
    return {
        "shape": list(calibration.shape),
        "mean": float(np.nanmean(sensitivity, dtype=np.float64)),
        "spread": float(np.nanstd(sensitivity, dtype=np.float64)),
        **_uncertainty(calibration),
        "converged": calibration.converged,
        "error_estimate": calibration.error_estimate,
        "sweeps": calibration.sweeps,
        _misfit_name(options): calibration.reduced_chi2,
        "components": calibration.components,
        "shift_sign": calibration.shift_sign,
        **({"orientation": orientation.words} if orientation else {}),
        "fluxes": options.get("flux", "known"),
        "flagged_pixels": _flagged(calibration),
    }


def _misfit_name(options: dict[str, Any]) -> str:
    """Name of the mean square residual: without variances it is a variance in DN²."""
    return "variance_of_a_value" if options.get("weights") == "equal" else "reduced_chi2"


def _uncertainty(calibration: Calibration) -> dict[str, Any]:
    """Standard deviations by noise, if they were computed, and their exactness."""
    std, tilt_std = calibration.sensitivity_std, calibration.tilt_std
    if std is None or tilt_std is None:
        return {}
    exactness = calibration.metadata["uncertainty"]["relative_standard_error"]
    return {
        "sensitivity_std": float(np.nanmedian(std)),
        "sensitivity_std_is_exact_to": exactness,
        "tilt": dict(zip(("rows", "cols"), calibration.tilt.tolist(), strict=True)),
        "tilt_std": dict(zip(("rows", "cols"), tilt_std.tolist(), strict=True)),
    }


@commands.command(epilog="Example: equipix compare first.tif second.tif -o agreement.png")
def compare(
    calibrations: Annotated[
        list[Path], typer.Argument(help="Calibrations of one sensor: .tif or .npz.")
    ],
    output: Picture = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Show how far calibrations of one sensor agree."""
    if output is not None:
        check_picture(output)
        check_output(output, force=force)
        refuse_inputs([output], calibrations)
    result = compare_calibrations([load_calibration(file) for file in calibrations])
    if output is not None:
        names = [file.stem for file in calibrations]
        save_figure(draw_comparison(result, names), output, force=force)
    pairs = [
        {
            "files": [str(calibrations[i]) for i in pair],
            "rms": float(result.rms[k]),
            "block_rms": float(result.block_rms[k]),
            "largest": float(result.largest[k]),
            "predicted_rms": None
            if result.predicted_rms is None
            else float(result.predicted_rms[k]),
        }
        for k, pair in enumerate(result.pairs)
    ]
    pixels = int(np.isfinite(result.agreement).sum())
    if as_json:
        show_result({"pixels": pixels, "pairs": pairs}, as_json=True)
    else:
        _show_pairs(pairs)
        show_result({"pixels compared": pixels, "picture": str(output or "none")}, as_json=False)


def _show_pairs(pairs: list[dict[str, Any]]) -> None:
    """Print how far the calibrations of each pair differ."""
    figures = ("rms", "block_rms", "largest")
    show_table(
        ("relative difference", "pixels, rms", "16×16 means, rms", "largest"),
        [(" − ".join(pair["files"]), *(f"{pair[name]:.2e}" for name in figures)) for pair in pairs],
    )
