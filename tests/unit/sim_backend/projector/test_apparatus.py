"""The simulated apparatus against the world's own light, and its account of time and energy."""

import numpy as np
import pytest

from drivers.errors import DeviceError
from rig.strategies.apparatus import Apparatus, MakesApparatus
from sim_backend.effects.beam_spread import AT, DEPTHS, shapes
from sim_backend.light.optics import Sensor
from sim_backend.projector import transport
from sim_backend.projector.apparatus import SimulatedApparatus, rows_of_fan
from sim_backend.scenes.medium import Medium
from sim_backend.world import SimulatedWorld
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import made_world

covers(SimulatedApparatus, rows_of_fan, transport)

ASKED = {
    "rows": np.array([3, 4, 20, 37]), "columns": 40, "command_range": (-0.88, 0.88), "power_w": 0.05, "rule": "energy",
    "seed": 3, "depth_range_m": (1.0, 15.0),
}  # fmt: skip
LIT = np.eye(40, dtype=np.float32)


def world_of(scene: str = "street", **config) -> SimulatedWorld:
    return made_world(scene=scene, geometry="config/small-rig.yaml", effects="all", **config)


def made(world: SimulatedWorld, **changed) -> Apparatus:
    assert isinstance(world, MakesApparatus)
    return world.apparatus(**{**ASKED, **changed})


def line_light(world: SimulatedWorld, column: int) -> np.ndarray:
    """Detections per watt and second from the line at a column, (rows, width), by the world's report on effects."""
    first, last = ASKED["command_range"]
    command = first + (column + 0.5) * (last - first) / ASKED["columns"]
    steady = world.flux_model.steady
    rows = [world.flux_row(int(row), command, 1.0, 1.0) for row in ASKED["rows"]]
    return np.array([sum(light for name, light in parts.items() if name not in steady) for parts in rows])


def deviations(counts: np.ndarray, frames: int, flux: np.ndarray) -> np.ndarray:
    p = -np.expm1(-flux)
    return (counts - frames * p) / np.sqrt(frames * p * (1 - p) + 1e-3)


@pytest.mark.parametrize("scene", ["street", "street-dense-fog", "street-smoke"])
def test_a_lit_column_gives_the_light_of_the_line_that_stands_there(scene: str) -> None:
    world = world_of(scene)
    apparatus, shown = made(world), (7, 20, 33)
    counts = apparatus.spad_counts(LIT[list(shown)], np.full(3, 20_000))
    steady = world.flux_model.steady_per_s[ASKED["rows"]]
    for of_column, column in zip(counts, shown, strict=True):
        z = deviations(of_column, 20_000, 1e-5 * (steady + 0.05 * line_light(world, column)))
        assert np.abs(z).max() < 5.5
        assert abs(z.mean()) < 4 / np.sqrt(z.size)
        assert 0.9 < z.std() < 1.1


@pytest.mark.parametrize("scene", ["street-rain", "street-snow"])
def test_drops_and_flakes_are_where_the_line_would_meet_them(scene: str) -> None:
    world = world_of(scene)
    light, _ = world._transport(ASKED["rows"], 40, ASKED["command_range"])
    moment = light.moment(0)
    some = 0
    for column in (5, 20, 34):
        found = light.light[:, column].astype(np.float64)
        for y in range(len(found)):
            part = slice(moment.first[column, y], moment.first[column, y] + moment.number[column, y])
            found[y, moment.x[part]] += moment.value[part]
            some += moment.number[column, y]
        np.testing.assert_allclose(found, line_light(world, column), rtol=1e-4, atol=1e-6 * found.max())
    assert some > 10


def test_drops_change_from_moment_to_moment_and_each_pattern_gets_those_of_its_time() -> None:
    light, _ = world_of("street-rain")._transport(ASKED["rows"], 40, ASKED["command_range"])
    ends_s = np.array([0.01, 0.02, 0.04])
    moments, shares = light.moments(0.0, ends_s)
    assert len(moments) == transport.MOMENTS - 1  # steps of 6.4 ms
    np.testing.assert_allclose(shares.sum(axis=0), 1)
    np.testing.assert_allclose(shares[:, 0], [0.64, 0.36, 0, 0, 0, 0, 0])
    assert not np.array_equal(moments[0].value, moments[1].value)
    again, _ = light.moments(0.0, ends_s)
    assert all(a is b for a, b in zip(moments, again, strict=True))


