"""The Helios driver against the firmware model. Golden bytes and traps: docs/reference/devices/helios.md."""

import logging
import struct
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceError, DeviceNotFound, DeviceTimeout, LimitExceeded, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, ScanWaveform
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.helios import HELIOS, Helios, encode, sendable, slice_points
from drivers.transports.usb_device import open_device
from sim_backend.wire.firmware import helios
from sim_backend.wire.firmware.helios import (
    BLUE,
    CENTRE,
    COMMANDS,
    FRAMES,
    GREEN,
    INTENSITY,
    RED,
    SEAM_S,
    DacHistory,
    HeliosModel,
)
from sim_backend.wire.serve.usb import EmulatedUsb
from sim_backend.wire.serve.usb_model import Answer
from tests.wire.emulated_scanners import HeliosRecorder, cosine, finish, open_scanner, opened, play, plug

# Bytes


def test_a_frame_is_the_bytes_of_the_manual() -> None:
    points = PointSlice(
        np.array([1.0, -1.0, 0.0]),
        np.array([MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD], np.uint8),
        np.array([True, True, False]),
    )
    along_x = encode(points, "x", 25001, 3)
    assert along_x.hex(" ") == "ff f8 00 ff ff 00 00 00 08 00 ff 00 ff 00 80 08 00 00 00 00 ff a9 61 03 00 03"
    along_y = encode(points, "y", 25001, 2)
    assert along_y.hex(" ") == "80 0f ff ff ff 00 00 80 00 00 ff 00 ff 00 80 08 00 00 00 00 ff a9 61 03 00 02"


def test_the_point_clock_is_the_real_one_not_the_asked_one() -> None:
    with opened("helios", HeliosModel()) as (device, _):
        for exact in (20_000, 25_000, 40_000, 50_000):
            assert device.point_clock(exact) == exact
        assert device.point_clock(30_000) == Fraction(112_000_000, 3733)
        assert device.point_clock(10_000) != 10_000


def test_the_exact_25_khz_is_asked_for_as_25001() -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        play(device, 1)
        assert {struct.unpack("<H", frame[-5:-3])[0] for frame in model.sent(FRAMES)} == {25_001}


# Traps


@pytest.mark.parametrize("points", [45, 109, 1501, 1545, 2989, 4500])
def test_no_frame_is_45_mod_64_points_long(points: int) -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        # Flat and at the centre, where the mirror stands: no way to the first point changes the length.
        device.load(ScanWaveform(np.zeros(points), np.zeros(points, np.uint8), device.point_clock(25_000)), 1)
        device.start()
        finish(device)
        lengths = [len(frame) // 7 for frame in model.sent(FRAMES)]
        assert all(map(sendable, lengths))
        assert sum(lengths) - points == (points in (45, 109))


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
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        play(device, 2)
        flags = [frame[-1] for frame in model.sent(FRAMES)]
        assert flags == [3] + [2] * (len(flags) - 1)
        assert len(flags) > 5


def test_a_dead_host_leaves_a_mirror_that_stands_after_two_frames() -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, plugged):
        device.load(cosine(device), 10_000)
        device.start()
        model.deaf = True  # nothing that the host sends arrives any more
        plugged.clock.sleep(0.2)
        assert not model.moving(plugged.now_s())
        model.deaf = False


def test_old_replies_are_drained_before_the_first_question() -> None:
    model = HeliosModel()
    enable = model.set_interface

    def with_leftovers(interface: int, alternate: int, now_s: float) -> None:
        enable(interface, alternate, now_s)
        for _ in range(3):
            model._replies.append(b"\x84\x01\x00\x00\x00")

    model.set_interface = with_leftovers  # type: ignore[method-assign]
    with opened("helios", model) as (device, _):
        assert device._dac.firmware == 6  # type: ignore[attr-defined]


@pytest.mark.parametrize("junk", [b"\x84\x06\x00\x00\x00", b"\x83", b"\x83\x02", b"\x83\x01\x00"])
def test_any_other_reply_than_83_01_is_not_ready(junk: bytes) -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        model._replies.append(junk)
        play(device, 1)
        asked = [data for _, endpoint, data in model.log if endpoint in (COMMANDS, FRAMES)]
        first = asked.index(model.sent(FRAMES)[0])
        assert asked[first - 2 : first] == [b"\x03\x00"] * 2
        assert device.status.fault is None


def test_a_frame_that_the_device_drops_in_silence_is_a_fault() -> None:
    model = HeliosModel()
    with opened("helios", model) as (device, _):
        model.drop_next = 1
        play(device, 100)
        assert "dropped a frame in silence" in str(device.status.fault)


def test_frames_hold_at_most_4095_points_however_long_they_may_last() -> None:
    model = HeliosRecorder()
    with opened("helios", model, frame="500 ms") as (device, _):
        device.load(cosine(device, 20_000, 50_000), 1)
        device.start()
        finish(device)
        assert max(len(frame) for frame in model.sent(FRAMES)) == 7 * 4095 + 5


