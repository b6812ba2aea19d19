"""What every scanner behind a DAC does, over its firmware model: opening, running, giving it back, going wrong."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceError, DeviceNotFound, DevicePermission
from drivers.interfaces import DeviceState
from drivers.scanners.helios import HeliosRun
from sim_backend.wire.firmware.helios import DAC_STEPS, KEEP_S, DacHistory, Played
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.emulated_scanners import (
    HeliosRecorder,
    LaserCubeRecorder,
    Recording,
    cosine,
    finish,
    open_scanner,
    opened,
    play,
    plug,
)

STEP = 2 / DAC_STEPS


@dataclass(frozen=True)
class Kind:
    """late: a transfer of points in the middle of a run. equal: options of two boards and how they are told apart."""

    name: str
    board: type[Recording]
    ids: str
    late: int
    equal: tuple[dict[str, Any], dict[str, Any], str]


HELIOS = Kind("helios", HeliosRecorder, "1209:e500", 4, ({}, {}, "usb:path=1-1, usb:path=1-2"))
LASERCUBE = Kind(
    "lasercube", LaserCubeRecorder, "1fc9:04d8", 60, ({"serial": "A"}, {"serial": "B"}, "usb:serial=A, usb:serial=B")
)
over_both = pytest.mark.parametrize("kind", [HELIOS, LASERCUBE], ids=lambda kind: kind.name)


@over_both
def test_opening_looking_and_closing_moves_nothing_and_sends_no_points(kind: Kind) -> None:
    clock, model = VirtualClock(), kind.board()
    with opened(kind.name, model, clock) as (device, plugged):
        opened_s = plugged.now_s()
        assert not device.status.moving
        device.load(cosine(device), 3)
        device.stop()
    clock.sleep(1.0)
    assert model.sent(model.points_endpoint) == []
    command = model.history.command(np.linspace(opened_s, plugged.now_s(), 1000))
    assert (command == command[0]).all()
    assert abs(command[0]) <= STEP


@over_both
def test_steps_and_accelerations_stay_within_the_limits_from_start_to_close(kind: Kind) -> None:
    clock, model = VirtualClock(), kind.board()
    with opened(kind.name, model, clock, max_point_rate="25 kHz", park=0.8) as (device, _):
        device.load(cosine(device), 1000)
        device.start()
        device.stop()
        device.start()
        limits, rate_hz = device.limits, 25_000
    x = np.concatenate([one.command for one in model.history._played])
    x = np.concatenate([[0.0, 0.0], x, [model.history.command(np.array([1e9]))[0]]])
    assert np.abs(np.diff(x)).max() <= limits.step
    # Half a step of the converter on either side of each of three points.
    assert np.abs(np.diff(x, 2)).max() <= limits.acceleration_per_s2 / rate_hz**2 + 2 * STEP
    assert x.max() >= 0.8 - STEP


@over_both
def test_a_stop_brakes_and_leaves_the_mirror_where_the_driver_says(kind: Kind) -> None:
    model = kind.board()
    with opened(kind.name, model) as (device, plugged):
        device.load(cosine(device), 1000)
        device.start()
        device.stop()
        position = device.status.position
        assert position is not None
        assert model.history.command(np.array([plugged.now_s()]))[0] == pytest.approx(position, abs=STEP)
        assert not model.moving(plugged.now_s())


@over_both
def test_a_host_that_was_busy_too_long_ends_the_run_with_a_fault(kind: Kind) -> None:
    clock = VirtualClock()
    model = kind.board(clock, kind.late)
    with opened(kind.name, model, clock) as (device, _):
        play(device, 100)
        fault = device.status.fault
        assert fault is not None
        assert "ran dry" in fault or "lost or played late" in fault
        device.stop()
        device.start()
        assert device.status.fault is None


@over_both
def test_after_a_fault_the_mirror_goes_on_from_the_centre_where_the_board_has_put_it(kind: Kind) -> None:
    clock = VirtualClock()
    model = kind.board(clock, kind.late)
    with opened(kind.name, model, clock, max_point_rate="25 kHz", park=0.6) as (device, plugged):
        play(device, 100)
        assert device.status.fault is not None
        since_s = plugged.now_s()
        device.park()
        drive = model.history.command(np.arange(since_s, plugged.now_s(), 1 / 25_000))
        moved = np.flatnonzero(np.abs(np.diff(drive)) > device.limits.step)
        assert len(moved) <= 1, "the board itself jumps, once"
        assert np.abs(drive[moved + 1]).max(initial=0.0) <= STEP, "to the centre"
        assert abs(drive[-1] - 0.6) <= 3 * STEP


@over_both
def test_a_firmware_that_hangs_ends_the_run_and_lets_itself_be_closed_within_its_deadline(
    kind: Kind, caplog: pytest.LogCaptureFixture
) -> None:
    clock, model = VirtualClock(), kind.board()
    device = open_scanner(kind.name, plug(model, clock).bus, clock)
    device.load(cosine(device), 100_000)
    device.start()
    model.deaf = True
    began = clock.now_ns()
    finish(device)
    assert device.status.fault is not None
    device.close()
    assert "could not be left safe" in caplog.text
    assert (clock.now_ns() - began) / 1e9 < 2


def test_a_fault_of_the_driver_itself_is_told_too(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with opened("helios", HeliosRecorder()) as (device, _):
        done: list[str] = []
        monkeypatch.setattr(HeliosRun, "feed", lambda *_: 1 / 0)
        monkeypatch.setattr(HeliosRun, "give_up", lambda _: done.append("given up"))

        def fails() -> None:
            done.append("told")
            raise RuntimeError("no gate")

        device.on_fault = fails
        play(device, 3)
        monkeypatch.undo()
        assert done == ["told", "given up"]
        assert "no gate" in caplog.text
        assert device.status.fault is not None
        assert "ZeroDivisionError" in device.status.fault


@over_both
def test_unplugging_during_a_run_is_a_disconnection(kind: Kind) -> None:
    clock = VirtualClock()
    plugged = plug(kind.board(), clock)
    device = open_scanner(kind.name, plugged.bus, clock)
    device.load(cosine(device), 100_000)
    device.start()
    plugged.attached.unplug()
    with pytest.raises(DeviceDisconnected, match="cable"):
        finish(device)
    with pytest.raises(DeviceDisconnected):
        device.stop()
    device.close()
    plugged.bus.plug(kind.board())
    open_scanner(kind.name, plugged.bus, clock).close()


@over_both
@pytest.mark.parametrize("moved", [False, True])
def test_closing_after_an_unplug_warns_and_raises_nothing(
    kind: Kind, moved: bool, caplog: pytest.LogCaptureFixture
) -> None:
    plugged = plug(kind.board(), VirtualClock())
    device = open_scanner(kind.name, plugged.bus, plugged.clock)
    if moved:
        play(device, 1)
    plugged.attached.unplug()
    device.close()
    assert device.state is DeviceState.CLOSED
    assert "the device is gone" in caplog.text


@over_both
def test_nobody_talks_while_the_device_is_given_back(kind: Kind) -> None:
    model = kind.board()
    with opened(kind.name, model) as (device, _):
        device.load(cosine(device), 1000)
        device.start()
    ends = [index for index, (_, endpoint, _) in enumerate(model.log) if endpoint == model.points_endpoint]
    assert {endpoint for _, endpoint, _ in model.log[ends[-1] + 1 :]} <= {-1, 0x01, 0x06}
    assert len(model.log) - ends[-1] > 2


@over_both
def test_absent_busy_forbidden_and_two_equal_ones_are_one_line_each(kind: Kind) -> None:
    clock = VirtualClock()
    bus = EmulatedUsb(clock)
    first, second, addresses = kind.equal
    with pytest.raises(DeviceNotFound, match=kind.ids):
        open_scanner(kind.name, bus, clock)
    attached = bus.plug(kind.board(**first))
    with open_scanner(kind.name, bus, clock), pytest.raises(DeviceBusy, match="another program"):
        open_scanner(kind.name, bus, clock)
    attached.denied = True
    with pytest.raises(DevicePermission, match=r"70-spadrig\.rules"):
        open_scanner(kind.name, bus, clock)
    attached.denied = False
    bus.plug(kind.board(**second))
    with pytest.raises(DeviceError, match=f"2 are attached; set port to one of {addresses}"):
        open_scanner(kind.name, bus, clock)


def test_what_was_played_long_ago_is_forgotten() -> None:
    history = DacHistory(0.5, 1)
    for second in range(60):
        history.play(Played(second, second + 1, 0.5, np.full(2, second / 60), np.array([[1], [0]], np.uint8)))
    oldest = 59 - KEEP_S - 1
    assert history.rising(0, 0, 60).tolist() == np.arange(oldest, 60).tolist()
    assert history.command(np.array([0.0, oldest])).tolist() == [(oldest - 1) / 60, oldest / 60]  # stood, and plays
