"""A page of results: one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix._check import Array, Floats
from equipix._native import __version__
from equipix.calibration.result import Calibration
from equipix.comparison import Comparison
from equipix.errors import EquipixError, InputError
from equipix.experiment.image_files import sha256_of
from equipix.findings import Finding, Flag, usable
from equipix.io import record
from equipix.io.paths import write_whole
from equipix.nuc.response import Response
from equipix.pictures import missing_matplotlib, new_figure
from equipix.report.drawing import (
    CMAPS,
    curves_of,
    draw_flags,
    draw_histogram,
    draw_profiles,
    draw_spectrum,
    limits_of,
)
from equipix.report.figures import COMPARED, pair_in_words, rows_of, summary, words_of
from equipix.report.limits import (
    Check,
    ComparisonLimits,
    Limits,
    LimitsFile,
    checked,
    verdict_of,
)
from equipix.report.maps import Map, difference_maps, flagged, maps_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LARGEST = 480
"""Most rows and columns of a map on a page of one result."""

_CELL = 160
"""The same in a notebook."""

_MOST_LISTED = 200
"""Most flagged pixels that are listed one by one."""

_MOST_BYTES = 15_000_000
"""Most bytes of a page."""

_WORDS = 2**16 - 2
"""Steps between the smallest and the largest value of a map; the word 0 stands for no value."""


class Table(NamedTuple):
    """Rows of words under a title."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    caption: str = ""
    links: Sequence[str] = ()
    """A file behind the first word of each row, or nothing."""


class Part(NamedTuple):
    """What a page says of one result."""

    name: str
    what: str
    findings: tuple[Finding, ...] | None
    checks: list[Check]
    figures: list[tuple[str, str]]
    maps: list[dict[str, Any]]
    plots: list[dict[str, str]]
    tables: list[Table]
    provenance: list[tuple[str, str]]

    @property
    def verdict(self) -> str:
        """PASS or FAIL; nothing where nothing is judged."""
        return verdict_of(self.checks)


def page(parts: list[Part], title: str) -> str:
    """Write the page.

    Raises
    ------
    EquipixError
        If jinja2 is not installed.
    """
    verdicts = {part.verdict for part in parts} - {""}
    return _rendered(
        "page.html",
        title=title,
        version=__version__,
        made=f"{record.now():.16}".replace("T", " ") + " UTC",
        verdict="FAIL" if "FAIL" in verdicts else "PASS" if verdicts else "",
        parts=parts,
    )


def cell(result: Any) -> str:
    """Write what a notebook shows of a result; the errors are those of `page`."""
    first = maps_of(result)[0]
    return _rendered(
        "cell.html",
        what=repr(result).strip("<>"),
        map=mapped(first, _CELL),
        figures=words_of(summary(result)),
        findings=getattr(result, "findings", ()),
    )


def _rendered(template: str, **content: Any) -> str:
    """Fill a template."""
    try:
        from jinja2 import Environment, PackageLoader
    except ImportError as error:
        raise EquipixError(
            "reports need jinja2, which is not installed: pip install 'equipix[report]'"
        ) from error
    loader = PackageLoader("equipix.report", ".")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    return environment.get_template(template).render(**content)


