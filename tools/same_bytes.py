"""Compare the results of two builds, byte by byte.

``python tools/same_bytes.py OLD NEW`` builds two commits in git worktrees of a temporary folder,
each with maturin in a virtual environment of its own, and runs with each the cases of its own
tools/byte_cases.py, so public names may differ between the two. It prints what differs and by how
much. The exit status is 1 if anything does, 2 if a build cannot be made or run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
CASES = Path("tools/byte_cases.py")
"""The script of the cases within a checkout."""

STDERR = 2
SCALARS = (bool, int, float, str, np.generic)

COMPARED = (
    *("sensitivity", "beam", "flags", "flux", "shifts"),
    *("beam_origin", "component_labels", "dark", "rejected", "objective", "reduced_chi2"),
    *("sweeps", "error_estimate", "converged", "shift_sign"),
)
"""Fields of a calibration whose bytes must be the same."""

REPORTED = ("sensitivity_std", "tilt_std", "shift_std")
"""Fields whose differences are shown, and count with ``--strict`` only."""

FIELDS = {
    "BolometerArray": "full_scale",
    "Calibration": "sensitivity beam beam_origin beam_coefficients beam_tilt flags shifts rotation "
    "flux objective reduced_chi2 components component_labels sweeps converged error_estimate "
    "history dark dark_is_fitted rejected shift_sign drift tilt sensitivity_std tilt_std shift_std "
    "colour_response coefficients is_partial",
    "CameraFigures": "transfer spatial photons exposure_s on off bright dark",
    "Camera": "offset response good full_scale",
    "Comparison": "sensitivities agreement pairs rms block_rms largest open_tilt predicted_rms "
    "predicted_block_rms",
    "Correctability": "ratio low high spatial_variance temporal_variance pixels frames",
    "Defects": "flags counts gain_percentiles misfit",
    "Drift": "size flux_std degrees_of_freedom probability slope_covariance tilt_std trend_tilt",
    "DynamicCorrection": "offset gain level flags",
    "EmvaSpatial": "dsnu prnu dark_mean bright_mean",
    "EmvaTransfer": "gain_dn_per_e read_noise_e responsivity quantum_efficiency saturation_dn "
    "linearity_error",
    "ErrorBudget": "shifts rms rms_by_cause tilt_by_cause spectrum distinct_trend components "
    "noise_map",
    "Format": "adc_bits dac_bits offset_bits gain_bits out_bits adc coarse offset gain out base "
    "zero",
    "Frame": "values level moving",
    "FrameStatistics": "mean variance variance_of_mean count saturated saturation raw reject step "
    "light_variance dark",
    "Identifiability": "components labels largest equations unknowns by_colour",
    "Kalman": "gain offset frames frames_taken frames_foreign floor gain_std offset_std",
    "LensFalloff": "centre focal_length coefficients std reach",
    "MovingScene": "gain offset",
    "Polynomial": "coefficients flags leaves_offset",
    "Quality": "before after added at_ends table",
    "Response": "deviation variances inverse inverse_error limits reduced_chi2 used flags levels "
    "dark saturation raw coefficients freedom valid_range largest_inverse_error order "
    "colour_response",
    "SceneCorrection": "gain offset frames frames_taken frames_foreign floor",
    "ShiftMeasurement": "shift std before after",
    "Spectrum": "rows cols values worst smallest",
    "Spot": "position std",
    "StaringArray": "gain_dn_per_e full_scale",
    "Suggestion": "shifts budget",
    "Table": "format coarse offset gain flags coefficients",
    "ThreeDNoise": "t v h tv th vh tvh total",
    "Tolerance": "spread half_width electrons netd_k",
    "Truth": "sensitivity shifts dead hot dark",
    "Widths": "offset_bits gain_bits both_bits added",
}
"""Fields of the results of each class: the names of its attributes.

Where an attribute is renamed, ``field:attribute`` keeps the name of the field.
"""

EPILOG = """\
Fields are attributes of a calibration (sensitivity, beam, flags, flux, shifts, dark, objective,
sweeps, ...), those that the cases of other results name, 'warnings' (their categories, in order),
'texts' (their messages) and 'error'. A case that one build alone has differs in the field 'case'.

Each build runs the tools/byte_cases.py of its own checkout. Where a public name has changed, the
scripts differ, and the names of cases and fields in them must not. Both builds use one folder of
compiled dependencies, a temporary one unless CARGO_TARGET_DIR names it.

examples:
  python tools/same_bytes.py main HEAD
  python tools/same_bytes.py main HEAD --allow texts
  python tools/same_bytes.py --with-builds ../before . --only robust refined
