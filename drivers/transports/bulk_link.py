"""A USB device that streams: commands, answers, and reads that are queued so that its FIFO does not overflow.

tests/benchmarks/spb_usb.py compares `PlainLink` and `QueuedLink`. Both have a deadline on every call and raise this
project's errors. A queue belongs to one thread at a time. Buffers are whole packets long and must be left alone until
`reap` or `cancel` gives them back.
"""

import array
import ctypes
import errno
import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import libusb_package
import numpy as np
import usb.util
from numpy.typing import NDArray

from drivers.errors import DeviceError, DeviceNotFound, DeviceTimeout
from drivers.transports.usb_device import USBFS_HINT, UsbDevice, UsbListing, milliseconds, usb_failure

Buffer = NDArray[np.uint8]

_log = logging.getLogger(__name__)

_CANCEL_S = 1.0
"""Longest wait for cancelled transfers."""
_ERRNO = {
    -1: errno.EIO,
    -3: errno.EACCES,
    -4: errno.ENODEV,
    -6: errno.EBUSY,
    -7: errno.ETIMEDOUT,
    -8: errno.EOVERFLOW,
    -9: errno.EPIPE,
    -11: errno.ENOMEM,
}
"""Linux error numbers by libusb's error codes (`enum libusb_error` of libusb 1.0)."""


