"""The model of the Helios firmware alone, bytes in and bytes out, against the vendor's firmware and SDK. No driver.

Sources: `Grix/helios_dac` 0952a2a, with firmware v6 (main.c, main.h, conf_usb.h; ud*.c in its ASF) and SDK v11.
"""

import struct

import numpy as np
import pytest

from sim_backend.wire.firmware.helios import BUS_BYTES_PER_S, COMMANDS, FRAMES, REPLIES, SEAM_S, HeliosModel

START, SINGLE, TICK_S = 1, 2, 5601 / 112e6
"""Flags of a frame (HeliosDac.h:121-127), and a point at 20 000 points per second (main.c:310)."""


def board() -> HeliosModel:
    """A board whose setting 1 has just been chosen (HeliosDac.cpp:232)."""
    model = HeliosModel()
    model.set_interface(0, 1, 0.0)
    return model


def said(model: HeliosModel, sent: bytes, at_s: float = 0.0) -> object:
    assert model.out(COMMANDS, sent, at_s) == len(sent)
    return model.inp(REPLIES, 32, at_s)


def frame(*x: int, flags: int, pps: int = 20_000, n: int | None = None) -> bytes:
    """Points at y = 0x123 with colours 1, 2, 3, 4 (HeliosDac.cpp:944-958)."""
    points = b"".join(bytes((one >> 4, (one & 0xF) << 4 | 0x1, 0x23, 1, 2, 3, 4)) for one in x)
    return points + struct.pack("<HHB", pps, len(x) if n is None else n, flags)


def send(model: HeliosModel, data: bytes, at_s: float, *, taken: bool = True) -> float:
    """Offer a transfer; time at which it has arrived, if the endpoint takes it."""
    arrives_s = at_s + len(data) / BUS_BYTES_PER_S
    offered = [model.out(FRAMES, data, now_s) for now_s in (at_s, arrives_s)]
    assert offered == [None, len(data) if taken else None]
    return arrives_s


def x(model: HeliosModel, *at_s: float) -> list[int]:
    model.advance(max(at_s))
    return [round(each) for each in (model.history.command(np.array(at_s)) + 1) / 2 * 4095]


def colours(model: HeliosModel, at_s: float) -> list[int]:
    return [int(model.history.level(line, np.array([at_s]))[0]) for line in range(4)]


def test_its_descriptors_are_those_of_the_firmware() -> None:
    spec = HeliosModel().spec
    assert (spec.vendor, spec.product, spec.release) == (0x1209, 0xE500, 0x0200)  # conf_usb.h:58-61
    assert spec.strings == ("Gitle Mikkelsen", "Helios Laser DAC")  # conf_usb.h:67-69: no serial number
    ends = [[(end.address, end.kind, end.packet_bytes) for end in one.endpoints] for one in spec.alternates]
    interrupt, bulk = [(0x83, "interrupt", 32), (0x06, "interrupt", 32)], [(0x81, "bulk", 64), (0x02, "bulk", 64)]
    assert ends == [[], interrupt + bulk]  # udi_vendor.h:220-241, udi_vendor_conf.h:64-68, conf_usb.h:143-144


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        (b"\x04\x00", b"\x84\x06\x00\x00\x00"),  # main.c:189-197
        (b"\x05\x00", b"\x85Helios 1" + bytes(23)),  # main.c:198-213: always 32 bytes
        (b"\x03\x00", b"\x83\x01"),  # main.c:178-188
        *((sent, None) for sent in (b"\x07\x0b", b"\x02\x01", b"\x01\x00", b"\x08\x00")),  # main.c:170-177, 225-235
    ],
)
def test_it_answers_what_the_sdk_sends(sent: bytes, answered: bytes | None) -> None:
    assert said(board(), sent) == answered


def test_one_reply_waits_a_name_needs_no_zero_the_shutter_stays_open_and_de_blanks_and_leaves_the_bus() -> None:
    model, name = board(), bytes(range(65, 96))
    model.out(COMMANDS, b"\x06" + name, 0.0)
    model.out(COMMANDS, b"\x05\x00", 0.0)
    assert said(model, b"\x04\x00") == b"\x85" + name  # main.c:216-221; udp_device.c:869-872: a job is under way
    assert said(model, b"\x02\xff") is None  # main.c:176: any value but 0 opens
    send(model, frame(9, flags=0), 1.0)
    said(model, b"\xde\x00", 1.1)
    assert (model.gone, model.shutter, colours(model, 1.1), x(model, 1.1)) == (True, True, [0] * 4, [9])  # main.c:229