@pytest.mark.parametrize("scene", ["street", "street-rain"])
def test_a_pattern_is_the_sum_of_its_columns_and_has_the_sources_power(scene: str) -> None:
    world = world_of(scene)
    rng = np.random.default_rng(5)
    bright = rng.random((1, 40)).astype(np.float32)
    frames = 40_000
    whole = made(world, seed=1).spad_counts(bright, np.array([frames]))[0]
    one = made(world, seed=2).spad_counts(LIT, np.full(40, frames))
    flux = [-np.log1p(-np.minimum(counts / frames, 1 - 1e-6)) for counts in (whole, one)]
    steady = 1e-5 * world.flux_model.steady_per_s[ASKED["rows"]]
    mixed = np.tensordot(bright[0] / bright.sum(), flux[1] - steady, 1)
    dim = (flux[0] < 3) & (flux[1].max(axis=0) < 3)
    assert dim.sum() > 100
    off = (flux[0] - steady - mixed)[dim] / np.sqrt((np.expm1(flux[0]) + 1e-3)[dim] / frames)
    assert abs(off.mean()) < (1.0 if scene == "street" else 2.0)  # drops differ between the two
    assert np.median(np.abs(off)) < 3


def test_rows_may_have_patterns_of_their_own_which_share_the_power() -> None:
    world = world_of()
    by_row = np.zeros((2, 4, 40), np.float32)
    by_row[0, :, 12:30] = 1
    by_row[1, :2, 12:30] = 1
    same = made(world).spad_counts(by_row[:1, 0], np.array([1000]))
    np.testing.assert_array_equal(made(world).spad_counts(by_row[:1], np.array([1000])), same)
    apparatus = made(world)
    watts, lit_w = apparatus._watts(by_row)  # half of the rows: twice as bright
    np.testing.assert_allclose(lit_w, 0.05)
    np.testing.assert_allclose(watts[1, 0, 12], 2 * watts[0, 0, 12])


def test_few_columns_are_summed_as_many_are() -> None:
    light, _ = world_of()._transport(ASKED["rows"], 40, ASKED["command_range"])
    patterns = np.zeros((1, 3, 40), np.float32)
    patterns[0, 0, [3, 20]], patterns[0, 1, 5:35], patterns[0, 2, 17] = (1, 0.25), 0.5, 1
    together = light.of_patterns(patterns, slice(0, 4))
    np.testing.assert_allclose(together, np.matmul(patterns[0], light.light), rtol=1e-5, atol=1e-6 * together.max())


@pytest.mark.parametrize("rule", ["energy", "irradiance"])
def test_time_and_energy_are_accounted_for(rule: str) -> None:
    apparatus = made(world_of(), rule=rule)
    patterns = np.zeros((3, 40), np.float32)
    patterns[0, :10], patterns[1, 5] = 1, 0.5
    apparatus.spad_counts(patterns, np.array([100, 200, 400]))
    power_w = (0.05, 0.05, 0.0) if rule == "energy" else (0.05 * 10 / 20, 0.05 * 0.5 / 20, 0.0)
    assert apparatus.spent.time_s == pytest.approx(7e-3)
    energy_j = np.dot(power_w, [1e-3, 2e-3, 4e-3])
    assert apparatus.spent.energy_j == pytest.approx(energy_j)
    apparatus.camera_images(patterns, 0.01)
    energy_j += 0.01 * sum(power_w)
    assert apparatus.spent.time_s == pytest.approx(0.037)
    assert apparatus.spent.energy_j == pytest.approx(energy_j)
    apparatus.pulse_times(100, 1e-9)
    energy_j += 1e-3 * (0.05 if rule == "energy" else 0.1)
    assert apparatus.spent.energy_j == pytest.approx(energy_j)
    apparatus.stereo_pair(0.02)
    assert apparatus.spent.time_s == pytest.approx(0.058)
    assert apparatus.spent.energy_j == pytest.approx(energy_j)
    before = apparatus.spent
    apparatus.spots(np.array([0, 2]), np.array([3, 4]), 5, brightness=0.5)
    spot_w = 0.5 * (
        0.05 if rule == "energy" else 0.05 / 20 / rows_of_fan(world_of().setting)[ASKED["rows"][[0, 2]]].mean()
    )
    assert apparatus.spent.time_s - before.time_s == pytest.approx(1e-4)
    assert apparatus.spent.energy_j - before.energy_j == pytest.approx(1e-4 * spot_w, rel=0.05)


