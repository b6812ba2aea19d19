"""The NI card: its config, and what needs no card. Facts: docs/reference/hardware.md."""

import sys
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.errors import DeviceNotFound, LimitExceeded, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.registry import lookup
from drivers.scanners.nidaq import Nidaq, NidaqConfig, PulseTrain, pulse_train

USUAL: dict[str, Any] = {"port": "Dev1", "max_velocity": "400 /s", "max_acceleration": "1e6 /s2"}


def config(**given: Any) -> NidaqConfig:
    return NidaqConfig.model_validate(USUAL | given)


def test_the_kind_is_found_by_its_name() -> None:
    assert lookup("scanner", "nidaq").config is NidaqConfig


def test_values_have_units_and_read_back_the_same() -> None:
    given = config(
        full_scale="5 V", buffer="100 ms", max_point_rate="80 kHz", clock="PFI0", clock_rate="100000/3 Hz", start="PFI1"
    )
    assert (given.full_scale, given.buffer, given.max_point_rate) == (5.0, 0.1, 80e3)
    assert given.clock_rate == Fraction(100_000, 3)
    assert NidaqConfig.model_validate(given.model_dump(mode="json")) == given
    counters = config(markers="counters", backward_marker="ctr1")
    assert NidaqConfig.model_validate(counters.model_dump(mode="json")) == counters


def test_markers_are_the_first_lines_of_port_0_or_one_counter() -> None:
    lines = {MARKER_LINE: "port0/line0", MARKER_SCAN: "port0/line1", LEVEL_BACKWARD: "port0/line2"}
    assert config().outputs == lines
    assert config(backward_marker=None, line_marker="port0/line31").outputs == {
        MARKER_LINE: "port0/line31",
        MARKER_SCAN: "port0/line1",
    }
    assert config(markers="counters").outputs == {MARKER_SCAN: "ctr0"}


@pytest.mark.parametrize(
    "port", ["Dev1", "cDAQ1Mod2", "grpc=10.0.0.5:31763/Dev1", "grpc=scan-pc.lab:31763/Dev1", "emulated:scanner"]
)
def test_ports_are_names_of_ni_max_or_behind_a_server(port: str) -> None:
    assert config(port=port).port == port


@pytest.mark.parametrize("port", ["", "/Dev1", "Dev1/ao0", "grpc=10.0.0.5/Dev1", "grpc=:31763/Dev1", "10.0.0.5:31763"])
def test_other_ports_are_refused(port: str) -> None:
    with pytest.raises(ValidationError, match="port"):
        config(port=port)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"port": None}, "port"),
        ({"full_scale": "11 V"}, "full_scale"),
        ({"full_scale": 10.0}, "no unit"),
        ({"full_scale": "-5 V"}, "full_scale"),
        ({"channel": "ai0"}, "channel"),
        ({"buffer": "1 ms"}, "buffer"),
        ({"max_point_rate": "2 MHz"}, "max_point_rate"),
        ({"clock": "PFI0"}, "give a terminal and its rate"),
        ({"clock_rate": "50 kHz"}, "give a terminal and its rate"),
        ({"clock": "PFI0", "clock_rate": "200 kHz"}, "divide the clock"),
        ({"clock": "PFI0", "clock_rate": "10 Hz"}, "outside 1000 to 100000 Hz"),
        ({"start": "PFI 1"}, "start"),
        ({"start": "PFI0", "clock_out": "PFI0"}, "name one twice"),
        ({"scan_marker": "port0/line0"}, "name one twice"),
        ({"scan_marker": "port1/line0"}, "a line such as port0/line1"),
        ({"scan_marker": "ctr0"}, "a line such as port0/line1"),
        ({"markers": "counters", "line_marker": "port0/line0"}, "a counter such as ctr0"),
        ({"markers": "relays"}, "markers"),
    ],
)
def test_a_config_that_cannot_be_is_refused(given: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        config(**given)


def test_a_notebook_gives_si_values_and_gets_one_line() -> None:
    limits: dict[str, Any] = {"max_velocity_per_s": 400.0, "max_acceleration_per_s2": 1e6}
    with pytest.raises(LimitExceeded, match=r"full_scale: .*less than or equal to 10"):
        Nidaq.open("Dev1", full_scale_v=12.0, **limits)
    with pytest.raises(LimitExceeded, match="give a terminal and its rate"):
        Nidaq.open("Dev1", clock="PFI0", **limits)
    with pytest.raises(DeviceNotFound, match=r"NoSuchCard.*; "):
        Nidaq.open("NoSuchCard", **limits)


@pytest.mark.parametrize(("package", "port"), [("nidaqmx", "Dev1"), ("grpc", "grpc=127.0.0.1:1/Dev1")])
def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, package: str, port: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        ProtocolError, match=rf"no package {package}; install the extra spadrig\[nidaq\]: .*pip install"
    ):
        Nidaq.open(port, max_velocity_per_s=400.0, max_acceleration_per_s2=1e6)


def bits(text: str) -> Any:
    return np.array([one == "1" for one in text])


def test_a_counter_makes_equal_pulses_at_equal_distances() -> None:
    assert pulse_train(bits("00000000")) is None
    assert pulse_train(bits("11100000")) == PulseTrain(first=0, width=3, period=8, number=1)
    assert pulse_train(bits("0110001100")) == PulseTrain(first=1, width=2, period=5, number=2)
    assert pulse_train(bits("00001111")) == PulseTrain(first=4, width=4, period=8, number=1)


@pytest.mark.parametrize("high", ["11111111", "0110011100", "0110110000", "1100001100", "00010000", "11111110"])
def test_a_counter_refuses_all_other_markers(high: str) -> None:
    with pytest.raises(ValueError, match="points"):
        pulse_train(bits(high))
