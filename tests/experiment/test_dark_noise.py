"""The noise of a dark that was subtracted from all exposures."""

from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import Flag, simulate
from equipix.errors import IdentifiabilityWarning, InputError
from equipix.io.tiff import write_frames

SHAPE = (80, 100)
SHIFTS = equipix.cross_pattern(5, 7)
FRAMES = 40
READ_NOISE, GAIN, LEVEL = 6.0, 0.01, 2000.0
DARK_FRAMES = (200, 40, 10, 4)


def smooth(row, col):
    return LEVEL * np.exp(-((row - 40) ** 2 + (col - 50) ** 2) / 300**2)


def steep(row, col):
    waves = np.sin(0.45 * row + 0.15 * col) + np.sin(0.4 * col - 0.2 * row + 1)
    return smooth(row, col) * (1 + 0.2 * waves)


def sensitivity(shape):
    truth = simulate.paper_sensitivity(shape, rng=3)
    return truth / truth.mean()


class Camera:
    """Frames and dark frames of one experiment, whole numbers in DN."""

    def __init__(self, dark_frames, *, beam=smooth, shifts=SHIFTS, seed=1):
        self.rng = np.random.default_rng([seed, dark_frames])
        self.truth = sensitivity(SHAPE)
        self.offset = 100 + self.rng.normal(0, 3, SHAPE)
        signals = [self.truth * simulate.beams.window(beam, SHAPE, d) for d in shifts]
        self.dark = self.take(np.zeros(SHAPE), dark_frames)
        self.exposures = [self.take(signal, FRAMES) for signal in signals]

    def take(self, signal, count):
        std = np.sqrt(READ_NOISE**2 + GAIN * signal)
        frames = self.offset + signal + std * self.rng.standard_normal((count, *SHAPE))
        return np.rint(frames).astype(np.uint16)

    def statistics(self):
        dark = equipix.average(self.dark)
        return [equipix.average(frames, dark=dark) for frames in self.exposures]

    def means(self):
        return np.array([frames.mean(0) for frames in self.exposures]) - self.dark.mean(0)

    def noise(self):
        """Noise of the mean of an exposure, rounding included, and variance of the dark mean."""
        read = READ_NOISE**2 + 1 / 12
        model = equipix.NoiseModel(read_noise=np.sqrt(read), gain=GAIN).of_mean(FRAMES)
        return {"variance": model, "dark_variance": read / len(self.dark)}

    def experiment(self, folder: Path) -> Path:
        text = '[sensor]\nsaturation = 65535\n[dark]\nframes = "dark.tif"\n'
        write_frames(folder / "dark.tif", iter(self.dark), nbytes=self.dark.nbytes)
        for k, (frames, shift) in enumerate(zip(self.exposures, SHIFTS, strict=True)):
            write_frames(folder / f"{k}.tif", iter(frames), nbytes=frames.nbytes)
            text += (
                f'[[exposure]]\nname = "{k}"\nframes = "{k}.tif"\nshift = {list(map(int, shift))}\n'
            )
        (folder / "experiment.toml").write_text(text)
        return folder / "experiment.toml"


def check(cal, truth):
    """Errors agree with the standard deviations, residuals with the variances.

    Within four standard errors.
    """
    z = (cal.sensitivity - truth) / cal.sensitivity_std
    z = z[np.isfinite(z)]
    # The map itself is exact to 2 %, in some fifty draws that all pixels share.
    assert abs(np.sqrt(np.mean(z**2)) - 1) < 4 * np.hypot(
        1 / np.sqrt(2 * z.size), 0.02 / np.sqrt(50)
    )
    freedom = cal.weighted.fit.degrees_of_freedom
    assert abs(cal.reduced_chi2 - 1) < 4 * np.sqrt(2 / freedom)


@pytest.mark.parametrize("dark_frames", DARK_FRAMES)
def test_error_bars_of_averages(dark_frames):
    camera = Camera(dark_frames)
    cal = equipix.calibrate(camera.statistics(), SHIFTS, uncertainty=True, tolerance=1e-5)
    check(cal, camera.truth)


@pytest.mark.parametrize("dark_frames", DARK_FRAMES)
@pytest.mark.parametrize(
    "shifts", [SHIFTS, SHIFTS + 0.4 * np.array([[0, 0], [1, -1], [-1, 0], [0, 1], [1, 1]])]
)
@pytest.mark.parametrize("beam", [smooth, steep])
def test_error_bars_of_arrays(dark_frames, shifts, beam):
    camera = Camera(dark_frames, beam=beam, shifts=shifts)
    cal = equipix.calibrate(
        camera.means(), shifts, uncertainty=True, tolerance=1e-5, **camera.noise()
    )
    check(cal, camera.truth)


