"""The LaserCube driver against the firmware model. Golden bytes: hardware.md 3.2."""

import time

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
)
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.lasercube_link import encode
from drivers.point_source import Points
from sim_backend.wire.lasercube import BLUE, COMMANDS, GREEN, RED, SAMPLES, LaserCubeModel
from sim_backend.wire.usb_backend import EmulatedUsb, Stall
from tests.wire.scanners import open_scanner, opened, plug

PATIENCE_S = 20.0


class Recorder(LaserCubeModel):
    """A LaserCube that notes what it was sent."""

    def __init__(self, clock: VirtualClock | None = None, late_transfer: int = -1, **options: object) -> None:
        super().__init__(**options)  # type: ignore[arg-type]
        self.log: list[tuple[int, bytes]] = []
        self._clock, self._late_transfer = clock, late_transfer

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._clock is not None and endpoint == SAMPLES and len(self.samples()) == self._late_transfer:
            self._late_transfer = -1
            self._clock.sleep(0.2)
            now_s += 0.2
        taken = super().out(endpoint, data, now_s)
        if taken:
            self.log.append((endpoint, data))
        return taken

    def commands(self) -> list[bytes]:
        return [data for endpoint, data in self.log if endpoint == COMMANDS]

    def samples(self) -> list[bytes]:
        return [data for endpoint, data in self.log if endpoint == SAMPLES]


