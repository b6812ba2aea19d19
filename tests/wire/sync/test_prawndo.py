"""The PrawnDO: golden bytes of docs/reference/devices/prawndo.md, and a test named after each of its traps."""

import gc
import threading

import pytest

from drivers.errors import (
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.interfaces import HOLD_S, OUT_FRAME, OUT_GATE, OUT_MARKER, Pulse
from drivers.sync.prawndo import ProgramLimits, compile_program
from drivers.sync.prawndo_line import USB_IDS, PrawnDoTiming
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from tests.wire.emulated_lasers import PATIENCE_S, Silent, eventually
from tests.wire.emulated_syncs import SWEEP, TriggerLine, board

# The emulator, against bytes written by hand from docs/reference/devices/prawndo.md


def answers(model: PrawnDoModel, *lines: bytes) -> list[bytes]:
    return [model.receive(line, 0.0) for line in lines]


def listen_to(model: PrawnDoModel) -> bytearray:
    """What the host says to it from now on."""
    heard, receive = bytearray(), model.receive

    def listen(data: bytes, now_s: float) -> bytes:
        heard.extend(data)
        return receive(data, now_s)

    model.receive = listen  # type: ignore[method-assign]
    return heard


def test_the_model_speaks_as_the_firmware_does() -> None:
    model = PrawnDoModel(board=2)
    assert answers(model, b"sts\n", b"ver\r\n", b"brd\n", b"gto\n", b"abt\n", b"xyz\n", b"ab\n") == [
        b"run-status:0 clock-status:0\r\n",
        b"Version: 1.3.1\r\n",
        b"board: pico2\r\n",
        b"0\r\n",
        b"Can only abort when status is 1 or 2\r\n",
        b"Invalid command: xyz\n\r\n",
        b"Invalid command: ab\n\r\n",
    ]
    assert answers(model, b"man 7\n", b"gto\n", b"man 0\n", b"gto\n") == [b"ok\r\n", b"7\r\n", b"ok\r\n", b"0\r\n"]
    answers(model, b"adm 0 3\n", bytes.fromhex("0400 05000000 0000 00000000 0000 00000000"))
    assert answers(model, b"run\n", b"man 0\n", b"sts\n") == [
        b"ok\r\n",
        b"Cannot execute command man 0\n during buffered execution.\r\n",
        b"run-status:2 clock-status:0\r\n",
    ]


def test_the_model_takes_words_of_six_bytes_little_endian() -> None:
    model = PrawnDoModel()
    assert answers(model, b"cls\n", b"adm 0 3\n") == [b"ok\r\n", b"ready\r\n"]
    assert model.receive(bytes.fromhex("0200 a0860100 0000 00000000 0000 0000 00"), 0.0) == b""
    assert model.receive(b"\x00", 0.0) == b"ok\r\n"
    assert model.words == [(2, 100_000), (0, 0), (0, 0)]
    assert answers(model, b"len\n") == [b"Number of command lines: 6\r\nNumber of instructions: 3\r\n"]


def test_the_model_plays_cycles_of_ten_nanoseconds_from_the_trigger_on() -> None:
    line = TriggerLine()
    model = PrawnDoModel(line)
    answers(model, b"adm 0 4\n", bytes.fromhex("0000 00000000 0200 a0860100 0000 00000000 0000 00000000"), b"swr\n")
    line.pulse(0.5, 1e-5)
    model.tick(1.0)
    assert model.changes(0.0, 1.0) == [(0.0, 0), (0.5, 2), (pytest.approx(0.501), 0)]
    assert model.status == 0


# Bytes that the driver sends


def test_a_program_goes_out_as_the_reference_writes_it() -> None:
    with board() as wire, wire.open() as device:
        sent = listen_to(wire.model)
        device.program([Pulse(OUT_MARKER, None), Pulse(OUT_GATE | OUT_FRAME, 1e-3)], 1)
        device.run()
        assert device.status.outputs is None  # nobody can read pins while a program runs
    words = bytes.fromhex("0400 00000000 0300 a0860100 0000 00000000 0000 00000000")
    assert b"\nadm 0 4\n" + words + b"#" in sent
    assert b"\nswr\n" in sent
    assert sent.index(b"cls\n") < sent.index(b"adm 0") < sent.index(b"swr")
    assert b"prg" not in sent


def test_closing_aborts_then_sets_all_outputs_low_then_reads_them_back() -> None:
    with board() as wire:
        device = wire.open()
        heard = listen_to(wire.model)
        device.close()
    assert heard.startswith(b"\nabt\nsts\nman 0\n")
    assert heard.index(b"abt\n") < heard.index(b"man 0\n") < heard.index(b"gto\n")


def test_a_held_pulse_goes_out_in_slices_that_wait_for_the_marker_with_the_gate_low() -> None:
    pico = ProgramLimits("Pico", 1e8, 30_000, 40e-6)
    pulses = [Pulse(0, None), Pulse(OUT_GATE | OUT_MARKER, 1.2e-3, held=True), Pulse(0, 1e-5)]
    words = compile_program(pulses, 2, pico).tolist()
    wait, part = (OUT_MARKER, 0), (OUT_GATE | OUT_MARKER, 40_000)
    assert words == 2 * [(0, 0), part, wait, part, wait, part, (0, 1000)] + 2 * [(0, 0)]


def test_the_gate_is_low_within_half_a_millisecond_of_the_marker() -> None:
    with board() as wire, wire.open() as device:
        device.program([Pulse(0, None), Pulse(OUT_GATE, 1.0, held=True)], 1)
        device.run()
        rises_s = wire.now_s + 0.01
        wire.trigger.pulse(rises_s, 0.0101)
        wire.clock.sleep(0.05)
        assert wire.pins == 0
        changes = wire.model.changes(rises_s - 0.005, wire.now_s)
    assert [level for _, level in changes] == [0, OUT_GATE, 0]
    assert changes[1][0] == rises_s
    assert 0.0101 <= changes[2][0] - rises_s <= 0.0101 + HOLD_S


@pytest.mark.parametrize(("frame", "gate", "marker"), [(0, 1, 2), (15, 14, 13), (1, 15, 0), (7, 8, 9)])
def test_each_of_the_sixteen_outputs_may_be_gate_frames_or_marker(frame: int, gate: int, marker: int) -> None:
    with board() as wire, wire.open(frame_output=frame, gate_output=gate, marker_output=marker) as device:
        held = Pulse(OUT_GATE | OUT_MARKER, 0.5e-3, held=True)
        device.program([Pulse(OUT_MARKER, None), Pulse(OUT_GATE | OUT_FRAME, 1e-3), held], 1)
        on_pins = [word for word, _ in wire.model.words]
        assert on_pins == [1 << marker, 1 << gate | 1 << frame, 1 << marker, 1 << gate | 1 << marker, 0, 0]
        device.run()
        wire.trigger.pulse(wire.now_s, 1e-5)
        wire.clock.sleep(5e-4)
        assert wire.pins == 1 << gate | 1 << frame
        device.gate_low()
        assert wire.pins == 0
        wire.model.receive(f"man {1 << gate | 1 << marker:x}\n".encode(), wire.now_s)
        assert device.status.outputs == OUT_GATE | OUT_MARKER


def test_outputs_beyond_the_sixteen_and_an_output_with_two_uses_are_refused() -> None:
    with board() as wire:
        with pytest.raises(ValueError, match="less than or equal to 15"):
            wire.open(gate_output=16)
        with pytest.raises(ValueError, match="output 2 has two uses"):
            wire.open(gate_output=2)


# The traps of docs/reference/devices/prawndo.md, one test each


def test_trap_the_trigger_is_a_level_so_waits_closer_than_a_scan_marker_are_refused() -> None:
    with board() as wire, wire.open(trigger_pulse="40 us") as device:
        with pytest.raises(LimitExceeded, match=r"plays 4e-05 s between the wait at word 0 and the next.*4e-05 s"):
            device.program([Pulse(0, None), Pulse(OUT_GATE, 40e-6)], 2)
        device.program([Pulse(0, None), Pulse(OUT_GATE, 40e-6)], 1)  # nothing waits behind it
        device.program([Pulse(0, None), Pulse(OUT_GATE, 41e-6)], 2)
        with pytest.raises(LimitExceeded, match="plays 0 s between"):
            device.program([Pulse(0, None), Pulse(0, None), Pulse(OUT_GATE, 1e-3)], 1)
    line = TriggerLine()
    model = PrawnDoModel(line)
    two_sweeps = bytes.fromhex("0000 00000000 0200 e8030000" * 2 + "0000 00000000 0000 00000000")
    answers(model, b"adm 0 6\n", two_sweeps, b"swr\n")
    line.pulse(0.1, 40e-6)
    model.tick(1.0)
    assert model.status == 0  # one marker, two sweeps


def test_trap_words_of_one_to_four_cycles_become_waits_so_they_are_refused_before_they_are_sent() -> None:
    with board() as wire, wire.open() as device:
        with pytest.raises(LimitExceeded, match=r"word 1 lasts 4e-08 s, outside 5e-08 to 42\.9497 s"):
            device.program([Pulse(0, 1e-3), Pulse(OUT_GATE, 4e-8)], 1)
        with pytest.raises(LimitExceeded, match="word 0 lasts 43 s"):
            device.program([Pulse(0, 43.0)], 1)
        device.program([Pulse(OUT_GATE, 5e-8)], 1)
        assert wire.model.words == [(OUT_GATE, 5), (0, 0), (0, 0)]
    model = PrawnDoModel()
    (_, reply) = answers(model, b"adm 0 2\n", bytes.fromhex("0200 04000000 0200 05000000"))
    assert reply.startswith(b"Invalid number of reps in 1 instructions")
    assert model.words == [(2, 0), (2, 5)]


def test_trap_after_any_reply_but_ok_a_program_is_cleared_and_never_run() -> None:
    with board() as wire, wire.open() as device:
        device.program(SWEEP, 1)
        take = wire.model._take_words
        wire.model._take_words = lambda data: take(data).replace(b"ok", b"Invalid number of reps in 1 instructions")  # type: ignore[method-assign]
        with pytest.raises(DeviceFault, match="Invalid number of reps in 1 instructions"):
            device.program(SWEEP, 2)
        assert wire.model.words == []
        with pytest.raises(DeviceFault, match="did not arrive whole"):
            device.run()
        assert wire.model.status == 0


def test_trap_abt_leaves_the_outputs_as_they_are() -> None:
    model = PrawnDoModel()
    answers(model, b"adm 0 3\n", bytes.fromhex("0200 00e1f505 0000 00000000 0000 00000000"), b"swr\n", b"abt\n")
    model.tick(0.1)
    assert model.status == 5
    assert model.outputs_at(0.1) == OUT_GATE


def test_a_last_word_that_waits_is_parted_from_the_end() -> None:
    """Else its zero and the end's first one would be the end, with that word's outputs left on the pins."""
    with board() as wire, wire.open() as device:
        device.program([Pulse(0, 1e-3), Pulse(OUT_MARKER, None)], 1)
        device.run()
        wire.clock.sleep(0.01)
        assert device.status.state == "running"
        wire.trigger.pulse(wire.now_s, 1e-5)
        wire.clock.sleep(0.01)
        assert wire.pins == 0
        assert device.status.state == "stopped"


@pytest.mark.parametrize(
    "left",
    [
        pytest.param(b"adm 0 3\n\x02\0" + b"\0\xca\x9a\x3b" + 12 * b"\0" + b"swr\n", id="running"),
        pytest.param(b"adm 0 ea60\n\x02\0", id="359 998 bytes of a program are missing"),
        pytest.param(b"man 2\nma", id="in the middle of a line"),
        pytest.param(b"man 2\nadd\n2 5\n", id="adding words"),
        pytest.param(b"man ffff\n", id="all outputs set by hand"),
        pytest.param(b"man 2\nadd\n2 5\nend\nedt\n", id="editing a word"),
        pytest.param(b"deb\nman 2\nadd\n2 5\n", id="adding words with debug output"),
    ],
)
def test_trap_a_board_is_lowered_and_freed_by_opening_it_however_a_dead_host_left_it(left: bytes) -> None:
    with board(board=2, usb_ids=USB_IDS) as wire:
        wire.model.receive(left, 0.0)
        with wire.open() as device:
            assert wire.pins == 0
            device.program(SWEEP, 1)
            device.run()
            assert device.status.state == "running"


def test_trap_debug_output_left_on_by_somebody_is_switched_off() -> None:
    """It would stand among the answers: `run` would fail although the program plays, and low outputs could not be
    read."""
    with board() as wire:
        wire.model.receive(b"deb\n", 0.0)
        with wire.open() as device:
            device.program(SWEEP, 1)
            device.run()
            assert device.status.state == "running"


@pytest.mark.parametrize("answer", [b"hwstart: 0\r\nok\r\n", b""], ids=["a wrong answer", "no answer"])
def test_a_run_that_fails_leaves_the_outputs_low_although_the_program_has_started(answer: bytes) -> None:
    with board() as wire, wire.open() as device:
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        reply = wire.model._answer

        def answer_wrongly(line: str, now_s: float) -> bytes:
            said = reply(line, now_s)
            return answer if line.strip() == "swr" else said

        wire.model._answer = answer_wrongly  # type: ignore[method-assign]
        with pytest.raises(DeviceFault, match="swr was answered"):
            device.run()
        changes = wire.model.changes(0.0, wire.now_s)
        assert [level for _, level in changes] == [0, OUT_GATE, 0]
        assert wire.model.status == 5
        assert device.status.outputs == 0


def test_a_run_that_is_interrupted_leaves_the_outputs_low(monkeypatch: pytest.MonkeyPatch) -> None:
    with board() as wire, wire.open() as device:
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        command = device._line.command

        def interrupted(line: str) -> None:
            command(line)
            raise KeyboardInterrupt

        monkeypatch.setattr(device._line, "command", interrupted)
        with pytest.raises(KeyboardInterrupt):
            device.run()
        assert wire.pins == 0


@pytest.mark.parametrize("raw", [False, True])
def test_a_board_that_is_deleted_with_its_gate_high_is_taken_low(raw: bool, caplog: pytest.LogCaptureFixture) -> None:
    with board() as wire:
        device = wire.open()
        if raw:
            device.ask("man 2")
        else:
            device.program([Pulse(OUT_GATE, 30.0)], 1)
            device.run()
        assert wire.pins == OUT_GATE
        del device
        gc.collect()
        assert wire.pins == 0
        assert "may have been left playing; its outputs were taken low" in caplog.text
        caplog.clear()
        device = wire.open()  # its port is free
        device.ask("ver")
        del device
        gc.collect()
        assert not caplog.records


@pytest.mark.parametrize(
    ("clock_hz", "said"),
    [(None, "clock on GPIO20 is lost"), (20_000_000, r"runs at 2e\+07 Hz, not 1e\+07")],
)
def test_trap_clk_1_says_ok_whatever_the_clock_so_it_is_measured(clock_hz: int | None, said: str) -> None:
    with board(external_clock_hz=clock_hz) as wire, pytest.raises(DeviceFault, match=said):
        wire.open(external_clock="10 MHz")


def test_trap_an_external_clock_that_dies_is_noticed_before_the_next_run() -> None:
    with board(external_clock_hz=10_000_000) as wire:
        device = wire.open(external_clock="10 MHz")
        assert device.resolution_s == 1e-7
        device.program(SWEEP, 1)
        assert wire.model.words[1] == (0, 10_000)
        with wire.server.lock:
            wire.model.external_clock_hz = None
            wire.model._resuscitate()
        with pytest.raises(DeviceFault, match=r"clock on GPIO20 is lost.*power-cycle the board"):
            device.run()
        # Outputs 0 and 1 have become a serial port, whose idle line is high.
        with pytest.raises(DeviceFault, match="outputs do not go low"):
            device.abort()
        with pytest.raises(DeviceFault, match="outputs do not go low"):
            device.close()


def test_trap_a_board_whose_external_clock_stops_may_hear_nothing_until_it_is_power_cycled() -> None:
    with board(external_clock_hz=10_000_000) as wire:
        device = wire.open(external_clock="10 MHz")
        wire.server.hang()
        with pytest.raises(DeviceTimeout, match=r"clock on GPIO20.*power-cycle the board"):
            _ = device.status
        wire.server.resume()
        device.close()


@pytest.mark.parametrize(("kind", "words"), [(1, 30_000), (2, 60_000)])
def test_trap_there_are_no_loops_so_repeats_use_up_words(kind: int, words: int) -> None:
    with board(board=kind) as wire, wire.open() as device:
        most = (words - 2) // len(SWEEP)
        held = [Pulse(0, None), Pulse(OUT_GATE, 1.2e-3, held=True), Pulse(0, 1e-5)]
        assert device.most_repeats(held) == (words - 3) // 7
        device.program(SWEEP, most)
        assert len(wire.model.words) == 4 * most + 2
        with pytest.raises(LimitExceeded, match=f"it holds {words}"):
            device.program(SWEEP, most + 1)


def test_trap_a_board_that_lost_power_greets_and_has_forgotten_its_program() -> None:
    with board() as wire:
        device = wire.open()
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        device.run()
        wire.server.unplug()
        with wire.server.lock:
            wire.model.power_cycle(wire.now_s)
        wire.server.plug()
        assert wire.pins == 0
        with wire.open() as again:
            assert wire.model.words == []
            with pytest.raises(WrongState, match="program"):
                again.run()
        device.close()


# The gate first


def test_the_gate_goes_low_at_once_beside_a_question_that_is_not_answered() -> None:
    patient = PrawnDoTiming(PATIENCE_S, PATIENCE_S, PATIENCE_S, PATIENCE_S)
    with board(terminal=True) as wire, wire.open(patient) as device:
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        device.run()
        wire.clock.sleep(0.1)
        wire.server.hang()
        failures: list[BaseException] = []
        said = device._line._serial_number

        def ask() -> None:
            try:
                _ = device.status
            except DeviceError as error:
                failures.append(error)
                wire.server.resume()

        asking = threading.Thread(target=ask)
        asking.start()
        eventually(lambda: device._line._serial_number > said)
        device.gate_low()
        asking.join()
        assert wire.pins == 0
        assert isinstance(failures[0], DeviceFault)


def test_a_board_that_does_not_answer_is_no_low_gate() -> None:
    with board() as wire:
        device = wire.open()
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        device.run()
        wire.server.hang()
        begun_s = wire.now_s
        with pytest.raises(DeviceTimeout, match="did not answer"):
            device.gate_low()
        assert wire.now_s - begun_s < 2
        wire.server.resume()
        device.close()


def test_debug_noise_and_blank_lines_do_not_confuse_it() -> None:
    with board() as wire, wire.open() as device:
        wire.model._unasked += b"\r\nhwstart: 0\r\n"
        assert device.status.outputs == 0


# Wrong and missing hardware: one line each


def test_a_board_that_is_unplugged(caplog: pytest.LogCaptureFixture) -> None:
    with board() as wire:
        device = wire.open()
        wire.server.unplug()
        assert device.port_lost
        for verb in (lambda: device.status, device.abort, lambda: device.program(SWEEP, 1)):
            with pytest.raises(DeviceDisconnected, match="plug it in again"):
                verb()
        device.close()
        assert "could not be left safe" in caplog.text
        wire.server.plug()
        wire.open().close()


def test_firmware_that_is_too_old() -> None:
    """Up to 1.3.0 `swr` waits for a trigger, and `man` after `abt` may set the next word of the program instead."""
    for version in ("1.2.0", "1.3.0"):
        said = rf"firmware {version} is older than 1\.3\.1"
        with board(version=version) as wire, pytest.raises(ProtocolError, match=said):
            wire.open()


def test_a_device_that_is_no_prawndo() -> None:
    class Laser(Silent):
        def receive(self, data: bytes, now_s: float) -> bytes:
            return b"Syntax error: illegal command\r\n" * data.count(b"\n")

    with board() as wire:
        wire.server.model = Laser()
        with pytest.raises(ProtocolError, match="is no PrawnDO"):
            wire.open()


def test_a_port_that_says_nothing() -> None:
    with board() as wire:
        wire.server.hang()
        with pytest.raises(DeviceTimeout):
            wire.open()


@pytest.mark.parametrize("left", [b"", b"adm 0 ea60\n"], ids=["another device", "a board in the middle of a program"])
def test_nothing_large_is_sent_to_a_port_without_usb_ids_before_it_has_said_what_it_is(left: bytes) -> None:
    class Deaf(Silent):
        heard = 0

        def receive(self, data: bytes, now_s: float) -> bytes:
            self.heard += len(data)
            return b""

    with board(board=2) as wire:
        if left:
            wire.model.receive(left, 0.0)
            heard = listen_to(wire.model)
        else:
            wire.server.model = deaf = Deaf()
        with pytest.raises(DeviceTimeout, match=r"no USB ids.*unplug it") as refused:
            wire.open()
        assert (len(heard) if left else deaf.heard) < 2000
        assert "\n" not in str(refused.value)


def test_a_port_of_another_usb_device_is_refused_before_a_byte_is_sent() -> None:
    with board(usb_ids=(0x0403, 0x6001)) as wire:
        heard = listen_to(wire.model)
        with pytest.raises(ProtocolError, match=r"/dev/emulated-\w+ is USB device 0403:6001, not 2e8a:000a") as refused:
            wire.open()
        assert not heard
        assert "\n" not in str(refused.value)


def test_outputs_are_confirmed_low_though_every_answer_reaches_an_overloaded_host_late() -> None:
    with board() as wire, wire.open() as device:
        device.program([Pulse(OUT_GATE, 30.0)], 1)
        device.run()
        queue = wire.server._queue
        wire.server._queue = lambda at, data: queue(at + 0.4, data)  # type: ignore[method-assign]
        device.abort()
        assert wire.pins == 0
