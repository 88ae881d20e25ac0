"""What readers raise and log about broken files, made into errors that name the file."""

from __future__ import annotations

import logging
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

from equipix.errors import EquipixError, FileError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever a reader raises or logs about a broken file into an error that names it."""
    complaints = _Complaints()
    logger = logging.getLogger("tifffile")
    logger.addHandler(complaints)
    try:
        yield
    except EquipixError:
        raise
    except Exception as error:
        hint = "; pip install 'equipix[codecs]'" if "imagecodecs" in str(error) else ""
        raise FileError(f"{path}: cannot be read: {error}{hint}") from error
    finally:
        logger.removeHandler(complaints)
    if complaints.messages:
        raise FileError(f"{path}: is broken: {complaints.messages[0]}")


class _Complaints(logging.Handler):
    """What tifffile logs instead of raising, such as a last page that it leaves out."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.thread = threading.get_ident()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message."""
        if record.thread == self.thread:
            self.messages.append(record.getMessage())
