"""The common part of all lasers on a serial line: a config with limits, opening, the check of the serial number, a port
that may get lost, and an end of the light if a program forgets an armed laser.

`PlainLaser` is a line laser without key or warm-up, whose emission follows `arm` and `pause` at once. Simulated and
recorded lasers use it.
"""

import logging
import os
import re
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, TypeVar

from pydantic import Field

from drivers.errors import (
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    InterlockOpen,
    LimitExceeded,
    NoAnswer,
    ProtocolError,
    WrongState,
)
from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.interfaces.device import OPEN_STATES
from drivers.interfaces.forgotten import watch_for_end
from drivers.registry import KindConfig, Surroundings
from drivers.transports.dialogue import Dialogue, Framing, LineTiming, OnSilence
from drivers.transports.endpoints import EMULATED_PREFIX, printable, resolve
from drivers.transports.serial_device import SerialDevice
from drivers.transports.serial_port import BAUD, SerialPort
from drivers.units import Seconds, Watts


class SerialLaserConfig(KindConfig):
    """Config fields that every kind of serial laser has."""

    port: str
    """Serial port: a path or COM port, "serial=..." or "usb=VVVV:PPPP" of its USB device, or "emulated:NAME"."""
    max_power: Annotated[Watts, Field(gt=0)]
    """Most power, in watts, that this rig may ever send out. If the laser's own maximum is smaller, that holds."""
    serial_number: str | None = None
    """Serial number of the laser; any other laser is refused. None: any laser will do."""
    baud: Annotated[int, Field(ge=9600, le=921_600)] = BAUD
    """Bits per second of the port, where the laser or the adapter before it is set to another rate than usual."""
    silence: Annotated[Seconds, Field(ge=0.05, le=2)] = 0.15
    """Longest time without an answer to a question of the guard, while the laser is armed. Then the guard asks once
    more, and 0.1 s later it switches the light off. A laser emulated at a port `emulated:` has 1.5 s."""


EMULATED_SILENCE_S = 1.5
"""That time for an emulated laser, which shares this computer's processors and may itself be late."""

_log = logging.getLogger(__name__)

_ANY = re.compile(".*")


class _Left:
    """Things left to do if a laser is deleted without a close. This does not refer to the laser itself."""

    def __init__(self) -> None:
        self.may_shine = False
        self.put_back: list[str] = []
        """Commands that put back settings which the driver has changed."""


OFF_TIMES = 3
"""Number of times that the bytes that switch off are sent: the first may end a command that was cut short, and the
second may come too soon after a reply to be heard."""


def _end(name: str, line: Dialogue, off: bytes, left: _Left, process: int) -> None:
    """Close the port of a laser that is closed or deleted; first switch it off by the bytes `off` if it may shine, and
    put its settings back. Only logs errors. process: number of the laser's process; in another one, which was forked
    from it, nothing is done."""
    if os.getpid() != process:
        return
    try:
        if left.may_shine:
            line.port.write_again(off, OFF_TIMES)
            _log.warning("%s: was left armed; it was told to switch off", name)
        for command in left.put_back:
            line.port.write_again(line.encode(command), 1)
    except DeviceError as error:
        trouble = "was left armed and may shine, turn its key off"
        if not left.may_shine:
            trouble = "its settings could not be put back"
        _log.error("%s: %s (%s)", name, trouble, error)
    line.port.close()


class SerialLaser(SerialDevice, LineLaser):
    """A laser on a serial line."""

    _line: Dialogue
    silence_s = SerialLaserConfig.model_fields["silence"].default
    """`SerialLaserConfig.silence`, in seconds."""

    def __init__(self, name: str, line: Dialogue, limits: LaserLimits) -> None:
        super().__init__(printable(name))
        line.name = self.name
        self._line = line
        self._limits = limits
        self._armed = False
        self._left = _Left()
        self._forgotten: weakref.finalize[..., object] | None = None
        self._stopped = False
        """Whether pause or disarm was called since arm began, which other threads may do."""

    def arm(self, power_w: float) -> None:
        """See `LineLaser`. Raises `WrongState` if a pause or disarm from another thread ended the arming."""
        self._stopped = False
        before, self._left.may_shine = self._left.may_shine, True
        try:
            super().arm(power_w)
        except (LimitExceeded, InterlockOpen, WrongState):
            self._left.may_shine = before or self._stopped
            raise

    def pause(self) -> None:
        """See `LineLaser`. Ends an `arm` that is under way on another thread."""
        self._stopped = True
        super().pause()
        self._note_dark()

    def disarm(self) -> None:
        """See `LineLaser`. Ends an `arm` that is under way on another thread."""
        self._stopped = True
        super().disarm()
        self._note_dark()

    def _note_dark(self) -> None:
        if self._stopped:  # else another thread has begun to arm
            self._left.may_shine = False

    def ask(self, command: str) -> str:
        """Send a raw command and return the laser's reply, even if it is a refusal.

        Nothing is checked: such a command can make light. It is sent up to three times if no reply comes; then
        `DeviceError` is raised.
        """
        self._require("ask", *OPEN_STATES)
        if not self._line.asks(command):
            self._left.may_shine = True
        return self._line.ask(command, _ANY)

    def send(self, command: str) -> None:
        """See `SerialDevice`."""
        self._left.may_shine = True
        super().send(command)

    def watch(self, on_silence: OnSilence | None, overloaded: Callable[[], bool] = lambda: False) -> None:
        """See `LineLaser`."""
        self._line.watch(on_silence, self.silence_s, overloaded)

    def check_alive(self) -> None:
        """See `LineLaser`."""
        self._require("check_alive", *OPEN_STATES)
        self._line.check_alive()

    @property
    def changed(self) -> list[str]:
        """See `LineLaser`."""
        return list(self._left.put_back)

    def adopt(self, changed: Sequence[str]) -> None:
        """See `LineLaser`."""
        self._left.put_back = list(dict.fromkeys([*self._left.put_back, *changed]))

    def _require_no_stop(self) -> None:
        """Raise `WrongState` if a pause or disarm has come while arming: the laser must then stay dark."""
        if self._stopped:
            raise WrongState(f"{self._name}: arm was ended by a pause; arm again")

    @property
    def limits(self) -> LaserLimits:
        """Powers from the laser's least power to the smaller of its own maximum and the config's `max_power`."""
        return self._limits

    def watch_for_end(self, off: bytes) -> None:
        """Have the laser told to switch off if it may shine and this object is deleted, or Python ends in the normal
        way, before `close`; also if `close` could not pause it. Settings are then put back, too. A failure is only
        logged. off: bytes that switch the laser off in any state."""
        self._end = partial(_end, self.name, self._line, off, self._left, os.getpid())
        self._forgotten = watch_for_end(self, self._end)

    def _make_safe(self) -> None:
        # A laser that cannot be paused keeps its settings: some of them keep it dark at its next power-up.
        put_back, self._left.put_back = self._left.put_back, []
        super()._make_safe()
        for command in put_back:
            with suppress(DeviceError):  # the laser is off, and that is what a close is for
                self._put_back(command)

    def _put_back(self, command: str) -> None:
        """Send one of the commands of `changed` to a laser that is off."""
        self._line.tell(command)

    def _do_close(self) -> None:
        if self._forgotten is not None and self._forgotten.detach() is not None:
            self._end()
        self._line.port.close()


