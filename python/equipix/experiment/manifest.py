"""The content of manifests, checked: errors name the value and its place.

The models are the one schema of the files. Each key has what it must hold as `title`, its meaning
as `description` and an example: messages, templates and the reference in docs/ are made of them.
"""

import tomllib
from collections.abc import Iterator
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic.functional_validators import BeforeValidator
from pydantic_core import ErrorDetails, PydanticCustomError

from equipix._check import Bools
from equipix.errors import EquipixError, FileError, InputError
from equipix.io import binary
from equipix.io.frames import Settings, has_format
from equipix.io.paths import find_files
from equipix.measured.colour import Colours

Positive = Annotated[FiniteFloat, Field(gt=0)]

NotNegative = Annotated[FiniteFloat, Field(ge=0)]

Text = Annotated[str, Field(min_length=1)]

Files = Text | Annotated[list[Text], Field(min_length=1)]

Pair = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]

Errors = Annotated[list[NotNegative], Field(min_length=2, max_length=2)]

Span = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]


FILES = "a file, a glob or a list of them"

DARKS = "a table [dark], or tables [[dark]]"

_FILTERS = "RGBWCMYEI"
"""Letters of colour filters: primary ones, white, complementary ones, emerald, infrared."""

_Content = TypeVar("_Content", bound="Table")


def key(wanted: str, meaning: str = "", example: Any = None, default: Any = None) -> Any:
    """Describe a key that may be left out: what it must hold, its meaning, an example."""
    return Field(default, title=wanted, description=meaning, examples=[example])


needed = partial(key, default=...)
"""Describe a key that a file must have."""


def _format() -> Any:
    return key("1: a newer format needs a newer equipix", "version of this file format", 1, 1)


