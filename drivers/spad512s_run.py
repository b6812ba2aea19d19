"""One run of a SPAD512S as it comes over the vendor's line: pixels that may read like its ending (hardware.md 2.1).

The answer to `I` is the pixels, then `DONE`; or text that ends with `ERROR`, anywhere. Pixels may well read `DONE` or
`ERROR`: what counts is the exact length and what stands behind it. A block is given out once so much has come behind it
that no error text can be part of it. Frames have neither number nor checksum: pixels handed over twice in place of
others have the right length, so that no frame may be the very same as one before.
"""

import time
import zlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.spad512s_line import DONE, ERROR, Spad512sLine

GUARD_BYTES = 512
"""So much must come behind a block before it counts. The longest error text of the samples has 160 characters."""
SLICE_S = 0.05
"""One wait: how late a `stop` from another thread comes at most."""
_ERROR_CHECK_S = 0.5
"""After a silence of so long within a run the last bytes are looked at: they may be an error text."""
_UNIFORM = (0x00, 0xFF)


class Spad512sRun:
    """Takes a run block by block; the memory it gives out is good until the next one is asked for."""

    def __init__(self, name: str, line: Spad512sLine, n_frames: int, block_frames: int, frame_bytes: int) -> None:
        """Allocates; the command that starts the run is the caller's."""
        self.n_frames = n_frames
        self.next_frame = 0
        """First frame of the block that comes next."""
        self.block_seq = 0
        """Blocks published."""
        self.just_lost = False
        """The block before was dropped."""
        self._name = name
        self._line = line
        self._block_frames, self._frame_bytes = block_frames, frame_bytes
        self._memory = np.zeros(block_frames * frame_bytes + GUARD_BYTES, np.uint8)
        self._got = 0
        """Bytes of the present block and of what guards it that are here."""
        self._heard_at = time.monotonic()
        self._seen: dict[tuple[int, int], int] = {}
        """Frames by the checksums of their halves: 64 bits, since 10 000 frames may well share one of 32."""

    @property
    def next_n(self) -> int:
        """Frames of the block that comes next; 0: the run is over."""
        return min(self._block_frames, self.n_frames - self.next_frame)

    @property
    def ends(self) -> bool:
        """Whether the block that comes next is the last."""
        return self.next_frame + self.next_n == self.n_frames

    def receive(self, ends_at: float, timeout_s: float, stopped: Callable[[], bool]) -> NDArray[np.uint8] | None:
        """Pixels of the next block, uint8 (n * frame bytes,), once it is safe; None: stopped. Goes on where it was.

        `DeviceTimeout` at `ends_at` (of `time.monotonic`); `DeviceFault` with the device's own words; `ProtocolError`.
        """
        pixel_bytes = self.next_n * self._frame_bytes
        wanted = pixel_bytes + (len(DONE) if self.ends else GUARD_BYTES)
        while self._got < wanted:
            if stopped():
                return None
            self._receive_some(self._memory[self._got : wanted], ends_at, timeout_s)
        if self.ends:
            self._require_done(pixel_bytes)
        pixels = self._memory[:pixel_bytes]
        self._require_new(pixels.reshape(self.next_n, 2, -1))
        return pixels

    def go_on(self) -> None:
        """The block is dealt with: what guarded it begins the next one."""
        used = self.next_n * self._frame_bytes
        self._memory[: self._got - used] = self._memory[used : self._got]
        self._got -= used
        self.next_frame += self.next_n

    def _receive_some(self, place: NDArray[np.uint8], ends_at: float, timeout_s: float) -> None:
        n = self._line.receive_into(place.data, min(SLICE_S, max(0.0, ends_at - time.monotonic())))
        now = time.monotonic()
        if n:
            self._heard_at = now
            self._got += n
            return
        if now - self._heard_at >= _ERROR_CHECK_S:
            self._refuse_error_text(b"")
        if now >= ends_at:
            raise DeviceTimeout(
                f"{self._name} sent nothing for {timeout_s:g} s, {self.next_frame} of {self.n_frames} frames are "
                "here; check trigger and the vendor's program"
            )

    def _require_done(self, pixel_bytes: int) -> None:
        """DONE must stand exactly behind the last pixel, and nothing behind it."""
        behind = self._memory[pixel_bytes : self._got].tobytes()
        if behind == DONE:
            return
        self._refuse_error_text(self._line.rest())
        raise ProtocolError(
            f"{self._name}: 0x{behind.hex()} stands behind the last pixel, not DONE; the run is not to be trusted"
        )

    def _require_new(self, frames: NDArray[np.uint8]) -> None:
        """ProtocolError for a frame that was there before, unless all dark or all bright. frames: (n, 2, half)."""
        for number, (one, other) in enumerate(frames, self.next_frame):
            before = self._seen.setdefault((zlib.crc32(one), zlib.crc32(other)), number)
            if before != number and not (one[0] in _UNIFORM and (one == one[0]).all() and (other == one[0]).all()):
                raise ProtocolError(
                    f"{self._name}: frame {number} is the very same as frame {before}: pixels were handed over twice, "
                    "or the sensor is saturated; start again, with less light"
                )

    def _refuse_error_text(self, rest: bytes) -> None:
        """DeviceFault with the device's own words where what came last is text that ends with ERROR."""
        tail = self._memory[max(0, self._got - 2 * GUARD_BYTES) : self._got].tobytes() + rest
        text = tail.rstrip(b"\r\n\0 ").removesuffix(DONE).rstrip()
        if not text.endswith(ERROR):
            return
        start = len(text)
        while start and (32 <= text[start - 1] < 127 or text[start - 1] in b"\r\n\t"):
            start -= 1
        words = " ".join(text[start:].decode("ascii").split())
        raise DeviceFault(
            f"{self._name} ended the run: {words!r}; see the vendor's program (auto-protect?) before retrying"
        )
