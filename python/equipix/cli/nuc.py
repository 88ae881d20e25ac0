"""Commands about corrections with a uniform source: nuc fit, nuc defects, nuc quality."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from equipix._check import Array, By, Flagged, naming_memory
from equipix.cli.summary import flagged as flag_counts
from equipix.cli.summary import summary
from equipix.cli.terminal import (
    Cfa,
    Force,
    Json,
    Mask,
    Sensor,
    Workers,
    check_output,
    naming_mask,
    progress_bars,
    show_result,
)
from equipix.correction.correct_files import warn_of_corrected
from equipix.correction.protocol import Correction, check_sensor, named_cfa
from equipix.experiment.image_files import origin_of
from equipix.experiment.level_experiment import LevelExperiment
from equipix.io.formats import SUFFIXES, refuse_saved
from equipix.io.frames import read_frames, read_mask
from equipix.io.paths import find_files, refuse_inputs
from equipix.io.record import read_record
from equipix.loading import load_correction
from equipix.measured.colour import Colours
from equipix.measured.defects import DefectLimits
from equipix.metrics.correctability import correctability
from equipix.metrics.frame_noise import three_d_noise
from equipix.metrics.maps import planes, roughness
from equipix.nuc.bad_pixels import find_defects
from equipix.nuc.response import Response

commands = typer.Typer()

nuc = typer.Typer(
    no_args_is_help=True,
    help="Uniform source: fit response curves, find bad pixels, measure quality.",
)

commands.add_typer(nuc, name="nuc")

_ORDERS = {"0": 0, "1": 1, "2": 2, "3": 3, "auto": "auto"}


@commands.callback()
def _group() -> None: ...


@nuc.callback()
def _nuc() -> None: ...


@nuc.command(epilog="Example: equipix nuc fit levels.toml -o response.tif --order auto")
def fit(
    levels: Annotated[Path, typer.Argument(help="The levels.toml.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Response: .tif or .npz.")],
    order: Annotated[
        Literal["0", "1", "2", "3", "auto"],
        typer.Option(help="0 one-point, 1 two-point, 2 quadratic, 3 cubic; or by held-out levels."),
    ] = "1",
    by: Annotated[By, typer.Option(help="What a one-point correction changes.")] = "offset",
    mask: Mask = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Fit the response curves of all pixels to levels of a uniform source."""
    check_output(output, force=force, suffixes=SUFFIXES)
    loaded = LevelExperiment.load(levels)
    refuse_inputs([output], [levels, *loaded.files(), *([mask] if mask else [])])
    with progress_bars() as progress, naming_mask(mask):
        response = loaded.run(
            order=_ORDERS[order],  # type: ignore[arg-type]
            by=by,
            mask=None if mask is None else read_mask(mask),
            workers=workers,
            progress=progress,
        )
    response.save(output, force=force)
    show_result({"output": str(output), **summary(response)}, as_json=as_json)


