"""What is said where views make no calibration."""

from calibration.errors import Degenerate
from calibration.verdict import Verdict
from rig.calibrating.taking import Taken


def refusal(refused: Degenerate, verdict: Verdict, taken: Taken) -> Degenerate:
    """The root cause; as notes what the fit said, the other reasons, and what was wrong with single views."""
    first = verdict.reasons[0]
    error = Degenerate(first.code, str(first))
    if str(refused) not in str(error):
        error.add_note(f"{refused.reason}: {refused}")
    for reason in verdict.reasons[1:]:
        if reason.text != str(refused):
            error.add_note(str(reason))
    for name, why in taken.refused.items():
        error.add_note(f"view {name}: {why}")
    return error
