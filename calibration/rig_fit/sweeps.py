"""What a fit leaves of each sweep's passages."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig_fit.rows import mirror_command, sheet_rows
from calibration.rig_fit.sightings import Sighting
from calibration.rig_fit.start import board_points
from calibration.rig_fit.state import RigState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SweepFit:
    """What is left of the passages of one sweep of a view; all float64 (m,), sorted by command.

    command: the mirror's, as the model has it. residual, sd: in command units. distance_m: how far the point on the
    board lies off the light.
    """

    direction: int
    speed_per_s: float
    x_px: Array
    y_px: Array
    command: Array
    residual: Array
    distance_m: Array
    sd: Array


def sweep_fits(seen: Sighting, residual: Array, state: RigState, view: int) -> tuple[SweepFit, ...]:
    """Of a view's sweeps, from the residuals of its passages."""
    command = mirror_command(state.timing, seen.command, seen.y_px, seen.velocity_per_s)
    points = board_points(state.model.camera, [seen], [state.poses[view]]).points_m
    per_command_m = sheet_rows(
        state.scanner, state.model.source_m, points, command, seen.y_px, seen.velocity_per_s
    ).per_command
    found = []
    for sweep in seen.sweeps:
        velocity = seen.velocity_per_s[sweep]
        found.append(
            SweepFit(
                direction=1 if velocity[0] > 0 else -1,
                speed_per_s=float(abs(velocity[0])),
                x_px=seen.x_px[sweep],
                y_px=seen.y_px[sweep],
                command=command[sweep],
                residual=residual[sweep],
                distance_m=residual[sweep] * per_command_m[sweep],
                sd=seen.sd[sweep],
            )
        )
    return tuple(found)
