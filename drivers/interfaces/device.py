"""The base of all devices: a name, a state, methods that check the state, and a close that leaves the device safe."""

import logging
import operator
from abc import ABC, abstractmethod
from enum import Enum
from typing import Self

from drivers.errors import GONE, DeviceError, LimitExceeded, WrongState

_log = logging.getLogger(__name__)


class DeviceState(Enum):
    """The states of a device.

    ::

                configure / load / program          start / run
        READY -----------------------------> CONFIGURED ------> RUNNING
                                                 ^                 |
                                                 +-----------------+
                                                  stop / abort / end
        any state -- close --> CLOSED, for good

    A laser goes READY -- arm --> RUNNING -- pause --> CONFIGURED -- arm --> RUNNING; `disarm` takes it to READY.
    """

    READY = "ready"
    CONFIGURED = "configured"
    RUNNING = "running"
    CLOSED = "closed"


OPEN_STATES = (DeviceState.READY, DeviceState.CONFIGURED, DeviceState.RUNNING)


class Device(ABC):
    """A device, open from its creation until `close` or the end of a `with` block.

    The public methods of the interfaces check state and arguments, log, and call hooks (`_do_*`). A driver implements
    the hooks and never touches the state. Methods must be called from one thread unless they say otherwise.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._state = DeviceState.READY

    @property
    def name(self) -> str:
        """The name of this device in messages."""
        return self._name

    @property
    def identity(self) -> str:
        """The device's name and what distinguishes it from others of its kind: model, serial number, firmware."""
        return self._name

    @property
    def serial(self) -> str | None:
        """The device's serial number, or else a permanent name stored in it; None if the driver knows neither."""
        return None

    @property
    def state(self) -> DeviceState:
        """The state that follows from the methods called so far. A run that ended by itself may not be noticed yet."""
        return self._state

    def close(self) -> None:
        """Leave the device safe (laser paused, gate low, mirror parked if it has moved) and release it.

        A second call does nothing. If the device was unplugged or does not answer, nothing can be done about it from
        here: that is logged, not raised, except for a device that the guard owns (`drivers.guard`). Any other failure
        to leave it safe is raised.
        """
        if self._state is DeviceState.CLOSED:
            return
        _log.info("%s: close", self._name)
        try:
            self._make_safe()
        except GONE as error:
            self._lost_at_close(error)
        finally:
            self._state = DeviceState.CLOSED
            self._do_close()

    def __enter__(self) -> Self:
        self._require("enter", *OPEN_STATES)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require(self, verb: str, *allowed: DeviceState, first: str = "") -> None:
        """Raise `WrongState` unless the state is one of `allowed`. first: the method that the message advises to call
        first.
        """
        if self._state in allowed:
            return
        if self._state is DeviceState.CLOSED:
            raise WrongState(f"{self._name}: {verb} after close; open the device again")
        hint = f"; call {first} first" if first else ""
        raise WrongState(f"{self._name}: {verb} is not possible while {self._state.value}{hint}")

    @abstractmethod
    def _make_safe(self) -> None:
        """End what still runs; called once by `close`, in any open state. Each interface implements it."""

    def _lost_at_close(self, error: DeviceError) -> None:
        """Log that the device is gone, so that `close` could not leave it safe. The guard's devices raise the error."""
        _log.error("%s: closed, but it could not be left safe: %s", self._name, error)

    @abstractmethod
    def _do_close(self) -> None:
        """Release handles and memory. Called even if making the device safe failed."""


def whole_number(device: str, name: str, value: object) -> int:
    """An argument that must be a whole number, as an int. Raises `LimitExceeded` for anything else, such as 2.5."""
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise LimitExceeded(f"{device}: {name} is {value!r}; give a whole number") from None
