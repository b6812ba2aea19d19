"""Writes a recording: segments (files of SPB1 blocks) and their index, usable however the program ends.

A block counts once the system has all its bytes and those of every block before it; then its index record is written.
So a killed program loses no block that counted. Unless syncs are slow, a loss of power loses at most blocks younger
than `SYNC_INTERVAL_S`, since a thread syncs the files to the disk, blocks before index.

`Recording` does this. `Recorder` is the pipeline's thread that passes the blocks of one start of the SPAD to the
recording. The recording's threads write several blocks at a time, straight from the slots of the ring (`drivers.ring`).
The recorder is a required reader: if the disk is slower than the stream, the ring fills and its `on_full` decides.
"""

import errno
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from drivers.frames import FrameBlock
from drivers.recorded.contents import HEADER_BYTES, INDEX_FILE, RECORD_BYTES, index_header, index_of, segment_name
from drivers.ring import BlockRing, RingReader
from drivers.spb1 import BlockLayout
from rig.errors import RecordingError
from rig.recording.check import FRAMES_SEAL, sealed
from rig.recording.segment import OpenSegment, Staging, paged
from rig.run_folder.disk import CLAIM_FILE, hold, sync_folder
from rig.threads import StageThread

SEGMENT_BYTES: Final = 1 << 30
"""Most bytes of a segment, unless a single block is larger."""
SYNC_INTERVAL_S: Final = 0.2
"""Seconds after which a recorded block survives a loss of power, if a sync takes at most a quarter of this time."""
_SYNC_EVERY_S: Final = SYNC_INTERVAL_S / 2
"""Seconds from the end of one sync to the next: a block may have to wait for the sync under way and for the next."""
WRITERS: Final = 4
"""Number of blocks written at a time: a thread computes checksums at some 4 GB/s, and disks are faster with a queue."""
RESERVE_FILE: Final = CLAIM_FILE
RESERVE_BYTES: Final = 1 << 20
"""Bytes reserved beside the recording, so that manifest and summary have room if the recording fills the disk."""


@dataclass(slots=True, eq=False)
class _Placed:
    """A block that is not indexed yet. end: offset of its end in its segment. payload_crc: None until it is written."""

    segment: OpenSegment
    end: int
    index_record: bytes
    payload_crc: int | None = None