class PlainLink(UsbDevice):
    """A streaming USB device read through pyusb: one read after the other, with gaps between them."""

    def __init__(self, listing: UsbListing, label: str, interfaces: tuple[int, ...]) -> None:
        """Open the device of a listing and claim its interfaces. label: the kind of device in messages. Raises
        `DeviceError` if that fails."""
        super().__init__(listing, label, dict.fromkeys(interfaces, 0))
        self._queue: deque[tuple[int, Buffer]] = deque()
        self._scratch = array.array("B")
        self._got = 0

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Queue the buffer for `reap`; always returns True."""
        self._queue.append((endpoint, buffer))
        return True

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """Read into the oldest queued buffer now; returns it and the number of bytes read. None if nothing is queued,
        or if the buffer is neither filled nor ended by a short packet in time; the next call then continues with the
        same buffer."""
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
        # A time-out that brought only whole packets does not end the transfer; a short packet would.
        if self._got < len(buffer) and n > 0 and n % 512 == 0:
            return None
        self._queue.popleft()
        got, self._got = self._got, 0
        return buffer, got

    def cancel(self) -> None:
        """Forget all queued buffers."""
        self._queue.clear()
        self._got = 0


class QueuedLink:
    """A streaming USB device with many reads in flight, which libusb writes straight into the caller's memory.

    Uses module `usb1` of package libusb1. libusb's events are handled inside `read`, `reap` and `cancel`, on the
    thread that calls them.
    """

    def __init__(self, listing: UsbListing, label: str, interfaces: tuple[int, ...]) -> None:
        """Open the device of a listing and claim its interfaces. label: the kind of device in messages. Raises
        `DeviceError` if that fails."""
        import usb1

        try:
            usb1.loadLibrary()
        except OSError:  # the system has none
            usb1.loadLibrary(ctypes.CDLL(str(libusb_package.get_library_path())))
        usb.util.dispose_resources(listing.handle)  # pyusb opened it to read its strings
        self.label = f"{label} at {listing.address}"
        self._usb1 = usb1
        self._context = usb1.USBContext()
        self._handle: Any = None
        self._queue: deque[_Read] = deque()
        self._spare: list[Any] = []
        self._hinted = False
        try:
            with self._translated():
                self._context.open()
                found = self._find(listing)
                self._handle = found.open()
                for interface in interfaces:
                    self._handle.claimInterface(interface)
                self.endpoints = frozenset(end.getAddress() for setting in found.iterSettings() for end in setting)
        except BaseException:
            self.close()
            raise

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """Make one OUT transfer. Raises `DeviceTimeout` if not all of it went out."""
        with self._translated(endpoint, timeout_s):
            sent = self._handle.bulkWrite(endpoint, data, milliseconds(timeout_s))
        if sent != len(data):
            raise DeviceTimeout(f"{self.label}: {sent} of {len(data)} bytes went out within {timeout_s:g} s")

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """Make one IN transfer of at most `size` bytes, in whole packets. Raises `DeviceTimeout` if nothing came.

        Bytes that came before a timeout are kept; libusb1's own read loses them (its issue 42).
        """
        buffer = np.zeros(size, np.uint8)
        read = _Read(self._transfer(), buffer)
        with self._translated(endpoint, timeout_s):
            read.begin(endpoint, milliseconds(timeout_s))
        if not self._wait(read, timeout_s + _CANCEL_S):
            raise DeviceTimeout(f"{self.label}: a read on endpoint 0x{endpoint:02x} does not end; unplug the device")
        self._spare.append(read.transfer)
        if read.status != self._usb1.TRANSFER_COMPLETED and not (
            read.status == self._usb1.TRANSFER_TIMED_OUT and read.got
        ):
            raise self._failed(read, timeout_s)
        return buffer[: read.got].tobytes()

    def control_in(
        self, request_type: int, request: int, value: int, index: int, length: int, timeout_s: float
    ) -> bytes:
        """Make a control transfer that reads; returns its bytes. Raises `DeviceFault` if the device refuses it
        (stall)."""
        with self._translated(0, timeout_s):
            return bytes(self._handle.controlRead(request_type, request, value, index, length, milliseconds(timeout_s)))

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Queue a read that fills the buffer. Returns False if the kernel takes no more reads while at least one is in
        flight."""
        read = _Read(self._transfer(), buffer)
        with self._translated(endpoint):
            try:
                read.begin(endpoint, 0)
            except self._usb1.USBErrorNoMem:
                self._spare.append(read.transfer)
                if not self._queue:
                    raise
                self._hint(len(buffer))
                return False
        self._queue.append(read)
        return True

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """The buffer of the oldest queued read and the number of bytes read; None if the read does not end in time, or
        nothing is queued. Raises `DeviceError` if the read failed.
        """
        if not self._queue or not self._wait(self._queue[0], timeout_s):
            return None
        read = self._queue.popleft()
        self._spare.append(read.transfer)
        if read.status != self._usb1.TRANSFER_COMPLETED:
            raise self._failed(read)
        return read.buffer, read.got

    def cancel(self) -> None:
        """End all queued reads and drop what they have received; waits until the kernel has released their memory.
        Never raises."""
        for read in reversed(self._queue):  # the newest first, so that none of them begins meanwhile
            with suppress(self._usb1.USBError):
                read.transfer.cancel()
        ends_at = time.monotonic() + _CANCEL_S
        for read in self._queue:
            with suppress(DeviceError):
                if self._wait(read, max(0.0, ends_at - time.monotonic())):
                    self._spare.append(read.transfer)
                    continue
            # usb1 keeps a submitted transfer and its memory for good: nobody knows when it would be safe to free them.
            _log.error("%s: a cancelled read does not end; its memory is given up", self.label)
        self._queue.clear()

    def close(self) -> None:
        """Cancel all reads and release the device; a second call does nothing."""
        if self._handle is not None:
            self.cancel()
            for transfer in self._spare:
                transfer.close()
            self._spare.clear()
            handle, self._handle = self._handle, None
            with suppress(self._usb1.USBError):
                handle.close()
        with suppress(self._usb1.USBError):
            self._context.close()

    def _transfer(self) -> Any:
        return self._spare.pop() if self._spare else self._handle.getTransfer()

    def _wait(self, read: "_Read", timeout_s: float) -> bool:
        ends_at = time.monotonic() + timeout_s
        while not read.over:
            left_s = ends_at - time.monotonic()
            with self._translated():
                self._context.handleEventsTimeout(max(0.0, left_s))
            if left_s <= 0:
                break
        return read.over

    def _find(self, listing: UsbListing) -> Any:
        for device in self._context.getDeviceIterator(skip_on_error=True):
            ports = device.getPortNumberList() or [device.getDeviceAddress()]
            if f"{device.getBusNumber()}-{'.'.join(str(port) for port in ports)}" == listing.path:
                return device
        raise DeviceNotFound(f"{self.label}: gone since it was found; plug it in again")

    def _hint(self, size: int) -> None:
        """Log, the first time only, how the kernel can be made to take more transfers."""
        if not self._hinted:
            self._hinted = True
            _log.warning(
                "%s: only %d reads of %d bytes fit into the kernel's memory; for more, run: %s",
                *(self.label, len(self._queue), size, USBFS_HINT),
            )

    def _failed(self, read: "_Read", timeout_s: float = 0.0) -> DeviceError:
        usb1 = self._usb1
        if read.status == usb1.TRANSFER_STALL:
            with suppress(usb1.USBError):
                self._handle.clearHalt(read.endpoint)
        number = {
            usb1.TRANSFER_NO_DEVICE: errno.ENODEV,
            usb1.TRANSFER_ERROR: errno.EIO,
            usb1.TRANSFER_STALL: errno.EPIPE,
            usb1.TRANSFER_OVERFLOW: errno.EOVERFLOW,
            usb1.TRANSFER_TIMED_OUT: errno.ETIMEDOUT,
        }.get(read.status)
        return usb_failure(self.label, number, f"transfer status {read.status}", read.endpoint, timeout_s)

    @contextmanager
    def _translated(self, endpoint: int | None = None, timeout_s: float = 0.0) -> Iterator[None]:
        """Turn libusb1's exceptions into those of `drivers.errors`."""
        try:
            yield
        except self._usb1.USBError as error:
            raise usb_failure(self.label, _ERRNO.get(error.value), str(error), endpoint, timeout_s) from None


@dataclass(slots=True, eq=False)
class _Read:
    """A queued read."""

    transfer: Any
    buffer: Buffer
    endpoint: int = 0
    over: bool = False
    got: int = 0
    status: int = -1

    def begin(self, endpoint: int, timeout_ms: int) -> None:
        """Hand the read to libusb."""
        self.endpoint = endpoint
        self.transfer.setBulk(endpoint, self.buffer.data, callback=self._done, timeout=timeout_ms)
        self.transfer.submit()

    def _done(self, transfer: Any) -> None:
        self.got = transfer.getActualLength()
        self.status = transfer.getStatus()
        self.over = True


BulkLink = PlainLink | QueuedLink
"""The link of a streaming driver."""
