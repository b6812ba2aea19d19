"""The Helios driver against the firmware model. Golden bytes and traps: hardware.md 3.1."""

import json
import logging
import re
import struct
import subprocess
import sys
import time
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from drivers.clock import SystemClock, VirtualClock
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
)
from drivers.helios_frames import encode, sendable, slice_points
from drivers.helios_link import HELIOS
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.point_source import Points
from drivers.transports.usb_device import open_device
from sim_backend.wire.helios import BLUE, COMMANDS, FRAMES, GREEN, INTENSITY, RED, REPLIES, HeliosModel
from sim_backend.wire.umockdev_server import UmockdevBus, missing
from sim_backend.wire.usb_backend import EmulatedUsb, Stall
from tests.wire.helios_over_libusb import PARK, REPEATS
from tests.wire.scanners import open_scanner, opened, plug

PATIENCE_S = 20.0
TOLERANCE_S = 1e-6


class Recorder(HeliosModel):
    """A Helios that notes what it was sent: (time, endpoint, data), and alternate settings as endpoint -1."""

    def __init__(self, clock: VirtualClock | None = None, late_frame: int = -1) -> None:
        super().__init__()
        self.log: list[tuple[float, int, bytes]] = []
        self._clock, self._late_frame = clock, late_frame

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        super().set_interface(interface, alternate, now_s)
        self.log.append((now_s, -1, bytes((alternate,))))

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._clock is not None and endpoint == FRAMES and len(self.frames()) == self._late_frame:
            self._late_frame = -1
            self._clock.sleep(0.2)  # the host was busy with something else
        taken = super().out(endpoint, data, now_s)
        if taken:
            self.log.append((now_s, endpoint, data))
        return taken

    def frames(self) -> list[bytes]:
        return [data for _, endpoint, data in self.log if endpoint == FRAMES]

    def commands(self) -> list[bytes]:
        return [data for _, endpoint, data in self.log if endpoint == COMMANDS]


