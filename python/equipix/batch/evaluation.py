"""What a worker does with one manifest: result, page and row are written whole, the row last."""

import hashlib
import json
import platform
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from inspect import signature
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from equipix._check import LOG, Array, Bools
from equipix._native import __version__
from equipix.calibration.result import Calibration, refuse_partial
from equipix.errors import EquipixError, EquipixWarning, FileError
from equipix.experiment.camera import CameraExperiment
from equipix.experiment.experiment import Experiment
from equipix.experiment.image_files import digest, refuse_changed, sha256_of, state_of
from equipix.experiment.level_experiment import LevelExperiment
from equipix.experiment.manifest import kind_of
from equipix.findings import Finding, Flag
from equipix.io.formats import checked, with_checksum
from equipix.io.paths import write_whole
from equipix.report.camera import camera_checks, camera_parts, figures_of
from equipix.report.figures import summary
from equipix.report.limits import Check, LimitsFile, in_json, verdict_of
from equipix.report.page import page, part_of, write_page
from equipix.shown import Brief

Described = Experiment | LevelExperiment | CameraExperiment

_PLACES = 48
"""Most rows and columns of the map of flagged pixels that a row holds; its parts are as square as
whole pixels allow."""

_FORM = 4
"""Form of a row: a sensor whose row has another one is evaluated again."""


class Job(NamedTuple):
    """One manifest, and what is to be made of it."""

    name: str
    manifest: Path
    output: Path
    suffix: str
    options: Mapping[str, Any]
    limits: LimitsFile
    partial: bool

    def path(self, suffix: str) -> Path:
        """A file of this sensor."""
        return self.output / f"{self.name}{suffix}"


@dataclass(frozen=True)
class Row(Brief):
    """What is known of one sensor of a lot.

    Attributes
    ----------
    sensor, manifest : str
        Its name in the lot, and the file that describes it.
    status : {"done", "kept", "failed"}
        Whether it was evaluated now, had been before, or gave no result.
    reason : str
        Why it failed.
    verdict : str
        PASS or FAIL; nothing where nothing is judged.
    limits : list of dict
        Each figure that is judged, with its limit.
    findings : list of dict
        Kind, severity and message of each.
    figures : dict
        Main figures of the result.
    flagged : dict of str to list of list of float
        For each `equipix.Flag` that occurs: share of such pixels in parts of the sensor, 48 at most
        along each axis.
    result, report : str
        Names of the files in the output folder.
    hashes : dict of str to str
        SHA-256 of each.
    key : str
        Hash of inputs, options, limits and version.
    seconds : float
        How long it took.
    host : str
        The machine that did it.
    """

    sensor: str
    manifest: str
    status: str = "failed"
    reason: str = ""
    verdict: str = ""
    limits: list[dict[str, str]] = field(default_factory=list)
    findings: list[dict[str, str]] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    flagged: dict[str, list[list[float]]] = field(default_factory=dict)
    result: str = ""
    report: str = ""
    hashes: dict[str, str] = field(default_factory=dict)
    key: str = ""
    seconds: float = 0.0
    host: str = ""


def described_by(manifest: Path) -> Described:
    """Read a manifest of any kind."""
    return type_of(manifest).load(manifest)


def type_of(manifest: Path) -> type[Described]:
    """Say what a manifest describes."""
    kinds: dict[str, type[Described]] = {
        "experiment": Experiment,
        "levels": LevelExperiment,
        "camera": CameraExperiment,
    }
    return kinds[kind_of(manifest)]


def options_of(kind: type[Described]) -> set[str]:
    """Keywords of what evaluates a manifest of this kind."""
    if issubclass(kind, CameraExperiment):
        return set()
    return set(signature(kind.run).parameters) - {"self", "mask", "workers", "progress"}


def evaluate(job: Job, workers: int | None = None) -> Row:
    """Evaluate a manifest, unless that was done; what stands in the way is the row's reason."""
    started = time.monotonic()
    row = Row(job.name, str(job.manifest), host=platform.node())
    try:
        described = described_by(job.manifest)
        states = {file: state_of(file) for file in [job.manifest, *described.files()]}
        key = key_of(job, described)
        before = _kept(job, key)
        if before is not None:
            return before
        found = replace(_evaluated(job, described, workers), key=key, host=row.host)
        refuse_changed(states)
        found = replace(found, hashes=_hashes(job, found), seconds=time.monotonic() - started)
        _write(job, found)
    except Exception as error:
        reason, seconds = reason_of(job, error), time.monotonic() - started
        return replace(row, reason=reason, seconds=seconds)
    return found


def reason_of(job: Job, error: Exception) -> str:
    """Why a sensor has no result: one must not stop the others, whatever is wrong with it."""
    if isinstance(error, EquipixError):
        return str(error)
    LOG.error("%s failed", job.name, exc_info=error)
    return f"{type(error).__name__}: {error}"


def key_of(job: Job, described: Described) -> str:
    """Hash of all that the result depends on; the place of the files is not part of it."""
    folder = job.manifest.parent
    hashes = sha256_of([job.manifest, *described.files()])
    inputs = {
        str(file.relative_to(folder) if file.is_relative_to(folder) else file): each
        for file, each in hashes.items()
    }
    known = {
        "version": __version__,
        "form": _FORM,
        "inputs": inputs,
        "options": dict(job.options),
        "partial": job.partial,
        "limits": job.limits.model_dump(),
        "suffix": job.suffix,
    }
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def kept(job: Job, described: Described) -> Row | None:
    """The row of before, if nothing has changed since."""
    return _kept(job, key_of(job, described)) if job.path(".json").exists() else None


