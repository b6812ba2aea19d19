"""The line's width over depth: thin-lens defocus, and a sheet that spreads."""

import numpy as np
import pytest

from drivers.errors import DeviceError
from sim_backend.light import line
from sim_backend.light.line import line_width, sigma_px
from sim_backend.light.optics import Line, Optics, Sensor
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import effect_rate, made_world, rig, setting, wall

covers(line)


def _sigma(optics: Optics, line: Line, depth_m: float) -> float:
    """Standard deviation in px of the stripe on a wall, pixels taken off."""
    model = rig(size=(8, 301), focal_px=600.0)
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), depth_m), optics=optics, line=line)
    plane = model.planes(0.3 / depth_m / 0.35)
    row, centre = effect_rate(setup, "stripe", plane)[3], setup.view.sheet(plane).x_stripe_px[3]
    return float(np.sqrt(row @ (np.arange(301) - centre) ** 2 / row.sum() - 1 / 12))


@pytest.mark.parametrize("depth_m", [1.5, 3.0, 8.0])
def test_defocus_is_the_disc_of_a_thin_lens(depth_m: float) -> None:
    """By the lens equation: an image distance for each depth, and the cone of light cut by the sensor."""
    optics = Optics.model_validate({"focus": "3 m", "f_number": 1.4})
    focal_m = 600 * 16.38e-6
    sensor_m = 1 / (1 / focal_m - 1 / 3.0)
    image_m = 1 / (1 / focal_m - 1 / depth_m)
    disc_px = focal_m / 1.4 * abs(sensor_m - image_m) / image_m / 16.38e-6
    expected = np.hypot(0.6, disc_px / 4)  # a disc has a variance of a sixteenth of its diameter squared along an axis
    assert _sigma(optics, Line(), depth_m) == pytest.approx(expected, rel=2e-3)


def test_a_sheet_that_spreads_keeps_its_angle_on_the_way() -> None:
    line = Line.model_validate({"spread": "8 mrad"})
    for depth_m in (2.0, 6.0):
        expected = np.hypot(0.6, 600 * 8e-3 / 4)  # as seen from the mirror, nearly as far away
        assert _sigma(Optics(), line, depth_m) == pytest.approx(expected, rel=0.03)


def test_without_either_it_is_as_wide_everywhere() -> None:
    model = rig()
    view = setting(model, wall(model, (0.0, 0.0, 1.0), 2.0)).view
    width = line_width(view, Optics(), Sensor(), Line())
    assert {sigma_px(width, w, r) for w in (0.1, 1.0, 5.0) for r in (0.2, 3.0)} == {0.6}


@pytest.mark.parametrize("focus", ["1 mm", "9.828 mm"])
def test_a_world_refuses_a_focus_within_the_focal_length(focus: str) -> None:
    # 600 px times 16.38 um: 9.828 mm
    with pytest.raises(DeviceError, match=r"optics\.focus.*focal length of 9\.83 mm.*beyond"):
        made_world(optics={"focus": focus})
