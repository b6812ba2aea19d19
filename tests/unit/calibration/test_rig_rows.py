"""Derivatives of residuals, against differences."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.rows import Rows, Terms
from calibration.rig_fit.state import first_state, sighting
from calibration.views import BoardPose
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, rotation, seen_view

LENSES = {
    5: [-0.15, 0.05, 1e-3, -8e-4, 0.02],
    12: [0.1, 0.02, 1e-3, -8e-4, 0.01, 0.2, 0.03, 0.01, 1e-3, 2e-3, -1e-3, 5e-4],
}


@pytest.mark.parametrize("lens", [5, 12])
def test_every_derivative_is_that_of_the_residual(lens: int) -> None:
    camera = Camera(512, 512, np.array([[600.0, 0, 250], [0, 610, 260], [0, 0, 1]]), np.array(LENSES[lens]))
    turn, position = np.array([0.3, -0.4, 0.1]), np.array([-0.3, -0.2, 1.4])
    scanner = PivotScanner(
        axis_point_m=np.array([-0.3, 0.01, 0.02]),
        axis_direction=rotation(np.array([0.05, 0, 0.03])) @ [0, 1, 0],
        zero_normal=np.array([1.0, 0, 0]),
        angle_rad=np.array([0.09, 0.53, 0.02, 0, 0, 0]),
        offset_m=np.array([2e-3, 1e-3]),
        cone_rad=0.02,
    )
    rig = TrueRig()
    view = seen_view(np.random.default_rng(0), rig, turn, position, Seen(passages=60, passage=1e-3))
    pose = BoardPose(turn, position)
    seen = sighting(view, BOARD, camera, pose)
    terms = Terms(lens)
    state = first_state(RigModel(camera, scanner), np.array([2e-4, 1e-4, 2e-8]), [pose], [seen])
    # Passages that the light meets exactly: elsewhere, only the model's own place of the light counts.
    seen = replace(seen, command=seen.command - state.rows(0, seen, terms)[1].residual)
    corners, passages = state.rows(0, seen, terms)
    assert np.abs(passages.residual).max() < 1e-6

    def moved(shared: np.ndarray, pose: np.ndarray) -> tuple[Rows, Rows]:
        return state.stepped(terms, shared, [pose], [seen]).rows(0, seen, terms)

    steps = {"fx": 1e-3, "fy": 1e-3, "cx": 1e-3, "cy": 1e-3, "row_delay": 1e-9}
    for column, name in enumerate(terms.names):
        step = steps.get(name, 1e-6)
        change = np.zeros(len(terms.names))
        change[column] = step
        above, below = (moved(sign * change, np.zeros(6)) for sign in (1, -1))
        for found, up, down in zip((corners, passages), above, below, strict=True):
            slope = (up.residual - down.residual) / (2 * step)
            assert np.abs(slope - found.shared[:, column]).max() <= 1e-4 * np.abs(slope).max() + 1e-6, name
    for column in range(6):
        change = np.zeros(6)
        change[column] = 1e-6
        nothing = np.zeros(len(terms.names))
        above, below = (moved(nothing, sign * change) for sign in (1, -1))
        for found, up, down in zip((corners, passages), above, below, strict=True):
            slope = (up.residual - down.residual) / 2e-6
            assert np.abs(slope - found.pose[:, column]).max() <= 1e-4 * np.abs(slope).max() + 1e-6