def test_replies_may_take_longer_than_the_vendors_16_ms() -> None:
    class Slow(HeliosModel):
        """A reply is there 18 ms after its question."""

        asked_s = 0.0

        def _command(self, data: bytes, now_s: float) -> None:
            self.asked_s = now_s
            super()._command(data, now_s)

        def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
            return super().inp(endpoint, length, now_s) if now_s - self.asked_s > 0.018 else None

    with opened("helios", Slow()) as (device, _):
        assert not device.status.moving


@pytest.mark.parametrize("every", [29, 31, 37])
def test_a_lost_status_reply_is_asked_for_again_in_time(every: int) -> None:
    class Losing(HeliosRecorder):
        """Every so many replies to the status query get lost: about one in each frame, at another place each time."""

        asked = lost = 0

        def _command(self, data: bytes, now_s: float) -> None:
            super()._command(data, now_s)
            if data[0] == 0x03:
                self.asked += 1
                if self.asked % every == 0:
                    self.lost += 1
                    self._replies.pop()

    model = Losing()
    with opened("helios", model) as (device, _):
        play(device, 20)
        assert device.status.fault is None
        assert model.lost > 20


def test_a_board_that_gives_no_status_is_a_timeout_within_a_fraction_of_a_second() -> None:
    model = HeliosModel()
    with opened("helios", model) as (device, plugged):
        model.deaf = True
        began_s = plugged.now_s()
        with pytest.raises(DeviceTimeout, match="gives no status"):
            _ = device.status
        assert plugged.now_s() - began_s < 0.3
        model.deaf = False


def test_the_version_is_asked_for_twice_since_a_first_answer_may_get_lost() -> None:
    class Forgetful(HeliosRecorder):
        forgot = False

        def _command(self, data: bytes, now_s: float) -> None:
            if self.forgot:
                super()._command(data, now_s)
            self.forgot = True

    model = Forgetful()
    with opened("helios", model):
        assert [command[0] for command in model.sent(COMMANDS)[:3]] == [0x04, 0x04, 0x07]


def test_frames_wait_150_ms_after_stop_since_the_firmware_refuses_them_for_100() -> None:
    clock = VirtualClock()
    model = HeliosRecorder(clock, late=3)
    with opened("helios", model, clock) as (device, _):
        play(device, 100)
        device.stop()
        device.start()
        device.stop()
        _, stopped = (at for at, endpoint, data in model.log if (endpoint, data[:1]) == (COMMANDS, b"\x01"))
        after = next(at for at, endpoint, _ in model.log if endpoint == FRAMES and at > stopped)
        assert after - stopped >= 0.149
        assert model.refused == 0


def test_the_shutter_is_never_opened_and_only_known_opcodes_are_sent() -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        device.load(cosine(device), 2)
        device.start()
        device.stop()
        device.park()
    assert {command[0] for command in model.sent(COMMANDS)} <= {0x01, 0x02, 0x03, 0x04, 0x05, 0x07}
    assert all(command[1] == 0 for command in model.sent(COMMANDS) if command[0] == 0x02)
    assert all(len(command) == 2 for command in model.sent(COMMANDS))
    assert not model.shutter
    assert not model.bootloader


def test_a_mirror_that_stands_elsewhere_is_centred_by_a_stop_at_open() -> None:
    model = HeliosRecorder()
    model.history = DacHistory(0.7, lines=4)  # no point was written since the power came, or another program died
    with opened("helios", model) as (device, plugged):
        assert b"\x01\x00" in model.sent(COMMANDS)
        assert model.history.command(np.array([plugged.now_s()]))[0] == CENTRE
        assert device.status.position == 0.0
        play(device, 1)
        assert model.refused == 0


def test_a_longer_first_point_in_every_frame_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(helios, "SEAM_S", 3e-6)
    with opened("helios", HeliosModel(), frame="10 ms") as (device, _):
        play(device, 10)
        assert device.status.fault is None


def test_it_opens_by_itself_with_plain_numbers() -> None:
    clock, model = VirtualClock(), HeliosModel(name="left")
    board: dict[str, Any] = {"usb_backend": plug(model, clock).bus, "clock": clock}
    galvo: dict[str, Any] = {"max_velocity_per_s": 2000.0, "max_acceleration_per_s2": 2e6}
    with Helios.open(**galvo, max_point_rate_hz=40e3, frame_s=0.03, name="left", **board) as device:
        assert device.limits.point_rate_hz[1] == 40e3
        play(device, 2)
        assert device.status.fault is None
    with pytest.raises(LimitExceeded, match="frame") as refused:
        Helios.open(**galvo, frame_s=10.0, **board)
    assert "\n" not in str(refused.value)


