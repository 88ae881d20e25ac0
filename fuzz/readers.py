"""Random files for the readers in Python: readers.py NAME, and flags of libFuzzer.

An exception that is none of the package's own, or whose message does not name the file, ends it.
So does memory beyond what the largest of so small files needs.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

import atheris

NAME = sys.argv[1]

WATCHED = {
    "npz": ["numpy.lib", "zipfile"],
    "hex": [],
    "bin": [],
    "fits": ["astropy.io.fits"],
    "toml": ["tomllib"],
}
"""Modules that count what they run, beside equipix."""

MEMORY = 64 << 20
"""Most bytes that one file may add to the memory of the process."""

with atheris.instrument_imports(include=["equipix", *WATCHED[NAME]]):
    import equipix
    from equipix.batch.evaluation import described_by
    from equipix.errors import EquipixError
    from equipix.io.frames import header, read_frames
    from equipix.report.limits import read_limits

READERS = {
    "npz": [equipix.load],
    "hex": [equipix.load],
    "bin": [equipix.load],
    "fits": [equipix.load, header, read_frames],
    "toml": [described_by, read_limits],
}


def used() -> int:
    """Largest memory of the process so far, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def read(data: bytes) -> None:
    """Read a file of these bytes."""
    FILE.write_bytes(data)
    before = used()
    for reader in READERS[NAME]:
        try:
            reader(FILE)
        except EquipixError as error:
            if FILE.name not in str(error):
                raise
    if used() - before > MEMORY:
        raise MemoryError(f"{used() - before} bytes for a file of {len(data)}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        FILE = Path(folder) / f"file.{NAME}"
        FILE.write_bytes(b"")
        for reader in READERS[NAME]:
            with suppress(EquipixError):  # what is imported on first use is counted with no file
                reader(FILE)
        atheris.Setup([sys.argv[0], *sys.argv[2:]], read)
        atheris.Fuzz()
