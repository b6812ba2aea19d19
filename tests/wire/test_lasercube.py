"""The LaserCube driver against the firmware model. Golden bytes: docs/reference/hardware.md."""

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceFault, DeviceNotFound, LimitExceeded, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.lasercube import encode
from sim_backend.wire.firmware.lasercube import BLUE, COMMANDS, GREEN, RED, SAMPLES, LaserCubeModel
from sim_backend.wire.serve.usb_model import Stall
from tests.wire.scanners import LaserCubeRecorder, cosine, finish, open_scanner, opened, play, plug


def test_samples_are_the_bytes_of_the_manual() -> None:
    markers = np.array([MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD], np.uint8)
    points = PointSlice(np.array([1.0, -1.0, 0.0]), markers, np.ones(3, bool))
    assert encode(points, "x", markers=True).hex(" ", 8) == "00ff0000ff0f0008 0000ff0000000008 ff00000000080008"
    assert encode(points, "y", markers=False).hex(" ", 8) == "000000000008ff0f 0000000000080000 0000000000080008"


def test_opening_turns_the_output_off_and_empties_the_ring_before_anything_else() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model):
        assert model.sent(COMMANDS)[:2] == [b"\x80\x00", b"\x8d\x00"]


def test_samples_go_to_alternate_setting_1_of_the_second_interface() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model):
        assert model.sent(-1) == [b"\x00", b"\x01"]


def test_close_turns_the_output_off_and_empties_the_ring() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model, colours="markers") as (device, _):
        device.load(cosine(device), 100)
        device.start()
    assert model.sent(COMMANDS)[-2:] == [b"\x80\x00", b"\x8d\x00"]
    assert not model.enabled


def test_the_rate_is_set_as_four_bytes_and_read_back() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model) as (device, _):
        play(device, 1)
        at = model.sent(COMMANDS).index(b"\x82\xa8\x61\x00\x00")
        assert model.sent(COMMANDS)[at + 1] == b"\x83"


def test_another_rate_than_the_asked_one_is_a_fault() -> None:
    model = LaserCubeModel()
    with opened("lasercube", model) as (device, _):
        device.load(cosine(device), 1)
        model.rate_offset_hz = 3
        with pytest.raises(DeviceFault, match="25003 Hz instead of 25000 Hz"):
            device.start()
        model.rate_offset_hz = 0


def test_transfers_hold_at_most_64_samples() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model) as (device, _):
        play(device, 2)
        assert max(len(data) for data in model.sent(SAMPLES)) == 512


def test_its_own_lasers_stay_dark_unless_the_config_says_where_the_colours_lead() -> None:
    clock, model = VirtualClock(), LaserCubeRecorder()
    with opened("lasercube", model, clock) as (device, plugged):
        play(device, 2)
        assert b"\x80\x01" not in model.sent(COMMANDS)
        assert all(not any(data[at : at + 4]) for data in model.sent(SAMPLES) for at in range(0, len(data), 8))
        assert not len(model.history.rising(GREEN, 0, plugged.now_s()))


@pytest.mark.parametrize("when_empty", ["hold", "repeat"])
def test_points_and_markers_come_out_once_whatever_an_empty_ring_does(when_empty: str) -> None:
    clock, model = VirtualClock(), LaserCubeRecorder(when_empty=when_empty)
    with opened("lasercube", model, clock, colours="markers") as (device, plugged):
        wave, repeats = cosine(device), 3
        device.load(wave, repeats)
        device.start()
        finish(device)
        history, period = model.history, 1 / 25_000
        scans = history.rising(BLUE, 0, plugged.now_s())
        assert scans - scans[0] == pytest.approx(np.arange(repeats) * 6000 * period, abs=1e-6)
        assert len(history.rising(GREEN, 0, plugged.now_s())) == 60 * repeats
        assert len(history.rising(RED, 0, plugged.now_s())) == repeats
        times = scans[0] + (np.arange(repeats * 6000) + 0.5) * period
        assert history.command(times) == pytest.approx(np.tile(wave.command, repeats), abs=1.01 / 4095)
        assert not model.moving(plugged.now_s())
        assert history.command(np.array([plugged.now_s()]))[0] == pytest.approx(wave.command[-1], abs=1.01 / 4095)


def test_a_lost_transfer_is_a_fault() -> None:
    class Lossy(LaserCubeRecorder):
        def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
            if endpoint == SAMPLES and len(self.sent(SAMPLES)) == 40:
                self.log.append((now_s, endpoint, data))
                return len(data)
            return super().out(endpoint, data, now_s)

    with opened("lasercube", Lossy()) as (device, _):
        play(device, 100)
        fault = device.status.fault
        assert fault is not None
        assert "lost" in fault


def test_the_reply_s_first_byte_does_not_matter_but_its_second_does() -> None:
    class Odd(LaserCubeModel):
        code = 0

        def _answer(self, data: bytes, now_s: float) -> tuple[int, bytes]:
            _, value = super()._answer(data, now_s)
            return self.code, value

        def inp(self, endpoint: int, length: int, now_s: float) -> bytes | None:
            reply = super().inp(endpoint, length, now_s)
            return b"\x77" + bytes(reply)[1:] if isinstance(reply, bytes) else None

    model = Odd()
    with opened("lasercube", model) as (device, _):
        assert not device.status.moving
        model.code = 9
        with pytest.raises(DeviceFault, match="code 9"):
            _ = device.status
        model.code = 0


def test_a_reply_left_by_another_program_is_dropped() -> None:
    model = LaserCubeModel()
    model.leave_reply(bytes(64))
    with opened("lasercube", model) as (device, _):
        assert device._dac.firmware == (0, 12)  # type: ignore[attr-defined]


def test_a_lasershark_with_the_same_numbers_is_not_taken_for_one() -> None:
    plugged = plug(LaserCubeModel(product_name="Lasershark"), VirtualClock())
    with pytest.raises(DeviceNotFound, match="1fc9:04d8"):
        open_scanner("lasercube", plugged.bus, plugged.clock)


def test_a_foreign_firmware_is_one_line() -> None:
    plugged = plug(LaserCubeModel(ring=0), VirtualClock())
    with pytest.raises(ProtocolError, match="no LaserCube firmware") as refused:
        open_scanner("lasercube", plugged.bus, plugged.clock)
    assert "\n" not in str(refused.value)


def test_the_device_s_own_highest_rate_is_a_limit() -> None:
    with (
        opened("lasercube", LaserCubeModel(highest_rate_hz=20_000)) as (device, _),
        pytest.raises(LimitExceeded, match="20000"),
    ):
        device.point_clock(25_000)
