"""Config and bytes of the Ether Dream driver.

Golden bytes: the structures of ether-dream.com/protocol.html, and what an Ether Dream 2 was sent and answered
(`ModulaserApp/laser-dac-rs` 01321db, tests/fixtures/ether_dream/ed2_r331_hw_*).
"""

import socket
import threading
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from drivers.errors import DeviceNotFound, LimitExceeded, UnknownKind
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.registry import alone, config_of, lookup
from drivers.scanners.dac_scanner import PointSlice
from drivers.scanners.etherdream import EtherDream, EtherDreamConfig, create
from drivers.scanners.etherdream_line import PLAYING, BoardStatus, Broadcast, begin, data, listen, queue_rate
from drivers.scanners.etherdream_stream import TIMER_HZ, encode, nearest_rate, pps_of

GALVO = {"max_velocity": "2000 /s", "max_acceleration": "2e6 /s2"}
BROADCAST = bytes.fromhex("d880390000000a0002003b0fa08601000000000000003377000000000000000000000000")


def points(*commands: float, markers: int = 0, lit: bool = False) -> PointSlice:
    n = len(commands)
    return PointSlice(np.array(commands), np.full(n, markers, np.uint8), np.full(n, lit))


def test_commands_are_the_bytes_that_a_board_accepted() -> None:
    assert begin(30_000).hex() == "62000030750000"
    assert queue_rate(25_000).hex() == "71a8610000"
    assert data(b"", 1500).hex() == "64dc05"


def test_a_point_is_control_then_x_y_r_g_b_i_u1_u2_of_16_bits_each_low_byte_first() -> None:
    dark, all_on = points(-1.0), points(1.0, markers=MARKER_LINE | MARKER_SCAN | LEVEL_BACKWARD, lit=True)
    assert encode(dark, "x").hex(" ", 2) == "0000 0880 0000 0000 0000 0000 0000 0000 0000"
    assert encode(all_on, "x").hex(" ", 2) == "0000 f87f 0000 ffff ffff ffff ffff 0000 0000"
    assert encode(all_on, "y").hex(" ", 2) == "0000 0000 f87f ffff ffff ffff ffff 0000 0000"


@pytest.mark.parametrize(("bit", "colour"), [(MARKER_LINE, 4), (MARKER_SCAN, 5), (LEVEL_BACKWARD, 6)])
def test_line_marker_scan_marker_and_direction_are_green_blue_and_intensity(bit: int, colour: int) -> None:
    words = np.frombuffer(encode(points(0.0, markers=bit), "x"), "<u2")
    assert np.flatnonzero(words).tolist() == [colour]


def test_only_the_first_point_asks_for_the_queued_rate() -> None:
    control = np.frombuffer(encode(points(0.0, 0.0, 0.0), "x", rate_change=True), "<u2")[::9]
    assert control.tolist() == [0x8000, 0, 0]


def test_a_12_bit_converter_that_drops_the_lowest_bits_gets_the_nearest_step_and_0_is_the_centre() -> None:
    command = np.linspace(-1, 1, 20_001)
    x = np.frombuffer(encode(points(*command), "x"), "<i2")[1::9].astype(int)
    step = (x + 0x8000) >> 4  # what the firmware writes: transform.c and dac_asm.s with the default transform
    assert np.abs(step - (command + 1) / 2 * 4095).max() <= 0.5 + 1 / 16
    assert step[[0, 10_000, 20_000]].tolist() == [0, 0x800, 4095]


def test_a_status_is_read_as_the_board_means_it() -> None:
    # 1500 points were sent, at 30 kHz, 3 ms before.
    status = BoardStatus.read(bytes.fromhex("613f0000020000003177000086053075000056000000")[2:])
    assert (status.light_engine, status.playback, status.source) == (0, PLAYING, 0)
    assert (status.fullness, status.rate_hz, status.count) == (1414, 30_000, 86)
    assert status.fullness + status.count == 1500


def test_a_broadcast_tells_address_revisions_buffer_and_highest_rate() -> None:
    assert Broadcast.read(BROADCAST) == Broadcast("d8:80:39:00:00:00", 10, 2, 3899, 100_000)
    assert Broadcast.read(BROADCAST[:-1]) is None