@pytest.mark.parametrize(("pps", "cycles"), [(0, 16_000_001), (7, 16_000_001), (40_001, 2800), (65_535, 1710)])
def test_a_frame_begins_a_point_late_and_a_single_one_is_dark_after_its_end(pps: int, cycles: int) -> None:
    model, tick_s = board(), cycles / 112e6  # main.c:305-310, main.h:27-28
    at = send(model, frame(0xABC, 1, flags=SINGLE, pps=pps), 0.0)  # main.c:65-107: the first tick brings a point
    assert x(model, *(at + np.array([0.999, 1.001, 2.001, 9]) * tick_s)) == [0x800, 0xABC, 1, 1]
    lit = [colours(model, at + n * tick_s) for n in (0.999, 1.001, 2.999, 3.001)]
    assert lit == [[0] * 4, [1, 2, 3, 4], [1, 2, 3, 4], [0] * 4]  # main.c:251-254, 259-268
    assert HeliosModel(axis="y")._decode(frame(0xABC, flags=0)[:-5], 7, 0).x[0] == 0x123 / 4095 * 2 - 1  # main.c:247


def test_a_frame_repeats_for_ever_until_one_that_waits_follows_with_a_longer_first_point() -> None:
    model = board()
    at = send(model, frame(1, 2, flags=0), 0.0)
    assert x(model, at + 2002.5 * TICK_S) == [2]  # main.c:88-94
    send(model, frame(3, 4, flags=SINGLE), at + 2002.6 * TICK_S)
    seam_s = at + 2004 * TICK_S
    assert x(model, seam_s + 0.9 * SEAM_S, seam_s + 1.1 * SEAM_S) == [3, 4]  # main.c:80-82
    assert not model.moving(seam_s + TICK_S + 1.1 * SEAM_S)


def test_one_frame_waits_and_the_endpoint_takes_no_other_until_it_begins() -> None:
    model, long = board(), frame(*[1] * 100, flags=SINGLE)
    at = send(model, long, 0.0)
    send(model, long, at)
    assert said(model, b"\x03\x00", at + 1e-3) == b"\x83\x00"  # main.c:150-151, 181
    send(model, long, at + 2e-3, taken=False)
    send(model, frame(7, flags=START | SINGLE), at + 101.5 * TICK_S)  # main.c:84
    assert x(model, at + 103.6 * TICK_S) == [7]  # main.c:135-146


@pytest.mark.parametrize("wrong", [frame(1, 2, flags=0, n=3), frame(1, flags=0) + b"\0", b"\0"])
def test_a_frame_of_another_length_is_dropped_and_the_endpoint_asleep_until_03(wrong: bytes) -> None:
    model, sound = board(), frame(1, flags=0)
    send(model, wrong, 0.0)
    send(model, sound, 0.1, taken=False)  # main.c:123-128
    said(model, b"\x03\x00", 0.2)  # main.c:183
    send(model, sound, 0.3)
    assert (model.refused, model.played) == (1, 1)


@pytest.mark.parametrize("by_setting", [False, True])
def test_a_stop_blanks_at_once_takes_no_frame_for_100_ms_and_centres_then(by_setting: bool) -> None:
    model = board()
    send(model, frame(9, flags=0), 0.0)
    for now_s in (1.0, 1.05):  # main.c:274: the second one starts the timer anew
        if by_setting:  # setting 1 is left for itself: udc.c:906-927, udi_vendor.c:116-121, main.c:328-335
            model.set_interface(0, 1, now_s)
        else:
            said(model, b"\x01\x00", now_s)
        assert (colours(model, now_s), x(model, now_s + 0.049)) == ([0] * 4, [9])  # main.c:259-268
    send(model, frame(5, flags=0), 1.1)
    assert (x(model, 1.149, 1.151), model.refused) == ([9, 0x800], 1)  # main.c:123, 278-292
    send(model, frame(5, flags=0), 1.2)  # main.c:296-297: ready again without 03
    assert x(model, 1.3) == [5]


@pytest.mark.parametrize(("points", "played"), [(44, 1), (45, 0), (46, 1), (109, 0), (173, 0)])
def test_a_transfer_of_whole_packets_hangs_until_another_setting_is_chosen(points: int, played: int) -> None:
    model = board()
    send(model, frame(*[1] * points, flags=SINGLE), 0.0)
    assert model.played == played  # issue 6
    model.set_interface(0, 0, 1.0)  # udp_device.c:768-776
    model.set_interface(0, 1, 2.0)
    send(model, frame(5, flags=0), 2.0)
    assert x(model, 2.1) == [5]
