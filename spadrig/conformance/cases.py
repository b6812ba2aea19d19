"""The cases that conformance suites are given: a device that is open, and functions that observe it from outside.

A case says, for example, whether there is really light. The suites never believe the device alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from drivers.clock import Clock
from drivers.errors import WrongState
from drivers.frames import FrameBlock
from drivers.interfaces import (
    BeamScanner,
    Device,
    DeviceState,
    LineLaser,
    SpadArray,
    SpadCounters,
    SpadRequest,
    SpadTiming,
    SyncSource,
)
from drivers.ring import BlockRing

TIMEOUT_S = 60.0
"""Longest wait for a block."""
N_FRAMES = 500
"""Frames of the run whose blocks the suite of SPADs looks at."""


def require_final(device: Device, *verbs: Callable[[], object]) -> None:
    """Leave the device's `with` block by an error; assert that this closed the device for good: every verb raises
    WrongState."""
    with pytest.raises(RuntimeError, match="on the way"), device as entered:  # noqa: PT012
        assert entered is device
        raise RuntimeError("on the way")
    device.close()
    assert device.state is DeviceState.CLOSED
    for verb in (*verbs, device.__enter__):
        with pytest.raises(WrongState, match="close"):
            verb()


@dataclass(frozen=True)
class SpadCase:
    """A SPAD array that is open, and a request that it can fulfil for a few thousand frames.

    Frames should be small, so that the suite is quick.
    """

    device: SpadArray
    request: SpadRequest


@dataclass(frozen=True)
class Taken:
    """A run of a SPAD array that is over: its blocks, all still in the ring, and the counters after it."""

    case: SpadCase
    timing: SpadTiming
    ring: BlockRing
    blocks: list[FrameBlock]
    counters: SpadCounters


def run(case: SpadCase, timing: SpadTiming, n_frames: int) -> tuple[BlockRing, list[FrameBlock]]:
    """Run a SPAD array to its end; returns the ring and the blocks in it.

    The ring has room for all of them, however short the device makes its blocks after a loss.
    """
    ring = BlockRing(2 * n_frames // case.request.block_frames + n_frames // 8, timing.stride)
    reader = ring.reader("test")
    case.device.start(n_frames)
    while case.device.fill(ring, TIMEOUT_S):
        assert case.device.state is DeviceState.RUNNING
    ring.finish()
    return ring, list(reader)


def take(case: SpadCase) -> Taken:
    """Configure a SPAD array and run it to its end."""
    timing = case.device.configure(case.request)
    ring, blocks = run(case, timing, N_FRAMES)
    return Taken(case, timing, ring, blocks, case.device.counters)


@dataclass(frozen=True)
class ScannerCase:
    """A scanner, open. `turning` tells whether the mirror really moves, even after the device was closed. `let_pass`
    lets a number of seconds pass for it."""

    device: BeamScanner
    turning: Callable[[], bool]
    let_pass: Callable[[float], None]


@dataclass(frozen=True)
class LaserCase:
    """A laser, open and off. `shining` tells whether it would shine through an open gate, even after close."""

    device: LineLaser
    clock: Clock
    shining: Callable[[], bool]


@dataclass(frozen=True)
class SyncCase:
    """A sync source that is open.

    trigger: sends one scan marker to its input. pins: reads its outputs, even after it is closed. waiting: state in its
    status while a program waits. plays: whether its outputs follow the program; those of a stand-in always stay low.
    step_s: time of a step of the program, much longer than the delays of the wire, so that the suite can see each step.
    """

    device: SyncSource
    clock: Clock
    trigger: Callable[[], None]
    pins: Callable[[], int]
    waiting: str = "waiting"
    plays: bool = True
    step_s: float = 0.01
