"""The sync source: plays a program of output levels that opens the laser's gate once per sweep."""

import logging
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal

from drivers.errors import DeviceFault, LimitExceeded
from drivers.interfaces.device import OPEN_STATES, Device, DeviceState, whole_number

_log = logging.getLogger(__name__)

OUT_FRAME = 1
"""Output that triggers the SPAD array."""
OUT_GATE = 2
"""Output that lets laser light out."""
OUT_MARKER = 4
"""Output that sets a mark in the SPAD's frame records."""
HOLD_S = 0.5e-3
"""Longest time by which a held pulse (`Pulse.held`) outlasts the scan marker. A galvo takes about as long to stop."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """One word of a program: levels of the outputs (OR of `OUT_*`), and their duration.

    duration_s: seconds. None: the word lasts as long as the scan marker is low, so that it waits for a sweep.
    held: the gate stays high only while the scan marker is high, which the source checks at least every `HOLD_S`
    seconds. If a scanner stops, is unplugged or loses its program, the light therefore goes off even if nobody else has
    noticed.
    """

    outputs: int
    duration_s: float | None
    held: bool = False


def slices(duration_s: float) -> int:
    """Number of equal parts of a held pulse, each of which begins only while the scan marker is high."""
    return max(1, math.ceil(duration_s / HOLD_S - 1e-9))


def sliced(pulses: Sequence[Pulse]) -> list[Pulse]:
    """The pulses as a source plays them: each held pulse is split into equal parts (`slices`), with a wait for the scan
    marker before each part."""
    played: list[Pulse] = []
    for pulse in pulses:
        if not pulse.held or pulse.duration_s is None:
            played.append(pulse)
            continue
        n = slices(pulse.duration_s)
        wait, part = Pulse(pulse.outputs & ~OUT_GATE, None), Pulse(pulse.outputs, pulse.duration_s / n)
        waits_already = bool(played) and played[-1].duration_s is None
        played += ([wait, part] * n)[waits_already:]
    return played


@dataclass(frozen=True, slots=True)
class SyncStatus:
    """The device's report on itself at the time when `status` was read."""

    state: Literal["stopped", "waiting", "running", "aborted"]
    """State of the program. A device that cannot tell whether its program waits for the scan marker says "running"."""
    outputs: int | None
    """Levels read back from the pins; None: this device cannot read them while a program runs."""


class SyncSource(Device):
    """A digital pattern generator. Use: `program`, `run`, then the program's end with all outputs low, or `abort`."""

    @property
    @abstractmethod
    def resolution_s(self) -> float:
        """Time step of the device in seconds: durations are rounded to multiples of it."""

    def most_repeats(self, pulses: Sequence[Pulse]) -> int | None:
        """Largest number of times that one program can repeat `pulses`; None if there is no limit."""
        return None

    @property
    def status(self) -> SyncStatus:
        """The device's status, asked anew each time. Raises `WrongState` after close, and another `DeviceError` if the
        device does not answer. May be called from any thread."""
        self._require("status", *OPEN_STATES)
        return self._do_status()

    def program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        """Load `pulses`, to be played `repeats` times, after which all outputs go low. Nothing is played before `run`.

        Raises `LimitExceeded` for a word that waits with the gate high (it would burn one spot for as long as the
        scanner rests), other outputs than `OUT_*`, a duration below half the resolution or infinite, no pulses or
        repeats at all, or a program that is too long for the device.
        """
        self._note_end()
        self._require("program", DeviceState.READY, DeviceState.CONFIGURED, first="abort")
        repeats = whole_number(self._name, "repeats", repeats)
        self._check(pulses, repeats)
        self._do_program(pulses, repeats)
        self._state = DeviceState.CONFIGURED
        _log.info("%s: program of %d words, %d times", self._name, len(pulses), repeats)

    def run(self) -> None:
        """Begin to play the program from its first word; does not wait for its end. Raises `WrongState` if no program
        is loaded or one is being played."""
        self._note_end()
        self._require("run", DeviceState.CONFIGURED, first="program" if self._state is DeviceState.READY else "abort")
        _log.info("%s: run", self._name)
        self._do_run()
        self._state = DeviceState.RUNNING

    def gate_low(self) -> None:
        """Take the gate low until the next `run`. Allowed until `close` and from any thread. Raises `DeviceFault` if it
        reads back high or cannot be read.
        """
        self._require("gate_low", *OPEN_STATES)
        _log.info("%s: gate low", self._name)
        self._do_gate_low()
        self._check_low(OUT_GATE, "gate_low")

    def abort(self) -> None:
        """Take all outputs low; the program stays loaded. Allowed until `close` and from any thread. Raises
        `DeviceFault` if an output reads back high or they cannot be read.
        """
        self._require("abort", *OPEN_STATES)
        _log.info("%s: abort", self._name)
        self._do_abort()
        if self._state is DeviceState.RUNNING:
            self._state = DeviceState.CONFIGURED
        self._check_low(~0, "abort")

    def _note_end(self) -> None:
        """Update the state if a program has ended by itself. Called where the state matters."""
        if self._state is DeviceState.RUNNING and self._do_status().state in ("stopped", "aborted"):
            self._state = DeviceState.CONFIGURED

    def _check_low(self, outputs: int, verb: str) -> None:
        read = self._do_status().outputs
        if read is None:
            raise DeviceFault(f"{self._name}: still runs a program after {verb}; turn the laser off by its key")
        high = read & outputs
        if high:
            raise DeviceFault(
                f"{self._name}: outputs read back 0x{high:x} after {verb}, not low; turn the laser off by its key"
            )

    def _check(self, pulses: Sequence[Pulse], repeats: int) -> None:
        if not pulses:
            raise LimitExceeded(f"{self._name}: a program of 0 words; give at least 1")
        if repeats < 1:
            raise LimitExceeded(f"{self._name}: {repeats} repeats; give at least 1")
        for index, pulse in enumerate(pulses):
            where = f"{self._name}: word {index}"
            if not isinstance(pulse, Pulse):
                raise LimitExceeded(f"{where} is {pulse!r}; give a Pulse")
            outputs = whole_number(self._name, f"outputs of word {index}", pulse.outputs)
            if not 0 <= outputs <= OUT_FRAME | OUT_GATE | OUT_MARKER:
                raise LimitExceeded(f"{where} sets outputs 0x{outputs:x}; outputs are 0x0 to 0x7")
            if pulse.duration_s is None:
                if pulse.outputs & OUT_GATE:
                    raise LimitExceeded(f"{where} waits with the gate high (0x{pulse.outputs:x}); clear OUT_GATE 0x2")
            elif not isinstance(pulse.duration_s, Real):
                raise LimitExceeded(f"{where} lasts {pulse.duration_s!r}; give a number of seconds")
            elif not math.isfinite(pulse.duration_s):
                raise LimitExceeded(f"{where} lasts {pulse.duration_s:g} s; give a time, or None to wait for a sweep")
            elif pulse.duration_s < self.resolution_s / 2:
                raise LimitExceeded(
                    f"{where} lasts {pulse.duration_s:g} s, under the resolution {self.resolution_s:g} s; lengthen it"
                )

    def _make_safe(self) -> None:
        self.abort()

    @abstractmethod
    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None: ...

    @abstractmethod
    def _do_run(self) -> None: ...

    @abstractmethod
    def _do_gate_low(self) -> None: ...

    @abstractmethod
    def _do_abort(self) -> None: ...

    @abstractmethod
    def _do_status(self) -> SyncStatus: ...
