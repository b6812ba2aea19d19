"""SPB1 under random geometry and random damage: nothing wrong is ever delivered, nothing sound is ever missed."""

import struct
import zlib
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, UnsupportedBlock
from drivers.frames import BlockFlag, BlockHeader, FrameBlock
from drivers.spb1 import ALIGN, BlockLayout, Damage, block_views, frames_per_block, parse_block, seal_block, walk_blocks
from drivers.spb1.layout import HEADER_BYTES, IDLE, TRAILER_BYTES, seal_control
from drivers.spb1.reader import read_control, read_header
from tests.unit.drivers.spb1.spb1_bytes import GOLDEN_HEADER, golden_block

FEW = settings(max_examples=150, deadline=None)


def written_block(layout: BlockLayout, stride: int, seq: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A block of random content, records and pixels alike."""
    memory = rng.integers(0, 256, stride, np.uint8)
    _, bits = block_views(memory, layout)
    packed = np.packbits(rng.random((layout.n_frames, layout.height, layout.width)) < 0.3, axis=2)
    bits[:] = 0
    bits[:, :, : packed.shape[2]] = packed
    header = replace(
        GOLDEN_HEADER,
        flags=BlockFlag.FIRST if seq == 0 else BlockFlag(0),
        block_seq=seq,
        first_frame=seq * 1000,
        t0_ticks=int(rng.integers(0, 2**62)),
        lost_before=int(rng.integers(0, 2**62)),
        tick_hz=Fraction(int(rng.integers(1, 2**32)), int(rng.integers(1, 2**32))),
        sweep=seq,
        width=layout.width,
        height=layout.height,
        sensor_width=65_535,
        sensor_height=layout.height,
    )
    seal_block(memory, header, layout, payload_crc=True)
    return memory


def content(block: FrameBlock) -> tuple[BlockHeader, bytes, bytes]:
    return block.header, block.records.tobytes(), block.bits.tobytes()


def test_a_control_block_of_which_a_part_is_valid_is_checked_whole() -> None:
    memory, end = np.zeros(512, np.uint8), HEADER_BYTES + 10
    seal_control(memory, IDLE, 1, b"0123456789")
    trailer = memory.data[end : end + TRAILER_BYTES]
    struct.pack_into("<I", trailer, 16, 4)  # valid bytes
    struct.pack_into("<I", trailer, TRAILER_BYTES - 4, zlib.crc32(trailer[:-4]))
    assert read_control(memory, read_header(memory)) == b"0123"
    memory[end - 1] ^= 1
    with pytest.raises(CorruptBlock, match="control block: CRC"):
        read_control(memory, read_header(memory))


@FEW
@given(st.integers(0, 40), st.integers(1, 700), st.integers(1, 30), st.integers(0, 3), st.integers(0, 2**32))
def test_any_geometry_reads_back_as_written(n_frames: int, width: int, height: int, spare: int, seed: int) -> None:
    layout = BlockLayout(n_frames, width, height)
    memory = written_block(layout, layout.min_stride + spare * ALIGN, 0, np.random.default_rng(seed))
    records, bits = block_views(memory, layout)
    block = parse_block(memory, check_payload=True)
    assert block.records.tobytes() == records.tobytes()
    assert block.bits.shape == (n_frames, height, layout.row_bytes)
    assert block.bits.tobytes() == bits.tobytes()
    assert not memory[layout.block_bytes :].any()
    assert np.shares_memory(block.bits, memory) or n_frames == 0


@FEW
@given(st.integers(1, 700), st.integers(1, 600), st.integers(1, 5000))
def test_a_stride_is_filled_to_the_last_frame_that_fits(width: int, height: int, kib: int) -> None:
    stride = kib * ALIGN
    try:
        frames = frames_per_block(stride, width, height)
    except ValueError:
        frames = 0
    assert frames == 0 or BlockLayout(frames, width, height).block_bytes <= stride
    assert frames == 65_535 or BlockLayout(frames + 1, width, height).block_bytes > stride


@dataclass(frozen=True)
class Stream:
    """A clean stream and, block by block, where it lies and what it holds."""

    raw: NDArray[np.uint8]
    stride: int
    spans: list[range]
    blocks: dict[int, tuple[BlockHeader, bytes, bytes]]


@st.composite
def streams(draw: st.DrawFn) -> Stream:
    n_blocks = draw(st.integers(2, 8))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    layouts = [
        BlockLayout(draw(st.integers(0, 12)), draw(st.integers(1, 130)), draw(st.integers(1, 24)))
        for _ in range(n_blocks)
    ]
    stride = max(layout.min_stride for layout in layouts) + draw(st.integers(0, 2)) * ALIGN
    parts = [written_block(layout, stride, seq, rng) for seq, layout in enumerate(layouts)]
    spans = [range(seq * stride, seq * stride + layout.block_bytes) for seq, layout in enumerate(layouts)]
    blocks = {seq: content(parse_block(part, check_payload=True)) for seq, part in enumerate(parts)}
    return Stream(np.concatenate(parts), stride, spans, blocks)


def walked(raw: NDArray[np.uint8], stride: int | None) -> tuple[list[FrameBlock], list[Damage]]:
    items = list(walk_blocks(raw, stride, check_payload=True))
    damage = [item for item in items if isinstance(item, Damage)]
    assert all("\n" not in item.reason for item in damage)
    return [item for item in items if isinstance(item, FrameBlock)], damage


def check_only_true_blocks(blocks: list[FrameBlock], stream: Stream) -> set[int]:
    """Every delivered block is one that was written, none comes twice, all in order; the numbers delivered."""
    numbers = [block.header.block_seq for block in blocks]
    assert numbers == sorted(set(numbers))
    for block in blocks:
        assert content(block) == stream.blocks[block.header.block_seq]
    return set(numbers)


@FEW
@given(streams(), st.booleans(), st.data())
def test_flipped_and_zeroed_bytes_cost_just_the_blocks_they_hit(
    stream: Stream, known_stride: bool, data: st.DataObject
) -> None:
    raw = stream.raw.copy()
    for _ in range(data.draw(st.integers(0, 4), "wounds")):
        start = data.draw(st.integers(0, len(raw) - 1), "start")
        if data.draw(st.booleans(), "flip"):
            raw[start] ^= 1 << data.draw(st.integers(0, 7), "bit")
        else:
            raw[start : start + data.draw(st.integers(1, 5000), "length")] = 0
    hit = {
        seq
        for seq, span in enumerate(stream.spans)
        if not np.array_equal(raw[span.start : span.stop], stream.raw[span.start : span.stop])
    }
    blocks, damage = walked(raw, stream.stride if known_stride else None)
    assert check_only_true_blocks(blocks, stream) == set(stream.blocks) - hit
    wholly_zero = {seq for seq in hit if not raw[stream.spans[seq].start : stream.spans[seq].stop].any()}
    assert bool(damage) == bool(hit) or (not known_stride and hit == wholly_zero)


@FEW
@given(streams(), st.booleans(), st.data())
def test_a_piece_lost_or_come_twice_costs_just_the_blocks_it_touches(
    stream: Stream, known_stride: bool, data: st.DataObject
) -> None:
    start = data.draw(st.integers(0, len(stream.raw) // ALIGN - 1), "start") * ALIGN
    stop = min(len(stream.raw), start + data.draw(st.integers(1, 20), "KiB") * ALIGN)
    if data.draw(st.booleans(), "lost"):
        raw = np.concatenate([stream.raw[:start], stream.raw[stop:]])
        touched = {seq for seq, span in enumerate(stream.spans) if span.start < stop and start < span.stop}
    else:
        raw = np.concatenate([stream.raw[:stop], stream.raw[start:stop], stream.raw[stop:]])
        touched = {seq for seq, span in enumerate(stream.spans) if span.start < stop < span.stop}
    blocks, _ = walked(raw, stream.stride if known_stride else None)
    assert check_only_true_blocks(blocks, stream) >= set(stream.blocks) - touched


@FEW
@given(streams(), st.booleans(), st.data())
def test_a_torn_stream_gives_what_was_whole_and_bytes_slipped_in_nothing_wrong(
    stream: Stream, known_stride: bool, data: st.DataObject
) -> None:
    length = data.draw(st.integers(0, len(stream.raw)), "length")
    stride = stream.stride if known_stride else None
    blocks, damage = walked(stream.raw[:length], stride)
    whole = {seq for seq, span in enumerate(stream.spans) if span.stop <= length}
    assert check_only_true_blocks(blocks, stream) == whole
    assert all(item.offset + item.length <= length for item in damage)
    extra = np.frombuffer(data.draw(st.binary(max_size=9)), np.uint8)
    blocks, _ = walked(np.concatenate([stream.raw[:length], extra, stream.raw[length + 3 :]]), stride)
    check_only_true_blocks(blocks, stream)


def test_damage_says_where_and_why() -> None:
    hurt = bytearray(golden_block())
    hurt[200] ^= 1
    raw = golden_block(block_seq=2) + hurt + golden_block(block_seq=4) + bytes(2048) + golden_block(block_seq=5)
    blocks, damage = walked(np.frombuffer(raw, np.uint8), 1024)
    assert [block.header.block_seq for block in blocks] == [2, 4, 5]
    assert [(item.offset, item.length, item.reason.split(":")[0]) for item in damage] == [
        (1024, 1024, "payload of block 3"),
        (3072, 2048, "no block"),
    ]
    blocks, damage = walked(np.frombuffer(raw, np.uint8), None)  # zeros are padding then
    assert [block.header.block_seq for block in blocks] == [2, 4, 5]
    assert [(item.offset, item.length) for item in damage] == [(1024, 1024)]
    torn = np.frombuffer(golden_block(payload_type=0x7F, tick_hz=0)[:200], np.uint8)
    assert "control block cut off: 200 of " in walked(torn, None)[1][0].reason


def test_a_block_that_comes_twice_is_delivered_once() -> None:
    raw = golden_block() * 2 + golden_block(block_seq=2) + golden_block(block_seq=4)
    blocks, damage = walked(np.frombuffer(raw, np.uint8), 1024)
    assert [block.header.block_seq for block in blocks] == [3, 4]
    assert [item.offset for item in damage] == [1024, 2048]
    assert damage[0].reason == "block 3 of run 7 comes after block 3"


@pytest.mark.parametrize(
    ("between", "numbers"),
    [
        ({"run_id": 8, "block_seq": 0}, [(7, 3), (8, 0), (7, 4)]),  # another run counts its blocks anew
        ({"payload_type": 0x7E, "tick_hz": 0}, [(7, 3), (7, 4)]),  # control blocks are passed over
        ({"payload_type": 0x7F, "tick_hz": 0}, [(7, 3), (7, 4)]),
    ],
)
def test_a_block_of_another_run_and_control_blocks_are_no_damage(
    between: dict[str, int], numbers: list[tuple[int, int]]
) -> None:
    raw = golden_block() + golden_block(**between) + golden_block(block_seq=4)
    blocks, damage = walked(np.frombuffer(raw, np.uint8), 1024)
    assert [(block.header.run_id, block.header.block_seq) for block in blocks] == numbers
    assert damage == []


@pytest.mark.parametrize(
    "fields", [{"version": 0x0200}, {"version": 0x0200, "payload_type": 0x7F}, {"payload_type": 1}]
)
def test_a_stream_of_another_sort_or_with_a_bad_stride_is_refused(fields: dict[str, int]) -> None:
    raw = np.frombuffer(golden_block() + golden_block(**fields), np.uint8)
    with pytest.raises(UnsupportedBlock):
        walked(raw, 1024)
    with pytest.raises(ValueError, match="stride -1024"):
        walked(raw, -1024)


def test_a_payload_that_holds_a_block_is_no_place_to_start_from_while_the_outer_block_is_sound() -> None:
    layout = BlockLayout(1, 512, 64)
    memory = np.zeros(layout.min_stride, np.uint8)
    inner = np.frombuffer(golden_block(), np.uint8)
    _, bits = block_views(memory, layout)
    bits.reshape(-1)[1024 - layout.pixels_offset :][:1024] = inner
    header = replace(GOLDEN_HEADER, width=512, height=64, sensor_width=512, sensor_height=64)
    seal_block(memory, header, layout, payload_crc=True)
    blocks, damage = walked(memory, None)
    assert [block.header for block in blocks] == [header]
    assert damage == []
