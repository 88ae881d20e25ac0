"""The origin of a calibration: files, versions and hashes."""

from __future__ import annotations

import hashlib
import os
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from equipix._types import Floats
    from equipix.experiment.manifest import Manifest
    from equipix.noise import NoiseModel


def provenance(
    path: Path,
    manifest: Manifest,
    hashes: Mapping[Path, str],
    shifts: Floats,
    std: Floats,
    noise: NoiseModel | None,
) -> dict[str, Any]:
    """Names, measured shifts, noise and the hashes of the files, as JSON values."""
    folder = path.parent
    return {
        "experiment": str(path),
        "sensor": manifest.sensor.model_dump(),
        "exposures": [exposure.name for exposure in manifest.exposure],
        "measured_shifts": shifts.tolist(),
        "measured_shift_std": std.tolist(),
        "noise": None if noise is None else asdict(noise),
        "inputs": {os.path.relpath(file, folder): digest for file, digest in hashes.items()},
    }


def sha256_of(files: Iterable[Path]) -> dict[Path, str]:
    """Hashes of the content of files."""
    return {file: _sha256(file) for file in files}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def origin_of(correction: Path) -> str:
    """Name a correction by the hash of its file, as corrected frames do."""
    return f"correction sha256 {sha256_of([correction])[correction]}"
