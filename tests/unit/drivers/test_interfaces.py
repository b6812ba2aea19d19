"""What the interfaces do for every driver, with drivers that misbehave as no simulated one does."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from drivers.errors import DeviceDisconnected, DeviceFault, InterlockOpen, LimitExceeded, WrongState
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

DARK = LaserStatus(False, False, True, None, True, False, "digital")


class TroubledLaser(LineLaser):
    """A laser whose status and pause are for the test to spoil."""

    def __init__(self, status: LaserStatus = DARK, pause_error: Exception | None = None) -> None:
        super().__init__("lamp")
        self.status_now = status
        self.pause_error = pause_error
        self.calls: list[str] = []

    @property
    def limits(self) -> LaserLimits:
        return LaserLimits(0.001, 0.05)

    def _do_status(self) -> LaserStatus:
        return self.status_now

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


def test_an_open_interlock_keeps_the_laser_off() -> None:
    laser = TroubledLaser(replace(DARK, interlock_closed=False))
    with pytest.raises(InterlockOpen, match="lamp: the interlock is open; close it"):
        laser.arm(0.01)
    assert laser.calls == []
    assert laser.state is DeviceState.READY


def test_a_fault_keeps_the_laser_off_and_is_told() -> None:
    laser = TroubledLaser(replace(DARK, fault="diode too hot"))
    with pytest.raises(DeviceFault, match="lamp: fault diode too hot; clear it"):
        laser.arm(0.01)
    assert laser.calls == []


def test_a_laser_is_paused_before_its_port_is_given_back_and_never_switched_off() -> None:
    laser = TroubledLaser()
    laser.arm(0.01)
    laser.close()
    assert laser.calls == ["arm 0.01", "pause", "close"]


def test_a_port_is_given_back_and_the_failure_told_where_the_pause_fails() -> None:
    laser = TroubledLaser(pause_error=DeviceDisconnected("lamp: unplugged"))
    with pytest.raises(DeviceDisconnected, match="unplugged"):
        laser.close()
    assert laser.calls == ["pause", "close"]
    assert laser.state is DeviceState.CLOSED
    laser.close()
    assert laser.calls == ["pause", "close"]


def test_a_failed_pause_is_not_taken_for_a_pause() -> None:
    laser = TroubledLaser(pause_error=DeviceDisconnected("lamp: unplugged"))
    laser.arm(0.01)
    with pytest.raises(DeviceDisconnected):
        laser.pause()
    assert laser.state is DeviceState.RUNNING


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


def test_an_output_that_reads_back_high_is_a_fault() -> None:
    sync = StuckSync()
    with pytest.raises(DeviceFault, match="box: outputs read back 0x2 after gate_low"):
        sync.gate_low()
    with pytest.raises(DeviceFault, match="box: outputs read back 0x2 after abort"):
        sync.abort()
    sync.stuck = 0x100  # an output nobody asked for
    sync.gate_low()
    with pytest.raises(DeviceFault, match="0x100 after abort"):
        sync.abort()


def test_a_sync_source_is_aborted_before_its_port_is_given_back() -> None:
    sync = StuckSync()
    with pytest.raises(DeviceFault, match="after abort"):
        sync.close()
    assert sync.aborts == 1
    assert sync.state is DeviceState.CLOSED


class SmallMemorySpad(SpadArray):
    """A SPAD that only bursts, and whose read-out the test decides."""

    def __init__(self) -> None:
        super().__init__("cam")
        self.answers: list[bool | Exception | Callable[[], None]] = []
        self.stopped = 0

    @property
    def info(self) -> SpadInfo:
        burst = BurstMode(100, 4e8)
        return SpadInfo("m", "s", 64, 8, 0, Fraction(100_000), burst, None, 64, True, ("free",))

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


def test_a_burst_has_to_fit_the_memory() -> None:
    spad = SmallMemorySpad()
    spad.configure(BURST)
    with pytest.raises(LimitExceeded, match="a burst of 101 frames exceeds the memory of 100 frames"):
        spad.start(101)
    with pytest.raises(LimitExceeded, match="endless frames exceeds the memory of 100"):
        spad.start(None)
    spad.start(100)
    with pytest.raises(LimitExceeded, match="mode 'stream' is not available; it can burst"):
        SmallMemorySpad().configure(replace(BURST, mode="stream"))


class StreamingSpad(SmallMemorySpad):
    """A SPAD whose link carries half of its full frames."""

    @property
    def info(self) -> SpadInfo:
        return SpadInfo("m", "s", 128, 8, 0, Fraction(100_000), BurstMode(100, 4e8), LINK, 64, True, ("free",))


LINK = StreamMode(8e6)
STREAM = SpadRequest(Fraction(100_000), 1e-5, "stream", 10)
HALF = WindowTable(64, (np.array([0, 64], np.int32),))


def test_a_stream_that_the_link_cannot_carry_is_refused_with_both_rates() -> None:
    with pytest.raises(
        LimitExceeded, match=r"128 x 8 pixels a second are 14\.4 MB/s, the link carries 8\.0 MB/s; lower"
    ):
        StreamingSpad().configure(STREAM)
    StreamingSpad().configure(replace(STREAM, window=HALF))
    StreamingSpad().configure(replace(STREAM, frame_rate_hz=Fraction(50_000)))


def test_windows_off_the_grid_or_in_a_burst_are_refused_under_the_name_of_the_device() -> None:
    spad = StreamingSpad()
    with pytest.raises(LimitExceeded, match="cam: a window of 64 pixels from pixel 128 on reaches beyond"):
        spad.configure(replace(STREAM, window=WindowTable(64, (np.array([128], np.int32),))))
    with pytest.raises(LimitExceeded, match="cam: windows in mode 'burst'"):
        spad.configure(replace(STREAM, mode="burst", window=HALF))
    assert spad.state is DeviceState.READY


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        *(({"frame_rate_hz": Fraction(hz)}, f"rate {float(hz):g} Hz is outside 0 to 100000 Hz") for hz in (2e5, 0, -1)),
        *(
            ({"exposure_s": seconds}, f"exposure {seconds:g} s is outside 0 to the frame period 1e-05 s")
            for seconds in (1.01e-5, 0.0, -1e-6, math.nan)
        ),
        ({"block_frames": 0}, "blocks of 0 frames"),
    ],
)
def test_a_request_beyond_the_limits_is_refused_with_value_and_limit(wrong: dict[str, Any], said: str) -> None:
    spad = SmallMemorySpad()
    with pytest.raises(LimitExceeded, match=f"cam: .*{said}"):
        spad.configure(replace(BURST, **wrong))
    assert spad.state is DeviceState.READY


def test_verbs_of_a_spad_out_of_order_are_refused_and_say_what_to_call() -> None:
    spad, ring = SmallMemorySpad(), BlockRing(1, 1024)
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
    spad, ring = SmallMemorySpad(), BlockRing(1, 1024)
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


def test_a_stop_that_comes_while_a_block_is_filled_ends_the_run() -> None:
    spad = SmallMemorySpad()
    spad.configure(BURST)
    spad.start(100)
    spad.answers = [spad.stop]
    assert not spad.fill(BlockRing(1, 1024), 0.1)


def test_an_exposure_of_one_period_is_taken_though_its_last_bit_was_rounded_up() -> None:
    SmallMemorySpad().configure(replace(BURST, exposure_s=math.nextafter(BURST.exposure_s, 1)))
    with pytest.raises(LimitExceeded, match="exposure"):
        SmallMemorySpad().configure(replace(BURST, exposure_s=1.0001e-5))


def test_close_stops_a_run() -> None:
    spad = SmallMemorySpad()
    spad.configure(BURST)
    spad.start(100)
    spad.close()
    assert spad.stopped == 1