class Recording:
    """A recording that grows block by block in a folder; whatever fails, it ends after a whole block.

    Only one thread may submit and append. expected_bytes: room to set aside in all; None: `segment_bytes` per segment.
    on_begin: called by `begin`. on_sync: called after every sync, on the thread that syncs, and by `close`.
    Raises RecordingError if the folder cannot be written or has an index already.
    """

    def __init__(
        self,
        folder: Path,
        *,
        expected_bytes: int | None = None,
        segment_bytes: int = SEGMENT_BYTES,
        on_begin: Callable[[], None] | None = None,
        on_sync: Callable[[], None] | None = None,
    ) -> None:
        self.folder = folder
        self.keep_blocks = 0
        self.blocks = 0
        """Number of blocks that are written and count."""
        self.bytes = 0
        """Bytes that these blocks take in the segments, with padding."""
        self._seal = sealed([])
        self.busy_s = 0.0
        """Time for checksums and writing, summed over the writers."""
        self.files: list[str] = []
        self.starts: list[dict[str, int]] = []
        """For each start of the SPAD, the planned number of `sweeps` and the number of its first `segment`."""
        self.longest_unsynced_s = 0.0
        """Longest time from one sync's beginning to the next one's end."""
        self._expected_bytes = expected_bytes
        self._segment_bytes = segment_bytes
        self._on_begin = on_begin
        self._on_sync = on_sync
        self._segment: OpenSegment | None = None
        self._segment_is_for: tuple[int, int] | None = None
        self._open: list[OpenSegment] = []
        self._order: deque[_Placed] = deque()
        self._lock = threading.Lock()
        self._failure: BaseException | None = None
        self._staging = Staging()
        self._closed = threading.Event()
        self._reserve = folder / RESERVE_FILE
        try:
            self._reserve.write_bytes(bytes(RESERVE_BYTES))
            self._index = (folder / INDEX_FILE).open("xb", buffering=0)
            hold(self._index.fileno())
            self._index.write(index_header())
            sync_folder(folder)
        except OSError as error:
            if index := getattr(self, "_index", None):
                index.close()  # Windows removes no open file
            self._reserve.unlink(missing_ok=True)
            raise self._failed(error) from error
        self._pool = ThreadPoolExecutor(WRITERS, "recording writer")
        self._last_sync = time.monotonic()
        self._indexed_at_sync = 0
        self._syncing = threading.Thread(target=self._sync_on, name="recording sync", daemon=True)
        self._syncing.start()

    def begin(self, sweeps: int) -> None:
        """Begin a start of the SPAD that is to give `sweeps` sweeps. Its blocks come next, in segments of their own."""
        self.starts.append({"sweeps": sweeps, "segment": len(self.files)})
        with self._lock:
            self._segment = None
        if self._on_begin is not None:
            self._on_begin()

    def append(self, block: FrameBlock) -> None:
        """Write a block after the others and wait until it counts. Raises RecordingError as `submit` does."""
        self.submit(block).result()

    def submit(self, block: FrameBlock) -> "Future[None]":
        """Begin to write a block after the others. The block's memory must not change until the future is done.

        The future, or this call, raises RecordingError if a block could not be written; from that block on none counts.
        """
        header = block.header
        size = paged(BlockLayout(block.n_frames, header.width, header.height).block_bytes)
        with self._lock:
            if self._failure is not None:
                raise self._failed(self._failure) from self._failure
        segment = self._segment_for(size, (header.run_id, header.width))
        offset = segment.place(size)
        placed = _Placed(segment, offset + size, index_of(block, segment.number, offset))
        with self._lock:
            self._order.append(placed)
        return self._pool.submit(self._write, block, placed, offset)

    def holds(self, ring: BlockRing) -> int:
        """Number of blocks of the ring that `write_from` holds at a time."""
        return max(1, min(WRITERS, ring.slots // 4))

    def write_from(self, reader: RingReader) -> None:
        """Write all blocks of one start of the SPAD; returns once the last one counts. Raises RecordingError."""
        under_way: deque[Future[None]] = deque()
        try:
            while (block := next_block(reader)) is not None:
                under_way.append(self.submit(block))
                while len(under_way) >= reader.holds:  # `next` gives the oldest slot back
                    under_way.popleft().result()
            while under_way:
                under_way.popleft().result()
        finally:
            for each in under_way:
                each.exception()  # slots go back only once nobody reads them

    def close(self) -> None:
        """Wait until everything is written, end the files and sync them. Raises RecordingError if that fails.

        A second call does nothing."""
        if self._closed.is_set():
            return
        self._pool.shutdown()
        self._closed.set()
        self._syncing.join()
        try:
            for segment in self._open:
                segment.close()
            self._index.truncate(HEADER_BYTES + self.blocks * RECORD_BYTES)
            os.fsync(self._index.fileno())
            sync_folder(self.folder)
            if self._on_sync is not None:
                self._on_sync()
        except OSError as error:
            raise self._failed(error) from error
        finally:
            self._open.clear()
            self._index.close()
            self._reserve.unlink(missing_ok=True)
            self.files = [name for name in self.files if (self.folder / name).exists()]

    def content(self) -> dict[str, object]:
        """The recording as plain values for the manifest."""
        return {
            "files": list(self.files),
            "index": INDEX_FILE,
            "blocks": self.blocks,
            "bytes": self.bytes,
            FRAMES_SEAL: self._seal,
            "sync_interval_s": SYNC_INTERVAL_S,
            "longest_unsynced_s": self.longest_unsynced_s,
            "failed": None if self._failure is None else _reason(self._failure),
            "starts": list(self.starts),
        }

    def _segment_for(self, size: int, is_for: tuple[int, int]) -> OpenSegment:
        """The segment for a block: a new one after `begin`, for another run id or width, or if the old one is full."""
        segment = self._segment
        fits = segment is not None and (segment.placed == 0 or segment.placed + size <= self._segment_bytes)
        if segment is not None and fits and self._segment_is_for == is_for:
            return segment
        reserve = self._segment_bytes
        if self._expected_bytes is not None:
            reserve = min(reserve, max(0, self._expected_bytes - self.bytes))
        name = segment_name(len(self.files))
        try:
            segment = OpenSegment(self.folder, len(self.files), name, reserve)
            sync_folder(self.folder)
        except OSError as error:
            raise self._failed(error) from error
        with self._lock:
            self.files.append(name)
            self._open.append(segment)
            self._segment, self._segment_is_for = segment, is_for
        return segment

    def _write(self, block: FrameBlock, placed: _Placed, offset: int) -> None:
        """Write one block, on a thread of the pool."""
        begun = time.perf_counter()
        try:
            placed.payload_crc = placed.segment.write(block, offset, self._staging)
            self._count(placed)
        except BaseException as error:
            with self._lock:
                self._failure = self._failure or error
            if isinstance(error, OSError):
                raise self._failed(error) from error
            raise
        finally:
            with self._lock:
                self.busy_s += time.perf_counter() - begun

    def _count(self, placed: _Placed) -> None:
        """Note that a block is written, and index all written blocks before the first one that is not written yet."""
        with self._lock:
            while self._order and (crc := self._order[0].payload_crc) is not None:
                first = self._order[0]
                self._index.seek(HEADER_BYTES + self.blocks * RECORD_BYTES)  # a record may have been cut short before
                if self._index.write(first.index_record) != RECORD_BYTES:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                self._order.popleft()
                self.bytes += first.end - first.segment.end
                first.segment.end = first.end
                self.blocks += 1
                self._seal = sealed([crc], self._seal)

    def _sync_on(self) -> None:
        """Sync at intervals until the recording is closed or a sync fails; runs as a thread."""
        while not self._closed.wait(_SYNC_EVERY_S):
            try:
                self._sync()
            except OSError as error:
                with self._lock:
                    self._failure = self._failure or error
                return

    def _sync(self) -> None:
        begun = time.monotonic()
        with self._lock:
            segments = list(self._open)
            full = [segment for segment in segments if segment is not self._segment and segment.complete]
            blocks = self.blocks
        for segment in segments:
            if segment in full:
                segment.close()
                with self._lock:
                    self._open.remove(segment)
            else:
                segment.sync()
        if blocks != self._indexed_at_sync:
            os.fsync(self._index.fileno())
            self._indexed_at_sync = blocks
        if self._on_sync is not None:
            self._on_sync()
        self.longest_unsynced_s = max(self.longest_unsynced_s, time.monotonic() - self._last_sync)
        self._last_sync = begun

    def _failed(self, error: BaseException) -> RecordingError:
        self._reserve.unlink(missing_ok=True)
        name = self.files[-1] if self.files else segment_name(0)
        return RecordingError(
            f"cannot write the recording {name} beyond {self.bytes / 1e6:.0f} MB: {_reason(error)}; "
            "free the space it needs or name a folder on another disk as `out`"
        )


class WritesBlocks(Protocol):
    """A recording, as far as the pipeline of a scan uses it."""

    @property
    def blocks(self) -> int:
        """Number of blocks that are written and count."""
        ...

    @property
    def bytes(self) -> int:
        """Bytes of the blocks that are written and count."""
        ...

    @property
    def busy_s(self) -> float:
        """Time for checksums and writing, summed over the writers."""
        ...

    @property
    def keep_blocks(self) -> int:
        """Number of newest blocks that are kept in the ring, even if they need not be written."""
        ...

    def begin(self, sweeps: int) -> None:
        """Begin a start of the SPAD that is to give `sweeps` sweeps."""
        ...

    def holds(self, ring: BlockRing) -> int:
        """Number of blocks of the ring that `write_from` holds at a time."""
        ...

    def write_from(self, reader: RingReader) -> None:
        """Take all blocks of one start of the SPAD. Raises RecordingError."""
        ...


def _reason(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error)


class Recorder:
    """Records the blocks of one start of the SPAD. `thread` ends once the last one is written.

    reader: holds as many blocks as `recording.holds` says. error: what was raised; None if nothing was. on_failure:
    called on `thread` once `error` is set.
    """

    def __init__(self, reader: RingReader, recording: WritesBlocks, on_failure: Callable[[], None]) -> None:
        self._reader = reader
        self._recording = recording
        self._on_failure = on_failure
        self.thread = StageThread(self._run, "recorder")
        self.error: BaseException | None = None

    def _run(self) -> None:
        with self._reader:
            try:
                self._recording.write_from(self._reader)
            except BaseException as error:  # raised again on the caller's thread
                self.error = error
                self._on_failure()


def next_block(reader: RingReader) -> FrameBlock | None:
    """The next block; None after the last one, or after an error of the source (the counting thread reports it)."""
    try:
        return reader.next()
    except Exception:
        return None
