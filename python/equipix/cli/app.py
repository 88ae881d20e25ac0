"""The command line: it parses and prints, the work is done elsewhere."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from equipix._native import __version__
from equipix._types import Flagged, FluxModel, Method
from equipix.calibration.calibrate import Calibration
from equipix.cli.terminal import check_output, progress_bars, say, show_result, show_warning
from equipix.comparison import compare as compare_calibrations
from equipix.correction.files import correct_files, is_folder
from equipix.correction.protocol import Correction
from equipix.demo import run_demo, virtual_experiment
from equipix.errors import EquipixError, EquipixWarning, InputError
from equipix.experiment.run import Experiment
from equipix.flags import Flag
from equipix.frames import average as average_frames
from equipix.frames import save_statistics
from equipix.io import SUFFIXES, find_files, refuse_inputs
from equipix.loading import load, load_calibration
from equipix.pictures.canvas import check_picture, save_figure
from equipix.pictures.comparison import draw_comparison
from equipix.pictures.demo import draw_demo
from equipix.pictures.plans import draw_plans
from equipix.plan import ErrorBudget, advise_order, error_budget, identify, suggest, trend_told

app = typer.Typer(
    name="equipix",
    help="Pixel sensitivity of image sensors, measured without a uniform light source.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Force = Annotated[bool, typer.Option("--force", help="Replace an existing output.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Threads; all processors unless given.")]
Tolerance = Annotated[float, typer.Option(help="Largest relative error of the sensitivity.")]
MaxSweeps = Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")]
Uncertainty = Annotated[
    bool, typer.Option("--uncertainty", help="Find the standard deviation of every pixel.")
]
Saturation = Annotated[
    float | None, typer.Option(help="Saturation level in DN; the largest value unless given.")
]
Picture = Annotated[
    Path | None, typer.Option("--output", "-o", help="A picture: .png, .pdf or .svg.")
]
Seed = Annotated[int, typer.Option("--rng", min=0, help="Seed of the random numbers.")]
Shape = Annotated[
    tuple[int, int], typer.Option(min=48, help="Rows and columns of the sensor, 48 or more.")
]


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit status is 0, 1 (failed), 2 (usage) or 130 (Ctrl-C)."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", EquipixWarning)
        warnings.showwarning = show_warning
        try:
            app(arguments, prog_name="equipix")
        except (EquipixError, OSError, MemoryError) as error:
            say("error", error or type(error).__name__)
            raise SystemExit(1) from None


def _show_version(wanted: bool) -> None:
    if wanted:
        print(__version__)  # noqa: T201
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None: ...


@app.command(epilog="Example: equipix calibrate experiment.toml -o cal.tif")
def calibrate(
    experiment: Annotated[Path, typer.Argument(help="The experiment.toml.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration: .tif or .npz.")],
    robust: Annotated[
        bool, typer.Option("--robust", help="Leave out measurements that disagree with the others.")
    ] = False,
    method: Annotated[
        Method, typer.Option(help="How to solve: fast, or as the paper does.")
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


@app.command(epilog="Example: equipix inspect cal.tif")
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
    """Collect what one wants to know first of a calibration."""
    sensitivity = calibration.sensitivity
    options = calibration.metadata.get("options", {})
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
        "fluxes": options.get("flux", "known"),
        "flagged_pixels": _flagged(calibration),
    }


def _misfit_name(options: dict[str, Any]) -> str:
    """What the mean square residual is: without variances to measure it by, one in DN²."""
    return "variance_of_a_value" if options.get("weights") == "equal" else "reduced_chi2"


def _uncertainty(calibration: Calibration) -> dict[str, Any]:
    """What noise leaves uncertain, if it was asked for, and how exact that is."""
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


@app.command(epilog="Example: equipix compare first.tif second.tif -o agreement.png")
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
    table = Table(
        "relative difference", "pixels, rms", "16×16 means, rms", "largest", box=SIMPLE_HEAD
    )
    for pair in pairs:
        table.add_row(" − ".join(pair["files"]), *(f"{pair[name]:.2e}" for name in figures))
    Console(soft_wrap=True).print(table)


@app.command(epilog="Example: equipix average frames/*.png --dark 'dark/*.png' -o mean.tif")
def average(
    source: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Statistics: .tif or .npz.")],
    dark: Annotated[list[str] | None, typer.Option(help="Dark frames, to be subtracted.")] = None,
    saturation: Saturation = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Mean and variance of every pixel over many frames."""
    check_output(output, force=force, suffixes=SUFFIXES)
    refuse_inputs([output], find_files([*source, *(dark or [])]))
    with progress_bars() as progress:
        offset = None
        if dark:
            offset = average_frames(dark, saturation=saturation, workers=workers, progress=progress)
        frames = average_frames(
            source, dark=offset, saturation=saturation, workers=workers, progress=progress
        )
    save_statistics(output, frames, force=force)
    result = {
        "output": str(output),
        "shape": list(frames.mean.shape),
        "frames": int(frames.count.max()),
        "mean": float(frames.mean.mean()),
        "variance": float(frames.variance.mean()),
        "saturated_pixels": int(np.count_nonzero(frames.saturated)),
    }
    show_result(result, as_json=as_json)


