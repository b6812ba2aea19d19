"""The model of the Ether Dream firmware alone, raw bytes against the protocol page and the firmware. No driver."""

import socket
import struct

import numpy as np
import pytest

from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.firmware.helios import BLUE, CENTRE, GREEN, INTENSITY, RED, Array
from sim_backend.wire.serve.tcp import HOST, TcpServer

PREPARE, STOP, CLEAR, PING, VERSION = b"p", b"s", b"c", b"?", b"v"
CLIENTS_BUFFER = 1799
P_S = 1 / 25_000
"""Period at 25 kHz: 960 ticks of 24 MHz."""


def begin(rate_hz: int) -> bytes:
    return b"b\0\0" + struct.pack("<I", rate_hz)


def update(rate_hz: int) -> bytes:
    return b"u\0\0" + struct.pack("<I", rate_hz)


def queue(rate_hz: int) -> bytes:
    return b"q" + struct.pack("<I", rate_hz)


def point(x: int = 0, y: int = 0, *, rgbi: tuple[int, int, int, int] = (0, 0, 0, 0), control: int = 0) -> bytes:
    return struct.pack("<HhhHHHHHH", control, x, y, *rgbi, 0, 0)


def data(*points: bytes) -> bytes:
    return b"d" + struct.pack("<H", len(points)) + b"".join(points)


def status(
    engine: int = 0, playback: int = 0, *, flags: int = 0, fullness: int = 0, rate: int = 0, count: int = 0
) -> bytes:
    return struct.pack("<BBBBHHHHII", 0, engine, playback, 0, engine, flags, 0, fullness, rate, count)


class Talk:
    """A client of the model at a time of its own."""

    def __init__(self, model: EtherDreamModel) -> None:
        self.model, self.now_s = model, 1.0
        model.connected(self.now_s)
        model.send(1000, self.now_s)

    def __call__(self, sent: bytes, after_s: float = 0.0) -> bytes:
        self.now_s += after_s
        self.model.receive(sent, self.now_s)
        return self.model.send(100_000, self.now_s)

    def acks(self, sent: bytes, after_s: float = 0.0) -> bytes:
        """Responses and commands of the replies, without their status."""
        reply = self(sent, after_s)
        return b"".join(reply[at : at + 2] for at in range(0, len(reply), 22))

    def fields(self) -> tuple[int, ...]:
        """Light engine, playback, playback flags, fullness, rate, count."""
        _, engine, playback, _, _, flags, _, fullness, rate, count = struct.unpack("<BBBBHHHHII", self(PING)[2:])
        return engine, playback, flags, fullness, rate, count


def ramp(points: int) -> list[bytes]:
    return [point(16 * step, rgbi=(0xFFFF, 0, 0, 0)) for step in range(points)]


def periods(first: float, count: int) -> Array:
    """Times in the middle of periods after the start at 1 s; first: number of the first one."""
    return np.linspace(1.0 + (first + 0.5) * P_S, 1.0 + (first + count - 0.5) * P_S, count)


def steps(model: EtherDreamModel, *times_s: float) -> list[int]:
    """Position of the mirror, in steps of the converter from the centre."""
    command = model.history.command(np.array(times_s))
    return [round(float((one + 1) / 2 * 4095)) - 0x800 for one in command]


def test_replies_broadcast_and_version_are_the_bytes_of_the_page() -> None:
    model = EtherDreamModel()
    model.connected(0.0)  # as if it had pinged
    assert model.send(1000, 0.0).hex(" ") == "61 3f 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"
    talk = Talk(model)
    assert talk(VERSION) == b"v0.5.5".ljust(32, b"\0")
    talk(PREPARE + data(point(), point()))
    assert model.broadcast(1.0).hex(" ") == (
        "00 04 a3 87 28 cd 01 00 02 00 07 07 a0 86 01 00 00 00 01 00 00 00 00 00 00 00 02 00 00 00 00 00 00 00 00 00"
    )


