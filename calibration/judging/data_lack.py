"""What views of a board lack to make a calibration: light of the line only, poses, tilts, size, coverage."""

import math
from dataclasses import dataclass, replace
from typing import Final

from calibration.judging.evidence import PoseEvidence, ViewEvidence
from calibration.rig_fit.degenerate import unfit
from calibration.verdict import Reason, reason_for

_FEWEST_TO_JUDGE = 3
"""Of fewer poses neither tilt nor coverage can be asked."""
_MEND_VIEWS = "mend what is said of the other views, then show more"
_SHOW_ANEW = "show the board again for each of these, at rest until its sweeps are over"
FEWEST_POSES: Final = 6
"""With fewer, a single bad view bends the fit to it, so that nothing shows that it was bad."""
FEWEST_WHY: Final = "are the fewest that can be checked against each other"


@dataclass(frozen=True, slots=True)
class Limit:
    """Of a number: what is never enough, and what is no likely cause of an error that is too large."""

    always: float
    imprecise: float

    def at(self, imprecise: bool) -> float:
        """The one that counts."""
        return self.imprecise if imprecise else self.always


LEAST_TILT_RAD: Final = Limit(math.radians(12), math.radians(20))
"""Between two boards. Of boards parallel to each other focal length and distance cannot be told apart: they hang on the
mirror's model alone, which nothing checks then."""
LEAST_BOARD_RAD: Final = Limit(0.11, 0.15)
"""Seen under smaller angles, a board's perspective (by which focal length is told) goes with the angle's square."""
LEAST_COVERAGE: Final = Limit(0.3, 0.5)
"""Share of the picture within the outline of all corners; the lens is extrapolated outside, which nothing checks."""
MOST_ROOM_FLUX: Final = Limit(3.0, 1.0)
"""Photons per pixel and exposure from white. At 3, 95 % of the frames hold a 1 whether the line is there or not; from 1
on room light costs more than half of what a frame can tell of the line."""


def data_lack(
    views: ViewEvidence, poses: PoseEvidence | None, *, imprecise: bool, photons: bool = True
) -> list[Reason]:
    """What the data lack, but for what is `hiding` the rest: more counts where the result is not precise enough.

    poses: None where nothing tells. photons: whether pictures count photons; those from files do not.
    """
    found = []
    bright = photons and MOST_ROOM_FLUX.at(imprecise) < views.room_flux <= MOST_ROOM_FLUX.always
    light = [_room_light(views.room_flux, MOST_ROOM_FLUX.at(imprecise))] if bright else []
    if views.used < FEWEST_POSES <= views.shown:
        found, light = light, []  # what hides board and line goes before the views that lack them
    if views.used < FEWEST_POSES:
        found.append(_too_few(views))
    if views.used < _FEWEST_TO_JUDGE:
        return found
    if poses is not None:
        found += _poses_lack(poses, imprecise)
    least = LEAST_COVERAGE.at(imprecise)
    if views.coverage < least:
        text = f"corners reach {views.coverage:.0%} of the picture, {least:.0%} are needed"
        found.append(reason_for("poor-coverage", text, views.coverage, least))
    return found + light


def hiding(views: ViewEvidence, poses: PoseEvidence | None, *, photons: bool = True) -> list[Reason]:
    """What makes up other faults: room light in which frames hold little else, and boards so far away that their
    corners do not say where they are. As for `data_lack`.
    """
    found = []
    if photons and views.room_flux > MOST_ROOM_FLUX.always:
        found.append(_room_light(views.room_flux, MOST_ROOM_FLUX.always))
    if views.used >= _FEWEST_TO_JUDGE and poses is not None and poses.board_rad < LEAST_BOARD_RAD.always:
        found.append(_too_far(poses, LEAST_BOARD_RAD.always))
    return found


def _too_few(views: ViewEvidence) -> Reason:
    shown = f"{views.shown} {'pose was' if views.shown == 1 else 'poses were'} shown"
    limit = f"{FEWEST_POSES} {FEWEST_WHY}"
    if views.used == views.shown:
        return reason_for("too-few-poses", f"{shown}, {limit}", views.shown, FEWEST_POSES)
    odd = f" ({unfit(views.odd)})" if views.odd else ""
    text = f"{shown}, {views.used or 'none'} of them could be used{odd}, {limit}"
    step = _SHOW_ANEW if views.used + len(views.odd) == views.shown else _MEND_VIEWS
    return replace(reason_for("too-few-poses", text, views.used, FEWEST_POSES), next_step=step)


def _poses_lack(poses: PoseEvidence, imprecise: bool) -> list[Reason]:
    found = []
    least = LEAST_TILT_RAD.at(imprecise)
    if poses.tilt_rad < least:
        text = (
            f"no two boards are tilted more than {math.degrees(poses.tilt_rad):.0f} degrees against each other, "
            f"{math.degrees(least):.0f} are needed"
        )
        found.append(reason_for("no-tilt", text, poses.tilt_rad, least))
    if LEAST_BOARD_RAD.always <= poses.board_rad < LEAST_BOARD_RAD.at(imprecise):
        found.append(_too_far(poses, LEAST_BOARD_RAD.at(imprecise)))
    return found


def _too_far(poses: PoseEvidence, least: float) -> Reason:
    text = (
        f"boards stood {poses.distance_m:.2g} m away (median) and were seen under "
        f"{math.degrees(poses.board_rad):.1f} degrees, {math.degrees(least):.1f} are needed"
    )
    return reason_for("board-too-far", text, poses.board_rad, least)


def _room_light(flux: float, limit: float) -> Reason:
    text = f"room light gives {flux:.2g} photons per pixel and exposure on white, the limit is {limit:g}"
    return reason_for("room-light", text, flux, limit)
