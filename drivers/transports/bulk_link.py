"""A USB device that streams: commands and answers, and reads that are queued so that its FIFO never starves.

Two implementations: `plain_link` reads one piece after the other through pyusb, with a gap between two; `queued_link`
keeps many transfers in flight through asynchronous libusb, which write straight into the caller's memory.
tests/benchmarks/spb_usb.py compares them. Both have a deadline on every call and our errors.

A queue belongs to one thread at a time. Buffers are whole packets long and stay the caller's until `reap` or `cancel`
gives them back.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Buffer = NDArray[np.uint8]


class BulkLink(Protocol):
    """What a streaming driver needs of its device."""

    label: str
    endpoints: frozenset[int]
    """Addresses of the claimed interfaces' endpoints; bit 7 set = IN."""

    @property
    def in_flight(self) -> int:
        """Reads that are queued."""
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