def part_of(name: str, result: Any, limits: LimitsFile, *, share: int = 1) -> Part:
    """Collect what a page says of a result; of `share` results on it maps are smaller."""
    figures, findings = summary(result), getattr(result, "findings", None)
    flags = getattr(result, "flags", None)
    if flags is not None:
        figures["flagged_share"] = float(np.mean(~usable(flags)))
    judged = {"flagged_share": None} | figures
    if math.isnan(figures.get("reduced_chi2", figures.get("variance_of_a_value", 0.0))):
        judged["reduced_chi2"] = None  # no more values than unknowns
    notes = {}
    if isinstance(result, Calibration) and result.sensitivity_std is None:
        notes = dict.fromkeys(("sensitivity_std", "tilt_std"), f"not known ({_why_none(result)})")
    maps = maps_of(result)
    curves = curves_of(result, maps)
    if flags is not None and flags.any():
        curves.insert(0, partial(draw_flags, flags=flags))
    return Part(
        name=name,
        what=repr(result).strip("<>"),
        findings=findings,
        checks=checked(_limits_of(result, limits), judged, findings, notes),
        figures=words_of(figures),
        maps=[mapped(each, int(LARGEST / share**0.5)) for each in maps],
        plots=[*map(drawn, curves)],
        tables=[*_tables(result)],
        provenance=provenance_of(getattr(result, "metadata", {})),
    )


def comparison_checks(
    comparison: Comparison, number: int, findings: Iterable[Finding], limits: ComparisonLimits
) -> list[Check]:
    """Judge a pair, by what noise predicts and by limits."""
    names = ("rms", "block_rms", "largest")
    figures = {name: float(getattr(comparison, name)[number]) for name in names}
    return [
        *(
            Check(
                f"{each.what}, over predicted",
                f"{each.times:.3g}",
                f"{each.low:.3g} to {each.high:.3g}",
                each.passed,
            )
            for each in comparison.checks[number]
        ),
        *checked(limits, figures, findings),
    ]


def comparison_parts(
    comparison: Comparison,
    files: Sequence[Path],
    calibrations: Sequence[Calibration],
    judged: Mapping[str, list[Check]],
) -> list[Part]:
    """Collect what a page says of calibrations that were compared: a part for each pair.

    `judged` has the name and the checks of each.
    """
    parts, largest = [], int(LARGEST / len(comparison.pairs) ** 0.5)
    scatter, hashes = maps_of(comparison)[0], sha256_of(files)
    pairs = zip(comparison.pairs, judged.items(), strict=True)
    for number, ((i, j), (name, checks)) in enumerate(pairs):
        maps = [*difference_maps("Difference", comparison.difference(number)), scatter]
        curves = (draw_histogram, draw_spectrum, draw_profiles)
        findings = tuple(dict.fromkeys(calibrations[i].findings + calibrations[j].findings))
        origins = [(str(files[k]), repr(calibrations[k]).strip("<>")) for k in (i, j)]
        parts.append(
            Part(
                name=name,
                what=f"{comparison.verdicts[number]}.".capitalize(),
                findings=findings,
                checks=checks,
                figures=words_of(summary(comparison), without=("verdicts",)),
                maps=[mapped(each, largest) for each in maps],
                plots=[drawn(partial(draw, shown=maps[0])) for draw in curves],
                tables=[Table("Differences", COMPARED, rows_of(comparison, number))],
                provenance=origins + [(f"sha256 of {files[k]}", hashes[files[k]]) for k in (i, j)],
            )
        )
    return parts


def write_page(path: Path, text: str, *, force: bool) -> None:
    """Write a page to a file; it appears whole or not at all.

    Raises
    ------
    InputError
        If it is larger than browsers and mail take well: then it has too many results.
    """
    content = text.encode("utf-8", "replace")  # names of files need not be UTF-8
    if len(content) > _MOST_BYTES:
        raise InputError(
            f"'{path}' would have {len(content) / 1e6:.1f} MB, at most {_MOST_BYTES / 1e6:.0f}: "
            "write fewer results to a page"
        )
    with write_whole(path, force=force) as temporary:
        temporary.write_bytes(content)


def _limits_of(result: Any, limits: LimitsFile) -> Limits:
    """Limits of the kind of a result."""
    kinds: dict[type, Limits] = {Calibration: limits.calibration, Response: limits.response}
    return kinds.get(type(result), limits.correction)


