"""SPB1 against bytes made by hand from the wire layout: reading, writing, refusing."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import BlockFlag, Mark
from drivers.spb1 import BlockLayout, block_parts, block_views, frames_per_block, parse_block, seal_block
from tests.unit.drivers.spb1.spb1_bytes import (
    GOLDEN_HEADER,
    PAYLOAD,
    PIXELS,
    RECORDS,
    golden_block,
    header_bytes,
    trailer_bytes,
)


def array(raw: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(raw, np.uint8)


def test_a_block_made_by_hand_is_read_field_by_field_where_it_lies() -> None:
    memory = array(golden_block())
    block = parse_block(memory, check_payload=True)
    assert np.shares_memory(block.bits, memory)
    assert np.shares_memory(block.records, memory)
    assert block.header == GOLDEN_HEADER
    assert block.status == 0
    assert block.frame_numbers.tolist() == [1000, 1001, 1002]
    assert block.start_ticks.tolist() == [123_456_789, 123_457_789, 123_458_789]
    assert block.records["x0"].tolist() == [64, 64, 0]
    assert block.records["line"].tolist() == [0, 1, 2]
    assert block.records["marks"][1] == Mark.GATE_HIGH | Mark.LINE | 0x80 << 8
    pixels = np.unpackbits(block.bits, axis=2)[:, :, :12]
    assert np.argwhere(pixels[0, :1]).tolist() == [[0, 0], [0, 11]]
    assert pixels[0, 1].all()
    assert np.argwhere(pixels[1:]).tolist() == [[0, 0, 1], [1, 1, 10]]


def test_a_sealed_block_and_one_in_parts_have_the_very_bytes_made_by_hand() -> None:
    memory = np.full(1024, 0xAA, np.uint8)
    layout = BlockLayout(3, 12, 2)
    records, bits = block_views(memory, layout)
    records.view(np.uint8)[:] = array(RECORDS)
    bits.reshape(-1)[:] = array(PIXELS)
    block = seal_block(memory, GOLDEN_HEADER, layout, payload_crc=True)
    assert memory.tobytes() == golden_block()
    assert np.shares_memory(block.bits, memory)
    assert block.header is GOLDEN_HEADER
    parts = block_parts(block)  # as for a file, without a copy of the pixels
    assert b"".join(parts) == golden_block()
    assert np.shares_memory(np.frombuffer(parts[3], np.uint8), memory)


def test_a_block_in_parts_that_lies_anywhere_and_holds_nothing_is_written_too() -> None:
    block = parse_block(array(golden_block()), check_payload=True)
    elsewhere = replace(block, records=block.records[::2].copy(), bits=block.bits[::2])
    again = parse_block(array(b"".join(block_parts(elsewhere))), check_payload=True)
    np.testing.assert_array_equal(again.bits, block.bits[::2])
    np.testing.assert_array_equal(again.records, block.records[::2])
    empty = replace(block, records=block.records[:0], bits=block.bits[:0])
    assert parse_block(array(b"".join(block_parts(empty))), check_payload=True).n_frames == 0


def test_a_payload_crc_that_was_not_computed_or_not_asked_for_is_not_checked() -> None:
    memory = array(golden_block()).copy()
    seal_block(memory, GOLDEN_HEADER, BlockLayout(3, 12, 2), payload_crc=False)
    assert memory[240:272].tobytes() == trailer_bytes(checked=False)
    memory[200] ^= 1
    parse_block(memory, check_payload=True)
    hurt = array(header_bytes() + PAYLOAD[:-1] + b"\1" + trailer_bytes())
    assert parse_block(hurt, check_payload=False).bits[-1, -1, -1] == 1


@pytest.mark.parametrize(
    ("layout", "sizes", "stride"),
    [
        (BlockLayout(31, 512, 512), (640, 1_016_480, 1_016_832), 2**20),  # those of the layout document
        (BlockLayout(32, 512, 512), (640, 1_049_248, 1_049_600), 1_049_600),
        (BlockLayout(2, 12, 54), (128, 1024, 1024), 1024),  # what ends on its boundary is not padded
    ],
)
def test_a_layout_has_its_sizes_and_fills_a_stride(
    layout: BlockLayout, sizes: tuple[int, int, int], stride: int
) -> None:
    assert (layout.pixels_offset, layout.block_bytes, layout.min_stride) == sizes
    assert frames_per_block(stride, layout.width, layout.height) == layout.n_frames


def test_a_stride_that_holds_nothing_and_a_buffer_too_short_are_refused() -> None:
    with pytest.raises(ValueError, match="buffer of 271 bytes for a block of 272"):
        block_views(np.zeros(271, np.uint8), BlockLayout(3, 12, 2))
    with pytest.raises(ValueError, match=r"holds no frame of 512x512; use at least 33792 bytes"):
        frames_per_block(32 * 1024, 512, 512)
    with pytest.raises(ValueError, match=r"1000 is no positive multiple of 1024"):
        frames_per_block(1000, 8, 8)


def test_blocks_with_the_least_significant_bit_first_are_turned_round() -> None:
    turned = np.packbits(np.unpackbits(array(PIXELS)).reshape(-1, 8)[:, ::-1]).tobytes()
    payload = PAYLOAD[: -len(PIXELS)] + turned
    block = parse_block(
        array(header_bytes(flags=1 << 5) + payload + trailer_bytes(payload=payload)), check_payload=True
    )
    assert block.bits.tobytes() == PIXELS
    assert block.header == GOLDEN_HEADER


def test_a_longer_header_is_skipped_over() -> None:
    # 32 bytes of a later minor version between header and records; the records then end at 176
    raw = header_bytes(version=0x0103, header_len=128, payload_len=64 + 48)
    payload = RECORDS + bytes(16) + PIXELS
    raw += bytes(32) + payload + trailer_bytes(payload=payload, valid=len(payload))
    block = parse_block(array(raw), check_payload=True)
    assert block.records.tobytes() == RECORDS
    assert block.bits.tobytes() == PIXELS


def test_of_a_truncated_block_the_whole_frames_are_delivered_and_one_without_frames_ends_a_run() -> None:
    valid = 96 + 16 + 16 + 15  # padding included: two frames of 16 bytes and all but one byte of the third
    raw = header_bytes() + PAYLOAD + trailer_bytes(status=1, valid=valid)
    block = parse_block(array(raw), check_payload=True)
    assert (block.n_frames, block.bits.shape, block.status) == (2, (2, 2, 8), 1)
    assert block.frame_numbers.tolist() == [1000, 1001]
    raw = header_bytes(flags=2, n_frames=0, payload_len=32, pixels_offset=128) + bytes(32)
    raw += trailer_bytes(status=3, valid=32, payload=bytes(32))
    block = parse_block(array(raw), check_payload=True)
    assert (block.n_frames, block.status, block.header.flags) == (0, 3, BlockFlag.LAST)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("version", 0x0200, "version 2.0"),
        *(("payload_type", sort, said) for sort, said in ((1, "sparse"), (5, "payload type 5"), (0x7F, "heartbeat"))),
        ("bits_per_px", 8, "8 bits per pixel"),
        ("frame_step", 4, "every 4th frame"),
    ],
)
def test_a_sound_block_of_another_sort_is_refused_in_one_line(field: str, value: int, message: str) -> None:
    raw = header_bytes(**{field: value}) + PAYLOAD + trailer_bytes()
    with pytest.raises(UnsupportedBlock, match=message) as refused:
        parse_block(array(raw), check_payload=True)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (golden_block()[:95], "too few"),
        (bytes(1024), "no block"),
        (header_bytes(crc=1) + PAYLOAD + trailer_bytes(), "header: CRC"),
        (header_bytes(magic=b"SPB2") + PAYLOAD + trailer_bytes(), "no block"),
        (golden_block()[:271], "cut off, 271 of 272"),
        (header_bytes(width=17) + PAYLOAD + trailer_bytes(), "17x2 on a sensor of 16x4"),
        *((header_bytes(**{den: 0}) + PAYLOAD + trailer_bytes(), "0 Hz") for den in ("tick_hz", "tick_hz_den")),
        (header_bytes(t0_ticks=2**63) + PAYLOAD + trailer_bytes(), "63 bits"),
        *(
            (header_bytes(**{field: value}) + PAYLOAD + trailer_bytes(), "contradict")
            for field, value in (("n_frames", 4), ("pixels_offset", 200), ("header_len", 64), ("payload_len", 150))
        ),
        (header_bytes() + PAYLOAD + trailer_bytes(block_seq=4), "trailer of block 4"),
        (header_bytes() + PAYLOAD + trailer_bytes(magic=b"SPE2"), "no trailer"),
        (header_bytes() + PAYLOAD + trailer_bytes()[:-1] + b"\0", "trailer of block 3: CRC"),
        (header_bytes() + PAYLOAD + trailer_bytes(valid=145), "145 valid bytes"),
        (header_bytes() + PAYLOAD[:-1] + b"\1" + trailer_bytes(), "payload of block 3: CRC"),
    ],
)
def test_a_damaged_block_is_refused_and_says_what_is_wrong(raw: bytes, message: str) -> None:
    with pytest.raises(CorruptBlock, match=message) as refused:
        parse_block(array(raw), check_payload=True)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"width": 13}, "13x2 window for a layout of 12x2"),
        ({"sensor_width": 11}, "sensor of 11x4"),
        ({"frame_step": 2}, "every frame only"),
        ({"bits_per_px": 8}, "1 bit per pixel"),
        ({"flags": BlockFlag.LSB_FIRST}, "most significant bit first"),
        ({"run_id": 65_536}, "does not fit"),
        ({"tick_hz": Fraction(2**33)}, "does not fit"),
    ],
)
def test_what_spb1_cannot_say_is_not_written(changed: dict[str, Any], message: str) -> None:
    header = replace(GOLDEN_HEADER, **changed)
    with pytest.raises(ValueError, match=message):
        seal_block(np.zeros(1024, np.uint8), header, BlockLayout(3, 12, 2), payload_crc=True)
