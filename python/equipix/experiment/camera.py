"""A camera under levels of light, as camera.toml or an EMVA 1288 descriptor describes it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from equipix._check import Floats, Progress, ReadOnly, naming_memory
from equipix.detector.photons import EV_UM
from equipix.errors import FileError, InputError
from equipix.experiment.described import Described
from equipix.experiment.image_files import (
    check_formats,
    entries_of,
    marks_of_levels,
    refuse_other_types,
    refuse_repeats,
    sha256_of,
)
from equipix.experiment.manifest import (
    CameraExposure,
    CameraLight,
    CameraManifest,
    checked_content,
    unreadable,
)
from equipix.findings import Finding, Rule, ask, say
from equipix.io.paths import as_path
from equipix.measured.colour import Colours, Filters, advice
from equipix.measured.statistics import FrameStatistics
from equipix.metrics.emva import (
    MOST_EFFICIENT,
    QUANTISED,
    TIMES,
    TRANSFER,
    EmvaSpatial,
    EmvaTransfer,
    dark_lines,
    linear_levels,
    mean_and_variance,
    spatial_of,
    transfer_of,
)
from equipix.metrics.frame_noise import moments
from equipix.metrics.maps import places_of

_DESCRIPTOR = "EMVA1288_Data.txt"

_FALLEN = 0.9
"""Variance at the brightest level over the largest, up to which it has fallen by saturation."""

_LEVELS = 9
"""Levels between 5 and 95 % of saturation that the standard wants for the linearity."""

_FRAMES = 16
"""Fewest frames for a non-uniformity: of fewer it is little more than what noise leaves."""

_Place = tuple[slice, slice]

_ALL: _Place = np.s_[:, :]

_JOULE_PER_EV = 1.602176634e-19


@dataclass(frozen=True, eq=False)
class CameraFigures(ReadOnly):
    """Figures of a camera, or of one plane of its colour filters.

    Attributes
    ----------
    transfer : EmvaTransfer
        Gain, noise, saturation, sensitivity threshold, linearity, dark current.
    spatial : EmvaSpatial or None
        DSNU in electrons and PRNU; None without frames for them.
    photons, exposure_s : ndarray, shape (n,)
        Photons per pixel and exposure time of each level.
    on, off : ndarray, shape (n, 2)
        Mean and temporal variance of each level with light and without it, in DN and DN².
    bright, dark : ndarray, shape (rows, cols), or None
        Mean of the frames of `spatial`, in DN.
    frames : tuple of int
        Numbers of frames of `spatial`, with light and without.
    findings : tuple of Finding
        What limits the figures.
    metadata : dict
        Where they come from.
    """

    transfer: EmvaTransfer
    spatial: EmvaSpatial | None
    photons: Floats
    exposure_s: Floats
    on: Floats
    off: Floats
    bright: Floats | None
    dark: Floats | None
    frames: tuple[int, int] = (0, 0)
    findings: tuple[Finding, ...] = ()
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def is_saturated(self) -> bool:
        """Whether the noise falls towards the brightest level, as it does by saturation."""
        return bool(self._share <= _FALLEN)

    @property
    def is_quantised(self) -> bool:
        """Whether quantisation hides the temporal dark noise."""
        return self.transfer.dark_noise_dn < QUANTISED**0.5 and not self.contradicts_times

    @property
    def contradicts_times(self) -> bool:
        """Whether the variance at the time 0 is negative, and that of each dark clear."""
        return self.transfer.dark_noise_dn < 0 and self._least >= QUANTISED

    @property
    def _share(self) -> float:
        """Variance at the brightest level over the largest."""
        return float(self.on[self.on[:, 0].argmax(), 1] / self.on[:, 1].max())

    @property
    def _least(self) -> float:
        """Smallest variance of a dark."""
        return float(self.off[:, 1].min())


@dataclass(frozen=True)
class CameraExperiment(Described[CameraManifest]):
    """Frames of a camera under levels of light, as files on disk.

    Attributes
    ----------
    path : Path
        The camera.toml, or the EMVA1288_Data.txt.
    manifest : CameraManifest
        Its checked content.

    See Also
    --------
    equipix.metrics.emva_transfer : Figures of frames in memory.
    equipix.metrics.emva_spatial : Non-uniformity of frames in memory.

    Notes
    -----
    An EMVA1288_Data.txt describes the public sets of EMVA 1288: lines ``b exposure_ns photons`` and
    ``d exposure_ns``, each followed by ``i image`` lines. Two images are a level, more are those of
    the non-uniformity; the dark of a level is that of its exposure time.
    """

    _model = CameraManifest

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read and check the description.

        Parameters
        ----------
        path : str or path
            The camera.toml or the EMVA1288_Data.txt, or a folder that holds one of them.

        Returns
        -------
        CameraExperiment
            What `figures` evaluates.

        Raises
        ------
        FileError
            If the file cannot be read, has an unknown key or a wrong value, or names a file that
            does not exist, or one file for two levels; if a level has no light or no dark.
        """
        file = as_path("path", path)
        if file.is_dir():
            found = [file / name for name in (_DESCRIPTOR, "camera.toml") if (file / name).exists()]
            if len(found) != 1:
                held, also = ("both", "and") if found else ("neither", "nor")
                raise FileError(
                    f"{file}: holds {held} {_DESCRIPTOR} {also} camera.toml, expected one of them: "
                    "name the file"
                )
            file = found[0]
        return super().load(file)

    @classmethod
    def _read(cls, file: Path) -> Any:
        if file.suffix.lower() != ".txt":
            return super()._read(file)
        return checked_content(file, _described(file), CameraManifest)

    def figures(
        self, *, workers: int | None = None, progress: Progress | None = None
    ) -> dict[str, CameraFigures]:
        """Evaluate the files after EMVA 1288, release 4.0 linear.

        Parameters
        ----------
        workers : int, optional
            Number of threads; by default one for each processor.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` repeatedly.

        Returns
        -------
        dict of str to CameraFigures
            By the plane of the colour filters, as `equipix.metrics.planes` names it; by an empty
            text without filters.

        Raises
        ------
        FileError
            If a file cannot be read, images differ in size or depth, two files have the same
            content, or the levels do not determine the figures.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Warns
        -----
        InputWarning
            Of each finding: saturation is not reached, levels or frames are few, exposure times
            determine no dark current, quantisation hides the noise, the photons give no quantum
            efficiency, or the image shows colours that `cfa` does not name.

        Notes
        -----
        The frames of a level are reduced to their mean and variance when they are read, so memory
        does not grow with their number. They are read once for each plane of the colour filters.
        Those of one level are read once more, to find colours that `cfa` does not name.
        """
        shape = self._shape()
        colours = Colours.of(self.manifest.sensor.cfa)
        places = {"": _ALL} if colours is None else places_of(colours)
        hashes = sha256_of([self.path, *self.files()])
        refuse_repeats(self.path, self.manifest, marks_of_levels(hashes))
        origin = self._provenance(hashes, None)
        with naming_memory("averaging"):
            found = {
                plane: self._evaluated(plane, partial(self._mean, place, shape, workers), progress)
                for plane, place in places.items()
            }
            mixed = _of_filters(self._filters(colours, [*found.values()], shape, workers))
        say(*mixed, *(each for one in found.values() for each in one.findings))
        return {
            plane: replace(one, findings=mixed + one.findings, metadata=origin)
            for plane, one in found.items()
        }

    def _filters(
        self,
        colours: Colours | None,
        found: list[CameraFigures],
        shape: tuple[int, int],
        workers: int | None,
    ) -> Filters | None:
        """Find colours in the brightest level that is well below saturation in all planes."""
        signals = np.array([one.on[:, 0] - one.off[:, 0] for one in found])
        most = [[TRANSFER * one.transfer.saturation_dn] for one in found]
        levels = np.flatnonzero(np.all(signals <= most, axis=0))
        if not levels.size:
            return None
        name, entry = self.manifest.series[levels[signals[0, levels].argmax()]]
        bright, dark = (
            self._mean(_ALL, shape, workers, f"'{key}' of exposure '{name}'", files).mean
            for key, files in (("frames", entry.frames), ("dark", entry.dark))
        )
        return Filters.of(colours, bright - dark)

    def _mean(
        self,
        place: _Place,
        shape: tuple[int, int],
        workers: int | None,
        at: str,
        files: str | list[str],
    ) -> FrameStatistics:
        """Average the frames of an entry in the pixels of a plane, as an image of their own."""
        mask = np.ones(shape, bool)
        mask[place] = False
        # With a mask a saved average loses the light between its frames.
        found = self._statistics(at, files, None, workers, None, mask if mask.any() else None)
        maps: dict[str, Any] = {
            name: np.ascontiguousarray(each[place]) for name, each in found.maps.items()
        }
        return replace(found, **maps)

    def _shape(self) -> tuple[int, int]:
        """Rows and columns that all images have."""
        entries = [*entries_of(self.path, self.manifest)]
        for entry in entries:
            try:
                files = [entries[0].files[0], *entry.files]
                shape = check_formats(files, self.manifest.sensor.bit_depth)
            except FileError as error:
                raise FileError(f"{self.path}, {entry}: {error}") from error
        refuse_other_types(self.path, self.manifest)
        return shape

    def _evaluated(
        self, plane: str, read: Callable[[str, Any], FrameStatistics], progress: Progress | None
    ) -> CameraFigures:
        """Evaluate one plane."""
        exposures, entry = self.manifest.exposure, self.manifest.spatial
        photons = np.array([_photons(each, self.manifest.light) for each in exposures])
        times = np.array([each.exposure_s for each in exposures])
        on, off = curve = np.empty((2, len(exposures), 2))
        spatial = bright = dark = None
        frames = 0, 0
        at = ""
        try:
            for k, (name, each) in enumerate(self.manifest.series[: len(exposures)]):
                for j, key in enumerate(("frames", "dark")):
                    at = f"'{key}' of exposure '{name}'"
                    curve[j, k] = mean_and_variance(key, read(at, getattr(each, key)))
                if progress is not None:
                    progress(k + 1, len(exposures), f"averaging levels {plane}".strip())
            at = f"plane {plane}" if plane else "levels"
            names = [f"exposure '{name}'" for name, _ in self.manifest.series]
            transfer = transfer_of(on, off, photons, times, "the light in photons", names)
            if entry is not None:
                at = "[spatial]"
                # One after the other: variances of all pixels take as much memory as the means.
                lit = moments("frames", read(at, entry.frames))
                unlit = moments("dark", read(at, entry.dark))
                spatial = spatial_of(lit, unlit, transfer.gain_dn_per_e)
                bright, dark, frames = lit.mean, unlit.mean, (lit.frames, unlit.frames)
        except InputError as error:
            raise FileError(f"{self.path}, {at}: {error}") from error
        found = CameraFigures(transfer, spatial, photons, times, on, off, bright, dark, frames)
        of = f"plane {plane}: " if plane else ""
        said = (replace(each, message=of + each.message) for each in ask(_CAMERA, found))
        return replace(found, findings=tuple(said))


