"""Laser classes against the published exposure limits, from which they follow, and against well-known powers."""

import math

import pytest

from rig.strategies.comparison.eye_safety import (
    CLASSES,
    PUPIL_M,
    Beam,
    Field,
    class_of,
    limit_j,
)
from tests.stability.inventory import covers

covers(Beam, Field, class_of, limit_j)
GREEN_M = 520e-9
AREA_M2 = math.pi / 4 * PUPIL_M**2


@pytest.mark.parametrize(
    ("duration_s", "exposure_j_m2"),
    [(1e-9, 2e-3), (1e-6, 2e-3), (1e-4, 18 * 1e-4**0.75), (0.25, 18 * 0.25**0.75), (9.9, 18 * 9.9**0.75), (50.0, 500)],
)
def test_class_1_lets_the_published_exposure_through_a_pupil(duration_s, exposure_j_m2):
    # ICNIRP 2013, table 5. The standard rounds to two digits.
    assert limit_j("1", duration_s, 650e-9) == pytest.approx(exposure_j_m2 * AREA_M2, rel=0.02)


@pytest.mark.parametrize(("laser_class", "most_w"), [("1", 0.39e-3), ("2", 1e-3), ("3R", 5e-3), ("3B", 0.5)])
def test_steady_beams_have_the_well_known_limits(laser_class, most_w):
    assert class_of(Beam(most_w * 0.999), GREEN_M) == laser_class
    above = [*CLASSES, "4"][CLASSES.index(laser_class) + 1]
    assert class_of(Beam(most_w * 1.001), GREEN_M) == above


def test_blue_light_has_a_photochemical_limit():
    assert limit_j("1", 100, 440e-9) == pytest.approx(39e-6 * 100)  # 39 uW, as for blue laser products
    assert limit_j("1", 100, 500e-9) == pytest.approx(0.39e-3 * 100)  # C3 = 10: equal to that of heat
    assert limit_j("1", 100, GREEN_M) == pytest.approx(0.39e-3 * 100)


def test_a_scanned_line_is_judged_by_its_passages():
    field = Field(0.05, math.radians(46), math.radians(53))
    moving, still = field.line(50e-3)
    share = 0.07 / math.radians(46)
    assert still.power_w == pytest.approx(0.05 * share)
    assert moving.pulse_s == pytest.approx(50e-3 * 0.07 / math.radians(53))
    assert moving.mean_w == pytest.approx(0.05 * share * 0.07 / math.radians(53))
    assert class_of(still, GREEN_M) == "3R"
    # 4.4 mW for 3.8 ms are 16.6 uJ, more than the 10.7 uJ of classes 1 and 2, though the mean is within class 1.
    assert moving.power_w * moving.pulse_s == pytest.approx(16.6e-6, rel=0.01)
    assert limit_j("1", moving.pulse_s, GREEN_M) == pytest.approx(10.7e-6, rel=0.01)
    assert moving.mean_w < 0.39e-3
    assert class_of(moving, GREEN_M) == "3R"


def test_classes_never_fall_with_power_or_pulse_energy():
    order = [*CLASSES, "4"]
    field = Field(1.0, 0.8, 0.9)
    for shape in (lambda f: f.line(0.05)[0], lambda f: f.spot(0.05, 512)[0], lambda f: f.flash(1e-10, 1e5)[0]):
        ranks = [order.index(class_of(shape(Field(p, field.fan_rad, field.scan_rad)), GREEN_M)) for p in
                 (0.0, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 1, 10, 1e3)]  # fmt: skip
        assert ranks == sorted(ranks)
        assert ranks[0] == 0


def test_a_pulse_train_counts_as_one_pulse_in_five_microseconds_and_with_a_factor():
    # 1 ns pulses at 10 kHz: a million in 100 s, so C5 is 0.4, and 10 uW on average do not matter.
    at_limit = 0.4 * 7.7e-8 / 1e-9
    assert class_of(Beam(0.999 * at_limit, 1e-9, 1e4), GREEN_M) == "1"
    assert class_of(Beam(1.001 * at_limit, 1e-9, 1e4), GREEN_M) == "2"
    assert class_of(Beam(1e-3 / 0.001, 1e-9, 1e6), GREEN_M) != "1"  # 1 mW on average


@pytest.mark.parametrize(("duration_s", "wavelength_m"), [(0.0, GREEN_M), (1.0, 905e-9), (math.nan, GREEN_M)])
def test_what_has_no_limit_here_is_refused(duration_s, wavelength_m):
    with pytest.raises(ValueError, match="limits"):
        limit_j("1", duration_s, wavelength_m)
