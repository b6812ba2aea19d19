"""The driver of a Teensy: its config, its lines held against docs/reference/teensy.md, and its way on the wire."""

import gc
import logging
import re
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock
from drivers.errors import (
    CommandRefused,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
)
from drivers.interfaces import HOLD_S, OUT_FRAME, OUT_GATE, OUT_MARKER, Pulse
from drivers.registry import Surroundings, lookup
from drivers.sync.teensy import KIND, MOST, BoardLimits, Teensy, TeensyConfig, encode
from drivers.sync.teensy_line import TRIES, USB_IDS
from sim_backend.wire.firmware.teensy import TeensyModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import PATIENCE_S, Babble, Silent, eventually
from tests.wire.emulated_syncs import USB_BAUD, TeensyBoard, teensy
from tests.wire.faults import Fault, FaultScript

TEENSY = BoardLimits("Teensy")
SWEEP = [Pulse(0, None), Pulse(0, 1e-3), Pulse(OUT_GATE, 5e-3, held=True), Pulse(0, 1e-5)]
EXAMPLE = ["new 1000 50000", "add 000000000 0000186a0 a0007a120 0000003e8", "end 4 07631eab"]
LIT = [Pulse(OUT_GATE, 30.0)]
MOST_LINE_BYTES = 1023
TAG_BYTES = 10
"""Number sign, eight characters, and a space."""


def heard(wire: TeensyBoard) -> list[str]:
    """The lines that the host says from now on, without tags."""
    lines: list[str] = []
    receive = wire.model.receive

    def listen(data: bytes, now_s: float) -> bytes:
        lines.extend(re.sub("^#[0-9a-f]{8} ", "", line) for line in data.decode().split("\n") if line)
        return bytes(receive(data, now_s))

    wire.model.receive = listen
    return lines


# Lines


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
    assert encode([pulse], 1, TEENSY)[1] == f"add {sent}"


def test_a_program_is_as_long_as_the_memory_in_lines_that_the_board_takes() -> None:
    new, *adds, end = encode([Pulse(OUT_FRAME, 1e-5)] * 29_999 + [Pulse(0, None)], MOST, TEENSY)
    assert (new, end[:10]) == ("new 4294967295 50000", "end 30000 ")
    assert max(map(len, adds)) + TAG_BYTES <= MOST_LINE_BYTES
    assert [w for add in adds for w in add.split(" ")[1:]] == ["1000003e8"] * 29_999 + ["000000000"]


def test_programs_that_the_board_would_refuse_are_refused_before_they_are_sent() -> None:
    refused: list[tuple[list[Pulse], int, str]] = [
        ([SWEEP[0], Pulse(0, 4.99e-6)], 1, r"word 1 lasts 4.99e-06 s, outside 5e-06 to 42\.9497 s"),
        ([SWEEP[0], Pulse(0, 42.94967296)], 1, r"word 1 lasts 42\.9497 s, outside"),
        ([Pulse(0, 1e-5)] * 30_001, 1, "30001 words; it holds 30000"),
        (SWEEP, 2**32, "4294967296 repeats; at most 4294967295"),
    ]
    with teensy() as wire, wire.open() as device:
        assert (device.most_repeats(SWEEP), device.most_repeats(30_001 * SWEEP)) == (MOST, 0)
        sent = heard(wire)
        for pulses, repeats, said in refused:
            with pytest.raises(LimitExceeded, match=said):
                device.program(pulses, repeats)
        assert sent == []


def test_what_each_verb_puts_on_the_wire() -> None:
    assert HOLD_S == 50_000 * 10e-9
    with teensy(usb_ids=USB_IDS) as wire:
        said = heard(wire)
        device = wire.open(watchdog="500 ms")
        expected = ["abort", "abort", "id", "status"]  # one without a tag, which waits for nobody
        assert said == expected
        verbs: list[tuple[Callable[[], Any], list[str]]] = [
            (lambda: device.program(SWEEP, 1000), EXAMPLE),
            (device.run, ["run 500"]),
            (device.gate_low, ["low", "low", "status"]),
            (device.abort, ["abort", "abort", "status"]),
            (device.close, ["abort", "abort", "status", "abort"]),
        ]
        for verb, lines in verbs:
            said.clear()
            verb()
            assert said == lines


def test_it_states_what_it_is_and_passes_raw_commands_on() -> None:
    with teensy(serial="8765430") as wire, wire.open() as device:
        wire.model.more_status = " later=1"
        assert device.identity == "Teensy 8765430, firmware 1, 30000 words, 10 ns"
        assert (device.serial, device.resolution_s) == ("8765430", 1e-8)
        assert device.ask("status").endswith(" why=none later=1")
        assert device.ask("nonsense") == "error unknown command"


