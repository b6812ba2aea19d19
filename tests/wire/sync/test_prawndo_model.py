"""The model of the PrawnDO firmware alone, bytes in and bytes out, against the source of the firmware. No driver."""

import struct
from collections.abc import Callable

import pytest

from sim_backend.wire.firmware.prawndo import (
    ABORT_REQUESTED,
    ABORTED,
    BANNER,
    MAX_WORDS,
    RUNNING,
    STOPPED,
    PrawnDoModel,
)

PROGRAM = b"add\n1 64\n2 64\n3 0\n0 0\nend\n"
"""Two words of 100 cycles, then the end, with outputs 0 and 1 high."""


def said(model: PrawnDoModel, sent: bytes, at_s: float = 0.0) -> bytes:
    return model.receive(sent, at_s)


def words(*program: tuple[int, int]) -> bytes:
    return b"".join(struct.pack("<HI", outputs, cycles) for outputs, cycles in program)


def high_from(start_s: float) -> Callable[[float, float], float | None]:
    """A trigger input that is high from a time on."""
    return lambda from_s, until_s: max(from_s, start_s) if max(from_s, start_s) < until_s else None


def assert_changes(model: PrawnDoModel, *changes: tuple[float, int]) -> None:
    """Compare the changes of the outputs after 0 s."""
    times, levels = zip(*model.changes(0.0, 10.0)[1:], strict=True)
    assert levels == tuple(level for _, level in changes)
    assert times == pytest.approx([at for at, _ in changes], abs=1e-9)


# Answers to commands at rest.


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        (b"ver\n", b"Version: 1.3.1\r\n"),
        (b"version\r\n", b"Version: 1.3.1\r\n"),
        (b"brd\r\n", b"board: pico1\r\n"),
        (b"sts\r\n", b"run-status:0 clock-status:0\r\n"),
        (b"deb\r\n", b"ok\r\n"),
        (b"ndb\r\n", b"ok\r\n"),
        (b"abt\r\n", b"Can only abort when status is 1 or 2\r\n"),
        (b"cls\r\n", b"ok\r\n"),
        (b"man\r\n", b"invalid request\r\n"),
        (b"man xyz\r\n", b"invalid request\r\n"),
        (b"man 1fxyz\r\n", b"ok\r\n"),
        (b"man5\r\n", b"invalid request\r\n"),
        (b"gto\r\n", b"0\r\n"),
        (b"len\r\n", b"Number of command lines: 0\r\nNumber of instructions: 0\r\n"),
        (b"set 0 1\r\n", b"Invalid instruction\r\n"),
        (b"set 7530 1 5\r\n", b"Invalid instruction address 7530\r\n"),
        (b"set 0 10000 5\r\n", b"Invalid output specification 10000\r\n"),
        (b"set 0 1 4\r\n", b"Reps must be 0 or greater than 4, got 4\r\n"),
        (b"set 0 ffff ffffffff\r\n", b"ok\r\n"),
        (b"get\r\n", b"Invalid request\r\n"),
        (b"get 0\r\n", b"Invalid address\r\n"),
        (b"adm 0\r\n", b"Invalid request\r\n"),
        (b"adm 1 7530\r\n", b"Invalid address and/or too many instructions (1 + 30000).\r\n"),
        (b"adm ffffffff 2\r\n", b"Invalid address and/or too many instructions (-1 + 2).\r\n"),
        (b"adm 0 0\r\n", b"ready\r\nok\r\n"),
        (b"dmp\r\n", b""),
        (b"edt\r\n", b"No commands to edit\r\nok\r\n"),
        (b"add\r\nend\r\n", b"ok\r\n"),
        (b"\n", b"Invalid command: \n\r\n"),
        (b"x\n", b"Invalid command: x\n\r\n"),
        (b"xyz\r\n", b"Invalid command: xyz\r\n\r\n"),
        (b"xy\0z\r\n", b"Invalid command: xy\r\n"),
        (b"VER\n", b"Invalid command: VER\n\r\n"),
    ],
)
def test_it_answers_a_command_at_rest(sent: bytes, answered: bytes) -> None:
    assert said(PrawnDoModel(), sent) == answered