def test_a_stream_from_prepare_to_stop() -> None:
    talk = Talk(EtherDreamModel())
    assert talk(PREPARE) == b"ap" + status(0, 1)
    assert talk(data(*ramp(100))) == b"ad" + status(0, 1, fullness=100)
    assert talk(begin(25_000)) == b"ab" + status(0, 2, flags=1, fullness=100, rate=25_000)
    assert talk(PING, 10.5 * P_S) == b"a?" + status(0, 2, flags=1, fullness=90, rate=25_000, count=10)
    assert talk(STOP) == b"as" + status(0, 0, fullness=90), "the ring keeps its points"
    assert talk(PREPARE) == b"ap" + status(0, 1)


PLAY = PREPARE + data(*ramp(100)) + begin(25_000)
TOO_FAST = b"q" + struct.pack("<I", 0x3F00_3F3F)


@pytest.mark.parametrize(
    ("by_page", "dialogue"),
    [
        # Out of place: refused, read to the end.
        (False, [(STOP + PREPARE + PREPARE, b"IsapIp"), (b"\0" + PREPARE, b"a\0Ip")]),
        (False, [(data(), b"ad"), (data(*ramp(5)) + PING, b"Ida?")]),
        # Begin is acknowledged though nothing is prepared or there are no points: the first period underflows.
        (False, [(begin(20_000), b"ab"), (PREPARE + begin(25_000), b"apab")]),
        # A rate beyond the highest costs one byte, and the rest is read as commands: the zero is an emergency stop.
        (False, [(begin(100_000), b"ab"), (TOO_FAST, b"Iqa?a?a\0a?"), (CLEAR + begin(100_001), b"acIba\0a\0")]),
        # Queued rates are acknowledged though they are dropped; c without a stop.
        (False, [(queue(1000) + CLEAR, b"aqac"), (PREPARE + queue(1000) * 200, b"ap" + b"aq" * 200)]),
        # Data that does not fit is taken in part and refused as invalid.
        (False, [(PREPARE + data(*ramp(1790)), b"apad"), (data(*ramp(20)) + data(point()), b"IdId")]),
        # An emergency stop remains until it is cleared.
        (False, [(PLAY + b"\xff", b"apadaba\xff"), (data(point()) + begin(1000) + b"\0" + CLEAR, b"Idaba\0ac")]),
        # By the page what the firmware lets pass is refused.
        (True, [(begin(25_000) + queue(1000) + CLEAR + data(), b"IbIqIcId")]),
        (True, [(PREPARE + begin(25_000) + begin(100_001) + update(0), b"apIbIbIu")]),
        (True, [(PREPARE + queue(1000) * 200, b"ap" + b"aq" * 199 + b"Fq")]),
        (True, [(PREPARE + data(*ramp(1790)) + data(*ramp(20)), b"apadFd"), (b"x" + data(point()), b"axId")]),
    ],
)
def test_commands_are_answered_as_firmware_and_page_do(by_page: bool, dialogue: list[tuple[bytes, bytes]]) -> None:
    at_once, one_by_one = Talk(EtherDreamModel(by_page=by_page)), Talk(EtherDreamModel(by_page=by_page))
    for sent, expected in dialogue:
        assert at_once.acks(sent) == expected
        assert b"".join(one_by_one.acks(bytes((one,))) for one in sent) == expected
        hung_up = at_once.model.hung_up
        assert one_by_one.model.hung_up == hung_up
        assert hung_up or at_once.fields() == one_by_one.fields()


def test_what_was_dropped_is_counted_and_what_was_taken_kept() -> None:
    talk = Talk(EtherDreamModel())
    talk(queue(1000) + PREPARE + queue(1000) * 200 + data(*ramp(1790)) + data(*ramp(20)))
    assert (len(talk.model.queued_rates), talk.model.lost_rates, talk.model.refused) == (199, 2, 11)
    assert talk.fields()[3] == CLIENTS_BUFFER
    talk(begin(25_000))
    sent = data(*ramp(20))
    assert talk(sent[:-18]) == b""
    assert talk.acks(sent[-18:], 10.5 * P_S) == b"Id", "a packet that was refused in part is not taken up again"
    assert talk.fields()[3] == CLIENTS_BUFFER - 10
    talk(STOP + PREPARE)
    assert not talk.model.queued_rates
    talk.acks(begin(25_000))
    talk.now_s += 1.01 * P_S
    assert talk.fields() == (0, 0, 2, 0, 0, 0), "without points it underflows"


