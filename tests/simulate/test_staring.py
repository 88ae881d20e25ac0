"""The virtual staring array, and what the source claims of corrections, shown on it."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import errors, metrics, nuc
from equipix.detector import photons as blackbody
from equipix.simulate import StaringArray

SHAPE = (48, 64)
LIGHT = (2e6, 5e6, 8e6, 11e6, 14e6)
"""Photoelectrons of the levels, of a well of 2e7."""
EPS = np.finfo(np.float64).eps


def spread(rms, seed=1, mean=1.0):
    return mean + rms * np.random.default_rng(seed).standard_normal(SHAPE)


def residual(array, order, light=6.5e6, **how):
    """Non-uniformity that a correction leaves at another level, in DN, without noise."""
    levels = {0: LIGHT[2:3], 1: LIGHT[::4], 2: LIGHT}[order]
    response = nuc.fit(np.stack([array.mean(each) for each in levels]), order=order)
    return float(np.std(response.correct(array.mean(light, **how), exact=True)))


def ratio(response, array, light, rng):
    """σ_spatial/σ_temporal of corrected frames, with its sign: the source's C."""
    frames = np.stack(list(array.frames(light, 32, rng=rng)))
    return metrics.correctability(response.correct(frames)).ratio


class TestCauses:
    """Each cause alone, and the order that removes it."""

    def test_an_offset_needs_one_point(self):
        array = StaringArray(shape=SHAPE, offset_dn=spread(50, mean=300.0))
        assert residual(array, 0) < 1e3 * EPS * 6000

    @pytest.mark.parametrize("cause", ["sensitivity", "area", "amplification"])
    def test_a_gain_needs_two_points(self, cause):
        array = StaringArray(shape=SHAPE, **{cause: spread(0.03)})
        assert residual(array, 1) < 1e4 * EPS * 6000
        # One point at 8e6 electrons leaves the spread of the difference to 6.5e6.
        assert residual(array, 0) == pytest.approx(
            1.5e6 * array.gain_dn_per_e * np.std(spread(0.03)), rel=1e-6
        )

    def test_the_area_of_a_pixel_collects_dark_current_too(self):
        array = StaringArray(shape=SHAPE, area=spread(0.03), dark_e=1e6)
        assert array.mean(0.0).std() == pytest.approx(
            1e6 * array.gain_dn_per_e * np.std(spread(0.03)), rel=1e-9
        )

    def test_a_curvature_that_differs_needs_three_points(self):
        array = StaringArray(shape=SHAPE, curvature=spread(0.01, mean=0.0))
        array = array.with_causes(curvature=array.curvature - np.mean(array.curvature))
        # Between two points 12e6 electrons apart n² deviates from the line by
        # (6.5 − 2)(14 − 6.5)·1e12 electrons².
        wanted = array.gain_dn_per_e * np.std(array.curvature) * 4.5e6 * 7.5e6 / array.well_e
        assert residual(array, 1) == pytest.approx(wanted, rel=1e-3)
        assert residual(array, 2) < 1e5 * EPS * 6000

    def test_a_cut_off_is_seen_in_the_light_of_a_black_body_alone(self):
        array = StaringArray(shape=SHAPE, cutoff_um=spread(0.02, mean=5.0))
        assert array.mean(5e6).std() < 1e-9
        assert array.mean(array.black_body(300.0, light_e=5e6)).std() > 10

    def test_a_warmer_detector_has_more_dark_current(self):
        array = StaringArray(shape=SHAPE, dark_e=spread(1e4, mean=1e5), doubling_k=6.0)
        assert residual(array, 1) < 1e4 * EPS * 6000
        shown = residual(array, 1, warmer_k=6.0)
        assert shown == pytest.approx(1e4 * array.gain_dn_per_e, rel=0.02)

    def test_a_drift_spoils_a_correction_with_time(self):
        array = StaringArray(shape=SHAPE, drift_dn=3.0, seed=5)
        now = array.mean(5e6, time_s=0.0)
        changes = [float(np.std(array.mean(5e6, time_s=t) - now)) for t in (0, 1, 60, 3600, 86400)]
        assert changes[0] == 0
        assert changes == sorted(changes)
        # Far apart two states of each pixel are independent: √2 of 3 DN, over 3072 pixels, of waves
        # of which the slowest have moved little in a day.
        assert 0.7 * 3 < changes[-1] < 1.1 * np.sqrt(2) * 3

    def test_a_pixel_without_sensitivity_has_gain_minus_one(self):
        sensitivity = np.ones(SHAPE)
        sensitivity[3, 4] = 0
        array = StaringArray(shape=SHAPE, sensitivity=sensitivity, dark_e=1e5)
        response = nuc.fit(np.stack([array.mean(each) for each in LIGHT]), order=1)
        assert response.deviation[1, 3, 4] == pytest.approx(-1, abs=1e-9)