def test_a_command_may_come_in_pieces() -> None:
    model = PrawnDoModel()
    assert [said(model, piece) for piece in (b"v", b"er", b"\r", b"\nst", b"s\n")] == [
        b"",
        b"",
        b"",
        b"Version: 1.3.1\r\n",
        b"run-status:0 clock-status:0\r\n",
    ]


def test_an_answer_loses_what_is_beyond_127_characters() -> None:
    answer = said(PrawnDoModel(), b"x" * 200 + b"\n")
    assert answer == b"Invalid command: " + b"x" * 110, "without a line end"


def test_an_older_release_has_no_brd() -> None:
    model = PrawnDoModel(version="1.2.2")
    assert said(model, b"ver\nbrd\n") == b"Version: 1.2.2\r\nInvalid command: brd\n\r\n"


# The program in the memory.


def test_words_are_read_back_as_they_were_set() -> None:
    model = PrawnDoModel()
    assert (
        said(model, b"set 0 f 5\nset 1 0 0\nget 0\nget 1\nget 2\n") == b"ok\r\nok\r\nf 5\r\n0 0\r\nInvalid address\r\n"
    )
    assert said(model, b"dmp\n") == b"do_cmd: 000f\r\n\treps: 5\r\ndo_cmd: 0000\r\n\tWait\r\n"
    assert said(model, b"cur\n") == b"Output: 0\r\nReps: 4\r\nWait\r\n"
    assert said(model, b"len\n") == b"Number of command lines: 4\r\nNumber of instructions: 2\r\n"
    assert said(model, b"get 80000000\n") == b"f 5\r\n", "twice the address has 32 bits"


def test_two_waits_in_a_row_cut_the_program_there() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM)
    assert said(model, b"set 1 2 0\nlen\n").endswith(b"instructions: 4\r\n")
    assert said(model, b"set 2 0 0\nlen\n").endswith(b"instructions: 3\r\n")


def test_the_memory_keeps_what_is_beyond_the_program() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM)
    assert said(model, b"cls\nset 3 7 8\n") == b"ok\r\nok\r\n"
    assert model.words == [(1, 100), (2, 100), (3, 0), (7, 8)]
    assert said(model, b"cls\nadm 1 1\n" + words((9, 9))) == b"ok\r\nready\r\nok\r\n"
    assert model.words == [(1, 100), (9, 9)]


def test_add_takes_lines_until_end_and_answers_once() -> None:
    model = PrawnDoModel()
    assert said(model, b"add\n1 64\nsts\n2\n") == b"", "a line that is no word is swallowed"
    assert said(model, b"add 5\n") == b"", "add is a hexadecimal number"
    assert said(model, b"end\n") == b"ok\r\n"
    assert model.words == [(1, 0x64), (0xADD, 5)]
    assert said(model, b"add\n1 3\nlen\n").startswith(b"Reps must be 0 or greater than 4, got 3\r\nNumber of")
    assert said(model, b"add\n10000 5\nsts\n").startswith(b"Invalid output specification 10000\r\nrun-status")


def test_an_empty_line_of_add_repeats_the_word() -> None:
    model = PrawnDoModel()
    assert said(model, b"add\n1 64\n\nend\n") == b"ok\r\n"
    assert model.words == [(1, 100), (1, 100)]


def test_add_ends_without_a_word_one_word_before_the_memory_is_full() -> None:
    model = PrawnDoModel()
    most = MAX_WORDS[1]
    said(model, f"set {most - 3:x} 1 5\n".encode())
    assert said(model, b"add\n1 5\nend\n") == b"Invalid command: end\n\r\n"
    assert len(model.words) == most - 1
    assert said(model, b"add\n") == b""
    assert said(model, b"sts\n") == b"run-status:0 clock-status:0\r\n"


