"""Light planes from mirror commands."""

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.model.scanner import PivotScanner, PlaneTable


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
    return PivotScanner(**given)  # type: ignore[arg-type]


def test_a_table_gives_its_own_planes_back() -> None:
    rows = vertical_planes(np.linspace(-0.3, 0.5, 500))
    table = PlaneTable(np.arange(500.0), rows)
    assert np.abs(table.planes(np.arange(500)) - rows).max() < 1e-15
    assert table.command_range == (0, 499)
    assert table.planes(np.zeros((2, 3))).shape == (2, 3, 4)
    assert table.planes(7).shape == (4,)


def test_a_pivot_turns_about_its_axis() -> None:
    mirror = pivot()
    command = np.linspace(-1, 1, 7)
    planes = mirror.planes(command)
    on_axis = np.array([-0.3, 1.7, 0])
    assert np.allclose(planes[:, :3] @ on_axis, planes[:, 3])
    assert np.allclose(-planes[:, 2] / planes[:, 0], np.tan(0.1 + 0.4 * command))


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
