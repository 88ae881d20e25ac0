"""Tasks on the workers of dask.distributed, each when the memory for it is free."""

import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from threading import Lock
from typing import Any, NamedTuple, TypeVar

from equipix.errors import EquipixError
from equipix.findings import Finding, say

_Result = TypeVar("_Result")

LOCAL = "local"
"""In the place of a scheduler's address: worker processes on this machine."""

_MEMORY = "equipix-memory"
"""The resource of dask that workers have as many of as bytes."""

_SHARE = 0.9
"""Share of a machine's free memory that its workers may take."""

_ROUNDS = 4
"""Times that jobs are sent, if the scheduler ends meanwhile."""

_TIMEOUT_S = 30

_POLL_S = 0.05

_START = f"start one with 'dask worker ADDRESS --resources {_MEMORY}=BYTES'"


class Task(NamedTuple):
    """A job, which has a name of its own, and the bytes that it needs at the peak."""

    job: Any
    memory: int


def finished(
    work: Callable[[Any, int | None], _Result],
    tasks: list[Task],
    scheduler: str | None,
    workers: int | None,
) -> Iterator[tuple[Task, _Result | str]]:
    """Each task with its result, or with the reason why there is none, as workers finish them."""
    left = {task.job.name: task for task in sorted(tasks, key=lambda task: -task.memory)}
    if not left:
        return
    most = max(task.memory for task in tasks)
    with scheduler_at(scheduler, [task.memory for task in tasks], workers) as address:
        reason = f"the scheduler ended {_ROUNDS} times"
        for number in range(_ROUNDS):
            if not left:
                return
            try:
                with _client(address) as client:
                    largest = _largest(client, 0 if scheduler is None else most)
                    for task, found in _round(client, work, [*left.values()], largest):
                        del left[task.job.name]
                        yield task, found
            except EquipixError as error:
                if not number:
                    raise
                reason = f"the scheduler ended: {error}"
                break
    for task in left.values():
        yield task, reason


def _round(
    client: Any, work: Callable[[Any, int | None], _Result], tasks: list[Task], largest: int
) -> Iterator[tuple[Task, _Result | str]]:
    """Tasks that are finished until the scheduler ends."""
    from distributed import KilledWorker, as_completed

    sent: dict[Any, Task] = {}

    def send(task: Task) -> Any:
        resources = {_MEMORY: task.memory}
        future = client.submit(_on_worker, work, task.job, pure=False, resources=resources)
        sent[future] = task
        return future

    for task in tasks:
        if task.memory > largest:
            yield (
                task,
                f"needs {task.memory / 1e9:.1f} GB, and the largest worker has "
                f"{largest / 1e9:.1f} GB: give a worker more memory, or bin the frames",
            )
    left = as_completed([send(task) for task in tasks if task.memory <= largest])
    suspects: list[Task] = []
    is_alone = False
    for future in _ended(client, left, sent):
        task = sent.pop(future)
        found = _fetched(future)
        if found:
            yield task, found[0]
        elif future.status == "cancelled":
            return  # the scheduler ended; the next round keeps what is written whole
        elif future.status != "error":  # the process that held the result ended: it is made again
            sent[future] = task
            left.add(future)
        elif isinstance(future.exception(), KilledWorker) and not is_alone:
            # Dask blames all tasks that wait where a process ends: each is tried alone.
            suspects.append(task)
        else:
            yield task, _in_words(future.exception())
        if suspects and not sent:
            is_alone = True
            left.add(send(suspects.pop()))


def _fetched(future: Any) -> list[Any]:
    """The result of a future; none where it has none, or loses it meanwhile."""
    from distributed import CancelledError, KilledWorker

    if future.status == "finished":
        with suppress(CancelledError, KilledWorker):
            return [future.result()]
    return []


def _ended(client: Any, left: Any, sent: dict[Any, Task]) -> Iterator[Any]:
    """Futures as they end; where no worker that is left has the memory for one, it warns."""
    asked, without = time.monotonic(), 0
    while not left.is_empty():
        yield from left.next_batch(block=False)
        time.sleep(_POLL_S)
        if not sent or time.monotonic() - asked < _TIMEOUT_S / 2:
            continue
        asked = time.monotonic()
        least = min(task.memory for task in sent.values())
        try:
            without = 0 if _declared(client) >= least else without + 1
        except (OSError, AttributeError):  # the scheduler ended, and so will the futures
            continue
        if without == 2:  # not while one is just started again
            words = f"there is no worker of {least / 1e9:.1f} GB for {len(sent)} tasks, which wait"
            say(Finding("workers", f"{words}: {_START}", "input"))


