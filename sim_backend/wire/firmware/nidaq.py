"""An X Series card of NI with its driver NI-DAQmx, as NI's gRPC device server shows them (docs/reference/hardware.md).

A pure state machine: it gets remote procedure calls as names and fields, and the time. It has the outputs only:
analogue ones for the galvo, port 0 with a clock and counters for the markers, static lines on ports 1 and 2.

What drivers trip over:

- A stopped task, a finite one that is done, and an underflow leave the last voltage and levels at the outputs.
- A client that goes away leaves its tasks running, since they live in the server. Whoever creates a task of the same
  name gets the old one.
- Digital lines on `ao/SampleClock` miss what came before their start, and wait for ever for a clock that does not run.
- New samples for a buffer that is being regenerated come out after those in the card's memory: old and new ones mix.
- Rates are 100 MHz by an integer; 48 kHz are 48007.68 Hz, and the crystal has an error of its own.
- Two tasks cannot have the same output, nor can two have the clock of the analogue outputs.

Public sources do not tell the following, and the model chose. A finite task is done half a period after its last
sample. A stop drops samples that are not regenerated. A write to a task that waits for its trigger replaces samples
that the card's memory already holds. A counter's first pulse begins at that edge of its clock before which
`initial_delay` edges came. A reset is reported as -88709, once, by the next call about a task that ran. An on-demand
write with automatic start releases the output afterwards. Analogue outputs with and without a clock exclude each other,
as on a PXI-6723. Lines that are taken are -200587, all else that is taken -50103. Full scale is exactly 10 V in 32767
steps. Properties that the model does not have are refused as not applicable, -200452, though the card may have them.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq_parts import daq_properties as properties
from sim_backend.wire.firmware.nidaq_parts.daq_card import PINS, Card
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import CardHistory
from sim_backend.wire.firmware.nidaq_parts.daq_task import (
    AO_MAX,
    AO_MIN,
    CHAN_PER_LINE,
    CODES,
    COMMITTED,
    CURRENT_POSITION,
    DIGITAL_EDGE,
    EDGE,
    ERRORS,
    IDLE,
    IMPLICIT,
    MODE,
    NO_TRIGGER,
    OFFSET,
    RATE,
    RELATIVE_TO,
    RESERVED,
    RUNNING,
    SAMPLE_CLOCK,
    SAMPLES,
    SOURCE,
    TIMING,
    TRIGGER,
    TRIGGER_EDGE,
    TRIGGER_SOURCE,
    UNVERIFIED,
    VERIFIED,
    Channel,
    DaqmxError,
    SessionError,
    Task,
    expand,
)

MARKERS: Final = {GREEN: "port0/line0", BLUE: "port0/line1", INTENSITY: "port0/line2"}
"""Outputs of the line marker, of the scan marker, and of the level that is high while the mirror goes backward."""
_SIGNALS: Final = {12487: "SampleClock", 12491: "StartTrigger"}
"""Signals that can be exported, by their numbers in NI's enumeration."""
_SWITCH: Final = {2: VERIFIED, 3: COMMITTED, 4: RESERVED}
"""States to which the actions of `TaskControl` lead. 0 starts, 1 stops, 5 releases, 6 aborts."""

Answer = dict[str, Any]


@dataclass(slots=True, eq=False)
class Call:
    """A remote procedure call. The same object is given to the model again until it has an answer.

    fields: those of the request, without the ending `_raw`: a task as its name, repeated numbers as an array.
    """

    rpc: str
    fields: Mapping[str, Any]
    since_s: float
    """Time at which it came."""
    taken: int = 0
    """Samples per channel that a write has put into the buffer."""


