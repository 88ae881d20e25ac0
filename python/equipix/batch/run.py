"""All manifests of a lot, on the workers of a cluster."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from os import PathLike
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, get_args

from equipix._check import LOG, FluxModel, Progress, check_type, check_word, positive_workers
from equipix.batch.cluster import LOCAL, Task, finished
from equipix.batch.evaluation import (
    Job,
    Row,
    described_by,
    evaluate,
    kept,
    options_of,
    reason_of,
    refuse_taken,
    type_of,
)
from equipix.batch.lot import LOT, Lot, refuse_no_table
from equipix.batch.memory import bytes_needed
from equipix.errors import EquipixError, FileError, InputError
from equipix.experiment.experiment import Experiment
from equipix.experiment.level_experiment import LevelExperiment
from equipix.exposures.exposures import FitOptions
from equipix.io.formats import SUFFIXES
from equipix.io.paths import as_path, writing
from equipix.nuc.order import check_order
from equipix.report.limits import read_limits

_OPTIONS = options_of(Experiment) | options_of(LevelExperiment)


def run(
    manifests: Iterable[str | PathLike[str]],
    output: str | PathLike[str],
    *,
    scheduler: str | None = None,
    limits: str | PathLike[str] | None = None,
    suffix: str = ".tif",
    partial: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Lot:
    """Evaluate many manifests, each on one worker of a cluster.

    Parameters
    ----------
    manifests : iterable of path
        Each an experiment.toml, levels.toml or camera.toml. All workers must see them, and their
        files, under the same names.
    output : path
        Folder of the results, made where it is not there. All workers must see it.
    scheduler : str, optional
        Address of a scheduler of dask.distributed, such as ``tcp://host:8786``. Unless given, and
        for "local", as many worker processes run on this machine as processors and memory allow.
    limits : path, optional
        A limits.toml, by which each result is judged.
    suffix : str
        Format of the results, as in ``save``.
    partial : bool
        Whether to write calibrations that determine less than half of the pixels; they have failed
        unless it is set.
    workers : int, optional
        Number of worker processes on this machine.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly.
    **options
        Keywords of `Experiment.run` and `LevelExperiment.run`; each goes to the manifests of its
        kind.

    Returns
    -------
    Lot
        A row for each manifest, also for those that failed.

    Raises
    ------
    InputError
        If an option is unknown or has a wrong value, a manifest is named twice, or `suffix` is no
        format.
    FileError
        If `output` or `limits` cannot be used, or `output` holds another sensor of the same name.
    EquipixError
        If dask.distributed or pyarrow is not installed, or the scheduler cannot be reached.

    Notes
    -----
    The name of a sensor is the folder of its manifest. Where two would have one name, or one would
    be named ``lot``, all get the name of the file or of folders above too. A worker writes the
    result, then a page, then ``NAME.json``, each whole or not at all. A sensor whose JSON file has
    the hash of its inputs, options, limits and version, and the hashes of its result and its page,
    is kept as it is: a lot that was interrupted goes on where it was. Nothing but rows travels
    through the scheduler. A worker takes a sensor when the memory for it is free. Where no worker
    has the memory for any that waits, an `InputWarning` says so within a minute, and the lot waits
    for others. Dask logs nothing in this process meanwhile.
    """
    if unknown := sorted(set(options) - _OPTIONS):
        known = ", ".join(sorted(_OPTIONS))
        raise InputError(f"'{unknown[0]}' is no option of a manifest, expected one of {known}")
    _check_options(options)
    check_type("suffix", suffix, str, "a text such as .tif")
    check_word("suffix", suffix.lower(), SUFFIXES)
    positive_workers(workers)
    wanted = read_limits(None if limits is None else as_path("limits", limits))
    folder = as_path("output", output).absolute()  # workers may run elsewhere
    jobs = [
        Job(name, manifest, folder, suffix, options, wanted, partial)
        for name, manifest in _named([as_path("manifests", each) for each in manifests]).items()
    ]
    _refuse_idle(options, jobs)
    for job in jobs:
        refuse_taken(job)
    refuse_no_table(folder)
    _refuse_as_output(folder)
    at = None if scheduler == LOCAL else scheduler
    found: dict[str, Row] = {}
    for row in _rows(jobs, at, workers, progress):
        found[row.sensor] = row
        LOG.info("%s: %s", row.sensor, row.reason or row.status)
    lot = Lot(tuple(found[job.name] for job in jobs))
    lot.save(folder)
    return lot


def _check_options(options: Mapping[str, Any]) -> None:
    """Refuse wrong values of options before any sensor is evaluated."""
    fit = {each.name: options.get(each.name, each.default) for each in fields(FitOptions)}
    FitOptions.of(**fit)
    if options.get("flux") is not None:
        check_word("flux", options["flux"], get_args(FluxModel))
    check_order(options.get("order", 1), options.get("by", "offset"))


def _refuse_idle(options: Mapping[str, Any], jobs: list[Job]) -> None:
    """Refuse an option that none of the manifests takes."""
    if not options:
        return
    try:
        kinds = {type_of(job.manifest): job.manifest.name for job in jobs}
    except (EquipixError, OSError):
        return  # a row will say what is wrong with the manifest
    if idle := sorted(options.keys() - {name for kind in kinds for name in options_of(kind)}):
        names = ", ".join(sorted(set(kinds.values())))  # one manifest of each kind
        raise InputError(f"'{idle[0]}' is no option of {names}: leave it out")


def _named(manifests: list[Path]) -> dict[str, Path]:
    """Manifests by short names: that of the folder, with that of the file where needed."""
    files = [Path(os.path.realpath(file)) for file in manifests]  # resolve() refuses loops of links
    if not files:
        raise InputError("'manifests' is empty: name the experiment.toml of each sensor")
    if twice := [str(file) for file, count in Counter(files).items() if count > 1]:
        raise InputError(f"'{twice[0]}' is named twice: name each manifest once")
    for parts in range(1, max(len(file.parts) for file in files)):
        for own in (False, True):
            names = ["-".join([*file.parent.parts[-parts:], *[file.stem] * own]) for file in files]
            if len(set(names)) == len(files) and LOT not in names:
                return dict(sorted(zip(names, files, strict=True)))
    raise InputError("two manifests differ by the letter / alone: rename a folder")


def _refuse_as_output(folder: Path) -> None:
    """Make the folder of results; refuse one that cannot be made or written to."""
    with writing(folder):
        for place in (folder, *folder.parents):
            if place.exists() and not place.is_dir():
                raise FileError(f"{place}: is a file, expected a folder for the results")
        folder.mkdir(parents=True, exist_ok=True)
        # Without a name, so that a kill leaves nothing; hidden where the system has no such files.
        TemporaryFile(dir=folder, prefix=".").close()


def _rows(
    jobs: list[Job], scheduler: str | None, workers: int | None, progress: Progress | None
) -> Iterator[Row]:
    """The row of each job, as workers finish them."""
    tasks, done = [], 0
    if progress is not None:
        progress(done, len(jobs), "sensors")
    for job in jobs:
        try:
            described = described_by(job.manifest)
            # Workers of a cluster look for themselves: they hash inputs side by side.
            before = kept(job, described) if scheduler is None else None
            if before is not None:
                done += 1
                yield before
            else:
                tasks.append(Task(job, bytes_needed(described, job.options)))
        except Exception as error:
            done += 1
            yield Row(job.name, str(job.manifest), reason=reason_of(job, error))
    for task, found in finished(evaluate, tasks, scheduler, workers):
        done += 1
        if progress is not None:
            progress(done, len(jobs), "sensors")
        job = task.job
        yield found if isinstance(found, Row) else Row(job.name, str(job.manifest), reason=found)
