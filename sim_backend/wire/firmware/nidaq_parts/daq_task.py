"""Tasks of an emulated NI card: what a client configured, and how far the generation has got. Names, numbers and errors
are those of NI-DAQmx (docs/reference/hardware.md).
"""

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.nidaq_parts.daq_outputs import Edges

FINITE, CONTINUOUS = 10178, 10123
ON_DEMAND, SAMPLE_CLOCK, IMPLICIT = 10390, 10388, 10451
RISING, DIGITAL_EDGE, NO_TRIGGER = 10280, 10150, 10230
ALLOW_REGENERATION, FIRST_SAMPLE, CURRENT_POSITION = 10097, 10424, 10430
LOW, CHAN_PER_LINE = 10214, 0
"""Values of NI's enumerations (nidaqmx/constants.py)."""

RATE, SOURCE, EDGE, MODE, SAMPLES, TIMING = 0x1344, 0x1852, 0x1301, 0x1300, 0x1310, 0x1347
REGENERATION, RELATIVE_TO, OFFSET = 0x1453, 0x190C, 0x190D
TRIGGER, TRIGGER_SOURCE, TRIGGER_EDGE = 0x1393, 0x1407, 0x1404
AO_MAX, AO_MIN, ONBOARD_ONLY = 0x1186, 0x1187, 0x183A
IDLE, DELAY_TICKS, LOW_TICKS, HIGH_TICKS, TICK_SOURCE = 0x1170, 0x298, 0x1171, 0x1169, 0x339
"""Numbers of NI's attributes that clients set."""

TIMEBASE_HZ: Final = 100_000_000
AO_RATES_HZ: Final = (TIMEBASE_HZ / 35, 2.0e6, TIMEBASE_HZ / 65, 1.25e6)
"""Highest update rates with 1, 2, 3 and 4 channels."""
DO_RATE_HZ: Final = 10.0e6
FIFO: Final = {"ao": 8191, "do": 2047}
"""Samples in the card's memory, for all channels of a task together (tests of nidaqmx-python name 8191)."""
PORT_LINES: Final = (32, 8, 8)
COUNTERS: Final = 4
AO_CHANNELS: Final = 4
CODES: Final = 32767
"""Steps of the 16-bit converter from 0 to full scale."""
RANGES_V: Final = (5.0, 10.0)
UNVERIFIED, VERIFIED, RESERVED, COMMITTED, RUNNING = range(5)

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
    -200295: "Samples cannot be written after start when only onboard memory is used.",
    -200341: "Onboard device memory is too small for the buffer.",
    -200430: "I/O type of the physical channel does not match that of the channel to be created.",
    -200452: "Specified property is not supported by the device or is not applicable to the task.",
    -200459: "Write failed, because there are no output channels in this task.",
    -200462: "Generation cannot be started, because the output buffer is empty.",
    -200478: "Specified operation cannot be performed when there are no channels in the task.",
    -200479: "Specified operation cannot be performed while the task is running.",
    -200489: "Specified channel cannot be added to the task, because it is already in it.",
    -200524: "Write cannot be performed, because the data does not match the channels in the task.",
    -200525: "Read cannot be performed, because its type does not match the channels in the task.",
    -200526: "Write cannot be performed, because its type does not match the channels in the task.",
    -200547: "A single sample cannot be written to a buffer whose size was configured automatically.",
    -200557: "Specified property cannot be set while the task is running.",
    -200559: "Task cannot contain channels of different I/O types.",
    -200560: "Wait Until Done did not indicate that the task was done within the specified timeout.",
    -200561: "Attempted writing analog data that is too large or too small.",
    -200587: "Digital lines are reserved or unavailable.",
    -200609: "Generation cannot be started, because the selected buffer size is too small.",
    -200656: "Regeneration must be allowed when only onboard memory is used.",
    -200846: "Write cannot be performed when auto start is false and the task is not running.",
    -200963: "Requested Sample Timing Type is not allowed, because another task of the device has a different one.",
    -201062: "Buffered operations are not supported on the selected lines.",
}
"""The errors that this card knows, in few words."""


class DaqmxError(Exception):
    """A refusal by the driver: its number, a text with the details, and the samples that a write had taken before."""

    def __init__(self, code: int, detail: str = "", written: int | None = None) -> None:
        super().__init__(f"{ERRORS[code]} {detail}".strip())
        self.code, self.written = code, written


class SessionError(Exception):
    """A refusal by the server itself: the name of a gRPC status, and a text."""

    def __init__(self, status: str, text: str) -> None:
        super().__init__(text)
        self.status = status


def expand(text: str) -> list[str]:
    """The names in a list such as `Dev1/ao0:1, Dev1/ao3`."""
    names: list[str] = []
    for one in filter(None, (part.strip() for part in text.split(","))):
        found = re.fullmatch(r"(.*?)(\d+):(\d+)", one)
        if found is None:
            names.append(one)
        else:
            first, last = int(found[2]), int(found[3])
            step = 1 if last >= first else -1
            names += [f"{found[1]}{number}" for number in range(first, last + step, step)]
    return names


