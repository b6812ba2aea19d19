"""The LaserCube driver against the firmware model. Golden bytes: docs/reference/devices/lasercube.md."""

from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceError, DeviceFault, DeviceNotFound, LimitExceeded, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.lasercube import LaserCube, encode
from sim_backend.wire.serve.usb_model import Stall
from tests.wire import emulated_scanners as scanners
from tests.wire.emulated_scanners import LaserCubeRecorder, cosine, opened, play, plug
from tests.wire.scanners.lasercube import BLUE, CENTRE, COMMANDS, GREEN, RED, REPLIES, SAMPLES, LaserCubeModel

STEP = 2 / 4095


class Fullest(LaserCubeRecorder):
    """Notes the most samples that its ring held."""

    fullest = 0

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        taken = super()._take_points(data, now_s)
        self.fullest = max(self.fullest, self._queued)
        return taken


def test_samples_are_the_bytes_of_the_manual() -> None:
    markers = np.array([MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD], np.uint8)
    points = PointSlice(np.array([1.0, -1.0, 0.0]), markers, np.ones(3, bool))
    assert encode(points, "x", markers=True).hex(" ", 8) == "00ff0000ff0f0008 0000ff0000000008 ff00000000080008"
    assert encode(points, "y", markers=False).hex(" ", 8) == "000000000008ff0f 0000000000080000 0000000000080008"


def test_the_model_keeps_its_ring_and_stands_at_the_centre_while_the_output_is_off() -> None:
    model = LaserCubeModel()
    far = np.tile(np.array([0, 0, 4095, 0x800], "<u2"), 64).tobytes()

    def sent(command: bytes, now_s: float) -> bytes:
        model.out(COMMANDS, command, now_s)
        reply = model.inp(REPLIES, 64, now_s)
        assert isinstance(reply, bytes)
        return reply

    assert model.out(SAMPLES, far, 0.0) == len(far)
    assert sent(b"\x8a", 1.0)[2:6] == (768 - 64).to_bytes(4, "little")
    assert model.history.command(np.array([1.0]))[0] == CENTRE
    sent(b"\x80\x01", 1.0)
    assert sent(b"\x8a", 2.0)[2:6] == (768).to_bytes(4, "little")
    assert model.history.command(np.array([2.0]))[0] == 1.0
    for command in (b"\x8d\x00", b"\x80\x00"):
        model.out(SAMPLES, far, 3.0)
        model.advance(4.0)
        sent(command, 4.0)
        assert model.history.command(np.array([4.1]))[0] == CENTRE
    codes = [sent(command, 5.0)[1] for command in (b"\x99", b"\x80\x02", b"\x82" + (65_000).to_bytes(4, "little"))]
    assert codes == [0xFF, 1, 1]


def test_it_is_found_and_left_with_its_output_off_and_its_ring_empty() -> None:
    model = LaserCubeRecorder()
    off = [b"\x80\x00", b"\x8d\x00"]
    with opened("lasercube", model, colours="markers") as (device, _):
        assert model.sent(COMMANDS)[:2] == off
        assert model.sent(-1) == [b"\x00", b"\x01"]  # samples go to alternate setting 1 of the second interface
        device.load(cosine(device), 100)
        device.start()
    assert model.sent(COMMANDS)[-2:] == off
    assert not model.enabled


def test_the_rate_is_set_as_four_bytes_and_read_back_and_transfers_hold_at_most_64_samples() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model) as (device, _):
        play(device, 2)
        at = model.sent(COMMANDS).index(b"\x82\xa8\x61\x00\x00")
        assert model.sent(COMMANDS)[at + 1] == b"\x83"
        assert max(len(data) for data in model.sent(SAMPLES)) == 512


def test_another_rate_than_the_asked_one_is_a_fault() -> None:
    model = LaserCubeModel()
    with opened("lasercube", model) as (device, _):
        device.load(cosine(device), 1)
        model.rate_offset_hz = 3
        with pytest.raises(DeviceFault, match="25003 Hz instead of 25000 Hz"):
            device.start()
        model.rate_offset_hz = 0


def test_its_own_lasers_stay_dark_unless_the_config_says_where_the_colours_lead() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model) as (device, _):
        play(device, 2)
        assert all(not any(data[at : at + 4]) for data in model.sent(SAMPLES) for at in range(0, len(data), 8))


@pytest.mark.parametrize("colours", ["dark", "markers"])
def test_the_output_is_on_for_the_whole_run_since_the_ring_is_not_played_otherwise(colours: str) -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model, colours=colours) as (device, plugged):
        wave, began_s = cosine(device), plugged.now_s()
        play(device, 2)
        assert device.status.fault is None
        times = np.arange(began_s, plugged.now_s(), 1 / 25_000)
        played = model.history.command(times)
        assert played.max() == pytest.approx(wave.command.max(), abs=STEP)
        assert np.count_nonzero(np.abs(played - wave.command.max()) < STEP) > 2 * 50
        sent = [(endpoint, data) for _, endpoint, data in model.log]
        first = sent.index((SAMPLES, model.sent(SAMPLES)[0]))
        assert (COMMANDS, b"\x80\x01") in sent[:first]
        assert not {b"\x80\x00", b"\x8d\x00"} & {data for _, data in sent[first:]}


