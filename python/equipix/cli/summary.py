"""Main figures of what the command line reads and writes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from equipix._check import Array
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.calibration.result import Calibration
from equipix.correction.protocol import Correction, sensor_of
from equipix.findings import Flag, usable
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.response import Response, common_misfit
from equipix.scene.scene_correction import SceneCorrection


def summary(
    content: Correction | DynamicCorrection | FrameStatistics | SceneCorrection,
) -> dict[str, Any]:
    """Collect the main figures of what a file holds."""
    if isinstance(content, FrameStatistics):
        return of_statistics(content)
    if isinstance(content, Calibration):
        return of_calibration(content)
    if isinstance(content, Response):
        return of_response(content)
    if isinstance(content, DynamicCorrection):
        return of_dynamic(content)
    if isinstance(content, SceneCorrection):
        return of_scene(content)
    return {
        **_sensor(content),
        "shape": list(content.shape),
        "order": len(content.coefficients) - 1,
        **_learned(content),
        "flagged_pixels": flagged(content),
    }


def _learned(correction: Correction) -> dict[str, Any]:
    """How a correction was learned from a scene, where it was."""
    scene = correction.metadata.get("scene")
    if not isinstance(scene, dict):
        return {}
    return {f"scene_{name}": scene.get(name) for name in ("method", "data_range", "frames")}


def of_response(response: Response) -> dict[str, Any]:
    """Collect the main figures of response curves."""
    good = usable(response.flags)
    options = response.metadata.get("options", {})
    spread = {
        f"spread_of_{name}": float(np.std(plane[good]))
        for name, plane in zip("aKce", response.deviation, strict=False)
    }
    prediction = options.get("prediction_errors")
    return {
        **_sensor(response),
        "shape": list(response.shape),
        "order": 0 if options.get("by") == "gain" else response.order,
        "levels": [float(f"{level:.6g}") for level in response.levels],
        **_level_values(response),
        **_colours(response),
        **spread,
        _misfit_name(options): _misfit(response, options),
        "largest_inverse_error": response.largest_inverse_error,
        **({} if prediction is None else {"prediction_errors": prediction}),
        "flagged_pixels": flagged(response),
    }


def _sensor(correction: Correction) -> dict[str, str]:
    """Name of the sensor, where it is known."""
    name = sensor_of(correction)
    return {"sensor": name} if name else {}


def _colours(correction: Calibration | Response) -> dict[str, str]:
    """Colour filters and the responses of the colours, of mean 1, where there are any."""
    if correction.cfa is None or correction.colour_response is None:
        return {}
    found = [f"{label} {value:.4g}" for label, value in correction.colour_response.items()]
    return {"cfa": str(correction.cfa), "colour_response": ", ".join(found)}


def _level_values(response: Response) -> dict[str, list[str]]:
    """Values of the levels with their units, or the names, where levels.toml has any."""
    levels = response.metadata.get("levels", [])
    texts = [
        each["name"] if each["value"] is None else f"{each['value']:g} {each['unit'] or ''}"
        for each in levels
    ]
    named = texts != [str(number) for number in range(len(levels))]
    return {"level_values": [" ".join(each.split()) for each in texts]} if named else {}


def _misfit(response: Response, options: dict[str, Any]) -> float | str:
    """Median reduced χ² over that of noise; without variances the mean, a variance in DN²."""
    judged = usable(response.flags) & (response.freedom > 0)
    if not judged.any():
        return "not determined"
    if options.get("weights") == "equal":
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
    }


def of_scene(method: SceneCorrection) -> dict[str, Any]:
    """Collect the main figures of a correction that learns from the scene."""
    return {
        "shape": list(method.shape),
        "scene_method": method.method,
        "scene_data_range": list(method.data_range),
        "usable_frames": method.frames_taken,
        "frames_that_counted": method.frames,
        "frames_foreign": method.frames_foreign,
        "floor_dn": method.floor,
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
        "variance": float(np.nanmean(frames.variance)) if several else float("nan"),
        "saturation": frames.saturation,
        "saturated_pixels": int(np.count_nonzero(frames.saturated)),
        **({} if frames.reject is None else {"rejected_beyond_sigmas": frames.reject}),
        "dark_frames": 0 if frames.dark is None else int(frames.dark.count.max()),
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
    sensitivity = calibration.sensitivity
    options = calibration.metadata.get("options", {})
    orientation = calibration.orientation
    return {
        **_sensor(calibration),
        "shape": list(calibration.shape),
        **_colours(calibration),
        "mean": float(np.nanmean(sensitivity, dtype=np.float64)),
        "spread": float(np.nanstd(sensitivity, dtype=np.float64)),
        **_uncertainty(calibration),
        "converged": calibration.converged,
        "error_estimate": calibration.error_estimate,
        "sweeps": calibration.sweeps,
        _misfit_name(options): calibration.reduced_chi2,
        "components": calibration.components,
        "shift_sign": calibration.shift_sign,
        **({"orientation": orientation.words} if orientation else {}),
        "fluxes": options.get("flux", "known"),
        "flagged_pixels": flagged(calibration),
        **_rejected(calibration),
        "is_partial": calibration.is_partial,
        "findings": [asdict(finding) for finding in calibration.findings],
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