def test_edt_replaces_the_last_word_and_makes_it_four_cycles_longer() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM)
    assert said(model, b"edt\nsts\n5 a\n") == b"ok\r\n", "sts is no word"
    assert said(model, b"get 3\ncur\n") == b"5 e\r\nOutput: 5\r\nReps: 14\r\n"


def test_adm_takes_everything_until_its_last_byte() -> None:
    model = PrawnDoModel()
    assert said(model, b"adm 0 2\nsts\n") == b"ready\r\n", "sts is taken for a part of the first word"
    assert said(model, words((1, 5), (2, 6))[4:]) == b"ok\r\n"
    assert len(model.words) == 2
    assert said(model, b"sts\n") == b"run-status:0 clock-status:0\r\n"


def test_adm_makes_waits_of_short_words_and_counts_from_the_start_of_the_program() -> None:
    model = PrawnDoModel()
    assert said(model, b"adm 2 3\n" + words((1, 4), (2, 5), (3, 1))) == (
        b"ready\r\nInvalid number of reps in 2 instructions, most recent error at instruction 5. "
        b"Setting reps to zero for these instructions.\r\n"
    )
    assert model.words[2:] == [(1, 0), (2, 5), (3, 0)]


def test_the_error_of_adm_loses_its_line_end_when_its_numbers_are_long() -> None:
    model = PrawnDoModel()
    answer = said(model, b"adm 0 2710\n" + words(*[(0, 1)] * 10_000))
    assert len(answer) == len(b"ready\r\n") + 127
    assert answer.endswith(b"zero for these instructio")


# Running.


def test_a_running_program_refuses_commands_and_quotes_them_with_their_line_end() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM + b"run\n")
    refused = b"cls", b"run", b"swr", b"man 1", b"gto", b"set 0 1 5", b"get 0", b"add", b"adm 0 1", b"dmp", b"len"
    for command in (*refused, b"clk 0 100000000", b"edt", b"cur", b"frq", b"prg", b"xyz", b"ab"):
        quoted = b"Cannot execute command " + command + b"\n during buffered execution.\r\n"
        assert said(model, command + b"\n") == quoted
    assert said(model, b"ver\nbrd\ndeb\nndb\n") == b"Version: 1.3.1\r\nboard: pico1\r\nok\r\nok\r\n"
    assert said(model, b"a\n") == b"Invalid command: a\n\r\n"
    assert model.status == RUNNING


def test_the_states_of_a_run_that_is_aborted() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM)
    assert said(model, b"run\n") == b"ok\r\n"
    assert said(model, b"sts\n") == b"run-status:2 clock-status:0\r\n"
    assert said(model, b"abt\n") == b"ok\r\n"
    assert model.status == ABORT_REQUESTED
    assert said(model, b"abt\n") == b"Can only abort when status is 1 or 2\r\n"
    assert said(model, b"sts\n") == b"run-status:5 clock-status:0\r\n"
    assert said(model, b"man 5\ngto\n") == b"ok\r\n5\r\n"
    assert model.status == ABORTED


def test_an_abort_in_the_instant_of_the_end_blocks_all_until_the_power_is_off() -> None:
    model = PrawnDoModel()
    model.late_abort = True
    assert said(model, PROGRAM + b"swr\nabt\n") == b"ok\r\nok\r\nok\r\n"
    for now_s in (1.0, 2.0):
        assert said(model, b"sts\n", now_s) == b"run-status:3 clock-status:0\r\n"
        assert said(model, b"abt\n", now_s) == b"Can only abort when status is 1 or 2\r\n"
        assert said(model, b"man 0\n", now_s) == b"Cannot execute command man 0\n during buffered execution.\r\n"
    model.power_cycle(3.0)
    assert said(model, b"sts\n", 3.0) == BANNER + b"run-status:0 clock-status:0\r\n"