def test_the_mirror_never_jumps_and_stays_at_the_dump_angle_until_it_is_closed() -> None:
    clock, model = VirtualClock(), LaserCubeRecorder()
    with opened("lasercube", model, clock, max_point_rate="25 kHz", park=0.8) as (device, plugged):
        began_s, most = plugged.now_s(), device.limits.step
        play(device, 1)
        device.start()
        device.stop()
        device.park()
        clock.sleep(1.0)
        assert model.enabled
        assert model.history.command(np.array([plugged.now_s()]))[0] == pytest.approx(0.8, abs=STEP)
    times = np.arange(began_s, plugged.now_s() + 0.1, 1 / 25_000)
    way = model.history.command(times)
    # Twice the step: a moment of the record may see two points.
    assert np.abs(np.diff(way)).max() <= 2 * most
    assert way[-1] == CENTRE
    assert not model.enabled


def test_a_ring_of_768_samples_is_used_up_to_its_last_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanners, "LATE_S", 0.022)  # half of the ring lasts 15 ms, all of it 30 ms
    clock = VirtualClock()
    model = Fullest(clock, late=60)
    with opened("lasercube", model, clock) as (device, _):
        play(device, 3)
        assert device.status.fault is None
        assert 768 - 64 - 8 < model.fullest <= 768 - 8


@pytest.mark.parametrize("product_name", ["Laserdock", "Laserdock.", "LaserCube", "LASERDOCK"])
def test_the_product_string_is_compared_without_case(product_name: str) -> None:
    with opened("lasercube", LaserCubeModel(product_name=product_name)) as (device, _):
        assert "LaserCube" in device.identity


def test_it_opens_by_itself_with_plain_numbers() -> None:
    clock, model = VirtualClock(), LaserCubeRecorder()
    board: dict[str, Any] = {"usb_backend": plug(model, clock).bus, "clock": clock}
    galvo: dict[str, Any] = {"max_velocity_per_s": 2000.0, "max_acceleration_per_s2": 2e6}
    with LaserCube.open(**galvo, max_point_rate_hz=25e3, buffer_s=0.02, park=0.5, **board) as device:
        assert device.limits.point_rate_hz[1] == 25e3
        play(device, 2)
        assert device.status.fault is None
    with pytest.raises(LimitExceeded, match="max_velocity") as refused:
        LaserCube.open(max_velocity_per_s=-1.0, max_acceleration_per_s2=2e6, **board)
    assert "\n" not in str(refused.value)
    with pytest.raises(LimitExceeded, match="parc"):
        LaserCube.open(**galvo, parc=0.5, **board)


def test_points_and_markers_come_out_once_and_the_mirror_rests_at_the_last_point() -> None:
    model = LaserCubeRecorder()
    with opened("lasercube", model, colours="markers") as (device, plugged):
        wave, repeats, rate_hz = cosine(device), 3, 25_000
        play(device, repeats)
        history, now_s = model.history, plugged.now_s()
        scans = history.rising(BLUE, 0, now_s)
        assert scans - scans[0] == pytest.approx(np.arange(repeats) * 6000 / rate_hz, abs=1e-6)
        assert len(history.rising(GREEN, 0, now_s)) == 60 * repeats
        assert len(history.rising(RED, 0, now_s)) == repeats
        times = scans[0] + (np.arange(repeats * 6000) + 0.5) / rate_hz
        assert history.command(times) == pytest.approx(np.tile(wave.command, repeats), abs=1.01 / 4095)
        assert not model.moving(now_s)
        assert history.command(np.array([now_s]))[0] == pytest.approx(wave.command[-1], abs=1.01 / 4095)


def test_a_lost_transfer_is_a_fault() -> None:
    class Lossy(LaserCubeRecorder):
        def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
            if endpoint == SAMPLES and len(self.sent(SAMPLES)) == 40:
                self.log.append((now_s, endpoint, data))
                return len(data)
            return super().out(endpoint, data, now_s)

    with opened("lasercube", Lossy()) as (device, _):
        play(device, 100)
        assert "lost" in str(device.status.fault)


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
    model._replies.append(bytes(64))
    with opened("lasercube", model) as (device, _):
        assert device._dac.firmware == (3, 7)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("settings", "error", "said"),
    [
        ({"product_name": "Lasershark"}, DeviceNotFound, "1fc9:04d8"),  # of the same numbers
        ({"ring": 0}, ProtocolError, "no LaserCube firmware"),
    ],
)
def test_another_board_is_refused_in_one_line(settings: dict[str, Any], error: type[DeviceError], said: str) -> None:
    with pytest.raises(error, match=said) as refused, opened("lasercube", LaserCubeModel(**settings)):
        pass
    assert "\n" not in str(refused.value)


def test_the_device_s_own_highest_rate_is_a_limit() -> None:
    with (
        opened("lasercube", LaserCubeModel(highest_rate_hz=20_000)) as (device, _),
        pytest.raises(LimitExceeded, match="20000"),
    ):
        device.point_clock(25_000)