def cosine(device: BeamScanner, points: int = 6000, rate_hz: float = 25_000.0) -> ScanWaveform:
    """A seamless wave with markers on 4 points of each line and of the scan."""
    clock = device.point_clock(rate_hz)
    at = np.arange(points)
    markers = np.zeros(points, np.uint8)
    markers[at % 100 < 4] |= MARKER_LINE
    markers[:4] |= MARKER_SCAN
    markers[at >= points // 2] |= LEVEL_BACKWARD
    return ScanWaveform(-0.5 * np.cos(2 * np.pi * at / points), markers, clock)


def finish(device: BeamScanner) -> None:
    """Wait for the end of a run whose own thread moves the virtual clock."""
    end = time.monotonic() + PATIENCE_S
    while device.status.moving:
        assert time.monotonic() < end, "the run does not end"
        time.sleep(0.001)


# Bytes


def test_a_frame_is_the_bytes_of_the_manual() -> None:
    points = Points(
        np.array([1.0, -1.0, 0.0]),
        np.array([MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD], np.uint8),
        np.array([True, True, False]),
    )
    along_x = encode(points, "x", 25001, 3)
    assert along_x.hex(" ") == "ff f8 00 ff ff 00 00 00 08 00 ff 00 ff 00 80 08 00 00 00 00 ff a9 61 03 00 03"
    along_y = encode(points, "y", 25001, 2)
    assert along_y.hex(" ") == "80 0f ff ff ff 00 00 80 00 00 ff 00 ff 00 80 08 00 00 00 00 ff a9 61 03 00 02"


@pytest.mark.parametrize(
    ("asked", "true"),
    [
        (20_000, Fraction(20_000)),
        (25_000, Fraction(25_000)),
        (40_000, Fraction(40_000)),
        (50_000, Fraction(50_000)),
        (30_000, Fraction(112_000_000, 3733)),
        (10_000, Fraction(112_000_000, 11_201)),
    ],
)
def test_the_point_clock_is_the_real_one_not_the_asked_one(asked: float, true: Fraction) -> None:
    with opened("helios", HeliosModel(), VirtualClock()) as (device, _):
        clock = device.point_clock(asked)
        assert abs(clock - asked) <= abs(true - asked)
        assert 112_000_000 % clock.numerator == 0 or (112_000_000 / clock).denominator == 1


def test_10_khz_is_unreachable() -> None:
    with opened("helios", HeliosModel(), VirtualClock()) as (device, _):
        assert device.point_clock(10_000) != 10_000


def test_the_exact_25_khz_is_asked_for_as_25001() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        wave = cosine(device)
        assert device.load(wave, 1) == 25_000
        device.start()
        finish(device)
        assert {struct.unpack("<H", frame[-5:-3])[0] for frame in model.frames()} == {25_001}


# Traps


def test_a_frame_of_45_mod_64_points_never_completes_in_the_firmware() -> None:
    clock = VirtualClock()
    model = HeliosModel()
    bus = EmulatedUsb(clock)
    bus.plug(model)
    with open_device(HELIOS, "usb", {0: 1}, bus) as link:
        for points, played in ((45, False), (109, False), (173, False), (44, True), (46, True)):
            model.set_interface(0, 1, clock.now_ns() / 1e9)
            model._received = b""
            before = model.played
            link.write(COMMANDS, b"\x03\x00", 0.1)
            assert link.read(REPLIES, 32, 0.1) == b"\x83\x01"
            link.write(FRAMES, bytes(7 * points) + struct.pack("<HHB", 25001, points, 3), 0.5)
            assert (model.played > before) == played


@pytest.mark.parametrize("points", [45, 109, 1499, 1500, 1501, 1502, 1545, 2989, 3001, 4500])
def test_no_frame_is_45_mod_64_points_long(points: int) -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        rate = device.point_clock(25_000)
        # Flat and at the centre, where the mirror stands: no way to the first point changes the length.
        device.load(ScanWaveform(np.zeros(points), np.zeros(points, np.uint8), rate), 1)
        device.start()
        finish(device)
        assert all(sendable(len(frame) // 7) for frame in model.frames())
        assert all(len(frame) % 64 for frame in model.frames())
        assert sum(len(frame) // 7 for frame in model.frames()) - points == (points in (45, 109))


def test_slices_are_sendable_and_only_the_last_is_short() -> None:
    for most in (1499, 1500, 4095, 100, 44):
        for total in range(2, 6 * most, 7 if most > 200 else 1):
            left, slices = total, []
            while left:
                if left <= most and not sendable(left):
                    assert not slices, "a rest that cannot be sent"
                    left += 1
                slices.append(slice_points(left, most))
                left -= slices[-1]
            assert all(sendable(n) and n <= most for n in slices)
            assert all(n >= most // 2 - 2 for n in slices[:-1])


def test_single_is_set_in_every_frame_and_start_in_the_first_of_a_run() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 2)
        device.start()
        finish(device)
        flags = [frame[-1] for frame in model.frames()]
        assert flags == [3] + [2] * (len(flags) - 1)
        assert len(flags) > 5


def test_a_dead_host_leaves_a_mirror_that_stands_after_two_frames() -> None:
    clock, model = VirtualClock(), Recorder()
    with opened("helios", model, clock) as (device, plugged):
        device.load(cosine(device), 10_000)
        device.start()
        model.deaf = True  # nothing that the host sends arrives any more
        end_s = plugged.now_s() + 0.2
        while plugged.now_s() < end_s:
            clock.sleep(0.01)
        assert not model.moving(plugged.now_s())
        model.deaf = False


def test_the_alternate_setting_is_1_while_open_and_0_after_close() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()):
        pass
    settings = [data[0] for _, endpoint, data in model.log if endpoint == -1]
    assert (settings[0], settings[-1]) == (1, 0)


def test_old_replies_are_drained_before_the_first_question() -> None:
    model = HeliosModel()
    enable = model.set_interface

    def with_leftovers(interface: int, alternate: int, now_s: float) -> None:
        enable(interface, alternate, now_s)
        for _ in range(3):
            model.leave_reply(b"\x84\x01\x00\x00\x00")

    model.set_interface = with_leftovers  # type: ignore[method-assign]
    with opened("helios", model, VirtualClock()) as (device, _):
        assert device.firmware == 6  # type: ignore[attr-defined]


@pytest.mark.parametrize("junk", [b"\x84\x06\x00\x00\x00", b"\x83", b"\x83\x02", b"\x00\x01", b"\x83\x01\x00"])
def test_any_other_reply_than_83_01_is_not_ready(junk: bytes) -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 1)
        model.leave_reply(junk)
        before = len(model.frames())
        device.start()
        finish(device)
        asked = [data for _, endpoint, data in model.log if endpoint in (COMMANDS, FRAMES)]
        first = asked.index(model.frames()[before])
        assert asked[first - 2 : first] == [b"\x03\x00"] * 2
        assert device.status.fault is None


def test_a_frame_that_the_device_drops_in_silence_is_a_fault() -> None:
    model = HeliosModel()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 100)
        model.drop_next = 1
        device.start()
        finish(device)
        fault = device.status.fault
        assert fault is not None
        assert "dropped a frame in silence" in fault


def test_frames_wait_150_ms_after_stop_since_the_firmware_refuses_them_for_100() -> None:
    clock = VirtualClock()
    model = Recorder(clock, late_frame=3)
    with opened("helios", model, clock) as (device, _):
        device.load(cosine(device), 100)
        device.start()
        finish(device)
        device.stop()
        device.start()
        finish_at = len(model.frames())
        device.stop()
        assert len(model.frames()) >= finish_at
        stops = [at for at, endpoint, data in model.log if (endpoint, data[:1]) == (COMMANDS, b"\x01")]
        after = next(at for at, endpoint, _ in model.log if endpoint == FRAMES and at > stops[0])
        assert after - stops[0] >= 0.15
        assert model.refused == 0


def test_the_shutter_is_never_opened_and_only_known_opcodes_are_sent() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 2)
        device.start()
        device.stop()
        device.park()
    assert {command[0] for command in model.commands()} <= {0x01, 0x02, 0x03, 0x04, 0x05, 0x07}
    assert all(command[1] == 0 for command in model.commands() if command[0] == 0x02)
    assert all(len(command) == 2 for command in model.commands())
    assert not model.shutter
    assert not model.bootloader


