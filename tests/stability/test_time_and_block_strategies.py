"""Lidar, dots and stereo over all that a sensor can read, and their functions at the ends of their ranges."""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.strategies import dots, lidar, passive_stereo
from rig.strategies.apparatus import Budget, PulseTimes
from rig.strategies.block_matching import best_match, independent_values, log_bayes_factor, match
from rig.strategies.dots import Dots
from rig.strategies.lidar import FlashLidar, within
from rig.strategies.passive_stereo import PassiveStereo
from rig.strategies.photon_times import Nodes, fog_background, ratio, surfaces, without_pile_up
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.rig.strategies.plane_scene import PlaneScene

LIDARS = (lidar.FIRST_PHOTON, lidar.PEAK, lidar.COATES, lidar.GAMMA)
PICTURES = (dots.CAMERA, dots.SPAD, passive_stereo.SGBM)
READINGS = ("nothing", "everything", "anything", "all or nothing", "one pixel", "one column")


def reading(kind: str, shape: tuple[int, ...], most: float, rng: np.random.Generator) -> np.ndarray:
    """What a sensor may read, 0 to most."""
    if kind in ("nothing", "everything"):
        return np.full(shape, most * (kind == "everything"))
    if kind == "anything":
        return np.floor(rng.random(shape) * (most + 1))
    if kind == "all or nothing":
        return most * rng.integers(0, 2, shape)
    values = np.zeros(shape)
    values[(..., shape[-1] // 2) if kind == "one column" else (..., shape[-2] // 2, shape[-1] // 2)] = most
    return values


class Stuck(PlaneScene):
    """A scene whose sensors read what they are told, whatever is there."""

    kind = "nothing"

    def spad_counts(self, patterns, frames):
        super().spad_counts(patterns, frames)
        shape = (len(patterns), self.rows_number, self.width)
        return reading(self.kind, shape, float(frames[0]), self.rng).astype(np.uint32)

    def camera_images(self, patterns, exposure_s):
        shape = (len(patterns), self.rows_number, self.width)
        return reading(self.kind, shape, self.camera_full_scale, self.rng).astype(np.uint16)

    def stereo_pair(self, exposure_s):
        return reading(self.kind, (2, self.rows_number, self.width), self.camera_full_scale, self.rng).astype(np.uint16)

    def pulse_times(self, pulses, bin_s):
        shape = (self.rows_number, self.width, 400)
        counts = np.zeros(shape, np.int64)
        left = np.full(shape[:2], pulses)
        for i in self.rng.permutation(400) if self.kind == "anything" else (0, 7, 200, 399):
            some = np.minimum(reading(self.kind, shape[:2], pulses, self.rng).astype(np.int64), left)
            counts[:, :, i] += some // 2 if self.kind == "anything" else some
            left -= counts[:, :, i]
        return PulseTimes(counts.astype(np.uint32), 6.5e-9, 2e-10, pulses)


@covers(FlashLidar.measure, Dots.measure, PassiveStereo.measure)
@pytest.mark.parametrize("kind", READINGS)
@pytest.mark.parametrize("strategy", [*LIDARS, *PICTURES], ids=lambda each: each.name)
@pytest.mark.parametrize("time_s", [1e-3, 0.05])
def test_any_reading_gives_depths_in_range_or_none(strategy, kind, time_s) -> None:
    scene = Stuck(rows_number=12, width=70, columns=120)
    scene.kind = kind
    answer = strategy.measure(scene, scene.geometry, Budget(time_s), 1)
    near_m, far_m = scene.range_m
    given_m = answer.depth_m[np.isfinite(answer.depth_m)]
    assert not np.isinf(answer.depth_m).any()
    assert np.all((given_m > 0.9 * near_m) & (given_m < 1.12 * far_m))
    assert np.all((answer.confidence >= 0) & (answer.confidence <= 1))
    assert np.all(answer.confidence[np.isnan(answer.depth_m)] == 0)
    if kind == "nothing" or (kind in ("everything", "all or nothing") and strategy in PICTURES):
        assert np.mean(answer.confidence >= 0.9) < 0.03


@covers(surfaces, without_pile_up, fog_background)
@EXAMPLES
@given(
    seed=st.integers(0, 10**6), pulses=st.sampled_from([1, 2, 1000, 10**6, 2**32 - 1]),
    share=st.sampled_from([0.0, 1e-6, 0.01, 1.0]), bins=st.sampled_from([1, 2, 9, 60, 500]),
    sigma_bins=st.sampled_from([0.1, 1.0, 7.0]), start_s=st.sampled_from([0.0, 1e-12, 7e-9]),
    fog=st.booleans(), coates=st.booleans(),
)  # fmt: skip
def test_any_histogram_gives_a_time_within_the_gate_or_none(
    seed, pulses, share, bins, sigma_bins, start_s, fog, coates
) -> None:
    rng, bin_s = np.random.default_rng(seed), 1e-10
    counts, left = np.zeros((1, 6, bins), np.uint32), np.full((1, 6), pulses, np.int64)
    for i in range(bins):
        counts[..., i] = rng.binomial(left, share * rng.random((1, 6)) ** 4)
        left -= counts[..., i]
    seen, end_s = PulseTimes(counts, start_s, bin_s, pulses), start_s + bins * bin_s
    between_s = np.array([start_s, start_s, start_s, end_s, end_s * 2, 0]), np.array([end_s, 0, end_s * 9, end_s, 1, 1])
    found = surfaces(seen, sigma_bins * bin_s, between_s, fog=fog, coates=coates)
    some = np.isfinite(found.time_s)
    reach_s = (2 * math.hypot(sigma_bins, 0.3) + 1) * bin_s
    assert np.all((found.time_s[some] >= start_s - reach_s) & (found.time_s[some] <= end_s + reach_s))
    for values in found[1:]:
        assert np.isfinite(values).all()
        assert np.all(values >= 0)
        assert not np.any(values[~some])
    assert np.all(found.confidence <= 1 + 1e-12)


@covers(ratio, within, log_bayes_factor)
def test_formulas_hold_to_the_last_digits(digits) -> None:
    value = np.array([1e-9, 0.5, 1.0, 3.0, 1e3, 1e9])
    expected = value * np.array([1e-12, 1e-3, 0.5, 0.9, 0.999, 1e-6])
    found = np.array([ratio(v, e) for v, e in zip(value, expected, strict=True)])
    digits("Poisson likelihood ratio", 1e-8, found, lambda v, e: v * mpmath.log(v / e) - (v - e), value, expected)
    assert [ratio(v, v * 2) for v in value] == [0.0] * 6
    limit, sd = np.array([0.0, 1e-9, 1e-3, 0.1, 1.0]), np.array([1.0, 1.0, 1e-3, 1e-1, 1e-9])
    digits(
        "P(error < limit)",
        1e-12,
        within(limit, sd)[1:],
        lambda a, b: mpmath.erf(a / (b * mpmath.sqrt(2))),
        limit[1:],
        sd[1:],
    )
    assert within(np.array([0.0, 1.0]), np.zeros(2)).tolist() == [0.0, 1.0]
    left = np.array([1e-5, 1e-3, 0.3, 0.9, 1.0], np.float32)
    for n in (3.0, 20.0, 99.0):
        digits(
            f"Bayes factor, {n:g} values", 2e-5, log_bayes_factor(left, n),
            lambda a, n=n: (n - 2) / 2 * mpmath.log(1 + n) - (n - 1) / 2 * mpmath.log(1 + n * a), left.astype(float),
        )  # fmt: skip


@covers(fog_background, Nodes)
@pytest.mark.parametrize("scale", [0.0, 1e-9, 1.0, 1e12])
@pytest.mark.parametrize("time_s", [np.array([0.0]), np.array([1e-9, 1e-8]), np.linspace(0, 1e-7, 700)])
def test_any_light_is_fitted_by_something_finite(scale, time_s) -> None:
    nodes = Nodes.over(np.maximum(time_s, 1e-12))
    rng = np.random.default_rng(1)
    counts = scale * rng.random((5, nodes.number)) ** 8
    for share in (np.ones_like(counts), np.zeros_like(counts), rng.integers(0, 2, counts.shape).astype(float)):
        light = fog_background(counts * share, share, nodes)
        assert np.isfinite(light).all()
        assert np.all(light > 0)


@covers(match, best_match, independent_values)
@EXAMPLES
@given(
    seed=st.integers(0, 10**6), scale=st.sampled_from([0.0, 1e-6, 1.0, 4e9]), offset=st.sampled_from([0.0, 1.0, 1e9]),
    rows=st.sampled_from([1, 2, 9, 30]), width=st.sampled_from([1, 2, 11, 64]), number=st.sampled_from([1, 2, 7]),
)  # fmt: skip
def test_any_pictures_give_places_among_the_hypotheses(seed, scale, offset, rows, width, number) -> None:
    rng = np.random.default_rng(seed)
    picture = (offset + scale * rng.random((rows, width))).astype(np.float32)
    known = [
        (rng.integers(0, 2, (rows, width)).astype(np.float32), rng.random((rows, width)) < 0.8) for _ in range(number)
    ]
    independent = independent_values(picture, known[0][0])
    assert 1 <= independent <= 99
    left, evidence = match(picture, iter(known), independent)
    assert np.all((left >= 0) & (left <= 1))
    found = best_match(left, evidence, independent, 1.0)
    some = np.isfinite(found.place)
    assert np.all((found.place[some] >= -0.5) & (found.place[some] <= number - 0.5))
    assert np.all(np.isfinite(found.sd) & (found.sd >= 0))
    assert np.all((found.confidence >= 0) & (found.confidence <= 1))
    assert not found.confidence[~some].any()
