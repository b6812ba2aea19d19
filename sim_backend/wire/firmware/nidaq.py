"""An X Series card of NI with its driver NI-DAQmx, as NI's gRPC device server shows them.

A pure state machine: it gets remote procedure calls as names and fields, and the time. It has what drives a galvo:
analogue outputs, port 0 with a clock, and counters for the markers; of inputs, those that measure the outputs. All
other calls are unknown to it, and properties that it does not have are refused as not applicable, -200452, though the
card may have them. Facts: docs/reference/devices/nidaq.md.

What drivers trip over:

- A stopped task, a finite one that is done, and an underflow leave the last voltage and levels at the outputs.
- A client that goes away leaves its tasks running, since they live in the server.
- Digital lines on `ao/SampleClock` miss what came before their start, and wait for ever for a clock that does not run.
- A buffer is repeated unless that is forbidden. New samples for it come out after those in the card's memory: old and
  new ones mix.
- Rates are 100 MHz divided by an integer: for 48 kHz it is 48007.68 Hz. The crystal has an error of its own.
- Two tasks cannot have the same output, nor can two have the clock of the analogue outputs.

Public sources do not tell the following, so it is assumed. A finite task is done half a period after its last sample. A
stop drops samples that are not regenerated. A write to a task that waits for its trigger replaces samples that the
card's memory already holds. A counter's first pulse begins with the edge number `initial_delay` of its clock after the
start. A reset is reported as -88709, once, by the next call about a task that ran. An on-demand write with automatic
start releases the output afterwards. Analogue outputs with and without a clock exclude each other, as on a PXI-6723. A
task that needs lines of another task is refused with -200587, one that needs anything else of another task with -50103.
Full scale is exactly 10 V in 32767 steps.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq_parts import daq_task as ni
from sim_backend.wire.firmware.nidaq_parts.daq_card import Card
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import CardHistory
from sim_backend.wire.firmware.nidaq_parts.daq_task import DaqmxError, DaqTask

MARKERS: Final = {GREEN: "port0/line0", BLUE: "port0/line1", INTENSITY: "port0/line2"}
"""Outputs of the line marker, of the scan marker, and of the level that is high while the mirror goes backward."""
SERIAL: Final = 0x01C3A5F7
_SIGNALS: Final = {12487: "SampleClock", 12491: "StartTrigger"}
"""Signals that can be exported, by their numbers in NI's enumeration."""
_TYPES: Final = {"ai": 10100, "ao": 10102, "do": 10153, "co": 10132}
_VOLTAGE: Final = 10322
_SETTABLE: Final = {0x1344: "rate_hz", 0x1453: "regeneration", 0x186D: "size"}
"""Properties of tasks that can be set: rate of the sample clock, regeneration, and size of the buffer."""
_KEPT_CALLS: Final = 200

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

    def __init__(self, *, markers: Mapping[int, str] = MARKERS, clock_error: float = 0.0) -> None:
        """markers: outputs, such as `port0/line0` or `ctr0`, by their line in `history`. clock_error: relative error of
        the crystal, positive if it runs fast."""
        super().__init__(clock_error)
        self.history = CardHistory(self.outputs["ao0"], {line: self.outputs[name] for line, name in markers.items()})
        self.exported: dict[str, str] = {}
        """Signal by the terminal to which it is exported."""
        self.properties: dict[int, Any] = {
            0x0631: "PCIe-6363",
            0x0632: SERIAL,
            0x22CA: False,  # simulated by the driver
            0x2996: True,  # analogue outputs have a clock
            0x2997: ni.RATE_HZ["ao"],
            0x299A: ni.RATE_HZ["do"],
            0x299B: [limit for one in ni.RANGES_V for limit in (-one, one)],
            0x193B: self.name,
            **{0x1272: 26, 0x1923: 0, 0x2F22: 0},  # the driver's version
        }
        """Properties of the device and its driver, by NI's numbers. Without some of them it is another card."""
        self.measures = True
        """Whether its outputs can be measured inside the card."""
        self.calls: list[str] = []
        """The last calls as they came, for tests to look at."""
        self._unnamed = 0

    def moving(self, now_s: float) -> bool:
        """Whether a clock drives the galvo."""
        self.advance(now_s)
        return any("ao0" in task.outputs and task.edges is not None for task in self.tasks.values())

    def serves(self, rpc: str) -> bool:
        """Whether the model knows a call. Whoever makes another one learns that the server lacks the operation."""
        return rpc in _CALLS or _PROPERTY.fullmatch(rpc) is not None

    def call(self, call: Call, now_s: float) -> Answer | None:
        """Fields of the answer to a call; None: not yet, ask again later. Raises `DaqmxError`."""
        self.advance(now_s)
        fields = SimpleNamespace(**call.fields)
        if call.rpc in _CALLS:
            return _CALLS[call.rpc](self, call, fields, now_s)
        if call.rpc.startswith("Set"):
            name = _SETTABLE.get(fields.attribute)
            if name is None:
                raise DaqmxError(-200452, f"Property: {fields.attribute:#x}. Task Name: {fields.task}")
            fresh: Answer = {"buffer": None, "own_size": False} if name == "size" else {}
            self.configure(self._task(fields), **{name: fields.value}, **fresh)
            return {}
        found = self._property(call.rpc, fields, now_s)
        return {"value_raw" if "Int32" in call.rpc and "UInt" not in call.rpc else "value": found}

    def came(self, rpc: str) -> None:
        """Note the name of a call."""
        self.calls = [*self.calls[-_KEPT_CALLS:], rpc]

    def _task(self, fields: Any) -> DaqTask:
        if fields.task not in self.tasks:
            raise DaqmxError(-200088)
        return self.tasks[fields.task]

    def _report(self, task: DaqTask) -> None:
        """Raise the error that ended the generation, if any. It is forgotten once it is raised for a stopped task."""
        error = task.error
        if task.state != ni.RUNNING:
            task.error = None
        if error is not None:
            raise DaqmxError(error.code, f"Task Name: {task.name}")

    # Tasks and their states

    def _create_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        name = fields.session_name
        if not name:
            name, self._unnamed = f"_unnamedTask<{self._unnamed:X}>", self._unnamed + 1
        new = name not in self.tasks
        self.tasks.setdefault(name, DaqTask(name))
        return {"task": name, "new_session_initialized": new}

    def _clear_task(self, call: Call, fields: Any, now_s: float) -> Answer:
        task = self._task(fields)
        self.stop(task, now_s, ni.UNVERIFIED)
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

    def _reset_device(self, call: Call, fields: Any, now_s: float) -> Answer:
        self.check_device(fields.device_name)
        self.reset(now_s)
        return {}

    # Channels, timing, triggers

    def _add(self, fields: Any, kind: str, outputs: list[str], **values: Any) -> Answer:
        """Add a channel to a task that has none."""
        task = self._task(fields)
        if task.kind:
            raise DaqmxError(-200489 if task.kind == kind else -200559, f"Task Name: {task.name}")
        self.configure(task, kind=kind, outputs=outputs, **values)
        return {}

    def _create_ao(self, call: Call, fields: Any, now_s: float) -> Answer:
        if fields.min_val >= fields.max_val:
            raise DaqmxError(-200082, f"Minimum: {fields.min_val}. Maximum: {fields.max_val}")
        outputs = self.physical(fields.physical_channel, "ao")
        return self._add(fields, "ao", outputs, limits_v=(fields.min_val, fields.max_val))

    def _create_ai(self, call: Call, fields: Any, now_s: float) -> Answer:
        """Take an internal input, which measures what an analogue output puts out. The model has no other inputs."""
        device, _, local = fields.physical_channel.partition("/")
        self.check_device(device)
        if not self.measures or re.fullmatch(r"_ao[0-3]_vs_aognd", local) is None:
            raise DaqmxError(-200170, f"Physical Channel: {fields.physical_channel}")
        return self._add(fields, "ai", [local])

    def _create_do(self, call: Call, fields: Any, now_s: float) -> Answer:
        return self._add(fields, "do", self.physical(fields.lines, "port"))

    def _create_co(self, call: Call, fields: Any, now_s: float) -> Answer:
        pulse = fields.initial_delay, fields.high_ticks, fields.low_ticks
        outputs = self.physical(fields.counter, "ctr")
        return self._add(fields, "co", outputs, source=fields.source_terminal, pulse=pulse)

    def _cfg_timing(self, call: Call, fields: Any, now_s: float) -> Answer:
        """Set a sample clock; for counters the number of pulses."""
        task, implicit = self._task(fields), call.rpc == "CfgImplicitTiming"
        if implicit != (task.kind == "co"):
            raise DaqmxError(-200077, f"Property: SampTimingType. Task Name: {task.name}")
        self.configure(
            task, clocked=True, continuous=fields.sample_mode == ni.CONTINUOUS, samples=fields.samps_per_chan
        )
        if not implicit:
            self.configure(task, rate_hz=fields.rate, source=fields.source)
        return {}

    def _cfg_dig_edge_start_trig(self, call: Call, fields: Any, now_s: float) -> Answer:
        self.configure(self._task(fields), trigger=fields.trigger_source)
        return {}

    def _export_signal(self, call: Call, fields: Any, now_s: float) -> Answer:
        task, signal = self._task(fields), _SIGNALS.get(fields.signal_id)
        if signal is None or task.kind not in ("ao", "do"):
            raise DaqmxError(-200452, f"Signal: {fields.signal_id}. Task Name: {task.name}")
        self.exported[self.terminal(fields.output_terminal, -89121)] = f"{task.kind}/{signal}"
        return {}

    # Properties

    def _property(self, rpc: str, fields: Any, now_s: float) -> Any:
        number = fields.attribute
        if "SystemInfo" in rpc or "Device" in rpc:
            self.check_device(getattr(fields, "device_name", self.name))
            values, code, of = self.properties, -200197, self.name
        else:
            task = self._task(fields)
            values = self._of_timing(task) if "Timing" in rpc else self._of_task(task, rpc, now_s)
            code, of = -200452, f"Task Name: {task.name}"
        if number not in values:
            raise DaqmxError(code, f"Property: {number:#x}. {of}")
        return values[number]

    def _of_timing(self, task: DaqTask) -> dict[int, Any]:
        self.verify(task)
        if not task.buffered:
            return {}
        source, divisor = self.source(task), self.divisor(task)
        return {
            0x1344: task.rate_hz if source else ni.TIMEBASE_HZ / divisor,
            0x1852: f"/{self.name}/{source or f'{task.kind}/SampleClockTimebase'}",
            0x22C8: ni.RATE_HZ[task.kind],
            0x1303: float(ni.TIMEBASE_HZ),
            0x18EB: divisor,
        }

    def _of_task(self, task: DaqTask, rpc: str, now_s: float) -> dict[int, Any]:
        if rpc.startswith("GetWrite"):
            self._report(task)
        generated = task.generated(now_s)
        ahead = 0 if task.regenerates else max(0, task.written - generated - ni.FIFO.get(task.kind, 0))
        name = f"{self.name}/{task.outputs[0]}" + ("..." if len(task.outputs) > 1 else "") if task.outputs else ""
        return {
            0x1276: task.name,
            0x1273: name,
            0x2181: bool(task.kind),
            0x187F: _TYPES.get(task.kind),
            0x1108: _VOLTAGE,
            0x0695: _VOLTAGE,
            0x2179: len(task.outputs),
            0x1453: task.regeneration,
            0x1458: task.written,
            0x192B: generated,
            0x1460: task.size - ahead,
            0x217E: 1,
            0x217F: len(task.outputs),
            0x1823: name,
            0x217B: 1,
            0x186D: task.size,
        }

    # Reading and writing

    def _read_analog(self, call: Call, fields: Any, now_s: float) -> Answer:
        measured = [self.outputs[one[1:4]].values(np.array([now_s]))[0] for one in self._task(fields).outputs]
        n = max(1, fields.num_samps_per_chan)
        return {"read_array": np.repeat(measured, n).tolist(), "samps_per_chan_read": n}

    def _write_analog(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        task, volts = self._writable(fields, "ao")
        if not (task.limits_v[0] <= volts.min() and volts.max() <= task.limits_v[1]):
            raise DaqmxError(-200561, f"Minimum and Maximum Value: {task.limits_v}. Task Name: {task.name}")
        volts = np.rint(volts / task.full_v * ni.CODES) / ni.CODES * task.full_v
        return self._write(call, task, volts[None], fields, now_s)

    def _write_integers(self, call: Call, fields: Any, now_s: float) -> Answer | None:
        """Take integers, whose bits are the lines of the port by number, whichever of them the task has."""
        task, words = self._writable(fields, "do")
        rows = [words >> int(one.rpartition("line")[2]) & 1 for one in task.outputs]
        return self._write(call, task, np.array(rows, np.uint8), fields, now_s)

    def _writable(self, fields: Any, kind: str) -> tuple[DaqTask, NDArray[Any]]:
        """The task of a write, and its numbers."""
        task = self._task(fields)
        self._report(task)
        if task.kind != kind or not 0 < fields.write_array.size == fields.num_samps_per_chan:
            raise DaqmxError(-200524, f"Samples: {fields.write_array.size}. Task Name: {task.name}")
        return task, fields.write_array

    def _write(self, call: Call, task: DaqTask, rows: NDArray[Any], fields: Any, now_s: float) -> Answer | None:
        """Take samples, (outputs, n): at once, or as there is room for them. None: not all are taken yet."""
        before, n = task.state, rows.shape[1]
        if not task.buffered:
            if not fields.auto_start and before != ni.RUNNING:
                raise DaqmxError(-200846, f"Task Name: {task.name}")
            self.start(task, now_s, before)
            for output, row in zip(task.outputs, rows, strict=True):
                self.outputs[output].put(float(row[-1]), now_s)
            if before != ni.RUNNING:
                self.stop(task, now_s)
            return {"samps_per_chan_written": n}
        self.commit(task)
        if not task.size:
            if n == 1:
                raise DaqmxError(-200547, f"Task Name: {task.name}")
            task.size, task.own_size = n, True
        if task.regenerates:
            self._write_over(task, rows, now_s)
        elif not self._append(call, task, rows, fields.timeout, now_s):
            return None
        if fields.auto_start:
            self.start(task, now_s, before)
        return {"samps_per_chan_written": n}

    def _write_over(self, task: DaqTask, rows: NDArray[Any], now_s: float) -> None:
        """Replace samples of the buffer that is regenerated. What the card's memory holds comes out as it was."""
        n, size = rows.shape[1], task.size
        if n > size:
            raise DaqmxError(-200293, f"Samples: {n}. Buffer: {size}. Task Name: {task.name}")
        buffer = np.zeros((len(rows), size), rows.dtype) if task.buffer is None else task.buffer.copy()
        buffer[:, (task.written + np.arange(n)) % size] = rows
        task.buffer, task.written = buffer, task.written + n
        if task.edges is not None:
            self.lay(task, task.generated(now_s) + ni.FIFO[task.kind])

    def _append(self, call: Call, task: DaqTask, rows: NDArray[Any], timeout_s: float, now_s: float) -> bool:
        """Add samples that come out once, as many as there is room for; returns whether all of them are in."""
        room = task.size + ni.FIFO[task.kind] - (task.written - task.generated(now_s))
        if task.state != ni.RUNNING and rows.shape[1] > room:
            raise DaqmxError(-200293, f"Samples: {rows.shape[1]}. Room: {room}. Task Name: {task.name}")
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


_PROPERTY: Final = re.compile("(Get|Set)(Timing|Buffer|Read|Write|Chan|Task|Device|SystemInfo)Attribute(?:Ex)?(\\w*)")
_CALLS: Final[dict[str, Callable[[NidaqModel, Call, Any, float], Answer | None]]] = {
    "CreateTask": NidaqModel._create_task,
    "ClearTask": NidaqModel._clear_task,
    "StartTask": NidaqModel._start_task,
    "StopTask": NidaqModel._stop_task,
    "ResetDevice": NidaqModel._reset_device,
    "CreateAOVoltageChan": NidaqModel._create_ao,
    "CreateAIVoltageChan": NidaqModel._create_ai,
    "CreateDOChan": NidaqModel._create_do,
    "CreateCOPulseChanTicks": NidaqModel._create_co,
    "CfgSampClkTiming": NidaqModel._cfg_timing,
    "CfgImplicitTiming": NidaqModel._cfg_timing,
    "CfgDigEdgeStartTrig": NidaqModel._cfg_dig_edge_start_trig,
    "ExportSignal": NidaqModel._export_signal,
    "ReadAnalogF64": NidaqModel._read_analog,
    "WriteAnalogF64": NidaqModel._write_analog,
    "WriteDigitalU32": NidaqModel._write_integers,
}
