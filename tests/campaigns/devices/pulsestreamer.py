"""A Pulse Streamer under random faults on its network, in the host's time: `syncs` says what is right.

Bits do not flip and answers do not merge: TCP carries checksums, and each call has a connection of its own. All else
strikes. A question may be heard long after the driver has given it up; some boxes keep their sequence in spite of
`constant`. Scan markers come all the time.
"""

import base64
import random
import struct

from drivers.clock import SystemClock
from tests.campaigns.devices.syncs import Subject
from tests.wire.emulated_syncs import PulseBox
from tests.wire.faults import Fault, FaultSchedule

KINDS = tuple(kind for kind in Fault if kind not in (Fault.CORRUPTED, Fault.MERGED))
CALL_S = 0.15
DEADLINE_S = 20.0
"""Far beyond every wait once: a machine may be busy with much else."""
MARKER_S, HIGH_S = 0.014, 0.012
"""Period of the scan markers, longer than a sweep may last, and what they are high of it."""


def _high(from_s: float, until_s: float) -> float | None:
    phase_s = from_s % MARKER_S
    first_s = from_s if phase_s < HIGH_S else from_s - phase_s + MARKER_S
    return first_s if first_s < until_s else None


def _low(from_s: float, until_s: float) -> float | None:
    return _high(from_s - HIGH_S, until_s - HIGH_S)


def _bench(faults: FaultSchedule, rng: random.Random) -> PulseBox:
    box = PulseBox(faults, clock=SystemClock(), keeps_sequence=rng.random() < 0.5)
    if rng.random() < 0.3:  # left running by a dead host
        box.model.call("setTrigger", [rng.choice((0, 2)), 0], box.now_s)
        steps = base64.b64encode(struct.pack(">IBhhIBhh", 5 * 10**6, 2, 0, 0, 10**6, 0, 0, 0)).decode()
        box.model.call("stream", [steps, rng.choice((1, -1)), [0, 2, 0, 0]], box.now_s)
    return box


PULSESTREAMER = Subject(
    _bench, CALL_S, DEADLINE_S, late_s=0.25, stall_s=0.3, kinds=KINDS, waits=True,
    interrupts=True,
)  # fmt: skip
