"""The content of manifests, checked: errors name the value and its place."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from pydantic.functional_validators import BeforeValidator
from pydantic_core import ErrorDetails, PydanticCustomError

from equipix._check import Bools
from equipix.errors import EquipixError, FileError, InputError
from equipix.io import binary
from equipix.io.frames import Settings, has_format
from equipix.io.paths import find_files
from equipix.measured.colour import Colours

_WANTED = {
    "format": "1: a newer format needs a newer equipix",
    "sensor": "a table",
    "bit_depth": "a whole number from 1 to 16",
    "saturation": "a positive number (DN)",
    "gain_dn_per_e": "a positive number (DN per electron)",
    "cfa": "colour filters: 'RGGB', rows of one period or lists of labels",
    "mask": "an image file",
    "region": "tables [[sensor.region]]",
    "rows": "[first, end], two whole numbers from 0 on, the first below the end",
    "cols": "[first, end], two whole numbers from 0 on, the first below the end",
    "centre": "[row, col] in pixels",
    "radius": "a positive number of pixels",
    "outside": "true or false",
    "dark": "a table [dark], or tables [[dark]]; files in a camera.toml",
    "dark_temperature_tolerance_c": "a number of kelvins, not negative",
    "layout": "a table",
    "shape": "[rows, cols], two whole numbers above 0",
    "pixel": f"one of {', '.join(binary.FORMATS)}",
    "big_endian": "true or false",
    "skip_bytes": "a whole number, not negative",
    "gap_bytes": "a whole number, not negative",
    "exposure_s": "a number of seconds, not negative",
    "temperature_c": "a number of degrees Celsius",
    "exposure": "two or more tables [[exposure]]",
    "level": "one or more tables [[level]]",
    "value": "a number",
    "unit": "a text",
    "name": "a text",
    "frames": "a file, a glob or a list of them",
    "aperture_before": "a file, a glob or a list of them",
    "aperture_after": "a file, a glob or a list of them",
    "shift": "[row, col] in pixels, without a unit: divide micrometres by the pixel pitch",
    "shift_std": "[row, col] in pixels, not negative",
    "flux": "a positive number",
    "flux_std": "a positive number, relative to the flux",
    "time": "a number of seconds",
    "rotation": "0, 90, 180 or 270",
    "photons": "a number of photons per pixel, not negative",
    "irradiance_uw_cm2": "a number of µW/cm², not negative",
    "light": "a table",
    "wavelength_nm": "a positive number of nanometres",
    "pixel_um": "a positive number of micrometres",
    "spatial": "a table",
}

KEYS = frozenset(_WANTED)
"""All keys and tables of the manifests."""

Positive = Annotated[FiniteFloat, Field(gt=0)]

NotNegative = Annotated[FiniteFloat, Field(ge=0)]

Text = Annotated[str, Field(min_length=1)]

Files = Text | Annotated[list[Text], Field(min_length=1)]

Pair = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]

Errors = Annotated[list[NotNegative], Field(min_length=2, max_length=2)]

Span = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]


_Content = TypeVar("_Content", bound=BaseModel)


class Table(BaseModel):
    """A table of a TOML file, whose keys are known."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Region(Table):
    """One ``[[sensor.region]]``: a rectangle or a circle of pixels that must not be used."""

    rows: Span | None = None
    cols: Span | None = None
    centre: Pair | None = None
    radius: Positive | None = None
    outside: bool = False

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        if (self.centre is None) != (self.radius is None):
            raise _problem("give both 'centre' and 'radius'")
        spans = [span for span in (self.rows, self.cols) if span is not None]
        if bool(spans) == (self.centre is not None):
            raise _problem("give 'rows', 'cols' or both, or 'centre' and 'radius'")
        for first, end in spans:
            if first >= end:
                raise _problem(f"{[first, end]} holds no pixel: the first must be below the end")
        return self

    def pixels(self, place: str, shape: tuple[int, int]) -> Bools:
        """Pixels of a sensor that must not be used; `place` names the region in messages."""
        inside = self._rectangle(place, shape) if self.centre is None else self._disc(place, shape)
        return ~inside if self.outside else inside

    def _rectangle(self, place: str, shape: tuple[int, int]) -> Bools:
        inside = np.zeros(shape, bool)
        spans = []
        for name, span, size in zip(("rows", "cols"), (self.rows, self.cols), shape, strict=True):
            first, end = span or (0, size)
            if end > size:
                raise FileError(f"{place}: '{name}' ends at {end}, expected at most {size}")
            spans.append(slice(first, end))
        inside[tuple(spans)] = True
        return inside

    def _disc(self, place: str, shape: tuple[int, int]) -> Bools:
        row, col = self.centre or (0.0, 0.0)
        rows, cols = np.ogrid[: shape[0], : shape[1]]
        inside: Bools = np.hypot(rows - row, cols - col) <= (self.radius or 0.0)
        if not inside.any():
            raise FileError(
                f"{place}: 'centre' {[row, col]} and 'radius' {self.radius:g} name no pixel of the "
                f"sensor, which has {shape[0]} rows and {shape[1]} columns"
            )
        return inside


