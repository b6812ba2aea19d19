"""Scanner kind `nidaq`: a galvo at an analogue output of an NI card, through NI-DAQmx.

    outputs   aoN: mirror, drive -1 to 1 as -full_scale to full_scale. port0/line0: line marker. line1: scan marker.
              line2: backward. All change with the same sample clock

The card is in this computer, or at a computer that runs NI's gRPC device server. A run has a task for the analogue
output (AO) and, if it plays a waveform and markers have lines, one for these digital outputs (DO). Both are buffered,
continuous and without regeneration (the buffer is not repeated). The DO task is clocked by the AO sample clock and
started first, so that sample i of both leaves with the same edge. The run is fed slice by slice, `buffer` ahead of what
the card says it has generated. If the buffer runs dry, the card stops with an error, never with old points.

After its points a run goes on with copies of the last one, markers low, until the card has generated the last point;
then the tasks are stopped in the middle of the copies. A stopped output keeps its last level, and so does one whose
task is cleared or whose buffer ran dry. So every way out of a run takes the markers low. If the host dies or the
connection to the server is lost, that fails and they stay as they are: the laser's gate must not depend on this card
alone.

`start` first turns the mirror to the first point, by the card's own clock, then arms the waveform with the config's
clock, triggers and exports. Point 0 of the waveform begins with the first sample clock after the start trigger; with
counters, with the second.

An output can be written, not read. Most cards with analogue inputs measure it on an internal channel, though. Such a
card brings a mirror that is elsewhere to the centre along a ramp when it is opened, and leaves it where it is after a
failed run. Other cards jump to the centre in both cases. Facts and sources: docs/reference/devices/nidaq.md.
"""

import logging
import math
import threading
from collections.abc import Callable
from contextlib import ExitStack
from fractions import Fraction
from typing import Annotated, Any, Literal, NoReturn, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from drivers.clock import Clock, SystemClock, now_s
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    LimitExceeded,
    ProtocolError,
)
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, ScanWaveform
from drivers.registry import Kind, Surroundings, config_of
from drivers.scanners.dac_scanner import PATIENCE_S, DacRun, DacScanner, PointSlice, PointSource
from drivers.scanners.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.scanners.nidaq_card import CALL_S, GRPC_PREFIX, NiCard
from drivers.transports.endpoints import EMULATED_PREFIX, resolve
from drivers.units import ExactHertz, Hertz, Seconds, Volts

_log = logging.getLogger(__name__)

_WRITE_S = 1.0
_POLL_S = 0.01
_MEASURED_V = 10.0
"""Outputs are measured from minus this to this voltage; none goes beyond."""
_LEAST_QUEUED = 64
"""Fewest samples queued in a run."""
_CENTRED = 0.005
"""Smaller differences of a measured drive count as none: 50 mV of 10 V, more than any card's error."""
_LINE = "port0/line"
_PATIENT = 0.6
"""Share of the buffer's duration that a call may take during a run."""
_NEVER = 2**30
"""Edges before a pulse that is not to come."""
_COUNTER_LEAD = 1
"""Points at rest before a waveform with counters, whose first edge comes 2 clocks after their start or later."""

_KEYS = {MARKER_LINE: "line_marker", MARKER_SCAN: "scan_marker", LEVEL_BACKWARD: "backward_marker"}

MarkerOutput = Annotated[str, Field(pattern=r"^(port0/line(\d|[12]\d|3[01])|ctr\d)$")]
"""Line or counter of the card, such as port0/line1 or ctr0."""
Terminal = Annotated[str, Field(pattern=r"^(/[\w-]+/)?[A-Za-z]\w*$")]
"""Terminal of the card, such as PFI0, or of another device, such as /Dev2/PFI0."""