@pytest.mark.parametrize("scene", ["street", "street-rain"])
def test_a_spot_is_brighter_by_the_rows_that_the_line_covers(scene: str) -> None:
    world = world_of(scene)
    frames, rows, columns = 4000, np.repeat([1, 2], 3), np.tile([12, 20, 28], 2)
    spots = made(world, power_w=1e-4).spots(rows, columns, frames)
    steady = world.flux_model.steady_per_s[ASKED["rows"]]
    if scene == "street-rain":  # drops are elsewhere at other times
        assert spots.shape == (6, 96)
        return
    # The small rig's rows are 1/110 rad high near the axis, the fan 50 degrees wide.
    number = np.radians(50) * 110 * (1 + (np.array([4, 20]) / 110 - 19.5 / 110) ** 2)
    for i, (row, column) in enumerate(zip(rows, columns, strict=True)):
        flux = 1e-5 * (steady[row] + 1e-4 * number[row - 1] * line_light(world, column)[row])
        z = deviations(spots[i], frames, flux)
        assert abs(z.mean()) < 1.5  # the rows' height is right to a few percent, since the lens distorts
        assert np.median(np.abs(z)) < 2


def test_the_halo_of_a_spot_leaves_its_row_and_nothing_else_does() -> None:
    light, _ = world_of("street-dense-fog")._transport(ASKED["rows"], 40, ASKED["command_range"])
    once, _ = world_of("street")._transport(ASKED["rows"], 40, ASKED["command_range"])
    assert once.spot_light is once.light  # `street` has no light scattered more than once
    world = world_of("street-dense-fog")
    first, last = ASKED["command_range"]
    parts = world.flux_row(int(ASKED["rows"][2]), first + 20.5 * (last - first) / 40, 1.0, 1.0)
    halo, stripe = parts["halo"], parts["stripe"]
    middle = float(np.sum(stripe * np.arange(96)) / stripe.sum())
    gone = light.light[2, 20] - light.spot_light[2, 20]
    rows = halo / (halo - gone)
    np.testing.assert_allclose(rows, 2 * np.abs(np.arange(96) - middle) + 0.05 * 110, rtol=0.05)


@pytest.mark.parametrize("optical", [0.1, 0.5, 1.0])
def test_a_spots_halo_is_spread_over_the_rows_that_the_band_of_a_line_implies(optical: float) -> None:
    lobes = Medium.model_validate({"fog": {"visibility": "10 m"}}).lobes
    band = shapes(lobes, 1.0, 0.1)[0][np.argmin(np.abs(DEPTHS - optical))]
    # A density K(r) around a spot adds up to the band k(x) along lines: K(r) = -1/pi int k'(x) / sqrt(x^2 - r^2) dx.
    slope = np.diff(band) / np.diff(AT)
    for off_px in (5, 20, 60, 150):
        at = int(np.argmin(np.abs(AT - off_px / 600)))
        reach = np.arccosh(AT[at:] / AT[at])
        density = -np.sum(slope[at:] * np.diff(reach)) / np.pi
        rows = transport.spread_rows(AT[at] * 600, 600.0)
        assert rows == pytest.approx(600 * band[at] / density, rel=0.4)


def test_a_dark_pattern_leaves_ambient_light_and_dark_counts() -> None:
    world = world_of()
    counts = made(world).spad_counts(np.zeros((1, 40)), np.array([100_000]))[0]
    z = deviations(counts, 100_000, 1e-5 * world.flux_model.steady_per_s[ASKED["rows"]])
    assert np.abs(z).max() < 5.5
    assert 0.8 < z.std() < 1.2


def test_the_camera_sees_the_light_of_the_spad_with_its_own_efficiency_and_no_dark_counts_of_it() -> None:
    world = world_of(sensor={"dark_rate": "1000 cps"}, conventional_camera={"full_well": 1e6, "bits": 16})
    apparatus = made(world)
    patterns = np.stack([np.ones(40), np.zeros(40)]).astype(np.float32)
    images = np.mean([apparatus.camera_images(patterns, 0.01) for _ in range(60)], axis=0)
    electron = 65535 / (1e6 + 4 * 6.8)
    steady = world.flux_model.steady
    ambient = (steady["ambient"] + steady["airlight"])[ASKED["rows"]]
    source = np.mean([line_light(world, column) for column in range(40)], axis=0) * 0.05
    light = 0.77 / (0.5 * 0.105) * np.stack([ambient + source, ambient]) + 1.5
    expected = electron * (np.minimum(0.01 * light, 1e6) + 4 * 6.8)
    sd = np.sqrt((electron * electron * (0.01 * light + 6.8**2) + 1 / 12) / 60)
    unsaturated = 0.01 * light < 9e5
    z = ((images - expected) / sd)[unsaturated]
    assert abs(z.mean()) < 0.3
    assert np.abs(z).max() < 5.5


