"""What a conformance suite needs of an implementation besides the device: time to pass, and a look from outside."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from drivers.clock import Clock
from drivers.errors import WrongState
from drivers.interfaces import BeamScanner, Device, DeviceState, LineLaser, SpadArray, SpadRequest, SyncSource, World


def require_final(device: Device, *verbs: Callable[[], object]) -> None:
    """Assert that closing is final: no verb is possible any more, and closing again does nothing."""
    device.close()
    device.close()
    assert device.state is DeviceState.CLOSED
    for verb in (*verbs, device.__enter__):
        with pytest.raises(WrongState, match="close"):
            verb()


def leave_with_an_error(device: Device, work: Callable[[], object]) -> None:
    """Work within the device's block and fail there; assert that the error comes through and the device is closed."""

    def fail() -> None:
        with device as entered:
            assert entered is device
            work()
            raise RuntimeError("on the way")

    with pytest.raises(RuntimeError, match="on the way"):
        fail()
    assert device.state is DeviceState.CLOSED


@dataclass(frozen=True)
class SpadCase:
    """A SPAD array, open, and a request it can fulfil for a few thousand frames; small enough to be quick."""

    device: SpadArray
    request: SpadRequest


@dataclass(frozen=True)
class ScannerCase:
    """A scanner, open. `turning` tells whether the mirror really moves, also after the device was closed. `let_pass`
    lets so many seconds pass for it."""

    device: BeamScanner
    turning: Callable[[], bool]
    let_pass: Callable[[float], None]


@dataclass(frozen=True)
class LaserCase:
    """A laser, open and off. `shining` tells whether it would shine through an open gate, also after close."""

    device: LineLaser
    clock: Clock
    shining: Callable[[], bool]


@dataclass(frozen=True)
class SyncCase:
    """A sync source, open. `trigger` gives its input one scan marker; `pins` reads the outputs, also after close.

    tells_waiting: its status tells a program that waits from one that plays. plays: its outputs follow the program; of
    a stand-in they are low for good.
    """

    device: SyncSource
    clock: Clock
    trigger: Callable[[], None]
    pins: Callable[[], int]
    tells_waiting: bool = True
    plays: bool = True

    @property
    def waiting(self) -> str:
        """The state that it tells while a program waits."""
        return "waiting" if self.tells_waiting else "running"


@dataclass(frozen=True)
class WorldCase:
    """A world and the size of its camera."""

    world: World
    rows: int
    width: int