def test_close_stops_waits_lowers_the_shutter_and_leaves_alternate_0() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 1000)
        device.start()
    end = model.log[-3:]
    assert [(endpoint, data) for _, endpoint, data in end] == [
        (COMMANDS, b"\x01\x00"),
        (COMMANDS, b"\x02\x00"),
        (-1, b"\x00"),
    ]
    assert end[1][0] - end[0][0] >= 0.15


def test_close_waits_for_the_feeding_thread() -> None:
    model = Recorder()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 1000)
        device.start()
    enders = [
        index for index, (_, endpoint, data) in enumerate(model.log) if (endpoint, data) == (COMMANDS, b"\x01\x00")
    ]
    assert all(endpoint != FRAMES for _, endpoint, _ in model.log[enders[-1] :])


def test_giving_the_interface_back_stops_the_mirror_as_when_the_process_is_killed() -> None:
    clock, model = VirtualClock(), HeliosModel()
    plugged = plug(model, clock)
    device = open_scanner("helios", plugged.bus, clock)
    device.load(cosine(device), 10)
    device.start()
    for owner in list(plugged.attached._claims.values()):
        plugged.attached.close(owner)
    assert not model.moving(plugged.now_s())
    with pytest.raises(DeviceError):
        device.close()


@pytest.mark.parametrize("rate", [6, 999, 65_536, 1e6])
def test_rates_that_the_firmware_would_clamp_are_refused(rate: float) -> None:
    with (
        opened("helios", HeliosModel(), VirtualClock()) as (device, _),
        pytest.raises(LimitExceeded, match=re.escape(f"{rate:g}")),
    ):
        device.point_clock(rate)


# What comes out


def test_frames_follow_each_other_without_a_seam_and_markers_are_where_the_waveform_has_them() -> None:
    clock, model = VirtualClock(), HeliosModel()
    with opened("helios", model, clock) as (device, plugged):
        wave, repeats = cosine(device), 3
        device.load(wave, repeats)
        device.start()
        finish(device)
        history, period = model.history, 1 / 25_000
        (start,) = history.rising(RED, 0, plugged.now_s())
        lines = history.rising(GREEN, 0, plugged.now_s()) - start
        at = np.arange(60)[None, :] * 100 * period + np.arange(repeats)[:, None] * 6000 * period
        assert lines == pytest.approx(at.ravel(), abs=TOLERANCE_S)
        assert history.rising(BLUE, 0, 1e9) - start == pytest.approx(
            np.arange(repeats) * 6000 * period, abs=TOLERANCE_S
        )
        back = history.rising(INTENSITY, 0, 1e9) - start
        assert back == pytest.approx((np.arange(repeats) + 0.5) * 6000 * period, abs=TOLERANCE_S)
        times = start + (np.arange(repeats * 6000) + 0.5) * period
        assert history.command(times) == pytest.approx(np.tile(wave.command, repeats), abs=1.01 / 4095)


