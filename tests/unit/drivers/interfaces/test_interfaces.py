"""What the interfaces do for every driver, with drivers that misbehave as no simulated one does."""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import pytest

from drivers.errors import GONE, DeviceDisconnected, DeviceError, DeviceFault, DeviceTimeout, LimitExceeded, WrongState
from drivers.interfaces import (
    OUT_GATE,
    BurstMode,
    DeviceState,
    LaserLimits,
    LaserStatus,
    LineLaser,
    Pulse,
    SpadArray,
    SpadCounters,
    SpadInfo,
    SpadRequest,
    SpadTiming,
    StreamMode,
    SyncSource,
    SyncStatus,
    WindowTable,
)
from drivers.ring import BlockRing


class TroubledLaser(LineLaser):
    """A laser whose pause is for the test to spoil."""

    def __init__(self, pause_error: Exception | None) -> None:
        super().__init__("lamp")
        self.pause_error = pause_error
        self.calls: list[str] = []

    @property
    def limits(self) -> LaserLimits:
        return LaserLimits(0.001, 0.05)

    def _do_status(self) -> LaserStatus:
        return LaserStatus(False, False, True, None, True, False, "digital")

    def _do_arm(self, power_w: float) -> None:
        self.calls.append(f"arm {power_w}")

    def _do_pause(self) -> None:
        self.calls.append("pause")
        if self.pause_error is not None:
            raise self.pause_error

    def _do_disarm(self) -> None:
        self.calls.append("disarm")

    def _do_close(self) -> None:
        self.calls.append("close")


@pytest.mark.parametrize(
    "error", [None, DeviceFault("lamp: stuck"), DeviceDisconnected("lamp: unplugged"), DeviceTimeout("lamp: silent")]
)
def test_a_laser_is_paused_before_its_port_is_given_back_and_never_switched_off(
    error: DeviceError | None, caplog: pytest.LogCaptureFixture
) -> None:
    laser = TroubledLaser(pause_error=error)
    laser.arm(0.01)
    with pytest.raises(type(error)) if error else nullcontext():
        laser.pause()
    assert laser.state is (DeviceState.RUNNING if error else DeviceState.CONFIGURED)
    with pytest.raises(DeviceFault, match="stuck") if isinstance(error, DeviceFault) else nullcontext():
        laser.close()
    assert ("could not be left safe" in caplog.text) is isinstance(error, GONE)
    laser.close()
    assert laser.calls == ["arm 0.01", "pause", "pause", "close"]
    assert laser.state is DeviceState.CLOSED


class StuckSync(SyncSource):
    """A sync source whose gate output stays high."""

    stuck = OUT_GATE

    def __init__(self) -> None:
        super().__init__("box")
        self.aborts = 0

    @property
    def resolution_s(self) -> float:
        return 1e-8

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None: ...

    def _do_run(self) -> None: ...

    def _do_gate_low(self) -> None: ...

    def _do_abort(self) -> None:
        self.aborts += 1

    def _do_close(self) -> None: ...

    def _do_status(self) -> SyncStatus:
        return SyncStatus("running" if self._state is DeviceState.RUNNING else "stopped", self.stuck)


def test_an_output_that_reads_back_high_is_a_fault_also_when_the_port_is_given_back() -> None:
    sync = StuckSync()
    with pytest.raises(DeviceFault, match="box: outputs read back 0x2 after gate_low"):
        sync.gate_low()
    with pytest.raises(DeviceFault, match="box: outputs read back 0x2 after abort"):
        sync.abort()
    sync.stuck = 0x100  # an output nobody asked for
    sync.gate_low()
    with pytest.raises(DeviceFault, match="0x100 after abort"):
        sync.close()
    assert sync.aborts == 2
    assert sync.state is DeviceState.CLOSED


class ScriptedSpad(SpadArray):
    """A SPAD whose read-out the test decides. width: 128 for one that also streams half of its full frames."""

    def __init__(self, width: int = 64) -> None:
        super().__init__("cam")
        self.answers: list[bool | Exception | Callable[[], None]] = []
        self.stopped = 0
        stream = StreamMode(8e6) if width == 128 else None
        burst = BurstMode(100, 4e8)
        self._info = SpadInfo("m", "s", width, 8, 0, Fraction(100_000), burst, stream, 64, True, ("free",))

    @property
    def info(self) -> SpadInfo:
        return self._info

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        return SpadTiming(Fraction(10**8), 1000, 1000, 1024)

    def _do_start(self, n_frames: int | None) -> None: ...

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        if isinstance(answer, bool):
            return answer
        answer()
        return True

    def _do_stop(self) -> None:
        self.stopped += 1

    def _do_close(self) -> None: ...

    def _do_counters(self) -> SpadCounters:
        return SpadCounters(None, 0, None, None, None)


