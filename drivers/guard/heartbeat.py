"""The heartbeat: a page of memory that application and guard share, in which the source thread writes.

To beat is one store: no lock, no system call, nothing that a full pipe, a stopped guard or a slow disk could hold up.
"""

import mmap
import os
import struct

from drivers.errors import DeviceError

_FRAME, _WAITED = struct.Struct("<q"), struct.Struct("<d")
_NO_FRAME = -1


class Heartbeat:
    """The page, in either process."""

    def __init__(self, handle: int) -> None:
        """handle: of an anonymous file of at least a page."""
        self.handle = handle
        self._page = mmap.mmap(handle, mmap.PAGESIZE)

    @classmethod
    def create(cls) -> "Heartbeat":
        """A new page, in memory: pages of a file on a disk may block while the disk does."""
        if not hasattr(os, "memfd_create"):
            raise DeviceError("the laser guard needs Linux; scan from a Linux machine")
        handle = os.memfd_create("spadrig-heartbeat")
        os.ftruncate(handle, mmap.PAGESIZE)
        beat = cls(handle)
        beat.frame = _NO_FRAME
        return beat

    @property
    def frame(self) -> int:
        """The last frame number told; -1 before the first one."""
        return int(_FRAME.unpack_from(self._page)[0])

    @frame.setter
    def frame(self, number: int) -> None:
        _FRAME.pack_into(self._page, 0, number)

    @property
    def waited_s(self) -> float:
        """For how long the source thread has asked the SPAD in vain since its last frames, as it said last."""
        return float(_WAITED.unpack_from(self._page, _FRAME.size)[0])

    @waited_s.setter
    def waited_s(self, seconds: float) -> None:
        _WAITED.pack_into(self._page, _FRAME.size, seconds)

    def close(self) -> None:
        """Give the page back; again: nothing happens."""
        if self.handle >= 0:
            self._page.close()
            os.close(self.handle)
            self.handle = -1