def _kept(job: Job, key: str) -> Row | None:
    """The row of before, if it has the same key, and its files are as they were written."""
    row = _before(job)
    if row is None or row.key != key:
        return None
    try:
        if _hashes(job, row) != row.hashes:
            return None
    except OSError:
        return None
    return replace(row, manifest=str(job.manifest), status="kept")


def _hashes(job: Job, row: Row) -> dict[str, str]:
    """SHA-256 of the files of a row."""
    names = [name for name in (row.result, row.report) if name]
    return {name: digest(job.output / name).hex() for name in names}


def _before(job: Job) -> Row | None:
    """The row that was written before."""
    try:
        return Row(**(checked(job.path(".json").read_text()) or {}))
    except (OSError, ValueError, TypeError):
        return None


def refuse_taken(job: Job) -> None:
    """Refuse the name of another sensor, whose manifest is still there.

    Raises
    ------
    FileError
        If the folder holds a row of this name of another manifest.
    """
    before = _before(job)
    if before is None or before.manifest == str(job.manifest):
        return
    if Path(before.manifest).exists():
        raise FileError(
            f"{job.path('.json')}: is that of {before.manifest}, but {job.manifest} has the same "
            "name: choose another folder for one of them"
        )


def _forget(job: Job) -> None:
    """Remove the row, which would stand beside a result that is not its own."""
    job.path(".json").unlink(missing_ok=True)


def _write(job: Job, row: Row) -> None:
    """Write the row, when all that it names is written."""
    with write_whole(job.path(".json"), force=True) as temporary:
        temporary.write_text(with_checksum(asdict(row)))


def _evaluated(job: Job, described: Described, workers: int | None) -> Row:
    """Evaluate a manifest and write its result and its page."""
    with warnings.catch_warnings():
        # The row holds them as findings.
        warnings.simplefilter("ignore", EquipixWarning)
        if isinstance(described, CameraExperiment):
            return _camera(job, described, workers)
        known = options_of(type(described))
        options = {name: value for name, value in job.options.items() if name in known}
        result = described.run(workers=workers, **options)
    output, report = job.path(job.suffix), job.path(".html")
    if isinstance(result, Calibration) and not job.partial:
        refuse_partial(result, output)
    _forget(job)
    result.save(output, force=True)
    part = part_of(job.name, result, job.limits)
    write_page(report, page([part], job.name), force=True)
    size = "{}×{}".format(*result.shape)
    figures = {"size": size, **summary(result)}
    # Each table has the same columns, also of flags that no pixel has.
    figures["flagged_pixels"] = {str(each.name): 0 for each in Flag} | figures["flagged_pixels"]
    row = _row(job, part.checks, result.findings, figures)
    return replace(row, result=output.name, flagged=_flagged(result.flags))


def _camera(job: Job, camera: CameraExperiment, workers: int | None) -> Row:
    """Evaluate a camera; its figures are its result."""
    planes = camera.figures(workers=workers)
    judged = [camera_checks(found, job.limits.camera) for found in planes.values()]
    parts = camera_parts(job.name, planes, judged)
    _forget(job)
    write_page(job.path(".html"), page(parts, job.name), force=True)
    figures = {
        f"{name}.{each.key}" if name else each.key: each.value
        for name, found in planes.items()
        for each in figures_of(found)
    }
    findings = tuple(dict.fromkeys(each for found in planes.values() for each in found.findings))
    return _row(job, [*chain.from_iterable(judged)], findings, figures)


def _row(
    job: Job, checks: list[Check], findings: tuple[Finding, ...], figures: Mapping[str, Any]
) -> Row:
    """What is found of a sensor."""
    counts = {
        f"{name}.{key}": value
        for name, group in figures.items()
        if isinstance(group, Mapping)
        for key, value in group.items()
    }
    numbers = {
        # The table has a column of names of its own.
        "sensor_name" if name == "sensor" else name: (
            None if isinstance(value, float) and not np.isfinite(value) else value
        )
        for name, value in {**figures, **counts}.items()
        if isinstance(value, bool | int | float | str)
    }
    return Row(
        sensor=job.name,
        manifest=str(job.manifest),
        status="done",
        verdict=verdict_of(checks),
        limits=in_json(checks),
        findings=[
            {"kind": each.kind, "severity": each.severity, "message": each.message}
            for each in findings
        ],
        figures=numbers,
        report=job.path(".html").name,
    )


def _flagged(flags: Array) -> dict[str, list[list[float]]]:
    """Share of pixels with each flag that occurs in parts of the sensor."""
    found = {str(flag.name): flags & flag != 0 for flag in Flag}
    return {name: _shares(pixels) for name, pixels in found.items() if pixels.any()}


def _shares(pixels: Bools) -> list[list[float]]:
    side = max(1, max(pixels.shape) / _PLACES)
    rows, cols = (np.linspace(0, n, max(1, round(n / side)) + 1).astype(int) for n in pixels.shape)
    sums = np.add.reduceat(np.add.reduceat(pixels, rows[:-1], 0, int), cols[:-1], 1)
    shares = sums / np.outer(np.diff(rows), np.diff(cols))
    return [[round(float(share), 6) for share in row] for row in shares]