def _photons(exposure: CameraExposure, light: CameraLight | None) -> float:
    """Photons per pixel: given, or E A t λ/(h c)."""
    if exposure.photons is not None or light is None or exposure.irradiance_uw_cm2 is None:
        return float(exposure.photons or 0.0)
    joule = exposure.irradiance_uw_cm2 * 1e-14 * light.pixel_um**2 * exposure.exposure_s
    return joule * light.wavelength_nm * 1e-3 / (EV_UM * _JOULE_PER_EV)


def _of_filters(filters: Filters | None) -> tuple[Finding, ...]:
    """Say that the image shows colours that 'cfa' does not name."""
    if filters is None or (filters.given and filters.shown is None):
        return ()
    shown = filters.shown or filters.colours
    repeats, is_of_channels = f"the response repeats {shown.interval}", min(shown.period) == 1
    if filters.shown is not None:
        words = (
            f"{repeats} otherwise than 'cfa' in [sensor], '{filters.colours}', so planes have "
            f"wrong colours or mix them: {advice(shown)}"
        )
    elif not is_of_channels:
        words = (
            f"{repeats} by {filters.spread:.0%}, as under colour filters, and no 'cfa' is given in "
            "[sensor], so the figures mix the colours and PRNU contains them: "
            f"{advice(shown, filters.response)}"
        )
    else:
        words = (
            f"{repeats} by {filters.spread:.0%}, as channels of the read-out have it, and PRNU "
            "contains that. Adjust the gains of the channels; name stripes of colours by 'cfa' in "
            "[sensor]"
        )
    return (Finding("cfa", words, "misfit", "note" if is_of_channels else "warning"),)