BURST = SpadRequest(Fraction(100_000), 1e-5, "burst", 10)


HALF = WindowTable(64, (np.array([0, 64], np.int32),))
STREAM = SpadRequest(Fraction(100_000), 1e-5, "stream", 10, HALF)


@pytest.mark.parametrize(
    ("request_", "wrong", "said"),
    [
        *((BURST, {"frame_rate_hz": Fraction(hz)}, "Hz is outside 0 to 100000 Hz") for hz in (2e5, 0, -1)),
        *(
            (BURST, {"exposure_s": seconds}, f"exposure {seconds:g} s is outside 0 to the frame period 1e-05 s")
            for seconds in (1.01e-5, 0.0, -1e-6, math.nan)
        ),
        (BURST, {"block_frames": 0}, "blocks of 0 frames"),
        (STREAM, {"window": None}, r"128 x 8 pixels a second are 14\.4 MB/s, the link carries 8\.0 MB/s; lower"),
        (STREAM, {"window": WindowTable(64, (np.array([128], np.int32),))}, "from pixel 128 on reaches beyond"),
        (STREAM, {"mode": "burst"}, "windows in mode 'burst'"),
    ],
)
def test_a_request_beyond_the_limits_is_refused_with_value_and_limit(
    request_: SpadRequest, wrong: dict[str, Any], said: str
) -> None:
    spad = ScriptedSpad(128)
    with pytest.raises(LimitExceeded, match=f"cam: .*{said}"):
        spad.configure(replace(request_, **wrong))
    assert spad.state is DeviceState.READY
    spad.configure(request_)


def test_a_burst_has_to_fit_the_memory_and_a_mode_to_be_there() -> None:
    spad = ScriptedSpad()
    spad.configure(replace(BURST, exposure_s=math.nextafter(BURST.exposure_s, 1)))  # its last bit was rounded up
    with pytest.raises(LimitExceeded, match="a burst of 101 frames exceeds the memory of 100 frames"):
        spad.start(101)
    with pytest.raises(LimitExceeded, match="endless frames exceeds the memory of 100"):
        spad.start(None)
    spad.start(100)
    with pytest.raises(LimitExceeded, match="mode 'stream' is not available; it can burst"):
        ScriptedSpad().configure(replace(BURST, mode="stream"))


def test_verbs_of_a_spad_out_of_order_are_refused_and_say_what_to_call() -> None:
    spad, ring = ScriptedSpad(), BlockRing(1, 1024)
    spad.stop()
    with pytest.raises(WrongState, match="configure"):
        spad.start(10)
    spad.configure(BURST)
    with pytest.raises(WrongState, match="start"):
        spad.fill(ring, 0.1)
    with pytest.raises(LimitExceeded, match="start of 0 frames"):
        spad.start(0)
    spad.start(10)
    for verb in (lambda: spad.configure(BURST), lambda: spad.start(10)):
        with pytest.raises(WrongState, match="stop"):
            verb()
    spad.stop()
    assert spad.state is DeviceState.CONFIGURED


def test_a_run_goes_on_after_an_error_until_it_is_stopped() -> None:
    spad, ring = ScriptedSpad(), BlockRing(1, 1024)
    spad.configure(BURST)
    spad.start(100)
    spad.answers = [True, DeviceDisconnected("cam: unplugged"), True]
    assert spad.fill(ring, 0.1)
    with pytest.raises(DeviceDisconnected):
        spad.fill(ring, 0.1)
    assert spad.fill(ring, 0.1)
    spad.stop()
    spad.stop()
    assert spad.stopped == 1
    assert not spad.fill(ring, 0.1)
    spad.configure(BURST)
    with pytest.raises(WrongState, match="call start first"):
        spad.fill(ring, 0.1)


def test_a_stop_that_comes_while_a_block_is_filled_and_a_close_end_the_run() -> None:
    for end in (ScriptedSpad.stop, ScriptedSpad.close):
        spad = ScriptedSpad()
        spad.configure(BURST)
        spad.start(100)
        spad.answers = [partial(end, spad)]
        assert not spad.fill(BlockRing(1, 1024), 0.1)
        assert spad.stopped == 1


def test_a_stop_by_another_thread_just_when_the_state_is_checked_ends_the_run() -> None:
    class StoppedMeanwhile(ScriptedSpad):
        def _require(self, verb: str, *allowed: DeviceState, first: str = "") -> None:
            if verb == "fill":
                self.stop()
            super()._require(verb, *allowed, first=first)

    spad = StoppedMeanwhile()
    spad.configure(BURST)
    spad.start(100)
    assert not spad.fill(BlockRing(1, 1024), 0.1)
