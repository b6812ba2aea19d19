"""The blanking pattern: flashes in each sweep's run-in, by which frames without markers are bound to columns.

The sync source waits for the scan marker and then opens the gate in a known order of flashes, before it opens it for
the lit part. The mirror moves at constant velocity by then, a few columns before the first one. Where the pattern lies
among the frames says when the scan marker came; from one sweep's to the next one's is the ratio of scanner and SPAD.

A chip is no whole number of frames: the edges of the flashes then fall on all parts of a frame, so that their place is
known to a small part of one whatever the phase of the two clocks.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

CODE = "101011101100011111001101001"
"""Chips, 1 = gate open: the maximum-length sequence of x^5 + x^2 + 1 without its run of zeros. Shifted against itself,
or against its reverse, it correlates to at most 0.36; it has 16 edges."""
MAX_CLOCK_ERROR = 1e-3
"""Clock ratios further from nominal than this are a fault, not a crystal."""
CHIPS_PER_COLUMN = 5
"""A chip is about this part of a column long: the longer, the fewer photons it takes to find it."""
MOST_CHIP_FRAMES = 8
VERNIER_FRAMES = 0.382
"""Added to whole frames (one minus the golden ratio, whose multiples spread most evenly)."""
MARGIN_FRAMES = 2.0
"""Dark frames kept before the pattern, and behind the last one that belongs to its search."""


@dataclass(frozen=True, slots=True)
class Blanking:
    """The pattern of a plan. guard_s: dark time between pattern and lit part; tolerance_s: how far off it may lie."""

    chip_s: float
    guard_s: float
    tolerance_s: float

    @property
    def length_s(self) -> float:
        """Seconds from the first edge to the last."""
        return len(CODE) * self.chip_s

    @property
    def lead_s(self) -> float:
        """Seconds of run-in that it takes before the gate opens for the lit part."""
        return self.length_s + self.guard_s

    def flashes_s(self, leg: int) -> tuple[tuple[float, float], ...]:
        """(open, close) of each flash from the pattern's first edge; the way back has the code backward."""
        code = CODE[::-1] if leg % 2 else CODE
        edges = [i for i in range(len(code) + 1) if (code[i - 1 : i] or "0") != (code[i : i + 1] or "0")]
        return tuple((a * self.chip_s, b * self.chip_s) for a, b in zip(edges[::2], edges[1::2], strict=True))


def blanking_for(columns: int, exposures: int, frame_rate_hz: Fraction) -> Blanking:
    """The pattern for a scan, whose clocks may differ by up to `MAX_CLOCK_ERROR`."""
    frame_s = 1 / float(frame_rate_hz)
    chip = min(max(1, round(exposures / CHIPS_PER_COLUMN)), MOST_CHIP_FRAMES) + VERNIER_FRAMES
    # From one pattern to the next; sweeps are rarely longer than twice their lit part.
    tolerance = MARGIN_FRAMES + math.ceil(MAX_CLOCK_ERROR * 2 * columns * exposures)
    return Blanking(chip * frame_s, (tolerance + 2 * MARGIN_FRAMES) * frame_s, tolerance * frame_s)
