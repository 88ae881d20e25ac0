"""Studies: tests over many simulated experiments, of which a share is run.

A study bears the marker `study`. It either takes its seeds from the fixture `draws`, or has
parameters. `make test-long` runs a tenth of each, `make study` all of them, and writes the figures
that they hand to the fixture `figure` into a record.
"""

from __future__ import annotations

import math
import subprocess
import zlib
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path

import pytest

HEAD = """# Studies

Tests over many simulated experiments, run whole. `make study` writes this page.
A seed is the number that starts the random numbers of one experiment; n seeds are 0 to n − 1.

{when}, commit {commit}, a share of {share:g} of each study: {passed} passed, {failed} failed.

| study | seeds | figure | wanted | got |
|---|---|---|---|---|
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that say how much of each study is run, and where figures are written."""
    group = parser.getgroup("studies")
    group.addoption("--study-share", type=share, default=0.1, help="share of each study; 1 is all")
    group.addoption("--study-record", type=Path, help="file for the figures of the studies")


def share(word: str) -> float:
    """Read a share of the studies: above 0, at most 1."""
    value = float(word)
    if not 0 < value <= 1:
        raise ValueError(word)
    return value


def taken(count: int, share: float) -> int:
    """Give how many of so many draws a share is: at least one."""
    # A share of 0.1 is slightly above a tenth: 20.000000000000004 draws are 20.
    return max(1, math.ceil(count * share - 1e-9))


def pytest_configure(config: pytest.Config) -> None:
    """Record figures in the process that hands out the tests, if it is asked to."""
    if config.option.study_record and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Record(config.option.study_record, config.option.study_share))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the parameter sets of studies beyond the share.

    Those with the smallest checksums of their names stay: spread over all parameters, and nobody
    chose them.
    """
    sets = defaultdict(list)
    for item in filter(lambda item: item.get_closest_marker("study"), items):
        item.user_properties.append(("study", item.nodeid))
        if "draws" not in item.fixturenames:
            if not hasattr(item, "callspec"):
                raise pytest.UsageError(f"{item.nodeid}: a study has parameters or uses `draws`")
            sets[item.nodeid.partition("[")[0]].append(item)
    left_out = []
    for same in sets.values():
        same.sort(key=lambda item: zlib.crc32(item.nodeid.encode()))
        left_out += same[taken(len(same), config.option.study_share) :]
    items[:] = [item for item in items if item not in set(left_out)]
    config.hook.pytest_deselected(items=left_out)


@pytest.fixture
def draws(request):
    """Seeds of a study: `draws(200)` is `range(200)`, or the first tenth of it in `make test-long`.

    Seeds that follow one another visit all cases of a study that takes turns by `seed % 5`.
    """

    def first(count):
        used = taken(count, request.config.option.study_share)
        request.node.user_properties.append(("draws", used))
        return range(used)

    return first


@pytest.fixture
def figure(request):
    """Record a figure of a study: its name, what was got, what was wanted."""

    def record(name, got, wanted):
        got = got if isinstance(got, str) else f"{got:.4g}"
        request.node.user_properties.append(("figure", (name, str(wanted), got)))

    return record


class Record:
    """The page that holds the figures of all studies of a run."""

    def __init__(self, path: Path, share: float):
        self.path, self.share, self.rows = path, share, []
        self.count = {"passed": 0, "failed": 0, "skipped": 0}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the rows of a study that ended."""
        found = defaultdict(list)
        for key, value in report.user_properties:
            found[key].append(value)
        if "study" in found and (report.when == "call" or not report.passed):
            self.count[report.outcome] += 1
            study = report.nodeid.removeprefix("tests/").replace("|", "\\|")
            seeds = ", ".join(map(str, found["draws"]))
            figures = list(map(tuple, found["figure"]))
            if report.failed or not figures:
                figures.append(("the test", "passed", report.outcome))
            self.rows += [(f"`{study}`", seeds, *each) for each in figures]

    def pytest_sessionfinish(self) -> None:
        """Write the page; nothing, where no study was run."""
        if self.rows:
            when = f"{datetime.now(UTC):%Y-%m-%d}"
            page = HEAD.format(when=when, commit=commit(), share=self.share, **self.count)
            # Workers end in any order.
            rows = [f"| {' | '.join(row)} |\n" for row in sorted(self.rows, key=lambda row: row[0])]
            self.path.write_text(page + "".join(rows), encoding="utf-8")


def commit() -> str:
    """Give the commit of the sources, and whether they differ from it."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"`{made.stdout.strip()}`" if made.returncode == 0 else "unknown"
