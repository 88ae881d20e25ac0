"""What the tests share: the folder of real and simulated data."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


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