@nuc.command(epilog="Example: equipix nuc defects response.tif level/*.tif -o flagged.tif")
def defects(
    response: Annotated[Path, typer.Argument(help="A response: .tif or .npz.")],
    frames: Annotated[
        list[str] | None,
        typer.Argument(help="Raw frames of one steady level: noise and flicker."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The response with the flags found: .tif or .npz."),
    ] = None,
    response_limit: Annotated[
        float,
        typer.Option(
            help="Least response over that of the neighbours (GB/T 17444-2013: the mean)."
        ),
    ] = DefectLimits.response,
    gain_limit: Annotated[float, typer.Option(help="Largest 1/(1 + K).")] = DefectLimits.gain,
    noise_limit: Annotated[
        float,
        typer.Option(help="Largest noise over that of its signal (GB/T 17444-2013: the mean)."),
    ] = DefectLimits.noise,
    correlation_limit: Annotated[
        float, typer.Option(help="Least deviation of von Neumann's ratio for flicker, in sigmas.")
    ] = DefectLimits.correlation,
    range_limit: Annotated[
        float, typer.Option(help="Least share of the range of levels with values.")
    ] = DefectLimits.range,
    misfit_limit: Annotated[
        float, typer.Option(help="Largest deviation of reduced chi2, in sigmas.")
    ] = DefectLimits.misfit,
    cfa: Cfa = None,
    sensor: Sensor = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Find bad pixels by response curves and by frames of one level."""
    if output is not None:
        check_output(output, force=force, suffixes=SUFFIXES)
        refuse_inputs([output], [response])
    limits = DefectLimits(
        response=response_limit,
        gain=gain_limit,
        noise=noise_limit,
        correlation=correlation_limit,
        range=range_limit,
        misfit=misfit_limit,
    )
    curves = read_record(response, Response)
    check_sensor(curves, sensor)
    with naming_memory("finding bad pixels"):
        raw = None if not frames else _raw(frames, response)
        found = find_defects(curves, raw, cfa=cfa, limits=limits)
    flagged = curves.with_flags(found.flags, cfa=cfa)
    if output is not None:
        flagged.save(output, force=force)
    result: dict[str, Any] = {"output": str(output or "none"), **found.counts}
    result |= {kind: f"not determinable {why}" for kind, why in found.not_determinable.items()}
    result |= {"percentiles_of_K": found.gain_percentiles, "flagged_pixels": flag_counts(flagged)}
    show_result(result, as_json=as_json)


@nuc.command(epilog="Example: equipix nuc quality response.tif level/*.tif")
def quality(
    correction: Annotated[Path, typer.Argument(help="A response or a calibration: .tif or .npz.")],
    frames: Annotated[list[str], typer.Argument(help="Raw frames of one steady even level.")],
    confidence: Annotated[
        float, typer.Option(help="Probability of the confidence interval.")
    ] = 0.95,
    cfa: Cfa = None,
    sensor: Sensor = None,
    as_json: Json = False,
) -> None:
    """Show spatial over temporal noise of corrected frames, and its parts.

    Behind colour filters that of each plane: of the correction's, or of --cfa, where it names none.
    """
    loaded = load_correction(correction)
    check_sensor(loaded, sensor)
    colours = named_cfa(loaded, cfa)
    with naming_memory("measuring quality"):
        result = _quality(loaded, _raw(frames, correction), colours, confidence)
    show_result(result, as_json=as_json)


def _quality(
    correction: Correction, raw: Array, colours: Colours | None, confidence: float
) -> dict[str, Any]:
    """Measure spatial over temporal noise of corrected frames, and its parts; of each plane."""

    def measured(flagged: Flagged, figure: Callable[[Array], Any]) -> dict[str, Any]:
        # The corrected frames end here: of long series one stack at a time is held.
        corrected = correction.correct(raw, flagged=flagged)
        cut = {"": corrected} if colours is None else planes(corrected, colours)
        return {name: figure(each) for name, each in cut.items()}

    usable = measured("nan", lambda each: correctability(each, confidence=confidence))
    kept = measured("keep", lambda each: correctability(each, confidence=confidence).ratio)
    parts = measured(
        "replace",
        lambda each: {
            "noise_variances": asdict(three_d_noise(each)),
            "roughness": roughness(each.mean(axis=0)),
        },
    )
    result = {
        name: {
            "frames": good.frames,
            "pixels": good.pixels,
            "C": good.ratio,
            "C_from": good.low,
            "C_to": good.high,
            "C_with_flagged_pixels": kept[name],
            "spatial_variance": good.spatial_variance,
            "temporal_variance": good.temporal_variance,
            **parts[name],
        }
        for name, good in usable.items()
    }
    return result[""] if colours is None else result


def _raw(source: list[str], correction: Path) -> Array:
    """Read raw frames, refuse files that equipix has saved, and warn of corrected ones."""
    files = find_files(source)
    for file in files:
        refuse_saved(file)
    warn_of_corrected(files, origin_of(correction))
    return read_frames(files)
