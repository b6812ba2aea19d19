"""SPB1 bytes put together by hand from the wire layout, sharing nothing with the encoder under test."""

import struct
import zlib


def header_bytes(
    *,
    magic: bytes = b"SPB1",
    version: int = 0x0100,
    header_len: int = 96,
    flags: int = 0,
    bits_per_px: int = 1,
    payload_type: int = 0,
    run_id: int = 7,
    block_seq: int = 3,
    first_frame: int = 1000,
    t0_ticks: int = 123_456_789,
    lost_before: int = 2,
    tick_hz: int = 100_000_000,
    tick_hz_den: int = 1,
    frame_period_ticks: int = 1000,
    exposure_ticks: int = 900,
    sweep: int = 70_000,
    n_frames: int = 3,
    frame_step: int = 1,
    width: int = 12,
    height: int = 2,
    sensor_width: int = 16,
    sensor_height: int = 4,
    payload_len: int = 96 + 48,
    pixels_offset: int = 192,
    crc: int | None = None,
) -> bytes:
    """The 96 bytes of a header, field by field at the offsets of the wire layout."""
    raw = bytearray(96)
    raw[0:4] = magic
    struct.pack_into("<H", raw, 4, version)
    struct.pack_into("<H", raw, 6, header_len)
    struct.pack_into("<I", raw, 8, flags)
    raw[12] = bits_per_px
    raw[13] = payload_type
    struct.pack_into("<H", raw, 14, run_id)
    struct.pack_into("<Q", raw, 16, block_seq)
    struct.pack_into("<Q", raw, 24, first_frame)
    struct.pack_into("<Q", raw, 32, t0_ticks)
    struct.pack_into("<Q", raw, 40, lost_before)
    struct.pack_into("<I", raw, 48, tick_hz)
    struct.pack_into("<I", raw, 52, tick_hz_den)
    struct.pack_into("<I", raw, 56, frame_period_ticks)
    struct.pack_into("<I", raw, 60, exposure_ticks)
    struct.pack_into("<I", raw, 64, sweep)
    struct.pack_into("<H", raw, 68, n_frames)
    struct.pack_into("<H", raw, 70, frame_step)
    struct.pack_into("<H", raw, 72, width)
    struct.pack_into("<H", raw, 74, height)
    struct.pack_into("<H", raw, 76, sensor_width)
    struct.pack_into("<H", raw, 78, sensor_height)
    struct.pack_into("<I", raw, 80, payload_len)
    struct.pack_into("<I", raw, 84, pixels_offset)
    struct.pack_into("<I", raw, 88, 0)
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


def golden_block() -> bytes:
    """Block 3 of run 7: frames 1000-1002, 12x2 windows, in a stride of 1024."""
    block = header_bytes() + PAYLOAD + trailer_bytes()
    return block + bytes(1024 - len(block))
