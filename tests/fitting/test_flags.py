"""Which finding sets which bits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.exposures.exposures import FitOptions
from equipix.findings import BITS, Flag
from equipix.fitting.pixels import _faint, pixel_flags
from equipix.fitting.weighted import Options, Weighted, contradictory_found, weighted_fit
from equipix.measured.defects import BadPixels
from equipix.measured.part import known_part
from given import exposures_of

CROSS = equipix.cross_pattern(2, 3)
FINDINGS = [field.name for field in dataclasses.fields(BadPixels)]


def weighted():
    beam, truth = simulate.gaussian_beam((20, 24)), np.ones((20, 24))
    exposures = exposures_of(simulate.exposures(truth, beam, CROSS), CROSS)
    return weighted_fit(exposures, Options(FitOptions()))


def with_findings(**found):
    fitted = weighted()
    exposures = dataclasses.replace(fitted.exposures, bad_pixels=BadPixels(**found))
    return fitted._replace(exposures=exposures)


def test_every_finding_has_bits_and_all_bits_have_a_finding():
    of_responses = {"undetermined", "falling", "nonlinear", "non_responding", "flickering"}
    of_responses |= {"out_of_range"}
    assert {*FINDINGS, "contradictory", *of_responses} == set(BITS)


def test_only_saturation_leaves_a_pixel_in_use():
    assert [name for name, bits in BITS.items() if not bits & Flag.DO_NOT_USE] == ["saturated"]


@pytest.mark.parametrize("finding", FINDINGS)
def test_a_finding_sets_its_bits_alone(finding):
    found = np.zeros((20, 24), bool)
    found[5, 7] = True
    flags = pixel_flags(with_findings(**{finding: found}), FitOptions())
    assert flags[5, 7] == BITS[finding]
    assert np.count_nonzero(flags) == 1


def test_findings_add_up():
    found = np.zeros((20, 24), bool)
    found[5, 7] = True
    flags = pixel_flags(with_findings(**dict.fromkeys(FINDINGS, found)), FitOptions())
    wanted = Flag.SATURATED | Flag.DEAD | Flag.HOT | Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE
    assert flags[5, 7] == wanted


def test_most_measurements_left_out_contradict_each_other():
    given = weighted().exposures
    left_out = np.zeros((5, 20, 24), bool)
    left_out[:3, 4, 4] = left_out[:2, 8, 8] = True
    exposures = contradictory_found(given.without(left_out), given.usable())
    fit = exposures.fit(FitOptions())
    flags = pixel_flags(Weighted(exposures, fit, left_out), FitOptions())
    assert fit.flags[4, 4] == BITS["contradictory"]
    assert np.argwhere(flags == BITS["contradictory"]).tolist() == [[4, 4]]
    assert np.count_nonzero(flags) == 1


def test_a_bright_pixel_of_a_large_sensor_is_found_among_a_part():
    # Sixteen sizes of pixel noise in 4x4 pixels, in light that falls to the edge.
    rows, cols = np.indices((900, 1200))
    std = 0.005 * (1 + (rows % 4 + cols % 4) / 20) * np.exp((rows / 900) ** 2 + (cols / 600) ** 2)
    std[::7, ::5] = np.nan
    bright = np.quantile(std[std <= 0.1], 0.1)
    part = known_part(std)
    # The share of the part below the quantile of all scatters as that of so many draws would.
    share = np.mean(part[part <= 0.1] <= bright)
    error = np.sqrt(0.1 * 0.9 / part.size)
    assert abs(share - 0.1) < 3 * error
    sure = np.abs(std / max(0.04, 4 * bright) - 1) > 0.01
    assert ((_faint(std) == (std > max(0.04, 4 * bright))) | ~sure | np.isnan(std)).all()