class Table(BaseModel):
    """A table of a TOML file, whose keys are known."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


_SPAN = "[first, end], two whole numbers from 0 on, the first below the end"


class Region(Table):
    """One ``[[sensor.region]]``: a rectangle or a circle of pixels that must not be used."""

    rows: Span | None = key(
        _SPAN, "rows of a rectangle, without the end; all unless given", [0, 10]
    )
    cols: Span | None = key(_SPAN, "columns of a rectangle, likewise", [0, 10])
    centre: Pair | None = key("[row, col] in pixels", "centre of a circle", [291, 391])
    radius: Positive | None = key("a positive number of pixels", "radius of the circle", 280)
    outside: bool = key("true or false", "whether what is outside is not used", True, False)

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

    shape: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)] = needed(
        "[rows, cols], two whole numbers above 0", "sizes of a frame", [480, 640]
    )
    pixel: Literal["Mono8", "Mono10", "Mono10p", "Mono12", "Mono12p", "Mono14", "Mono16"] = needed(
        f"one of {', '.join(binary.FORMATS)}",
        "format of a pixel, by the names of GenICam",
        "Mono12p",
    )
    big_endian: bool = key(
        "true or false",
        "whether the high byte of two is the first; not with packed formats",
        True,
        False,
    )
    skip_bytes: Annotated[int, Field(ge=0)] = key(
        "a whole number, not negative", "bytes before the first frame", 16, 0
    )
    gap_bytes: Annotated[int, Field(ge=0)] = key(
        "a whole number, not negative", "bytes between two frames", 8, 0
    )

    def behind(self, file: Path) -> Path:
        """Return a file with its layout behind its name, unless it has a format of its own."""
        if has_format(file) or binary.split(str(file))[1]:
            return file
        (rows, cols), between = self.shape, (self.skip_bytes, self.gap_bytes, self.big_endian)
        return Path(f"{file}:{binary.Layout(rows, cols, self.pixel, *between)}")


class Sensor(Table):
    """Table ``[sensor]``: levels in DN, and pixels that must not be used."""

    name: str = key("a text", "name of the sensor, kept in the result", "array 7", "")
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None = key(
        "a whole number from 1 to 16", "bits of the camera; 2^bits − 1 counts as saturated", 12
    )
    saturation: Positive | None = key(
        "a positive number (DN)",
        "saturation, if not that of `bit_depth` or of the file's type",
        4000,
    )
    gain_dn_per_e: Positive | None = key(
        "a positive number (DN per electron)", "gain for the noise model; fitted unless given", 0.3
    )
    cfa: Text | list[Text] | list[list[Text]] | None = key(
        "colour filters: letters such as 'RGGB', rows of one period, or lists of labels",
        "colour filters of the pixels: see [colour.md](colour.md)",
        "RGGB",
    )
    # A dark current that doubles every 6.5 K changes by 5 % in half a kelvin.
    dark_temperature_tolerance_c: NotNegative = key(
        "a number of kelvins, not negative",
        "largest difference between the temperatures of a dark and an exposure",
        2.0,
        0.5,
    )
    mask: Text | None = key(
        "an image (TIFF, PNG, PGM, BMP, FITS) or .npy",
        "pixels not 0 in it are not used",
        "mask.png",
    )
    region: Annotated[list[Region], Field(min_length=1)] | None = key(
        "tables [[sensor.region]]", "areas that are not used, each a rectangle or a circle"
    )

    @model_validator(mode="after")
    def _cfa_is_a_pattern(self) -> Self:
        try:
            Colours.of(self.cfa)
        except InputError as error:
            raise _problem(f"[sensor]: {error}") from error
        if isinstance(self.cfa, str) and {*self.cfa} - {*_FILTERS, "/"}:
            raise _problem(
                f"'cfa' in [sensor] is {self.cfa!r}, expected the letters {', '.join(_FILTERS)}: "
                'other filters have labels in lists, as in [["R", "X"], ["G", "B"]]'
            )
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

    frames: Files = needed(FILES, "frames")
    exposure_s: NotNegative | None = key(
        "a number of seconds, not negative",
        "exposure time of a frame, by which a dark is chosen",
        0.02,
    )
    temperature_c: FiniteFloat | None = key(
        "a number of degrees Celsius",
        "temperature of the sensor, by which a dark is chosen",
        -10.0,
    )

    @property
    def settings(self) -> Settings:
        """Exposure time and temperature, where they are given."""
        return Settings(self.exposure_s, self.temperature_c)


class Dark(Taken):
    """Table ``[dark]``, or one of several ``[[dark]]``: frames without light."""

    frames: Files = needed(FILES, "frames without light", "dark/*.tif")


Darks = Annotated[
    list[Dark],
    Field(min_length=1),
    BeforeValidator(lambda given: [given] if isinstance(given, dict) else given),
]


class Exposure(Taken):
    """One ``[[exposure]]``: the frames of one sensor position, and that position."""

    name: Text = needed("a text", "name of the exposure, different for each", "p0")
    frames: Files = needed(FILES, "frames at this position", "frames/p0-*.tif")
    aperture_before: Files | None = key(
        FILES, "images of the hole before the move to this position", "hole/p1-before.tif"
    )
    aperture_after: Files | None = key(
        FILES, "images of the hole after this move", "hole/p1-after.tif"
    )
    shift: Pair | None = key(
        "[row, col] in pixels, without a unit: divide micrometres by the pixel pitch",
        "position where it is known; not the step from the position before. Excludes the two keys "
        "above. One of the two ways is required from the second exposure on",
        [0, 19],
    )
    shift_std: Errors | None = key(
        "[row, col] in pixels, not negative",
        "standard deviations of both numbers of `shift`, at most 0.3; `shift` is then refined. A "
        "pair also where both are the same",
        [0.05, 0.05],
    )
    flux: Positive | None = key(
        "a positive number", "relative power of the lamp; in all exposures or in none", 1.0
    )
    flux_std: Positive | None = key(
        "a positive number, relative to the flux",
        "standard deviation of `flux`; in all exposures or in none. Without it `flux` counts as "
        "exact",
        0.001,
    )
    time: FiniteFloat | None = key(
        "a number of seconds",
        "time for a linear drift of the lamp; in all exposures or in none",
        0.0,
    )
    rotation: Literal[0, 90, 180, 270] = key(
        "0, 90, 180 or 270", "degrees by which the sensor is turned in the beam", 180, 0
    )

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

    frames: Files = needed(FILES, "frames of this level, or their saved average", "20C/*.tif")
    temperature_c: FiniteFloat | None = key(
        "a number of degrees Celsius",
        "temperature of the sensor, not of the source, by which a dark is chosen",
        -10.0,
    )
    name: str = key("a text", "name of the level; its value or number unless given", "20C", "")
    value: FiniteFloat | None = key(
        "a number", "what the source was set to; means should rise with it", 20
    )
    unit: Text | None = key("a text", "unit of all values", "°C")

    @model_validator(mode="after")
    def _unit_of_a_value(self) -> Self:
        if self.unit is not None and self.value is None:
            raise _problem("'unit' is given without 'value'")
        return self


class WholeFile(Table):
    """What each file that describes measurements begins with."""

    format: Literal[1] = _format()
    sensor: Sensor = key("a table", default=Sensor())
    layout: Layout | None = key(
        "a table", "how the bytes of files without a format of their own are frames"
    )


class LevelManifest(WholeFile):
    """The whole levels.toml."""

    dark: Darks | None = key(
        DARKS,
        "frames without light; without it the level without light is part of the curves",
    )
    level: Annotated[list[Level], Field(min_length=1)] = needed("one or more tables [[level]]")

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
            for index, each in enumerate(self.level, start=1)
        ]

    @property
    def measurements(self) -> list[tuple[str, Taken]]:
        """Name and frames of each level."""
        return list(zip(self.names, self.level, strict=True))


class Manifest(WholeFile):
    """The whole experiment.toml."""

    dark: Darks | None = key(
        DARKS,
        "one or several, of which each exposure takes the one that fits; only raw files of cameras "
        "go without",
    )
    exposure: Annotated[list[Exposure], Field(min_length=2)] = needed(
        "two or more tables [[exposure]]"
    )

    @model_validator(mode="after")
    def _exposures_fit_together(self) -> Self:
        first, *others = self.exposure
        if first.aperture_before is not None:
            raise _problem(
                f"[[exposure]] 1 ('{first.name}') has aperture images, but no move before it"
            )
        for number, exposure in enumerate(others, start=2):
            if exposure.aperture_before is None and exposure.shift is None:
                raise _problem(
                    f"[[exposure]] {number} ('{exposure.name}') needs 'aperture_before' and "
                    "'aperture_after', or 'shift'"
                )
        names = [exposure.name for exposure in self.exposure]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise _problem(f"two exposures have the name '{repeated[0]}'")
        for column in ("flux", "flux_std", "time"):
            missing = [each.name for each in self.exposure if getattr(each, column) is None]
            if missing and len(missing) < len(names):
                raise _problem(
                    f"'{column}' is missing in exposure '{missing[0]}': give all or none"
                )
        return self

    @property
    def measurements(self) -> list[tuple[str, Taken]]:
        """Name and frames of each exposure."""
        return [(each.name, each) for each in self.exposure]


class Series(Table):
    """Frames with light, and as many without: ``[spatial]`` of a camera.toml."""

    frames: Files = needed(
        FILES,
        "two or more with light; of `[spatial]` 100 or more, half saturated",
        "bright/000-*.png",
    )
    dark: Files = needed(
        FILES, "as many without light, of the same exposure time", "dark/000-*.png"
    )


class CameraExposure(Series):
    """One ``[[exposure]]`` of a camera.toml: a level of light, and its dark."""

    name: str = key("a text", "name of the level, for messages", "level 0", "")
    exposure_s: NotNegative = needed("a number of seconds, not negative", "exposure time", 0.001)
    photons: NotNegative | None = key(
        "a number of photons per pixel, not negative", "light within the exposure time", 120
    )
    irradiance_uw_cm2: NotNegative | None = key(
        "a number of µW/cm², not negative", "irradiance, in the place of `photons`", 0.3
    )

    @model_validator(mode="after")
    def _one_light(self) -> Self:
        if (self.photons is None) == (self.irradiance_uw_cm2 is None):
            raise _problem("give either 'photons' or 'irradiance_uw_cm2'")
        return self


class CameraLight(Table):
    """Table ``[light]``: what turns an irradiance into photons per pixel."""

    wavelength_nm: Positive = needed("a positive number of nanometres", "its wavelength", 530)
    pixel_um: Positive = needed(
        "a positive number of micrometres", "side of a pixel, or root of its area", 5.5
    )


class CameraManifest(WholeFile):
    """The whole camera.toml."""

    unused: ClassVar = (
        "saturation",
        "gain_dn_per_e",
        "dark_temperature_tolerance_c",
        "mask",
        "region",
    )
    """Keys of ``[sensor]`` that it does not have."""

    light: CameraLight | None = key("a table", "what turns an irradiance into photons")
    exposure: Annotated[list[CameraExposure], Field(min_length=2)] = needed(
        "two or more tables [[exposure]]"
    )
    spatial: Series | None = key(
        "a table", "frames for DSNU and PRNU, which are left out without them"
    )

    @model_validator(mode="after")
    def _figures_of_all_pixels(self) -> Self:
        for name in self.unused:
            if name in self.sensor.model_fields_set:
                raise _problem(
                    f"'{name}' in [sensor] is not for a camera.toml: the figures are of all "
                    "pixels, gain and saturation are measured, and each level names its dark"
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
        return [(each.name or str(k), each) for k, each in enumerate(self.exposure, 1)] + spatial

    @property
    def measurements(self) -> list[tuple[str, Series]]:
        """Name and frames of each exposure."""
        return self.series


AnyManifest = Manifest | LevelManifest | CameraManifest


def table_of(kind: Any, *, many: bool = False) -> tuple[type[Table], bool] | None:
    """Return the table that a key of this type holds, and whether it holds a list of them."""
    if isinstance(kind, type) and issubclass(kind, Table):
        return kind, many
    parts = (table_of(each, many=many or get_origin(kind) is list) for each in get_args(kind))
    return next(filter(None, parts), None)


def keys_of(model: type[Table], within: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Give all keys of a file with their descriptions, those in tables after that of the table."""
    for name, field in model.model_fields.items():
        yield within + name, field
        if table := table_of(field.annotation):
            for path, inner in keys_of(table[0], f"{within}{name}."):
                if path.removeprefix("sensor.").split(".")[0] not in getattr(model, "unused", ()):
                    yield path, inner


