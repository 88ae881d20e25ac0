"""A virtual calibration experiment: a camera on a stage in a steady beam, a hole, and files."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from equipix._check import Array, ArrayLike, Floats, Progress, Rng, as_array, as_shifts
from equipix.errors import FileError, InputError
from equipix.io.paths import as_path, folder_beside, replace_folder
from equipix.io.tiff import write_frames
from equipix.measured.colour import Colours
from equipix.measured.noise import UNIFORM, scatter, unaveraged
from equipix.shown import Brief
from equipix.simulate.accuracy import noise_prediction
from equipix.simulate.beams import Beam, check_beam, filtered, window
from equipix.simulate.camera import Camera, Pixels

FULL_SCALE_E = 20_000.0
"""Electrons that fill the range of the ADC where no gain is given."""

DARK_LEVEL, DARK_SPREAD = 60 / 4095, 3 / 4095
"""Mean and standard deviation of the dark level over the pixels, relative to full scale."""

HOLE_EDGE = 1.5
"""Half width of the soft edge of the hole's image, in pixels."""

SMALLEST_HOLE = 3.0
"""Least radius of the hole's image, in pixels."""

_FRAMES, _DARK, _BEFORE, _AFTER = range(4)


@dataclass(frozen=True, eq=False)
class Truth(Brief):
    """What an experiment should find.

    Attributes
    ----------
    sensitivity : ndarray, shape (rows, cols), float64
        Relative sensitivity, that of the dead pixels and the responses of colours included.
    shifts : ndarray, shape (n, 2), float64
        Where the stage really was: (row, col) in pixels.
    dead, hot : ndarray of int64
        Flat indices of the bad pixels.
    dark : ndarray, shape (rows, cols), float64
        Dark level, that of the hot pixels included, in DN.
    gain_dn_per_e : float
        Digital numbers per photoelectron.
    """

    sensitivity: Floats
    shifts: Floats
    dead: Pixels
    hot: Pixels
    dark: Floats
    gain_dn_per_e: float


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualExperiment(Brief):
    """An experiment whose frames are made on demand; see `experiment`.

    Every stream of frames has random numbers of its own and can be drawn again.

    Attributes
    ----------
    camera : Camera
        The camera.
    beam : callable
        The beam, in electrons that a pixel of sensitivity 1 collects in a frame.
    hole : callable
        The same beam behind the screen with the hole.
    positions : ndarray, shape (n, 2), float64
        True position of the stage in each exposure, the first (0, 0).
    count, dark_count, aperture_count : int
        Numbers of frames: of an exposure, of the dark, of an image of the hole.
    entropy : int
        Seed of all frames.
    cfa : Colours or None
        Colour filters of the camera.
    """

    camera: Camera
    beam: Beam
    hole: Beam
    positions: Floats
    count: int
    dark_count: int
    aperture_count: int
    entropy: int
    cfa: Colours | None = None

    @property
    def truth(self) -> Truth:
        """What a calibration should find."""
        c = self.camera
        return Truth(c.response, self.positions, c.dead, c.hot, c.offset, c.gain_dn_per_e)

    def frames(self, k: int) -> Iterator[Array]:
        """Make the frames of exposure `k`, one at a time."""
        return self._stream(self.beam, k, self.count, _FRAMES, k)

    def dark(self) -> Iterator[Array]:
        """Make the dark frames, one at a time."""
        rng = np.random.default_rng([self.entropy, _DARK])
        return self.camera.frames(np.zeros(self.camera.shape), self.dark_count, rng=rng)

    def aperture_before(self, k: int) -> Iterator[Array]:
        """Make the frames of the hole before the move to exposure `k`, from 1 on."""
        return self._stream(self.hole, k - 1, self.aperture_count, _BEFORE, k)

    def aperture_after(self, k: int) -> Iterator[Array]:
        """Make the frames of the hole after the move to exposure `k`, from 1 on."""
        return self._stream(self.hole, k, self.aperture_count, _AFTER, k)

    def _stream(self, beam: Beam, position: int, count: int, kind: int, k: int) -> Iterator[Array]:
        light = window(beam, self.camera.shape, self.positions[position])
        rng = np.random.default_rng([self.entropy, kind, k])
        return self.camera.frames(light, count, rng=rng)

    def variance_of_mean(self) -> Floats:
        """Variance of the dark-subtracted mean of each exposure, (n, rows, cols), in DN².

        What frames do not average out of the rounding is included: see `equipix.measured.noise`.
        """
        shape = self.camera.shape
        dark = self._of_mean(np.zeros(shape), self.dark_count)
        lights = (window(self.beam, shape, position) for position in self.positions)
        return np.stack([self._of_mean(light, self.count) + dark for light in lights])

    def _of_mean(self, light: Floats, count: int) -> Floats:
        """Variance of the mean of so many frames."""
        before = self.camera.variance(light) - UNIFORM
        return np.asarray(scatter(before) / count + unaveraged(before))

    def noise_prediction(self, *, draws: int = 4, rng: Rng) -> tuple[float, float]:
        """Error of the sensitivity of the good pixels that the camera's noise alone leaves.

        Parameters
        ----------
        draws : int
            Number of random draws that are averaged.
        rng : numpy.random.Generator or int
            Source of the random numbers, or its seed.

        Returns
        -------
        rms, block_rms : float
            Relative root mean square over the pixels and over means of 16×16 pixels; see
            `equipix.simulate.noise_prediction`.
        """
        gain = self.camera.gain_dn_per_e
        return noise_prediction(
            self.camera.response,
            self.beam,
            self.positions,
            self.variance_of_mean() / gain**2,
            mask=~self.camera.good,
            draws=draws,
            rng=rng,
        )

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        force: bool = False,
        progress: Progress | None = None,
    ) -> Path:
        """Write the experiment as TIFF files with their manifest, whole or not at all.

        Parameters
        ----------
        folder : path
            Folder to make. It gets ``experiment.toml``, the folders ``frames``, ``dark`` and
            ``aperture`` that this names, and ``truth.npz``, which it does not name.
        force : bool
            Whether a folder that holds an experiment may be replaced.
        progress : callable, optional
            Called as ``progress(frames done, frames in all, "writing")``.

        Returns
        -------
        Path
            The manifest.

        Raises
        ------
        FileError
            If the folder holds files already, or cannot be written.
        InputError
            If `folder` is not the name of a folder.
        """
        target = as_path("folder", folder)
        if target.exists() and not _may_replace(target, force):
            raise FileError(
                f"'{target}' exists and is not empty: name another folder, or force the "
                "replacement of a folder that holds nothing but an experiment written before"
            )
        moves = len(self.positions) - 1
        total = self.dark_count + (moves + 1) * self.count + 2 * moves * self.aperture_count
        done = 0

        def reported(frames: Iterator[Array]) -> Iterator[Array]:
            nonlocal done
            for frame in frames:
                yield frame
                done += 1
                if progress is not None:
                    progress(done, total, "writing")

        size = self.camera.response.size * (1 if self.camera.bit_depth == 8 else 2)
        with folder_beside(target) as made:
            for name, frames, count in self._streams():
                (made / name).parent.mkdir(exist_ok=True)
                write_frames(made / name, reported(frames), nbytes=count * size)
            np.savez(made / "truth.npz", **vars(self.truth))
            (made / "experiment.toml").write_text(self._manifest(), encoding="utf-8")
            replace_folder(target, made)
        return target / "experiment.toml"

    def _streams(self) -> Iterator[tuple[str, Iterator[Array], int]]:
        """Name of each file, its frames, made when they are asked for, and their number."""
        yield "dark/dark.tif", self.dark(), self.dark_count
        for k in range(len(self.positions)):
            yield f"frames/p{k}.tif", self.frames(k), self.count
        for k in range(1, len(self.positions)):
            yield f"aperture/p{k}-before.tif", self.aperture_before(k), self.aperture_count
            yield f"aperture/p{k}-after.tif", self.aperture_after(k), self.aperture_count

    def _manifest(self) -> str:
        cfa = None if self.cfa is None else self.cfa.written
        sensor = {"name": "virtual", "bit_depth": self.camera.bit_depth, "cfa": cfa}
        lines = [
            "# calibration experiment of a virtual camera; the truth is in truth.npz",
            "[sensor]",
            *(f"{key} = {json.dumps(value)}" for key, value in sensor.items() if value is not None),
            *("", "[dark]", 'frames = "dark/dark.tif"'),
        ]
        for k in range(len(self.positions)):
            lines += ["", "[[exposure]]", f'name = "p{k}"', f'frames = "frames/p{k}.tif"']
            if k:
                ends = ("before", "after")
                lines += [f'aperture_{end} = "aperture/p{k}-{end}.tif"' for end in ends]
        return "\n".join(lines) + "\n"