def _on_unit(found: CameraFigures) -> str | None:
    """Say that the photons free more electrons than there are photons."""
    efficiency = found.transfer.responsivity / found.transfer.gain_dn_per_e
    if efficiency <= MOST_EFFICIENT:
        return None
    return (
        f"the quantum efficiency is {efficiency:.4g} (limit {MOST_EFFICIENT:g}), so "
        "it is left out: see that the light is in photons per pixel and exposure, or in µW/cm², "
        "and the pixel in µm"
    )


def _on_saturation(found: CameraFigures) -> str | None:
    """Say that the noise does not fall towards the brightest level."""
    if found.is_saturated:
        return None
    return (
        f"the variance at the brightest level is {found._share:.0%} of the largest (limit "
        f"{_FALLEN:.0%}), so saturation is not reached: saturation capacity, SNR and dynamic range "
        "are lower bounds. Add levels with more light, up to where the noise falls"
    )


def _on_levels(found: CameraFigures) -> str | None:
    """Say that the linearity is judged by few levels."""
    signal = found.on[:, 0] - found.off[:, 0]
    count = np.count_nonzero(linear_levels(signal, found.transfer.saturation_dn))
    if count >= _LEVELS:
        return None
    return (
        f"{count} levels lie between 5 and 95 % of saturation (limit {_LEVELS}), so the linearity "
        "error is of few, and saturation lies anywhere between two levels: add levels, 50 in all"
    )


