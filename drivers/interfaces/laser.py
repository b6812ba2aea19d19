"""The line laser. While it is armed and not paused, it emits whenever the gate is high."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real

from drivers.errors import DeviceError, DeviceFault, InterlockOpen, LimitExceeded
from drivers.interfaces.device import OPEN_STATES, Device, DeviceState

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LaserLimits:
    """Powers at which the laser may be armed: within the device's own range and the config's."""

    min_power_w: float
    max_power_w: float


@dataclass(frozen=True, slots=True)
class LaserStatus:
    """The laser's report on itself at the time when `status` was read."""

    emission: bool
    """The laser emits whenever the gate is high (light = emission AND gate). False while paused, or while it warms up
    after `arm`; True also if another program left it about to emit, and always if it is `LineLaser.gate_only`."""
    armed: bool
    """True from `arm` to `disarm`, pauses included."""
    interlock_closed: bool | None
    """Whether the interlock is closed. None: the laser does not say."""
    fault: str | None
    """The laser's faults in one line; None: it has none."""
    key_on: bool | None
    """Whether the laser's key is on. None: the laser has no key, or does not say."""
    warming_up: bool
    """The laser is not ready yet; its light may begin later by itself."""
    input_mode: str
    """Kind of input or mode that controls the light. It is "digital" if only the TTL gate does."""
    temperature_c: float | None = None
    """Temperature of the laser's base plate. None: the laser does not say."""
    power_w: float | None = None
    """Measured mean power, the gate's dark times included. None: the laser does not say."""


class LineLaser(Device):
    """A laser that a TTL gate modulates. `pause` ends a scan normally; `disarm` is for faults and for the end of work.

    READY = disarmed, RUNNING = armed, CONFIGURED = paused.
    """

    @property
    @abstractmethod
    def limits(self) -> LaserLimits:
        """Powers at which the laser may be armed."""

    @property
    def gate_only(self) -> bool:
        """Whether only the gate ends the laser's light: `pause`, `disarm` and `close` do not, since the laser is
        switched by hand."""
        return False

    @property
    def status(self) -> LaserStatus:
        """The laser's status, asked anew each time. Raises `WrongState` after close, and another `DeviceError` if the
        laser does not answer. May be called from any thread."""
        self._require("status", *OPEN_STATES)
        return self._do_status()

    def watch(
        self, on_silence: Callable[[DeviceError], object] | None, overloaded: Callable[[], bool] = lambda: False
    ) -> None:
        """Have `on_silence` called, on any thread, as soon as the laser answers a question later than it ever should
        and says nothing when asked once more. None ends the watch. The guard watches a laser while it is armed. Does
        nothing for a laser that cannot be asked.

        overloaded: whether this host has so much to do now that it may hold up an answer.
        """

    def check_alive(self) -> None:
        """Ask the laser the question that it answers fastest. If it is silent, calls the function given to `watch`,
        then raises `DeviceTimeout`. May be called from any thread. Does nothing for a laser that cannot be asked."""

    @property
    def changed(self) -> list[str]:
        """Commands that put back the settings of the laser that this driver has changed; `close` sends them."""
        return []

    def adopt(self, changed: Sequence[str]) -> None:
        """Take over the settings that another process has changed, so that `close` puts them back. changed: that
        process's `changed`."""

    def arm(self, power_w: float) -> None:
        """Set the power, in watts, and enable emission under the gate. Light may come later (`status.warming_up`).

        Raises `LimitExceeded`, `InterlockOpen` or `DeviceFault` before anything is enabled. If the laser then fails to
        obey, raises `DeviceError` and tries to leave it dark.
        """
        self._require("arm", *OPEN_STATES)
        if not isinstance(power_w, Real):
            raise LimitExceeded(f"{self._name}: power is {power_w!r}; give a number of watts")
        limits = self.limits
        if not limits.min_power_w <= power_w <= limits.max_power_w:
            raise LimitExceeded(
                f"{self._name}: power {power_w:g} W is outside {limits.min_power_w:g} to {limits.max_power_w:g} W; "
                "choose a power within the limits"
            )
        self._check_health()
        _log.info("%s: arm at %g W", self._name, power_w)
        self._do_arm(power_w)
        self._state = DeviceState.RUNNING

    def pause(self) -> None:
        """Stop emission in a way that needs no key to resume. Allowed until `close`, even if the laser is not armed. If
        the laser is `gate_only`, its light does not change.

        May be called from any thread, even while another one arms: the interrupted `arm` then leaves the laser dark.
        """
        self._require("pause", *OPEN_STATES)
        _log.info("%s: pause", self._name)
        self._do_pause()
        if self._state is DeviceState.RUNNING:
            self._state = DeviceState.CONFIGURED

    def disarm(self) -> None:
        """Switch emission off. The laser may need its key turned before it arms again. Allowed until `close` and from
        any thread. If the laser is `gate_only`, its light is not switched off."""
        self._require("disarm", *OPEN_STATES)
        _log.info("%s: disarm", self._name)
        self._do_disarm()
        self._state = DeviceState.READY

    def _make_safe(self) -> None:
        self.pause()

    def _check_health(self) -> None:
        """Refuse a laser that must not be enabled. May raise `InterlockOpen`, `DeviceFault`."""
        status = self._do_status()
        if status.interlock_closed is False:
            raise InterlockOpen(f"{self._name}: the interlock is open; close it and arm again")
        if status.fault is not None:
            raise DeviceFault(f"{self._name}: fault {status.fault}; clear it at the laser and arm again")

    @abstractmethod
    def _do_status(self) -> LaserStatus: ...

    @abstractmethod
    def _do_arm(self, power_w: float) -> None: ...

    @abstractmethod
    def _do_pause(self) -> None:
        """Stop emission. Must work in any state, also if the laser already emitted when it was opened."""

    @abstractmethod
    def _do_disarm(self) -> None: ...