class NidaqModel(Card):
    """The card and its driver."""

    def __init__(
        self,
        *,
        name: str = "Dev1",
        serial: int = 0x01C3A5F7,
        full_scale_v: float = 10.0,
        galvo: str = "ao0",
        markers: Mapping[int, str] = MARKERS,
        clock_error: float = 0.0,
    ) -> None:
        """full_scale_v: voltage at which the galvo's drive is 1. galvo: its output. markers: outputs, such as
        `port0/line0` or `ctr0`, by their line in `history`. clock_error: of the crystal, relative.
        """
        super().__init__(name, serial, clock_error)
        lines = {line: self.outputs[output] for line, output in markers.items()}
        self.history = CardHistory(self.outputs[galvo], full_scale_v, lines)
        self.routes: dict[str, str] = {}
        """Source by destination terminal, of exported signals and of connected terminals."""
        self.calls: list[str] = []
        """The last calls as they came, for tests to look at."""
        self._galvo = galvo
        self._unnamed = 0

    def moving(self, now_s: float) -> bool:
        """Whether a clock drives the galvo."""
        self.advance(now_s)
        return any(self._galvo in task.outputs and task.edges is not None for task in self.tasks.values())

    def serves(self, rpc: str) -> bool:
        """Whether the model knows a call. Whoever makes another one learns that the server lacks the operation."""
        return rpc in _CALLS or _PROPERTY.fullmatch(rpc) is not None

    def call(self, call: Call, now_s: float) -> Answer | None:
        """Fields of the answer to a call; None: not yet, ask again later. Raises `DaqmxError` or `SessionError`."""
        self.advance(now_s)
        fields = SimpleNamespace(**call.fields)
        method = _CALLS.get(call.rpc)
        return self._property(call, fields, now_s) if method is None else method(self, call, fields, now_s)

    def came(self, rpc: str) -> None:
        """Note the name of a call."""
        self.calls = [*self.calls[-_KEPT_CALLS:], rpc]

    def _task(self, fields: Any) -> Task:
        found = self.tasks.get(fields.task)
        if found is None:
            raise DaqmxError(-200088)
        return found

    def _report(self, task: Task) -> None:
        """Raise the error that ended the generation. It is raised until the task is stopped."""
        error = task.error
        if task.state != RUNNING:
            task.error = None
        if error is not None:
            raise DaqmxError(error.code, f"Task Name: {task.name}")

    # Tasks and their states

    def _create_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        name, behavior = fields.session_name, fields.initialization_behavior
        if behavior == 1 and name in self.tasks:
            raise SessionError("ALREADY_EXISTS", f"Cannot initialize '{name}' when a session already exists.")
        if behavior == 2 and name not in self.tasks:
            raise SessionError("FAILED_PRECONDITION", f"Cannot attach to '{name}': it has not been initialized.")
        if not name:
            name, self._unnamed = f"_unnamedTask<{self._unnamed:X}>", self._unnamed + 1
        new = name not in self.tasks
        self.tasks.setdefault(name, Task(name))
        return {"task": name, "new_session_initialized": new}

    def _clear_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self.stop(task, now_s, UNVERIFIED)
        del self.tasks[task.name]
        return {}

    def _start_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self._report(task)
        self.start(task, now_s, task.state)
        return {}

    def _stop_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self.stop(task, now_s)
        self._report(task)
        return {}

    def _task_control(self, call: Call, fields: Any, now_s: float) -> Answer:
        task, action = self._task(fields), fields.action
        if action in _SWITCH:
            self.lead_to(task, _SWITCH[action])
        elif action == 0:
            self.start(task, now_s, task.state)
        else:
            self.stop(task, now_s, RUNNING if action == 1 else VERIFIED)
        return {}

    def _is_task_done(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self._report(task)
        return {"is_task_done": task.state != RUNNING or task.done}

    def _wait_until_task_done(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        task = self._task(fields)
        self._report(task)
        if task.state != RUNNING or task.done:
            return {}
        if 0 <= fields.time_to_wait <= now_s - call.since_s:
            raise DaqmxError(-200560, f"Task Name: {task.name}")
        return None

    # Channels, timing, triggers, routes

    def _add(self, fields: Any, kind: str, named: Mapping[str, list[str]], values: Mapping[int, Any]) -> Answer:
        """Add channels to a task. named: outputs by name of the channel."""
        task = self._task(fields)
        if task.state == RUNNING:
            raise DaqmxError(-200479, f"Task Name: {task.name}")
        if task.kind not in ("", kind):
            raise DaqmxError(-200559, f"Task Name: {task.name}")
        for name, outputs in named.items():
            if name in [channel.name for channel in task.channels] or set(outputs) & set(task.outputs):
                raise DaqmxError(-200489, f"Channel: {name}")
            task.channels.append(Channel(name, outputs, dict(values)))
        task.kind = kind
        self.stop(task, 0.0, UNVERIFIED)
        return {}

    def _named(self, given: str, outputs: list[str]) -> dict[str, list[str]]:
        """One channel for each output."""
        if not given:
            return {f"{self.name}/{one}": [one] for one in outputs}
        return {f"{given}{n}" if len(outputs) > 1 else given: [one] for n, one in enumerate(outputs)}

    def _create_ao(self, call: Call, fields: Any, now_s: float) -> Answer:
        if fields.min_val >= fields.max_val:
            raise DaqmxError(-200082, f"Minimum: {fields.min_val}. Maximum: {fields.max_val}")
        named = self._named(fields.name_to_assign_to_channel, self.physical(fields.physical_channel, "ao"))
        return self._add(fields, "ao", named, {AO_MIN: fields.min_val, AO_MAX: fields.max_val})

    def _create_ai(self, call: Call, fields: Any, now_s: float) -> Answer:
        """Take an internal input, which measures what an analogue output puts out. The model has no other inputs."""
        named: dict[str, list[str]] = {}
        for one in expand(fields.physical_channel):
            device, _, local = one.partition("/")
            self.check_device(device)
            if re.fullmatch(r"ai\d+", local):
                raise SessionError("UNIMPLEMENTED", f"The emulated card has no input {one}.")
            if re.fullmatch(r"_ao[0-3]_vs_aognd", local) is None:
                raise DaqmxError(-200170, f"Physical Channel: {one}")
            named[fields.name_to_assign_to_channel or one] = [local]
        return self._add(fields, "ai", named, {})

    def _create_do(self, call: Call, fields: Any, now_s: float) -> Answer:
        outputs, given = self.physical(fields.lines, "port"), fields.name_to_assign_to_lines
        if fields.line_grouping == CHAN_PER_LINE:
            return self._add(fields, "do", self._named(given, outputs), {})
        name = given or f"{self.name}/{outputs[0]}" + ("..." if len(outputs) > 1 else "")
        return self._add(fields, "do", {name: outputs}, {})

    def _create_co(self, call: Call, fields: Any, now_s: float) -> Answer:
        named = self._named(fields.name_to_assign_to_channel, self.physical(fields.counter, "ctr"))
        return self._add(fields, "co", named, properties.pulses(call.rpc, fields) | {IDLE: fields.idle_state})

    def _cfg_samp_clk_timing(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        if task.kind == "ai":
            raise SessionError("UNIMPLEMENTED", "The emulated card has no clock for inputs.")
        values = {RATE: fields.rate, SOURCE: fields.source, EDGE: fields.active_edge, TIMING: SAMPLE_CLOCK}
        self.configure(task, task.timing, values | {MODE: fields.sample_mode, SAMPLES: fields.samps_per_chan})
        return {}

    def _cfg_implicit_timing(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        if task.kind != "co":
            raise DaqmxError(-200077, f"Property: SampTimingType. Requested Value: Implicit. Task Name: {task.name}")
        values = {MODE: fields.sample_mode, SAMPLES: fields.samps_per_chan, TIMING: IMPLICIT}
        self.configure(task, task.timing, values)
        return {}

    def _cfg_dig_edge_start_trig(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        values = {TRIGGER: DIGITAL_EDGE, TRIGGER_SOURCE: fields.trigger_source, TRIGGER_EDGE: fields.trigger_edge}
        self.configure(task, task.trigger, values)
        return {}

    def _disable_start_trig(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self.configure(task, task.trigger, {TRIGGER: NO_TRIGGER})
        return {}

    def _cfg_output_buffer(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self.configure(task)
        task.size, task.buffer = fields.num_samps_per_chan, None
        return {}

    def _export_signal(self, call: Call, fields: Any, now_s: float) -> Answer:
        task, signal = self._task(fields), _SIGNALS.get(fields.signal_id)
        if signal is None or task.kind not in ("ao", "do"):
            raise DaqmxError(-200452, f"Signal: {fields.signal_id}. Task Name: {task.name}")
        for one in expand(fields.output_terminal):
            self.routes[self.terminal(one, -89121)] = f"{task.kind}/{signal}"
        return {}

    def _connect_terms(self, call: Call, fields: Any, now_s: float) -> Answer:
        destination = self.terminal(fields.destination_terminal, -89121)
        if destination not in PINS:
            raise DaqmxError(-89136, f"Destination: {fields.destination_terminal}")
        self.routes[destination] = self.terminal(fields.source_terminal)
        return {}

    def _disconnect_terms(self, call: Call, fields: Any, now_s: float) -> Answer:
        self.routes.pop(self.terminal(fields.destination_terminal, -89121), None)
        return {}

    # The card, and properties

    def _reset_device(self, call: Call, fields: Any, now_s: float) -> Answer:
        """Abort all tasks; analogue outputs go to 0 V, lines to their level after power-up."""
        self.check_device(fields.device_name)
        for task in self.tasks.values():
            task.error = DaqmxError(-88709) if task.state == RUNNING else task.error
            self.stop(task, now_s, VERIFIED)
        for output in self.outputs.values():
            output.put(0.0, now_s)
        self.routes.clear()
        return {}

    def _self_test_device(self, call: Call, fields: Any, now_s: float) -> Answer:
        self.check_device(fields.device_name)
        return {}

    def _get_error_string(self, call: Call, fields: Any, now_s: float) -> Answer:
        return {"error_string": ERRORS.get(fields.error_code, "")}

    def _property(self, call: Call, fields: Any, now_s: float) -> Answer:
        found = _PROPERTY.fullmatch(call.rpc)
        assert found is not None, "asked for calls that are served only"
        verb, group, kind = found.groups()
        if verb != "Get":
            properties.set_property(self, self._task(fields), group, call.fields)
            return {}
        if group == "SystemInfo":
            value = properties.of_system(self, fields.attribute)
        elif group == "Device":
            self.check_device(fields.device_name)
            value = properties.of_device(self, fields.attribute)
        elif group == "PhysicalChan":
            value = properties.of_physical(self, fields.physical_channel, fields.attribute)
        else:
            value = properties.of_task(self, self._task(fields), group, call.fields, now_s)
        return {"value_raw" if kind.startswith("Int32") else "value": value}

    def _read_analog(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        if task.kind != "ai":
            raise DaqmxError(-200525, f"Task Name: {task.name}")
        before, n = task.state, max(1, fields.num_samps_per_chan)
        self.start(task, now_s, before)
        if before != RUNNING:
            self.stop(task, now_s)
        measured = [self.outputs[one[1:4]].values(np.array([now_s]))[0] for one in task.outputs]
        values = np.repeat(measured, n) if fields.fill_mode == 0 else np.tile(measured, n)
        return {"read_array": values.tolist(), "samps_per_chan_read": n}

    # Writing

    def _write_analog(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        task = self._writable(fields, "ao")
        rows = _by_channel(fields, len(task.channels)).astype(np.float64)
        for row, channel in zip(rows, task.channels, strict=True):
            full_v, low_v, high_v = channel.dac_range_v, channel.attributes[AO_MIN], channel.attributes[AO_MAX]
            if call.rpc == "WriteBinaryI16":
                row *= full_v / CODES
            elif row.size and not (low_v <= row.min() and row.max() <= high_v):
                detail = f"Maximum Value: {high_v}. Minimum Value: {low_v}. Channel Name: {channel.name}"
                raise DaqmxError(-200561, detail, written=0)
            row[:] = np.rint(row / full_v * CODES) / CODES * full_v
        return self._write(call, task, rows, fields, now_s)

    def _write_lines(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        """Take booleans, for every channel as many as the largest one has lines."""
        task = self._writable(fields, "do")
        n, most = fields.num_samps_per_chan, max(len(channel.outputs) for channel in task.channels)
        data = np.frombuffer(fields.write_array, np.uint8)
        if data.size != n * len(task.channels) * most:
            raise DaqmxError(-200524, f"Booleans: {data.size}. Task Name: {task.name}", written=0)
        by_scan = fields.data_layout == 1
        cube = data.reshape(n, -1, most).swapaxes(0, 1) if by_scan else data.reshape(-1, n, most)
        rows = [cube[at, :, : len(channel.outputs)].T for at, channel in enumerate(task.channels)]
        return self._write(call, task, np.concatenate(rows), fields, now_s)

    def _write_integers(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        """Take integers, whose bits are the lines of a port by number, whichever of them a channel has."""
        task = self._writable(fields, "do")
        words = _by_channel(fields, len(task.channels)).astype(np.int64)
        rows = []
        for word, channel in zip(words, task.channels, strict=True):
            rows += [word >> shift & 1 for shift in channel.shifts]
        return self._write(call, task, np.array(rows, np.uint8), fields, now_s)

    def _writable(self, fields: Any, kind: str) -> Task:
        task = self._task(fields)
        self._report(task)
        if task.kind != kind:
            raise DaqmxError(-200526 if task.channels else -200459, f"Task Name: {task.name}", written=0)
        return task

    def _write(self, call: Call, task: Task, rows: NDArray[Any], fields: Any, now_s: float) -> Answer | None:
        """Take samples, (outputs, n): at once, or as there is room for them."""
        before, n = task.state, rows.shape[1]
        if not task.buffered:
            if not fields.auto_start and before != RUNNING:
                raise DaqmxError(-200846, f"Task Name: {task.name}", written=0)
            self.start(task, now_s, before)
            for output, row in zip(task.outputs, rows, strict=True):
                self.outputs[output].put(float(row[-1]), now_s)
            if before != RUNNING:
                self.stop(task, now_s)
            return {"samps_per_chan_written": n}
        self.lead_to(task, COMMITTED)
        if task.state == RUNNING and task.onboard_only:
            raise DaqmxError(-200295, f"Task Name: {task.name}", written=0)
        if task.size is None and not task.first_size:
            if n == 1:
                raise DaqmxError(-200547, f"Task Name: {task.name}", written=0)
            task.first_size = n
        if task.regenerates:
            self._write_over(task, rows, now_s)
        elif not self._append(call, task, rows, fields.timeout, now_s):
            return None
        if fields.auto_start:
            self.start(task, now_s, before)
        return {"samps_per_chan_written": n}

    def _write_over(self, task: Task, rows: NDArray[Any], now_s: float) -> None:
        """Replace samples of the buffer that is regenerated. What the card's memory holds comes out as it was."""
        n, size = rows.shape[1], task.buffer_size
        if n > size:
            raise DaqmxError(-200293, f"Samples: {n}. Buffer: {size}. Task Name: {task.name}", written=0)
        buffer = np.zeros((len(rows), size), rows.dtype) if task.buffer is None else task.buffer.copy()
        begin = task.writing[OFFSET] + (task.written if task.writing[RELATIVE_TO] == CURRENT_POSITION else 0)
        buffer[:, (begin + np.arange(n)) % size] = rows
        task.buffer, task.written = buffer, begin + n
        if task.edges is not None:
            self.lay(task, task.generated(now_s) + task.fifo)

    def _append(self, call: Call, task: Task, rows: NDArray[Any], timeout_s: float, now_s: float) -> bool:
        """Add samples that come out once, as many as there is room for; returns whether all of them are in."""
        room = task.buffer_size + task.fifo - (task.written - task.generated(now_s))
        if task.state != RUNNING and rows.shape[1] > room:
            raise DaqmxError(-200293, f"Samples: {rows.shape[1]}. Room: {room}. Task Name: {task.name}", written=0)
        taken = rows[:, call.taken : call.taken + max(0, room)]
        if taken.shape[1]:
            begin = task.written
            task.chunks.append((begin, taken))
            task.written += taken.shape[1]
            call.taken += taken.shape[1]
            if task.edges is not None:
                self.lay(task, begin)
        if call.taken < rows.shape[1] and 0 <= timeout_s <= now_s - call.since_s:
            raise DaqmxError(-200292, f"Task Name: {task.name}", written=call.taken)
        return bool(call.taken == rows.shape[1])


def _by_channel(fields: Any, channels: int) -> NDArray[Any]:
    """Numbers of a write, (channels, n)."""
    data = getattr(fields, "write_array", None)
    if data is None:
        data = np.full(channels, fields.value)
    elif isinstance(data, bytes):
        data = np.frombuffer(data, np.uint8)
    n = getattr(fields, "num_samps_per_chan", 1)
    if data.size != n * channels:
        raise DaqmxError(-200524, f"Samples: {data.size}. Channels: {channels}", written=0)
    by_scan = getattr(fields, "data_layout", 0) == 1
    found: NDArray[Any] = data.reshape(n, channels).T if by_scan else data.reshape(channels, n)
    return found


_KEPT_CALLS: Final = 200
_GROUPS: Final = "Timing|Buffer|Read|Write|Chan|Trig|Task|Device|PhysicalChan|SystemInfo"
_PROPERTY: Final = re.compile(rf"(Get|Set|Reset)({_GROUPS})Attribute(?:Ex)?(\w*)")
_CALLS: Final[dict[str, Callable[[NidaqModel, Call, Any, float], Answer | None]]] = {
    "CreateTask": NidaqModel._create_task,
    "ClearTask": NidaqModel._clear_task,
    "StartTask": NidaqModel._start_task,
    "StopTask": NidaqModel._stop_task,
    "TaskControl": NidaqModel._task_control,
    "IsTaskDone": NidaqModel._is_task_done,
    "WaitUntilTaskDone": NidaqModel._wait_until_task_done,
    "CreateAOVoltageChan": NidaqModel._create_ao,
    "CreateAIVoltageChan": NidaqModel._create_ai,
    "CreateDOChan": NidaqModel._create_do,
    "CreateCOPulseChanTicks": NidaqModel._create_co,
    "CreateCOPulseChanFreq": NidaqModel._create_co,
    "CreateCOPulseChanTime": NidaqModel._create_co,
    "CfgSampClkTiming": NidaqModel._cfg_samp_clk_timing,
    "CfgImplicitTiming": NidaqModel._cfg_implicit_timing,
    "CfgDigEdgeStartTrig": NidaqModel._cfg_dig_edge_start_trig,
    "DisableStartTrig": NidaqModel._disable_start_trig,
    "CfgOutputBuffer": NidaqModel._cfg_output_buffer,
    "ExportSignal": NidaqModel._export_signal,
    "ConnectTerms": NidaqModel._connect_terms,
    "DisconnectTerms": NidaqModel._disconnect_terms,
    "ResetDevice": NidaqModel._reset_device,
    "SelfTestDevice": NidaqModel._self_test_device,
    "GetErrorString": NidaqModel._get_error_string,
    "ReadAnalogF64": NidaqModel._read_analog,
    "WriteAnalogF64": NidaqModel._write_analog,
    "WriteAnalogScalarF64": NidaqModel._write_analog,
    "WriteBinaryI16": NidaqModel._write_analog,
    "WriteDigitalLines": NidaqModel._write_lines,
    "WriteDigitalU8": NidaqModel._write_integers,
    "WriteDigitalU16": NidaqModel._write_integers,
    "WriteDigitalU32": NidaqModel._write_integers,
    "WriteDigitalScalarU32": NidaqModel._write_integers,
}
