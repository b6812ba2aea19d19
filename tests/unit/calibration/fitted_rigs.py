"""A rig of the second simulator, and fits of its views."""

from typing import Any

import numpy as np

from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance
from calibration.rig_fit.fit import RigFit, fit_rig
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, random_views

SIZE = (512, 512)
SEEN = Seen(passages=200, passage=1e-3, corner_px=0.04)
EXACT = Seen(passages=200, passage=1e-3, factor=1e-6, corner_px=1e-7)
RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02), lag=(1.5e-4, 2.5e-4))


def fitted(rig: TrueRig, seed: int, seen: Seen = SEEN, poses: int = 8, **given: object) -> RigFit:
    velocities = given.pop("velocities", (35.2, -35.2))
    views = random_views(np.random.default_rng(seed), rig, poses, seen, velocities)  # type: ignore[arg-type]
    return fit_rig(views, BOARD, SIZE, **given)  # type: ignore[arg-type]


def held(rig: TrueRig) -> dict[str, Any]:
    """What is given to a fit of a rig whose camera is known exactly."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return {"camera": true_camera(rig), "known": Covariance(names, np.zeros((9, 9)))}


def true_camera(rig: TrueRig) -> Camera:
    return Camera(*SIZE, np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1.0]]), np.array(rig.lens))