def example_of(field: FieldInfo) -> Any:
    """Return the example of a key."""
    return (field.examples or [None])[0]


KEYS = frozenset(
    path.rsplit(".", 1)[-1]
    for model in (Manifest, LevelManifest, CameraManifest)
    for path, _ in keys_of(model)
)
"""All keys and tables of the manifests."""


def read_manifest(path: Path, model: type[_Content]) -> _Content:
    """Read and check the experiment.toml, levels.toml or camera.toml `path`."""
    return checked_content(path, _content(path, model), model)


def _content(path: Path, model: type[Table]) -> dict[str, Any]:
    """Read the tables of a file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise FileError(f"{path}: {unreadable(path, error)}, expected {_called(model)}") from error
    except UnicodeDecodeError as error:
        if b"\0" in error.object:
            raise FileError(f"{path}: is no text, expected {_called(model)}") from None
        line = error.object.count(b"\n", 0, error.start) + 1
        raise FileError(f"{path}: line {line} is no UTF-8: save it as UTF-8, as TOML is") from None
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path}: is not valid TOML: {error}") from error
    except RecursionError:
        raise FileError(
            f"{path}: has arrays or tables within one another beyond what Python reads, expected "
            f"{_called(model)}"
        ) from None


def kind_of(path: Path) -> Literal["experiment", "levels", "camera"]:
    """Say which of the manifests `path` is, by its tables.

    Raises
    ------
    FileError
        If it cannot be read, or is none.
    """
    if path.is_dir() or path.suffix.lower() != ".toml":
        return "camera"
    content = _content(path, WholeFile)
    if "level" in content:
        return "levels"
    exposures = content.get("exposure")
    tables = exposures if isinstance(exposures, list) else []
    known = (set(each) for each in tables if isinstance(each, dict))
    of_camera = [each for each in known if {"photons", "irradiance_uw_cm2"} & each]
    return "camera" if of_camera or {"light", "spatial"} & set(content) else "experiment"


def unreadable(path: Path, error: OSError) -> str:
    """Say why a file of text cannot be read."""
    if isinstance(error, FileNotFoundError):
        return "does not exist"
    return "is a folder" if path.is_dir() else f"cannot be read: {error.strerror}"


def _called(model: type[Table]) -> str:
    """Name the file that a model is the schema of."""
    names: dict[type[Table], str] = {
        Manifest: "the file experiment.toml",
        LevelManifest: "the file levels.toml",
        CameraManifest: "the file camera.toml",
    }
    return names.get(model, "a TOML file")


def checked_content(path: Path, content: dict[str, Any], model: type[_Content]) -> _Content:
    """Check the content of a manifest; messages name `path`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError(f"{path}: {'; '.join(_problems(error.errors(), content, model))}") from None


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


