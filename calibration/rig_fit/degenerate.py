"""Views that make no model of a rig: refused with the reason, what was measured, its limit and what to do."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.depth.uncertainty import command_at, depth_sd_m
from calibration.digits import condition_text, digits
from calibration.errors import Degenerate
from calibration.model.rig_model import RigModel
from calibration.rig_fit.sightings import Sighting
from calibration.verdict import AT_M
from calibration.views import BoardPose, View

Array = NDArray[np.float64]

LEAST_TILT_RAD = np.radians(5.0)
"""Between two boards at least."""
LEAST_THICKNESS = 0.01
"""Of the points about the plane that fits them best, as a share of their distance: less is one plane."""
LEAST_SPAN = 0.02
"""Of the mirror's command range: a line that hardly moved tells nothing of how it turns."""
LEAST_LIT_SHARE = 0.1
"""Of the picture, for a distance to be judged at."""
MOST_DEPTH_SD_SHARE = 0.2
"""Of the distance it is judged at; a model that knows depth no better knows nothing."""


def check_views(views: Sequence[View], sightings: Sequence[Sighting]) -> None:
    """Raise Degenerate unless two views show board and line, and the line moved."""
    with_line = [seen for seen in sightings if seen.command.size]
    if len(sightings) == 0:
        raise Degenerate(
            "no-board", f"none of {len(views)} views shows the board; show all of it, closer or with more light"
        )
    if len(with_line) < 2:
        raise Degenerate(
            "one-pose" if len(sightings) < 2 else "no-line",
            f"{len(with_line)} of {len(views)} views show both the board and the line on it, limit 2 (condition number "
            "inf); show the board at 8 or more poses, at several distances and tilted differently",
        )
    commands = np.concatenate([seen.command for seen in with_line])
    low, high = np.percentile(commands, [1, 99])
    if high - low < LEAST_SPAN:
        raise Degenerate(
            "poor-coverage",
            f"line passed the board at commands {low:.4g} to {high:.4g} alone, limit a span of {LEAST_SPAN:g} "
            "(condition number inf); sweep further, or show the board where the line moves",
        )


def check_poses(points_m: Array, poses: Sequence[BoardPose]) -> None:
    """Raise Degenerate where all points (m, 3) at which the light met the boards lie in one plane."""
    middle = points_m.mean(axis=0)
    sizes = np.linalg.svd(points_m - middle, compute_uv=False) / np.sqrt(len(points_m))
    thickness = float(sizes[2] / np.linalg.norm(middle))
    if not thickness >= LEAST_THICKNESS:
        raise Degenerate(
            "coplanar",
            f"boards of all {len(poses)} views lie in one plane: the light's points leave it by {thickness:.2g} of "
            f"their distance, limit {LEAST_THICKNESS:g} (condition number "
            f"{condition_text(sizes[0] / max(sizes[2], 1e-300))}); show the board at other distances and tilted "
            "differently",
        )


def reason_of(poses: Sequence[BoardPose]) -> str:
    """The likeliest reason why boards at these poses fix too little: a guess, where `coplanar` is seen."""
    normals = np.array([pose.matrix[:, 2] for pose in poses])
    tilt = float(np.arccos(np.clip(normals @ normals.T, -1, 1).min()))
    return "too-few-poses" if tilt >= LEAST_TILT_RAD and len(poses) < 6 else "no-tilt"


def no_start(error: Exception, poses: Sequence[BoardPose]) -> Degenerate:
    """What is raised where not even a first guess makes a rig."""
    return Degenerate(
        reason_of(poses),
        f"light on {len(poses)} boards fits no mirror: {error}; show the board at 8 or more poses, at several "
        "distances and tilted differently",
    )


def unfit(names: Sequence[str]) -> str:
    """That these views had no say, in words."""
    return f"view{'s' if len(names) > 1 else ''} {', '.join(names)} left out: unlike the others"


def check_depth(
    model: RigModel,
    poses: Sequence[BoardPose],
    condition: float,
    velocity_per_s: float,
    misfit: float = 1.0,
    outliers: Sequence[str] = (),
) -> None:
    """Raise Degenerate where the poses of a fitted model tell next to nothing of depth.

    misfit: by which its variances were widened since the data contradict each other; that says nothing of the poses.
    outliers: names of the views that had no say, whose poses are none of these.
    """
    camera = model.camera
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 7) * camera.width, np.linspace(0.1, 0.9, 5) * camera.height)
    for at_m in (AT_M, float(np.median([np.linalg.norm(pose.position_m) for pose in poses]))):
        command = command_at(model, x, y, at_m)
        sd = depth_sd_m(model, x, y, command, velocity_per_s)
        if np.isfinite(sd).mean() >= LEAST_LIT_SHARE:
            break
    else:
        raise Degenerate(
            reason_of(poses), f"line reaches nothing at {at_m:.3g} m; sweep further, or show the board at more poses"
        )
    usual = float(np.nanmedian(sd)) / math.sqrt(misfit)
    odd = f" ({unfit(outliers)})" if outliers else ""
    if usual > MOST_DEPTH_SD_SHARE * at_m:
        raise Degenerate(
            reason_of(poses),
            f"depth at {at_m:.3g} m would be known to {digits(usual)} m from {len(poses)} poses{odd}, limit "
            f"{MOST_DEPTH_SD_SHARE * at_m:.3g} m (condition number {condition_text(condition)}); show the board at "
            "more poses, at other distances and tilted differently",
        )
