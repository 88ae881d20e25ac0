"""Main figures of results, with their names and units."""

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from equipix._check import Array
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.calibration.result import Calibration
from equipix.comparison import Comparison
from equipix.correction.protocol import Correction, sensor_of
from equipix.diagnosis.coverage import FAR
from equipix.findings import Findings, Flag, usable
from equipix.hardware.table import Table
from equipix.hardware.words import STEPS
from equipix.io.record import Record
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.response import Response, common_misfit
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneCorrection

_LEARNED = ("method", "data_range", "frames")
"""Keys of a scene's metadata that are shown."""

_LAW = ("law", "centre", "focal_length", "k1", "k2", "std", "least_illumination")
"""Keys of a lens's metadata that are shown."""


def summary(content: Record | Correction | SceneCorrection | Comparison) -> dict[str, Any]:
    """Collect the main figures of what a file holds."""
    figures: Callable[[Any], dict[str, Any]] = _FIGURES.get(type(content), _of_correction)
    return figures(content)


def known(**figures: Any) -> dict[str, Any]:
    """Leave out what is not known."""
    return {name: value for name, value in figures.items() if value not in (None, "")}


def findings_entry(findings: Findings, *, as_json: bool = True) -> dict[str, Any]:
    """Findings; their kinds alone where messages are on stderr, as warnings, already."""
    return {"findings": [asdict(each) if as_json else each.kind for each in findings]}


def _of_correction(correction: Correction) -> dict[str, Any]:
    """Collect the main figures of any correction, and how it was learned from a scene."""
    scene = correction.metadata.get("scene")
    learned = scene if isinstance(scene, dict) else {}
    return {
        **known(sensor=sensor_of(correction)),
        "shape": list(correction.shape),
        "degree": len(correction.coefficients) - 1,
        **{name: correction.metadata[name] for name in _LAW if name in correction.metadata},
        **{f"scene_{name}": learned[name] for name in _LEARNED if name in learned},
        "flagged_pixels": flagged(correction),
        **findings_entry(correction.findings),
    }


def of_table(table: Table) -> dict[str, Any]:
    """Collect the main figures of a table of words."""
    f, linearised = table.format, table.metadata.get("linearised")
    form = asdict(f)
    return {
        **known(sensor=sensor_of(table)),
        "shape": list(table.shape),
        "bits": {name.removesuffix("_bits"): form[name] for name in form if "_bits" in name},
        "steps": {name: 2.0 ** form[name] for name in STEPS if name != "coarse" or f.dac_bits},
        "base": f.base,
        "zero": f.zero,
        "unusable_pixels": int((~usable(table.flags)).sum()),
        "flagged_pixels": flagged(table),
        **known(largest_error_dn=table.metadata.get("largest_error_dn")),
        "rounding_dn": (2.0**f.out + 2.0 ** (f.adc + f.gain) * int(table.gain.max())) / 2,
        **({"sag_dn": linearised["sag_dn"]} if linearised else {}),
        **known(correction_sha256=table.metadata.get("sha256")),
        **findings_entry(table.findings),
    }


def of_response(response: Response) -> dict[str, Any]:
    """Collect the main figures of response curves."""
    good = usable(response.flags)
    options = response.metadata.get("options", {})
    spread = {
        f"spread_of_{name}": float(np.std(plane[good]))
        for name, plane in zip("aKce", response.deviation, strict=False)
    }
    return {
        **known(sensor=sensor_of(response)),
        "shape": list(response.shape),
        "order": 0 if options.get("by") == "gain" else response.order,
        "levels": [float(f"{level:.6g}") for level in response.levels],
        **_level_values(response),
        **_colours(response),
        **spread,
        _misfit_name(options): _misfit(response, options),
        "largest_inverse_error": response.largest_inverse_error,
        **known(prediction_errors=options.get("prediction_errors")),
        "flagged_pixels": flagged(response),
        **findings_entry(response.findings),
    }