def test_nothing_shines_on_ramps_and_at_rest() -> None:
    clock, model = VirtualClock(), HeliosModel()
    with opened("helios", model, clock) as (device, plugged):
        device.load(cosine(device), 1)
        began = plugged.now_s()
        device.start()
        finish(device)
        device.park()
        lit = model.history.level(RED, np.linspace(began, plugged.now_s(), 100_000)) > 0
        times = np.linspace(began, plugged.now_s(), 100_000)[lit]
        assert times[-1] - times[0] == pytest.approx(6000 / 25_000, abs=1e-4)


def test_steps_and_accelerations_stay_within_the_limits_from_start_to_park() -> None:
    clock, model = VirtualClock(), Recorder()
    with opened("helios", model, clock) as (device, _):
        device.load(cosine(device, rate_hz=40_000.0), 1000)
        before = len(model.frames())
        device.start()
        time.sleep(0.02)
        device.stop()
        run = model.frames()[before:]
        limits = device.limits
        x = np.concatenate([decoded(frame) for frame in run])
        x = np.concatenate([[0.0, 0.0], x, [x[-1]]])
        noise = 2 / 4095  # one step of the converter on either side
        assert np.abs(np.diff(x)).max() <= limits.step
        turns = np.abs(np.diff(x, 2))
        assert turns.max() <= limits.acceleration_per_s2 / 40_000**2 + 2 * noise
        assert model.history.command(np.array([1e9]))[0] == pytest.approx(x[-1], abs=noise)


def decoded(frame: bytes) -> np.ndarray:
    raw = np.frombuffer(frame[:-5], np.uint8).reshape(-1, 7).astype(int)
    return (raw[:, 0] * 16 + raw[:, 1] // 16) / 4095 * 2 - 1


def test_park_ends_at_the_dump_angle_with_a_frame_not_with_stop() -> None:
    clock, model = VirtualClock(), Recorder()
    with opened("helios", model, clock, park=0.8) as (device, plugged):
        device.load(cosine(device), 1000)
        device.start()
        device.park()
        assert model.history.command(np.array([plugged.now_s()]))[0] == pytest.approx(0.8, abs=1 / 4095)
        assert device.status.position == 0.8
        assert b"\x01\x00" not in model.commands()
        assert model.frames()[-1][-1] & 2


# What goes wrong


def test_a_frame_that_comes_too_late_ends_the_run_with_a_fault() -> None:
    clock = VirtualClock()
    model = Recorder(clock, late_frame=4)
    with opened("helios", model, clock) as (device, _):
        device.load(cosine(device), 100)
        device.start()
        finish(device)
        fault = device.status.fault
        assert fault is not None
        assert "ran dry" in fault
        device.stop()
        device.start()
        assert device.status.fault is None


def test_a_firmware_that_hangs_ends_the_run_within_its_deadline() -> None:
    clock, model = VirtualClock(), HeliosModel()
    device = open_scanner("helios", plug(model, clock).bus, clock)
    device.load(cosine(device), 100_000)
    device.start()
    model.deaf = True
    began = clock.now_ns()
    finish(device)
    assert device.status.fault is not None
    assert (clock.now_ns() - began) / 1e9 < 2
    with pytest.raises(DeviceTimeout):
        device.close()


def test_unplugging_during_a_run_is_a_disconnection() -> None:
    clock, model = VirtualClock(), HeliosModel()
    plugged = plug(model, clock)
    device = open_scanner("helios", plugged.bus, clock)
    device.load(cosine(device), 100_000)
    device.start()
    plugged.bus.unplug(plugged.attached)
    with pytest.raises(DeviceDisconnected, match="cable"):
        finish(device)
    with pytest.raises(DeviceDisconnected):
        device.stop()
    with pytest.raises(DeviceDisconnected):
        device.close()
    device.close()
    plugged.bus.plug(HeliosModel())
    open_scanner("helios", plugged.bus, clock).close()


@pytest.mark.parametrize("reply", [b"\x84\x06", b"\xff" * 8])
def test_a_foreign_firmware_is_one_line(reply: bytes) -> None:
    class Foreign(HeliosModel):
        def _command(self, data: bytes, now_s: float) -> None:
            self.leave_reply(reply)

    plugged = plug(Foreign(), VirtualClock())
    with pytest.raises(ProtocolError, match="no Helios firmware") as refused:
        open_scanner("helios", plugged.bus, plugged.clock)
    assert "\n" not in str(refused.value)
    open_device(HELIOS, "usb", {0: 1}, plugged.bus).close()


def test_an_old_firmware_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), opened("helios", HeliosModel(version=5), VirtualClock()):
        assert "firmware 5 is older than the tested 6" in caplog.text


