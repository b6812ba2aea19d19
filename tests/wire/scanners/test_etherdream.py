"""The Ether Dream driver: its bytes, what it makes of replies, and whole runs over the firmware model.

Golden bytes: the structures of ether-dream.com/protocol.html, and what an Ether Dream 2 was sent and answered
(`ModulaserApp/laser-dac-rs` 01321db, tests/fixtures/ether_dream/ed2_r331_hw_*).
"""

import socket
import threading
from collections.abc import Callable
from contextlib import closing
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceError, DeviceFault, DeviceNotFound, DeviceTimeout
from drivers.errors import LimitExceeded as Limit
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, DeviceState
from drivers.registry import config_of, lookup
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.etherdream import EtherDream, EtherDreamConfig
from drivers.scanners.etherdream_line import (
    ACCEPTED,
    PREPARED,
    REPLY_S,
    Broadcast,
    EtherDreamLine,
    Reply,
    begin,
    broadcasts,
    data,
    queue_rate,
)
from drivers.scanners.etherdream_stream import TIMER_HZ, PointStream, encode, nearest_rate, pps_of
from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.firmware.helios import BLUE, CENTRE, GREEN, INTENSITY, RED
from tests.wire.emulated_scanners import GALVO, cosine, finish, play
from tests.wire.scanners.etherdream import TcpWire, let_pass, open_etherdream, wired

BROADCAST = bytes.fromhex("d880390000000a0002003b0fa08601000000000000003377000000000000000000000000")
STEP = 2 / 4095


def points(*commands: float, markers: int = 0, lit: bool = False) -> PointSlice:
    n = len(commands)
    return PointSlice(np.array(commands), np.full(n, markers, np.uint8), np.full(n, lit))


def test_commands_and_points_are_the_bytes_that_a_board_accepted() -> None:
    assert begin(30_000).hex() == "62000030750000"
    assert queue_rate(25_000).hex() == "71a8610000"
    assert data(b"", 1500).hex() == "64dc05"
    # Control, then x, y, r, g, b, i, u1, u2 of 16 bits each, low byte first.
    dark, all_on = points(-1.0), points(1.0, markers=MARKER_LINE | MARKER_SCAN | LEVEL_BACKWARD, lit=True)
    assert encode(dark, "x", rate_change=True).hex(" ", 2) == "0080 0880 0000 0000 0000 0000 0000 0000 0000"
    assert encode(all_on, "x").hex(" ", 2) == "0000 f87f 0000 ffff ffff ffff ffff 0000 0000"
    assert encode(all_on, "y").hex(" ", 2) == "0000 0000 f87f ffff ffff ffff ffff 0000 0000"
    for bit, word in ((MARKER_LINE, 4), (MARKER_SCAN, 5), (LEVEL_BACKWARD, 6)):
        assert np.flatnonzero(np.frombuffer(encode(points(0.0, markers=bit), "x"), "<u2")).tolist() == [word]


def test_a_12_bit_converter_that_drops_the_lowest_bits_gets_the_nearest_step_and_0_is_the_centre() -> None:
    command = np.linspace(-1, 1, 20_001)
    x = np.frombuffer(encode(points(*command), "x"), "<i2")[1::9].astype(int)
    step = (x + 0x8000) >> 4
    assert np.abs(step - (command + 1) / 2 * 4095).max() <= 0.5 + 1 / 16
    assert step[[0, 10_000, 20_000]].tolist() == [0, 0x800, 4095]


def test_replies_and_broadcasts_are_read_as_the_board_means_them() -> None:
    # 1500 points were sent, at 30 kHz, 3 ms before.
    reply = Reply.read(bytes.fromhex("613f0000020000003177000086053075000056000000"))
    assert reply == Reply(b"a", 0, 2, 0, 0x7731, 1414, 30_000, 86)
    assert Broadcast.read(BROADCAST) == Broadcast("d8:80:39:00:00:00", 10, 2, 3899, 100_000)
    assert Broadcast.read(BROADCAST[:-1]) is None


def test_broadcasts_are_heard_among_other_datagrams() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    ended = threading.Event()

    def broadcast() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            while not ended.wait(0.01):
                for datagram in (b"something else", BROADCAST):
                    board.sendto(datagram, ("127.0.0.1", port))

    thread = threading.Thread(target=broadcast)
    thread.start()
    with closing(broadcasts(5.0, port)) as heard:
        assert next(heard) == ("127.0.0.1", Broadcast.read(BROADCAST))
    ended.set()
    thread.join()
    assert list(broadcasts(0.05, port)) == []