def _colours(correction: Calibration | Response) -> dict[str, Any]:
    """Colour filters and the responses of the colours, of mean 1, where there are any."""
    if correction.cfa is None or correction.colour_response is None:
        return {}
    return {"cfa": str(correction.cfa), "colour_response": correction.colour_response}


def _level_values(response: Response) -> dict[str, list[str]]:
    """Values of the levels with their units, or the names, where levels.toml has any."""
    levels = response.metadata.get("levels", [])
    texts = [
        each["name"] if each["value"] is None else f"{each['value']:g} {each['unit'] or ''}"
        for each in levels
    ]
    named = texts != [str(number + 1) for number in range(len(levels))]
    return {"level_values": [" ".join(each.split()) for each in texts]} if named else {}


def _misfit(response: Response, options: dict[str, Any]) -> float:
    """Median reduced χ² over that of noise; without variances the mean, a variance in DN²."""
    if options.get("weights") == "equal":
        judged = usable(response.flags) & (response.freedom > 0)
        if judged.any():
            return float(np.mean(response.reduced_chi2[judged]))
    return common_misfit(response)


def of_dynamic(correction: DynamicCorrection) -> dict[str, Any]:
    """Collect the main figures of a correction that follows temperature and bias."""
    return {
        "shape": list(correction.shape),
        "substrate_c": list(correction.axes.substrate_c),
        "bias_v": list(correction.axes.bias_v),
        "order": correction.axes.order,
        "bias_order": correction.axes.bias_order,
        **_errors("offset_prediction_errors", correction.metadata.get("prediction_errors")),
        **_gain(correction),
        "flagged_pixels": flagged(correction),
        **findings_entry(correction.findings),
    }


def _gain(correction: DynamicCorrection) -> dict[str, Any]:
    """Order of the gain and its errors, or what is not found without black bodies."""
    if correction.gain is None:
        return {"gain_order": None, "dead_pixels": "not determinable without black bodies"}
    errors = correction.metadata.get("gain_prediction_errors")
    return {"gain_order": correction.gain_axes.order, **_errors("gain_prediction_errors", errors)}


def _errors(name: str, squares: list[float] | None) -> dict[str, list[float]]:
    """Rms errors of the predictions of held-out temperatures, from order 0 on."""
    return {} if squares is None else {name: np.sqrt(squares).tolist()}


def of_scene(method: SceneCorrection) -> dict[str, Any]:
    """Collect the main figures of a correction that learns from the scene."""
    return {
        "shape": list(method.shape),
        "scene_method": method.method,
        "scene_data_range": np.asarray(method.data_range).tolist(),
        "usable_frames": method.frames_taken,
        "frames_that_counted": method.frames,
        "frames_foreign": method.frames_foreign,
        "floor_dn": np.nan if (floor := method.floor) is None else floor,
        "gain_rms": float(np.std(method.gain)),
        "offset_rms": float(np.std(method.offset)),
    }


def of_statistics(frames: FrameStatistics) -> dict[str, Any]:
    """Collect the main figures of averaged frames."""
    several = (frames.count > 1).any()
    return {
        "shape": list(frames.mean.shape),
        "frames": int(frames.count.max()),
        "mean": float(np.nanmean(frames.mean)),
        "variance": float(np.nanmean(frames.variance)) if several else np.nan,
        "saturation": frames.saturation,
        "saturated_pixels": int(np.count_nonzero(frames.saturated)),
        **known(rejected_beyond_sigmas=frames.reject),
        "dark_frames": 0 if frames.dark is None else int(frames.dark.count.max()),
        **findings_entry(frames.findings),
    }


def flagged(correction: Correction | DynamicCorrection) -> dict[str, int]:
    """Count the pixels that have each flag."""
    bits = correction.flags[correction.flags != 0]
    counts = {flag.name or "": int(np.count_nonzero(bits & flag)) for flag in Flag}
    return {name: count for name, count in counts.items() if count}


