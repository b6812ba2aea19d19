"""An emulated X Series card: its outputs and terminals, and tasks that start, share clocks and triggers, and stop."""

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from sim_backend.wire.firmware.helios import KEEP_S
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import EARLY, Edges, Output, Pulses, Span
from sim_backend.wire.firmware.nidaq_parts.daq_task import (
    AO_CHANNELS,
    AO_MAX,
    AO_MIN,
    AO_RATES_HZ,
    COMMITTED,
    CONTINUOUS,
    COUNTERS,
    DELAY_TICKS,
    DIGITAL_EDGE,
    DO_RATE_HZ,
    FINITE,
    HIGH_TICKS,
    IDLE,
    LOW,
    LOW_TICKS,
    MODE,
    ON_DEMAND,
    PORT_LINES,
    RANGES_V,
    RATE,
    RESERVED,
    RUNNING,
    SAMPLE_CLOCK,
    SAMPLES,
    SOURCE,
    TICK_SOURCE,
    TIMEBASE_HZ,
    TIMING,
    TRIGGER,
    TRIGGER_SOURCE,
    VERIFIED,
    DaqmxError,
    Task,
    expand,
)

START_DELAY_TICKS: Final = 2
"""Ticks of the timebase between a start trigger and the first edge of the sample clock (X Series User Manual, 5-9)."""
_TIMEBASES_HZ: Final = {"100MHzTimebase": 1e8, "20MHzTimebase": 2e7, "100kHzTimebase": 1e5}
PINS: Final = [f"PFI{n}" for n in range(16)] + [f"RTSI{n}" for n in range(8)]
_COUNTER_OUTPUTS: Final = [f"Ctr{n}InternalOutput" for n in range(COUNTERS)]
_CLOCKS: Final = [f"{part}/SampleClock" for part in ("ai", "ao", "di", "do")]
_TRIGGERS: Final = [f"{part}/StartTrigger" for part in ("ai", "ao", "di", "do")]
TERMINALS: Final = (*PINS, *_COUNTER_OUTPUTS, *_CLOCKS, *_TRIGGERS, *_TIMEBASES_HZ)