def test_a_rate_of_zero_stops_the_processor_until_the_power_comes_anew() -> None:
    for sent in (begin(0), update(0), queue(0) + data(point(), point(control=0x8000)) + begin(1000)):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + sent)
        assert talk(PING, 0.01) == b""
        assert talk.model.panicked
        talk.model.power_up(talk.now_s)
        assert talk.acks(PING) == b"a?"


def test_a_server_hangs_up_with_its_model() -> None:
    with TcpServer(EtherDreamModel()) as server:
        for _ in range(2):
            with socket.create_connection((HOST, int(server.address.split(":")[1])), 5.0) as client:
                client.sendall(PING + b"x")
                received = b""
                while piece := client.recv(100):
                    received += piece
            assert received == b"a?" + status() + b"a?" + status()


@pytest.mark.parametrize("end", ["client", "unknown command", "stop", "emergency", "input", "link", "power"])
def test_what_ends_playback_and_what_does_not(end: str) -> None:
    talk = Talk(EtherDreamModel())
    model = talk.model
    talk(PLAY)
    now_s = talk.now_s = 1.0 + 50 * P_S
    match end:
        case "client":
            model.disconnected(now_s)
        case "unknown command":
            assert talk.acks(PING + b"x" + STOP) == b"a?"
            assert model.hung_up
        case "stop":
            assert talk(STOP) == b"as" + status(0, 0, fullness=50)
        case "emergency":
            assert talk(b"\0") == b"a\0" + status(3, 0, flags=4, fullness=50), "its state for its flags"
            assert talk(CLEAR) == b"ac" + status(0, 0, flags=4, fullness=50)
        case "input":
            model.stop_input(True, now_s)
            assert talk(CLEAR) == b"!c" + status(3, 0, flags=4, fullness=50)
            model.stop_input(False, now_s)
            assert talk.fields()[0] == 3
            assert talk.acks(CLEAR + PREPARE) == b"acap"
        case "link":
            model.link(False, now_s)
            assert model.light_engine == 3
            model.link(True, now_s)
            assert talk.fields() == (0, 0, 4, 50, 0, 0)
        case "power":
            model.power_up(now_s)
            assert talk.fields() == (0, 0, 0, 0, 0, 0)
    plays_on = end in ("client", "unknown command")
    assert model.moving(now_s + 49 * P_S) == plays_on
    assert not model.moving(now_s + 51.5 * P_S)
    assert model.history.command(np.array([now_s + 40.5 * P_S]))[0] > CENTRE or not plays_on
    assert model.history.command(np.array([2.0]))[0] == CENTRE
    if end == "client":
        model.connected(2.0)
        assert model.send(100, 2.0) == b"a?" + status(0, 0, flags=2)


def test_prepared_points_wait_for_the_next_client_and_a_half_command_does_not() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(3)) + b"d\x05\0" + point())
    talk.model.disconnected(1.0)
    talk.model.connected(2.0)
    assert talk.model.send(100, 2.0) == b"a?" + status(0, 1, fullness=4)
    assert talk.acks(PREPARE) == b"Ip"


def test_a_point_is_shown_in_the_second_period_after_it_was_due_and_the_last_one_never() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.advance(2.0)
    shown = periods(0, 102)
    assert steps(talk.model, *shown) == [0, 0, *range(99), 0]
    lit = talk.model.history.level(RED, shown)
    assert lit.tolist() == [0, 0, *[255] * 99, 0]
    assert talk.model.history.command(np.array([3.0]))[0] == CENTRE
    edges = talk.model.history.rising(RED, 0.0, 2.0)
    assert edges == pytest.approx([1.0 + 2 * P_S], abs=1e-9)