def _problems(
    details: list[ErrorDetails], content: dict[str, Any], model: type[Table]
) -> list[str]:
    """Name each mistake once, with the number of exposures that share it, and the remedy."""
    found: dict[tuple[object, ...], dict[int | None, tuple[str, str]]] = {}
    for detail in details:
        location = detail["loc"]
        exposure = next((part for part in location if isinstance(part, int)), None)
        names = [part for part in location if isinstance(part, str)]
        kinds = {"manifest": detail["msg"], "extra_forbidden": "unknown", "missing": "missing"}
        depth = 3 if names[:2] == ["sensor", "region"] else 2
        mistake = (kinds.get(detail["type"], "value"), *names[:depth])
        found.setdefault(mistake, {}).setdefault(exposure, _sentence(detail, content, model))
    sentences = [list(alike.values()) for alike in found.values()]
    return [
        first + (f", and likewise in {len(others)} more" if others else "") + remedy
        for (first, remedy), *others in sentences
    ]


def _sentence(detail: ErrorDetails, content: dict[str, Any], model: type[Table]) -> tuple[str, str]:
    """One of pydantic's errors in the terms of the file, and what to do about it."""
    location = detail["loc"]
    place = _place(location, content)
    named, wanted, owner = _described(model, location)
    if detail["type"] == "manifest":
        return detail["msg"] + place, ""
    if detail["type"] == "extra_forbidden":
        unknown = str(location[-1])
        return f"unknown key '{unknown}'{place}", _nearest(unknown, owner)
    if detail["type"] == "missing":
        return f"key '{location[-1]}' is missing{place}", ""
    value = detail["input"]
    if named in ("exposure", "level") and isinstance(value, dict):
        return f"[{named}] is one table: write [[{named}]], with two brackets, for each {named}", ""
    if isinstance(location[-1], int) and named in ("exposure", "level", "dark", "region"):
        return f"[[{named}]] {location[-1] + 1} is {_held(value)}, expected a table", ""
    return f"'{named}'{place} holds {_held(value)}, expected {wanted}", ""