def test_a_software_start_plays_at_once_and_a_hardware_start_at_the_level() -> None:
    for command, start_s in ((b"swr\n", 1.0), (b"run\n", 2.0)):
        model = PrawnDoModel(high_from(2.0))
        said(model, PROGRAM + command, 1.0)
        model.advance(3.0)
        assert model.status == STOPPED
        assert_changes(model, (start_s, 1), (start_s + 1e-6, 2), (start_s + 2e-6, 3))


def test_a_wait_that_is_the_last_word_holds_for_ever() -> None:
    model = PrawnDoModel(high_from(0.0))
    said(model, b"add\n1 64\n2 0\nend\nswr\n")
    assert said(model, b"sts\n", 10.0) == b"run-status:2 clock-status:0\r\n"
    assert model.outputs_at(10.0) == 2


def test_man_with_bit_16_starts_the_program() -> None:
    model = PrawnDoModel()
    said(model, PROGRAM)
    assert said(model, b"man 10000\n") == b"ok\r\n"
    assert said(model, b"gto\n", 1.0) == b"3\r\n"
    assert said(model, b"man 30000\nsts\n", 1.0).endswith(b"run-status:1 clock-status:0\r\n")
    assert PrawnDoModel().receive(b"man 20005\ngto\n", 0.0) == b"ok\r\n5\r\n"


def test_before_release_1_3_1_swr_waits_and_man_lags_after_an_abort() -> None:
    model = PrawnDoModel(version="1.3.0")
    said(model, b"add\n1 0\n2 64\n4 64\nend\nswr\n")
    model.advance(1.0)
    assert model.outputs_at(1.0) == 0
    said(model, b"abt\n", 1.0)
    assert said(model, b"man 0\ngto\nman f\ngto\nman 0\ngto\n", 1.0) == b"ok\r\n1\r\nok\r\n0\r\nok\r\nf\r\n"


# Debugging.


def test_debugging_adds_lines() -> None:
    model = PrawnDoModel()
    said(model, b"deb\n")
    assert said(model, b"add\n1 64\n") == b"Output: 1\r\nNumber of Reps: 100\r\n"
    assert said(model, b"2 0\nend\n") == b"Output: 2\r\nNumber of Reps: 0\r\nWait\r\nok\r\n"
    assert said(model, b"set 2 3 5\n") == b"NumNZ: 6, Arr Idx: 4, Output: 3, Reps: 1\r\nok\r\n"
    assert said(model, b"man 7\n") == b"ok\r\nOutput commanded: 7\r\n"
    assert said(model, b"run\n") == b"ok\r\nhwstart: 1\r\n"
    assert said(model, b"abt\n") == b"ok\r\n"
    stopped = b"Tight execution loop ended\r\nProgram ended at instr 2\r\nAborted execution\r\nCore1 loop ended\r\n"
    assert said(model, b"sts\n") == stopped + b"run-status:5 clock-status:0\r\n"
    assert said(model, b"ndb\nrun\n") == b"ok\r\nok\r\n"


def test_debugging_tells_the_end_of_a_program() -> None:
    model = PrawnDoModel()
    assert said(model, PROGRAM + b"deb\nswr\n") == b"ok\r\nok\r\nok\r\nhwstart: 0\r\n"
    assert model.tick(1.0) == (
        b"Tight execution loop ended\r\nProgram ended at instr 16\r\nExecution stopped\r\nCore1 loop ended\r\n"
    )


def test_before_release_1_3_1_set_has_no_debug_line() -> None:
    assert said(PrawnDoModel(version="1.3.0"), b"deb\nset 0 1 5\n") == b"ok\r\nok\r\n"


# The clock.