class TestFrames:
    def test_their_mean_and_variance_are_those_stated(self):
        array = StaringArray.of("InSb", SHAPE, rng=2)
        statistics = equipix.average(array.frames(6e6, 64, rng=3))
        noise = array.temporal_noise(6e6)
        z = (statistics.mean - array.mean(6e6)) / noise * 8
        # 3072 normal values; the curvature lowers the noise by 2·0.005·0.3.
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.06)
        found = np.mean(statistics.variance / noise**2)
        assert found == pytest.approx((1 - 2 * 0.005 * 0.31) ** 2, abs=5 * np.sqrt(2 / 63 / 3072))

    def test_the_seed_gives_the_same_bytes(self):
        array = StaringArray.of("HgCdTe", SHAPE, rng=2)
        one, other = (next(array.frames(6e6, 1, rng=3)) for _ in range(2))
        assert one.tobytes() == other.tobytes()
        assert one.dtype == np.uint16

    def test_a_full_well_and_the_range_of_the_adc_limit_values(self):
        array = StaringArray(shape=SHAPE, bit_depth=8, offset_dn=60.0)
        frame = next(array.frames(1e9, 1, rng=1))
        assert frame.dtype == np.uint8
        assert frame.max() == 255
        assert array.electrons(1e9).max() == array.well_e

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"bit_depth": 7}, "'bit_depth' is 7"),
            ({"well_e": 0.0}, "'well_e' is 0"),
            ({"area": np.ones(3)}, r"'area' has shape \(3,\)"),
            ({"area": np.full(SHAPE, -0.1)}, "'area' holds -0.1, expected finite numbers not"),
            ({"read_noise_e": np.nan}, "'read_noise_e' holds nan"),
            ({"drift_dn": -1.0}, "'drift_dn' holds -1"),
            ({"offset_dn": np.inf}, "'offset_dn' holds inf, expected finite numbers"),
            ({"curvature": 1.5}, "'curvature' holds 1.5, expected finite numbers up to 0.5"),
            ({"band_start_um": 8.0}, "'cutoff_um' holds 5, expected .* 'band_start_um', 8"),
            ({"cutoff_um": 3.0}, "'cutoff_um' holds 3, expected"),
            ({"shape": (0, 4)}, "'shape'"),
        ],
    )
    def test_wrong_values_are_refused(self, given, message):
        with pytest.raises(errors.InputError, match=message):
            StaringArray(**({"shape": SHAPE} | given))

    @pytest.mark.parametrize("light", [np.nan, -1.0, np.inf])
    def test_light_that_is_none_is_refused(self, light):
        values = np.full(SHAPE, 5e6)
        values[3, 4] = light
        with pytest.raises(errors.InputError, match=f"'light_e' holds {light:g}, expected"):
            next(StaringArray(shape=SHAPE).frames(values, 1, rng=1))

    def test_an_unknown_material_is_refused(self):
        with pytest.raises(errors.InputError, match="'material' is 'Si'"):
            StaringArray.of("Si", SHAPE, rng=1)