class Card:
    """The card and its tasks. `outputs` has what every output did and will do, in V and in levels 0 and 1."""

    def __init__(self, name: str, serial: int, clock_error: float) -> None:
        """clock_error: of the crystal, relative."""
        self.name, self.serial = name, serial
        lines = [f"port{port}/line{line}" for port, count in enumerate(PORT_LINES) for line in range(count)]
        names = [f"ao{n}" for n in range(AO_CHANNELS)] + lines + [f"ctr{n}" for n in range(COUNTERS)]
        self.outputs = {one: Output() for one in names}
        self.tasks: dict[str, Task] = {}
        self._tick_s = 1 / TIMEBASE_HZ / (1 + clock_error)

    def advance(self, now_s: float) -> None:
        """Let everything end that ends by itself until now, in order."""
        while True:
            task = min(self.tasks.values(), key=Task.ends_s, default=None)
            if task is None or (ends_s := task.ends_s()) > now_s:
                break
            if task.kind != "co" and not task.regenerates and task.written < task.limit:
                task.error = DaqmxError(-200290, f"Task Name: {task.name}")
            self._pause(task, ends_s)
            task.done = True
        for output in self.outputs.values():
            output.forget(now_s - KEEP_S)
        for task in self.tasks.values():
            generated = task.generated(now_s)
            while task.chunks and task.chunks[0][0] + task.chunks[0][1].shape[1] <= generated:
                task.chunks.popleft()

    def pulse(self, terminal: str, now_s: float) -> None:
        """Send a rising edge to a terminal from outside: tasks that wait for it as their start trigger start."""
        self.advance(now_s)
        self._fire(self.terminal(terminal), now_s)

    # Names and rates

    def terminal(self, text: str, code: int = -89120) -> str:
        """A terminal without the name of the card, as in `TERMINALS`. code: error if there is none."""
        local = text.removeprefix("/").removeprefix(f"{self.name}/")
        for known in TERMINALS:
            if known.lower() == local.lower():
                return known
        raise DaqmxError(code, f"Terminal: {text}")

    def source(self, task: Task) -> str:
        """Terminal of the clock that a task counts; "" is the card's own clock."""
        text = task.channels[0].attributes[TICK_SOURCE] if task.kind == "co" else task.timing[SOURCE]
        if text.lower() in ("", "onboardclock", f"/{self.name}/{task.kind}/SampleClockTimebase".lower()):
            return ""
        known = self.terminal(text)
        allowed = [*PINS, *_COUNTER_OUTPUTS, *_CLOCKS, *(_TIMEBASES_HZ if task.kind == "co" else ())]
        if known not in allowed or known == task.terminal:
            raise DaqmxError(-89136, f"Source: /{self.name}/{known}. Destination: /{self.name}/{task.terminal}")
        return known

    def physical(self, text: str, kind: str) -> list[str]:
        """The outputs in a list of physical channels of a kind: ao, port or ctr."""
        found: list[str] = []
        for one in expand(text):
            device, _, local = one.removeprefix("/").partition("/")
            self.check_device(device)
            local = local.lower()
            if local not in self.outputs and f"{local}/line0" not in self.outputs:
                input_channel = re.fullmatch(r"ai([12]?\d|3[01])", local)
                raise DaqmxError(-200430 if input_channel else -200170, f"Physical Channel: {one}")
            if not local.startswith(kind):
                raise DaqmxError(-200430, f"Physical Channel: {one}")
            found += [output for output in self.outputs if output.startswith(f"{local}/")] or [local]
        if not found:
            raise DaqmxError(-200170, "No physical channel is given.")
        return found

    def check_device(self, name: str) -> None:
        """Refuse a device that does not exist."""
        if name.lower() != self.name.lower():
            raise DaqmxError(-200220, f"Device: {name}")

    def rate_hz(self, task: Task) -> float:
        """The rate of a task's sample clock as the driver computes it, which takes the crystal for exact."""
        asked: float = task.timing[RATE]
        return asked if self.source(task) else TIMEBASE_HZ / round(TIMEBASE_HZ / asked)

    def highest_rate_hz(self, task: Task) -> float:
        """Highest rate of a task's sample clock."""
        return AO_RATES_HZ[len(task.channels) - 1] if task.kind == "ao" else DO_RATE_HZ

    # States

    def configure(
        self, task: Task, group: dict[int, Any] | None = None, values: Mapping[int, Any] | None = None
    ) -> None:
        """Set properties in one of a task's groups."""
        if task.state == RUNNING:
            raise DaqmxError(-200557, f"Task Name: {task.name}")
        if group is not None:
            group.update(values or {})

    def verify(self, task: Task) -> None:
        """Check what a client configured."""
        if not task.channels:
            raise DaqmxError(-200478, f"Task Name: {task.name}")
        for channel in task.channels:
            values = channel.attributes
            if task.kind == "ao" and not -RANGES_V[-1] <= values[AO_MIN] < values[AO_MAX] <= RANGES_V[-1]:
                detail = f"Property: AO.Max, AO.Min. Requested Value: {values[AO_MAX]}, {values[AO_MIN]}"
                raise DaqmxError(-200077, f"{detail}. Maximum Value: {RANGES_V[-1]}. Channel Name: {channel.name}")
            if task.kind == "co" and (min(values[HIGH_TICKS], values[LOW_TICKS]) < 1 or values[DELAY_TICKS] < 0):
                raise DaqmxError(-200077, f"Property: CO.Pulse.HighTicks, LowTicks. Channel Name: {channel.name}")
        if task.kind == "co" and task.timing[TIMING] == SAMPLE_CLOCK:
            raise DaqmxError(-200452, "Property: SampTimingType. Requested Value: Sample Clock")
        if task.buffered:
            self._verify_clock(task)
        self.source(task)
        if task.trigger[TRIGGER] == DIGITAL_EDGE:
            if task.timing[TIMING] == ON_DEMAND and task.kind != "co":
                raise DaqmxError(-200262, f"Task Name: {task.name}")
            self._trigger(task)
        task.state = max(task.state, VERIFIED)

    def _verify_clock(self, task: Task) -> None:
        if task.kind == "do" and not all(one.startswith("port0/") for one in task.outputs):
            raise DaqmxError(-201062, f"Task Name: {task.name}")
        rate_hz, highest_hz = task.timing[RATE], self.highest_rate_hz(task)
        if not TIMEBASE_HZ / 2**32 <= rate_hz <= highest_hz * (1 + 1e-9):
            detail = f"Property: SampClk.Rate. Requested Value: {rate_hz}. Maximum Value: {highest_hz}"
            raise DaqmxError(-200077, f"{detail}. Task Name: {task.name}")
        if task.timing[MODE] not in (FINITE, CONTINUOUS) or (task.timing[MODE] == FINITE and task.timing[SAMPLES] < 2):
            detail = f"Property: SampQuant.SampMode, SampPerChan. Requested Value: {task.timing[SAMPLES]}"
            raise DaqmxError(-200077, f"{detail}. Minimum Value: 2. Task Name: {task.name}")

    def _trigger(self, task: Task) -> str:
        """Terminal of a task's start trigger."""
        known = self.terminal(task.trigger[TRIGGER_SOURCE])
        if known not in [*PINS, *_TRIGGERS, *_COUNTER_OUTPUTS] or known == f"{task.kind}/StartTrigger":
            raise DaqmxError(-89136, f"Source: /{self.name}/{known}. Destination: start trigger of {task.name}")
        return known

    def lead_to(self, task: Task, state: int) -> None:
        """Bring a task to a state up to committed."""
        self.verify(task)
        for other in self.tasks.values() if state >= RESERVED > task.state else ():
            taken = task.resources & other.resources if other.state >= RESERVED else set()
            if taken:
                code = -200587 if all(one.startswith("port") for one in taken) else -50103
                raise DaqmxError(code, f"Resource: {min(taken)} of task {other.name}. Task Name: {task.name}")
            if task.kind == other.kind == "ao" and other.state >= RESERVED and task.buffered != other.buffered:
                raise DaqmxError(-200963, f"Other task: {other.name}. Task Name: {task.name}")
        task.state = max(task.state, state)

    def start(self, task: Task, now_s: float, before: int) -> None:
        """Start a task, unless it runs. before: the state to which a stop brings it back."""
        if task.state == RUNNING:
            return
        self.lead_to(task, COMMITTED)
        if task.buffered:
            self._check_data(task)
        task.before, task.state = before, RUNNING
        task.error, task.played, task.edges = None, 0, None
        task.done = not task.buffered and task.kind != "co"
        task.waiting = task.trigger[TRIGGER] == DIGITAL_EDGE
        if not task.waiting:
            self._triggered(task, now_s)

    def _check_data(self, task: Task) -> None:
        if task.size is not None and task.size < 2:
            raise DaqmxError(-200609, f"Task Name: {task.name}")
        if task.buffer is None and not task.chunks:
            raise DaqmxError(-200462, f"Task Name: {task.name}")
        if task.onboard_only and not task.regenerates:
            raise DaqmxError(-200656, f"Task Name: {task.name}")
        if task.onboard_only and task.buffer_size > task.fifo:
            raise DaqmxError(-200341, f"Samples: {task.buffer_size}. Maximum Value: {task.fifo}")

    def stop(self, task: Task, now_s: float, state: int = RUNNING) -> None:
        """Stop a task, if it runs, and bring it back to the state before its start, or to `state` if that is lower."""
        if task.state == RUNNING:
            self._pause(task, now_s)
            task.state, task.waiting = task.before, False
            task.played = task.written = 0
            task.chunks.clear()
        task.state = min(task.state, state)
        if task.state < RESERVED:
            task.buffer, task.first_size = None, 0

    # Clocks

    def _triggered(self, task: Task, at_s: float) -> None:
        task.waiting = False
        if task.kind != "co":
            self._fire(f"{task.kind}/StartTrigger", at_s)
        self._open(task, at_s)

    def _fire(self, terminal: str, at_s: float) -> None:
        for other in self.tasks.values():
            if other.state == RUNNING and other.waiting and self._trigger(other) == terminal:
                self._triggered(other, at_s)

    def _open(self, task: Task, at_s: float) -> None:
        """Begin to generate, if the task's clock runs, and let others begin that use the task's clock."""
        source = self.source(task)
        if source or task.kind == "co":
            clock = self._clock(source or "100MHzTimebase")
            task.edges = None if clock is None else clock.from_(at_s)
        elif task.buffered:
            period_s = round(TIMEBASE_HZ / task.timing[RATE]) * self._tick_s
            task.edges = Edges(at_s + START_DELAY_TICKS * self._tick_s, period_s)
        if task.edges is None:
            return
        self.lay(task, task.played)
        for other in self.tasks.values():
            idle = other.state == RUNNING and not other.waiting and not other.done and other.edges is None
            if idle and self.source(other) == task.terminal:
                self._open(other, at_s)

    def _pause(self, task: Task, at_s: float) -> None:
        """Generate no more from a time on, since the clock stops. The outputs hold, and others that use it stop too."""
        if task.edges is None:
            return
        task.played = task.generated(at_s - 2 * EARLY * task.edges.period_s)
        task.edges = None
        for output in task.outputs:
            self.outputs[output].cut(at_s)
        for other in self.tasks.values():
            if other.edges is not None and self.source(other) == task.terminal:
                self._pause(other, at_s)

    def _clock(self, terminal: str) -> Edges | None:
        """Edges at a terminal, if a clock runs there."""
        if terminal in _TIMEBASES_HZ:
            return Edges(0.0, TIMEBASE_HZ / _TIMEBASES_HZ[terminal] * self._tick_s)
        for task in self.tasks.values():
            if task.edges is not None and task.terminal == terminal:
                if task.kind != "co":
                    return task.edges
                delay, high, low = task.pulses
                return Edges(task.edges.at(delay), (high + low) * task.edges.period_s)
        return None

    def lay(self, task: Task, sample: int) -> None:
        """Give the outputs of a task with a clock its samples from a number on, in place of what was to come there."""
        assert task.edges is not None, "asked for by the caller"
        if task.kind == "co":
            for channel in task.channels:
                delay, high, low = (channel.attributes[one] for one in (DELAY_TICKS, HIGH_TICKS, LOW_TICKS))
                ticks = delay + task.limit * (high + low)
                inverted = channel.attributes[IDLE] != LOW
                span = Pulses(task.edges, ticks, np.zeros(1), delay=delay, high=high, low=low, inverted=inverted)
                self.outputs[channel.outputs[0]].play(span)
            return
        repeated = task.buffer is not None
        for begin, rows in [(sample, task.buffer)] if task.buffer is not None else list(task.chunks):
            size, skipped = rows.shape[1], max(0, sample - begin)
            count = min(task.limit, np.inf if repeated else begin + size) - begin - skipped
            if count > 0:
                at = Edges(task.edges.at(begin + skipped - task.played), task.edges.period_s)
                for output, row in zip(task.outputs, rows, strict=True):
                    self.outputs[output].play(Span(at, count, row, begin % size if repeated else skipped))
