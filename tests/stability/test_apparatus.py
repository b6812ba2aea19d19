"""The simulated apparatus from no light to endless light, from clear air to fog that hides a hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.effects.beam_spread import DEPTHS
from sim_backend.light.optics import LIGHT_M_PER_S
from sim_backend.projector import draws, pulse, stereo, transport
from sim_backend.projector.apparatus import SimulatedApparatus, rows_of_fan
from sim_backend.projector.draws import count, inverted, next_wait, readings
from sim_backend.projector.hardware import ConventionalCamera, PulsedSource
from sim_backend.projector.pulse import LEAST_RANGE_M, FogEcho, Gate, blur_s, gate, mean_detections
from sim_backend.projector.stereo import ambient_radiance, first_view, second_view
from sim_backend.projector.transport import blocks, checked_columns, checked_rows, runs
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.sim_backend.rigs import made_world, rig, setting, wall

ROWS = np.array([2, 3, 20])


@covers(draws)
@EXAMPLES
@given(
    st.integers(1, 2**32 - 1), st.floats(0, allow_nan=False) | st.floats(1e-12, 100.0), st.integers(0, 2**32),
)  # fmt: skip
def test_a_count_is_never_more_than_the_frames_and_close_to_its_mean(frames: int, flux: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found, wait = count(rng, next_wait(rng), frames, flux)
    p = -math.expm1(-flux)
    assert 0 <= found <= frames
    assert 0 <= wait < 50
    assert abs(found - frames * p) <= 9 * math.sqrt(frames * p * (1 - p)) + 40


@covers(inverted)
@EXAMPLES
@given(st.floats(0, 1), st.integers(1, 2**32 - 1), st.floats(1e-300, 30.0))
def test_inversion_ends_for_any_uniform_number(uniform: float, frames: int, mean: float) -> None:
    flux = min(mean / frames, math.log(2))
    assert 0 <= inverted(uniform, frames, flux) <= min(frames, 400)


@covers(readings)
@EXAMPLES
@given(
    st.floats(0, allow_nan=False), st.integers(8, 16), st.floats(10, 1e7), st.floats(0, 1000), st.integers(0, 2**32),
)  # fmt: skip
def test_readings_stay_within_the_range(
    electrons: float, bits: int, full_well: float, read_noise: float, seed: int
) -> None:
    camera = ConventionalCamera(bits=bits, full_well=full_well, read_noise=read_noise)
    read = readings(np.random.default_rng(seed), np.array([electrons, np.inf]), camera)
    assert read.max() < 2**bits
    assert read[1] > 0


@covers(mean_detections, pulse)
@EXAMPLES
@given(
    st.floats(1e-3, 1e12) | st.just(np.inf), st.floats(0, 1e6), st.floats(0, 1e6), st.floats(0, 1e9),
    st.floats(1e-13, 1e-6), st.floats(1e-13, 1e-7), st.integers(1, 4),
)  # fmt: skip
def test_echoes_are_finite_and_add_up(
    range_m: float, surface: float, fog: float, detour_m: float, bin_s: float, sigma_s: float, parts: int
) -> None:
    mean, of_fog = np.full(50, np.nan), np.full((50, parts), fog)
    mean_detections((3e-9, bin_s, sigma_s), np.array([surface, 2 * surface, range_m, detour_m, 1e3]), of_fog, mean)
    assert np.isfinite(mean).all()
    assert (mean >= 1e3 * bin_s * (1 - 1e-9)).all()
    assert mean.sum() <= (3 * surface + of_fog.sum() + 50 * 1e3 * bin_s) * (1 + 1e-6)


@covers(FogEcho)
@EXAMPLES
@given(st.floats(0, 1e6), st.floats(0, 1e6), st.floats(0, 1e-6), st.floats(1e-12, 1e-7))
def test_the_fog_sends_back_no_more_than_without_extinction(
    per_j: float, extinction_per_m: float, start_s: float, bin_s: float
) -> None:
    none = np.zeros(len(DEPTHS))
    opened = Gate(start_s, bin_s, 20, 1e-10)
    once = FogEcho(per_j, extinction_per_m, DEPTHS, none).of_bins(opened)
    more = FogEcho(per_j, extinction_per_m, DEPTHS, none + 1.0).of_bins(opened)
    assert np.isfinite(more).all()
    assert (once >= 0).all()
    assert (once <= more).all()
    assert once.sum() <= per_j / LEAST_RANGE_M * (1 + 1e-9)


@covers(gate, blur_s)
@EXAMPLES
@given(st.floats(1e-3, 1e3), st.floats(1.001, 1e3), st.floats(1, 3), st.floats(1e-3, 1))
def test_a_gate_has_at_least_a_bin_and_ends_after_the_range(
    near_m: float, ratio: float, stretch: float, part: float
) -> None:
    source = PulsedSource()
    whole = gate(source, (near_m, ratio * near_m), (1.0, stretch), 1e-15)
    length_s = whole.bins * whole.bin_s
    opened = gate(source, (near_m, ratio * near_m), (1.0, stretch), part * length_s * 0.999)
    assert isinstance(opened, Gate)
    assert opened.bins >= 1
    assert opened.start_s + opened.bins * opened.bin_s >= 2 * ratio * near_m * stretch / LIGHT_M_PER_S


@covers(checked_rows, checked_columns, runs, blocks, transport)
@EXAMPLES
@given(st.sets(st.integers(0, 511), min_size=1), st.integers(2, 4096), st.floats(-1, 0.999), st.floats(1e-3, 1))
def test_rows_and_columns_are_kept_whole(rows: set[int], columns: int, first: float, width: float) -> None:
    at = checked_rows(sorted(rows), 512)
    assert [y for a, b in runs(at) for y in range(a, b)] == sorted(rows)
    last = min(first + width, 1.0)
    if last > first:
        commands = checked_columns(columns, (first, last), (-1, 1))
        assert (np.diff(commands) > -1e-15).all()
        assert first <= commands[0] <= commands[-1] <= last
    parts = [y for part in blocks(len(at), columns, 512) for y in range(part.start, part.stop)]
    assert parts == list(range(len(at)))


@covers(stereo, first_view, second_view, ambient_radiance)
@pytest.mark.parametrize("depth_m", [0.02, 1.0, 1e6])
@pytest.mark.parametrize("tilt", [0.0, 1.4, -1.4])
@pytest.mark.parametrize("visibility", ["1 cm", "1000 km"])
def test_both_views_are_finite_at_any_depth_tilt_and_visibility(depth_m: float, tilt: float, visibility: str) -> None:
    model = rig()
    u, _ = model.camera.tangents()
    facing = np.maximum(math.sin(tilt) * u + math.cos(tilt), 1e-3)
    surfaces = wall(model, (0.0, 0.0, 1.0), 1.0)
    surfaces.depth_m[:] = depth_m / facing
    scene = {"medium": {"fog": {"visibility": visibility}}, "ambient": {"illuminance": "100000 lux"}}
    setup = setting(model, surfaces, **scene)
    for view in (first_view, second_view):
        seen = view(setup.view, ROWS)
        assert ((seen.albedo >= 0) & (seen.albedo <= 1)).all()
        assert (seen.range_m > 0).all()
        radiance = ambient_radiance(setup, seen, 300e-9)
        assert (np.isfinite(radiance) & (radiance >= 0)).all()


@covers(SimulatedApparatus, rows_of_fan)
@pytest.mark.parametrize("power_w", [0.0, 1e-30, 1e6])
@pytest.mark.parametrize("fog", ["1 cm", "clear", "1000 km"])
@pytest.mark.parametrize("rule", ["energy", "irradiance"])
def test_every_measurement_ends_well_at_any_power_and_visibility(power_w: float, fog: str, rule: str) -> None:
    world = made_world(scene="street", geometry="config/small-rig.yaml", fog=fog)
    assert (rows_of_fan(world.setting) > 0).all()
    apparatus = world.apparatus(
        rows=ROWS,
        columns=16,
        command_range=(-0.88, 0.88),
        power_w=power_w,
        rule=rule,
        seed=1,
        depth_range_m=(0.1, 100.0),
    )
    patterns = np.array([np.zeros(16), np.ones(16), np.full(16, 1e-30), np.eye(16)[3]])
    counts = apparatus.spad_counts(patterns, np.array([1, 10, 1000, 4_000_000_000]))
    assert (counts.max(axis=(1, 2)) <= [1, 10, 1000, 4_000_000_000]).all()
    assert apparatus.camera_images(patterns, 0.01).max() <= apparatus.camera_full_scale
    assert apparatus.spots([0, 2], [0, 15], 100).max() <= 100
    timed = apparatus.pulse_times(1000, 1e-8)
    assert timed.counts.sum(axis=2).max() <= 1000
    assert apparatus.stereo_pair(1.0).max() <= apparatus.camera_full_scale
    assert math.isfinite(apparatus.spent.time_s)
    assert math.isfinite(apparatus.spent.energy_j)