def test_the_broadcast_of_the_board_itself_is_heard_among_others() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    ended = threading.Event()

    def broadcast() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            while not ended.wait(0.01):
                board.sendto(b"something else", ("127.0.0.1", port))
                board.sendto(BROADCAST, ("127.0.0.1", port))

    thread = threading.Thread(target=broadcast)
    thread.start()
    try:
        assert listen("127.0.0.1", 5.0, port) == Broadcast.read(BROADCAST)
        assert listen("127.0.0.2", 0.1, port) is None
    finally:
        ended.set()
        thread.join()


def test_the_rate_is_the_one_that_the_boards_divider_makes() -> None:
    assert nearest_rate(30_000, 1000, 100_000) == 30_000
    assert nearest_rate(44_100, 1000, 100_000) == Fraction(TIMER_HZ, 544)
    assert nearest_rate(100_000, 1000, 100_000) == 100_000
    assert nearest_rate(65_535, 1000, 65_535) == Fraction(TIMER_HZ, 367)
    assert nearest_rate(1000, 1000, 100_000) == 1000


@pytest.mark.parametrize("low_hz", [1000, 4890, 20_000, 99_000])
def test_every_rate_asked_for_again_is_unchanged_and_the_firmware_divides_to_it(low_hz: int) -> None:
    for requested_hz in np.linspace(low_hz, low_hz + 1000, 997):
        rate = nearest_rate(requested_hz, 1000, 100_000)
        assert nearest_rate(float(rate), 1000, 100_000) == rate
        assert Fraction(TIMER_HZ, TIMER_HZ // pps_of(rate)) == rate
        assert pps_of(rate) <= 100_000
        assert abs(rate - requested_hz) <= requested_hz**2 / TIMER_HZ / 2 + 1


def test_a_config_has_units_and_needs_a_port_and_the_galvos_limits() -> None:
    config = EtherDreamConfig.model_validate(
        {"port": "10.0.0.7", "buffer": "40 ms", "max_point_rate": "20 kHz", **GALVO}
    )
    assert (config.buffer, config.max_point_rate, config.buffer_points) == (0.04, 20_000, None)
    for left_out in ("port", *GALVO):
        fields = {name: value for name, value in {"port": "x", **GALVO}.items() if name != left_out}
        with pytest.raises(LimitExceeded, match=left_out):
            config_of(EtherDreamConfig, **fields)


@pytest.mark.parametrize(
    "wrong",
    [{"max_point_rate": "100.1 kHz"}, {"max_point_rate": "1 kHz"}, {"buffer": "1 ms"}, {"buffer_points": 65_536}],
)
def test_a_setting_that_the_board_cannot_have_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(LimitExceeded, match=next(iter(wrong))):
        config_of(EtherDreamConfig, port="x", **GALVO, **wrong)


def test_it_is_found_by_its_name() -> None:
    try:
        assert lookup("scanner", "etherdream").config is EtherDreamConfig
    except UnknownKind as error:  # the entry point of the installed package
        pytest.skip(str(error))


@pytest.mark.parametrize(("port", "told"), [("127.0.0.1", "127.0.0.1:7765"), ("127.0.0.1:1", "127.0.0.1:1 ")])
def test_the_port_is_7765_unless_another_is_given(port: str, told: str) -> None:
    with pytest.raises(DeviceNotFound, match=told):
        EtherDream.open(port, max_velocity_per_s=2000.0, max_acceleration_per_s2=2e6)


def test_an_impossible_setting_is_refused_before_anything_is_connected() -> None:
    with pytest.raises(LimitExceeded, match="max_point_rate"):
        EtherDream.open("127.0.0.1:1", max_velocity_per_s=1.0, max_acceleration_per_s2=1.0, max_point_rate_hz=2e5)


def test_a_port_that_is_not_emulated_is_refused_by_its_name() -> None:
    config = config_of(EtherDreamConfig, port="emulated:dac", **GALVO)
    with pytest.raises(DeviceNotFound, match="emulated:dac"):
        create(config, alone())
