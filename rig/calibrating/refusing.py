"""What is said where views make no calibration."""

from collections import Counter

from calibration.board.board import Board
from calibration.errors import Degenerate
from calibration.judging.rig import judge_refused
from rig.calibrating.taken import Taken


def refusal(refused: Degenerate, taken: Taken, board: Board, *, photons: bool = True, line: bool = True) -> Degenerate:
    """The root cause; as notes what the fit said, the other reasons, and what was wrong with single views unless that
    was told when they were taken.

    photons: whether the pictures count photons; those from files do not. line: whether it was to be seen, or a camera
    alone was asked for.
    """
    refused = _of_views(refused, taken)
    reasons = judge_refused(refused, taken.views, board, taken.size, photons=photons, line=line).reasons
    error = Degenerate(reasons[0].code, str(reasons[0]))
    if str(refused) not in str(error):
        error.add_note(f"{refused.reason}: {refused}")
    for reason in reasons[1:]:
        if reason.text != str(refused):
            error.add_note(str(reason))
    note_views(error, taken)
    return error


def note_views(error: Degenerate, taken: Taken) -> None:
    """Add what was wrong with single views, unless that was told when they were taken."""
    for name, why in taken.refused.items() if taken.tell is None else ():
        error.add_note(f"view {name}: {why}")


def _of_views(refused: Degenerate, taken: Taken) -> Degenerate:
    """Why most views have no board, where that is why there is no model."""
    if refused.reason != "no-board" or not taken.refused:
        return refused
    (reason, _), *_ = Counter(why.reason for why in taken.refused.values()).most_common()
    return Degenerate(reason, f"none of {len(taken.views)} views shows the board as it should")