# Config


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
    assert lookup("sync", "teensy") is KIND
    with pytest.raises(ValidationError, match=said):
        TeensyConfig.model_validate(fields)


@pytest.mark.parametrize("watchdog_s", [0.0, 60.1, float("nan")])
def test_open_takes_the_watchdog_in_seconds_within_the_same_limits(watchdog_s: float) -> None:
    with pytest.raises(LimitExceeded, match="watchdog"):
        Teensy.open("COM7", watchdog_s=watchdog_s)


# Whom it finds


def _other_version(wire: TeensyBoard) -> None:
    obey = wire.model._obey
    wire.model._obey = lambda text: obey(text).replace("spadrig-sync 1", "spadrig-sync 2")


@pytest.mark.parametrize(
    ("spoil", "error", "said"),
    [
        (lambda w: setattr(w, "usb_ids", (0x2E8A, 0xA)), ProtocolError, "USB device 2e8a:000a, not 16c0:0483; corr"),
        (lambda w: setattr(w.server, "model", Babble()), ProtocolError, r"not the firmware .*'hello there'\); upload"),
        (lambda w: setattr(w.server, "model", Silent()), DeviceTimeout, "did not answer 'abort' within 3 s on /dev"),
        (_other_version, ProtocolError, "speaks version 2 .* not 1; upload config/firmware/teensy/teensy.ino"),
        (lambda w: w.model.short(OUT_GATE, 0.0), DeviceFault, "read back 0x2 after opening, not low; turn the laser"),
    ],
)
def test_a_wrong_board_is_refused_and_the_port_is_free_again(
    spoil: Callable[[TeensyBoard], None], error: type[DeviceError], said: str
) -> None:
    with teensy() as wire:
        spoil(wire)
        with pytest.raises(error, match=said) as refused:
            wire.open()
        assert "\n" not in str(refused.value)
        assert wire.server._port is None  # type: ignore[attr-defined]


LOADED = b"\n".join(line.encode() for line in encode(LIT, 9, TEENSY))


@pytest.mark.parametrize(
    "left", [LOADED + b"\nrun 60000\n", LOADED + b"\nrun 60000\n#12 sta", b"x" * 2000, b"new 1 0\nadd"]
)
def test_opening_takes_it_low_however_a_dead_host_left_it(left: bytes) -> None:
    with teensy() as wire:
        wire.model.receive(left, 0.0)
        with wire.open() as device:
            assert wire.pins == 0
            device.program(LIT, 1)
            device.run()
            assert (device.status.state, device.status.outputs) == ("running", OUT_GATE)


# Answers that do not come as they should


@pytest.mark.parametrize("fault", [Fault.LOST, Fault.CORRUPTED, Fault.TRUNCATED, Fault.MERGED])
def test_a_run_without_a_right_answer_fails_dark_and_what_may_come_twice_is_asked_again(fault: Fault) -> None:
    faults = FaultScript()
    with teensy(faults) as wire, wire.open() as device:
        device.program(LIT, 1)
        faults._script = [fault]
        assert device.status.state == "stopped"
        faults._script = [fault]
        with pytest.raises(DeviceTimeout, match="did not answer 'run 2000' within 1 s"):
            device.run()
        levels = [level for _, level in wire.model.changes(0.0, wire.now_s)]
        assert (levels, wire.model.why) == ([0, OUT_GATE, 0], "abort")


@pytest.mark.parametrize("line", range(3))
def test_a_program_that_may_not_have_arrived_whole_is_never_run(line: int) -> None:
    faults = FaultScript()
    with teensy(faults) as wire, wire.open() as device:
        device.program(LIT, 1)
        faults._script = [*[None] * line, Fault.LOST]
        with pytest.raises(DeviceTimeout):
            device.program(SWEEP, 1)
        with pytest.raises(DeviceFault, match="did not arrive whole; program it again"):
            device.run()
        device.program(SWEEP, 1)
        wire.model.power_cycle(wire.now_s)
        with pytest.raises(CommandRefused, match=r"refuses 'run 2000': error no program: new, add, end; see docs"):
            device.run()


