"""What the tests share: the folder of real and simulated data, and a run of a command."""

from __future__ import annotations

import functools
import os
import signal
import statistics
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

pytest_plugins = ["studies"]

ROOT = Path(__file__).parents[1]


def pytest_configure() -> None:
    """Give each process of a parallel run one processor, before NumPy counts them.

    Threads of two processes that share two processors mostly wait for each other.
    A run that a script starts in the background ignores Ctrl-C, and its children would as well.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    name = os.environ.get("PYTEST_XDIST_WORKER", "")
    if name and hasattr(os, "sched_setaffinity"):
        processors = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {processors[int(name.removeprefix("gw")) % len(processors)]})


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the shared data; without it the test skips, in CI it fails."""
    folder = Path(os.environ.get("EQUIPIX_TEST_DATA", ROOT / "../shared/data"))
    if not folder.is_dir():
        reason = f"no data folder at {folder}: set EQUIPIX_TEST_DATA"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return folder


@pytest.fixture(scope="session")
def stops_within():
    """Whether a measured number of seconds is below a limit: the first, or the median of three.

    Other work of the machine may delay one of them; what is slow by itself is so in two.
    """

    def check(limit_s, measure):
        first = measure()
        return first < limit_s or statistics.median([first, measure(), measure()]) < limit_s

    return check


@pytest.fixture
def hashing_by_one_thread(monkeypatch):
    """Each thread that hashes a file has a buffer: as many as happen to run would be the peak."""
    one = functools.partial(ThreadPoolExecutor, 1)
    monkeypatch.setattr("equipix.experiment.image_files.ThreadPoolExecutor", one)


@pytest.fixture
def run(capsys):
    """Run a command; its exit status, stdout and stderr."""
    from equipix import cli

    def call(*arguments):
        with pytest.raises(SystemExit) as done:
            cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return done.value.code or 0, captured.out, captured.err

    return call
