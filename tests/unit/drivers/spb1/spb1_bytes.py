"""SPB1 bytes put together by hand from the wire layout, sharing nothing with the encoder under test."""

import struct
import zlib
from fractions import Fraction

from drivers.frames import BlockFlag, BlockHeader

HEADER_FIELDS: dict[str, tuple[int, str, int | bytes]] = {
    "magic": (0, "4s", b"SPB1"),
    "version": (4, "H", 0x0100),
    "header_len": (6, "H", 96),
    "flags": (8, "I", 0),
    "bits_per_px": (12, "B", 1),
    "payload_type": (13, "B", 0),
    "run_id": (14, "H", 7),
    "block_seq": (16, "Q", 3),
    "first_frame": (24, "Q", 1000),
    "t0_ticks": (32, "Q", 123_456_789),
    "lost_before": (40, "Q", 2),
    "tick_hz": (48, "I", 100_000_000),
    "tick_hz_den": (52, "I", 1),
    "frame_period_ticks": (56, "I", 1000),
    "exposure_ticks": (60, "I", 900),
    "sweep": (64, "I", 70_000),
    "n_frames": (68, "H", 3),
    "frame_step": (70, "H", 1),
    "width": (72, "H", 12),
    "height": (74, "H", 2),
    "sensor_width": (76, "H", 16),
    "sensor_height": (78, "H", 4),
    "payload_len": (80, "I", 96 + 48),
    "pixels_offset": (84, "I", 192),
}
"""Offset in the wire layout, format, and value of the golden block."""
GOLDEN_HEADER = BlockHeader(
    flags=BlockFlag(0),
    run_id=7,
    block_seq=3,
    first_frame=1000,
    t0_ticks=123_456_789,
    lost_before=2,
    tick_hz=Fraction(100_000_000),
    frame_period_ticks=1000,
    exposure_ticks=900,
    sweep=70_000,
    frame_step=1,
    width=12,
    height=2,
    sensor_width=16,
    sensor_height=4,
)


def header_bytes(*, crc: int | None = None, **changed: int | bytes) -> bytes:
    """The 96 bytes of the golden header, some fields changed."""
    raw = bytearray(96)
    for name, (offset, form, value) in HEADER_FIELDS.items():
        struct.pack_into("<" + form, raw, offset, changed.pop(name, value))
    assert not changed
    struct.pack_into("<I", raw, 92, zlib.crc32(raw[:92]) if crc is None else crc)
    return bytes(raw)


RECORDS = (
    struct.pack("<IIHHHH", 0x0000_0008, 0, 64, 1, 0, 4464)  # scan marker; 70 000 = 65 536 + 4 464
    + struct.pack("<IIHHHH", 0x0000_8005, 1000, 64, 1, 1, 4464)  # gate high, line marker half way through the period
    + struct.pack("<IIHHHH", 0x0000_0041, 2000, 0, 1, 2, 4464)  # gate high, window lost
)
PIXELS = bytes.fromhex(
    "8010000000000000" "fff0000000000000"  # frame 0: pixels 0 and 11; all 12
    "4000000000000000" "0000000000000000"  # frame 1: pixel 1
    "0000000000000000" "0020000000000000"  # frame 2: pixel 10 of row 1
)  # fmt: skip
PAYLOAD = RECORDS + bytes(192 - 96 - 48) + PIXELS


def trailer_bytes(
    *,
    magic: bytes = b"SPE1",
    status: int = 0,
    block_seq: int = 3,
    valid: int = len(PAYLOAD),
    payload: bytes = PAYLOAD,
    lost: int = 2,
    checked: bool = True,
) -> bytes:
    """The 32 bytes of a trailer."""
    body = struct.pack("<4sIQIII", magic, status, block_seq, valid, zlib.crc32(payload) if checked else 0, lost)
    return body + struct.pack("<I", zlib.crc32(body))


def golden_block(**changed: int) -> bytes:
    """Block 3 of run 7: frames 1000-1002, 12x2 windows, in a stride of 1024; some fields of its header changed."""
    block = header_bytes(**changed) + PAYLOAD + trailer_bytes(block_seq=changed.get("block_seq", 3))
    return block + bytes(1024 - len(block))