"""


class BuildError(Exception):
    """A build that cannot be made or run."""


@dataclass(frozen=True)
class Build:
    """An interpreter, the folder that it imports equipix from, and the script that it runs."""

    python: Path
    packages: Path
    cases: Path

    @classmethod
    def at(cls, folder: Path) -> Build:
        """The build in a checkout, with the interpreter of its .venv or else this one."""
        packages = folder.absolute() / "python"
        if not list(packages.glob("equipix/_native*")):
            raise BuildError(f"{folder}: expected a folder that holds python/equipix")
        cases = folder.absolute() / CASES
        if not cases.exists():
            raise BuildError(f"{folder}: expected a folder that holds {CASES}, the cases to run")
        own = folder.absolute() / ".venv/bin/python"
        return cls(own if own.exists() else Path(sys.executable), packages, cases)


@dataclass(frozen=True)
class Outcome:
    """What a build gives: arrays by case and field, the notes of each case, its NumPy."""

    arrays: dict[str, dict[str, NDArray[Any]]]
    notes: dict[str, dict[str, Any]]
    numpy: str

    def fields(self, case: str) -> dict[str, NDArray[Any]]:
        """All that is compared of a case, as arrays."""
        notes = self.notes[case]
        categories, texts = [[pair[i] for pair in notes["warnings"]] for i in (0, 1)]
        words = {"warnings": categories, "texts": texts, "error": [notes["error"] or "none"]}
        return self.arrays.get(case, {}) | {name: np.array(word) for name, word in words.items()}


def collected(value: Any, name: str = "") -> dict[str, NDArray[Any]]:
    """The numbers of results as arrays; a field is named by the parts that lead to it."""
    if value is None:
        return {}
    flat = value if isinstance(value, list | tuple) else (value,)
    if all(isinstance(each, SCALARS) for each in flat) or isinstance(value, np.ndarray):
        return {name: np.asarray(value)}
    found: dict[str, NDArray[Any]] = {}
    for key, part in parts(value):
        found |= collected(part, f"{name} {key}".strip())
    return found


def parts(value: Any) -> Iterator[tuple[object, Any]]:
    """The parts of a result by their names, those of a list by their numbers."""
    for kind in type(value).__mro__:
        if kind.__name__ in FIELDS:
            for word in FIELDS[kind.__name__].split():
                field, _, attribute = word.partition(":")
                part = getattr(value, attribute or field)
                named = field == "history" or not isinstance(part, dict)
                yield field, part if named else list(part.values())
            return
    yield from value.items() if isinstance(value, dict) else enumerate(value)


def call(*command: str | Path, folder: Path, **variables: str) -> None:
    """Run a command; its output goes to stderr."""
    environment = os.environ | variables
    try:
        subprocess.run(command, cwd=folder, env=environment, check=True, stdout=STDERR)
    except (OSError, subprocess.CalledProcessError) as error:
        raise BuildError(f"failed: {' '.join(map(str, command))}") from error


def run(build: Build, words: Sequence[str] = ()) -> Outcome:
    """Run with a build, in a folder of its own, the cases whose names hold one of the words."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command: tuple[str | Path, ...] = (build.python, build.cases, folder, *words)
        call(*command, folder=folder, PYTHONPATH=str(build.packages))
        with np.load(folder / "results.npz") as file:
            found = {key: file[key] for key in file.files}
        notes = json.loads((folder / "notes.json").read_text())
    package = Path(notes["about"]["package"])
    if package.resolve() != (build.packages / "equipix").resolve():
        raise BuildError(f"{build.python} imports {package}, not that of {build.packages}")
    arrays: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in found.items():
        case, field = key.split("/")
        arrays.setdefault(case, {})[field] = array
    return Outcome(arrays, notes["cases"], notes["about"]["numpy"])


def difference(old: NDArray[Any] | None, new: NDArray[Any] | None) -> str | None:
    """How two arrays differ, in words; None if all their bytes are the same."""
    if old is None or new is None:
        return None if old is new else f"only in the {'new' if old is None else 'old'}"
    if old.dtype.kind == new.dtype.kind == "U":
        return None if old.tolist() == new.tolist() else f"{old.tolist()} -> {new.tolist()}"
    if (old.dtype, old.shape) != (new.dtype, new.shape):
        return f"{old.dtype} {old.shape} -> {new.dtype} {new.shape}"
    if old.tobytes() == new.tobytes():
        return None
    if old.dtype.kind != "f":
        return f"{np.count_nonzero(old != new)} of {old.size} values"
    return largest(old, new)


def largest(old: NDArray[Any], new: NDArray[Any]) -> str:
    """The largest relative difference of finite values, and how many values differ."""
    finite = np.isfinite(old) & np.isfinite(new)
    changed = finite & (old != new)
    size = np.maximum(np.abs(old[changed]), np.abs(new[changed]))
    relative = np.max(np.abs(old[changed] - new[changed]) / size, initial=0.0)
    odd = ~finite & (old != new) & ~(np.isnan(old) & np.isnan(new))
    if not (changed.any() or odd.any()):
        return "signs of zeros or bits of NaN alone"
    shown = f"relative {relative:.1e}, {np.count_nonzero(changed)} of {old.size} values"
    return shown + (f", {np.count_nonzero(odd)} more not finite in one" if odd.any() else "")


