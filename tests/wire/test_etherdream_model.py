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


# Bytes.


def test_it_greets_a_client_as_if_it_had_pinged() -> None:
    model = EtherDreamModel()
    model.connected(0.0)
    assert model.send(1000, 0.0).hex(" ") == "61 3f 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"


def test_the_broadcast_has_36_bytes() -> None:
    model = EtherDreamModel()
    Talk(model)(PREPARE + data(point(), point()))
    assert model.broadcast(1.0).hex(" ") == (
        "00 04 a3 87 28 cd 01 00 02 00 07 07 a0 86 01 00 00 00 01 00 00 00 00 00 00 00 02 00 00 00 00 00 00 00 00 00"
    )


def test_a_version_has_32_bytes_and_no_status() -> None:
    assert Talk(EtherDreamModel())(VERSION) == b"v0.5.5".ljust(32, b"\0")


def test_a_stream_from_prepare_to_stop() -> None:
    talk = Talk(EtherDreamModel())
    assert talk(PREPARE) == b"ap" + status(0, 1)
    assert talk(data(*ramp(100))) == b"ad" + status(0, 1, fullness=100)
    assert talk(begin(25_000)) == b"ab" + status(0, 2, flags=1, fullness=100, rate=25_000)
    assert talk(PING, 10.5 * P_S) == b"a?" + status(0, 2, flags=1, fullness=90, rate=25_000, count=10)
    assert talk(STOP) == b"as" + status(0, 0, fullness=90), "the ring keeps its points"
    assert talk(PREPARE) == b"ap" + status(0, 1)


def test_bytes_may_come_one_by_one() -> None:
    talk = Talk(EtherDreamModel())
    sent = PREPARE + data(*ramp(3)) + queue(30_000) + begin(25_000) + STOP
    assert b"".join(talk(bytes((one,)))[:2] for one in sent) == b"apadaqabas"


def test_data_without_points_is_acknowledged_even_when_idle() -> None:
    assert Talk(EtherDreamModel()).acks(data()) == b"ad"


# Refusals.


def test_prepare_and_stop_are_refused_in_the_wrong_state() -> None:
    talk = Talk(EtherDreamModel())
    assert talk.acks(STOP + PREPARE + PREPARE) == b"IsapIp"
    talk(b"\0")
    assert talk.acks(PREPARE) == b"Ip"


def test_data_is_refused_when_idle_and_read_to_its_end() -> None:
    talk = Talk(EtherDreamModel())
    assert talk.acks(data(*ramp(5)) + PING) == b"Ida?"
    assert talk.model.refused == 5


def test_data_that_does_not_fit_is_taken_in_part_and_refused_as_invalid() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE)
    assert talk.acks(data(*ramp(1790))) == b"ad"
    assert talk(data(*ramp(20))) == b"Id" + status(0, 1, fullness=CLIENTS_BUFFER)
    assert talk.model.refused == 11
    assert talk.acks(data(point())) == b"Id"


def test_a_packet_that_was_refused_in_part_is_not_taken_up_again() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(CLIENTS_BUFFER)) + begin(25_000))
    sent = data(*ramp(20))
    assert talk(sent[:-18]) == b""
    assert talk.acks(sent[-18:], 10.5 * P_S) == b"Id"
    assert talk.fields()[3] == CLIENTS_BUFFER - 10


def test_begin_is_acknowledged_though_nothing_is_prepared_or_there_are_no_points() -> None:
    talk = Talk(EtherDreamModel())
    assert talk(begin(20_000)) == b"ab" + status()
    assert talk.acks(PREPARE + begin(25_000)) == b"apab"
    assert talk.fields() == (0, 2, 1, 0, 25_000, 0)
    talk.now_s += 1.01 * P_S
    assert talk.fields() == (0, 0, 2, 0, 0, 0)


def test_a_rate_beyond_the_highest_costs_one_byte_and_the_rest_is_read_as_commands() -> None:
    talk = Talk(EtherDreamModel())
    assert talk.acks(begin(100_000)) == b"ab"
    assert talk.acks(b"q" + struct.pack("<I", 0x3F00_3F3F)) == b"Iqa?a?a\0a?"
    assert talk.fields()[0] == 3, "the zero was an emergency stop"
    assert talk.acks(CLEAR + begin(100_001)) == b"acIba\0a\0", "then a1 ends the connection"
    assert talk.model.hung_up


def test_queued_rates_are_acknowledged_though_they_are_dropped() -> None:
    talk = Talk(EtherDreamModel())
    assert talk.acks(queue(1000)) == b"aq"
    assert talk.model.lost_rates == 1
    talk(PREPARE)
    assert talk.acks(queue(1000) * 200) == b"aq" * 200
    assert (len(talk.model.queued_rates), talk.model.lost_rates) == (199, 2)
    talk(STOP + PREPARE)
    assert not talk.model.queued_rates


def test_a_rate_of_zero_stops_the_processor_until_the_power_comes_anew() -> None:
    for sent in (begin(0), update(0), queue(0) + data(point(), point(control=0x8000)) + begin(1000)):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + sent)
        assert talk(PING, 0.01) == b""
        assert talk.model.panicked
        talk.model.power_up(talk.now_s)
        assert talk.acks(PING) == b"a?"