def test_error_bars_of_files(tmp_path):
    camera = Camera(4)
    cal = equipix.Experiment.load(camera.experiment(tmp_path)).run(uncertainty=True, tolerance=1e-5)
    check(cal, camera.truth)


def test_all_doors_lead_to_the_same_standard_deviations(tmp_path):
    camera = Camera(4)
    options = {"uncertainty": True, "tolerance": 1e-5}
    averages = equipix.calibrate(camera.statistics(), SHIFTS, **options)
    files = equipix.Experiment.load(camera.experiment(tmp_path)).run(**options)
    # The files are kept as float32.
    np.testing.assert_allclose(files.sensitivity_std, averages.sensitivity_std, rtol=1e-4)


def narrow(row, col):
    return LEVEL * np.exp(-((row - 40) ** 2 + (col - 50) ** 2) / 25**2)


def test_pixels_that_the_dark_leaves_unknown_are_flagged():
    camera = Camera(4, beam=narrow)
    with pytest.warns(IdentifiabilityWarning, match="average more dark frames"):
        cal = equipix.calibrate(camera.statistics(), SHIFTS, uncertainty=True)
    used = (cal.flags & Flag.DO_NOT_USE) == 0
    assert cal.sensitivity[used].mean() == pytest.approx(1, abs=1e-9)
    # 4 % by the noise of the pixel and its dark; what the beam's error adds is in the error bars.
    std = cal.sensitivity_std[used]
    assert np.quantile(std, 0.99) < 0.05
    error = cal.sensitivity - camera.truth / camera.truth[used].mean()
    # Of some thousand normal values one is beyond 5 in one time of 500.
    assert abs(error[used] / std).max() < 5


def test_functionals_of_a_noisy_dark():
    """The mean of ln M over a quarter of the sensor, and the tilt, over 50 experiments."""
    shape, shifts, beam = (16, 20), equipix.cross_pattern(2, 3), smooth
    truth = sensitivity(shape)
    clean = np.array([truth * simulate.beams.window(beam, shape, d) for d in shifts])
    weights = np.zeros(shape)
    weights[:8, :10] = 1 / 80
    rng = np.random.default_rng(5)
    z = []
    for _ in range(50):
        common = 9.0 * rng.standard_normal(shape)
        frames = clean + 3.0 * rng.standard_normal(clean.shape) - common
        cal = equipix.calibrate(
            frames, shifts, variance=np.full(5, 9.0), dark_variance=81.0, uncertainty=True
        )
        mean = np.sum(weights * np.log(cal.sensitivity / truth))
        z.append([mean / cal.std_of(weights), *(cal.tilt - tilt(truth)) / cal.tilt_std])
    assert np.all(np.abs(np.sqrt(np.mean(np.square(z), 0)) - 1) < 4 / np.sqrt(2 * len(z)))


def tilt(image):
    return equipix.metrics.maps.tilt(image, np.ones(image.shape, bool))


def test_the_dark_has_no_part_in_the_weights():
    camera = Camera(4)
    noise = camera.noise()
    with_dark = equipix.calibrate(camera.means(), SHIFTS, **noise)
    without = equipix.calibrate(camera.means(), SHIFTS, variance=noise["variance"])
    np.testing.assert_array_equal(with_dark.sensitivity, without.sensitivity)


def test_the_variance_of_a_dark_per_pixel_is_that_of_all():
    camera = Camera(4)
    noise = camera.noise()
    each = noise | {"dark_variance": np.full(SHAPE, noise["dark_variance"])}
    one, other = (
        equipix.calibrate(camera.means(), SHIFTS, uncertainty=True, **given)
        for given in (noise, each)
    )
    np.testing.assert_array_equal(one.sensitivity_std, other.sensitivity_std)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.ones((2, 3)), r"'dark_variance' has shape \(2, 3\)"),
        (np.ones(5), "'dark_variance'"),
        (-1.0, "'dark_variance' holds -1"),
        (np.nan, "'dark_variance' holds nan"),
    ],
)
def test_a_wrong_variance_of_the_dark_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        equipix.calibrate(Camera(4).means(), SHIFTS, dark_variance=given)


def test_a_fitted_dark_excludes_the_variance_of_a_subtracted_one():
    with pytest.raises(InputError, match="'dark' is 'fit'"):
        equipix.calibrate(Camera(4).means(), SHIFTS, dark="fit", dark_variance=1.0)
