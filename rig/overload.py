"""What becomes of frames that come faster than they can be worked on: the user's policy, and the ring it asks for."""

from enum import StrEnum

from drivers.interfaces import SpadInfo, SpadTiming
from drivers.ring import BlockRing, OnFull
from rig.errors import UsageError
from rig.scan_plan import ScanPlan

RING_BYTES = 512 * 2**20
"""Ring of a source that cannot wait: 0.16 s of full frames at 100 kHz, more than any pause of the interpreter."""
FEWEST_SLOTS = 8
"""Also the slots for a source that can wait: it runs ahead by as many blocks."""
MOST_SLOTS = 1024


class Overload(StrEnum):
    """What to do with blocks for which the ring has no room (`--on-overload`)."""

    ABORT = "abort"
    """Lose nothing: a source that can wait waits, one that cannot ends the run."""
    DROP = "drop"
    """Drop them, count them as lost and go on, also where the source could wait."""
    BLOCK = "block"
    """Let the source wait; refused where it cannot."""

    @classmethod
    def parse(cls, text: str) -> "Overload":
        """The policy of that name. Raises UsageError for anything else."""
        try:
            return cls(text)
        except ValueError:
            raise UsageError(f"--on-overload is {text!r}; write 'abort', 'drop' or 'block'") from None


def require_policy(policy: Overload, info: SpadInfo) -> None:
    """UsageError where the policy asks a source to wait that cannot."""
    if policy is Overload.BLOCK and not info.can_wait:
        raise UsageError(
            f"--on-overload is 'block', but the {info.model} SPAD cannot wait while it exposes; "
            "choose 'abort' to lose no frame or 'drop' to go on without those lost"
        )


def ring_for(
    policy: Overload, info: SpadInfo, plan: ScanPlan, timing: SpadTiming, *, keeps_time: bool = False
) -> BlockRing:
    """The ring between this SPAD and its readers, allocated and touched.

    keeps_time: the SPAD can wait, but should have no need to.
    """
    few = info.can_wait and not keeps_time
    slots = FEWEST_SLOTS if few else min(max(RING_BYTES // timing.stride, FEWEST_SLOTS), MOST_SLOTS)
    waits = OnFull.WAIT if info.can_wait else OnFull.FAIL
    on_full = OnFull.DROP if policy is Overload.DROP else waits
    frames = slots * (timing.stride // plan.frame_bytes)
    return BlockRing(slots, timing.stride, on_full=on_full, holds_s=frames / float(plan.frame_rate_hz))