def _held(value: object) -> str:
    """Write a value; of tables their number and keys."""
    match value:
        case dict():
            return f"a table with the keys {', '.join(value) or 'none'}"
        case [dict(), *_]:
            return f"{len(value)} table" + "s" * (len(value) > 1)
    return repr(value)


def _described(model: type[Table], location: tuple[object, ...]) -> tuple[str, str, type[Table]]:
    """Return the key that a location ends in, what it must hold, and the table around it."""
    named = wanted = ""
    for part in location:
        field = model.model_fields.get(str(part))
        if field is not None:
            named, wanted = str(part), field.title or ""
            model, _ = table_of(field.annotation) or (model, False)
    return named, wanted, model


def _nearest(unknown: str, table: type[Table]) -> str:
    """Name the known key that an unknown one is nearest to."""
    if "shift" in table.model_fields and unknown.startswith(("shift_", "position")):
        return ": 'shift' is in pixels: divide micrometres by the pixel pitch"
    near = get_close_matches(unknown, table.model_fields, 1)
    return (
        f": did you mean '{near[0]}'?" if near else f": known are {', '.join(table.model_fields)}"
    )


def _place(location: tuple[int | str, ...], content: dict[str, Any]) -> str:
    match location:
        case ["exposure" | "level" as kind, int(index), *_]:
            return f" in [[{kind}]] {index + 1}{_name(content[kind][index])}"
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
