"""The verdict on a calibration: whether it is good enough for what was asked, and the reasons if not."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

from calibration.errors import digits

VerdictWord = Literal["passed", "failed"]
"""A verdict as written in files."""
SIGMAS: Final = 4.0
"""Standard deviations by which a result, such as the baseline, must differ from the stated one to count as wrong."""
WORST_TIMES: Final = 4.0
"""The 95th percentile of the error over the picture may be this many times the error asked for."""


AT_M: Final = 5.0
"""Distance at which depth is judged by default."""


@dataclass(frozen=True, slots=True)
class AccuracyGoal:
    """The required quality of a calibration: the largest sd of depth at the distance `at_m`, and the baseline if it was
    measured."""

    accuracy_m: float
    at_m: float = AT_M
    stated_baseline_m: float | None = None


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason against a calibration: code for programs, text for people, value and limit in one unit (NaN: none)."""

    code: str
    text: str
    value: float
    limit: float
    next_step: str

    def __str__(self) -> str:
        """Code, text and next step in one line."""
        return f"{self.code}: {self.text}; {self.next_step}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a calibration may be used, and why not. The reasons against a fit begin with the most likely root
    cause."""

    passed: bool
    reasons: tuple[Reason, ...] = ()

    @property
    def word(self) -> VerdictWord:
        """The verdict as a single word."""
        return "passed" if self.passed else "failed"

    @property
    def codes(self) -> tuple[str, ...]:
        """The reasons' codes."""
        return tuple(reason.code for reason in self.reasons)

    def as_json(self) -> dict[str, Any]:
        """The verdict as JSON content, for programs."""
        return {"passed": self.passed, "reasons": [asdict(reason) for reason in self.reasons]}


MOST_POSES: Final = 50
"""Most poses that can be expected of a person: four times those of a usual calibration."""

_GUIDED = " ('--guided' says which)"
_TELL_MORE = f"make each pose tell more, with more light, the board nearer and tilted more{_GUIDED}"
_NEXT_STEP = {
    "exposure-not-locked": "lock the exposures to the scan (shared clock, markers in the stream) and check for a loose "
    "marker cable",
    "moved-rig": "fix camera and scanner to one another, leave the rig alone and calibrate again",
    "wrong-square-size": "measure a square of the print and write its side into the board's file, or correct the "
    "stated baseline",
    "room-light": "darken the room or shorten the exposures",
    "too-few-poses": f"show the board in more poses{_GUIDED}",
    "no-tilt": "tilt the board by 20 to 40 degrees, to all sides",
    "board-too-far": "come nearer, until the board fills a third of the picture",
    "poor-coverage": "show the board at the borders and in the corners of the picture too",
    "no-board": "show the whole board, lit evenly, and check that the board's file is the print's",
    "wrong-board": "name the board that is shown (--board), or show the one that is named",
    "board-half-out": "move it in until all of it is in the picture",
    "mirrored": "turn the print over, or correct the sensor's orientation in the config",
    "two-boards": "show one at a time",
}


def reason_for(code: str, text: str, value: float = math.nan, limit: float = math.nan) -> Reason:
    """A reason with the next step that belongs to its code; for any other code, to show the board again."""
    return Reason(code, text, value, limit, _NEXT_STEP.get(code, "show the board again"))


def unguided(verdict: Verdict) -> Verdict:
    """The verdict with next steps that do not mention `--guided`, for a command that has no guided mode."""
    reasons = tuple(replace(reason, next_step=reason.next_step.replace(_GUIDED, "")) for reason in verdict.reasons)
    return replace(verdict, reasons=reasons)


def more_poses(shown: int, what: str, found: tuple[float, float], asked: float, said: Callable[[float], str]) -> Reason:
    """The reason if data are simply too few. The text estimates how many poses would be enough. If these are more than
    MOST_POSES, it says instead that more poses will not do. If the error is not finite, the text has no estimate.

    shown: number of poses so far. what: words for the error, with the verb. found: median and 95th percentile of the
    error over the picture; the text names the one that exceeds its limit more. asked: limit of the median; that of the
    percentile is WORST_TIMES as large. said: turns an error into text.
    """
    over = [error / limit for error, limit in zip(found, (asked, WORST_TIMES * asked), strict=True)]
    worst = over[1] > over[0]
    text = f"{'in the worst 5 % of the picture ' if worst else ''}{what} {said(found[worst])}, asked for are "
    text += said(WORST_TIMES * asked if worst else asked)
    if not math.isfinite(over[worst]):
        return reason_for("too-few-poses", text, shown)
    needed = math.ceil(shown * over[worst] ** 2)
    if needed > MOST_POSES:
        text = f"{text}, {digits(over[worst], 2)} times less: more poses like these {shown} will not do"
        return replace(reason_for("too-few-poses", text, shown, needed), next_step=_TELL_MORE)
    return reason_for("too-few-poses", f"{text}: about {needed} poses would do", shown, needed)
