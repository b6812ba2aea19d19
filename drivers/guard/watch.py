"""Decides whether an application that should be taking frames still does. Pure: fed with what was seen, and when.

A deadline on frames alone would either be too long for the laser or trip on a busy machine. So there are two: a short
one for an application that does nothing at all (all its threads asleep, or the process stopped), and a longer one for
one that is at work or waits for a processor or a disk, as its threads' states tell. Work is no excuse where the source
thread itself says that it has asked the SPAD in vain: then it is the SPAD that is silent.

The guard's own time counts in short steps only: what stops the guard as well (a suspended or overloaded machine) is no
silence of the application's.
"""

from collections.abc import Callable
from dataclasses import dataclass

TICK_S = 0.01
"""Time from one look to the next."""
MAX_STEP_S = 0.03
"""Most that one look adds to a silence, however late it comes."""


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """Longest times without a new frame number while the gate may open. Light is gone within 50 ms after them.

    The defaults suit a stream with several blocks in 10 ms. A burst, which is silent until it is read out, and blocks
    that take longer need more: three times what passes between two blocks.
    """

    frames_within_s: float = 0.05
    """By an application that sleeps, as two looks say: with their 20 ms and the gate's 30 ms, 100 ms in all."""
    busy_within_s: float = 1.5
    """By one that computes or waits for a processor or a disk. With four times more work than processors a thread that
    only sleeps 1 ms was seen to wake 0.2 s late, one that shares its interpreter 0.35 s, and disks stall for a second:
    none of that may end a scan. The light meanwhile is that of a moving mirror, since each sweep waits, with its gate
    low, for a scan marker. An application that is killed or stopped never gets this long."""
    waits_within_s: float = 0.04
    """By one at work whose source thread says that it has asked the SPAD for so long in vain."""
    first_wait_s: float = 0.3
    """The same before its first frame."""
    first_frame_s: float = 1.0
    """From `run` to the first one: SPAD, scanner and the scan marker come in between. An application at work gets
    `busy_within_s` on top, since devices that start and a machine with too much to do may come together."""


class FrameWatch:
    """Watches between `start` and `stop`."""

    def __init__(self, limits: GuardLimits) -> None:
        self.limits = limits
        self._watching = False
        self._begun = False
        self._last = 0
        self._silent_s = 0.0

    @property
    def watching(self) -> bool:
        """Whether frames are expected."""
        return self._watching

    @property
    def last(self) -> int:
        """The last frame number seen."""
        return self._last

    @property
    def quiet(self) -> bool:
        """Whether the next frame is later than it may be for an application that sleeps."""
        return self._watching and self._begun and self._silent_s > self.limits.frames_within_s

    def start(self, frame: int) -> None:
        """The gate may open from now on; `frame` is the last number told before."""
        self._last, self._begun, self._silent_s, self._watching = frame, False, 0.0, True

    def stop(self) -> None:
        """The gate is low."""
        self._watching = False

    def look(
        self, elapsed_s: float, frame: int, stopped: bool, busy: Callable[[], bool], waited_s: float = 0.0
    ) -> str | None:
        """What is wrong with the application, `elapsed_s` after the last look; None: nothing that is known.

        stopped: it is, while the laser may shine. busy: asked only in doubt, since it costs a look at every thread.
        waited_s: for how long the SPAD has been asked in vain, as the source thread says.
        """
        if stopped:
            return "is stopped"
        if not self._watching:
            return None
        if frame != self._last:
            self._last, self._begun, self._silent_s = frame, True, 0.0
            return None
        self._silent_s += min(elapsed_s, MAX_STEP_S)
        limits = self.limits
        in_vain = waited_s > (limits.waits_within_s if self._begun else limits.first_wait_s)
        patience_s = limits.frames_within_s if self._begun or in_vain else limits.first_frame_s
        if self._silent_s <= patience_s:
            return None
        if in_vain:
            return f"waited for the SPAD in vain for {self._silent_s * 1e3:.0f} ms after frame {frame}"
        excused_s = limits.busy_within_s if self._begun else limits.first_frame_s + limits.busy_within_s
        if self._silent_s <= excused_s and busy():
            return None
        return f"took no frame for {self._silent_s * 1e3:.0f} ms after frame {frame}"