class NidaqConfig(GalvoConfig):
    """Config of an NI card and of the galvo behind it. `axis` has no meaning here: `channel` is the mirror."""

    kind: Literal["nidaq"] = "nidaq"
    port: Annotated[str, Field(pattern=rf"^({EMULATED_PREFIX}.+|({GRPC_PREFIX}[^/=]+:\d+/)?[^/:=]+)$")]
    """Port: the card's name in NI MAX, such as "Dev1"; "grpc=HOST:PORT/Dev1" behind NI's gRPC device server; or
    "emulated:NAME"."""
    channel: Annotated[str, Field(pattern=r"^ao\d+$")] = "ao0"
    """Output that drives the mirror."""
    full_scale: Annotated[Volts, Field(gt=0, le=10)] = 10.0
    """Voltage at drive 1; at drive -1 it is the negative of that."""
    line_marker: MarkerOutput | None = "port0/line0"
    """Output of the line marker; null: not wired. port0/lineN: a line with a clock. ctrN: a counter, for cards without
    such lines; it can only make a marker that is periodic over the whole waveform."""
    scan_marker: MarkerOutput | None = "port0/line1"
    """Output of the scan marker, in the same form."""
    backward_marker: MarkerOutput | None = "port0/line2"
    """Output of the marker of the way back, in the same form."""
    counted_at: Terminal | None = None
    """Terminal at which counters see the sample clock; None: they take it inside the card."""
    clock: Terminal = "onboard"
    """Sample clock of waveforms: "onboard", or a terminal that gets one edge per point."""
    clock_rate: ExactHertz | None = None
    """Rate of an external clock, one rising edge per point. It is then the only point rate."""
    start: Terminal = "now"
    """Start of a waveform: "now", or a terminal whose rising edge starts it."""
    start_wait: Annotated[Seconds, Field(gt=0, le=3600)] = 60.0
    """Longest wait for the first point of a waveform with an external clock or start trigger."""
    clock_out: Terminal | None = None
    """Terminal to which waveforms send their sample clock."""
    start_out: Terminal | None = None
    """Terminal to which waveforms send their start trigger."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=1e6)] = 100_000.0
    """Most points per second; the card may allow less."""
    buffer: Annotated[Seconds, Field(ge=0.02, le=2)] = 0.2
    """Duration of the samples queued in host and card: the host may be late by as much, and a stop takes as long."""

    @model_validator(mode="after")
    def _check_wiring(self) -> Self:
        if self.axis != "x":
            raise ValueError(f"axis {self.axis} means nothing to an NI card; name the mirror's output by 'channel'")
        outputs = list(self.outputs.values())
        if len(set(outputs)) < len(outputs):
            raise ValueError(f"marker outputs {', '.join(outputs)} name one twice; give each its own, or null")
        if (self.clock == "onboard") != (self.clock_rate is None):
            raise ValueError(f"clock {self.clock} with clock_rate {self.clock_rate}; give a terminal and its rate")
        if self.clock_rate is not None and not LOWEST_RATE_HZ <= self.clock_rate <= self.max_point_rate:
            limits = f"{LOWEST_RATE_HZ:g} to {self.max_point_rate:g} Hz"
            raise ValueError(f"clock_rate {float(self.clock_rate):g} Hz is outside {limits}; divide the clock")
        used = [one for one in (self.clock, self.start, self.clock_out, self.start_out) if one]
        if len(set(used)) < len(used):
            raise ValueError(f"terminals {', '.join(used)} name one twice; give each signal its own")
        return self

    @property
    def outputs(self) -> dict[int, str]:
        """Name of the line or counter by marker bit, such as `MARKER_LINE`; markers that are not wired are left out."""
        return {bit: name for bit, key in _KEYS.items() if (name := getattr(self, key)) is not None}

    @property
    def lines(self) -> dict[int, int]:
        """Number of the line on port 0 by marker bit, for the markers that are lines."""
        return {bit: int(name[len(_LINE) :]) for bit, name in self.outputs.items() if name.startswith(_LINE)}

    @property
    def counters(self) -> dict[int, str]:
        """Name of the counter by marker bit, for the markers that are made by counters."""
        return {bit: name for bit, name in self.outputs.items() if not name.startswith(_LINE)}


class NidaqDac:
    """An NI card as a `Dac`. It has tasks only while something is set, written or measured; `release` ends those of a
    run."""

    def __init__(self, config: NidaqConfig, address: str, clock: Clock) -> None:
        """Look the card up. Moves nothing. Raises `LimitExceeded` if the config asks for more than the card can do, and
        what `NiCard` raises."""
        self.config, self.clock = config, clock
        self.card = NiCard(address)
        self.name = self.card.name
        self.mirror = f"{self.card.device}/{config.channel}"
        self.lines = ",".join(f"{self.card.device}/{_LINE}{line}" for line in config.lines.values())
        """The marker lines as NI-DAQmx takes them; empty: none."""
        self._clocks: dict[float, Fraction] = {}
        """Exact rate by requested rate: a rate that was returned once is returned again."""
        try:
            self._look_up()
        except BaseException as error:
            self.card.disconnect()
            if isinstance(error, DeviceDisconnected):
                raise DeviceNotFound(str(error)) from error
            raise

    def _look_up(self) -> None:
        config, has = self.config, self.card.properties
        with self.card.errors():
            self.serial: str | None = f"0x{has.serial_num:X}"
            self.identity = f"{has.product_type}, serial {self.serial}"
            self._simulated = has.is_simulated
            timed = self.card.property_of(lambda: has.ao_samp_clk_supported)
            ends = self.card.property_of(lambda: has.ao_voltage_rngs) or []
            mirror_hz = self.card.property_of(lambda: has.ao_max_rate) or 0.0
            lines_hz = self.card.property_of(lambda: has.do_max_rate) if self.lines else math.inf
        if not timed:
            self._refuse("no analogue output with a sample clock", "use another card")
        if not lines_hz:
            self._refuse("no digital lines with a sample clock", "make each marker a counter or null")
        ranges = list(zip(ends[::2], ends[1::2], strict=True))
        if not any(low <= -config.full_scale and config.full_scale <= high for low, high in ranges):
            offered = " or ".join(f"{low:g} to {high:g} V" for low, high in ranges)
            self._refuse(f"full_scale {config.full_scale:g} V is beyond its {offered}", "lower it")
        self.highest_rate_hz = min(config.max_point_rate, mirror_hz, lines_hz)
        if config.clock_rate is not None:
            clock_hz = float(config.clock_rate)
            if clock_hz > self.highest_rate_hz:
                self._refuse(f"clock_rate {clock_hz:g} Hz exceeds {self.highest_rate_hz:g} Hz", "divide the clock")
            self.highest_rate_hz = clock_hz

    def _refuse(self, what: str, advice: str) -> NoReturn:
        raise LimitExceeded(f"{self.name}: {self.identity}: {what}; {advice}")

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The nearest rate that the card makes by dividing its timebase, as it reads back; or the external clock's."""
        if self.config.clock_rate is not None:
            return self.config.clock_rate
        if requested_hz not in self._clocks:
            with self.card.errors(), self.card.task() as task:
                self.add_mirror(task)
                clock_hz = self.card.nearest_clock(task, requested_hz, low_hz, high_hz)
            self._clocks[requested_hz] = self._clocks[float(clock_hz)] = clock_hz
        return self._clocks[requested_hz]

    def run(self, source: PointSource, clock_hz: Fraction) -> "NidaqRun":
        """See `Dac`."""
        return NidaqRun(self, source, clock_hz)

    def check(self) -> None:
        """Ask the card for its level or, where that cannot be measured, NI-DAQmx for its serial number. Raises
        `DeviceError` if that fails."""
        if self.level() is None:
            with self.card.errors():
                _ = self.card.properties.serial_num

    def level(self) -> float | None:
        """The drive at the mirror's output, as the card measures it; None if the card cannot measure it, or cannot at
        present."""
        if self._simulated:  # NI's simulated cards measure a sine wave
            return None
        try:
            with self.card.errors(), self.card.task() as task:
                channel = f"{self.card.device}/_{self.config.channel}_vs_aognd"
                task.ai_channels.add_ai_voltage_chan(channel, min_val=-_MEASURED_V, max_val=_MEASURED_V)
                drive = float(task.read(timeout=CALL_S / 2)) / self.config.full_scale
        except (ProtocolError, DeviceNotFound, DeviceBusy):
            return None
        return min(max(drive, -1.0), 1.0)

    def halt(self) -> float:
        """End all tasks with the markers low. The mirror stays where it is if the card can measure where, else it jumps
        to the centre. Returns the mirror's drive."""
        self.release()
        drive = self.level()
        if drive is None or abs(drive) < _CENTRED:
            self._centre()
            return 0.0
        return drive

    def dark(self) -> None:
        """Write all marker lines low, and make the counters idle, which is low. Without this, an output whose task is
        cleared keeps its level."""
        if self.lines:
            with self.card.errors(), self.card.task() as task:
                self.add_lines(task)
                writer = self.card.writers.DigitalSingleChannelWriter(task.out_stream, auto_start=True)
                writer.write_many_sample_port_uint32(np.zeros(1, np.uint32), _WRITE_S)
        for name in self.config.counters.values():
            with self.card.errors(), self.card.task() as task:
                self.add_counter(task, name, _NEVER, 2, 2)
                task.start()

    def add_counter(self, task: Any, name: str, delay: int, low: int, high: int) -> None:
        """Add the counter `name` to a task. It waits for `delay` edges of the mirror's sample clock, then makes pulses
        that are high for `high` edges and low for `low` edges."""
        task.co_channels.add_co_pulse_chan_ticks(
            f"{self.card.device}/{name}",
            self.card.terminal(self.config.counted_at or "ao/SampleClock"),
            idle_state=self.card.const.Level.LOW,
            initial_delay=delay,
            low_ticks=low,
            high_ticks=high,
        )

    def add_mirror(self, task: Any) -> None:
        """Add the mirror's output to a task."""
        scale = self.config.full_scale
        task.ao_channels.add_ao_voltage_chan(self.mirror, min_val=-scale, max_val=scale)

    def add_lines(self, task: Any) -> None:
        """Add the marker lines to a task, as one channel whose bits are those of the port."""
        task.do_channels.add_do_chan(self.lines, line_grouping=self.card.const.LineGrouping.CHAN_FOR_ALL_LINES)

    def release(self) -> None:
        """End all tasks of a run but the mirror's, take the markers low, then end the mirror's. Without a run, only
        take the markers low. The mirror keeps its level."""
        with self.card.errors(), ExitStack() as steps:
            steps.callback(self.card.clear)
            steps.callback(self.dark)
            self.card.clear(keep=1)

    def close(self) -> None:
        """Take the markers low, put the mirror at the centre, and close the channel to the server."""
        try:
            self.release()
            self._centre()
        finally:
            self.card.disconnect()

    def _centre(self) -> None:
        with self.card.errors(), self.card.task() as task:
            self.add_mirror(task)
            writer = self.card.writers.AnalogSingleChannelWriter(task.out_stream, auto_start=True)
            writer.write_many_sample(np.zeros(1), _WRITE_S)


