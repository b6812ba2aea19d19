"""Blocks and index records with false numbers and the right checksums, as a sound file of something else would have."""

import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from drivers.frames import FRAME_RECORD
from drivers.recorded.contents import HEADER_BYTES as INDEX_HEADER_BYTES
from drivers.recorded.contents import INDEX_FILE, INDEX_RECORD
from drivers.spb1.layout import CRC, HEADER, HEADER_BYTES, TRAILER, TRAILER_BYTES

HEADER_FIELDS: Final = [
    "magic", "version", "header_len", "flags", "bits_per_px", "payload_type", "run_id", "block_seq", "first_frame",
    "t0_ticks", "lost_before", "tick_hz", "tick_hz_den", "frame_period_ticks", "exposure_ticks", "sweep", "n_frames",
    "frame_step", "width", "height", "sensor_width", "sensor_height", "payload_len", "pixels_offset", "reserved",
    "header_crc",
]  # fmt: skip
TRAILER_FIELDS: Final = ["magic", "status", "block_seq", "valid_payload_len", "payload_crc", "frames_lost", "crc"]
MOST: Final = {"B": 2**8 - 1, "H": 2**16 - 1, "I": 2**32 - 1, "Q": 2**64 - 1}


def most_of(layout: struct.Struct, fields: list[str], name: str) -> int:
    """The largest number that a field holds."""
    return MOST[layout.format[2:].replace("s", "")[fields.index(name) - 1]]


def forge_header(data: bytearray, at: int, **values: int) -> None:
    """Write other values into the header of the block at `at`, and a `block_seq` into its trailer too."""
    fields = dict(zip(HEADER_FIELDS, HEADER.unpack_from(data, at), strict=True))
    trailer_at = at + fields["header_len"] + fields["payload_len"]
    fields |= values
    HEADER.pack_into(data, at, *fields.values())
    _sign(data, at, HEADER_BYTES)
    if "block_seq" in values:
        forge_trailer(data, trailer_at, block_seq=values["block_seq"])


def forge_trailer(data: bytearray, at: int, **values: int) -> None:
    """Write other values into the trailer at `at`."""
    fields = dict(zip(TRAILER_FIELDS, TRAILER.unpack_from(data, at), strict=True)) | values
    TRAILER.pack_into(data, at, *fields.values())
    _sign(data, at, TRAILER_BYTES)


def forge_payload(data: bytearray, at: int, name: str, frames: slice, value: int) -> None:
    """Write another value into the records of some frames of the block at `at`, and sign its payload anew."""
    fields = dict(zip(HEADER_FIELDS, HEADER.unpack_from(data, at), strict=True))
    np.frombuffer(data, FRAME_RECORD, fields["n_frames"], at + HEADER_BYTES)[name][frames] = value
    end = at + HEADER_BYTES + fields["payload_len"]
    forge_trailer(data, end, payload_crc=zlib.crc32(data[at + HEADER_BYTES : end]))


def forge_index(folder: Path, number: int, name: str, value: int) -> None:
    """Write another value into a record of a recording's index."""
    file = folder / INDEX_FILE
    data = bytearray(file.read_bytes())
    forge_record(data, number, name, value)
    file.write_bytes(data)


def forge_record(data: bytearray, number: int, name: str, value: int) -> None:
    """Write another value into a record of the bytes of an index."""
    records = np.frombuffer(
        data, INDEX_RECORD, (len(data) - INDEX_HEADER_BYTES) // INDEX_RECORD.itemsize, INDEX_HEADER_BYTES
    )
    records[number][name] = value
    _sign(data, INDEX_HEADER_BYTES + number % len(records) * INDEX_RECORD.itemsize, INDEX_RECORD.itemsize)


def _sign(data: bytearray, at: int, size: int) -> None:
    CRC.pack_into(data, at + size - CRC.size, zlib.crc32(data[at : at + size - CRC.size]))