def test_the_rate_is_the_one_that_the_boards_divider_makes() -> None:
    for asked_hz, cycles in ((30_000, 800), (44_100, 544), (100_000, 240), (1000, 24_000)):
        assert nearest_rate(asked_hz, 1000, 100_000) == Fraction(TIMER_HZ, cycles)
    for requested_hz in np.geomspace(1000, 100_000, 3000):
        rate = nearest_rate(requested_hz, 1000, 100_000)
        assert nearest_rate(float(rate), 1000, 100_000) == rate
        assert Fraction(TIMER_HZ, TIMER_HZ // pps_of(rate)) == rate
        assert abs(rate - requested_hz) <= requested_hz**2 / TIMER_HZ / 2 + 1


def test_a_config_has_units_and_limits_and_needs_a_port_and_the_galvos_limits() -> None:
    usual = {"port": "10.0.0.7", **GALVO}
    config = config_of(EtherDreamConfig, **usual, buffer="40 ms", max_point_rate="20 kHz")
    assert (config.buffer, config.max_point_rate) == (0.04, 20_000)
    for name in usual:
        with pytest.raises(Limit, match=name):
            config_of(EtherDreamConfig, **{key: value for key, value in usual.items() if key != name})
    for wrong in ({"max_point_rate": "100.1 kHz"}, {"max_point_rate": "1 kHz"}, {"buffer": "1 ms"}):
        with pytest.raises(Limit, match=next(iter(wrong))):
            config_of(EtherDreamConfig, **usual, **wrong)
    assert lookup("scanner", "etherdream").config is EtherDreamConfig


@pytest.mark.parametrize(
    ("port", "rate_hz", "error", "told"),
    [
        ("127.0.0.1", 3e4, DeviceNotFound, "127.0.0.1:7765"),
        ("127.0.0.1:1", 3e4, DeviceNotFound, "127.0.0.1:1 "),
        ("emulated:dac", 3e4, DeviceNotFound, "emulated:dac"),
        ("127.0.0.1:1", 2e5, Limit, "max_point_rate"),
    ],
)
def test_what_cannot_be_opened_is_named(port: str, rate_hz: float, error: type[DeviceError], told: str) -> None:
    with pytest.raises(error, match=told):
        EtherDream.open(port, max_velocity_per_s=1.0, max_acceleration_per_s2=1.0, max_point_rate_hz=rate_hz)


# What replies mean.


class Board(EtherDreamLine):
    """A line to a board whose next reply a test determines."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.commands: list[bytes] = []
        self.says(playback=PREPARED)

    def says(self, engine: int = 0, playback: int = 2, flags: int = 0, code: bytes = ACCEPTED, **numbers: int) -> None:
        self.reply = Reply(
            code, engine, playback, 0, flags, **{"fullness": 0, "rate_hz": 10_000, "count": 0, **numbers}
        )

    def ask(self, command: bytes, within_s: float = REPLY_S) -> Reply:
        self.commands.append(command)
        self.within_s = within_s
        return self.reply


@pytest.fixture
def playing() -> tuple[Board, PointStream, VirtualClock]:
    """100 points were sent at 10 kHz, and play."""
    board, clock = Board(), VirtualClock()
    stream = PointStream(board, "dac", "x", 1799, clock)
    stream.change_rate(Fraction(10_000), 500)
    board.says(playback=PREPARED, fullness=100)
    stream.send(points(*[0.0] * 100))
    board.says(fullness=100)
    stream.begin()
    return board, stream, clock


Playing = tuple[Board, PointStream, VirtualClock]


def test_room_ends_with_the_rates_share_the_buffer_and_a_command_and_a_new_rate_is_asked_for_once(
    playing: Playing,
) -> None:
    board, stream, clock = playing
    assert [command[:7].hex() for command in board.commands] == ["70", "64640000000000", "62000010270000"]
    assert stream.room == 400
    stream.change_rate(Fraction(1000), 250)
    assert stream.room == 250
    assert board.commands[-1].hex() == "71e8030000"
    for fullness, control in ((102, 0x8000), (104, 0)):
        board.says(fullness=fullness)
        stream.send(points(0.0, 0.0))
        words = np.frombuffer(board.commands[-1][3:], "<u2")
        assert words[[0, 9]].tolist() == [control, 0]
    small = PointStream(board, "dac", "x", 120, clock)
    small.change_rate(Fraction(1000), 250)
    assert small.room == 120


@pytest.mark.parametrize(
    ("says", "told"),
    [
        ({"fullness": 80, "count": 19}, "of 100 points sent, 80 are queued"),
        ({"fullness": 80, "count": 22}, "of 100 points sent, 80 are queued"),
        ({"fullness": 80, "count": 21 + 2**31}, "of 100 points sent, 80 are queued"),
        ({"playback": 0, "flags": 0x7733, "code": b"I"}, "jumped to the centre: .*ran dry"),
        ({"playback": 0, "flags": 0x7735, "engine": 3, "code": b"I"}, "jumped to the centre: .*emergency stop"),
        ({"playback": 0, "flags": 0x7731, "code": b"I"}, "jumped to the centre: .*elsewhere"),
        ({"fullness": 100, "code": b"F"}, "refused"),
        ({"fullness": 80, "count": 20, "rate_hz": 9000}, "plays at 9000 Hz instead of 10000 Hz"),
        ({"fullness": 80, "count": 20, "after_s": 1.0}, "clock is not the expected one"),
        ({"fullness": 100, "after_s": 1.1}, "plays no points"),
    ],
)
def test_a_reply_that_does_not_fit_is_a_fault(playing: Playing, says: dict[str, Any], told: str) -> None:
    board, stream, clock = playing
    clock.sleep(2e-3)
    board.says(fullness=80, count=20)
    if "no points" not in told:
        stream.ping()
    clock.sleep(says.pop("after_s", 0.0))
    board.says(**says)
    with pytest.raises(DeviceFault, match=told):
        stream.ping()


def test_a_count_that_is_read_one_point_later_is_no_fault_unless_it_always_is(playing: Playing) -> None:
    board, stream, clock = playing
    for n in range(1, 51):
        clock.sleep(1e-4)
        board.says(fullness=100 - n, count=n + 1)
        stream.ping()
    assert stream.played == 50
    with pytest.raises(DeviceFault, match="lost or repeated"):
        stream.ping()


def test_a_reply_is_waited_for_no_longer_than_queued_points_play(playing: Playing) -> None:
    board, stream, clock = playing
    assert board.within_s == REPLY_S, "nothing played before"
    for fullness in (80, 60):
        clock.sleep(2e-3)
        board.says(fullness=fullness, count=100 - fullness)
        stream.ping()
    assert board.within_s == pytest.approx(80 / 10_000 - 2e-3 + 0.05)
    stream.change_rate(Fraction(1000), 250)
    board.says(fullness=60 + 50, count=40)
    stream.send(points(*[0.0] * 50))
    stream.ping()
    assert board.within_s == pytest.approx(60 / 10_000 + 50 / 1000 + 0.05), "slower ones behind them"
    clock.sleep(0.5)
    stream.ping()
    assert board.within_s == pytest.approx(0.05), "the host was late"


# Whole runs.


class Recorder(EtherDreamModel):
    """Notes the commands it was sent, and when."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.log: list[bytes] = []

    def receive(self, data: bytes, now_s: float) -> None:
        self.log.append(data)
        super().receive(data, now_s)

    @property
    def codes(self) -> str:
        return "".join(chr(one[0]) for one in self.log)


def test_looking_and_closing_moves_nothing_and_each_verb_sends_its_commands() -> None:
    model = Recorder()
    with wired(model) as wire:
        with open_etherdream(wire) as device:
            device.load(cosine(device), 3)
            device.stop()
            assert (device.identity, device.serial) == ("Ether Dream, firmware v0.5.5", None)
        assert model.codes == "v??"
        assert model.history.command(np.linspace(0, 1, 100)) == pytest.approx(np.full(100, CENTRE))
        with open_etherdream(wire) as device:
            play(device, 1)
            del model.log[:]
            device.park()
            device.start()
            device.stop()
        assert set(model.codes) == {"d", "?", "q", "s"}  # playback goes on from run to run
        assert model.codes[-2:] == "?s"
        assert not model.moving(wire.now_s)


@pytest.mark.parametrize("options", [{}, {"by_page": True}, {"clock_error": 5e-4}, {"axis": "y"}, {"capacity": 3899}])
def test_every_point_comes_out_once_and_the_mirror_is_held_at_the_last_and_never_jumps(options: dict[str, Any]) -> None:
    model = EtherDreamModel(**options)
    with wired(model) as wire:
        with open_etherdream(wire, max_point_rate="25 kHz", park=0.8, axis=options.get("axis", "x")) as device:
            wave, limits = cosine(device), device.limits
            for _ in range(2):  # from the idle board, and from the one that holds
                began_s = wire.now_s
                play(device, 3)
                let_pass(wire, 0.01)
                scans = model.history.rising(BLUE, began_s, wire.now_s)
                period_s = 1 / 25_000 / (1 + options.get("clock_error", 0.0))
                assert scans - scans[0] == pytest.approx(np.arange(3) * 6000 * period_s, abs=1e-6)
                assert len(model.history.rising(GREEN, began_s, wire.now_s)) == 180
                assert len(model.history.rising(INTENSITY, began_s, wire.now_s)) == 3
                times = scans[0] + (np.arange(18_000) + 0.5) * period_s
                assert model.history.command(times) == pytest.approx(np.tile(wave.command, 3), abs=0.57 * STEP)
                assert (model.history.level(RED, times) == 255).all()
                assert device.status.position == wave.command[-1]
                let_pass(wire, 0.7)
                assert device.status.fault is None
                assert model.history.command(np.array([wire.now_s])) == pytest.approx(wave.command[-1], abs=STEP)
                assert not model.history.level(RED, np.array([wire.now_s]))
            device.start()
            device.stop()
            device.park()
        drive = np.concatenate([[CENTRE, CENTRE], *(one.command for one in model.history._played), [CENTRE]])
        assert np.abs(np.diff(drive)).max() <= limits.step
        assert np.abs(np.diff(drive, 2)).max() <= limits.acceleration_per_s2 / 25_000**2 + 2 * STEP
        assert drive.max() == pytest.approx(0.8, abs=STEP)
        assert (model.refused, model.lost_rates) == (0, 0)


def _late(wire: TcpWire) -> None:
    with wire.lock:
        wire._clock.sleep(0.5)


def _other_client(wire: TcpWire, n: int = 5) -> None:
    with wire.lock:
        wire.model._ring = np.concatenate([wire.model._ring, wire.model._ring[-n:]])


FAULTS: dict[str, tuple[Callable[[Any], object], str]] = {
    "the host is late": (_late, "ran dry"),
    "another client sends points": (_other_client, "lost or repeated"),
    "another client stops": (lambda wire: wire.model._stop(0, wire.now_s), "stopped from elsewhere"),
    "emergency stop": (lambda wire: wire.model._emergency_stop(1, wire.now_s), "emergency stop"),
    "link lost and back": (lambda wire: [wire.model.link(up, wire.now_s) for up in (False, True)], "emergency stop"),
    "power lost": (lambda wire: wire.model.power_up(wire.now_s), "elsewhere"),
    "another rate": (lambda wire: wire.model._set_rate(900, wire.now_s), "at 900 Hz"),
}


@pytest.mark.parametrize("held", [False, True], ids=["running", "held"])
@pytest.mark.parametrize("name", FAULTS)
def test_what_ends_a_run_or_the_hold_is_a_fault_and_the_next_run_begins_at_the_centre(name: str, held: bool) -> None:
    strike, told = FAULTS[name]
    with wired() as wire, open_etherdream(wire) as device:
        device.load(cosine(device), 3 if held else 1000)
        device.start()
        finish(device) if held else let_pass(wire, 0.1)
        let_pass(wire, 0.3 if held else 0.0)
        with wire.lock:
            strike(wire)
        let_pass(wire, 0.1)
        finish(device)
        assert told in str(device.status.fault)
        assert device.status.position is None
        device.stop()
        device.load(cosine(device), 1)
        began_s = wire.now_s
        play(device, 1)
        assert device.status.fault is None
        assert wire.model.history.command(np.array([began_s]))[0] == CENTRE


def test_a_mirror_that_is_not_held_any_more_is_parked_again_and_starts_at_once() -> None:
    with wired() as wire, open_etherdream(wire, park=0.8) as device:

        def lose() -> None:
            with wire.lock:
                for up in (False, True):
                    wire.model.link(up, wire.now_s)
            let_pass(wire, 0.3)
            assert wire.model.history.command(np.array([wire.now_s]))[0] == CENTRE

        device.park()
        lose()
        device.park()
        assert wire.model.history.command(np.array([wire.now_s]))[0] == pytest.approx(0.8, abs=1e-3)
        assert device.status.fault is None
        lose()
        device.load(cosine(device), 1)
        device.start()
        finish(device)
        assert device.status.fault is None
        lose()


def test_a_board_in_emergency_stop_is_closed_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with wired() as wire:
        device = open_etherdream(wire)
        device.load(cosine(device), 1000)
        device.start()
        let_pass(wire, 0.1)
        with wire.lock:
            wire.model.stop_input(True, wire.now_s)
        device.close()
        assert "stays in emergency stop" in caplog.text


def test_a_single_point_too_many_shortly_before_the_end_is_a_fault() -> None:
    model = Recorder()
    with wired(model) as wire, open_etherdream(wire) as device:
        device.load(cosine(device), 1)
        receive = model.receive

        def joined(data: bytes, now_s: float) -> None:
            receive(data, now_s)
            if len(model.log) == 110:
                _other_client(wire, 1)

        model.receive = joined  # type: ignore[method-assign]
        device.start()
        finish(device)
        assert "lost or repeated" in str(device.status.fault)


def test_a_lost_connection_is_told_and_a_board_that_hangs_ends_the_run_in_time(
    caplog: pytest.LogCaptureFixture,
) -> None:
    for strike, error in ((TcpWire.unplug, DeviceDisconnected), (TcpWire.hang, DeviceTimeout)):
        with wired() as wire:
            device = open_etherdream(wire)
            device.load(cosine(device), 1000)
            device.start()
            let_pass(wire, 0.1)
            faults: list[float] = []
            device.on_fault = lambda wire=wire, faults=faults: faults.append(wire.now_s)  # type: ignore[misc]
            with wire.lock:
                began_s = wire.now_s
                strike(wire)
            if error is DeviceDisconnected:
                with pytest.raises(error, match="cable"):
                    finish(device)
                device.close()
            else:
                finish(device)
                assert "in reply to command" in str(device.status.fault)
                assert faults[0] - began_s < 0.06 + 0.05 + 0.01, "as long as points were queued, and 50 ms"
                device.close()
                assert "could not be left safe: Ether Dream: 0 of 22 B" in caplog.text
            assert wire.now_s - began_s < 2
            assert device.state is DeviceState.CLOSED
            wire._clock.sleep(0.5)
            assert not wire.model.moving(wire.now_s)
            assert wire.model.history.command(np.array([wire.now_s]))[0] == CENTRE


@pytest.mark.parametrize("parked", [False, True])
def test_a_board_that_hangs_is_closed_within_a_second_without_an_error(
    parked: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with wired() as wire:
        device = open_etherdream(wire)
        if parked:
            device.park()
        with wire.lock:
            began_s = wire.now_s
            wire.hang()
        device.close()
        assert wire.now_s - began_s < 1.1
        assert "could not be left safe" in caplog.text


def test_a_board_in_use_or_stopped_is_refused_or_cleared() -> None:
    with wired() as wire:
        model: Any = wire.model
        model.receive(b"p" + data(bytes(18 * 1500), 1500) + begin(1000), 0.0)
        open_etherdream(wire).close()  # what is left of an earlier program plays to its end
        model.receive(b"p" + data(bytes(18 * 1799), 1799) + begin(100), wire.now_s)
        with pytest.raises(DeviceBusy, match="plays for another client"):
            open_etherdream(wire)
        model.power_up(wire.now_s)
        model.receive(b"p\0", wire.now_s)
        open_etherdream(wire).close()
        assert model.light_engine == 0
        model.stop_input(True, wire.now_s)
        with pytest.raises(DeviceFault, match="stays in emergency stop"):
            open_etherdream(wire)
        model.stop_input(False, wire.now_s)
        model.hung_up = True
        model.connected = lambda now_s: None
        with pytest.raises(DeviceBusy, match="closed it at once"):
            open_etherdream(wire)


@pytest.mark.parametrize("at", range(1, 90, 6))
def test_an_interrupt_on_the_way_leaves_it_dark_at_the_centre_and_nothing_running(at: int) -> None:
    model = Recorder()
    with wired(model) as wire:
        with pytest.raises(KeyboardInterrupt), open_etherdream(wire) as device:  # noqa: PT012
            play(device, 1)
            receive, main = model.receive, threading.current_thread()

            def interrupted(data: bytes, now_s: float) -> None:
                nonlocal at
                receive(data, now_s)
                at -= threading.current_thread() is main
                if at == 0:
                    raise KeyboardInterrupt

            model.receive = interrupted  # type: ignore[method-assign]
            device.park()
            raise KeyboardInterrupt
        wire._clock.sleep(0.5)
        assert not model.moving(wire.now_s)
        assert model.history.command(np.array([wire.now_s]))[0] == CENTRE
        assert not any(thread.name.startswith("Ether Dream") for thread in threading.enumerate())
