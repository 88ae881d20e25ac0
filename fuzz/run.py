"""Random files for every reader: `make fuzz`.

Each target runs for FUZZ_SECONDS (0: without end), or until it has read FUZZ_INPUTS files, as many
targets at a time as there are processors. What ends a target is kept in fuzz/artifacts.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent

COMPILED = ("tiff", "png", "pgm", "bmp")

IN_PYTHON = ("npz", "hex", "bin", "fits", "toml")

SECONDS, INPUTS = (int(os.environ.get(f"FUZZ_{name}") or 0) for name in ("SECONDS", "INPUTS"))

COVERAGE = "level=4", "inline-8bit-counters", "pc-table", "trace-compares"


def built() -> Path:
    """Build the targets in Rust; flags for the machine they run on alone, not for build scripts."""
    known = subprocess.run(["rustc", "-vV"], check=True, capture_output=True, text=True).stdout
    host = re.search("host: (.*)", known)[1]
    passes = ["-Cpasses=sancov-module", "--cfg=fuzzing"]
    passes += [f"-Cllvm-args=-sanitizer-coverage-{each}" for each in COVERAGE]
    folder = os.environ.get("CARGO_TARGET_DIR", HERE.parent / "target")
    subprocess.run(
        ["cargo", "build", "--locked", "--release", "--target", host],
        cwd=HERE,
        env=os.environ | {"RUSTFLAGS": " ".join(passes), "CARGO_TARGET_DIR": f"{folder}/fuzz"},
        check=True,
    )
    return Path(folder, "fuzz", host, "release")


def run(name: str, program: list[str]) -> bool:
    """Run a target; say how many files it read, or how it ended."""
    artifacts = HERE / "artifacts"
    artifacts.mkdir(exist_ok=True)
    flags = ["-timeout=10", "-rss_limit_mb=2048", "-print_final_stats=1"]
    flags += [f"-max_total_time={SECONDS}", f"-artifact_prefix={artifacts}/{name}-"]
    flags += [f"-runs={INPUTS}"] if INPUTS else []
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="equipix-fuzz-", dir=memory) as folder:
        found, files = Path(folder, "found"), Path(folder, "files")
        found.mkdir()
        files.mkdir()
        command = [*program, *flags, str(found), str(HERE / "corpus" / name)]
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | {"TMPDIR": str(files)},
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
    told = done.stdout + done.stderr
    read = re.search(r"number_of_executed_units: (\d+)", told)
    count = int(read[1]) if read else 0
    good = not done.returncode and count >= max(INPUTS, 1)
    print(f"{name}: {count} files, status {done.returncode}", flush=True)
    if not good:
        print(told[-6000:], flush=True)
    return good


def main(wanted: list[str]) -> int:
    """Run all targets, or those that are named; two processes run one that is named twice."""
    if unknown := set(wanted) - {*COMPILED, *IN_PYTHON}:
        known = ", ".join([*COMPILED, *IN_PYTHON])
        sys.exit(f"{sorted(unknown)[0]} is no target, expected one of {known}")
    names = wanted or [*COMPILED, *IN_PYTHON]
    folder = built() if set(names) & set(COMPILED) else HERE
    programs = [
        [str(folder / each)]
        if each in COMPILED
        else [sys.executable, str(HERE / "readers.py"), each]
        for each in names
    ]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
        return int(not all([*threads.map(run, names, programs)]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
