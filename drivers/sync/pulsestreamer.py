"""Pulse Streamer 8/2 of Swabian Instruments: eight outputs, 1 ns steps, a trigger input, JSON-RPC over the network.

Facts: docs/reference/devices/pulsestreamer.md. Outputs: unless the config says otherwise, channel 0 triggers the SPAD,
channel 1 is the laser's gate, channel 2 marks records. The vendor's package `pulsestreamer` is not used: it takes no
port, waits 10 s for an answer, prints, and obeys the environment's web proxies.

**Waits.** The box cannot wait within a sequence. It waits for a rising edge of its trigger input before one, plays it,
and ignores edges meanwhile. So a program may wait for the scan marker only where it begins and where it repeats, and
the words after each wait must be the same. Other programs, such as blanking patterns, are refused.

**Repeats.** After a sequence the box arms itself again, for ever. A program of one sweep, or without waits, is played
without that, so the box itself ends it. For more sweeps a thread counts them by asking whether the box plays, and takes
the outputs low after the last one. It never counts too many, so no sweep stays dark. It may count too few if computer
or network are late; then the gate goes on opening at each scan marker until the count is full, the markers cease or
`abort` is called. If the box does not answer for `silence`, `port_lost` tells the guard, which ends the laser's light.

**Held pulses** (`Pulse.held`). Once triggered, the box does not look at the scan marker again, so if the mirror stops,
the light stays on until the sequence ends. Therefore a held pulse must end within `HOLD_S` of the marker's edge, unless
the config says `hold: external`: a logic chip (AND) between box and laser lets the gate through only while the scan
marker is high. The driver cannot see this chip; docs/how-to/devices.md says how to wire and try it.

**Outputs cannot be read back.** They are reported as 0 when the box has confirmed `constant` with all low, has no
hardware trigger armed, and says that it plays nothing; and as None otherwise.
"""

import logging
import re
import threading
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from drivers.clock import Clock, now_s
from drivers.errors import (
    GONE,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    ProtocolError,
    WrongState,
)
from drivers.interfaces import Pulse, SyncStatus
from drivers.interfaces.device import OPEN_STATES
from drivers.registry import Kind, Surroundings, alone, config_of
from drivers.sync.board import BoardConfig, OutputPins, SyncBoard
from drivers.sync.pulsestreamer_rpc import CALL_S, JsonRpc
from drivers.sync.pulsestreamer_sequence import (
    IDLE_POLL_S,
    RESOLUTION_S,
    GateSequence,
    SweepCount,
    compile_sequence,
)
from drivers.transports.endpoints import one_line, resolve
from drivers.units import Seconds

_log = logging.getLogger(__name__)

OLDEST_FIRMWARE = (1, 2, 0)
"""Oldest firmware that is accepted: its client has all methods that are used here."""
LOW: Final = (0, 0, 0, 0)
"""State with all outputs low, as `constant` takes it: duration (none), channels, two analog outputs."""
SOFTWARE, RISING = 1, 2
"""Starts of a sequence (`setTrigger`): by `startNow`, or at a rising edge of the trigger input."""
AUTO, MANUAL = 0, 1
"""Rearming (`setTrigger`): AUTO arms the trigger again after each sequence, MANUAL does not."""
CHECK_S = 0.2
"""Time after which a box that waits for the scan marker is asked whether it still does: a restart loses its program."""
CLOSE_S = 0.3
"""Deadline for each of the at most three calls to a box that does not answer when it is closed."""
CLOCKS = {"internal": 0, "external-125MHz": 1, "external-10MHz": 2}

_DARK = compile_sequence("dark", [Pulse(0, 248e-9)], 1, OutputPins(), external_hold=False).encoded
"""A dark sequence of 248 ns. Read in the other byte order it lasts 4.2 s."""
_PROBE_S, _PROBE_PAUSE_S = 1.0, 0.01


@dataclass(frozen=True, slots=True)
class _Run:
    """A program that was started. waits: as in `GateSequence`. count: None if the box itself ends it. aborts: how often
    outputs were taken low before. over: set once it has ended or been aborted."""

    waits: bool
    count: SweepCount | None
    aborts: int
    over: threading.Event = field(default_factory=threading.Event)

    def pause_s(self, now_s: float) -> float:
        """Time until the box is to be asked again."""
        return IDLE_POLL_S if self.count is None else self.count.pause_s(now_s)