_Laser = TypeVar("_Laser", bound=SerialLaser)


def open_laser(
    make: str,
    config: SerialLaserConfig,
    surroundings: Surroundings,
    framing: Framing,
    timing: LineTiming,
    identify: Callable[[Dialogue], _Laser],
    off: bytes,
    prepare: Callable[[SerialPort], None] | None = None,
    undo: Callable[[SerialPort], None] | None = None,
) -> _Laser:
    """Open the port, synchronise with the laser and identify it; returns the laser. Closes the port again if any step
    fails.

    make: name of the make in messages. off: bytes that switch the laser off in any state. prepare: called with the open
    port first, for a laser whose replies may have another form than `framing` reads. undo: puts back what `prepare` has
    changed; called if opening fails. identify: identifies the laser over the dialogue and returns it.
    Raises `DeviceNotFound` if nothing of that make answers, and what `SerialPort`, `prepare` and `identify` raise.
    """
    port = SerialPort(f"{make} laser", resolve(config.port, surroundings.ports), surroundings.tap, config.baud)
    try:
        if prepare is not None:
            prepare(port)
        line = Dialogue(f"{make} laser", port, framing, surroundings.clock, timing)
        try:
            line.connect()
        except (DeviceTimeout, ProtocolError):
            raise NoAnswer(
                f"{make} laser: nothing on port {config.port} answers as one; check 'port', power and cable"
            ) from None
        laser = identify(line)
        laser.silence_s = EMULATED_SILENCE_S if config.port.startswith(EMULATED_PREFIX) else config.silence
        laser.watch_for_end(off)
        return laser
    except BaseException:
        if undo is not None:
            with suppress(DeviceError):  # the first error is the one to report
                undo(port)
        port.close()
        raise


def require_serial_number(make: str, config: SerialLaserConfig, found: str) -> None:
    """Raise `DeviceNotFound` if the config names another serial number than `found`. make: name of the make in
    messages."""
    if config.serial_number not in (None, found):
        raise DeviceNotFound(
            f"{make} laser on {config.port} has serial number {printable(found)}, not {config.serial_number}; correct "
            "'serial_number' or 'port'"
        )


class PlainLaser(LineLaser):
    """A laser that takes any power up to `max_power_w`.

    emit: called with the power in watts that the laser emits while the gate is high, each time that this is set; 0
    while paused.
    """

    def __init__(self, name: str, max_power_w: float, emit: Callable[[float], None] | None = None) -> None:
        super().__init__(name)
        self._limits = LaserLimits(0.0, max_power_w)
        self._emit = emit
        self._armed = self._emission = False

    @property
    def limits(self) -> LaserLimits:
        """Powers from 0 W to `max_power_w`."""
        return self._limits

    def _do_status(self) -> LaserStatus:
        return LaserStatus(
            emission=self._emission,
            armed=self._armed,
            interlock_closed=True,
            fault=None,
            key_on=None,
            warming_up=False,
            input_mode="digital",
        )

    def _do_arm(self, power_w: float) -> None:
        self._armed = True
        self._set(power_w, emission=True)

    def _do_pause(self) -> None:
        self._set(0.0, emission=False)

    def _do_disarm(self) -> None:
        self._do_pause()
        self._armed = False

    def _do_close(self) -> None:
        self._do_disarm()

    def _set(self, power_w: float, *, emission: bool) -> None:
        self._emission = emission
        if self._emit is not None:
            self._emit(power_w)
