"""The spread of composition that a correction tolerates: closed forms, laws, the source."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import detector, errors, nuc
from equipix.detector import photons as blackbody
from equipix.simulate import StaringArray

MIDDLE = detector.HgCdTe(start_um=3.0, cutoff_um=5.1)
LONG = detector.HgCdTe(start_um=8.0, cutoff_um=10.6)
BANDS = pytest.mark.parametrize("band", [MIDDLE, LONG], ids=["3-5.1", "8-10.6"])


def spread(band, **how):
    return detector.composition_tolerance(band, **how).spread


def per_composition(band, kelvin):
    """Electrons at 300 K for 1, their derivative by x: photons at the cut-off times dλ/dx."""
    x, step = band.composition, 1e-5
    ends = blackbody.hgcdte_cutoff([x - step, x + step], band.detector_k)
    rise = (ends[1] - ends[0]) / (2 * step)
    light = blackbody.band_photons(band.start_um, band.cutoff_um, 300.0)
    photons = blackbody.band_photons(band.start_um, band.cutoff_um, kelvin)
    return photons / light, blackbody.photon_exitance(band.cutoff_um, kelvin) * rise / light


class TestTolerance:
    @BANDS
    def test_a_small_spread_leaves_its_derivative(self, band):
        """At 2e13 electrons spreads are so small that deviations are linear in x to 1e-4."""
        (n, d), (n1, d1), (n2, d2) = (per_composition(band, each) for each in (300, 290, 310))
        left = {
            (): d,
            (290.0,): d - d1,
            (290.0, 310.0): d - d1 - (d2 - d1) * (n - n1) / (n2 - n1),
        }
        for references, each in left.items():
            found = spread(band, charge_e=2e13, references_k=references)
            assert found == pytest.approx(1 / np.sqrt(2e13) / abs(each), rel=1e-3)
        found = spread(band, charge_e=2e13, references_k=(290.0,), by="gain")
        assert found == pytest.approx(1 / np.sqrt(2e13) / abs(d - n / n1 * d1), rel=1e-3)

    @BANDS
    def test_random_pixels_corrected_by_a_fit_have_equal_noises(self, band):
        pixels = np.random.default_rng(3).standard_normal((64, 64))
        found = detector.composition_tolerance(band)
        cutoffs = blackbody.hgcdte_cutoff(band.composition + found.spread * pixels)
        array = StaringArray(
            shape=(64, 64), cutoff_um=cutoffs, band_start_um=band.start_um, well_e=1e9
        )
        cold, scene, hot = (array.black_body(each, light_e=2e7) for each in (290, 300, 310))
        left = nuc.fit(np.stack([cold, hot]), order=1).correct(scene).std()
        # The spread of 4096 normal values has a standard error of 1.1 %; the quadratic part of the
        # deviation, which differs for normal and even distributions, is below 1 % of the variance.
        assert left / np.sqrt(scene.mean()) == pytest.approx(1, abs=0.04)

    @BANDS
    def test_both_measures_of_a_spread_and_the_noise(self, band):
        found = detector.composition_tolerance(band, filled_k=310.0)
        assert found.half_width == pytest.approx(np.sqrt(3) * found.spread)
        share = float(band.photons(band.composition, 300.0) / band.photons(band.composition, 310.0))
        assert found.electrons == pytest.approx(2e7 * share)
        # The mean over the pixels differs from the mean pixel by some 1e-5 of the electrons.
        assert found.spread == pytest.approx(spread(band, charge_e=2e7 * share), rel=1e-3)

        def slope(wavelength):
            energy = 14387.768775 / (wavelength * 300.0)
            return energy / 300.0 / -np.expm1(-energy)

        rise = blackbody.band_photons(band.start_um, band.cutoff_um, 300.0, response=slope)
        rise /= blackbody.band_photons(band.start_um, band.cutoff_um, 300.0)
        # Central differences over ±0.3 K err by 0.3²/6 of the third derivative: some 2e-5.
        assert found.netd_k == pytest.approx(1 / np.sqrt(found.electrons) / rise, rel=1e-4)

    @BANDS
    def test_laws(self, band):
        # Noise grows with the root of the charge, and deviations with the charge. The curvature of
        # the deviation adds less than 1 % of the variance.
        assert spread(band) == pytest.approx(spread(band, charge_e=8e7) * 2, rel=0.01)
        wide = spread(band, references_k=(280.0, 320.0))
        assert wide < spread(band) / 3
        assert spread(band, references_k=(310.0, 290.0)) == pytest.approx(spread(band), rel=1e-5)
        order = [(), (290.0,), (290.0, 310.0)]
        found = [spread(band, references_k=each) for each in order]
        assert found == sorted(found)

    def test_no_spread_is_found_at_a_reference(self):
        with pytest.raises(
            errors.InputError, match="spreads of x from 1e-10 to 0.04.* times the tem"
        ):
            detector.composition_tolerance(MIDDLE, references_k=(280.0, 300.0))


class TestFilter:
    def test_its_slope_is_that_from_80_to_5_percent(self):
        found = detector.ShortPass(edge_um=4.7, slope=0.05, peak=0.9)
        wavelength = np.linspace(3.5, 6, 250001)
        passed = found.transmission(wavelength) / 0.9
        ends = [wavelength[np.argmin(np.abs(passed - each))] for each in (0.8, 0.05)]
        assert ends[1] - ends[0] == pytest.approx(0.05 * 4.7, abs=2e-5)
        assert float(found.transmission(4.7)) == pytest.approx(0.45)

    @BANDS
    def test_it_relaxes_the_tolerance_and_takes_longer(self, band):
        edge = 4.7 if band is MIDDLE else 9.6
        slopes = (0.4, 0.2, 0.05)
        behind = [
            replace(band, short_pass=detector.ShortPass(edge_um=edge, slope=each))
            for each in slopes
        ]
        found = [spread(each) for each in behind]
        assert [spread(band), *found] == sorted([spread(band), *found])
        # A logistic edge is symmetric: more passes than a sharp one by (π scale)²/6 of the slope of
        # the photons, with scale = slope·edge/ln 76. Its tail behind the cut-off is below 1e-3.
        sharp = blackbody.band_photons(band.start_um, [band.cutoff_um, edge], 300.0)
        low, high = blackbody.photon_exitance([edge - 0.01, edge + 0.01], 300.0)
        more = (np.pi * slopes[-1] * edge / np.log(76)) ** 2 / 6 * (high - low) / 0.02
        factor = behind[-1].integration_factor()
        assert factor == pytest.approx(sharp[0] / (sharp[1] + more), rel=1e-3)
        assert band.integration_factor() == 1

    def test_the_peak_takes_longer_and_changes_nothing_else(self):
        clear, dim = (
            replace(MIDDLE, short_pass=detector.ShortPass(edge_um=4.7, peak=each))
            for each in (1.0, 0.8)
        )
        assert dim.integration_factor() == pytest.approx(clear.integration_factor() / 0.8)
        assert spread(dim) == pytest.approx(spread(clear), rel=1e-5)


class TestEdge:
    @BANDS
    def test_its_width_moves_the_mean_cut_off(self, band):
        """The response is the distribution of −W ln(ln 2/e) with e exponential: mean −0.2107 W."""
        x, width = band.composition, 0.1
        soft = replace(band, edge_mev=width)
        moved = (np.euler_gamma + np.log(np.log(2))) * width / 1e3
        gap = float(blackbody.hgcdte_gap(x))
        sharp = blackbody.band_photons(
            band.start_um, [band.cutoff_um, 1.239841984 / (gap - moved)], 300.0
        )
        rise = float(soft.photons(x, 300.0)) - sharp[0]
        # Photons grow e-fold within some 20 meV, so the second order of a spread of π W/√6 adds
        # (π²/6) W/(2·0.21·20 meV): 2 %.
        assert rise == pytest.approx(sharp[1] - sharp[0], rel=0.05)

    def test_pixels_of_a_soft_edge_are_computed_one_by_one(self):
        soft, x = replace(LONG, edge_mev=3.0), LONG.composition + np.array([[0.0, 1e-3, -1e-3]])
        together = soft.photons(x, 300.0)
        assert together.shape == (1, 3)
        assert together[0, 1] == float(soft.photons(x[0, 1], 300.0))
        assert spread(soft) == pytest.approx(spread(LONG), rel=0.1)


class TestSource:
    """What the source states and DESIGN reproduces, to the digits given."""

    @pytest.mark.parametrize(
        ("band", "how", "wanted"),
        [
            (MIDDLE, {}, "6.7e-04"),
            (LONG, {}, "2.2e-03"),
            (MIDDLE, {"references_k": ()}, "4.5e-06"),
        ],
    )
    def test_numbers_of_the_tolerance(self, band, how, wanted):
        assert f"{spread(band, **how):.1e}" == wanted

    @pytest.mark.long
    def test_the_example_prints_them_beside_those_of_the_source(self, capsys):
        path = Path(__file__).parents[2] / "examples/composition.py"
        runpy.run_path(str(path), run_name="__main__")
        printed = capsys.readouterr().out
        assert "0.0006  1.11" in printed
        assert "0.0006  3.72" in printed
        assert "0.0006 as std: references at 300 ± 19.4 K" in printed


class TestComposition:
    def test_it_is_the_inverse_of_the_cut_off(self):
        for x in (0.2, 0.3, 0.45, 0.6):
            cutoff = float(blackbody.hgcdte_cutoff(x, 120.0))
            assert blackbody.hgcdte_composition(cutoff, 120.0) == pytest.approx(x, rel=1e-12)

    @pytest.mark.parametrize("cutoff", [1.0, np.nan])
    def test_cut_offs_without_a_composition_are_refused(self, cutoff):
        with pytest.raises(errors.InputError, match=rf"'cutoff_um' is {cutoff}, but HgCdTe of x"):
            blackbody.hgcdte_composition(cutoff)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: replace(MIDDLE, start_um=0.0), "'start_um' is 0.0, expected a finite"),
        (lambda: replace(MIDDLE, cutoff_um=2.0), "'cutoff_um' is 2.0, expected more than"),
        (lambda: replace(MIDDLE, cutoff_um="5"), "'cutoff_um' is '5', expected a number"),
        (lambda: replace(MIDDLE, edge_mev=50.0), r"'edge_mev' is 50.0, expected 0, or 0.1 to 12"),
        (lambda: replace(MIDDLE, edge_mev=0.01), "'edge_mev' is 0.01"),
        (
            lambda: replace(MIDDLE, short_pass=detector.ShortPass(edge_um=2.9)),
            "'short_pass' has its edge at 2.9 µm",
        ),
        (lambda: detector.HgCdTe(start_um=3000.0, cutoff_um=5100.0), "'start_um' .* divide nm by"),
        (lambda: replace(MIDDLE, cutoff_um=5100.0), "'cutoff_um' is 5100.0 µm, expected at most"),
        (lambda: detector.ShortPass(edge_um=4700.0), "'edge_um' is 4700.0 µm"),
        (lambda: spread(MIDDLE, references_k=(20.0, 300.0)), "'references_k' is 20 K, .* °C"),
        (lambda: spread(MIDDLE, scene_k=30.0), "'scene_k' is 30 K, expected 100 or more"),
        (lambda: spread(MIDDLE, filled_k=37.0), "'filled_k' is 37 K"),
        (lambda: detector.ShortPass(edge_um=4.7, slope=0.0), "'slope' is 0.0, expected 0.005"),
        (lambda: detector.ShortPass(edge_um=4.7, peak=1.2), "'peak' is 1.2"),
        (lambda: detector.ShortPass(edge_um=np.nan), "'edge_um' is nan"),
        (lambda: spread(MIDDLE, references_k=(1.0, 2.0, 3.0)), r"'references_k' is \[1.0, 2.0"),
        (lambda: spread(MIDDLE, references_k=(290.0, 290.0)), "up to two that differ"),
        (
            lambda: spread(MIDDLE, references_k=(-5.0,)),
            "'references_k' is -5.0, expected a finite",
        ),
        (lambda: spread(MIDDLE, scene_k=np.nan), "'scene_k' is nan"),
        (lambda: spread(MIDDLE, charge_e=0), "'charge_e' is 0"),
        (lambda: spread(MIDDLE, by="noise"), "'by' is 'noise'"),
        (lambda: spread(MIDDLE, by="gain"), "'by' is 'gain', but there are 2 references"),
    ],
)
def test_wrong_values_are_refused(call, message):
    with pytest.raises(errors.InputError, match=message):
        call()


def test_the_module_is_public():
    assert equipix.detector is detector