def _on_frames(found: CameraFigures) -> str | None:
    """Say that the non-uniformity is judged by few frames."""
    if found.spatial is None or min(found.frames) >= _FRAMES:
        return None
    lit, dark = found.frames
    return (
        f"[spatial] has {lit} frames with light and {dark} without (limit {_FRAMES}), so DSNU "
        "and PRNU have the error of a large noise that is subtracted: give 100 or more of each"
    )


def _on_times(found: CameraFigures) -> str | None:
    """Say that the noise of the darks contradicts their exposure times."""
    if not found.contradicts_times:
        return None
    noise = found.transfer.dark_noise_dn
    return (
        f"the variance of the darks is {found._least:.3g} DN² or more, and its line over their "
        f"exposure times is {-(noise**2):.3g} DN² at the time 0, below 0 by more than twice its "
        "error. So dark noise, sensitivity threshold and dynamic range are left out: see that each "
        "'exposure_s' is that of its frames, in seconds"
    )


def _on_spread(found: CameraFigures) -> str | None:
    """Say that the exposure times differ, but not by enough."""
    times, t = np.unique(found.exposure_s), found.transfer
    if len(times) < TIMES:
        return None
    is_clear = found._least >= QUANTISED
    unknown = ["dark current by the mean"] if np.isnan(t.dark_current_mean) else []
    if is_clear and np.isnan(t.dark_current_variance):
        unknown += ["dark current by the variance"]
    reasons = ["the error, of 95 %, of a dark current is not below its size, so it may be 0"]
    reasons = reasons if unknown else []
    if is_clear and np.isnan(dark_lines(found.exposure_s, found.off).at_zero):
        unknown += ["dark noise at the time 0"]
        reasons += [
            "the error of the variance at the time 0 is above half of it, so dark noise is that of "
            "the darks as they are"
        ]
    if not unknown:
        return None
    return (
        f"exposure times of {times[0]:.6g} s and up to {np.ptp(times):.3g} s more do not determine "
        f"{', '.join(unknown)}: {', and '.join(reasons)}. Add short and long exposure times"
    )


