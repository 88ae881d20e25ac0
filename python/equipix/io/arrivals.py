"""Waiting for new files in a folder."""

import time
from contextlib import suppress
from pathlib import Path
from threading import Event

try:
    import watchfiles
except ImportError:  # the extra is not installed
    watchfiles = None  # type: ignore[assignment]

_POLLED = 0.5
"""Seconds between two looks without a library that hears of changes."""


def wait_for_change(folder: Path, seconds: float) -> None:
    """Wait until something changes in a folder or below it, or some seconds have passed.

    Parameters
    ----------
    folder : Path
        The folder.
    seconds : float
        How long at most: the system reports no change on some network folders, nor one between
        two calls. The caller looks at the files in any case.
    """
    if watchfiles is None:
        time.sleep(min(seconds, _POLLED))
        return
    # Changes that cannot be reported, as with too many watches, leave polling.
    with suppress(OSError, RuntimeError):
        changes = watchfiles.watch(
            folder,
            debounce=50,
            step=20,
            stop_event=Event(),
            rust_timeout=int(1000 * seconds),
            yield_on_timeout=True,
        )
        next(changes, None)
        changes.close()
        return
    time.sleep(min(seconds, _POLLED))
