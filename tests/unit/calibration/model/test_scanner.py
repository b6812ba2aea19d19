"""Light planes from mirror commands, and light that bows out of its plane, against light traced ray by ray."""

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.model.light_sheet import depth, light_sheets
from calibration.model.scanner import PivotScanner, PlaneTable
from tests.unit.calibration.fans import Fan


def vertical_planes(tangents: np.ndarray, baseline_m: float = 0.3) -> np.ndarray:
    """Planes X = -baseline + tangent Z."""
    rows = np.stack([np.ones_like(tangents), 0 * tangents, -tangents, np.full_like(tangents, -baseline_m)], axis=1)
    return rows / np.linalg.norm(rows[:, :3], axis=1, keepdims=True)


def pivot(**changes: object) -> PivotScanner:
    """The mirror of the simulated rig."""
    given = {
        "axis_point_m": [-0.3, 0, 0],
        "axis_direction": [0, 2, 0],
        "zero_normal": [1, 5, 0],
        "angle_rad": [0.1, 0.4],
    } | changes
    return PivotScanner(**given)


def test_a_table_gives_its_own_planes_back() -> None:
    rows = vertical_planes(np.linspace(-0.3, 0.5, 500))
    table = PlaneTable(np.arange(500.0), rows)
    assert np.abs(table.planes(np.arange(500)) - rows).max() < 1e-15
    assert table.command_range == (0, 499)
    assert table.planes(np.zeros((2, 3))).shape == (2, 3, 4)
    assert table.planes(7).shape == (4,)


@pytest.mark.parametrize("command", [-1.1, 1.1, np.nan, np.inf])
def test_a_command_outside_the_calibrated_range_is_refused(command: float) -> None:
    with pytest.raises(CalibrationError, match=r"outside the calibrated range \[-1, 1\]"):
        pivot().planes([0, command])


@pytest.mark.parametrize(
    ("command", "rows", "said"),
    [
        ([0, 1], [[1, 0, 0, 1]], "1 planes for 2 commands"),
        ([0, 0], [[1, 0, 0, 1], [1, 0, 0, 2]], "must increase"),
        ([0], [[0, 0, 0, 1]], "non-zero normal"),
        ([0], [[1, 0, np.nan, 1]], "non-zero normal"),
        ([], np.zeros((0, 4)), "nx, ny, nz, d"),
        ([0], [[1, 0, 0]], "nx, ny, nz, d"),
    ],
)
def test_a_table_that_is_none_is_refused(command: list[float], rows: list[list[float]], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        PlaneTable(np.array(command, float), np.array(rows))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"axis_direction": [0, 0, 0]}, "length zero"),
        ({"zero_normal": [0, 1, 0]}, "zero_normal"),
        ({"axis_point_m": [0, 1]}, "three finite numbers"),
        ({"angle_rad": []}, "polynomial"),
        ({"command_range": (1, -1)}, "smaller"),
    ],
)
def test_a_pivot_that_is_none_is_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        pivot(**changes)


def test_signs_and_lengths_in_a_table_do_not_matter() -> None:
    rows = vertical_planes(np.linspace(-0.3, 0.5, 9))
    signs = np.array([1, -1, -1, 1, -2, 3, -1, 1, -1.0])
    at = np.linspace(0, 8, 50)
    assert np.allclose(
        PlaneTable(np.arange(9.0), rows * signs[:, None]).planes(at), PlaneTable(np.arange(9.0), rows).planes(at)
    )


ANGLE = [0.1, 0.4, 0.02]
COMMANDS = [-0.8, 0.0, 0.9]
FANS = {
    "bowed": {"bow": 0.02},
    "the other way, beside its axis, on a cone": {"bow": -0.05, "offset": (2e-3, -1e-3), "cone": 0.02},
    "from a source off the axis": {"bow": 0.03, "offset": (1e-3,), "source": (-0.28, 0.07, 0.03)},
    "strongly bowed": {"bow": 0.2, "cone": -0.05},
}


def both(side: float, turned: bool, **changes) -> tuple[Fan, PivotScanner]:
    """The same mirror traced and modelled, on one side of the camera, its normal written one way or the other."""
    point, axis = np.array([0.3 * side, 0.02, 0.01]), np.array([0.05, 1.0, -0.03])
    sign = -1.0 if turned else 1.0
    fan = Fan(point, axis, [1.0, 0, 0], **changes)
    scanner = PivotScanner(
        point if "cone" in changes else point + 0.4 * axis,  # any point of an axis, but a cone has one tip
        axis,
        np.array([sign, 0, 0]),
        np.array(ANGLE),
        offset_m=sign * np.array(changes.get("offset", ())),
        cone_rad=sign * changes.get("cone", 0.0),
        bow_per_rad=sign * changes["bow"],
    )
    return fan, scanner


@pytest.mark.parametrize("changes", FANS.values(), ids=FANS.keys())
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("turned", [False, True])
def test_depth_is_that_of_the_light_s_own_rays(changes: dict, side: float, turned: bool) -> None:
    changes = changes | ({"source": np.multiply(changes["source"], [-side, 1, 1])} if "source" in changes else {})
    fan, scanner = both(side, turned, **changes)
    rng = np.random.default_rng(3)
    for command in COMMANDS:
        angle = ANGLE[0] + ANGLE[1] * command + ANGLE[2] * command**2
        points = fan.light(angle, rng.uniform(-0.5, 0.5, 200), rng.uniform(0.7, 9.0, 200))
        sheet = light_sheets(scanner, changes.get("source"), command)
        z = sheet.depth(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        assert np.abs(z / points[:, 2] - 1).max() < 1e-9
        assert np.abs(sheet.distance_m(points)).max() < 1e-12
        flat = depth(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], sheet.planes)
        assert np.nanmax(np.abs(flat / points[:, 2] - 1)) > 1e-3  # so the bow is what the test is about


def test_a_sheet_without_a_bow_is_its_plane_bit_for_bit() -> None:
    scanner = PivotScanner(np.array([-0.3, 0, 0]), np.array([0, 1, 0]), np.array([1, 0, 0]), np.array(ANGLE))
    table = PlaneTable(np.array([-1.0, 1.0]), scanner.planes([-1.0, 1.0]))
    u, v = np.linspace(-0.4, 0.4, 30), 0.2
    for each in (scanner, table):
        assert np.array_equal(light_sheets(each, None, 0.3).depth(u, v), depth(u, v, each.planes(0.3)), equal_nan=True)


def test_rays_that_miss_a_bowed_sheet_have_no_depth() -> None:
    _, scanner = both(-1.0, False, bow=0.02)
    sheet = light_sheets(scanner, None, 0.0)
    assert np.isnan(sheet.depth([np.nan, -40.0, 0.6], 0.0)).all()  # none, behind the mirror, behind the camera
    assert np.all(np.isfinite(sheet.inverse_depth([0.0, 0.6, 0.1003], 0.2)))  # behind the camera, yet a number


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cone_rad": 0.7}, "cone_rad is 0.7"),
        ({"bow_per_rad": np.nan}, "bow_per_rad is nan"),
        ({"offset_m": [[1.0]]}, "offset_m"),
        ({"offset_m": [0.0, 50.0]}, "offset_m over the whole turn is 26"),
    ],
)
def test_a_mirror_that_is_none_is_refused(changes: dict, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        PivotScanner(np.zeros(3), np.array([0, 1, 0]), np.array([1, 0, 0]), np.array(ANGLE), **changes)
