"""Commands about corrections with a uniform source: nuc fit, nuc defects, nuc quality."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from equipix import metrics
from equipix._check import Array, By, Flagged, Order, naming_memory
from equipix.cli import terminal
from equipix.correction.protocol import Correction, check_sensor, named_cfa
from equipix.experiment.level_experiment import LevelExperiment
from equipix.findings import Findings, ask, say, usable
from equipix.io.formats import SAVED, SUFFIXES
from equipix.io.frames import FrameFiles
from equipix.io.paths import find_files, refuse_inputs
from equipix.io.record import read_record
from equipix.measured.colour import Colours
from equipix.measured.defects import SIGMAS, DefectLimits
from equipix.measured.noise import ROBUST
from equipix.measured.part import median
from equipix.metrics.correctability import Correctability, judged
from equipix.metrics.frame_noise import STEADY, refuse_lost, stack_of, used_in
from equipix.metrics.sums import Sums
from equipix.metrics.three_d import components
from equipix.nuc.defect_search import find_defects
from equipix.nuc.response import Response, pattern_variance
from equipix.report.figures import flagged as flag_counts
from equipix.saved_results import READ, load_correction

commands = typer.Typer()

nuc = typer.Typer(
    no_args_is_help=True,
    help="Uniform source: fit response curves, find bad pixels, measure quality.",
)

commands.add_typer(nuc, name="nuc")

_ORDERS: dict[str, Order] = {"0": 0, "1": 1, "2": 2, "3": 3, "auto": "auto"}


@nuc.command(epilog="Example: equipix nuc fit levels.toml -o response.tif --order auto")
def fit(
    levels: Annotated[Path, typer.Argument(help="The levels.toml.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"Response: {SAVED}.")],
    order: Annotated[
        Literal["0", "1", "2", "3", "auto"],
        typer.Option(help="0 one-point, 1 two-point, 2 quadratic, 3 cubic; or by held-out levels."),
    ] = "1",
    by: Annotated[By, typer.Option(help="What a one-point correction changes.")] = "offset",
    mask: terminal.Mask = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Fit the response curves of all pixels to levels of a uniform source."""
    terminal.check_output(output, force=force, suffixes=SUFFIXES)
    loaded = LevelExperiment.load(levels)
    refuse_inputs([output], [levels, *loaded.files(), *terminal.given(mask)])
    with terminal.working(mask) as (progress, excluded):
        response = loaded.run(
            order=_ORDERS[order], by=by, mask=excluded, workers=workers, progress=progress
        )
    terminal.show_saved(output, response, force=force, as_json=as_json)