def _on_quantisation(found: CameraFigures) -> str | None:
    """Say that the noise of the dark is hidden by rounding."""
    if not found.is_quantised:
        return None
    hidden = (
        "Dark current by the variance is not known, and dark current by the mean has errors of "
        "rounding. "
    )
    # Without noise a pixel shows whole DN alone, so that means of frames are not finer.
    most = 0.5 / found.transfer.gain_dn_per_e
    spatial = f"DSNU is of rounded values, off by up to 0.5 DN, {most:.2g} e⁻. "
    return (
        f"the temporal dark noise is {max(found.transfer.dark_noise_dn, 0):.3g} DN, and "
        f"quantisation hides noise below {QUANTISED**0.5:.2g} DN. So dark noise and sensitivity "
        "threshold are upper bounds, and dynamic range is a lower bound. "
        f"{hidden if found._least < QUANTISED else ''}{spatial if found.spatial else ''}"
        "Use a higher gain of the camera"
    )


_CAMERA: tuple[Rule[CameraFigures], ...] = (
    Rule("unit", "input", _on_unit),
    Rule("saturation", "input", _on_saturation),
    Rule("levels", "input", _on_levels, severity="note"),
    Rule("frames", "input", _on_frames, severity="note"),
    Rule("times", "input", _on_times),
    Rule("spread", "input", _on_spread, severity="note"),
    Rule("quantisation", "input", _on_quantisation, severity="note"),
)
"""What is asked of the figures of a camera."""


class _Group(NamedTuple):
    """Lines of a descriptor: one of ``b`` or ``d`` with its place, and its images."""

    kind: str
    at: str
    values: list[float]
    files: list[str]

    @property
    def series(self) -> tuple[float, bool]:
        """Exposure time in ns, and whether it is of more than two images."""
        return self.values[0], len(self.files) > 2


_LINES = {
    "n": "bits, columns and rows",
    "b": "exposure time in ns and photons per pixel",
    "d": "exposure time in ns",
}
"""What follows each kind of line."""


def _described(path: Path) -> dict[str, Any]:
    """Content of a camera.toml that says what a descriptor says."""
    groups = _groups(path)
    darks = {group.series: group for group in groups if group.kind == "d"}
    content: dict[str, Any] = {"sensor": {}, "exposure": []}
    for group in groups:
        if group.kind == "n":
            content["sensor"] = {"bit_depth": int(group.values[0])}
        if group.kind != "b":
            continue
        dark = darks.get(group.series)
        if dark is None:
            raise FileError(
                f"{path}, {group.at}: there are no dark images of {group.values[0]:g} ns, expected "
                "as many as bright ones"
            )
        time, photons = group.values
        files = {"frames": group.files, "dark": dark.files}
        if group.series[1]:
            content.setdefault("spatial", files)
        else:
            level = {"name": group.at, "exposure_s": time / 1e9, "photons": photons}
            content["exposure"].append(level | files)
    return content


def _groups(path: Path) -> list[_Group]:
    """Read the lines of a descriptor; images must exist."""
    groups: list[_Group] = []
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()
    except OSError as error:
        raise FileError(f"{path}: {unreadable(path, error)}") from error
    for number, line in enumerate(map(str.strip, lines), 1):
        kind, _, rest = line.partition(" ")
        if kind in _LINES:
            groups.append(_Group(kind, f"line {number}", _numbers(path, number, line), []))
        elif kind == "i" and groups:
            name = rest.strip().replace("\\", "/")
            if not (path.parent / name).is_file():
                raise FileError(f"{path}, line {number}: '{name}' does not exist")
            groups[-1].files.append(name)
        elif kind[:1] not in ("", "#", "v"):
            raise FileError(
                f"{path}, line {number}: holds {line!r}, expected a line of n, b, d, i, v or #"
            )
    for group in groups:
        if group.kind != "n" and len(group.files) < 2:
            raise FileError(
                f"{path}, {group.at}: names {len(group.files)} images, expected two or more"
            )
    return groups


def _numbers(path: Path, number: int, line: str) -> list[float]:
    """Numbers of a line, as many as it must hold."""
    kind, *words = line.split()
    try:
        values = [float(word.replace(",", ".")) for word in words]
    except ValueError:
        values = []
    if len(values) != {"n": 3, "b": 2, "d": 1}[kind]:
        raise FileError(
            f"{path}, line {number}: holds {line!r}, expected '{kind}' with {_LINES[kind]}"
        )
    return values