def of_calibration(calibration: Calibration) -> dict[str, Any]:
    """Collect the main figures of a calibration."""
    sensitivity, components = calibration.sensitivity, calibration.components
    options = calibration.metadata.get("options", {})
    return {
        **known(sensor=sensor_of(calibration)),
        "shape": list(calibration.shape),
        **_colours(calibration),
        "sensitivity_mean": float(np.nanmean(sensitivity, dtype=np.float64)),
        "sensitivity_spread": float(np.nanstd(sensitivity, dtype=np.float64)),
        **_uncertainty(calibration),
        "converged": calibration.converged,
        "error_estimate": calibration.error_estimate,
        "sweeps": calibration.sweeps,
        _misfit_name(options): calibration.reduced_chi2,
        "components": components if components > 1 or calibration.error_estimate <= FAR else np.nan,
        "shift_sign": calibration.shift_sign,
        **known(orientation=calibration.orientation and calibration.orientation.words),
        "fluxes": options.get("flux", "known"),
        "flagged_pixels": flagged(calibration),
        **_rejected(calibration),
        "is_partial": calibration.is_partial,
        "exposures": [*_exposures(calibration)],
        **findings_entry(calibration.findings),
    }


def _exposures(calibration: Calibration) -> Iterator[dict[str, Any]]:
    """Name, shift with its standard deviation where it is known, and flux of each exposure.

    Unless that of the shift as fitted was found, it is that of the measurement of the shift.
    """
    shifts, std = calibration.shifts, calibration.shift_std
    measured = np.array(calibration.metadata.get("measured_shift_std", 0.0))
    if std is None and measured.any():
        std = measured
    names = calibration.metadata.get("exposures", range(len(shifts)))
    darks = calibration.metadata.get("darks", [""] * len(shifts))
    for number, name in enumerate(names):
        yield {
            "exposure": str(name),
            "shift": shifts[number].tolist(),
            "shift_std": None if std is None else std[number].tolist(),
            "flux": float(calibration.flux[number]),
            "dark": darks[number] or None,
        }


def of_comparison(comparison: Comparison) -> dict[str, Any]:
    """Collect the main figures of a comparison."""
    pairs = comparison.pairs.tolist()
    return {
        "pixels_compared": int(np.isfinite(comparison.agreement).sum()),
        "verdicts": {
            f"{i} − {j}:": verdict
            for (i, j), verdict in zip(pairs, comparison.verdicts, strict=True)
        },
    }


COMPARED = ("relative difference", "found", "predicted", "ratio", "by noise")
"""Titles of the rows that say how far two calibrations agree."""


def rows_of(comparison: Comparison, pair: int) -> list[tuple[str, ...]]:
    """Rows of a pair: what is judged, with the ratios that noise alone gives, then the rest."""
    rows = {
        each.what: (
            each.found,
            each.predicted,
            f"{each.times:.3g}",
            f"{each.low:.3g} to {each.high:.3g}",
        )
        for each in comparison.checks[pair]
    }
    for what, found, predicted in (
        ("pixels, rms", comparison.rms, comparison.predicted_rms),
        ("16×16 means, rms", comparison.block_rms, comparison.predicted_block_rms),
        ("largest of a pixel", comparison.largest, None),
    ):
        known = math.nan if predicted is None else float(predicted[pair])
        rows.setdefault(what, (float(found[pair]), known, "", ""))
    return [
        (what, f"{found:.2e}", f"{known:.2e}" if math.isfinite(known) else "not known", *limits)
        for what, (found, known, *limits) in rows.items()
    ]


def _rejected(calibration: Calibration) -> dict[str, Any]:
    """Count the values of each exposure that a robust calibration left out, by its name."""
    counts = calibration.metadata.get("rejected")
    if counts is None:
        return {}
    names = calibration.metadata.get("exposures", range(len(counts)))
    return {"rejected_values": dict(zip(map(str, names), counts, strict=True))}