@nuc.command(epilog="Example: equipix nuc defects response.tif level/*.tif -o flagged.tif")
@terminal.options_of(
    DefectLimits,
    suffix="_limit",
    response_limit="Least response over that of the neighbours (GB/T 17444-2013: the mean).",
    gain_limit="Largest 1/(1 + K).",
    noise_limit="Largest noise over that of its signal (GB/T 17444-2013: the mean).",
    correlation_limit="Least deviation of von Neumann's ratio for flicker, in sigmas.",
    range_limit="Least share of the range of levels with values.",
    misfit_limit="Largest deviation of reduced chi2, in sigmas.",
)
def defects(
    response: Annotated[Path, typer.Argument(help=f"A response: {SAVED}.")],
    frames: Annotated[
        list[str] | None, typer.Argument(help="Raw frames of one steady level: noise and flicker.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=f"The response with the flags found: {SAVED}."),
    ] = None,
    cfa: terminal.Cfa = None,
    sensor: terminal.Sensor = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Find bad pixels by response curves and by frames of one level."""
    terminal.check_output(output, [response], force=force, suffixes=SUFFIXES)
    refuse_inputs(terminal.given(output), find_files(frames) if frames else [])
    limits = DefectLimits(**{name.removesuffix("_limit"): each for name, each in options.items()})
    curves = read_record(response, Response)
    check_sensor(curves, sensor)
    with naming_memory("finding bad pixels"):
        raw, said = terminal.raw_frames(frames, response) if frames else (None, ())
        found = find_defects(curves, raw, cfa=cfa, limits=limits)
    flagged = curves.with_flags(found.flags, cfa=cfa, findings=said + found.findings)
    if output is not None:
        flagged.save(output, force=force)
    result: dict[str, Any] = {"output": None if output is None else str(output), **found.counts}
    result |= {kind: f"not determinable {why}" for kind, why in found.not_determinable.items()}
    result |= {"percentiles_of_K": found.gain_percentiles, "flagged_pixels": flag_counts(flagged)}
    terminal.show_result(result, flagged.findings, as_json=as_json)


@nuc.command(epilog="Example: equipix nuc quality response.tif level/*.tif")
def quality(
    correction: Annotated[Path, typer.Argument(help=f"A correction: {READ}.")],
    frames: Annotated[list[str], typer.Argument(help="Raw frames of one steady even level.")],
    confidence: Annotated[
        float, typer.Option(help="Probability of the confidence interval.")
    ] = 0.95,
    substrate_c: terminal.SubstrateC = None,
    bias_v: terminal.BiasV = None,
    cfa: terminal.Cfa = None,
    sensor: terminal.Sensor = None,
    as_json: terminal.Json = False,
) -> None:
    """Show spatial over temporal noise of corrected frames, its parts, and what noise predicts.

    The verdict says whether the predicted C lies in the confidence interval of C.

    Behind colour filters that of each plane: of the correction's, or of --cfa, where it names none.
    """
    loaded = load_correction(correction, substrate_c=substrate_c, bias_v=bias_v)
    check_sensor(loaded, sensor)
    colours = named_cfa(loaded, cfa)
    with naming_memory("measuring quality"):
        raw, said = terminal.raw_frames(frames, correction)
        result, more = _quality(loaded, raw, colours, confidence)
    terminal.show_result(result, said + more, as_json=as_json)


def _quality(
    correction: Correction, raw: FrameFiles, colours: Colours | None, confidence: float
) -> tuple[dict[str, Any], Findings]:
    """Measure spatial over temporal noise of corrected frames, and its parts; of each plane."""
    stack_of("frames", raw)
    # One sum of all pixels at a time, so frames are read twice.
    found, said = _of_good(correction, raw, colours, confidence)
    parts = _of_replaced(correction, raw, colours)
    result = {name: {**figures, **parts[name]} for name, figures in found.items()}
    return result[""] if colours is None else result, said


def _planes(frame: Array, colours: Colours | None) -> dict[str, Array]:
    """Each plane of colour filters by its name, or all pixels under no name."""
    return {"": frame} if colours is None else metrics.planes(frame, colours)


def _each_plane(
    correction: Correction,
    raw: FrameFiles,
    flagged: Flagged,
    colours: Colours | None,
    add: Callable[[str, Array], None],
) -> None:
    """Hand on each plane of each corrected frame by its name."""
    for frame in raw:
        planes = _planes(correction.correct(frame, flagged=flagged), colours)
        for name in [*planes]:
            add(name, planes.pop(name))  # nothing is left of it when the next frame is corrected


def _of_good(
    correction: Correction, raw: FrameFiles, colours: Colours | None, confidence: float
) -> tuple[dict[str, dict[str, Any]], Findings]:
    """C of each plane without flagged pixels and with them, and what noise predicts."""
    flagged, finite = (_planes(each, colours) for each in (~usable(correction.flags), used_in(raw)))
    good: dict[str, Sums] = {}
    bad: dict[str, Sums] = {}

    def add(name: str, plane: Array) -> None:
        if name not in good:
            known = finite[name] & np.isfinite(plane)
            good[name] = Sums(known & ~flagged[name])
            bad[name] = Sums(known[flagged[name]][None])
        good[name].add(plane)
        bad[name].add(plane[flagged[name]][None])

    _each_plane(correction, raw, "keep", colours, add)
    result: dict[str, dict[str, Any]] = {}
    said: Findings = ()
    for name, sums in good.items():
        steady = say(*ask(STEADY, sums.steadiness))
        found = judged(sums, confidence, steady)
        said += steady
        result[name] = {
            "frames": found.frames,
            "pixels": found.pixels,
            "C": found.ratio,
            "C_from": found.low,
            "C_to": found.high,
            **_judged(correction, found, sums),
            "spatial_variance": found.spatial_variance,
            "temporal_variance": found.temporal_variance,
        }
        sums.join(flagged[name], bad[name])
        result[name]["C_with_flagged_pixels"] = judged(sums).ratio
    return result, said


def _of_replaced(
    correction: Correction, raw: FrameFiles, colours: Colours | None
) -> dict[str, dict[str, Any]]:
    """Components of the noise, and roughness, of each plane with flagged pixels replaced."""
    every: dict[str, Sums] = {}
    lost = Counter[str]()

    def add(name: str, plane: Array) -> None:
        lost[name] += int(np.count_nonzero(~np.isfinite(plane)))
        if name not in every:
            every[name] = Sums(np.ones(plane.shape, bool))
        every[name].add(plane)

    _each_plane(correction, raw, "replace", colours, add)
    refuse_lost("frames", lost.total())
    return {
        name: {
            "noise_variances": asdict(components(sums)),
            "roughness": metrics.roughness(sums.mean),
        }
        for name, sums in every.items()
    }


def _judged(correction: Correction, found: Correctability, sums: Sums) -> dict[str, Any]:
    """C that the noise of the response predicts, whether it lies in the interval, what to do."""
    variance = math.nan
    if isinstance(correction, Response):
        variance = pattern_variance(correction, found.level)
    predicted = math.sqrt(variance / found.temporal_variance)
    if math.isnan(predicted):
        words = "not judged: no noise is predicted for this correction (a response without filters)"
    elif found.low > predicted:
        limit = variance + found.temporal_variance / found.frames
        words = "the pattern is above that of noise: " + _cause(correction, sums, limit)
    elif found.high < predicted:
        words = "the pattern is below that of noise: give frames that the fit has not used"
    else:
        words = "the pattern is that of noise"
    return {"C_predicted": predicted, "verdict": words}


def _cause(correction: Correction, sums: Sums, variance: float) -> str:
    """Say what makes a pattern that is above noise of this variance, and what to do."""
    mean = sums.mean[sums.used]
    away = np.abs(mean - median(mean))
    far = away > SIGMAS * ROBUST * median(away)
    odd = int(np.count_nonzero(far))
    # Without these few pixels the rest is as noise has it.
    if odd and np.var(mean[~far]) < variance * (1 + SIGMAS * math.sqrt(2 / sums.mean.size)):
        return f"{odd} pixels far off make it, flag them by equipix nuc defects with these frames"
    if any(each.kind == "misfit" for each in correction.findings):
        return "the curves do not follow the levels (see the findings of the response), fit again"
    return (
        "all pixels share in it, as where offsets have drifted since the fit: renew them by "
        "equipix combine with one point of today (docs/infrared.md, section 3)"
    )
