"""A streaming USB device read by pyusb, one piece after the other: nothing is queued between two reads."""

import array
from collections import deque

import numpy as np

from drivers.errors import DeviceTimeout
from drivers.transports.bulk_link import Buffer
from drivers.transports.usb_device import UsbDevice


class PlainLink:
    """A `BulkLink`."""

    def __init__(self, device: UsbDevice) -> None:
        self.label = device.label
        self.endpoints = frozenset(device.endpoints())
        self._device = device
        self._queue: deque[tuple[int, Buffer]] = deque()
        self._scratch = array.array("B")
        self._got = 0

    @property
    def in_flight(self) -> int:
        """Reads that are waiting."""
        return len(self._queue)

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """See `BulkLink`."""
        self._device.write(endpoint, data, timeout_s)

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """See `BulkLink`."""
        return self._device.read(endpoint, size, timeout_s)

    def control_in(
        self, request_type: int, request: int, value: int, index: int, length: int, timeout_s: float
    ) -> bytes:
        """See `BulkLink`."""
        return self._device.control_in(request_type, request, value, index, length, timeout_s)

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Remember it for `reap`."""
        self._queue.append((endpoint, buffer))
        return True

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """Read the oldest now. What a time-out interrupts goes on with the next call."""
        if not self._queue:
            return None
        endpoint, buffer = self._queue[0]
        left = len(buffer) - self._got
        if len(self._scratch) != left:
            self._scratch = array.array("B", bytes(left))
        try:
            n = self._device.read_into(endpoint, self._scratch, timeout_s)
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

    def close(self) -> None:
        """Give the device back."""
        self.cancel()
        self._device.close()
