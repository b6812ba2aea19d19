"""The driver of a Teensy: its config, and the lines that load a program, held against docs/reference/teensy.md."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
from pydantic import ValidationError

from drivers.errors import LimitExceeded, ProtocolError
from drivers.interfaces import HOLD_S, OUT_FRAME, OUT_GATE, OUT_MARKER, Pulse
from drivers.registry import alone, lookup
from drivers.sync.teensy import KIND, MOST, BoardLimits, Teensy, TeensyConfig, encode
from drivers.transports.endpoints import Endpoint

TEENSY = BoardLimits("Teensy")
SWEEP = [Pulse(0, None), Pulse(0, 1e-3), Pulse(OUT_GATE, 5e-3, held=True), Pulse(0, 1e-5)]
MOST_LINE_BYTES = 1023
TAG_BYTES = 10
"""Number sign, eight characters, and a space."""


def word(pulse: Pulse) -> str:
    _, add, _ = encode([pulse], 1, TEENSY)
    return add.removeprefix("add ")


# Lines


def test_the_example_of_the_page_goes_out_as_it_stands_there() -> None:
    assert encode(SWEEP, 1000, TEENSY) == [
        "new 1000 50000",
        "add 000000000 0000186a0 a0007a120 0000003e8",
        "end 4 07631eab",
    ]
    assert HOLD_S == 50_000 * 10e-9


@pytest.mark.parametrize(
    ("pulse", "sent"),
    [
        (Pulse(0, None), "000000000"),
        (Pulse(OUT_FRAME | OUT_MARKER, None), "500000000"),
        (Pulse(OUT_MARKER, None, held=True), "400000000"),  # a wait cannot be held
        (Pulse(OUT_FRAME, 10e-3), "1000f4240"),
        (Pulse(OUT_GATE, 5e-3), "20007a120"),
        (Pulse(OUT_FRAME | OUT_GATE | OUT_MARKER, 1e-3, held=True), "f000186a0"),
        (Pulse(OUT_GATE, 5e-6, held=True), "a000001f4"),
        (Pulse(0, 42.94967295), "0ffffffff"),
        (Pulse(0, 1e-3 + 4e-9), "0000186a0"),  # to the nearest tick
    ],
)
def test_a_word_is_outputs_and_held_in_one_digit_and_ticks_in_eight(pulse: Pulse, sent: str) -> None:
    assert word(pulse) == sent


@pytest.mark.parametrize("duration_s", [4.99e-6, 42.94967296])
def test_words_that_the_board_would_refuse_are_refused_before_they_are_sent(duration_s: float) -> None:
    with pytest.raises(LimitExceeded, match=rf"word 1 lasts {duration_s:g} s, outside 5e-06 to 42\.9497 s") as refused:
        encode([Pulse(0, None), Pulse(OUT_GATE, duration_s)], 1, TEENSY)
    assert "\n" not in str(refused.value)


def test_a_program_is_as_long_as_the_memory_in_lines_that_the_board_takes() -> None:
    new, *adds, end = encode([Pulse(OUT_FRAME, 1e-5)] * 29_999 + [Pulse(0, None)], MOST, TEENSY)
    assert new == "new 4294967295 50000"
    assert end.startswith("end 30000 ")
    assert max(map(len, adds)) + TAG_BYTES <= MOST_LINE_BYTES
    assert [w for add in adds for w in add.split(" ")[1:]] == ["1000003e8"] * 29_999 + ["000000000"]
    with pytest.raises(LimitExceeded, match="30001 words; it holds 30000"):
        encode([Pulse(0, 1e-5)] * 30_001, 1, TEENSY)
    with pytest.raises(LimitExceeded, match="4294967296 repeats; at most 4294967295"):
        encode(SWEEP, 2**32, TEENSY)


def test_any_change_of_a_program_changes_its_checksum() -> None:
    changed = [
        (SWEEP, 1000),
        (SWEEP, 1001),
        (SWEEP[::-1], 1000),
        ([*SWEEP, Pulse(0, 1e-5)], 1000),
        ([*SWEEP[:2], Pulse(OUT_GATE, 5e-3), SWEEP[3]], 1000),
    ]
    assert len({encode(pulses, repeats, TEENSY)[-1].split(" ")[-1] for pulses, repeats in changed}) == len(changed)


# Config


def test_the_kind_is_found_by_its_name_and_its_watchdog_has_a_unit() -> None:
    assert lookup("sync", "teensy") is KIND
    assert TeensyConfig(port="/dev/ttyACM0").watchdog == 2.0
    config = TeensyConfig.model_validate({"port": "serial=1234560", "watchdog": "500 ms"})
    assert config.watchdog == 0.5
    assert config.model_dump(mode="json")["watchdog"] == "0.5 s"
    assert TeensyConfig.real_time


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "port"),
        ({"port": ""}, "port"),
        ({"port": "COM7", "watchdog": 2}, "no unit"),
        ({"port": "COM7", "watchdog": "0 s"}, "greater than or equal to 0.2"),
        ({"port": "COM7", "watchdog": "61 s"}, "less than or equal to 60"),
        ({"port": "COM7", "gate_output": 1}, "gate_output"),  # its pins are fixed
    ],
)
def test_a_config_without_a_port_or_beyond_the_limits_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        TeensyConfig.model_validate(fields)


@pytest.mark.parametrize("watchdog_s", [0.0, 60.1, float("nan")])
def test_open_takes_the_watchdog_in_seconds_within_the_same_limits(watchdog_s: float) -> None:
    with pytest.raises(LimitExceeded, match="watchdog"):
        Teensy.open("COM7", watchdog_s=watchdog_s)


def test_a_port_of_another_usb_device_is_refused_before_a_byte_is_sent() -> None:
    port = Mock()
    endpoint = Endpoint("/dev/x", serial_port=lambda: port, usb_ids=(0x2E8A, 0x000A))
    surroundings = replace(alone(), ports={"sync": endpoint})
    with pytest.raises(ProtocolError, match=r"/dev/x is USB device 2e8a:000a, not 16c0:0483; correct 'port'"):
        Teensy.open("emulated:sync", surroundings=surroundings)
    port.write.assert_not_called()
    port.close.assert_called()