def compared(old: Outcome, new: Outcome) -> dict[str, dict[str, str]]:
    """What differs in each case, by field."""
    found = {}
    for case in old.notes | new.notes:
        if case not in old.notes or case not in new.notes:
            found[case] = {"case": f"only in the {'old' if case in old.notes else 'new'}"}
            continue
        before, after = old.fields(case), new.fields(case)
        pairs = {name: difference(before.get(name), after.get(name)) for name in before | after}
        found[case] = {name: words for name, words in pairs.items() if words}
        if case not in old.arrays and case not in new.arrays:
            found[case]["error"] = f"in both: {old.notes[case]['error']}"
    return found


def table(found: dict[str, dict[str, str]], ignored: Sequence[str]) -> tuple[str, int]:
    """The differences as a table, and the number of cases in which one counts."""
    width = max(map(len, found))
    lines, faults = [], 0
    for case, fields in found.items():
        counted = [name for name in fields if name not in ignored]
        faults += bool(counted)
        state = "DIFFERS" if counted else "same but for" if fields else "same"
        lines.append(f"{case:{width}}  {state}")
        for name, words in fields.items():
            note = " (allowed)" if name in ignored else ""
            lines.append(f"{'':{width}}    {name}{note}: {words}")
    lines.append(f"{len(found)} cases: {len(found) - faults} same, {faults} differ")
    return "\n".join(lines), faults


def resolved(commit: str) -> str:
    """The hash of a commit, since a branch may move while the first one is built."""
    command = ("git", "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}")
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        raise BuildError(f"'{commit}' is no commit of this repository")
    return found.stdout.strip()


def made(commit: str, folder: Path, target: Path) -> Build:
    """Build a commit in a worktree at `folder`."""
    call("git", "worktree", "add", "--detach", folder, commit, folder=ROOT)
    call(sys.executable, "-m", "venv", ".venv", folder=folder)
    bin_folder = folder / ".venv/bin"
    pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    call(bin_folder / "python", *pip, "-r", "requirements-dev.txt", folder=folder)
    maturin = (bin_folder / "maturin", "develop", "--locked", "--profile", "ci")
    own = {"VIRTUAL_ENV": str(folder / ".venv"), "CARGO_TARGET_DIR": str(target)}
    call(*maturin, folder=folder, **own)
    return Build.at(folder)


@contextmanager
def builds_of(commits: Sequence[str]) -> Iterator[list[Build]]:
    """Build commits in a temporary folder, which goes when they have been used."""
    commits = [resolved(commit) for commit in commits]
    with tempfile.TemporaryDirectory() as name:
        folders = [Path(name) / place for place in ("old", "new")]
        target = Path(os.environ.get("CARGO_TARGET_DIR", f"{name}/target")).absolute()
        pairs = zip(commits, folders, strict=True)
        try:
            yield [made(commit, folder, target) for commit, folder in pairs]
        finally:
            for folder in filter(Path.exists, folders):
                call("git", "worktree", "remove", "--force", folder, folder=ROOT)


@contextmanager
def builds_at(folders: Sequence[str]) -> Iterator[list[Build]]:
    """Builds that are there already."""
    yield [Build.at(Path(folder)) for folder in folders]


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commits", nargs="*", metavar="COMMIT", help="the old one and the new one")
    parser.add_argument(
        "--with-builds",
        nargs=2,
        metavar=("OLD", "NEW"),
        help="two checkouts with python/equipix, its extension and tools, instead of commits",
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="cases with a word in their name"
    )
    parser.add_argument(
        "--allow",
        nargs="+",
        default=[],
        metavar="FIELD",
        help="differences of these fields are shown, but do not count",
    )
    parser.add_argument(
        "--strict", action="store_true", help=f"let {', '.join(REPORTED)} count like the others"
    )
    options = parser.parse_args(arguments)
    if len(options.commits) != (0 if options.with_builds else 2):
        parser.error("expected two commits, or two folders after --with-builds")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare two builds; returns the exit status."""
    options = parsed(arguments)
    given, commits = options.with_builds, options.commits
    try:
        with builds_at(given) if given else builds_of(commits) as builds:
            old, new = [run(build, options.only) for build in builds]
    except BuildError as error:
        print(error, file=sys.stderr)
        return 2
    if old.numpy != new.numpy:
        print(f"NumPy differs: {old.numpy} -> {new.numpy}")
    ignored = options.allow if options.strict else [*options.allow, *REPORTED]
    text, faults = table(compared(old, new), ignored)
    print(text)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
