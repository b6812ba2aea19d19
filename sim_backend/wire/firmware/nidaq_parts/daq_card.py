"""An emulated X Series card: its outputs and terminals, and tasks that start, share clocks and triggers, and stop."""

import re
from typing import Any, Final

import numpy as np

from sim_backend.wire.firmware.helios import KEEP_S
from sim_backend.wire.firmware.nidaq_parts import daq_task as ni
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import EARLY, Edges, Output, Samples
from sim_backend.wire.firmware.nidaq_parts.daq_task import DaqmxError, DaqTask, expand

START_DELAY_TICKS: Final = 2
"""Ticks of the timebase between a start trigger and the first edge of the sample clock (X Series User Manual, 5-9)."""
_PINS: Final = tuple(f"PFI{n}" for n in range(16))
_CLOCKS: Final = tuple(f"{part}/SampleClock" for part in ("ai", "ao", "di", "do"))
_TRIGGERS: Final = tuple(f"{part}/StartTrigger" for part in ("ai", "ao", "di", "do"))


class Card:
    """The card and its tasks. `outputs` has what every output did in the last KEEP_S and will do: analogue ones in V,
    others as levels 0 and 1."""

    name: Final = "Dev1"

    def __init__(self, clock_error: float) -> None:
        """clock_error: relative error of the crystal, positive if it runs fast."""
        counts = {"ao": ni.AO_CHANNELS, "port0/line": ni.LINES, "ctr": ni.COUNTERS}
        self.outputs = {f"{kind}{n}": Output() for kind, count in counts.items() for n in range(count)}
        self.tasks: dict[str, DaqTask] = {}
        self._tick_s = 1 / ni.TIMEBASE_HZ / (1 + clock_error)
        self._outside: dict[str, Edges] = {}

    def advance(self, now_s: float) -> None:
        """End everything that ends by itself until now, in order of time, and forget what is older than `KEEP_S`."""
        while True:
            task = min(self.tasks.values(), key=DaqTask.ends_s, default=None)
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

    def trigger(self, terminal: str, now_s: float) -> None:
        """Send a rising edge to a terminal from outside: tasks that wait for it as their start trigger start."""
        self.advance(now_s)
        self._fire(terminal, now_s)

    def clock(self, terminal: str, period_s: float, now_s: float) -> None:
        """Connect a clock of another device to a terminal, from now on."""
        self.advance(now_s)
        self._outside[terminal] = Edges(now_s, period_s)
        self._follow(terminal, now_s)

    def reset(self, now_s: float) -> None:
        """Reset the device: abort all tasks. Analogue outputs go to 0 V, all others low."""
        for task in self.tasks.values():
            task.error = DaqmxError(-88709) if task.state == ni.RUNNING else task.error
            self.stop(task, now_s, ni.VERIFIED)
        for output in self.outputs.values():
            output.put(0.0, now_s)

    # Names and rates

    def terminal(self, text: str, code: int = -89120) -> str:
        """Name of a terminal without that of the card. Raises DaqmxError with `code` if there is no such terminal."""
        local = text.removeprefix("/").removeprefix(f"{self.name}/").lower()
        found = [known for known in (*_PINS, *_CLOCKS, *_TRIGGERS) if known.lower() == local]
        if not found:
            raise DaqmxError(code, f"Terminal: {text}")
        return found[0]

    def source(self, task: DaqTask) -> str:
        """Terminal of the clock that a task counts; "" is the card's own clock. Raises DaqmxError for one that it
        cannot count."""
        if task.source.lower() in ("", "onboardclock"):
            return ""
        known = self.terminal(task.source)
        if known not in _PINS + _CLOCKS or known == task.terminal:
            raise DaqmxError(-89136, f"Source: /{self.name}/{known}. Destination: /{self.name}/{task.terminal}")
        return known

    def physical(self, text: str, kind: str) -> list[str]:
        """The outputs in a list of physical channels of a kind: ao, port or ctr. Raises DaqmxError for others."""
        found: list[str] = []
        for one in expand(text):
            device, _, local = one.removeprefix("/").lower().partition("/")
            self.check_device(device)
            known = [output for output in self.outputs if output == local or output.startswith(f"{local}/")]
            if not known or not local.startswith(kind):
                code = -200430 if known or re.fullmatch(r"ai([12]?\d|3[01])", local) else -200170
                raise DaqmxError(code, f"Physical Channel: {one}")
            found += known
        if not found:
            raise DaqmxError(-200170, "No physical channel is given.")
        return found

    def check_device(self, name: str) -> None:
        """Raise DaqmxError for a device that does not exist."""
        if name.lower() != self.name.lower():
            raise DaqmxError(-200220, f"Device: {name}")

    def divisor(self, task: DaqTask) -> int:
        """Ticks of the timebase from one edge of a task's own clock to the next."""
        return round(ni.TIMEBASE_HZ / task.rate_hz)

    # States

    def configure(self, task: DaqTask, **values: Any) -> None:
        """Set properties of a task. Raises DaqmxError while it runs."""
        if task.state == ni.RUNNING:
            raise DaqmxError(-200557, f"Task Name: {task.name}")
        for name, value in values.items():
            setattr(task, name, value)

    def verify(self, task: DaqTask) -> None:
        """Check what a client configured. Raises DaqmxError for the first thing that is wrong."""
        if not task.outputs:
            raise DaqmxError(-200478, f"Task Name: {task.name}")
        if task.kind == "ao" and task.full_v > ni.RANGES_V[-1]:
            detail = f"Property: AO.Max, AO.Min. Requested Value: {task.limits_v}"
            raise DaqmxError(-200077, f"{detail}. Maximum Value: {ni.RANGES_V[-1]}. Task Name: {task.name}")
        if task.kind == "co" and (min(task.pulse[1:]) < 1 or task.pulse[0] < 0):
            raise DaqmxError(-200077, f"Property: CO.Pulse.HighTicks, LowTicks. Task Name: {task.name}")
        if task.buffered:
            highest_hz = ni.RATE_HZ[task.kind]
            if not ni.TIMEBASE_HZ / 2**32 <= task.rate_hz <= highest_hz * (1 + 1e-9):
                detail = f"Property: SampClk.Rate. Requested Value: {task.rate_hz}. Maximum Value: {highest_hz}"
                raise DaqmxError(-200077, f"{detail}. Task Name: {task.name}")
        self.source(task)
        if task.trigger:
            if not task.buffered and task.kind != "co":
                raise DaqmxError(-200262, f"Task Name: {task.name}")
            known = self.terminal(task.trigger)
            if known not in _PINS + _TRIGGERS or known == f"{task.kind}/StartTrigger":
                raise DaqmxError(-89136, f"Source: /{self.name}/{known}. Destination: start trigger of {task.name}")
        task.state = max(task.state, ni.VERIFIED)

    def commit(self, task: DaqTask) -> None:
        """Bring a task to the state committed, with all its resources. Raises DaqmxError if the task is wrong, or if
        another task has one of the resources."""
        self.verify(task)
        if task.state >= ni.COMMITTED:
            return
        for other in self.tasks.values():
            if other.state < ni.COMMITTED:
                continue
            taken = set(task.outputs) & set(other.outputs)
            if task.buffered and other.buffered and task.kind == other.kind:
                taken.add(f"{task.kind} timing engine")
            if taken:
                code = -200587 if all(one.startswith("port") for one in taken) else -50103
                raise DaqmxError(code, f"Resource: {min(taken)} of task {other.name}. Task Name: {task.name}")
            if task.kind == other.kind == "ao" and task.buffered != other.buffered:
                raise DaqmxError(-200963, f"Other task: {other.name}. Task Name: {task.name}")
        task.state = ni.COMMITTED

    def start(self, task: DaqTask, now_s: float, before: int) -> None:
        """Start a task, unless it runs; it may then wait for its trigger. before: the state to which a stop brings it
        back. Raises DaqmxError if it cannot start."""
        if task.state == ni.RUNNING:
            return
        self.commit(task)
        if task.buffered and task.buffer is None and not task.chunks:
            raise DaqmxError(-200462, f"Task Name: {task.name}")
        task.before, task.state = before, ni.RUNNING
        task.error, task.played, task.edges = None, 0, None
        task.done = not task.buffered and task.kind != "co"
        if task.kind == "co":
            self.outputs[task.outputs[0]].put(0.0, now_s)  # idle
        task.waiting = bool(task.trigger)
        if not task.waiting:
            self._triggered(task, now_s)

    def stop(self, task: DaqTask, now_s: float, state: int = ni.RUNNING) -> None:
        """Stop a task, if it runs, and bring it back to the state before its start, or to `state` if that is lower."""
        if task.state == ni.RUNNING:
            self._pause(task, now_s)
            task.state, task.waiting = task.before, False
            task.played = task.written = 0
            task.chunks.clear()
        task.state = min(task.state, state)
        if task.state < ni.COMMITTED:
            task.buffer = None
            task.size, task.own_size = 0 if task.own_size else task.size, False

    # Clocks

    def _triggered(self, task: DaqTask, at_s: float) -> None:
        task.waiting = False
        self._open(task, at_s)
        if task.kind != "co":
            self._fire(f"{task.kind}/StartTrigger", at_s)

    def _fire(self, terminal: str, at_s: float) -> None:
        for other in self.tasks.values():
            if other.waiting and self.terminal(other.trigger) == terminal:
                self._triggered(other, at_s)

    def _open(self, task: DaqTask, at_s: float) -> None:
        """Begin to generate, if the task's clock runs, and let others begin that use the task's clock."""
        source = self.source(task)
        if source:
            edges = next((one.edges for one in self.tasks.values() if one.edges and one.terminal == source), None)
            edges = edges or self._outside.get(source)
            task.edges = edges and edges.from_(at_s)
        elif task.buffered:
            task.edges = Edges(at_s + START_DELAY_TICKS * self._tick_s, self.divisor(task) * self._tick_s)
        if task.edges is not None:
            self.lay(task, task.played)
            self._follow(task.terminal, at_s)

    def _follow(self, terminal: str, at_s: float) -> None:
        for task in self.tasks.values():
            idle = task.state == ni.RUNNING and not task.waiting and not task.done and task.edges is None
            if idle and self.source(task) == terminal:
                self._open(task, at_s)

    def _pause(self, task: DaqTask, at_s: float) -> None:
        """Generate no more from a time on: the clock stops, the outputs hold, and tasks that use the clock stop too."""
        if task.edges is None:
            return
        task.played = task.generated(at_s - 2 * EARLY * task.edges.period_s)
        task.edges = None
        for output in task.outputs:
            self.outputs[output].cut(at_s)
        for other in self.tasks.values():
            if other.edges is not None and self.source(other) == task.terminal:
                self._pause(other, at_s)

    def lay(self, task: DaqTask, sample: int) -> None:
        """Give the outputs of a task with a clock its samples from number `sample` on, in place of what was to come
        then."""
        assert task.edges is not None, "asked for by the caller"
        if task.kind == "co":
            delay, high, low = task.pulse
            edges = Edges(task.edges.at(max(0, delay - 1)), task.edges.period_s)
            data = np.repeat([1, 0], [high, low])
            self.outputs[task.outputs[0]].play(Samples(edges, task.limit * (high + low), data))
            return
        repeated = task.buffer is not None
        for begin, rows in [(sample, task.buffer)] if task.buffer is not None else list(task.chunks):
            size, skipped = rows.shape[1], max(0, sample - begin)
            count = min(task.limit, np.inf if repeated else begin + size) - begin - skipped
            if count > 0:
                at = Edges(task.edges.at(begin + skipped - task.played), task.edges.period_s)
                for output, row in zip(task.outputs, rows, strict=True):
                    self.outputs[output].play(Samples(at, count, row, begin % size if repeated else skipped))
