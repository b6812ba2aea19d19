"""Compresses a finished recording, each block by itself, so that any block can be read alone.

`frames-000000.spb` becomes `frames-000000.spb.zst`; the index stays as it is. A segment is removed only once the
compressed one is on the disk and unpacks to the same bytes.
"""

import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import ProtocolError
from drivers.recorded.segments import (
    PACKED_SUFFIX,
    PackedSegment,
    PlainSegment,
    table_bytes,
    unpack_frame,
    zstandard_or_error,
)
from rig.config.overrides import PathLike
from rig.errors import DamagedRecordingError, RecordingError, UsageError
from rig.progress import tell_stage
from rig.recording.verify import Integrity, examine
from rig.run_folder.disk import new_file, sync_folder
from rig.run_folder.manifest import UNFINISHED

LEVEL: Final = 3
"""Level of zstd, its default: binary frames look like noise to zstd, and higher levels save little more."""


@dataclass(frozen=True, slots=True)
class Compression:
    """Result of a compression: number of segments, and the bytes of all of them, plain and compressed."""

    segments: int
    bytes_before: int
    bytes_after: int


def compress(run: PathLike) -> Compression:
    """Compress a recording with zstd; it can be read like any other (`rig compress`). Needs the extra `compress`.

    Raises UsageError if there is no recording or the package zstandard is missing, DamagedRecordingError if the
    recording is damaged or its run not over, and RecordingError if a segment cannot be written or does not unpack to
    the same bytes. Each segment is then still plain or completely compressed.
    """
    folder = Path(run)
    try:
        zstandard_or_error()
    except ProtocolError as error:
        raise UsageError(str(error)) from None
    found = examine(folder)
    if found.problems or (found.manifest or {}).get("verdict") == UNFINISHED:
        why = found.problems[0] if found.problems else f"its run is not over ({Integrity.UNFINISHED.value})"
        raise DamagedRecordingError(f"{folder} is not compressed as it is: {why}; 'rig repair' it first")
    before = after = 0
    for done, segment in enumerate(found.segments):
        tell_stage("compressing", done, len(found.segments), "segments")
        before += segment.size
        if isinstance(segment, PlainSegment):
            mine = found.entries[found.entries["segment"] == segment.number]
            try:
                _compress(segment, np.sort(mine["offset"]).tolist())
                segment.release()
                segment.path.unlink()
            except OSError as error:
                raise RecordingError(
                    f"cannot compress {segment.path}: {error.strerror or error}; free the space it needs"
                ) from error
        packed = segment.path.with_name(segment.path.name.removesuffix(PACKED_SUFFIX) + PACKED_SUFFIX)
        after += packed.stat().st_size
    return Compression(len(found.segments), before, after)


def _compress(segment: PlainSegment, offsets: list[int]) -> None:
    """Write the compressed segment beside the plain one and check it."""
    packer = zstandard_or_error().ZstdCompressor(level=LEVEL, write_checksum=True)
    packed = segment.path.with_name(segment.path.name + PACKED_SUFFIX)
    scratch = packed.with_name(f"{packed.name}.part")
    sizes: list[tuple[int, int]] = []
    try:
        with new_file(scratch) as file:
            for begin, end in pairwise(sorted({0, *offsets, segment.size})):  # bytes before the first block too
                plain = segment.at(begin, end - begin)
                frame = packer.compress(plain.data)
                if not np.array_equal(unpack_frame(np.frombuffer(frame, np.uint8), len(plain)), plain):
                    raise RecordingError(f"{segment.path}: zstandard does not unpack what it packed; leave it plain")
                file.write(frame)
                sizes.append((len(frame), len(plain)))
            file.write(table_bytes(sizes))
            file.flush()
            os.fsync(file.fileno())
        if PackedSegment(scratch, segment.number).size != segment.size:
            raise RecordingError(f"{scratch} is not as it was written; check the disk")
        scratch.replace(packed)
        sync_folder(packed.parent)
    finally:
        scratch.unlink(missing_ok=True)
