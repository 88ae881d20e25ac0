"""Main figures of results, with their names and units."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from equipix._check import Array
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.calibration.result import Calibration
from equipix.correction.protocol import Correction, sensor_of
from equipix.diagnosis.coverage import FAR
from equipix.findings import Findings, Flag, usable
from equipix.io.record import Record
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.response import Response, common_misfit
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneCorrection

_LEARNED = ("method", "data_range", "frames")
"""Keys of a scene's metadata that are shown."""


def summary(content: Record | Correction | SceneCorrection) -> dict[str, Any]:
    """Collect the main figures of what a file holds."""
    figures: Callable[[Any], dict[str, Any]] = _FIGURES.get(type(content), _of_correction)
    return figures(content)


def known(**figures: Any) -> dict[str, Any]:
    """Leave out what is not known."""
    return {name: value for name, value in figures.items() if value not in (None, "")}


def told(findings: Findings, *, as_json: bool = True) -> dict[str, Any]:
    """Findings; their kinds alone where messages are on stderr, as warnings, already."""
    return {"findings": [asdict(each) if as_json else each.kind for each in findings]}


def _of_correction(correction: Correction) -> dict[str, Any]:
    """Collect the main figures of any correction, and how it was learned from a scene."""
    scene = correction.metadata.get("scene")
    learned = scene if isinstance(scene, dict) else {}
    return {
        **known(sensor=sensor_of(correction)),
        "shape": list(correction.shape),
        "order": len(correction.coefficients) - 1,
        **{f"scene_{name}": learned[name] for name in _LEARNED if name in learned},
        "flagged_pixels": flagged(correction),
        **told(correction.findings),
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
        **told(response.findings),
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
    named = texts != [str(number) for number in range(len(levels))]
    return {"level_values": [" ".join(each.split()) for each in texts]} if named else {}


def _misfit(response: Response, options: dict[str, Any]) -> float:
    """Median reduced χ² over that of noise; without variances the mean, a variance in DN²."""
    judged = usable(response.flags) & (response.freedom > 0)
    if options.get("weights") == "equal" and judged.any():
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
        "gain_order": None if correction.gain is None else correction.gain_axes.order,
        "flagged_pixels": flagged(correction),
        **told(correction.findings),
    }


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
        **told(frames.findings),
    }


def flagged(correction: Correction | DynamicCorrection) -> dict[str, int]:
    """Count the pixels that have each flag."""
    return {
        flag.name or "": int(np.count_nonzero(correction.flags & flag))
        for flag in Flag
        if (correction.flags & flag).any()
    }


def of_calibration(calibration: Calibration) -> dict[str, Any]:
    """Collect the main figures of a calibration."""
    sensitivity, components = calibration.sensitivity, calibration.components
    options = calibration.metadata.get("options", {})
    return {
        **known(sensor=sensor_of(calibration)),
        "shape": list(calibration.shape),
        **_colours(calibration),
        "mean": float(np.nanmean(sensitivity, dtype=np.float64)),
        "spread": float(np.nanstd(sensitivity, dtype=np.float64)),
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
        **told(calibration.findings),
    }


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
    DynamicCorrection: of_dynamic,
    **dict.fromkeys(METHODS.values(), of_scene),
}
"""What collects the main figures of each kind of result."""


FIGURES = {
    "mean": ("mean", "DN"),
    "variance": ("variance of a frame", "DN²"),
    "saturation": ("saturation", "DN"),
    "levels": ("levels", "DN"),
    "spread_of_a": ("spread of the offset a", "DN"),
    "spread_of_K": ("spread of the gain deviation K", ""),
    "spread_of_c": ("spread of the curvature c", "1/DN"),
    "spread_of_e": ("spread of the cubic term e", "1/DN²"),
    "variance_of_a_value": ("variance of a value", "DN²"),
    "largest_inverse_error": ("largest error of the inverse", "DN"),
    "floor_dn": ("floor of the pattern", "DN"),
    "offset_rms": ("rms of the offset", "of the range"),
    "substrate_c": ("temperature of the substrate", "°C"),
    "bias_v": ("bias", "V"),
    "reduced_chi2": ("reduced χ²", ""),
    "sensitivity_std": ("standard deviation of M, median", ""),
    "tilt": ("tilt of M, edge to edge", ""),
    "tilt_std": ("standard deviation of the tilt", ""),
}
"""Names and units of figures; of all others the name is the key, and there is no unit."""


def words_of(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and values of figures in words, findings left out."""
    return [
        (FIGURES.get(key, (key.replace("_", " "), ""))[0], _words_of(key, value))
        for key, value in figures.items()
        if key != "findings"
    ]


def _words_of(key: str, value: Any) -> str:
    unit = FIGURES.get(key, ("", ""))[1]
    return f"{_plain(value)} {unit}".strip()


def _plain(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case None:
            return "not known"
        case float():
            return f"{value:.4g}"
        case dict():
            return ", ".join(f"{name} {_plain(item)}" for name, item in value.items()) or "none"
        case list() | tuple():
            return ", ".join(_plain(item) for item in value) or "none"
    return str(value)