class TestClaimsOfTheSource:
    @pytest.mark.parametrize(
        ("material", "enough"),
        [("PtSi", 1), ("InSb", 1), ("HgCdTe", 2)],
        ids=lambda each: str(each),
    )
    @pytest.mark.parametrize("seed", range(4, 9))
    def test_the_order_that_brings_spatial_noise_below_temporal_noise(self, material, enough, seed):
        array = StaringArray.of(material, SHAPE, rng=seed)
        averages = [
            equipix.average(array.frames(e, 64, rng=[seed, k])) for k, e in enumerate(LIGHT)
        ]
        for order in (0, 1, 2):
            levels = {0: averages[2:3], 1: averages[::4], 2: averages}[order]
            response = nuc.fit(levels, order=order)
            lights = enumerate((3.5e6, 6.5e6, 12.5e6))
            ratios = [ratio(response, array, light, rng=[seed, 9, k]) for k, light in lights]
            assert (max(ratios) < 1) == (order >= enough), (order, ratios)

    def test_four_levels_are_interpolated_by_the_cubic(self):
        array = StaringArray.of("HgCdTe", SHAPE, rng=5)
        means = np.stack([array.mean(each) for each in LIGHT[:4]])
        response = nuc.fit(means, order=3)
        for mean, reference in zip(means, response.levels, strict=True):
            corrected = response.correct(mean, exact=True)
            np.testing.assert_allclose(corrected, reference, rtol=1e5 * EPS)

    @pytest.mark.parametrize(
        ("start", "cutoff", "tolerance"), [(3.0, 5.1, 6.7e-4), (8.0, 10.6, 2.2e-3)]
    )
    def test_the_tolerance_of_the_composition_of_hgcdte(self, start, cutoff, tolerance):
        """Spread of x at which spatial equals temporal noise, after two points at 290 and 310 K."""
        x = np.linspace(0.15, 0.45, 30001)
        centre = x[np.argmin(np.abs(blackbody.hgcdte_cutoff(x) - cutoff))]
        composition = spread(tolerance, mean=centre)
        array = StaringArray(
            shape=SHAPE,
            cutoff_um=blackbody.hgcdte_cutoff(composition),
            band_start_um=start,
            well_e=1e9,
            offset_dn=0.0,
        )

        def electrons(temperature):
            return array.electrons(array.black_body(temperature, light_e=2e7))

        response = nuc.fit(np.stack([electrons(290.0), electrons(310.0)]), order=1)
        left = response.correct(electrons(300.0)).std()
        # The tolerance is given to two digits; the spread of 3072 values has 1.3 %.
        assert left / np.sqrt(2e7) == pytest.approx(1, abs=0.06)
        raw = electrons(300.0).std() / np.sqrt(2e7)
        assert raw > 100


class TestBlackBody:
    def test_photons_of_all_wavelengths_follow_the_cube_of_the_temperature(self):
        # ∫λ⁻⁴/(exp(c/λT) − 1) dλ = (T/c)³ Γ(3) ζ(3).
        wavelength = np.geomspace(0.5, 1e6, 400001)
        values = blackbody.photon_exitance(wavelength, 1000.0)
        integral = np.sum(np.diff(wavelength) * (values[1:] + values[:-1]) / 2)
        wanted = (1000 / 14387.768775) ** 3 * 2 * 1.2020569
        assert integral == pytest.approx(wanted, rel=1e-5)

    def test_cut_offs_far_apart_have_the_integrals_of_each(self):
        cutoffs = np.array([3.0, 3.01, 5.0, 5.1, 9.7, 12.0])
        together = blackbody.band_photons(3.0, cutoffs, 300.0)
        for cutoff, found in zip(cutoffs, together, strict=True):
            # The trapezium rule errs by h²/12 of the change of the slope: some 1e-8 of the whole.
            wavelength = np.linspace(3.0, cutoff, 20001)
            values = blackbody.photon_exitance(wavelength, 300.0)
            wanted = np.sum(np.diff(wavelength) * (values[1:] + values[:-1]) / 2)
            assert found == pytest.approx(wanted, rel=1e-7, abs=1e-30)
        assert together[0] == 0

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ((0.0, 5.0, 300.0), "'start_um' is 0.0"),
            ((3.0, 5.0, np.nan), "'temperature_k' is nan"),
            ((3.0, [5.0, 2.9], 300.0), "'cutoff_um' holds 2.9, expected 3 or more"),
            ((3.0, [5.0, np.nan], 300.0), "'cutoff_um' holds nan"),
        ],
    )
    def test_bands_that_are_none_are_refused(self, given, message):
        with pytest.raises(errors.InputError, match=message):
            blackbody.band_photons(*given)

    def test_the_gap_of_hansen(self):
        # Of x = 0.2 at 77 K, term by term.
        gap = 1.239841984 / blackbody.hgcdte_cutoff(0.2, 77.0)
        wanted = -0.302 + 0.386 - 0.0324 + 0.006656 + 5.35e-4 * 77 * 0.6
        assert gap == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_another_depth_scales_what_the_read_out_adds(bits):
    array = StaringArray.of("InSb", SHAPE, rng=1)
    other = array.with_causes(bit_depth=bits)
    share = 2.0**bits / 2**14
    np.testing.assert_allclose(other.offset_dn, share * np.asarray(array.offset_dn))
    np.testing.assert_allclose(other.drift_dn, share * np.asarray(array.drift_dn))
    given = array.with_causes(bit_depth=bits, offset_dn=60.0)
    assert given.offset_dn == 60.0