def test_a_board_that_hangs_or_is_unplugged_is_not_taken_for_dark(caplog: pytest.LogCaptureFixture) -> None:
    with teensy() as wire:
        device = wire.open()
        device.program(LIT, 1)
        device.run()
        wire.server.hang()
        begun_s = wire.now_s
        with pytest.raises(DeviceTimeout, match="did not answer 'low'"):
            device.gate_low()
        assert wire.now_s - begun_s < 1.1
        assert wire.pins == OUT_GATE
        wire.clock.sleep(2.0)
        assert (wire.pins, wire.model.why) == (0, "watchdog")
        wire.server.unplug()
        assert device.port_lost
        for verb in (lambda: device.status, device.abort):
            with pytest.raises(DeviceDisconnected, match="plug it in again"):
                verb()
        device.close()
        assert "could not be left safe" in caplog.text


# Light


def test_the_board_ends_a_held_pulse_and_the_status_shows_its_pins() -> None:
    with teensy() as wire, wire.open() as device:
        device.program(SWEEP, 2)
        device.run()
        wire.trigger.pulse(wire.now_s + 0.01, 2e-3)
        wire.clock.sleep(0.0115)
        assert (device.status.state, device.status.outputs) == ("running", OUT_GATE)
        wire.clock.sleep(0.1)
        assert device.status.state == "waiting"
        edges = [at_s for at_s, _ in wire.model.changes(0.0, wire.now_s)[1:]]
        assert edges[1] - edges[0] == pytest.approx(1e-3 + HOLD_S)
        assert " cuts=1 " in device.ask("status")


def test_an_interrupt_at_any_line_of_the_driver_leaves_it_dark() -> None:
    tried = 0
    while True:
        left = tried

        def strike(frame: Any, event: str, _: Any) -> Any:
            nonlocal left
            if re.search(r"drivers/sync/(teensy|teensy_line|board)\.py$", frame.f_code.co_filename) is None:
                return None
            if event == "line":
                left -= 1
                if left == -1:
                    raise KeyboardInterrupt
            return strike

        with teensy() as wire:
            wire.model.receive(LOADED + b"\nrun 60000\n", 0.0)
            device = wire.open()
            try:
                sys.settrace(strike)
                with suppress(KeyboardInterrupt), device:
                    device.program(LIT, 1)
                    device.run()
                    device.gate_low()
            finally:
                sys.settrace(None)
            assert wire.pins == 0, f"after an interrupt at line {tried}"
        if left >= 0:
            break
        tried += 3
    assert tried > 100


@pytest.fixture
def board() -> Any:
    """A board in the host's time on a pseudo terminal, and its surroundings."""
    with SerialServer(TeensyModel(), baud=USB_BAUD) as server:
        yield server, Surroundings(SystemClock(), None, 0, {"sync": server.endpoint})


def test_the_driver_feeds_the_watchdog_until_it_is_deleted_or_the_board_is_deaf(
    board: Any, caplog: pytest.LogCaptureFixture
) -> None:
    server, surroundings = board
    device = Teensy.open("emulated:sync", watchdog_s=0.6, surroundings=surroundings)
    device.program(LIT, 1)
    for _ in range(2):
        device.run()
        time.sleep(1.0)
        with server.lock:
            assert server.model.state == "playing"
            server.model.advance(time.monotonic() + 0.7)  # it hears nothing in this time
        eventually(lambda: "the board ended its program (watchdog)" in caplog.text)
        caplog.clear()
    caplog.set_level(logging.WARNING)
    device.run()
    del device
    gc.collect()
    eventually(lambda: server.model.why == "abort")
    assert "may have been left playing; its outputs were taken low" in caplog.text
    eventually(lambda: "Teensy watchdog" not in [thread.name for thread in threading.enumerate()])


def test_the_gate_goes_low_at_once_beside_a_question_that_is_not_answered(board: Any) -> None:
    server, surroundings = board
    config = TeensyConfig.model_validate({"port": "emulated:sync", "watchdog": "60 s"})
    with Teensy(config, surroundings, reply_s=TRIES * PATIENCE_S) as device:
        device.program(LIT, 1)
        device.run()
        receive, asked = server.model.receive, []

        def leave_unanswered(data: bytes, now_s: float) -> Any:
            if b"status" not in data:
                return receive(data, now_s)
            asked.append(data)
            return b""

        server.model.receive = leave_unanswered
        asking = threading.Thread(target=lambda: device.status)
        asking.start()
        eventually(lambda: asked)
        lowering = threading.Thread(target=device.gate_low)
        lowering.start()
        eventually(lambda: server.model._gate_low)
        assert asking.is_alive()
        with server.lock:
            server.model.receive = receive
            server._reply(receive(asked[0], server._now_s()))
        for thread in (asking, lowering):
            thread.join()
        assert server.model.why == "none"