@app.command(epilog="Example: equipix correct cal.tif raw/*.tif -o corrected/")
def correct(
    calibration: Annotated[Path, typer.Argument(help="A calibration: .tif or .npz.")],
    frames: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="A .tif of all frames, or a folder of files.")
    ],
    dark: Annotated[
        str, typer.Option(help="'stored', 'none', or a file: dark frames or their average.")
    ] = "stored",
    flagged: Annotated[Flagged, typer.Option(help="What flagged pixels become.")] = "nan",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Divide frames by the sensitivity, their dark level subtracted."""
    check_output(output, force=force, folder=is_folder(output))
    refuse_inputs([output], [calibration])
    with progress_bars() as progress:
        done = correct_files(
            load(calibration),
            frames,
            output,
            dark=dark,
            flagged=flagged,
            force=force,
            progress=progress,
        )
    show_result({"output": str(output), "frames": done}, as_json=as_json)


@app.command(epilog="Example: equipix simulate --shape 240 320 --frames 20 -o experiment")
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to make.")],
    shape: Shape = (240, 320),
    frames: Annotated[int, typer.Option(min=1, help="Frames of an exposure.")] = 20,
    bit_depth: Annotated[int, typer.Option(min=8, max=16, help="Bits of the ADC.")] = 12,
    rng: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the images of an experiment with a virtual camera, and its truth."""
    check_output(output, force=force, folder=True)
    virtual = virtual_experiment(shape, frames=frames, bit_depth=bit_depth, rng=rng)
    with progress_bars() as progress:
        manifest = virtual.write(output, force=force, progress=progress)
    show_result({"experiment": str(manifest), "shape": list(shape)}, as_json=as_json)


@app.command(epilog="Example: equipix demo -o demo.png")
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png, .pdf or .svg.")
    ] = Path("equipix-demo.png"),
    shape: Shape = (582, 782),
    frames: Annotated[int, typer.Option(min=2, help="Frames of an exposure.")] = 40,
    rng: Seed = 1,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to make for the images, which else go away.")
    ] = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Calibrate a simulated CCD from image files and compare with the truth and a flat field."""
    check_picture(output)
    check_output(output, force=force)
    if keep is not None:
        check_output(keep, force=force, folder=True)
    with (
        tempfile.TemporaryDirectory(prefix="equipix-") as scratch,
        progress_bars(announce=True) as progress,
    ):
        folder = keep or Path(scratch) / "experiment"
        result = run_demo(
            folder,
            shape=shape,
            frames=frames,
            workers=workers,
            progress=progress,
            rng=rng,
            force=force,
        )
    save_figure(draw_demo(result), output, force=force)
    figures = {"picture": str(output), **result.figures()}
    if as_json:
        show_result(figures, as_json=True)
    else:
        _show_demo(figures)
    if not result.passed:
        raise EquipixError("the errors are larger than the noise explains")


def _show_demo(figures: dict[str, Any]) -> None:
    """Print the demo's errors beside what the noise predicts."""
    table = Table("rms error of the sensitivity", "pixels", "16×16 means", box=SIMPLE_HEAD)
    for title, prefix in (
        ("noise predicts", "predicted_"),
        ("shift calibration", ""),
        ("flat field, source uneven by 1 %", "flat_field_"),
    ):
        errors = (figures[f"{prefix}rms"], figures[f"{prefix}block_rms"])
        table.add_row(title, *(f"{error:.2e}" for error in errors))
    Console(soft_wrap=True).print(table)
    names = ("sweeps", "converged", "error_estimate", "passed", "picture")
    show_result({name: figures[name] for name in names}, as_json=False)