def _in_words(error: BaseException) -> str:
    """Why a worker gave no result."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return (
            "each process that worked on it ended, perhaps for lack of memory: give a worker more "
            "memory, or bin the frames"
        )
    return f"the worker ended with {type(error).__name__}: {error}"


def _wait(client: Any) -> None:
    """Wait until there is a worker."""
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT_S)
    except TimeoutError as error:
        raise EquipixError(f"no worker came within {_TIMEOUT_S} s: {_START}") from error


_ALONE = Lock()


def _on_worker(work: Callable[[Any, int | None], _Result], job: Any) -> _Result:
    """Do the work with as many threads as the worker has, and no other work in its process."""
    from distributed import get_worker

    with _ALONE:
        return work(job, get_worker().state.nthreads)


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    """A client of the scheduler; what it would log is the reason of a task, or a warning."""
    distributed = _distributed()
    try:
        client = distributed.Client(scheduler, timeout=f"{_TIMEOUT_S}s")
    except (OSError, ValueError) as error:
        raise EquipixError(
            f"the scheduler '{scheduler}' cannot be reached ({error}): name it as "
            "tcp://HOST:PORT, and see that it runs"
        ) from error
    with distributed.utils.silence_logging_cmgr(logging.CRITICAL), client:
        yield client


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise EquipixError(
            "a cluster needs dask.distributed, which is not installed: pip install 'equipix[batch]'"
        ) from error
    return distributed


SETTINGS = {
    # Some seconds after a worker was lost, the cluster ends one of its name for good if it is just
    # being started again: one that is killed twice.
    "distributed.deploy.lost-worker-timeout": "1 day",
    # A worker would give each array back to the system, and wait for new pages a third of its time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
}
"""Of dask, for a cluster on this machine; docs/batch.md has those for others."""


@contextmanager
def scheduler_at(
    scheduler: str | None, memory: Sequence[int], workers: int | None = None
) -> Iterator[str]:
    """Address of the scheduler, or of a cluster on this machine for tasks of so many bytes."""
    if scheduler is not None:
        yield scheduler
        return
    distributed, free = _distributed(), _free_memory()
    import dask
    from dask.system import CPU_COUNT

    fitting = [each for each in memory if each <= free] or [free]
    most = workers or min(CPU_COUNT, free // max(fitting))
    count = max(1, min(most, len(memory)))
    with dask.config.set(SETTINGS), ExitStack() as stack:
        with _sigint_blocked():
            cluster = distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=max(1, CPU_COUNT // count),
                processes=True,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,  # what ends a worker is the reason of its task
                resources={_MEMORY: free // count},
            )
            stack.enter_context(cluster)
        yield cluster.scheduler_address


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """What starts here gets no SIGINT: it is for the caller, who ends all that has started."""
    resource_tracker.ensure_running()  # would take the signal off the mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _free_memory() -> int:
    """Bytes that the workers of this machine may take."""
    import psutil
    from distributed.system import MEMORY_LIMIT  # of the machine or its control groups

    return int(_SHARE * min(psutil.virtual_memory().available, MEMORY_LIMIT))


def _largest(client: Any, wanted: int) -> int:
    """Bytes of the largest worker, once one has as many as wanted, or none has come for long."""
    _wait(client)
    end = time.monotonic() + _TIMEOUT_S
    while largest := _declared(client):
        if largest >= wanted or time.monotonic() > end:
            return largest
        time.sleep(0.5)
    # A worker that a nanny starts again has what it was started with, and nothing else.
    raise EquipixError(f"no worker declares its memory: {_START}, such as {_MEMORY}=16e9")


def _declared(client: Any) -> int:
    """Bytes of the largest worker that is there; 0 where none declares them."""
    workers = client.sync(client.scheduler.identity, n_workers=-1)["workers"].values()
    return max((int(each["resources"].get(_MEMORY, 0)) for each in workers), default=0)