class Layout(Table):
    """Table ``[layout]``: how the bytes of files without a format of their own are frames."""

    shape: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)]
    pixel: Literal["Mono8", "Mono10", "Mono10p", "Mono12", "Mono12p", "Mono14", "Mono16"]
    big_endian: bool = False
    skip_bytes: Annotated[int, Field(ge=0)] = 0
    gap_bytes: Annotated[int, Field(ge=0)] = 0

    def behind(self, file: Path) -> Path:
        """Return a file with its layout behind its name, unless it has a format of its own."""
        if has_format(file) or binary.split(str(file))[1]:
            return file
        (rows, cols), between = self.shape, (self.skip_bytes, self.gap_bytes, self.big_endian)
        return Path(f"{file}:{binary.Layout(rows, cols, self.pixel, *between)}")


class Sensor(Table):
    """Table ``[sensor]``: levels in DN, and pixels that must not be used."""

    name: str = ""
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None = None
    saturation: Positive | None = None
    gain_dn_per_e: Positive | None = None
    cfa: Text | list[Text] | list[list[Text]] | None = None
    # A dark current that doubles every 6.5 K changes by 5 % in half a kelvin.
    dark_temperature_tolerance_c: Annotated[FiniteFloat, Field(ge=0)] = 0.5
    mask: Text | None = None
    region: Annotated[list[Region], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _cfa_is_a_pattern(self) -> Self:
        try:
            Colours.of(self.cfa)
        except InputError as error:
            raise _problem(f"[sensor]: {error}") from error
        return self

    @model_validator(mode="after")
    def _level_within_depth(self) -> Self:
        if self.saturation is None or self.largest is None:
            return self
        if self.saturation > self.largest:
            raise _problem(
                f"'saturation' in [sensor] is {self.saturation:g}, above {self.largest}, the "
                f"largest value that 'bit_depth' = {self.bit_depth} holds: no value would reach it"
            )
        return self

    @property
    def largest(self) -> int | None:
        """Largest value that `bit_depth` holds, if it is given."""
        return None if self.bit_depth is None else 2**self.bit_depth - 1

    @property
    def saturation_level(self) -> float | None:
        """Level that counts as saturated: the given one, else the largest of `bit_depth`."""
        if self.saturation is None and self.largest is not None:
            return float(self.largest)
        return self.saturation

    @property
    def saturation_key(self) -> str:
        """The key that gives `saturation_level`."""
        return "bit_depth" if self.saturation is None and self.bit_depth else "saturation"


class Taken(Table):
    """Frames, with the exposure time and temperature that they were taken with."""

    frames: Files
    exposure_s: Annotated[FiniteFloat, Field(ge=0)] | None = None
    temperature_c: FiniteFloat | None = None

    @property
    def settings(self) -> Settings:
        """Exposure time and temperature, where they are given."""
        return Settings(self.exposure_s, self.temperature_c)


class Dark(Taken):
    """Table ``[dark]``, or one of several ``[[dark]]``: frames without light."""


Darks = Annotated[
    list[Dark],
    Field(min_length=1),
    BeforeValidator(lambda given: [given] if isinstance(given, dict) else given),
]


class Exposure(Taken):
    """One ``[[exposure]]``: the frames of one sensor position, and that position."""

    name: Text
    aperture_before: Files | None = None
    aperture_after: Files | None = None
    shift: Pair | None = None
    shift_std: Errors | None = None
    flux: Positive | None = None
    flux_std: Positive | None = None
    time: FiniteFloat | None = None
    rotation: Literal[0, 90, 180, 270] = 0

    @model_validator(mode="after")
    def _one_way_to_know_the_position(self) -> Self:
        if (self.aperture_before is None) != (self.aperture_after is None):
            raise _problem("give both 'aperture_before' and 'aperture_after'")
        if self.aperture_before is not None and self.shift is not None:
            raise _problem("give aperture images or 'shift', not both")
        if self.shift_std is not None and self.shift is None:
            raise _problem("'shift_std' is given without 'shift'")
        if self.flux_std is not None and self.flux is None:
            raise _problem("'flux_std' is given without 'flux'")
        return self


class Level(Taken):
    """One ``[[level]]``: frames of a uniform source, and what the source was set to."""

    name: str = ""
    value: FiniteFloat | None = None
    unit: Text | None = None

    @model_validator(mode="after")
    def _unit_of_a_value(self) -> Self:
        if self.unit is not None and self.value is None:
            raise _problem("'unit' is given without 'value'")
        return self


class LevelManifest(Table):
    """The whole levels.toml."""

    format: Literal[1] = 1
    sensor: Sensor = Sensor()
    layout: Layout | None = None
    dark: Darks | None = None
    level: Annotated[list[Level], Field(min_length=1)]

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        units = list(dict.fromkeys(each.unit.strip() for each in self.level if each.unit))
        if len(units) > 1:
            raise _problem(
                f"'unit' is {' and '.join(map(repr, units[:2]))} in different levels: give all "
                "values in one unit, and name it in each level"
            )
        return self

    @property
    def names(self) -> list[str]:
        """Name of each level: its own, its value, or its number."""
        return [
            each.name or (f"{index}" if each.value is None else f"{each.value:g}{each.unit or ''}")
            for index, each in enumerate(self.level)
        ]

    @property
    def measurements(self) -> list[tuple[str, Taken]]:
        """Name and frames of each level."""
        return list(zip(self.names, self.level, strict=True))


class Manifest(Table):
    """The whole experiment.toml."""

    format: Literal[1] = 1
    sensor: Sensor = Sensor()
    layout: Layout | None = None
    dark: Darks | None = None
    exposure: Annotated[list[Exposure], Field(min_length=2)]

    @model_validator(mode="after")
    def _exposures_fit_together(self) -> Self:
        first, *others = self.exposure
        if first.aperture_before is not None:
            raise _problem(
                f"exposure 0 ('{first.name}') has aperture images, but no move before it"
            )
        for number, exposure in enumerate(others, start=1):
            if exposure.aperture_before is None and exposure.shift is None:
                raise _problem(
                    f"exposure {number} ('{exposure.name}') needs 'aperture_before' and "
                    "'aperture_after', or 'shift'"
                )
        names = [exposure.name for exposure in self.exposure]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise _problem(f"two exposures have the name '{repeated[0]}'")
        for key in ("flux", "flux_std", "time"):
            missing = [each.name for each in self.exposure if getattr(each, key) is None]
            if missing and len(missing) < len(names):
                raise _problem(f"'{key}' is missing in exposure '{missing[0]}': give all or none")
        return self

    @property
    def measurements(self) -> list[tuple[str, Taken]]:
        """Name and frames of each exposure."""
        return [(each.name, each) for each in self.exposure]


class Series(Table):
    """Frames with light, and as many without: ``[spatial]`` of a camera.toml."""

    frames: Files
    dark: Files


class CameraExposure(Series):
    """One ``[[exposure]]`` of a camera.toml: a level of light, and its dark."""

    name: str = ""
    exposure_s: NotNegative
    photons: NotNegative | None = None
    irradiance_uw_cm2: NotNegative | None = None

    @model_validator(mode="after")
    def _one_light(self) -> Self:
        if (self.photons is None) == (self.irradiance_uw_cm2 is None):
            raise _problem("give either 'photons' or 'irradiance_uw_cm2'")
        return self


class CameraLight(Table):
    """Table ``[light]``: what turns an irradiance into photons per pixel."""

    wavelength_nm: Positive
    pixel_um: Positive


class CameraManifest(Table):
    """The whole camera.toml."""

    format: Literal[1] = 1
    sensor: Sensor = Sensor()
    layout: Layout | None = None
    light: CameraLight | None = None
    exposure: Annotated[list[CameraExposure], Field(min_length=2)]
    spatial: Series | None = None

    @model_validator(mode="after")
    def _figures_of_all_pixels(self) -> Self:
        for key in ("saturation", "gain_dn_per_e", "mask", "region"):
            if getattr(self.sensor, key) is not None:
                raise _problem(
                    f"'{key}' in [sensor] is not for a camera.toml: the figures are of all pixels, "
                    "and gain and saturation are measured"
                )
        if self.light is None and any(each.photons is None for each in self.exposure):
            raise _problem(
                "'irradiance_uw_cm2' needs a table [light] with 'wavelength_nm' and 'pixel_um'"
            )
        return self

    @property
    def series(self) -> list[tuple[str, Series]]:
        """Each exposure by its name, or its number, and the frames for the non-uniformity."""
        spatial: list[tuple[str, Series]] = [("spatial", self.spatial)] if self.spatial else []
        return [(each.name or str(k), each) for k, each in enumerate(self.exposure)] + spatial

    @property
    def measurements(self) -> list[tuple[str, Series]]:
        """Name and frames of each exposure."""
        return self.series


AnyManifest = Manifest | LevelManifest | CameraManifest


def read_manifest(path: Path, model: type[_Content]) -> _Content:
    """Read and check the experiment.toml, levels.toml or camera.toml `path`."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise FileError(f"{path}: line {line} is no UTF-8: save it as UTF-8, as TOML is") from None
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path}: is not valid TOML: {error}") from error
    return checked_content(path, content, model)


def checked_content(path: Path, content: dict[str, Any], model: type[_Content]) -> _Content:
    """Check the content of a manifest; messages name `path`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError(f"{path}: {'; '.join(_problems(error.errors(), content))}") from None


def entry_files(path: Path, entry: Files, layout: Layout | None = None) -> list[Path]:
    """Find the files of an entry of the manifest `path` (a file, a glob or a list)."""
    try:
        files = find_files(entry, folder=path.parent)
    except EquipixError as error:
        raise FileError(f"{path}: {error}") from error
    return files if layout is None else list(map(layout.behind, files))


def name_of_dark(index: int, count: int) -> str:
    """Return what messages call a dark."""
    return "[dark]" if count == 1 else f"[[dark]] {index + 1}"


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("manifest", "{text}", {"text": text})


def _problems(details: list[ErrorDetails], content: dict[str, Any]) -> list[str]:
    """Name each mistake once, with the number of exposures that share it."""
    found: dict[tuple[object, ...], dict[int | None, str]] = {}
    for detail in details:
        location = detail["loc"]
        exposure = next((part for part in location if isinstance(part, int)), None)
        names = [part for part in location if isinstance(part, str)]
        kinds = {"manifest": detail["msg"], "extra_forbidden": "unknown", "missing": "missing"}
        depth = 3 if names[:2] == ["sensor", "region"] else 2
        mistake = (kinds.get(detail["type"], "value"), *names[:depth])
        found.setdefault(mistake, {}).setdefault(exposure, _sentence(detail, content))
    sentences = [list(alike.values()) for alike in found.values()]
    return [
        first + (f", and likewise in {len(others)} more" if others else "")
        for first, *others in sentences
    ]


def _sentence(detail: ErrorDetails, content: dict[str, Any]) -> str:
    """One of pydantic's errors in the terms of the file."""
    location = detail["loc"]
    place = _place(location, content)
    if detail["type"] == "manifest":
        return detail["msg"] + place
    if detail["type"] == "extra_forbidden":
        hint = ""
        if str(location[-1]).startswith(("shift", "position")):
            hint = ": 'shift' is in pixels: divide micrometres by the pixel pitch"
        return f"unknown key '{location[-1]}'{place}{hint}"
    if detail["type"] == "missing":
        return f"key '{location[-1]}' is missing{place}"
    value = detail["input"]
    key = next((key for key in reversed(location) if key in _WANTED), None)
    if key is None:
        named = next(part for part in reversed(location) if isinstance(part, str))
        wanted = detail["msg"].replace("Input should be", "expected")
        return f"'{named}'{place} holds {value!r}, {wanted}"
    if key in ("exposure", "level") and isinstance(value, dict):
        return f"[{key}] is one table: write [[{key}]], with two brackets, for each {key}"
    return f"'{key}'{place} holds {value!r}, expected {_WANTED[key]}"


def _place(location: tuple[int | str, ...], content: dict[str, Any]) -> str:
    match location:
        case ["exposure" | "level" as kind, int(index), *_]:
            return f" in {kind} {index}{_name(content[kind][index])}"
        case ["dark", int(index), *_] if isinstance(content["dark"], list):
            return f" in [[dark]] {index + 1}"
        case ["sensor", "region", int(index), *_]:
            return f" in [[sensor.region]] {index + 1}"
        case [table, _, *_]:
            return f" in [{table}]"
    return ""


def _name(table: object) -> str:
    name = table.get("name") if isinstance(table, dict) else None
    return f" ('{name}')" if name else ""