@app.command(
    epilog="Example: equipix plan --shape 582 782 --shifts '0,0 0,11 0,19 11,0 19,0' --drift 1e-4. "
    "To find one: equipix plan --shape 582 782 --exposures 5 --max-shift 80 80"
)
def plan(
    shape: Annotated[tuple[int, int], typer.Option(min=1, help="Rows and columns of the sensor.")],
    shifts: Annotated[
        str | None, typer.Option(help="The pattern to judge: 'row,col row,col …' in pixels.")
    ] = None,
    max_shift: Annotated[
        tuple[int, int] | None,
        typer.Option(min=0, help="Find patterns within this travel (row, col), in pixels."),
    ] = None,
    exposures: Annotated[
        int | None, typer.Option(min=2, help="Of the patterns to find; the fewest unless given.")
    ] = None,
    noise: Annotated[float, typer.Option(help="Noise of an exposure, over its signal.")] = 1e-3,
    drift: Annotated[
        float | None,
        typer.Option(help="Unknown relative change of the lamp; noise/10 unless given."),
    ] = None,
    shift_error: Annotated[float, typer.Option(help="Error of a shift, in pixels.")] = 0,
    beam_width: Annotated[
        float | None, typer.Option(help="Width of a Gaussian beam in pixels; even unless given.")
    ] = None,
    rng: Seed = 0,
    output: Picture = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Say what errors a pattern of shifts will leave, or find better patterns."""
    if (shifts is None) == (max_shift is None):
        raise InputError("give either --shifts, to judge a pattern, or --max-shift, to find some")
    if output is not None:
        check_picture(output)
        check_output(output, force=force)
    causes: dict[str, Any] = {
        "noise": noise,
        "shift_error": shift_error,
        "beam_width": beam_width,
    }
    if shifts is not None:
        assumed = noise / 10 if drift is None else drift
        budgets = [error_budget(shape, _pairs(shifts), drift=assumed, **causes)]
    elif max_shift is not None:
        with progress_bars() as progress:
            found = suggest(
                shape, exposures, max_shift, drift=drift, rng=rng, progress=progress, **causes
            )
        budgets = [suggestion.budget for suggestion in found]
    if output is not None:
        save_figure(draw_plans(budgets), output, force=force)
    plans = [_plan_summary(budget) for budget in budgets]
    if as_json:
        result = {"shape": list(shape), "patterns": plans}
        show_result(result | ({"picture": str(output)} if output else {}), as_json=True)
    else:
        _show_plans(plans)


def _pairs(text: str) -> list[list[float]]:
    """Parse 'row,col row,col'."""
    try:
        pairs = [[float(part) for part in pair.split(",")] for pair in text.split()]
    except ValueError:
        pairs = []
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise InputError(f"'--shifts' is {text!r}, expected pairs such as '0,0 0,11 0,19'")
    return pairs


def _plan_summary(budget: ErrorBudget) -> dict[str, Any]:
    """Collect the figures of a pattern."""
    found = identify(budget.shape, budget.shifts)
    order = advise_order(budget.shifts)
    return {
        "shifts": budget.shifts.tolist(),
        "components": found.components,
        "largest": found.largest,
        "equations": found.equations,
        "unknowns": found.unknowns,
        "rms": budget.rms,
        "rms_by_cause": budget.rms_by_cause,
        "tilt_by_cause": {name: list(tilt) for name, tilt in budget.tilt_by_cause.items()},
        "worst_wave": list(budget.spectrum.worst),
        "smallest_eigenvalue": budget.spectrum.smallest,
        "trend_told": budget.trend_told,
        "order": order.tolist(),
        "trend_told_in_order": trend_told(budget.shifts[order]),
    }


def _show_plans(plans: list[dict[str, Any]]) -> None:
    """Print the patterns' figures side by side."""
    table = Table(
        "rms error of the sensitivity",
        *(f"pattern {k + 1}" for k in range(len(plans))),
        box=SIMPLE_HEAD,
    )
    rows = {
        "all causes": lambda p: f"{p['rms']:.2e}",
        "noise": lambda p: f"{p['rms_by_cause']['noise']:.2e}",
        "tilt from lamp drift": lambda p: f"{p['rms_by_cause']['drift']:.2e}",
        "shift errors": lambda p: f"{p['rms_by_cause']['shift_error']:.2e}",
        "parts that nothing compares": lambda p: str(p["components"]),
        "equations / unknowns": lambda p: f"{p['equations']} / {p['unknowns']}",
        "worst wave, cycles per pixel": lambda p: "({:.3f}, {:.3f})".format(*p["worst_wave"]),
        "λ of it": lambda p: f"{p['smallest_eigenvalue']:.3f}",
        "linear trend told from tilt": lambda p: f"{p['trend_told']:.1%}",
        "  in the order advised": lambda p: f"{p['trend_told_in_order']:.1%}",
    }
    for name, words in rows.items():
        table.add_row(name, *map(words, plans))
    console = Console(soft_wrap=True)
    console.print(table)
    for k, found in enumerate(plans):
        shifts = " ".join(f"{row:g},{col:g}" for row, col in _ordered(found))
        console.print(f"pattern {k + 1}, in the order advised: {shifts}")


def _ordered(found: dict[str, Any]) -> list[list[float]]:
    return [found["shifts"][k] for k in found["order"]]
