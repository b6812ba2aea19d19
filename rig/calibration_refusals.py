"""Why a calibration is not to be used, said in a line each, or that it was accepted all the same.

Of a rig's calibration (`calibration_identity`), and of the file of a camera alone (`calibrating.camera_use`).
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rig.errors import UsageError

NEXT: Final = "calibrate again, or add --accept-calibration to use it all the same"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a calibration is not to be used. code: other-spad, other-scanner, other-world, other-lines, failed-verdict,
    failed-check or too-old."""

    code: str
    text: str

    def __str__(self) -> str:
        """One line, as summaries have it."""
        return f"{self.code}: {self.text}"


def failed_verdict(verdict: str | None, reasons: Sequence[str]) -> list[Refusal]:
    """What a calibration's own verdict says against it: nothing where it passed, or where nobody judged it (None)."""
    if verdict != "failed":
        return []
    why = ", ".join(reasons) or "no reason noted"
    return [Refusal("failed-verdict", f"its verdict is 'failed' ({why}), 'passed' is needed")]


def require_accepted(name: str, found: Sequence[Refusal], accepted: Container[str]) -> None:
    """UsageError, a line for each reason whose code is not among the accepted. name: of what, for these lines."""
    if refused := [each for each in found if each.code not in accepted]:
        raise UsageError.of(f"{name}: {each.text}; {NEXT}" for each in refused)


def check_content(checked: str, accepted: Sequence[Refusal]) -> dict[str, Any]:
    """How the check ended, for a manifest: `checked`, or 'accepted' and in spite of what."""
    if not accepted:
        return {"check": checked}
    return {"check": "accepted", "accepted": [[each.code, each.text] for each in accepted]}
