"""The model of the LaserCube's firmware alone, bytes in and bytes out. No driver.

lasershark.c, lasershark.h, usbuser.c and dac124s085.h are the firmware of its ancestor, `macpod/lasershark_firmware`
f33c6d6. LaserdockDevice.cpp, LaserdockSample.h and laserdocklibcircle.cpp are in `Wickedlasers/laserdocklib` 51d13bc,
ldUSBHardware.cpp in `Wickedlasers/libLaserdockCore` c77cdc2. Bridge is `Joewodsen/lasercube-v1-ethernet-bridge`
389a35f, whose author measured a LaserCube.
"""

import struct

import numpy as np
import pytest

from tests.wire.scanners.lasercube import BLUE, COMMANDS, GREEN, RED, REPLIES, SAMPLES, LaserCubeModel

OPENING = b"\x8b \x8c \x8d\x00 \x8e \x84 \x87 \x88 \x8a \x80\x00 \x82\x30\x75\x00\x00 \x80\x01".split(b" ")
"""Commands of the vendor's program up to the first sample (ldUSBHardware.cpp:69-160), for 30 000 samples per second."""
ANSWERS = [3, 7, 0, 64, 64_000, 0, 4095, 768, 0, 0, 1]
"""Numbers in the answers of firmware 3.7 (Bridge: lasercube.py; README.md); the last one is lasershark.c:238-243."""
MID = 0x7FF


def said(model: LaserCubeModel, sent: bytes, at_s: float = 0.0) -> bytes:
    assert model.out(COMMANDS, sent, at_s) == len(sent)
    reply = model.inp(REPLIES, 64, at_s)
    assert isinstance(reply, bytes)
    return reply


def number(reply: bytes) -> int:
    assert reply[1] == 0, "refused"
    return int.from_bytes(reply[2:6], "little")


def samples(*x: int, y: int = 0x123) -> bytes:
    """Samples of red 1, green 2 and blue 3 (LaserdockSample.h)."""
    return b"".join(struct.pack("<4H", 0x0201, 3, one, y) for one in x)


def opened() -> LaserCubeModel:
    """A cube as the vendor's program leaves it before the first sample."""
    model = LaserCubeModel()
    for sent in OPENING:
        said(model, sent)
    return model


def x(model: LaserCubeModel, *at_s: float) -> list[int]:
    model.advance(max(at_s))
    return [round(each) for each in (model.history.command(np.array(at_s)) + 1) / 2 * 4095]


def colours(model: LaserCubeModel, at_s: float) -> list[int]:
    return [int(model.history.level(line, np.array([at_s]))[0]) for line in (RED, GREEN, BLUE)]


def test_it_is_found_as_the_vendor_s_library_looks_for_it() -> None:
    spec = LaserCubeModel().spec
    assert (spec.vendor, spec.product) == (0x1FC9, 0x04D8)  # LaserdockDeviceManager.cpp:11-12
    assert (spec.manufacturer, spec.product_name, spec.speed) == ("WICKED", "Laserdock", "full")  # issue 15
    ends = {(one.interface, one.alternate): [end.address for end in one.endpoints] for one in spec.alternates}
    assert ends[0, 0] == [0x01, 0x81]  # LaserdockDevice.cpp:26, 30
    assert ends[1, 1] == [0x03]  # LaserdockDevice.cpp:275, LaserdockDevice_desktop.cpp:18-24


def test_it_answers_the_vendor_s_program_with_64_bytes_each() -> None:
    model = LaserCubeModel()
    replies = [said(model, sent) for sent in OPENING]
    assert {len(reply) for reply in replies} == {64}  # LaserdockDevice.cpp:31
    assert [reply[0] for reply in replies] == [sent[0] for sent in OPENING]  # lasershark.c:220
    assert [number(reply) for reply in replies] == ANSWERS
    assert number(said(model, b"\x83")) == 30_000  # LaserdockDevice.cpp:205-207