def test_an_unknown_command_closes_the_connection_and_stops_nothing() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    assert talk.acks(PING + b"x" + STOP) == b"a?"
    assert talk.model.hung_up
    assert talk.model.moving(talk.now_s)


def test_a_server_hangs_up_with_its_model() -> None:
    with TcpServer(EtherDreamModel()) as server:
        for _ in range(2):
            with socket.create_connection((HOST, int(server.address.split(":")[1])), 5.0) as client:
                client.sendall(PING + b"x")
                received = b""
                while piece := client.recv(100):
                    received += piece
            assert received == b"a?" + status() + b"a?" + status()


# Stops.


def test_an_emergency_stop_says_its_state_for_its_flags_and_lasts_until_cleared() -> None:
    for code in (b"\0", b"\xff"):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + data(*ramp(100)) + begin(25_000))
        assert talk(code) == b"a" + code + status(3, 0, flags=4, fullness=100)
        assert talk.acks(data(point()) + begin(1000) + code) == b"Idaba" + code
        assert talk(CLEAR) == b"ac" + status(0, 0, flags=4, fullness=100)
        assert talk(CLEAR)[:2] == b"ac"
        assert talk(PREPARE) == b"ap" + status(0, 1)


def test_an_open_interlock_cannot_be_cleared() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.stop_input(True, talk.now_s)
    assert talk(CLEAR) == b"!c" + status(3, 0, flags=4, fullness=100)
    talk.model.stop_input(False, talk.now_s)
    assert talk.fields()[0] == 3
    assert talk.acks(CLEAR + PREPARE) == b"acap"


def test_a_lost_link_stops_and_is_forgotten_when_it_is_back() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.link(False, talk.now_s)
    assert not talk.model.moving(talk.now_s)
    assert talk.model.light_engine == 3
    talk.model.link(True, talk.now_s)
    assert talk.fields() == (0, 0, 4, 100, 0, 0)


def test_a_client_that_goes_away_lets_the_ring_play_on_to_its_end() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.disconnected(talk.now_s)
    assert talk.model.moving(talk.now_s + 99 * P_S)
    assert not talk.model.moving(talk.now_s + 101.5 * P_S)
    talk.model.connected(2.0)
    assert talk.model.send(100, 2.0) == b"a?" + status(0, 0, flags=2)


def test_prepared_points_wait_for_the_next_client() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(3)) + b"d\x05\0" + point())
    talk.model.disconnected(1.0)
    talk.model.connected(2.0)
    assert talk.model.send(100, 2.0) == b"a?" + status(0, 1, fullness=4)
    assert talk.acks(PREPARE) == b"Ip"


# Outputs.


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


def test_a_stream_is_the_same_however_often_time_is_asked_for() -> None:
    histories = []
    for pieces in (1, 137):
        talk = Talk(EtherDreamModel())
        talk(PREPARE + data(*ramp(1000)) + begin(25_000))
        for now_s in np.linspace(1.0, 1.03, pieces + 1)[1:]:
            talk.model.advance(float(now_s))
        talk.now_s = 1.03
        assert talk.acks(data(*ramp(500))) == b"ad"
        talk.model.advance(2.0)
        histories.append(talk.model.history.command(periods(0, 1600)))
    assert np.array_equal(histories[0], histories[1])


def test_a_deaf_firmware_plays_on() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.deaf = True
    assert talk(STOP) == b""
    assert talk.model.moving(talk.now_s)
    talk.model.deaf = False
    assert talk.acks(PING) == b"a?"


def test_without_power_the_outputs_are_at_0_v() -> None:
    talk = Talk(EtherDreamModel())
    talk(PREPARE + data(*ramp(100)) + begin(25_000))
    talk.model.power_up(1.0 + 50 * P_S)
    assert talk.model.history.command(np.array([1.1]))[0] == CENTRE
    assert talk.fields() == (0, 0, 0, 0, 0, 0)


# A device that does as the page says.


def test_by_the_page_what_the_firmware_lets_pass_is_refused() -> None:
    talk = Talk(EtherDreamModel(by_page=True))
    assert talk.acks(begin(25_000) + queue(1000) + CLEAR + data()) == b"IbIqIcId"
    assert talk.acks(PREPARE + begin(25_000) + begin(100_001) + update(0)) == b"apIbIbIu"
    assert talk.acks(queue(1000) * 200) == b"aq" * 199 + b"Fq"
    assert talk.acks(data(*ramp(1790)) + data(*ramp(20))) == b"adFd"
    assert talk(PING) == b"a?" + status(0, 1, fullness=1790, rate=30_000)
    assert talk.acks(begin(25_000)) == b"ab"
    assert talk.acks(b"x") == b"ax"
    _, engine, _, _, causes = struct.unpack("<BBBBH", talk(PING)[2:8])
    assert (engine, causes) == (3, 1)
    assert not talk.model.moving(talk.now_s)
    assert talk.acks(data(point())) == b"Id"