def mapped(shown: Map, largest: int = LARGEST) -> dict[str, Any]:
    """Picture, values and words of a map."""
    values, step = shown.reduced(largest)
    low, high = limits_of(shown, values, step)
    known = values[np.isfinite(values)]
    ends = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    cmap = CMAPS[shown.scale]
    return {
        "title": shown.name,
        "unit": shown.unit,
        "words": shown.words(step),
        "rows": values.shape[0],
        "cols": values.shape[1],
        "ends": [size * shown.cell for size in shown.values.shape],
        "step": step,
        "low": repr(ends[0]),
        "high": repr(ends[1]),
        "coded": _coded(values, *ends),
        "image": _picture(values, low, high, cmap),
        "bar": _picture(np.linspace(low, high, 256)[None], low, high, cmap),
        "first": f"{low:.4g}",
        "last": f"{high:.4g}",
    }


def _coded(values: Floats, low: float, high: float) -> str:
    """Words of 16 bits, little-endian in base 64: 0 for no value, 1 for the lowest."""
    scale = _WORDS / (high - low) if high > low else 0.0
    words = np.where(np.isfinite(values), 1 + np.rint((values - low) * scale), 0)
    return base64.b64encode(np.nan_to_num(words).astype("<u2").tobytes()).decode()


def _picture(values: Floats, low: float, high: float, cmap: str) -> str:
    """Draw values in colours, as a PNG within an address."""
    try:
        from matplotlib.image import imsave
    except ImportError as error:
        raise missing_matplotlib() from error

    buffer = io.BytesIO()
    imsave(buffer, values, vmin=low, vmax=high, cmap=cmap, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def drawn(draw: Callable[[Axes], None]) -> dict[str, str]:
    """Make a drawing that takes the colour of the text around it."""
    figure = new_figure(5.2, 3.8)
    from matplotlib import rc_context

    axes = figure.subplots()
    draw(axes)
    if (legend := axes.get_legend()) is not None:
        legend.set_frame_on(False)  # its white would hide the text in the dark
    buffer = io.StringIO()
    # Without a salt each drawing has other names inside.
    with rc_context({"svg.hashsalt": "equipix"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace("#000000", "currentColor")
    return {"title": axes.get_title(), "svg": svg}


def _tables(result: Any) -> Iterator[Table]:
    """Shifts, fluxes and flagged pixels, one by one."""
    if isinstance(result, Calibration):
        yield _shifts(result)
        yield _errors(result)
    flags = getattr(result, "flags", None)
    if flags is not None and flags.any():
        yield _flagged(flags)


def _shifts(calibration: Calibration) -> Table:
    """Where the sensor stood, as given or measured and as fitted, and the dark that was taken."""
    metadata = calibration.metadata
    count = len(calibration.shifts)
    names = metadata.get("exposures", [str(number) for number in range(count)])
    measured, stated = (
        metadata.get(name, [None] * count) for name in ("measured_shifts", "measured_shift_std")
    )
    std, darks = calibration.shift_std, metadata.get("darks", [""] * count)
    rows: list[tuple[str, ...]] = [
        (
            str(names[k]),
            "given" if measured[k] is None else pair_in_words(measured[k], stated[k]),
            pair_in_words(calibration.shifts[k], None if std is None else std[k]),
            f"{calibration.rotation[k]}°",
            f"{calibration.flux[k]:.5g}",
            darks[k] or "not known",
        )
        for k in range(count)
    ]
    head = ("Exposure", "Given or measured (row, col)", "Used (row, col)", "Turned", "Flux", "Dark")
    known = 6 if any(darks) else 5
    rows = [row[:known] for row in rows]
    return Table(
        "Exposures", head[:known], rows, "Shifts in pixels, with standard deviations if known."
    )


def _why_none(calibration: Calibration) -> str:
    """Say what gives a calibration the standard deviations that it lacks, or where to see why."""
    failed = any(each.kind == "uncertainty" for each in calibration.findings)
    return "see its findings" if failed else "calibrate with --uncertainty"


def _errors(calibration: Calibration) -> Table:
    """What the error of M is made of, known or not; error bars contain the drift."""
    std, tilt, drift = calibration.sensitivity_std, calibration.tilt_std, calibration.drift
    pixel = of_tilt = ("not known", _why_none(calibration))
    fitted = calibration.metadata["options"]["flux"] in ("fit", "prior")
    why = "the fluxes were fitted" if fitted else "not estimated"
    lamp = ("not known", f"in the tilt; {why}")
    if std is not None:
        variance = np.square(std, dtype=np.float64)
        if drift is not None:
            response = calibration.sensitivity
            variance -= response**2 * drift.variance_map(response)
        noise = np.sqrt(np.maximum(np.nanmedian(variance), 0))
        pixel = (f"{noise:.2g}", "median")
    if tilt is not None:
        variance = np.square(tilt) - np.square(0.0 if drift is None else drift.tilt_std)
        of_tilt = (_pair(np.sqrt(np.maximum(variance, 0))), "edge to edge, along rows and columns")
    if drift is not None:
        size = f"is {drift.size:.2g}" if drift.size else "is smaller than the noise of the fluxes"
        lamp = (_pair(drift.tilt_std), f"in the tilt; the drift {size}")
    rows = [
        ("Noise, of a pixel", *pixel),
        ("Noise, of the tilt", *of_tilt),
        ("Drift of the lamp", *lamp),
    ]
    solver = (
        f"The estimated error that the solver left, {calibration.error_estimate:.2g}, is no "
        "standard deviation."
    )
    return Table("Errors of M by cause", ("Cause", "Standard deviation", "Of what"), rows, solver)


def _pair(values: Floats) -> str:
    return ", ".join(f"{each:.2g}" for each in values)


def _flagged(flags: Array) -> Table:
    """Flagged pixels, one by one: dead and hot ones before those of a mask or of weak light."""
    rows, cols = np.nonzero(flags)
    first = np.argsort((flags[rows, cols] & (Flag.DEAD | Flag.HOT)) == 0, kind="stable")
    rows, cols = rows[first], cols[first]
    listed = [
        (f"{row}, {col}", ", ".join(_names(int(flags[row, col]))))
        for row, col in zip(rows[:_MOST_LISTED], cols[:_MOST_LISTED], strict=True)
    ]
    counts = ", ".join(f"{_words(flag)} {len(at)}" for flag, (at, _) in flagged(flags).items())
    left = f" {_MOST_LISTED} of {len(rows)} are listed." if len(rows) > _MOST_LISTED else ""
    return Table("Flagged pixels", ("Row, column", "Flags"), listed, f"{counts}.{left}")


def _names(bits: int) -> list[str]:
    return [_words(flag) for flag in Flag if bits & flag]


def _words(flag: Flag) -> str:
    return (flag.name or "").replace("_", " ").lower()


def _text(value: Any) -> str:
    """Write a value of the metadata, lists of them with commas between."""
    if isinstance(value, list):
        inner = (f"({_text(each)})" if isinstance(each, list) else _text(each) for each in value)
        return ", ".join(inner) or "none"
    words = {None: "none", True: "yes", False: "no"}
    return words[value] if value is None or isinstance(value, bool) else str(value)


def provenance_of(metadata: Mapping[str, Any], above: str = "") -> list[tuple[str, str]]:
    """Entries of the metadata by their places, those of tables within tables one by one."""
    found: list[tuple[str, str]] = []
    for key, value in metadata.items():
        name = f"{above}{key.replace('_', ' ')}"
        if isinstance(value, Mapping):
            found += provenance_of(value, f"{name}: ")
        elif isinstance(value, list) and any(isinstance(each, Mapping) for each in value):
            entries = {f"{number}": each for number, each in enumerate(value, start=1)}
            found += provenance_of(entries, f"{name} ")
        else:
            found.append((name, _text(value)))
    return found