def test_the_drive_has_12_bits_of_16() -> None:
    along = (-32768, -1, 0, 15, 16, 32767, 0)
    for model, sent in (
        (EtherDreamModel(axis="x"), [point(x, 77) for x in along]),
        (EtherDreamModel(axis="y"), [point(77, y) for y in along]),
    ):
        talk = Talk(model)
        talk(PREPARE + data(*sent) + begin(25_000))
        model.advance(1.0 + 7.5 * P_S)
        assert steps(model, *periods(2, 6)) == [-2048, -1, 0, 0, 1, 2047]


def test_the_colours_are_four_lines() -> None:
    talk = Talk(EtherDreamModel())
    colours = ((0xFFFF, 0, 0, 0), (0, 0xFFFF, 0, 0), (0, 0, 0x8000, 0), (0, 0, 0, 0x10), (0xF, 0, 0, 0), (0, 0, 0, 0))
    talk(PREPARE + data(*(point(rgbi=one) for one in colours)) + begin(25_000))
    talk.model.advance(2.0)
    at = periods(2, 5)
    levels = [talk.model.history.level(line, at).tolist() for line in (RED, GREEN, BLUE, INTENSITY)]
    assert levels == [[255, 0, 0, 0, 0], [0, 255, 0, 0, 0], [0, 0, 128, 0, 0], [0, 0, 0, 1, 0]]


@pytest.mark.parametrize(("rate_hz", "ticks"), [(25_000, 960), (30_000, 800), (7_000, 3428), (99_999, 240), (1, 24e6)])
def test_the_period_is_a_whole_number_of_ticks_of_24_mhz(rate_hz: int, ticks: float) -> None:
    for extra, error in ((0, 0.0), (1, 0.0), (0, 1e-4)):
        talk = Talk(EtherDreamModel(extra_ticks=extra, clock_error=error))
        talk(PREPARE + data(point(rgbi=(0xFFFF, 0, 0, 0)), point(), point()) + begin(rate_hz))
        talk.model.advance(1.0 + 3.5 / rate_hz)
        period_s = (ticks + extra) / 24e6 / (1 + error)
        assert talk.model.history.rising(RED, 0, 10) == pytest.approx([1.0 + 2 * period_s], rel=1e-12)
        assert talk.fields()[4] == rate_hz, "the rate as it was asked for"


def test_a_stop_is_at_once() -> None:
    for code in (STOP, b"\0"):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + data(*ramp(1000)) + begin(25_000))
        talk(code, 500.25 * P_S)
        assert steps(talk.model, 1.0 + 500.2 * P_S, 1.0 + 500.3 * P_S, 2.0) == [498, 0, 0]
        assert talk.model.history.level(RED, np.array([talk.now_s - 1e-6, talk.now_s + 1e-6])).tolist() == [255, 0]


def test_a_queued_rate_comes_with_the_point_that_asks_for_it() -> None:
    talk = Talk(EtherDreamModel())
    points = [point(160), point(320), point(480, control=0x8000), point(640, control=0x8000), point(800), point()]
    talk(PREPARE + queue(12_500) + data(*points) + begin(25_000))
    talk.model.advance(1.0 + 3.5 * P_S)
    assert talk.fields()[4] == 12_500
    talk.model.advance(1.0 + 10.5 * P_S)
    ends = np.array([2, 3, 4, 6, 8, 10]) * P_S + 1.0
    assert steps(talk.model, *(ends - 1e-7)) == [0, 10, 20, 30, 40, 50]
    assert steps(talk.model, *(ends[:-1] + 1e-7)) == [10, 20, 30, 40, 50]


def test_an_update_comes_with_the_next_period() -> None:
    for code in (update, begin):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + data(*ramp(100)) + begin(25_000))
        assert talk.acks(code(12_500), 10.5 * P_S) == b"a" + code(0)[:1]
        talk.model.advance(2.0)
        ends = np.array([10, 11, 13, 15]) * P_S + 1.0
        assert steps(talk.model, *(ends + 1e-7)) == [8, 9, 10, 11]
