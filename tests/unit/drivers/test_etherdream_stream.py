"""What an Ether Dream replies decides whether its points count as played."""

import struct
import threading
from fractions import Fraction

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceFault
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.etherdream_line import ACCEPTED, PREPARED, BoardStatus, EtherDreamLine, Reply
from drivers.scanners.etherdream_stream import PointStream


class Board(EtherDreamLine):
    """A line to a board whose next reply a test determines."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.commands: list[bytes] = []
        self.code = ACCEPTED
        self.says(playback=PREPARED)

    def says(self, light_engine: int = 0, playback: int = 2, flags: int = 0, **numbers: int) -> None:
        numbers = {"fullness": 0, "rate_hz": 0, "count": 0, **numbers}
        self.status = BoardStatus(light_engine, playback, 0, flags, **numbers)

    def ask(self, command: bytes) -> Reply:
        self.commands.append(command)
        return Reply(self.code, self.status)


def dark(n: int) -> PointSlice:
    return PointSlice(np.zeros(n), np.zeros(n, np.uint8), np.zeros(n, bool))


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def playing(board: Board, clock: VirtualClock) -> PointStream:
    """100 points were sent at 10 kHz, and play."""
    stream = PointStream(board, "dac", "x", 1799, clock)
    stream.change_rate(Fraction(10_000), 500)
    board.says(playback=PREPARED, fullness=100)
    stream.send(dark(100))
    board.says(fullness=100, rate_hz=10_000)
    stream.begin()
    return stream


def test_commands_come_in_the_order_prepare_data_begin(board: Board, playing: PointStream) -> None:
    assert [command[:1] for command in board.commands] == [b"p", b"d", b"b"]
    assert board.commands[1][:3].hex() == "646400"
    assert board.commands[2].hex() == "62000010270000"


def test_there_is_room_up_to_the_limit_of_the_rate_of_the_buffer_and_of_a_command(
    board: Board, clock: VirtualClock, playing: PointStream
) -> None:
    assert playing.room == 400
    playing.change_rate(Fraction(1000), 250)
    assert playing.room == 250
    small = PointStream(board, "dac", "x", 120, clock)
    small.change_rate(Fraction(1000), 250)
    assert small.room == 120


def test_a_new_rate_is_queued_and_its_first_point_asks_for_it(board: Board, playing: PointStream) -> None:
    playing.change_rate(Fraction(1000), 250)
    assert board.commands[-1].hex() == "71e8030000"
    board.says(fullness=102, rate_hz=10_000)
    playing.send(dark(2))
    assert struct.unpack_from("<H", board.commands[-1], 3) == (0x8000,)
    assert struct.unpack_from("<H", board.commands[-1], 3 + 18) == (0,)
    board.says(fullness=104, rate_hz=10_000)
    playing.send(dark(2))
    assert struct.unpack_from("<H", board.commands[-1], 3) == (0,)


def test_a_count_that_is_read_one_point_later_is_no_fault_unless_it_always_is(
    board: Board, clock: VirtualClock, playing: PointStream
) -> None:
    for n in range(1, 41):
        clock.sleep(1e-4)
        board.says(fullness=100 - n, rate_hz=10_000, count=n + 1)
        playing.ping()
    assert playing.played == 40
    for _ in range(10):
        playing.ping()
    with pytest.raises(DeviceFault, match="lost or repeated"):
        playing.ping()


@pytest.mark.parametrize("count", [19, 22, 21 + 2**31])
def test_a_point_too_many_or_too_few_is_a_fault(
    board: Board, clock: VirtualClock, playing: PointStream, count: int
) -> None:
    clock.sleep(2e-3)
    board.says(fullness=80, rate_hz=10_000, count=20)
    playing.ping()
    board.says(fullness=80, rate_hz=10_000, count=count)
    with pytest.raises(DeviceFault, match="of 100 points sent, 80 are queued"):
        playing.ping()


@pytest.mark.parametrize(
    ("light_engine", "flags", "why"), [(0, 0x7733, "ran dry"), (3, 0x7735, "emergency stop"), (0, 0x7731, "elsewhere")]
)
def test_a_board_that_plays_no_more_says_why(
    board: Board, playing: PointStream, light_engine: int, flags: int, why: str
) -> None:
    board.code = b"I"
    board.says(light_engine, playback=0, flags=flags)
    with pytest.raises(DeviceFault, match=f"jumped to the centre: .*{why}"):
        playing.send(dark(10))


def test_points_that_are_refused_while_the_board_plays_are_a_fault(board: Board, playing: PointStream) -> None:
    board.code = b"F"
    board.says(fullness=100, rate_hz=10_000)
    with pytest.raises(DeviceFault, match="refused"):
        playing.send(dark(10))


def test_another_rate_than_the_one_that_was_set_is_a_fault(
    board: Board, clock: VirtualClock, playing: PointStream
) -> None:
    clock.sleep(1e-3)
    board.says(fullness=90, rate_hz=9000, count=10)
    with pytest.raises(DeviceFault, match="plays at 9000 Hz instead of 10000 Hz"):
        playing.ping()


@pytest.mark.parametrize(
    ("clock_error", "faulty"), [(0.0, False), (5e-4, False), (-5e-4, False), (5e-3, True), (-5e-3, True)]
)
def test_a_clock_that_is_off_is_a_fault_and_a_crystals_drift_is_none(
    board: Board, clock: VirtualClock, playing: PointStream, clock_error: float, faulty: bool
) -> None:
    def play(seconds: float) -> None:
        for at_s in np.arange(0.01, seconds, 0.01):
            clock.advance_to_ns(round(at_s * 1e9))
            played = int(at_s * 10_000 * (1 + clock_error))
            board.says(fullness=20, rate_hz=10_000, count=played)
            playing.send(dark(played + 20 - playing.sent)) if played + 20 > playing.sent else playing.ping()

    board.says(fullness=100, rate_hz=10_000)
    clock.advance_to_ns(0)
    playing.sent = 20
    if faulty:
        with pytest.raises(DeviceFault, match="clock is not the expected one"):
            play(2.0)
    else:
        play(2.0)


def test_a_board_that_stands_still_is_a_fault_after_a_second(
    board: Board, clock: VirtualClock, playing: PointStream
) -> None:
    clock.sleep(0.9)
    playing.ping()
    clock.sleep(0.2)
    with pytest.raises(DeviceFault, match="plays no points"):
        playing.ping()
