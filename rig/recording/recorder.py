"""The recording of a run: its blocks as they came, appended to one file as SPB1 with the payload's CRC.

The recorder is a thread of its own with a required place in the ring: where the disk is slower than the stream, the
ring fills and the overload policy decides. Checksums are computed here, without the interpreter's lock, and nowhere
else live. `drivers.spb1.walk_blocks` reads the file (stride None).
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from drivers.frames import FrameBlock
from drivers.ring import RingReader
from drivers.spb1 import block_parts
from rig.errors import RecordingError

FIRST_FILE = "frames-000000.spb"
RESERVE_BYTES = 1 << 20
"""Kept free beside the recording, so that manifest and summary still find room on the disk that it filled."""


class Recording:
    """An SPB1 file that grows block by block; whatever fails, it ends behind a whole block."""

    def __init__(self, path: Path) -> None:
        """Begin the file. Raises RecordingError where it cannot be written."""
        self.path = path
        self.blocks = 0
        self.bytes = 0
        self._reserve = path.with_suffix(".reserve")
        try:
            self._file = path.open("xb", buffering=0)
            self._reserve.write_bytes(bytes(RESERVE_BYTES))
        except OSError as error:
            raise self._failed(error) from error

    def append(self, block: FrameBlock) -> None:
        """Write a block behind the others. Raises RecordingError where it did not fit; the file is then as before."""
        try:
            written = sum(self._write(part) for part in block_parts(block))
        except BaseException as error:
            self._file.truncate(self.bytes)
            self._file.seek(self.bytes)
            if isinstance(error, OSError):
                raise self._failed(error) from error
            raise
        self.blocks += 1
        self.bytes += written

    def close(self) -> None:
        """End the file. A second call does nothing."""
        self._file.close()
        self._reserve.unlink(missing_ok=True)

    def content(self) -> dict[str, object]:
        """What there is, for the manifest."""
        return {"files": [self.path.name], "blocks": self.blocks, "bytes": self.bytes}

    def _write(self, part: memoryview) -> int:
        left = part
        while left:  # a disk that is nearly full takes a piece of what it is given
            left = left[self._file.write(left) or 0 :]
        return part.nbytes

    def _failed(self, error: OSError) -> RecordingError:
        self._reserve.unlink(missing_ok=True)
        reason = error.strerror or str(error)
        return RecordingError(
            f"cannot write the recording {self.path.name} beyond {self.bytes / 1e6:.0f} MB: {reason}; "
            "free the space it needs or name a folder on another disk with --out"
        )


class Recorder:
    """The thread that records the blocks of one start of the SPAD, up to the last one. on_failure: called on it."""

    def __init__(self, reader: RingReader, recording: Recording, on_failure: Callable[[], None]) -> None:
        self._reader = reader
        self._recording = recording
        self._on_failure = on_failure
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self.busy_s = 0.0
        self.blocks = 0
        self.bytes = 0
        self.error: BaseException | None = None

    def start(self) -> None:
        """Begin to record."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait until everything is written; False where that takes longer."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        with self._reader:
            try:
                while (block := self._next()) is not None:
                    self._record(block)
            except BaseException as error:  # raised again on the caller's thread
                self.error = error
                self._on_failure()

    def _next(self) -> FrameBlock | None:
        """The next block; None where none will come. An error of the source is for counting to tell."""
        try:
            return self._reader.next()
        except Exception:
            return None

    def _record(self, block: FrameBlock) -> None:
        begun = time.perf_counter()
        before = self._recording.bytes
        try:
            self._recording.append(block)
        finally:
            self.busy_s += time.perf_counter() - begun
        self.blocks += 1
        self.bytes += self._recording.bytes - before