def cosine(device: BeamScanner, points: int = 6000, rate_hz: float = 25_000.0) -> ScanWaveform:
    at = np.arange(points)
    markers = np.zeros(points, np.uint8)
    markers[at % 100 < 4] |= MARKER_LINE
    markers[:4] |= MARKER_SCAN
    markers[at >= points // 2] |= LEVEL_BACKWARD
    return ScanWaveform(-0.5 * np.cos(2 * np.pi * at / points), markers, device.point_clock(rate_hz))


def finish(device: BeamScanner) -> None:
    end = time.monotonic() + PATIENCE_S
    while device.status.moving:
        assert time.monotonic() < end, "the run does not end"
        time.sleep(0.001)


def test_samples_are_the_bytes_of_the_manual() -> None:
    markers = np.array([MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD], np.uint8)
    points = Points(np.array([1.0, -1.0, 0.0]), markers, np.ones(3, bool))
    assert encode(points, "x", markers=True).hex(" ", 8) == "00ff0000ff0f0008 0000ff0000000008 ff00000000080008"
    assert encode(points, "y", markers=False).hex(" ", 8) == "000000000008ff0f 0000000000080000 0000000000080008"


def test_opening_turns_the_output_off_and_empties_the_ring_before_anything_else() -> None:
    model = Recorder()
    with opened("lasercube", model, VirtualClock()):
        assert model.commands()[:2] == [b"\x80\x00", b"\x8d\x00"]


def test_close_turns_the_output_off_and_empties_the_ring() -> None:
    model = Recorder()
    with opened("lasercube", model, VirtualClock(), colours="markers") as (device, _):
        device.load(cosine(device), 100)
        device.start()
    assert model.commands()[-2:] == [b"\x80\x00", b"\x8d\x00"]
    assert not model.enabled


def test_the_rate_is_set_as_four_bytes_and_read_back() -> None:
    model = Recorder()
    with opened("lasercube", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 1)
        device.start()
        finish(device)
        at = model.commands().index(b"\x82\xa8\x61\x00\x00")
        assert model.commands()[at + 1] == b"\x83"


def test_another_rate_than_the_asked_one_is_a_fault() -> None:
    model = LaserCubeModel()
    with opened("lasercube", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 1)
        model.rate_offset_hz = 3
        with pytest.raises(DeviceFault, match="25003 Hz instead of 25000 Hz"):
            device.start()
        model.rate_offset_hz = 0


def test_transfers_hold_at_most_64_samples() -> None:
    model = Recorder()
    with opened("lasercube", model, VirtualClock()) as (device, _):
        device.load(cosine(device), 2)
        device.start()
        finish(device)
        assert max(len(data) for data in model.samples()) == 512


def test_its_own_lasers_stay_dark_unless_the_config_says_where_the_colours_lead() -> None:
    clock, model = VirtualClock(), Recorder()
    with opened("lasercube", model, clock) as (device, plugged):
        device.load(cosine(device), 2)
        device.start()
        finish(device)
        assert b"\x80\x01" not in model.commands()
        assert all(not any(data[at : at + 4]) for data in model.samples() for at in range(0, len(data), 8))
        assert not len(model.history.rising(GREEN, 0, plugged.now_s()))


@pytest.mark.parametrize("when_empty", ["hold", "repeat"])
def test_points_and_markers_come_out_once_whatever_an_empty_ring_does(when_empty: str) -> None:
    clock, model = VirtualClock(), Recorder(when_empty=when_empty)
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


def test_a_stop_brakes_and_leaves_the_mirror_where_the_driver_says() -> None:
    clock, model = VirtualClock(), LaserCubeModel()
    with opened("lasercube", model, clock) as (device, plugged):
        device.load(cosine(device), 1000)
        device.start()
        device.stop()
        position = device.status.position
        assert position is not None
        assert model.history.command(np.array([plugged.now_s()]))[0] == pytest.approx(position, abs=1.01 / 4095)
        assert not model.moving(plugged.now_s())


def test_an_empty_ring_ends_the_run_with_a_fault() -> None:
    clock = VirtualClock()
    model = Recorder(clock, late_transfer=60)
    with opened("lasercube", model, clock) as (device, _):
        device.load(cosine(device), 100)
        device.start()
        finish(device)
        fault = device.status.fault
        assert fault is not None
        assert "ran dry" in fault or "lost or played late" in fault


def test_a_lost_transfer_is_a_fault() -> None:
    class Lossy(Recorder):
        def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
            if endpoint == SAMPLES and len(self.samples()) == 40:
                self.log.append((endpoint, data))
                return len(data)
            return super().out(endpoint, data, now_s)

    with opened("lasercube", Lossy(), VirtualClock()) as (device, _):
        device.load(cosine(device), 100)
        device.start()
        finish(device)
        fault = device.status.fault
        assert fault is not None
        assert "lost" in fault


def test_the_reply_s_first_byte_does_not_matter_but_its_second_does() -> None:
    class Odd(LaserCubeModel):
        code = 0

        def _command(self, data: bytes, now_s: float) -> tuple[int, bytes]:
            _, value = super()._command(data, now_s)
            return self.code, value

        def inp(self, endpoint: int, length: int, now_s: float) -> bytes | None:
            reply = super().inp(endpoint, length, now_s)
            return b"\x77" + bytes(reply)[1:] if isinstance(reply, bytes) else None

    model = Odd()
    with opened("lasercube", model, VirtualClock()) as (device, _):
        assert not device.status.moving
        model.code = 9
        with pytest.raises(DeviceFault, match="code 9"):
            _ = device.status
        model.code = 0


def test_a_reply_left_by_another_program_is_dropped() -> None:
    model = LaserCubeModel()
    model.leave_reply(bytes(64))
    with opened("lasercube", model, VirtualClock()) as (device, _):
        assert device.firmware == (0, 12)  # type: ignore[attr-defined]


def test_a_device_that_hangs_is_a_timeout_not_a_wait_for_ever() -> None:
    clock, model = VirtualClock(), LaserCubeModel()
    device = open_scanner("lasercube", plug(model, clock).bus, clock)
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
    clock = VirtualClock()
    plugged = plug(LaserCubeModel(), clock)
    device = open_scanner("lasercube", plugged.bus, clock)
    device.load(cosine(device), 100_000)
    device.start()
    plugged.bus.unplug(plugged.attached)
    with pytest.raises(DeviceDisconnected, match="cable"):
        finish(device)
    with pytest.raises(DeviceDisconnected):
        device.close()


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
        opened("lasercube", LaserCubeModel(highest_rate_hz=20_000), VirtualClock()) as (device, _),
        pytest.raises(LimitExceeded, match="20000"),
    ):
        device.point_clock(25_000)


def test_absent_busy_forbidden_and_two_equal_ones_are_one_line_each() -> None:
    clock = VirtualClock()
    bus = EmulatedUsb(clock)
    with pytest.raises(DeviceNotFound, match="1fc9:04d8"):
        open_scanner("lasercube", bus, clock)
    attached = bus.plug(LaserCubeModel(serial="A"))
    with open_scanner("lasercube", bus, clock), pytest.raises(DeviceBusy, match="another program"):
        open_scanner("lasercube", bus, clock)
    attached.denied = True
    with pytest.raises(DevicePermission, match=r"70-spadrig\.rules"):
        open_scanner("lasercube", bus, clock)
    attached.denied = False
    bus.plug(LaserCubeModel(serial="B"))
    with pytest.raises(DeviceError, match="2 are attached; set port to one of usb:serial=A, usb:serial=B"):
        open_scanner("lasercube", bus, clock)