@pytest.mark.parametrize(
    ("board", "sent", "answered"),
    [
        (1, b"clk 0\n", b"invalid clock request\r\n"),
        (1, b"clk 3 100\n", b"invalid clock source request\r\n"),
        (1, b"clk 0 133000001\n", b"invalid clock frequency request\r\n"),
        (1, b"clk 0 133000000\n", b"ok\r\n"),
        (2, b"clk 0 150000000\n", b"ok\r\n"),
        (2, b"clk 0 150000001\n", b"invalid clock frequency request\r\n"),
        (1, b"clk 0 100000999\n", b"ok\r\n"),
        (1, b"clk 0 99999999\n", b"Failure. Cannot exactly achieve that clock frequency\r\n"),
        (1, b"clk 0 10000000\n", b"Failure. Cannot exactly achieve that clock frequency\r\n"),
        (1, b"clk 0 0\n", b"Failure. Cannot exactly achieve that clock frequency\r\n"),
    ],
)
def test_it_answers_clk(board: int, sent: bytes, answered: bytes) -> None:
    assert said(PrawnDoModel(board=board), sent) == answered


def test_frq_has_no_real_time_clock_on_a_pico_2() -> None:
    pico = said(PrawnDoModel(), b"clk 0 125000000\nfrq\n").split(b"\r\n")
    assert pico[1] == b"pll_sys = 125000kHz"
    assert pico[4] == b"clk_sys = 125000kHz"
    assert pico[8] == b"clk_rtc = 46kHz"
    assert said(PrawnDoModel(board=2), b"frq\n").count(b"\r\n") == 7


@pytest.mark.parametrize("source", [1, 2])
def test_the_program_is_played_with_the_external_clock_whatever_was_said_of_it(source: int) -> None:
    model = PrawnDoModel(external_clock_hz=10_000_000)
    assert said(model, PROGRAM + f"clk {source} 50000000\nsts\n".encode()).endswith(b"run-status:0 clock-status:1\r\n")
    said(model, b"swr\n", 1.0)
    model.advance(2.0)
    assert_changes(model, (1.0, 1), (1.0 + 10e-6, 2), (1.0 + 20e-6, 3))


def test_a_clock_that_is_missing_is_told_before_ok() -> None:
    model = PrawnDoModel()
    assert said(model, b"clk 1 10000000\n") == b"System Clock Resus'd\r\nok\r\n"
    assert said(model, b"sts\n") == b"run-status:0 clock-status:0\r\n"


def test_a_clock_that_dies_takes_two_outputs_away_until_the_power_is_off() -> None:
    model = PrawnDoModel(external_clock_hz=10_000_000)
    said(model, b"clk 1 10000000\nman fffe\n")
    model.set_external_clock(None, 1.0)
    assert model.tick(1.0) == b"System Clock Resus'd\r\n"
    assert said(model, b"sts\ngto\n", 1.0) == b"run-status:0 clock-status:0\r\nfffd\r\n"
    assert said(model, b"man 0\ngto\nman ffff\ngto\n", 2.0) == b"ok\r\n1\r\nok\r\nfffd\r\n"
    model.power_cycle(3.0)
    assert model.tick(3.0) == BANNER
    assert said(model, b"man 3\ngto\n", 4.0) == b"ok\r\n3\r\n"


def test_a_build_without_a_uart_keeps_its_outputs() -> None:
    model = PrawnDoModel(external_clock_hz=10_000_000, uart_takes_pins=False)
    said(model, b"clk 1 10000000\nman 2\n")
    model.set_external_clock(None, 1.0)
    assert said(model, b"gto\n", 1.0) == b"System Clock Resus'd\r\n2\r\n"


def test_a_program_goes_on_with_the_internal_clock() -> None:
    model = PrawnDoModel(external_clock_hz=10_000_000, uart_takes_pins=False)
    said(model, b"clk 1 10000000\n" + PROGRAM + b"swr\n")
    model.set_external_clock(None, 5e-6)  # in the middle of the first word, of 10 us
    model.advance(1.0)
    assert_changes(model, (5.5e-6, 2), (6.5e-6, 3))


def test_the_bootloader_answers_nothing() -> None:
    model = PrawnDoModel()
    assert said(model, b"man ff\nprg\nver\n") == b"ok\r\n"
    assert said(model, b"ver\n", 1.0) == b""
    assert model.outputs_at(1.0) == 0
    model.power_cycle(2.0)
    assert said(model, b"ver\n", 3.0) == BANNER + b"Version: 1.3.1\r\n"