def _misfit_name(options: dict[str, Any]) -> str:
    """Name of the mean square residual: without variances it is a variance in DN²."""
    return "variance_of_a_value" if options.get("weights") == "equal" else "reduced_chi2"


def _uncertainty(calibration: Calibration) -> dict[str, Any]:
    """Standard deviations by noise, if they were computed, and their exactness."""
    std, tilt_std = calibration.sensitivity_std, calibration.tilt_std
    if std is None or tilt_std is None:
        return {}
    exactness = calibration.metadata["uncertainty"]["relative_standard_error"]
    return {
        "sensitivity_std": float(np.nanmedian(std)),
        "sensitivity_std_is_exact_to": exactness,
        "tilt": dict(zip(("rows", "cols"), calibration.tilt.tolist(), strict=True)),
        "tilt_std": dict(zip(("rows", "cols"), tilt_std.tolist(), strict=True)),
        "tilt_is": _tilt_in_words(tilt_std),
    }


def _tilt_in_words(std: Array) -> str:
    """Say which tilts are undetermined: JSON has no infinite standard deviation."""
    names = [name for name, each in zip(("rows", "cols"), std, strict=True) if np.isinf(each)]
    return f"undetermined along {' and '.join(names)}, and set to 0" if names else "determined"


_FIGURES: dict[type, Callable[[Any], dict[str, Any]]] = {
    FrameStatistics: of_statistics,
    Calibration: of_calibration,
    Response: of_response,
    Comparison: of_comparison,
    DynamicCorrection: of_dynamic,
    Table: of_table,
    **dict.fromkeys(METHODS.values(), of_scene),
}
"""What collects the main figures of each kind of result."""


FIGURES = {
    "mean": ("mean", "DN"),
    "variance": ("variance of a frame", "DN²"),
    "saturation": ("saturation", "DN"),
    "rejected_beyond_sigmas": ("rejected beyond", "standard deviations"),
    "levels": ("levels", "DN"),
    "spread_of_a": ("spread of the offset a", "DN"),
    "spread_of_K": ("spread of the gain deviation K", ""),
    "spread_of_c": ("spread of the curvature c", "1/DN"),
    "spread_of_e": ("spread of the cubic term e", "1/DN²"),
    "prediction_errors": (
        "prediction errors, in variances of a level (DN² where no noise is known)",
        "",
    ),
    "offset_prediction_errors": ("rms errors of predicted offsets, order 0 and up", "DN"),
    "gain_prediction_errors": ("rms errors of predicted gains, order 0 and up, relative", ""),
    "variance_of_a_value": ("variance of a value", "DN²"),
    "largest_inverse_error": ("largest error of the inverse", "DN"),
    "degree": ("degree of the correction in raw values", ""),
    "scene_data_range": ("range of the scene", "DN"),
    "floor_dn": ("floor of the pattern", "DN"),
    "offset_rms": ("rms of the offset", "DN"),
    "substrate_c": ("temperature of the substrate", "°C"),
    "bias_v": ("bias", "V"),
    "reduced_chi2": ("reduced χ²", ""),
    "colour_response": ("mean response of each colour (M has mean 1 within each)", ""),
    "sensitivity_mean": ("mean of M", ""),
    "sensitivity_spread": ("spread of M", ""),
    "sensitivity_std": ("median standard deviation of M", ""),
    "sensitivity_std_is_exact_to": ("relative error of the standard deviation of M", ""),
    "tilt": ("tilt of M, edge to edge", ""),
    "tilt_std": ("standard deviation of the tilt", ""),
    "error_estimate": ("estimated error of M that the solver left", ""),
    "centre": ("centre (row, col)", "pixels"),
    "row": ("row", "pixels"),
    "col": ("col", "pixels"),
    "focal_length": ("focal length", "pixels"),
    "k1": ("k1 of (r over half the diagonal)²", ""),
    "k2": ("k2 of (r over half the diagonal)⁴", ""),
    "std": ("standard errors", ""),
    "least_illumination": ("least illumination, relative to the centre", ""),
    "t": ("time t", ""),
    "v": ("rows v", ""),
    "h": ("columns h", ""),
    "tv": ("rows and time tv", ""),
    "th": ("columns and time th", ""),
    "vh": ("pixels vh", ""),
    "tvh": ("pixels and time tvh", ""),
    "flagged_share": ("share of flagged pixels", ""),
    "sweeps": ("passes of the solver over the data", ""),
    "components": ("separate parts of the sensor", ""),
    "orientation": ("orientation of the shifts", ""),
    "is_partial": ("determines less than half of the pixels", ""),
    "dark_frames": ("dark frames subtracted", ""),
    "spatial_variance": ("spatial variance", "DN²"),
    "temporal_variance": ("temporal variance", "DN²"),
    "noise_variances": ("variances of noise", "DN²"),
    "steps": ("steps in DN, that of the gain a ratio", ""),
    "base": ("output of the sum 0", "steps of the output"),
    "zero": ("corrected value of the output 0", "steps of the output"),
    "largest_error_dn": ("largest error of rounded gains and offsets", "DN"),
    "rounding_dn": ("beside it, by rounding of ADC and output", "DN"),
    "sag_dn": ("sag of the line", "DN"),
}
"""Names and units of figures; of all others the name is the key, and there is no unit."""

