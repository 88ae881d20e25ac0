"""Figures of EMVA 1288, release 4.0 linear, from frames."""

from __future__ import annotations

import numpy as np


def figures(bright, dark, photons, seconds, many, many_dark):
    """Figures of pairs of frames at all levels, and of many frames at one.

    The units are those of the standard: %, e-, DN and photons.
    """
    photons, seconds = np.array(photons), np.array(seconds)
    means, variances = np.array([pair_moments(pair) for pair in bright]).T
    dark_means, dark_variances = np.array([pair_moments(pair) for pair in dark]).T
    signal, noise = means - dark_means, variances - dark_variances
    at = int(np.argmax(variances))
    low = signal <= 0.7 * signal[at]
    gain = np.sum(signal[low] * noise[low]) / np.sum(signal[low] ** 2)
    responsivity = np.sum(photons[low] * signal[low]) / np.sum(photons[low] ** 2)
    efficiency = responsivity / gain
    current, _ = line(seconds, dark_means)
    current_by_noise, dark_variance = line(seconds, dark_variances)
    threshold = np.sqrt(dark_variance / gain**2 + 0.25) + 0.5
    saturation = efficiency * photons[at]
    used = (signal >= 0.05 * signal[at]) & (signal <= 0.95 * signal[at])
    slope, offset = line(photons[used], signal[used], 1 / signal[used])
    fitted = offset + slope * photons[used]
    found = {
        "gain_dn_per_e": gain,
        "inverse_gain_e_per_dn": 1 / gain,
        "responsivity_dn_per_photon": responsivity,
        "quantum_efficiency_percent": 100 * efficiency,
        "dark_noise_dn": np.sqrt(dark_variance),
        "dark_noise_e": np.sqrt(dark_variance - 1 / 12) / gain,
        "snr_max": np.sqrt(saturation),
        "snr_max_db": 10 * np.log10(saturation),
        "snr_max_bits": np.log2(saturation) / 2,
        "inverse_snr_max_percent": 100 / np.sqrt(saturation),
        "threshold_photons": threshold / efficiency,
        "threshold_e": threshold,
        "saturation_photons": photons[at],
        "saturation_e": saturation,
        "dynamic_range": saturation / threshold,
        "dynamic_range_db": 20 * np.log10(saturation / threshold),
        "dynamic_range_bits": np.log2(saturation / threshold),
        "linearity_error_percent": 100 * np.mean(np.abs(signal[used] / fitted - 1)),
        "dark_current_mean_e_per_s": current / gain,
        "dark_current_variance_e_per_s": current_by_noise / gain**2,
    }
    lit, off = parts(many, lambda image: image), parts(many_dark, lambda image: image)
    high, high_off = parts(many, high_passed), parts(many_dark, high_passed)
    span = np.mean(many) - np.mean(many_dark)
    assert lit.keys() == off.keys()
    for name, square in off.items():
        found[f"dsnu{name}_e"] = signed(square) / gain
        found[f"prnu{name}_percent"] = 100 * signed(high[name] - high_off[name]) / span
    return found | {"dsnu_dn": signed(off[""])}


def pair_moments(pair):
    """Mean and temporal variance of two frames."""
    first, second = (frame.astype(float) for frame in pair)
    square = np.mean((first - second) ** 2) - (first.mean() - second.mean()) ** 2
    return (first.mean() + second.mean()) / 2, square / 2


def line(x, y, weights=None):
    """Slope and offset of a line of least squares, by the normal equations."""
    w = np.ones(len(x)) if weights is None else weights**2
    middle = np.sum(w * x) / np.sum(w)
    slope = np.sum(w * (x - middle) * y) / np.sum(w * (x - middle) ** 2)
    return slope, np.sum(w * y) / np.sum(w) - slope * middle


def parts(frames, filtered):
    """Variances between all pixels, rows, columns and single pixels of many frames."""
    frames = np.asarray(frames, float)
    count, rows, cols = frames.shape
    free = frames - frames.mean(axis=(1, 2), keepdims=True)
    temporal = free.var(axis=0, ddof=1).mean()
    image = filtered(frames.mean(axis=0))
    total = image.var(ddof=1) - temporal / count
    of_cols = image.mean(axis=0).var(ddof=1) - temporal / count / rows
    of_rows = image.mean(axis=1).var(ddof=1) - temporal / count / cols
    size, rest = rows * cols, rows * cols - rows - cols
    return {
        "": total,
        "_row": ((size - cols) * of_rows - rows * (total - of_cols)) / rest,
        "_column": ((size - rows) * of_cols - cols * (total - of_rows)) / rest,
        "_pixel": size * (total - of_cols - of_rows) / rest,
    }


def high_passed(image):
    """The image less its means over 7×7, 11×11 and binomial 3×3 pixels."""
    smooth = image
    for weights in (np.ones(7) / 7, np.ones(11) / 11, np.array([1, 2, 1]) / 4):
        half = len(weights) // 2
        padded = np.pad(smooth, half, mode="symmetric")
        rows = np.apply_along_axis(np.convolve, 0, padded, weights, mode="valid")
        smooth = np.apply_along_axis(np.convolve, 1, rows, weights, mode="valid")
    return image - smooth


def signed(square):
    """The root with the sign of what it is taken of."""
    return np.sign(square) * np.sqrt(abs(square))
