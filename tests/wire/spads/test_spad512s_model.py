"""The model of the vendor's program for a SPAD512S alone, bytes in and bytes out, as the vendor's clients use it."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.spads.orientation import turn_packed
from sim_backend.wire.firmware.spad512s import (
    CALIBRATION_BEGUN,
    CALIBRATION_DONE,
    CALIBRATION_SOON,
    READ_OUT_S,
    Spad512sModel,
)

FRAME_BYTES = 32_768
LONG = 1 << 24


class Upright:
    """A source of random frames that remembers what it gave."""

    def __init__(self, width: int, height: int) -> None:
        self._shape = height, width // 8
        self._rng = np.random.default_rng(0)
        self.given: list[NDArray[np.uint8]] = []

    def __call__(self, first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
        frames = self._rng.integers(0, 256, (n, *self._shape), np.uint8)
        self.given.extend(frames)
        return frames


def program(size: tuple[int, int] = (512, 512), **settings: Any) -> tuple[Spad512sModel, Upright]:
    """The program with a client that has read the banner."""
    frames = Upright(*size)
    model = Spad512sModel(frames, **settings)
    model.connected(0.0)
    assert model.send(LONG, 0.0), "the banner"
    return model, frames


def answer(model: Spad512sModel, command: bytes, now_s: float = 0.0) -> bytes:
    model.receive(command, now_s)
    said = b""
    while piece := model.send(LONG, now_s):
        said += piece
    return said


def test_the_first_word_of_the_banner_is_the_detector() -> None:
    usual, other = Spad512sModel(Upright(512, 512)), Spad512sModel(Upright(512, 512), banner="cSPAD ready")
    for model, banner in [(usual, b"SPAD512S TCP server\n"), (other, b"cSPAD ready")]:
        model.connected(0.0)
        assert model.send(LONG, 0.0) == banner
        assert model.send(LONG, 0.0) == b""


@pytest.mark.parametrize("flavour", ["512", "1M"])
def test_the_vendors_client_finds_the_flavour_after_18_characters_of_the_sixth_line(flavour: str) -> None:
    lines = answer(program(flavour=flavour)[0], b"D").decode().split("\n")
    assert lines[5][18:] == flavour
    assert len(lines) == 10, "nine lines, each with its end"


def test_a_unit_may_leave_the_labels_out() -> None:
    model, _ = program(labels=False, flavour="1M", intensity=False)
    assert answer(model, b"D") == b"MASTER-0042\nSLAVE-0043\n2.3.1\n1.4\n1.1\n1M\n0\n1\n0\n"


def test_the_first_question_starts_the_calibration_and_the_second_is_answered() -> None:
    model, _ = program(calibration_s=15.0)
    assert answer(model, b"D") == (CALIBRATION_SOON + CALIBRATION_BEGUN).encode()
    assert model.send(LONG, 14.9) == b""
    assert model.send(LONG, 15.0) == CALIBRATION_DONE.encode()
    assert answer(model, b"D", 15.0).startswith(b"Master FPGA serial: ")


def test_voltages_and_temperatures_are_lists() -> None:
    model, _ = program()
    assert answer(model, b"V") == b"23.5,4.0"
    assert answer(model, b"V,7") == b"Excess bias set to 7.0 V"
    assert answer(model, b"V\n") == b"23.5,7.0"
    assert len(answer(model, b"R").split(b",")) == 6
    assert len(answer(program(extra_fields=True)[0], b"R").split(b",")) == 8


@pytest.mark.parametrize(
    "command",
    [
        b"I,1,10,3,0,1,0,1",
        b"I,1,10,3,0,1,0,1\n",
        b"I,1,10.5,3,0,1,0,1",
        b"I,1,10,3,0,1,0,1,512",
    ],
)
def test_eight_fields_and_nine_give_the_same_bytes(command: bytes) -> None:
    model, frames = program()
    data = answer(model, command)
    assert data[-4:] == b"DONE"
    assert len(data) == 3 * FRAME_BYTES + 4
    read = np.frombuffer(data[:-4], np.uint8).reshape(3, 512, 64)
    for turned, upright in zip(read, frames.given, strict=True):
        assert np.array_equal(np.rot90(np.unpackbits(turned).reshape(512, 512)), np.unpackbits(upright, axis=1))


@pytest.mark.parametrize(
    ("fields", "command"),
    [
        ((8,), b"I,1,10,3,0,1,0,1,512"),
        ((9,), b"I,1,10,3,0,1,0,1"),
        ((8, 9), b"I,1,10,3,0,1,0"),
        ((8, 9), b"I,1,10,3,0,1,0,1,512,0"),
        ((8, 9), b"I"),
        ((8, 9), b"I,1,ten,3,0,1,0,1"),
    ],
)
def test_a_unit_refuses_other_numbers_of_fields(fields: tuple[int, ...], command: bytes) -> None:
    assert answer(program(fields=fields)[0], command) == b"Wrong number of arguments ERROR"


@pytest.mark.parametrize("command", [b"I,8,15,20,0,0,0,0", b"I,1,10,3,0,1,0,0", b"I,1,10,3,0,1,0,1,256"])
def test_other_modes_are_not_emulated(command: bytes) -> None:
    assert answer(program()[0], command) == b"Mode not emulated ERROR"


def test_a_megapixel_frame_has_131072_bytes() -> None:
    model, frames = program((1024, 1024), flavour="1M")
    data = answer(model, b"I,1,20,2,0,1,0,1,1024")
    assert len(data) == 2 * 131_072 + 4
    upright = np.empty((2, 1024, 128), np.uint8)
    turn_packed(np.frombuffer(data[:-4], np.uint8).reshape(2, 1024, 128), 90, upright)
    assert np.array_equal(upright, frames.given)
    assert answer(model, b"I,1,20,2,0,1,0,1,512") == b"Mode not emulated ERROR"


def test_a_1m_unit_may_deliver_half_of_its_columns() -> None:
    model, _ = program((1024, 512), flavour="1M", columns=512)
    assert len(answer(model, b"I,1,20,2,0,1,0,1")) == 2 * 65_536 + 4


@pytest.mark.parametrize(
    ("overlap", "t_int_us", "period_s"),
    [(1, 5, READ_OUT_S), (1, 20, 20e-6), (0, 20, 20e-6 + READ_OUT_S)],
)
def test_without_overlap_the_read_out_comes_on_top(overlap: int, t_int_us: int, period_s: float) -> None:
    model, _ = program(paced=True)
    model.receive(f"I,1,{t_int_us},1,0,{overlap},0,1".encode(), 0.0)
    assert model.send(LONG, 0.999 * period_s) == b""
    assert len(model.send(LONG, period_s)) == FRAME_BYTES
    assert model.send(LONG, period_s) == b"DONE"


def test_pile_up_correction_need_not_be_set_but_for_a_unit_that_wants_it() -> None:
    model, _ = program(wants_pile_up=True)
    run = b"I,1,10,1,0,1,0,1"
    assert answer(model, run) == b"Pile-up correction not set ERROR"
    assert answer(model, b"PU,0") == b"Pile-up correction set"
    assert answer(model, run).endswith(b"DONE")
    assert answer(model, run).endswith(b"ERROR")


def test_an_error_in_a_run_comes_as_text_after_pixels() -> None:
    model, _ = program()
    model.fail_at_byte = 1000
    data = answer(model, b"I,1,10,1,0,1,0,1")
    assert data[1000:] == model.fail_text
    assert data[-5:] == b"ERROR"


def test_what_comes_during_a_run_is_not_answered_but_for_stop() -> None:
    model, _ = program()
    model.receive(b"I,1,10,100,0,1,0,1", 0.0)
    assert len(model.send(LONG, 0.0)) == 8 * FRAME_BYTES
    model.receive(b"R", 0.0)
    model.receive(b"STOP", 0.0)
    assert model.send(LONG, 0.0) == b"ERROR"
    assert model.send(LONG, 0.0) == b""
