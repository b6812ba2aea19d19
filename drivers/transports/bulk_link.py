"""A USB device that streams: commands and answers, and reads that are queued so that its FIFO never starves.

Two implementations: `PlainLink`, here, reads one piece after the other through pyusb, with a gap between two;
`queued_link` keeps many transfers in flight through asynchronous libusb, which write straight into the caller's memory.
tests/benchmarks/spb_usb.py compares them. Both have a deadline on every call and our errors.

A queue belongs to one thread at a time. Buffers are whole packets long and stay the caller's until `reap` or `cancel`
gives them back.
"""

import array
from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceTimeout
from drivers.transports.usb_device import UsbDevice, UsbListing

Buffer = NDArray[np.uint8]


class BulkLink(Protocol):
    """The abilities that a streaming driver needs of its device."""

    label: str

    @property
    def endpoints(self) -> frozenset[int]:
        """Addresses of the claimed interfaces' endpoints; bit 7 set = IN."""
        ...

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """One OUT transfer. `DeviceTimeout` where not all of it went out."""
        ...

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """One IN transfer of at most `size` bytes, whole packets. `DeviceTimeout` where nothing came."""
        ...

    def control_in(
        self, request_type: int, request: int, value: int, index: int, length: int, timeout_s: float
    ) -> bytes:
        """A control transfer that reads."""
        ...

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Queue a read of the whole buffer. False where the system takes no more of them."""
        ...

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """The oldest queued read once it is over, and its bytes; None where it is not within the time."""
        ...

    def cancel(self) -> None:
        """End all queued reads; what they hold is dropped. Never raises."""
        ...

    def close(self) -> None:
        """Cancel and give the device back; again: nothing happens."""
        ...


class PlainLink(UsbDevice):
    """A streaming USB device read through pyusb, one piece after the other."""

    def __init__(self, listing: UsbListing, label: str, interfaces: tuple[int, ...]) -> None:
        """Open the device of a listing and claim its interfaces."""
        super().__init__(listing, label, dict.fromkeys(interfaces, 0))
        self._queue: deque[tuple[int, Buffer]] = deque()
        self._scratch = array.array("B")
        self._got = 0

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Remember the buffer for `reap`."""
        self._queue.append((endpoint, buffer))
        return True

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """Read the oldest queued buffer now. What a time-out interrupts goes on with the next call."""
        if not self._queue:
            return None
        endpoint, buffer = self._queue[0]
        left = len(buffer) - self._got
        if len(self._scratch) != left:
            self._scratch = array.array("B", bytes(left))
        try:
            n = self.read_into(endpoint, self._scratch, timeout_s)
        except DeviceTimeout:
            return None
        buffer[self._got : self._got + n] = np.frombuffer(self._scratch, np.uint8)[:n]
        self._got += n
        # A time-out that brought whole packets only is no end of the transfer: a short packet would be one.
        if self._got < len(buffer) and n > 0 and n % 512 == 0:
            return None
        self._queue.popleft()
        got, self._got = self._got, 0
        return buffer, got

    def cancel(self) -> None:
        """Forget what is queued."""
        self._queue.clear()
        self._got = 0
