"""What a calibration gives back: verdict, figures, the model and where everything was written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.model.rig_model import RigModel
from calibration.verdict import Verdict

EXIT_NOT_TRUSTWORTHY = 1


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Of `rig calibrate camera`, `planes`, `sync` and `check`.

    line: the one that matters, as 'at 5 m: 8 mm, 6 of them from the baseline'. figures: for people, by name. summary:
    for programs. model: what was calibrated, or checked; None where only a camera is. folder, calibration: where they
    were written, None where they were not.
    """

    verdict: Verdict
    line: str
    figures: tuple[tuple[str, str], ...]
    summary: Mapping[str, Any]
    model: RigModel | None = None
    folder: Path | None = None
    calibration: Path | None = None

    @property
    def exit_code(self) -> int:
        """0 for a calibration to be used, 1 for one whose verdict failed."""
        return 0 if self.verdict.passed else EXIT_NOT_TRUSTWORTHY

    def rows(self) -> list[tuple[str, str]]:
        """Figures for people, by name."""
        return list(self.figures)

    def as_json(self) -> Mapping[str, Any]:
        """What summary.json holds."""
        return self.summary


def named(names: Sequence[str]) -> str:
    """How many, and which."""
    return f"{len(names)} ({', '.join(names)})" if names else "0"