def test_before_that_it_is_off_slow_and_at_the_centre() -> None:
    model = LaserCubeModel()
    assert [number(said(model, query)) for query in (b"\x81", b"\x83")] == [
        0,
        1000,
    ]  # lasershark.c:72, lasershark.h:112
    assert x(model, 1.0) == [MID]  # dac124s085.h:39


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        (b"\x85", b"\x85\x00\x04\x00"),  # lasershark.c:258-261, lasershark.h:102
        (b"\x86", b"\x86\x00\x40\x00"),  # lasershark.c:262-266, lasershark.h:104
        (b"\x89", b"\x89\x00\x00\x03"),  # Bridge; lasershark.c:280-283, lasershark.h:101
        (b"\x80\x02", b"\x80\x01\x01\x00"),  # lasershark.c:234-243: refused, and the state
        (b"\x82\x00\x00\x00\x00", b"\x82\x01\x00\x00"),  # lasershark.c:308-310
        (b"\x82\x01\xfa\x00\x00", b"\x82\x01\x00\x00"),  # lasershark.c:308-310: 64 001
        (b"\xbf", b"\xbf\xff\x00\x00"),  # Bridge; lasershark.c:299-301
    ],
)
def test_it_answers(sent: bytes, answered: bytes) -> None:
    model = opened()
    assert said(model, sent)[:4] == answered
    assert number(said(model, b"\x83")) == 30_000


def test_samples_of_12_bits_play_after_a_blank_one_and_the_last_one_waits_for_the_next() -> None:
    model = opened()
    assert model.out(SAMPLES, samples(0xABC, 0x1001), 1.0) == 16
    at = 1.0 + np.array([0.5, 1.5, 9]) / 30_000
    # lasershark.c:57-67, 212-213: the head is one place before the first sample, and blank. 374-397: it plays unless
    # the tail follows it at once; then values are kept, dark.
    assert x(model, *at) == [MID, 0xABC, 0xABC]
    assert [colours(model, each) for each in at] == [[0, 0, 0], [1, 2, 3], [0, 0, 0]]
    model.out(SAMPLES, samples(0x7), 2.0)
    assert x(model, 2.0 + 0.5 / 30_000, 3.0) == [0x001, 0x001]  # dac124s085.c: masked
    assert colours(model, 2.0 + 0.5 / 30_000) == [1, 2, 3]


def test_a_sample_lasts_a_whole_number_of_ticks_of_the_timer() -> None:
    model = opened()
    said(model, b"\x82" + struct.pack("<I", 35_000))  # lasershark.c:313: 72 MHz / 35 kHz is 2057.14 ticks
    model.out(SAMPLES, samples(*[1] * 700, 9, 9), 1.0)
    ends_s = 1.0 + 701 * 2057 / 72e6  # after a blank one
    assert x(model, ends_s - 1e-7, ends_s + 1e-7) == [1, 9]


@pytest.mark.parametrize("left", [b"\x80\x00", b"\x8d\x00"])
def test_off_and_clear_are_dark_and_at_the_centre_at_once(left: bytes) -> None:
    model = opened()
    model.out(SAMPLES, samples(*[9] * 600), 1.0)
    assert (x(model, 1.00101), colours(model, 1.00101)) == ([9], [1, 2, 3])
    said(model, left, 1.002)  # lasershark.c:50-55, 207-215, 369-371
    assert (x(model, 1.003), colours(model, 1.003)) == ([MID], [0, 0, 0])
    kept = {b"\x80\x00": 600 - 60, b"\x8d\x00": 0}[left]
    assert number(said(model, b"\x8a", 2.0)) == 768 - kept  # Bridge: what is off is not drained
    said(model, b"\x80\x01", 2.0)
    assert x(model, 2.00101) == [9 if kept else MID]


def test_the_ring_takes_packets_of_8_while_9_are_free_and_then_waits_for_64() -> None:
    model = opened()
    said(model, b"\x80\x00")
    assert model.out(SAMPLES, samples(*[9] * 800), 1.0) == 760 * 8  # usbuser.c:200
    assert number(said(model, b"\x8a", 1.0)) == 8
    said(model, b"\x80\x01", 1.0)
    offered = [model.out(SAMPLES, samples(*[9] * 40), 1.0 + played / 30_000) for played in (0, 54.5, 56.5)]
    assert offered == [None, None, 320]  # lasershark.c:353-361
