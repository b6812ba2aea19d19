"""Tasks of an emulated NI card: what a client configured, and how far the generation has got. Numbers and errors are
those of NI-DAQmx (docs/reference/devices/nidaq.md).
"""

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.nidaq_parts.daq_outputs import Edges

CONTINUOUS, ALLOW_REGENERATION = 10123, 10097
"""Values of NI's enumerations (nidaqmx/constants.py)."""
TIMEBASE_HZ: Final = 100_000_000
RATE_HZ: Final = {"ao": TIMEBASE_HZ / 35, "do": 10.0e6}
"""Highest rates of one channel."""
FIFO: Final = {"ao": 8191, "do": 2047}
"""Samples in the card's memory (tests of nidaqmx-python name 8191)."""
LINES, COUNTERS, AO_CHANNELS = 32, 4, 4
CODES: Final = 32767
"""Steps of the 16-bit converter from 0 to full scale."""
RANGES_V: Final = (5.0, 10.0)
UNVERIFIED, VERIFIED, COMMITTED, RUNNING = range(4)

ERRORS: Final = {
    -50103: "The specified resource is reserved. The operation could not be completed as specified.",
    -88709: "The specified operation cannot be performed because a task has been aborted or a device has been reset.",
    -89120: "Source terminal to be routed could not be found on the device.",
    -89121: "Destination terminal to be routed could not be found on the device.",
    -89136: "Specified route cannot be satisfied, because the hardware does not support it.",
    -200077: "Requested value is not a supported value for this property.",
    -200082: "Minimum is greater than or equal to the maximum.",
    -200088: "Task specified is invalid or does not exist.",
    -200170: "Physical channel specified does not exist on this device.",
    -200197: "Specified property is not supported by the device.",
    -200220: "Device identifier is invalid.",
    -200262: "Trigger cannot be used when sample timing type is On Demand.",
    -200290: "The generation has stopped to prevent the regeneration of old samples.",
    -200292: "Some or all of the samples to write could not be written to the buffer yet.",
    -200293: "There is no more space in the buffer when new data was written before the start.",
    -200430: "I/O type of the physical channel does not match that of the channel to be created.",
    -200452: "Specified property is not supported by the device or is not applicable to the task.",
    -200462: "Generation cannot be started, because the output buffer is empty.",
    -200478: "Specified operation cannot be performed when there are no channels in the task.",
    -200489: "Specified channel cannot be added to the task, because it is already in it.",
    -200524: "Write cannot be performed, because the data does not match the channels in the task.",
    -200526: "Write cannot be performed, because its type does not match the channels in the task.",
    -200547: "A single sample cannot be written to a buffer whose size was configured automatically.",
    -200557: "Specified property cannot be set while the task is running.",
    -200559: "Task cannot contain channels of different I/O types.",
    -200561: "Attempted writing analog data that is too large or too small.",
    -200587: "Digital lines are reserved or unavailable.",
    -200609: "Generation cannot be started, because the selected buffer size is too small.",
    -200846: "Write cannot be performed when auto start is false and the task is not running.",
    -200963: "Requested Sample Timing Type is not allowed, because another task of the device has a different one.",
}
"""The errors that this card knows, in few words."""


class DaqmxError(Exception):
    """A refusal by the driver: its number, a text with the details, and the samples that a write had taken before."""

    def __init__(self, code: int, detail: str = "", written: int = 0) -> None:
        super().__init__(f"{ERRORS[code]} {detail}".strip())
        self.code, self.written = code, written


def expand(text: str) -> list[str]:
    """The names in a list such as `Dev1/ao0:1, Dev1/ao3`."""
    names: list[str] = []
    for one in filter(None, (part.strip() for part in text.split(","))):
        found = re.fullmatch(r"(.*?)(\d+):(\d+)", one)
        numbers = range(int(found[2]), int(found[3]) + 1) if found else ()
        names += [f"{found[1]}{number}" for number in numbers] if found else [one]
    return names


@dataclass(eq=False)
class DaqTask:
    """A task with one channel at most, its data and its generation. Samples are counted from the start on."""

    name: str
    kind: str = ""
    """ao, do, co or ai, as soon as there is a channel."""
    outputs: list[str] = field(default_factory=list)
    """Outputs that its channel drives, such as `ao0`, or port0/line0 to line2."""
    limits_v: tuple[float, float] = (0.0, 0.0)
    """Limits of an analogue output, as the client gave them."""
    clocked: bool = False
    """Whether a sample clock was configured, or a counter's number of pulses. Else samples are put out on demand, and a
    counter makes one pulse."""
    rate_hz: float = 1000.0
    source: str = ""
    continuous: bool = False
    samples: int = 1000
    trigger: str = ""
    """Terminal of the start trigger; "": none."""
    regeneration: int = ALLOW_REGENERATION
    size: int = 0
    """Samples per channel in the buffer, as the client configured it; 0: as many as the first write had."""
    pulse: tuple[int, int, int] = (0, 1, 1)
    """Delay, high and low ticks of a counter."""
    state: int = UNVERIFIED
    before: int = UNVERIFIED
    """State to which a stop returns."""
    buffer: NDArray[Any] | None = None
    """(outputs, size): what is regenerated."""
    chunks: deque[tuple[int, NDArray[Any]]] = field(default_factory=deque)
    """(number of the first sample, (outputs, n)): what is generated once."""
    own_size: bool = False
    """Whether the size is that of the first write."""
    written: int = 0
    error: DaqmxError | None = None
    """Reported by the calls that follow."""
    waiting: bool = False
    """Whether the start trigger is still to come."""
    done: bool = False
    edges: Edges | None = None
    """Edges of its clock; None while there are none."""
    played: int = 0
    """Samples generated before the first of these edges."""

    @property
    def full_v(self) -> float:
        """Range of the converter for these limits, in V; the larger limit if no range covers them."""
        needed = max(map(abs, self.limits_v))
        return next(one for one in (*RANGES_V, needed) if one >= needed)

    @property
    def buffered(self) -> bool:
        """Whether a clock takes samples out of a buffer."""
        return self.kind in ("ao", "do") and self.clocked

    @property
    def regenerates(self) -> bool:
        """Whether the buffer's content is repeated."""
        return self.regeneration == ALLOW_REGENERATION

    @property
    def limit(self) -> float:
        """Number of samples, or of pulses of a counter, to generate; infinite if the task is continuous."""
        return np.inf if self.continuous else self.samples if self.clocked else 1

    @property
    def terminal(self) -> str:
        """Terminal of its clock, which other tasks can use."""
        return f"{self.kind}/SampleClock"

    def generated(self, now_s: float) -> int:
        """Samples that have come out by now."""
        if self.edges is None:
            return self.played
        most = self.limit if self.regenerates else min(self.limit, self.written)
        return int(min(self.played + self.edges.count(now_s), most))

    def ends_s(self) -> float:
        """Time at which the generation ends by itself: after its last sample, or when a sample is due that the client
        has not written. Infinite if neither happens."""
        if self.edges is None:
            return np.inf
        if self.kind == "co":
            delay, high, low = self.pulse
            return self.edges.at(max(0, delay - 1) + self.limit * (high + low))
        if not self.regenerates and self.written < self.limit:
            return self.edges.at(self.written - self.played)
        return self.edges.at(self.limit - self.played - 0.5)