def test_a_device_that_says_nothing_at_open_is_a_timeout() -> None:
    model = HeliosModel()
    model.deaf = True
    plugged = plug(model, VirtualClock())
    with pytest.raises(DeviceTimeout):
        open_scanner("helios", plugged.bus, plugged.clock)


def test_two_equal_devices_ask_for_the_port_since_they_have_no_serial() -> None:
    plugged = plug(HeliosModel(name="left"), VirtualClock())
    plugged.bus.plug(HeliosModel(name="right"))
    with pytest.raises(DeviceError, match="2 are attached; set port to one of usb:path=1-1, usb:path=1-2"):
        open_scanner("helios", plugged.bus, plugged.clock)


def test_another_name_than_the_configured_one_is_refused() -> None:
    plugged = plug(HeliosModel(name="left"), VirtualClock())
    open_scanner("helios", plugged.bus, plugged.clock, name="left").close()
    with pytest.raises(DeviceNotFound, match="'left', not 'right'"):
        open_scanner("helios", plugged.bus, plugged.clock, name="right")


def test_absent_busy_and_forbidden_are_one_line_each() -> None:
    clock = VirtualClock()
    bus = EmulatedUsb(clock)
    with pytest.raises(DeviceNotFound, match="1209:e500"):
        open_scanner("helios", bus, clock)
    attached = bus.plug(HeliosModel())
    with open_scanner("helios", bus, clock), pytest.raises(DeviceBusy, match="another program"):
        open_scanner("helios", bus, clock)
    attached.denied = True
    with pytest.raises(DevicePermission, match=r"70-spadrig\.rules"):
        open_scanner("helios", bus, clock)


@pytest.mark.parametrize("config", [{"park": 0.9, "command_range": [-0.5, 0.5]}, {"command_range": [0.5, -0.5]}])
def test_a_config_that_cannot_be_is_refused(config: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="command_range"):
        open_scanner("helios", EmulatedUsb(VirtualClock()), VirtualClock(), **config)


def test_slices_follow_each_other() -> None:
    model = HeliosModel()
    with opened("helios", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 5)
        device.start()
        finish(device)
        for one, following in pairwise(list(model.history._played)):
            assert following.start_s == one.end_s


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_a_run_through_real_libusb() -> None:
    model = HeliosModel()
    command = [sys.executable, "-m", "tests.wire.helios_over_libusb"]
    with UmockdevBus(SystemClock()) as bus:
        bus.plug(model)
        done = subprocess.run(command, env=bus.environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"clock_hz": 20_000.0, "fault": None, "position": PARK}
    scans = model.history.rising(BLUE, 0, 1e12)
    assert np.diff(scans) == pytest.approx([3000 / 20_000] * (REPEATS - 1), abs=TOLERANCE_S)
    assert not model.shutter


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_kill_9_of_the_process_stops_the_mirror_through_alternate_0() -> None:
    model = HeliosModel()
    clock = SystemClock()
    command = [sys.executable, "-m", "tests.wire.helios_over_libusb", "endless"]
    with UmockdevBus(clock) as bus:
        bus.plug(model)
        with subprocess.Popen(command, env=bus.environment(), stdout=subprocess.PIPE, text=True) as client:
            assert client.stdout is not None
            assert client.stdout.readline() == "scanning\n"
            time.sleep(0.2)
            assert model.moving(clock.now_ns() / 1e9)
            client.kill()
        end = time.monotonic() + PATIENCE_S
        while model.moving(clock.now_ns() / 1e9):
            assert time.monotonic() < end
            time.sleep(0.01)
        assert model.played < 100  # stopped, not played to the end of its repeats