class PulseStreamerConfig(BoardConfig):
    """Config of a Pulse Streamer 8/2."""

    kind: Literal["pulsestreamer"] = "pulsestreamer"
    port: Annotated[
        str, Field(description="address on the network: host or host:port", examples=["192.168.1.10"], min_length=1)
    ]
    clock: Annotated[
        Literal["internal", "external-125MHz", "external-10MHz"],
        Field(description="clock of the box: its own, or the one at its clock input"),
    ] = "internal"
    hold: Annotated[
        Literal["none", "external"],
        Field(description="external: a logic chip lets the gate through only while the scan marker is high"),
    ] = "none"
    silence: Annotated[
        Seconds,
        Field(ge=0.1, le=4, description="longest silence of the box while a program runs", examples=["300 ms"]),
    ] = 0.3
    frame_output: Annotated[int, Field(ge=0, le=7, description="output that triggers the SPAD: 0 to 7")] = 0
    gate_output: Annotated[int, Field(ge=0, le=7, description="output that is the laser's gate")] = 1
    marker_output: Annotated[int, Field(ge=0, le=7, description="output that marks the SPAD's records")] = 2


class PulseStreamer(SyncBoard):
    """A Pulse Streamer 8/2. Opening it first takes all outputs low, whatever the box was doing, and resets it.

    The box obeys everybody on its network: keep other programs away from it. A program of several sweeps is ended by
    this computer. If nobody closes the device, its outputs are taken low when the object is deleted or Python ends. If
    the process is killed, the box opens the gate at every scan marker until a program opens the box again.
    """

    def __init__(self, config: PulseStreamerConfig, surroundings: Surroundings, call_s: float = CALL_S) -> None:
        """call_s: longest wait for an answer, in seconds. Raises `DeviceNotFound` if the box does not answer, and
        another `DeviceError` if it cannot be used."""
        super().__init__("Pulse Streamer")
        self._config, self._clock = config, surroundings.clock
        self._rpc = JsonRpc(self.name, resolve(config.port, surroundings.ports).address, surroundings.tap, call_s)
        self._lock = threading.RLock()
        self._sequence: GateSequence | None = None
        self._run: _Run | None = None
        self._safe = False
        """Whether the box has confirmed that all is low and that no trigger can change it."""
        self._aborts = 0
        self._ended: Literal["stopped", "aborted"] = "stopped"
        self._lost = False
        # The connection is one call long: there is nothing to release.
        self._watch_for_end(partial(_lower_box, self._rpc), lambda: None)
        try:
            self._rpc.call("constant", LOW)
        except GONE as error:
            raise DeviceNotFound(str(error)) from None
        self._rpc.call("reset")  # ends what else a program may have left: a square wave, a trigger
        self._lower()
        self._firmware = self._check_firmware()
        self._serial = one_line(self._rpc.call("getSerial"))
        self._rpc.call("selectClock", CLOCKS[config.clock])
        self._check_clock()
        self._check_timing()

    @classmethod
    def open(
        cls, port: str, *, silence_s: float = 0.3, surroundings: Surroundings | None = None, **settings: Any
    ) -> "PulseStreamer":
        """Open a box by itself, without a config file.

        port, settings (clock, hold, frame_output, gate_output, marker_output): as in `PulseStreamerConfig`. silence_s:
        the longest silence of the box while a program runs. surroundings: clock, tap and emulated ports; None: the
        system's clock and real ports only. Raises `LimitExceeded` for a setting that is not possible, and another
        `DeviceError` if the box cannot be opened.
        """
        config = config_of(PulseStreamerConfig, port=port, silence_s=silence_s, **settings)
        return cls(config, surroundings or alone())

    def ask(self, method: str, *params: Any) -> Any:
        """Call a method of the box, such as `ask("getTemperature")`, and return its result. Nothing is checked: a
        method such as `constant` can raise the gate. Raises `DeviceError` if no answer comes."""
        self._require("ask", *OPEN_STATES)
        if not method.startswith(("get", "has", "is")):
            self._may_play.set()
            self._safe = False
        return self._rpc.call(method, *params)

    @property
    def identity(self) -> str:
        """Serial number, firmware and clock."""
        return f"Pulse Streamer 8/2 {self._serial}, firmware {self._firmware}, clock {self._config.clock}"

    @property
    def serial(self) -> str:
        """The serial number that the box states."""
        return self._serial

    @property
    def resolution_s(self) -> float:
        """1e-9 s. The box lengthens a sequence to a multiple of 8 ns by holding its last levels, and samples its
        trigger every 8 ns: a sweep begins 61 to 69 ns after the scan marker."""
        return RESOLUTION_S

    @property
    def port_lost(self) -> bool:
        """Whether the box gave no answer for `silence`, or a wrong one, while a program ran. May be called from any
        thread."""
        return self._lost

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        external = self._config.hold == "external"
        sequence = compile_sequence(self.name, pulses, repeats, self._config.pins, external_hold=external)
        self._check_clock()
        self._sequence, self._ended = sequence, "stopped"

    def _do_run(self) -> None:
        sequence, aborts = self._sequence, self._aborts
        assert sequence is not None
        if (settles_in_s := self._rpc.settles_in_s) > 0:
            raise DeviceTimeout(
                f"{self.name} has not answered a call that it may still hear; run again in {settles_in_s:.1f} s"
            )
        once = sequence.sweeps == 1 or not sequence.waits
        start = RISING if sequence.waits else SOFTWARE

        def step(method: str, *params: Any) -> Any:
            self._require_no_abort(aborts)
            return self._rpc.call(method, *params)

        self._may_play.set()
        try:
            with self._lock:
                self._safe = False
                step("constant", (0, sequence.rest, 0, 0))
                step("setTrigger", start, MANUAL if once else AUTO)
                self._require_no_abort(aborts)
                self._check_trigger(start)  # a sequence for the trigger IMMEDIATE would start at once
                count = None if once else SweepCount(sequence.sweeps, sequence.duration_s, now_s(self._clock))
                runs, final = 1 if sequence.waits else sequence.sweeps, 0 if once else sequence.rest
                step("stream", sequence.encoded, runs, (0, final, 0, 0))
                if not sequence.waits:
                    step("startNow")
                self._run = run = _Run(sequence.waits, count, aborts)
                self._require_no_abort(aborts)
        except WrongState:
            self._lower()  # the thread that interrupted may have failed to
            raise
        watched = weakref.ref(self), run, self._clock
        threading.Thread(target=_watch, args=watched, name="Pulse Streamer", daemon=True).start()

    def _require_no_abort(self, aborts: int) -> None:
        if self._aborts != aborts:
            raise WrongState(f"{self.name}: run was interrupted by abort or gate_low; run it again")

    def _do_gate_low(self) -> None:
        self._lower()

    _do_abort = _do_gate_low

    def _do_status(self) -> SyncStatus:
        run = self._run
        if run is not None:
            asked_s = now_s(self._clock)
            plays = self._flag("isStreaming")
            # Once another thread takes the outputs low, the box no longer knows that the program has ended.
            if not self._has_ended(run, asked_s, plays) and self._aborts == run.aborts:
                return self._not_ended(run, plays)
        with self._lock:  # another thread may just be taking the outputs low
            plays, run = self._flag("isStreaming"), self._run
            if plays or run is not None:  # the outputs could not be taken low
                return self._not_ended(run, plays)
            return SyncStatus(self._ended, 0 if self._safe else None)

    @staticmethod
    def _not_ended(run: _Run | None, plays: bool) -> SyncStatus:
        return SyncStatus("running" if plays else "waiting" if run is not None and run.waits else "aborted", None)

    def _make_safe(self) -> None:
        self._rpc.call_s = min(self._rpc.call_s, CLOSE_S)
        super()._make_safe()

    def _do_close(self) -> None:
        if self._run is not None:
            self._run.over.set()
        self._forgotten.detach()
        self._end()  # once more, if the outputs could not be taken low

    def _lower(self, ended: Literal["stopped", "aborted"] = "aborted") -> None:
        """Take all outputs low at once, whatever other threads do, and disarm the trigger. A `run` under way gives up.
        ended: state that `status` then reports for a program that was started."""
        self._aborts += 1
        try:
            self._rpc.call("constant", LOW)
        except DeviceTimeout:
            self._rpc.call("constant", LOW)
        with self._lock:
            self._safe = False
            _replace_program(self._rpc)
            if self._run is not None:  # only now: until then the thread that watches it has to try again
                self._run.over.set()
                self._run, self._ended = None, ended
            self._may_play.clear()
            self._safe = True

    def _has_ended(self, run: _Run, asked_s: float, plays: bool, ask: Callable[[str], Any] | None = None) -> bool:
        """Whether a program has ended, by the box's answer; if so, take the outputs low. May raise `DeviceError`. ask:
        as in `_flag`."""
        if run.count is not None:
            ended = run.count.take(asked_s, now_s(self._clock), plays)
        else:
            ended = not plays and self._flag("hasFinished", ask)
            if not (plays or ended or run.waits) and self._aborts == run.aborts:
                raise DeviceFault(f"{self.name}: its program is gone: it has restarted, or another program uses it")
        if ended:
            with self._lock:
                if self._run is run:
                    self._lower("stopped")
        return ended or run.over.is_set()

    def _look(self, run: _Run, checked_s: float) -> float | None:
        """Ask whether a program plays, and count. On an error set `port_lost` and try to take the outputs low.

        checked_s: time when the trigger was last looked at; returns it for the next call, or None after an error.
        """
        ask = partial(self._rpc.ask, silence_s=self._config.silence)
        try:
            asked_s = now_s(self._clock)
            plays = self._flag("isStreaming", ask)
            ended = self._has_ended(run, asked_s, plays, ask)
            if run.waits and not (ended or plays) and asked_s > checked_s + CHECK_S:
                self._check_trigger(RISING, ask)
                checked_s = asked_s
        except Exception as error:
            with self._lock:  # another thread may just be taking the outputs low
                ended = run.over.is_set() or not self._may_play.is_set()
            if not ended:
                advice = "the gate may open at every scan marker, turn the laser off by its key"
                _log.error("%s: while a program runs: %s; %s", self.name, error, advice)
                self._lost = True
                self._try_to_lower()
            return None
        return checked_s

    def _try_to_lower(self) -> None:
        """Take the outputs low, unless the box cannot be reached."""
        with suppress(DeviceError):
            self._lower()

    def _check_trigger(self, wanted: int, ask: Callable[[str], Any] | None = None) -> None:
        found = (ask or self._rpc.call)("getTriggerStart")
        if found != wanted:
            raise DeviceFault(
                f"{self.name}: its trigger is {found!r}, not {wanted}: it has restarted, or another program uses it; "
                "end that program and open it again"
            )

    def _flag(self, method: str, ask: Callable[[str], Any] | None = None) -> bool:
        """A yes or no of the box, which says true, false, 1 or 0. ask: calls the method; None: with the usual
        deadline."""
        value = (ask or self._rpc.call)(method)
        if value not in (0, 1):
            raise ProtocolError(f"{self.name} answers {method} with {value!r}, neither yes nor no; report it")
        return bool(value)

    def _check_firmware(self) -> str:
        """The firmware's version; raises `ProtocolError` if it is too old."""
        version = one_line(self._rpc.call("getFirmwareVersion"))
        numbers = re.match(r"(\d{1,9})\.(\d{1,9})\.(\d{1,9})(?!\d)", version, re.ASCII)
        if numbers is None:
            raise ProtocolError(f"{self.name}: no version in {version!r}; is this a Pulse Streamer 8/2?")
        if tuple(map(int, numbers.groups())) < OLDEST_FIRMWARE:
            oldest = ".".join(map(str, OLDEST_FIRMWARE))
            raise ProtocolError(f"{self.name}: firmware {version} is older than {oldest}; install a newer one")
        return version

    def _check_clock(self) -> None:
        found, wanted = self._rpc.call("getClock"), CLOCKS[self._config.clock]
        if found != wanted:
            raise DeviceFault(
                f"{self.name}: its clock is {found!r}, not {wanted} ({self._config.clock}); check the clock at its "
                "input and 'clock', then open it again"
            )

    def _check_timing(self) -> None:
        """Play a dark sequence: it shows whether the box reads durations as they are meant (clients have sent them in
        both byte orders), waits for its start, and reports its end."""
        self._rpc.call("stream", _DARK, 1, LOW)
        waits = not self._flag("isStreaming") and not self._flag("hasFinished")
        self._rpc.call("startNow")
        ends_s = now_s(self._clock) + _PROBE_S
        while not (ended := self._flag("hasFinished")) and now_s(self._clock) < ends_s:
            self._clock.sleep(_PROBE_PAUSE_S)
        self._lower()
        if not (waits and ended):
            what = f"did not end within {_PROBE_S:g} s" if waits else "did not wait for its start"
            raise ProtocolError(
                f"{self.name}: a dark test of 248 ns {what}; check the clock at its input and 'clock', power-cycle "
                f"it, or report it with firmware {self._firmware}"
            )


