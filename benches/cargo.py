"""Benches in Rust that print a line of JSON for each thing measured."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def bench(name: str, *, smoke: bool) -> list[dict[str, Any]]:
    """Run a bench and read what it prints."""
    command = ["cargo", "bench", "--quiet", "--locked", "-p", "equipix-core", "--bench", name]
    if smoke:
        # No time is measured then, so the build of the tests serves, which is there already.
        command += ["--profile", "test", "--", "--test"]
    output = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return [json.loads(line) for line in output.stdout.splitlines() if line.startswith("{")]
