"""A USB device that streams: commands and answers, and reads that are queued so that its FIFO never starves.

Two implementations: `PlainLink` reads one piece after the other through pyusb, with a gap between two; `QueuedLink`
keeps many transfers in flight through asynchronous libusb (module `usb1` of package libusb1) which write straight into
the caller's memory. tests/benchmarks/spb_usb.py compares them. Both have a deadline on every call and our errors.

A queue belongs to one thread at a time. Buffers are whole packets long and stay the caller's until `reap` or `cancel`
gives them back.
"""

import array
import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import numpy as np
import usb.util
from numpy.typing import NDArray

from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.usb_device import UDEV_RULES, UsbDevice, UsbListing

_log = logging.getLogger(__name__)

Buffer = NDArray[np.uint8]

USBFS_HINT = "echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb"
"""Linux lets all queued transfers hold 16 MB unless told otherwise."""
_CANCEL_S = 1.0
"""Cancelled transfers are waited for at most so long."""


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


class PlainLink:
    """Reads one after the other, with pyusb."""

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


class QueuedLink:
    """Many reads in flight, with asynchronous libusb. Events are handled inside `reap`, on the caller's thread."""

    def __init__(self, listing: UsbListing, label: str, interfaces: tuple[int, ...]) -> None:
        """Open the device of a listing and claim its interfaces."""
        import usb1

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
                self.endpoints = frozenset(_endpoints(found))
        except BaseException:
            self.close()
            raise

    @property
    def in_flight(self) -> int:
        """Reads that are queued."""
        return len(self._queue)

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """See `BulkLink`."""
        with self._translated(endpoint, timeout_s):
            sent = self._handle.bulkWrite(endpoint, data, _milliseconds(timeout_s))
        if sent != len(data):
            raise DeviceTimeout(f"{self.label}: {sent} of {len(data)} bytes went out within {timeout_s:g} s")

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """See `BulkLink`. Bytes that came before a time-out are kept: libusb1's own read loses them (its issue 42)."""
        buffer = np.zeros(size, np.uint8)
        read = _Read(self._transfer(), buffer)
        with self._translated(endpoint, timeout_s):
            read.begin(endpoint, _milliseconds(timeout_s))
        if not self._wait(read, timeout_s + _CANCEL_S):
            raise DeviceTimeout(f"{self.label}: a read on endpoint 0x{endpoint:02x} does not end; unplug the device")
        self._spare.append(read.transfer)
        if read.status == self._usb1.TRANSFER_TIMED_OUT and read.got == 0:
            raise DeviceTimeout(f"{self.label}: nothing on endpoint 0x{endpoint:02x} within {timeout_s:g} s")
        if read.status not in (self._usb1.TRANSFER_COMPLETED, self._usb1.TRANSFER_TIMED_OUT):
            raise self._failed(read.status, endpoint)
        return buffer[: read.got].tobytes()

    def control_in(
        self, request_type: int, request: int, value: int, index: int, length: int, timeout_s: float
    ) -> bytes:
        """See `BulkLink`."""
        with self._translated(0, timeout_s):
            return bytes(
                self._handle.controlRead(request_type, request, value, index, length, _milliseconds(timeout_s))
            )

    def submit(self, endpoint: int, buffer: Buffer) -> bool:
        """Queue it; False where the kernel's memory for transfers is used up and at least one is in flight."""
        read = _Read(self._transfer(), buffer)
        try:
            with self._translated(endpoint):
                read.begin(endpoint, 0)
        except _NoMemoryError:
            self._spare.append(read.transfer)
            if not self._queue:
                raise DeviceError(
                    f"{self.label}: the kernel takes not even one transfer of {len(buffer)} bytes; run: {USBFS_HINT}"
                ) from None
            if not self._hinted:
                self._hinted = True
                _log.warning(
                    "%s: only %d reads of %d bytes fit into the kernel's memory; for more, run: %s",
                    *(self.label, len(self._queue), len(buffer), USBFS_HINT),
                )
            return False
        self._queue.append(read)
        return True

    def reap(self, timeout_s: float) -> tuple[Buffer, int] | None:
        """Handle events until the oldest is over or the time is."""
        if not self._queue or not self._wait(self._queue[0], timeout_s):
            return None
        read = self._queue.popleft()
        self._spare.append(read.transfer)
        if read.status != self._usb1.TRANSFER_COMPLETED:
            raise self._failed(read.status, read.endpoint)
        return read.buffer, read.got

    def cancel(self) -> None:
        """End all; waits until the kernel has let go of their memory."""
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
        """Give the device back."""
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

    def _failed(self, status: int, endpoint: int) -> DeviceError:
        usb1 = self._usb1
        where = f"endpoint 0x{endpoint:02x}"
        if status in (usb1.TRANSFER_NO_DEVICE, usb1.TRANSFER_ERROR):
            return DeviceDisconnected(f"{self.label}: the device is gone; check cable and power, open again")
        if status == usb1.TRANSFER_STALL:
            with suppress(usb1.USBError):
                self._handle.clearHalt(endpoint)
            return DeviceFault(f"{self.label}: the device refused a transfer on {where} (stall)")
        if status == usb1.TRANSFER_OVERFLOW:
            return ProtocolError(f"{self.label}: more bytes than asked for on {where}; check the firmware")
        return DeviceError(f"{self.label}: a transfer on {where} ended with libusb status {status}")

    @contextmanager
    def _translated(self, endpoint: int = 0, timeout_s: float = 0.0) -> Iterator[None]:
        """Turn libusb1's exceptions into ours."""
        usb1 = self._usb1
        try:
            yield
        except usb1.USBErrorTimeout:
            raise DeviceTimeout(f"{self.label}: nothing on endpoint 0x{endpoint:02x} within {timeout_s:g} s") from None
        except (usb1.USBErrorNoDevice, usb1.USBErrorIO):
            raise DeviceDisconnected(f"{self.label}: the device is gone; check cable and power, open again") from None
        except usb1.USBErrorAccess:
            raise DevicePermission(
                f"{self.label}: no permission to open it; install {UDEV_RULES} and plug it in again"
            ) from None
        except usb1.USBErrorBusy:
            raise DeviceBusy(f"{self.label}: another program holds it; end that program") from None
        except usb1.USBErrorNoMem:
            raise _NoMemoryError(f"{self.label}: the kernel's USB memory is used up; run: {USBFS_HINT}") from None
        except usb1.USBErrorPipe:
            raise DeviceFault(f"{self.label}: the device refused a transfer (stall)") from None
        except usb1.USBError as error:
            raise DeviceError(f"{self.label}: USB error {error}") from None


class _NoMemoryError(DeviceError):
    """The kernel takes no more transfers."""


class _Read:
    """A queued read."""

    def __init__(self, transfer: Any, buffer: Buffer) -> None:
        self.transfer = transfer
        self.buffer = buffer
        self.endpoint = 0
        self.over = False
        self.got = 0
        self.status = -1

    def begin(self, endpoint: int, timeout_ms: int) -> None:
        """Hand it to libusb."""
        self.endpoint = endpoint
        self.transfer.setBulk(endpoint, self.buffer.data, callback=self._done, timeout=timeout_ms)
        self.transfer.submit()

    def _done(self, transfer: Any) -> None:
        self.got = transfer.getActualLength()
        self.status = transfer.getStatus()
        self.over = True


def _endpoints(device: Any) -> Iterator[int]:
    for setting in device.iterSettings():
        for endpoint in setting:
            yield endpoint.getAddress()


def _milliseconds(timeout_s: float) -> int:
    """libusb takes 0 as 'for ever', which no call here may ask for."""
    return max(1, round(timeout_s * 1000))