def _watch(device: "weakref.ref[PulseStreamer]", run: _Run, clock: Clock) -> None:
    """Count the sweeps of a program until it is over or the device is deleted, which takes the outputs low."""
    checked_s: float | None = now_s(clock)
    while not run.over.wait(CHECK_S if checked_s is None else run.pause_s(now_s(clock))):
        box = device()
        if box is None:
            return
        if checked_s is None:
            box._try_to_lower()  # the box goes on by itself, and the network may have come back
        else:
            checked_s = box._look(run, checked_s)
        del box


def _replace_program(rpc: JsonRpc) -> None:
    """Disarm the box, after which all outputs are low and stay so."""
    rpc.call("setTrigger", SOFTWARE, MANUAL)
    rpc.call("constant", LOW)  # again: until now a trigger may have started what was armed
    # In place of the program, which some firmware may keep: whatever call of an interrupted or failed `run` the box
    # takes up only after this, it has nothing else to play. Last, as it would freeze a high gate.
    rpc.call("stream", _DARK, 1, LOW)


def _lower_box(rpc: JsonRpc) -> None:
    """Take the outputs of a box low whose driver is gone, and disarm it."""
    rpc.call("constant", LOW)
    _replace_program(rpc)


KIND = Kind(config=PulseStreamerConfig, create=PulseStreamer)
