"""Parameters of a model: their changes do what their names say."""

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.model.parameters import parameters, with_parameters
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from tests.unit.calibration.cameras import camera

COMMANDS = np.linspace(-1, 1, 9)


def model(**changes) -> RigModel:
    scanner = PivotScanner(
        np.array([-0.3, 0.1, 0.02]), np.array([0.02, 1, -0.05]), np.array([1, 0, 0.1]), np.array([0.1, 0.4, 1e-3]),
        offset_m=np.array([1e-3, 2e-4]), cone_rad=0.01, bow_per_rad=0.02,
    )  # fmt: skip
    return RigModel(camera([-0.3, 0.1, 1e-3, 1e-3, 0.01]), scanner, Lag(2e-4, 3e-4), row_delay_s=1e-8, **changes)


def test_every_parameter_is_named_once_with_its_value() -> None:
    names, values = parameters(model())
    assert len(set(names)) == len(names) == len(values)
    assert names[:6] == ("fx", "fy", "cx", "cy", "k1", "k2")
    said = dict(zip(names, values, strict=True))
    assert said["k3"] == 0.01
    assert said["axis_turn_1"] == said["axis_shift_2"] == 0
    assert (said["angle_2"], said["offset_1"], said["cone"], said["bow"]) == (1e-3, 2e-4, 0.01, 0.02)
    assert (said["lag_forward"], said["lag_backward"], said["row_delay"]) == (2e-4, 3e-4, 1e-8)


def test_axis_turns_and_shifts_move_all_planes_as_one_body() -> None:
    base = model()
    mirror = base.scanner
    assert isinstance(mirror, PivotScanner)
    e1, e2 = mirror.zero_normal, np.cross(mirror.axis_direction, mirror.zero_normal)
    turn = cv2.Rodrigues(0.02 * e1 - 0.03 * e2)[0]
    shift = 0.004 * e1 - 0.002 * e2
    names = ("axis_turn_1", "axis_turn_2", "axis_shift_1", "axis_shift_2")
    moved = with_parameters(base, names, [0.02, -0.03, 0.004, -0.002]).planes(COMMANDS)
    planes = base.planes(COMMANDS)
    normal = planes[:, :3] @ turn.T
    about = planes[:, 3] - planes[:, :3] @ mirror.axis_point_m  # of a plane turned about the axis point, the same
    assert moved[:, :3] == pytest.approx(normal, abs=1e-14)
    assert moved[:, 3] == pytest.approx(about + normal @ (mirror.axis_point_m + shift), abs=1e-14)


def test_terms_beyond_those_of_the_model_begin_at_zero() -> None:
    longer = with_parameters(model(), ["angle_4", "offset_3"], [1e-4, 2e-5]).scanner
    assert isinstance(longer, PivotScanner)
    assert longer.angle_rad.tolist() == [0.1, 0.4, 1e-3, 0, 1e-4]
    assert longer.offset_m.tolist() == [1e-3, 2e-4, 0, 2e-5]


def test_what_a_model_does_not_have_is_refused_with_what_it_has() -> None:
    table = RigModel(camera([]), PlaneTable(np.zeros(1), np.array([[1, 0, 0, -0.3]])))
    assert "angle_0" not in parameters(table)[0]
    for name in ("angle_0", "k1", "nonsense"):
        with pytest.raises(CalibrationError, match=f"no parameter {name}; it has fx, fy"):
            with_parameters(table, [name], [0.1])
    with pytest.raises(CalibrationError, match="lag_s"):
        with_parameters(table, ["lag_forward"], [-1.0])