def _may_replace(target: Path, force: bool) -> bool:
    """Whether the target is an empty folder, or an experiment that may be replaced."""
    if not target.is_dir():
        return False
    return not any(target.iterdir()) or (force and all(map(_is_ours, target.iterdir())))


def _is_ours(entry: Path) -> bool:
    """Whether an entry of an experiment's folder is one that `VirtualExperiment.write` makes."""
    if entry.is_symlink():
        return False
    if entry.name in ("frames", "dark", "aperture") and entry.is_dir():
        return all(file.suffix == ".tif" and file.is_file() for file in entry.iterdir())
    return entry.name in ("experiment.toml", "truth.npz") and entry.is_file()


def experiment(
    sensitivity: ArrayLike,
    beam: Beam,
    shifts: ArrayLike,
    *,
    frames: int = 50,
    dark_frames: int | None = None,
    aperture_frames: int = 8,
    exposure_e: float = 14_000.0,
    bit_depth: int = 12,
    gain_dn_per_e: float | None = None,
    read_noise_e: float = 10.0,
    dead: int = 4,
    hot: int = 4,
    stage_error: float = 0.002,
    cfa: ArrayLike | None = None,
    rng: Rng,
) -> VirtualExperiment:
    """Prepare a shift-calibration experiment with a virtual camera on a stage.

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        Relative sensitivity of the pixels.
    beam : callable
        Beam of amplitude about 1, a function of arrays of row and column coordinates.
    shifts : array_like, shape (n, 2)
        Shifts (row, col), in pixels, that the stage is commanded to make; the first is (0, 0).
    frames, dark_frames, aperture_frames : int
        Numbers of frames of an exposure, of the dark (as many as of an exposure unless given)
        and of each image of the hole.
    exposure_e : float
        Electrons that a pixel of sensitivity 1 collects in a frame where the beam is 1.
    bit_depth : int
        Bits of the ADC, 8 to 16.
    gain_dn_per_e : float, optional
        Digital numbers per electron; full scale for 20 000 electrons unless given.
    read_noise_e : float
        Standard deviation of the read noise, in electrons.
    dead, hot : int
        Numbers of dead and of hot pixels, placed at random.
    stage_error : float
        Standard deviation of the error of each move, along each axis, in pixels; the errors add
        up along the way.
    cfa : str or array_like of labels, optional
        Colour filters of the camera, of letters R, G and B: `filtered` is applied to
        `sensitivity`, and the manifest names the pattern.
    rng : numpy.random.Generator or int
        Source of the random numbers, or its seed.

    Returns
    -------
    VirtualExperiment
        The experiment: streams of frames, the truth, and `write`.

    Raises
    ------
    InputError
        If an argument is out of its range, or the hole does not stay in view.

    Examples
    --------
    >>> from equipix import simulate
    >>> sensitivity = simulate.paper_sensitivity((48, 64), rng=1)
    >>> beam = simulate.gaussian_beam(sensitivity.shape)
    >>> virtual = simulate.experiment(sensitivity, beam, [(0, 0), (0, 5), (7, 0)], rng=2)
    >>> next(virtual.frames(1)).shape
    (48, 64)
    """
    check_beam(beam)
    rng = np.random.default_rng(rng)
    size = as_array("sensitivity", sensitivity, ndim=2).size
    dark_frames = frames if dark_frames is None else dark_frames
    for name, number in (("frames", frames), ("dark_frames", dark_frames)):
        if number < 1:
            raise InputError(f"'{name}' is {number}, expected 1 or more")
    if dead < 0 or hot < 0 or dead + hot > size:
        raise InputError(f"{dead} dead and {hot} hot pixels do not fit {size} pixels")
    full_scale, colours = 2**bit_depth - 1, Colours.of(cfa)
    bad = rng.choice(size, dead + hot, replace=False)
    camera = Camera(
        sensitivity=sensitivity if colours is None else filtered(sensitivity, colours.pattern),
        dark=full_scale * rng.normal(DARK_LEVEL, DARK_SPREAD, np.shape(sensitivity)),
        gain_dn_per_e=full_scale / FULL_SCALE_E if gain_dn_per_e is None else gain_dn_per_e,
        read_noise_e=read_noise_e,
        bit_depth=bit_depth,
        dead=bad[:dead],
        hot=bad[dead:],
    )
    positions = as_shifts(shifts)
    # Each move of the stage has a random error.
    positions[1:] += rng.normal(0, stage_error, positions[1:].shape).cumsum(axis=0)

    def light(rows: Floats, cols: Floats) -> Floats:
        return exposure_e * beam(rows, cols)

    return VirtualExperiment(
        camera=camera,
        beam=light,
        hole=_behind_hole(light, camera.shape, positions),
        positions=positions,
        count=frames,
        dark_count=dark_frames,
        aperture_count=aperture_frames,
        entropy=int(rng.integers(2**63)),
        cfa=colours,
    )


def _behind_hole(beam: Beam, shape: tuple[int, int], positions: Floats) -> Beam:
    """Put the beam through a round hole in the middle of the area common to all positions."""
    low, high = positions.max(axis=0), positions.min(axis=0) + shape
    row, col = (low + high - 1) / 2
    radius = float(min(0.1 * min(shape), 0.35 * (high - low).min()))
    if radius < SMALLEST_HOLE:
        raise InputError(f"'shifts' leave no hole in view on a sensor of shape {shape}")

    def hole(rows: Floats, cols: Floats) -> Floats:
        distance = np.hypot(rows - row, cols - col)
        transmission: Floats = 0.5 - 0.5 * np.tanh((distance - radius) / HOLE_EDGE)
        return beam(rows, cols) * transmission

    return hole