def test_the_same_seed_gives_the_same_and_another_one_other_counts() -> None:
    world = world_of()
    first, again, other = (made(world, seed=s).spad_counts(LIT[10:20], np.full(10, 50)) for s in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.02


def test_hot_dead_and_misread_pixels_are_those_of_the_sensor() -> None:
    sensor = {"dead_share": "10 %", "hot_share": "10 %", "bit_error_rate": "1 %"}
    world = world_of(sensor=sensor)
    frames = 20_000
    counts = made(world).spad_counts(LIT[20:21], np.array([frames]))[0]
    lot = np.random.default_rng([Sensor().pixel_seed, 2]).random((40, 96))[ASKED["rows"]]
    flux = 1e-5 * (world.flux_model.steady_per_s[ASKED["rows"]] + 0.05 * line_light(world, 20))
    p = np.where(lot < 0.1, 0, np.where(lot >= 0.9, 1, -np.expm1(-flux)))
    p = p * 0.99 + (1 - p) * 0.01
    z = (counts - frames * p) / np.sqrt(frames * p * (1 - p))
    assert np.abs(z).max() < 5
    assert 0.85 < z.std() < 1.15


WRONG = [
    ("spad_counts", (np.zeros((1, 39)), np.array([1])), "shape"),
    ("spad_counts", (np.zeros((0, 40)), np.zeros(0, int)), "shape"),
    ("spad_counts", (np.full((1, 40), np.nan), np.array([1])), "brightness is 0 to 1"),
    ("spad_counts", (np.full((1, 40), 1.5), np.array([1])), "brightness is 0 to 1"),
    ("spad_counts", (np.zeros((2, 40)), np.array([1])), "2 whole numbers"),
    ("spad_counts", (np.zeros((1, 40)), np.array([0])), "1 to"),
    ("spad_counts", (np.zeros((1, 40)), np.array([0.5])), "whole numbers"),
    ("camera_images", (np.zeros((1, 40)), 1e-3), "at least 0.00333333 s"),
    ("camera_images", (np.zeros((1, 40)), np.nan), "exposure_s is nan"),
    ("spots", (np.array([4]), np.array([0]), 1), "0 to 3"),
    ("spots", (np.array([0]), np.array([-1]), 1), "0 to 39"),
    ("spots", (np.array([0, 1]), np.array([0]), 1), "one of each"),
    ("spots", (np.array([0]), np.array([0]), 0), "1 to"),
    ("spots", (np.array([0]), np.array([0]), 1, 0.0), "above 0"),
    ("pulse_times", (0, 1e-10), "1 to"),
    ("pulse_times", (1, 0.0), "bin_s is 0 s"),
    ("pulse_times", (1, 1e-16), "GiB"),
    ("stereo_pair", (1e-4,), "at least"),
]


@pytest.mark.parametrize(("call", "given", "message"), WRONG)
def test_what_cannot_be_is_refused_in_a_line(call: str, given: tuple[object, ...], message: str) -> None:
    apparatus = made(world_of())
    with pytest.raises(ValueError, match=message) as refused:
        getattr(apparatus, call)(*given)
    assert "\n" not in str(refused.value)
    assert apparatus.spent.time_s == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rows": np.array([0, 40])}, "within 0 to 39"), ({"rows": np.array([4, 3])}, "ascend"),
        ({"rows": np.zeros(0, int)}, "rows are"), ({"columns": 1}, "2 to"), ({"command_range": (-2.0, 1.0)}, "mirror"),
        ({"command_range": (0.3, 0.3)}, "command_range"), ({"power_w": -1.0}, "power_w"), ({"rule": "none"}, "rule"),
        ({"power_w": np.inf}, "power_w"), ({"depth_range_m": (0.0, 3.0)}, "depth_range_m"),
        ({"spad_frame_s": 0.0}, "spad_frame_s"),
    ],
)  # fmt: skip
def test_an_apparatus_that_cannot_be_is_refused(changed: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(world_of(), **changed)


def test_a_scene_that_moves_is_refused() -> None:
    with pytest.raises(DeviceError, match="use a scene without motion"):
        made(world_of("street-everything"))


def test_a_descending_range_of_commands_mirrors_the_columns() -> None:
    world = world_of()
    up, _ = world._transport(ASKED["rows"], 40, (-0.5, 0.8))
    down, _ = world._transport(ASKED["rows"], 40, (0.8, -0.5))
    np.testing.assert_allclose(up.light, down.light[:, ::-1], rtol=1e-5, atol=1e-3)