_WHOLE = 1e9
"""Whole numbers below this are printed with all digits, as saturation levels are."""

_NOTHING = ("none", "not determined")


def words_of(
    figures: dict[str, Any], without: Collection[str] = ("findings", "exposures")
) -> list[tuple[str, str]]:
    """Names and values of figures in words, some left out.

    The sign of the shifts is part of what the orientation says in words.
    """
    left_out = {*without} | ({"shift_sign"} if "orientation" in figures else set())
    return [
        (
            name_of(key),
            "{} rows × {} columns".format(*value)
            if key == "shape"
            else in_words(value, _unit(key)),
        )
        for key, value in figures.items()
        if key not in left_out
    ]


def name_of(key: str) -> str:
    """Name of a figure in words."""
    return FIGURES.get(key, (key.replace("_", " "), ""))[0]


def _unit(key: str) -> str:
    return FIGURES.get(key, ("", ""))[1]


def in_words(value: Any, unit: str = "") -> str:
    """Write a value with its unit; what is no number is not determined."""
    text = _plain(value)
    return f"{text} {unit}" if unit and text not in _NOTHING else text


def _plain(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return _number(value, ".0f" if value.is_integer() and abs(value) < _WHOLE else ".4g")
        case dict():
            return (
                ", ".join(
                    f"{FIGURES.get(k, (k,))[0]} {in_words(each, _unit(k))}"
                    for k, each in value.items()
                )
                or "none"
            )
        case [] | () | None:
            return "none"
        case [dict(), *_]:
            return "\n".join(map(_row, value))
        case [float(), *_]:
            return ", ".join(_number(item, ".6g") for item in value)
        case [str(), *_]:
            return ", ".join(value)
        case list() | tuple():
            return " × ".join(str(item) for item in value)
    return str(value)


def _number(value: float, form: str) -> str:
    """Write a number; what is none is not determined."""
    return f"{value:{form}}" if math.isfinite(value) else "not determined"


def _row(fields: dict[str, Any]) -> str:
    """Words of a row: of a finding its kind and its message, else numbers with their names."""
    return f"{fields['kind']}: {fields['message']}" if "kind" in fields else _plain(fields)


def pair_in_words(values: Any, std: Any) -> str:
    """Row and column with their standard deviations, where they are known."""
    errors = (None, None) if std is None else std
    return ", ".join(
        f"{value:.4f}" + (f" ± {error:.4f}" if error else "")
        for value, error in zip(values, errors, strict=True)
    )
