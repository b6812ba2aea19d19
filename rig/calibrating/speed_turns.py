"""At how many exposures per column a live rig is looked at, pose by pose, so that the mirror is seen at several speeds.

A speed that the rig cannot do is left out. Where one does not show the line on the board, the pose is scanned again at
the slowest, before the board is moved; a speed that never showed the line where the slowest did is left out too.
"""

from collections.abc import Callable, Sequence

from rig.calibrating.capture import Capture
from rig.calibrating.showing import Tell
from rig.errors import PlanError

Scan = Callable[[int | None], Capture]
"""Takes a view at so many exposures per column; None: as the config says. PlanError where the rig cannot do that."""


class SpeedTurns:
    """Takes each view at the speed whose turn it is."""

    def __init__(self, exposures: Sequence[int], sees: Callable[[Capture], bool], tell: Tell | None = None) -> None:
        """exposures: per column, by turns; none: as the config says. sees: whether a capture has what it is for."""
        self.turns = list(exposures)
        self._sees = sees
        self._tell = tell
        self._shown: set[int] = set()

    def capture(self, pose: int, scan: Scan) -> Capture:
        """The view of a pose, the number of which says whose turn it is."""
        exposures, capture = self._in_turn(pose, scan)
        if exposures is None or capture.refused is not None:
            return capture
        if self._sees(capture):
            self._shown.add(exposures)
            return capture
        slowest = max(self.turns)
        return capture if exposures >= slowest else self._again(capture, exposures, slowest, scan)

    def _in_turn(self, pose: int, scan: Scan) -> tuple[int | None, Capture]:
        while True:
            exposures = self.turns[pose % len(self.turns)] if self.turns else None
            try:
                return exposures, scan(exposures)
            except PlanError:
                if exposures is None or len(self.turns) < 2:
                    raise
                self.turns.remove(exposures)

    def _again(self, capture: Capture, exposures: int, slowest: int, scan: Scan) -> Capture:
        """The same pose at the slowest speed; the first capture where the rig cannot do it."""
        self._say(f"at {_of(exposures)} the line does not stand out on the board: again at {slowest}")
        try:
            again = scan(slowest)
        except PlanError:
            self.turns.remove(slowest)
            return capture
        if self._sees(again):
            self._shown.add(slowest)
            if exposures not in self._shown:
                self.turns.remove(exposures)
                self._say(f"scans at {_of(exposures)} are left out from now on")
        return again

    def _say(self, what: str) -> None:
        if self._tell is not None:
            self._tell(what)


def _of(exposures: int) -> str:
    return f"{exposures} exposure{'s' if exposures > 1 else ''} per column"