def test_close_stops_waits_lowers_the_shutter_and_leaves_alternate_0() -> None:
    model = HeliosRecorder()
    with opened("helios", model) as (device, _):
        assert model.sent(-1) == [b"\x01"]
        device.load(cosine(device), 1000)
        device.start()
    end = model.log[-3:]
    assert [(endpoint, data) for _, endpoint, data in end] == [
        (COMMANDS, b"\x01\x00"),
        (COMMANDS, b"\x02\x00"),
        (-1, b"\x00"),
    ]
    assert end[1][0] - end[0][0] >= 0.149  # the clock advances by 0.15 in binary fractions


def test_giving_the_interface_back_stops_the_mirror_as_when_the_process_is_killed() -> None:
    clock, model = VirtualClock(), HeliosModel()
    plugged = plug(model, clock)
    device = open_scanner("helios", plugged.bus, clock)
    device.load(cosine(device), 10**9)
    device.start()
    for owner in list(plugged.attached._claims.values()):
        plugged.attached.close(owner)
    assert not model.moving(plugged.now_s())
    where = model.history.command(plugged.now_s() + np.array([0.09, 0.11]))
    assert (where == CENTRE).tolist() == [False, True]  # as after STOP
    with pytest.raises(DeviceError):
        device.close()


# What comes out


def test_each_frame_begins_with_a_longer_point_and_markers_are_where_the_waveform_has_them() -> None:
    model = HeliosModel()
    with opened("helios", model) as (device, plugged):
        wave, repeats, rate_hz = cosine(device), 3, 25_000
        play(device, repeats)
        now_s, history = plugged.now_s(), model.history
        (start,) = history.rising(RED, 0, now_s)
        scan = np.arange(repeats) * 6000 / rate_hz
        lines = (np.arange(60) * 100 / rate_hz + scan[:, None]).ravel()
        for line, at in ((GREEN, lines), (BLUE, scan), (INTENSITY, scan + 3000 / rate_hz)):
            late = (history.rising(line, 0, now_s) - start - at) / SEAM_S
            assert late == pytest.approx(np.round(late), abs=1e-3), "late by whole seams"
            assert np.diff(late).min() > -0.1
            assert 1 < late[-1] <= model.played
        starts = np.repeat(history.rising(GREEN, 0, now_s), 100)
        times = starts + (np.tile(np.arange(100), len(lines)) + 0.5) / rate_hz
        assert history.command(times) == pytest.approx(np.tile(wave.command, repeats), abs=1.01 / 4095)


def test_nothing_shines_on_ramps_and_at_rest() -> None:
    model = HeliosModel()
    with opened("helios", model) as (device, plugged):
        began_s = plugged.now_s()
        play(device, 1)
        device.park()
        times = np.linspace(began_s, plugged.now_s(), 100_000)
        lit = times[model.history.level(RED, times) > 0]
        assert lit[-1] - lit[0] == pytest.approx(6000 / 25_000, abs=1e-4)


def test_park_ends_at_the_dump_angle_with_a_frame_not_with_stop() -> None:
    model = HeliosRecorder()
    with opened("helios", model, park=0.8) as (device, plugged):
        device.load(cosine(device), 1000)
        device.start()
        device.park()
        assert model.history.command(np.array([plugged.now_s()]))[0] == pytest.approx(0.8, abs=1 / 4095)
        assert model.sent(COMMANDS).count(b"\x01\x00") == 1  # at open


# What goes wrong


@pytest.mark.parametrize("reply", [b"\x84\x06", b"\xff" * 8])
def test_a_foreign_firmware_is_one_line(reply: bytes) -> None:
    class Foreign(HeliosModel):
        def _command(self, data: bytes, now_s: float) -> None:
            self._replies.append(reply)

    plugged = plug(Foreign(), VirtualClock())
    with pytest.raises(ProtocolError, match="no Helios firmware") as refused:
        open_scanner("helios", plugged.bus, plugged.clock)
    assert "\n" not in str(refused.value)
    open_device(HELIOS, "usb", {0: 1}, plugged.bus).close()


def test_an_old_firmware_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), opened("helios", HeliosModel(version=5)):
        assert "firmware 5 is older than the tested 6" in caplog.text


def test_a_device_that_says_nothing_at_open_is_a_timeout() -> None:
    model = HeliosModel()
    model.deaf = True
    with pytest.raises(DeviceTimeout), opened("helios", model):
        pass


def test_another_name_than_the_configured_one_is_refused() -> None:
    with opened("helios", HeliosModel(name="left"), name="left"):
        pass
    with (
        pytest.raises(DeviceNotFound, match="'left', not 'right'"),
        opened("helios", HeliosModel(name="left"), name="right"),
    ):
        pass


@pytest.mark.parametrize("config", [{"park": 0.9, "command_range": [-0.5, 0.5]}, {"command_range": [0.5, -0.5]}])
def test_a_config_that_cannot_be_is_refused(config: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="command_range"):
        open_scanner("helios", EmulatedUsb(VirtualClock()), VirtualClock(), **config)