def pulse_train(high: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """The pulses that a counter has to make for a marker that is high at these points, bool (points,): begin of the
    first pulse, width and period, in points, and the number of pulses. None: the marker is never high.

    A counter makes equal pulses at equal distances, 2 points or more high and 2 or more low. Raises ValueError for a
    marker that needs others.
    """
    if not high.any():
        return None
    edges = np.flatnonzero(np.diff(high.astype(np.int8), prepend=0, append=0))
    begins, widths = edges[::2], edges[1::2] - edges[::2]
    periods = np.diff(begins, append=begins[0] + len(high))
    if np.ptp(periods) or np.ptp(widths) or widths[0] < 2 or periods[0] - widths[0] < 2:
        found = f"pulses of {widths.min()} to {widths.max()} points, {periods.min()} to {periods.max()} apart"
        raise ValueError(f"{found}; a counter makes equal ones, 2 points or more high and low")
    return int(begins[0]), int(widths[0]), int(periods[0]), len(begins)


class NidaqRun(DacRun):
    """One run: `begin`, then `feed`. No wait is longer than `start_wait` plus one second."""

    def __init__(self, dac: NidaqDac, source: PointSource, clock_hz: Fraction) -> None:
        self.source = source
        self._dac, self._card = dac, dac.card
        self._clock_hz = clock_hz
        self._plays = source.repeats > 0
        config = dac.config
        self._awaited = self._plays and (config.clock != "onboard" or config.start != "now")
        self._most = max(_LEAST_QUEUED, round(config.buffer * float(clock_hz)))
        self._sent = self._played = 0
        self._end: int | None = None
        """Number of samples up to the last point; copies of it follow. None: points are still to be sent."""
        if self._plays and config.counters:
            source.pad_start(_COUNTER_LEAD)

    def begin(self) -> None:
        """Make the tasks, fill their buffers and start them, the mirror's last."""
        with self._card.errors():
            self._begin()

    def feed(self, stopping: threading.Event) -> None:
        """Send all remaining points; returns when the mirror rests. Brakes once another thread sets `stopping`."""
        # A call that is later than this leaves too little time to take the gate low before the points run dry.
        with self._card.errors(), self._card.patient(_PATIENT * self._dac.config.buffer):
            self._feed(stopping)
        self._dac.release()

    def give_up(self) -> None:
        """End the tasks. An error is only logged: the one that ended the run is the one to report."""
        try:
            self._dac.release()
        except DeviceError as error:
            _log.error("%s: markers may be high: %s", self._dac.name, error)

    def _begin(self) -> None:
        dac, card, config = self._dac, self._card, self._dac.config
        self._mirror = card.new_task()
        dac.add_mirror(self._mirror)
        source = card.terminal(config.clock) if self._plays and config.clock != "onboard" else ""
        actual_hz = card.tune(self._mirror, self._clock_hz, source, 2 * self._most)
        if self._plays and actual_hz != self._clock_hz:
            raise DeviceFault(f"{dac.name}: runs at {actual_hz} Hz, not {self._clock_hz} Hz; choose another point rate")
        self._tasks = [self._mirror]
        self._writers = [self._mirror_writer()]
        if self._plays and dac.lines:
            # Not for a way to rest: NI-DAQmx is known to refuse buffers in which all lines are low.
            lines = card.new_task()
            dac.add_lines(lines)
            card.tune(lines, self._clock_hz, card.terminal("ao/SampleClock"), 2 * self._most)
            self._tasks.insert(0, lines)
            self._writers.insert(0, self._line_writer(lines))
        for task in self._tasks:
            task.out_stream.regen_mode = card.const.RegenerationMode.DONT_ALLOW_REGENERATION
            task.out_stream.output_buf_size = 2 * self._most
        self._uncounted = len(self._tasks)
        if self._plays:
            self._wire()
        self._send(self._most)
        for task in self._tasks:
            task.start()
        self._heard_s = now_s(dac.clock)

    def _mirror_writer(self) -> Callable[[PointSlice], None]:
        writer = self._card.writers.AnalogSingleChannelWriter(self._mirror.out_stream, auto_start=False)
        scale = self._dac.config.full_scale
        return lambda points: writer.write_many_sample(points.command * scale, _WRITE_S)

    def _line_writer(self, task: Any) -> Callable[[PointSlice], None]:
        writer = self._card.writers.DigitalSingleChannelWriter(task.out_stream, auto_start=False)

        def write(points: PointSlice) -> None:
            words = np.zeros(len(points), np.uint32)
            for bit, line in self._dac.config.lines.items():
                words |= ((points.markers & bit) != 0).astype(np.uint32) << np.uint32(line)
            writer.write_many_sample_port_uint32(words, _WRITE_S)

        return write

    def _wire(self) -> None:
        """Set start trigger and exports of the mirror's task, and put the counters' tasks before it."""
        card, config, signal = self._card, self._dac.config, self._card.const.Signal
        if config.start != "now":
            self._mirror.triggers.start_trigger.cfg_dig_edge_start_trig(card.terminal(config.start))
        for what, where in ((signal.SAMPLE_CLOCK, config.clock_out), (signal.START_TRIGGER, config.start_out)):
            if where is not None:
                self._mirror.export_signals.export_signal(what, card.terminal(where))
        for bit, name in config.counters.items():
            if train := pulse_train((self.source.waveform.markers & bit) != 0):
                self._tasks.insert(0, self._counter(name, *train))

    def _counter(self, name: str, first: int, width: int, period: int, number: int) -> Any:
        """A task that makes a marker by counting the mirror's sample clock."""
        card = self._card
        task = card.new_task()
        # Point i begins with clock i + 1.
        self._dac.add_counter(task, name, _COUNTER_LEAD + first + 1, period - width, width)
        if (pulses := number * self.source.repeats) > 1:
            task.timing.cfg_implicit_timing(card.const.AcquisitionType.FINITE, samps_per_chan=pulses)
        return task

    def _send(self, room: int) -> None:
        """Append `room` samples: points as long as there are any, then copies of the last one."""
        if room <= 0:
            return
        points = self.source.take(room)
        copies = room - len(points)
        padded = PointSlice(
            np.append(points.command, np.full(copies, self.source.last)),
            np.append(points.markers, np.zeros(copies, np.uint8)),
            np.append(points.lit, np.zeros(copies, bool)),
        )
        for write in self._writers:
            write(padded)
        self._sent += room
        if self._end is None and not self.source.left:
            self._end = self._sent - copies

    def _feed(self, stopping: threading.Event) -> None:
        stopped = False
        while self._end is None or self._played < self._end:
            self._ask()
            if stopping.is_set() and not stopped:
                stopped = True
                self._card.clear(keep=self._uncounted)
                if self._awaited and not self._played:  # neither clock nor trigger has come
                    self.source.give_back()
                    self.source.stop()
                    self._mirror.stop()
                    drive = self._dac.level()
                    if drive is not None and abs(drive - self.source.last) > _CENTRED:  # they came just now
                        self.source.last = drive
                    return
                self.source.stop()
            self._send(self._most - (self._sent - self._played))
            self._dac.clock.sleep(_POLL_S)
        self._mirror.stop()

    def _ask(self) -> None:
        """Ask how many samples were generated. Raises `DeviceFault` if their number stands still for too long."""
        config, asked_s = self._dac.config, now_s(self._dac.clock)
        played = int(self._mirror.out_stream.total_samp_per_chan_generated)
        if played != self._played:
            self._played, self._heard_s = played, asked_s
        waits = self._awaited and not played
        if asked_s - self._heard_s > (config.start_wait if waits else PATIENCE_S):
            what = f"no first point within {config.start_wait:g} s" if waits else f"stands still after {played} points"
            raise DeviceFault(
                f"{self._dac.name}: {what}; check that clock ({config.clock}) and start ({config.start}) arrive"
            )


class Nidaq(DacScanner):
    """A galvo behind an NI card."""

    @classmethod
    def open(
        cls,
        port: str,
        *,
        max_velocity_per_s: float,
        max_acceleration_per_s2: float,
        full_scale_v: float = 10.0,
        max_point_rate_hz: float = 100_000.0,
        buffer_s: float = 0.2,
        host_clock: Clock | None = None,
        **settings: Any,
    ) -> "Nidaq":
        """Open an NI card by itself. Commands are drives from -1 to 1, so the galvo's limits are in drive per second
        and per second squared.

        port: as in `NidaqConfig`. full_scale_v: the voltage at drive 1. max_point_rate_hz, buffer_s: the most points
        per second; the duration of the samples queued ahead. settings: the other fields of `NidaqConfig`, such as
        channel, clock and start. host_clock: that of an emulator; None: the system's clock. Raises `LimitExceeded` for
        a setting that is not possible, and another `DeviceError` if the card cannot be opened.
        """
        config = config_of(
            NidaqConfig,
            port=port,
            max_velocity_per_s=max_velocity_per_s,
            max_acceleration_per_s2=max_acceleration_per_s2,
            full_scale_v=full_scale_v,
            max_point_rate_hz=max_point_rate_hz,
            buffer_s=buffer_s,
            **settings,
        )
        return cls(NidaqDac(config, port, host_clock or SystemClock()), config)

    def __init__(self, dac: NidaqDac, config: NidaqConfig) -> None:
        """Take over `dac`, which is closed with the scanner. Takes the markers low and the mirror to the centre."""
        super().__init__(dac, config)
        self._card, self._counters = dac.card, config.counters
        try:
            self._motion.position = dac.halt()
            if self._motion.position:
                self._go(0.0)
        except BaseException:
            self._forgotten.detach()
            dac.card.disconnect()
            raise

    def _make_safe(self) -> None:
        self._card.limit_waits()
        super()._make_safe()

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        for bit, name in self._counters.items():
            try:
                pulse_train((waveform.markers & bit) != 0)
            except ValueError as error:
                refused = f"{self.name}: {name} cannot make the {_KEYS[bit]}: {error}; give it a line, or null"
                raise LimitExceeded(refused) from None
        super()._do_load(waveform, repeats, clock_hz)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        self._go(float(self._loaded[0].command[0]))
        super()._do_start()


def create(config: NidaqConfig, surroundings: Surroundings) -> Nidaq:
    """Open the card at the config's port."""
    endpoint = resolve(config.port, surroundings.ports)
    return Nidaq(NidaqDac(config, endpoint.address, surroundings.clock), config)


KIND = Kind(config=NidaqConfig, create=create)