@dataclass(eq=False)
class Channel:
    """A virtual channel. outputs: the card's outputs that it drives, such as `ao0` or `port0/line3`."""

    name: str
    outputs: list[str]
    attributes: dict[int, Any]

    @property
    def shifts(self) -> list[int]:
        """Bits of its lines in an integer: by number, and port after port in the order of the lines."""
        ports = list(dict.fromkeys(one.partition("/")[0] for one in self.outputs))
        places = {port: sum(PORT_LINES[int(before[4:])] for before in ports[:at]) for at, port in enumerate(ports)}
        parts = [one.partition("/line") for one in self.outputs]
        return [places[port] + int(line) for port, _, line in parts]

    @property
    def dac_range_v(self) -> float:
        """Range of the converter for the limits that the client gave."""
        needed = max(abs(self.attributes[AO_MIN]), abs(self.attributes[AO_MAX]))
        return next(one for one in (*RANGES_V, needed) if one >= needed)


@dataclass(eq=False)
class Task:
    """A task, its data, and its generation. Times are the transport's; samples are counted from the start on."""

    name: str
    kind: str = ""
    """ao, do, co or ai, as soon as there is a channel."""
    channels: list[Channel] = field(default_factory=list)
    timing: dict[int, Any] = field(
        default_factory=lambda: {
            RATE: 1000.0,
            SOURCE: "",
            EDGE: RISING,
            MODE: FINITE,
            SAMPLES: 1000,
            TIMING: ON_DEMAND,
        }
    )
    trigger: dict[int, Any] = field(
        default_factory=lambda: {TRIGGER: NO_TRIGGER, TRIGGER_SOURCE: "", TRIGGER_EDGE: RISING}
    )
    writing: dict[int, Any] = field(
        default_factory=lambda: {REGENERATION: ALLOW_REGENERATION, RELATIVE_TO: CURRENT_POSITION, OFFSET: 0}
    )
    size: int | None = None
    """Buffer size that the client configured; None: that of the first write."""
    state: int = UNVERIFIED
    before: int = UNVERIFIED
    """State to which a stop returns."""
    buffer: NDArray[Any] | None = None
    """(outputs, size): what is regenerated."""
    chunks: deque[tuple[int, NDArray[Any]]] = field(default_factory=deque)
    """(number of the first sample, (outputs, n)): what is generated once."""
    first_size: int = 0
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
    def outputs(self) -> list[str]:
        """All outputs, in the order of the channels."""
        return [output for channel in self.channels for output in channel.outputs]

    @property
    def buffered(self) -> bool:
        """Whether a clock takes samples out of a buffer."""
        return self.kind in ("ao", "do") and self.timing[TIMING] == SAMPLE_CLOCK

    @property
    def regenerates(self) -> bool:
        """Whether the buffer's content is repeated."""
        return bool(self.writing[REGENERATION] == ALLOW_REGENERATION)

    @property
    def onboard_only(self) -> bool:
        """Whether samples are repeated by the card's memory."""
        return any(channel.attributes.get(ONBOARD_ONLY) for channel in self.channels)

    @property
    def fifo(self) -> int:
        """Samples per channel that the card's memory takes ahead of their time."""
        return FIFO[self.kind] // (len(self.channels) if self.kind == "ao" else 1)

    @property
    def buffer_size(self) -> int:
        """Samples per channel in the buffer."""
        return self.first_size if self.size is None else self.size

    @property
    def limit(self) -> float:
        """Samples, or pulses of a counter, to generate."""
        if self.timing[TIMING] == ON_DEMAND:
            return 1
        return np.inf if self.timing[MODE] == CONTINUOUS else float(self.timing[SAMPLES])

    @property
    def terminal(self) -> str:
        """Terminal of its clock, which other tasks can use."""
        return f"{self.outputs[0].capitalize()}InternalOutput" if self.kind == "co" else f"{self.kind}/SampleClock"

    @property
    def resources(self) -> set[str]:
        """Parts of the card that no other task may have at the same time."""
        return set(self.outputs) | ({f"{self.kind} timing engine"} if self.buffered else set())

    @property
    def pulses(self) -> tuple[int, int, int]:
        """Delay, high and low ticks of a counter."""
        attributes = self.channels[0].attributes
        return attributes[DELAY_TICKS], attributes[HIGH_TICKS], attributes[LOW_TICKS]

    def generated(self, now_s: float) -> int:
        """Samples that have come out by now."""
        if self.edges is None:
            return self.played
        most = self.limit if self.regenerates else min(self.limit, self.written)
        return int(min(self.played + self.edges.count(now_s), most))

    def ends_s(self) -> float:
        """Time at which the generation ends by itself: its last sample has come out, or none is left."""
        if self.edges is None:
            return np.inf
        if self.kind == "co":
            delay, high, low = self.pulses
            return self.edges.at(delay + self.limit * (high + low))
        if not self.regenerates and self.written < self.limit:
            return self.edges.at(self.written - self.played)
        return self.edges.at(self.limit - self.played - 0.5)
