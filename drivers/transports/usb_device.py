"""One USB device, opened and claimed through pyusb. Every call has a deadline; every failure raises one of
`drivers.errors`.

Addresses: "usb" (the only one attached), "usb:serial=ABC", "usb:path=1-2.4" (bus and hub ports, as in
/sys/bus/usb/devices; for devices without a serial string). `backend` is a pyusb backend: None for the real libusb, an
emulator's object otherwise. Between two reads no transfer is queued; for a stream use `bulk_link`.

Errors carry Linux error numbers, as pyusb sets them for libusb 1.0. Unplugging shows as ENODEV, EIO, ESHUTDOWN or
ENOTCONN. If a read asks for fewer bytes than a packet has, it overflows and the packet is lost. The sum of all queued
transfers is limited by Linux's `usbfs_memory_mb`, 16 MB by default.
"""

import array
import errno
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from threading import RLock
from typing import Any

import libusb_package
import usb.backend.libusb1
import usb.core
import usb.util

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
from drivers.transports.endpoints import UDEV_RULES, printable
from drivers.transports.tap import IN, OUT, Tap

USBFS_HINT = "echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb"
"""Command that raises the limit for all queued transfers together, which is 16 MB by default."""

_LOST = (errno.ENODEV, errno.EIO, errno.ESHUTDOWN, errno.ENOTCONN)


def no_permission(label: str) -> str:
    """The error text for a device that is attached but may not be opened."""
    return f"{label}: no permission to open it; install {UDEV_RULES} (its first lines say how) and plug it in again"


@contextmanager
def translated(label: str, endpoint: int | None = None, timeout_s: float | None = None) -> Iterator[None]:
    """Turn what pyusb raises inside the `with` block into an error of `drivers.errors` with one line of text."""
    try:
        yield
    except usb.core.USBError as error:
        raise usb_failure(label, error.errno, error.strerror or str(error), endpoint, timeout_s) from None
    except (ValueError, NotImplementedError) as error:  # no such endpoint or setting; a call libusb cannot do here
        raise ProtocolError(f"{label}: {error}; check the device's firmware") from None


def usb_failure(
    label: str, number: int | None, text: str, endpoint: int | None = None, timeout_s: float | None = None
) -> DeviceError:
    """The `DeviceError` for a failure in libusb. number: its Linux error number; None if it has none. timeout_s: the
    deadline that the message names. text: libusb's own message."""
    where = "" if endpoint is None else f" on endpoint 0x{endpoint:02x}"
    if number in _LOST:
        return DeviceDisconnected(f"{label}: the device is gone ({text}); check cable and power, open again")
    if number == errno.EACCES:
        return DevicePermission(no_permission(label))
    kind, said = {
        errno.ETIMEDOUT: (DeviceTimeout, f"nothing{where} within {timeout_s or 0:g} s"),
        errno.EBUSY: (DeviceBusy, "another program holds it; end that program"),
        errno.EPIPE: (DeviceFault, f"the device refused the transfer{where} (stall)"),
        errno.EOVERFLOW: (ProtocolError, f"more bytes than asked for{where}; check the firmware"),
        errno.ENOMEM: (DeviceError, f"the kernel's USB memory is used up; run: {USBFS_HINT}"),
    }.get(number or 0, (DeviceError, f"USB error{where}: {text}"))
    return kind(f"{label}: {said}")


@dataclass(frozen=True, slots=True)
class UsbId:
    """The ids of a kind of device. Unrelated devices use the same ids. So if there are `product_names`, one of them
    must be part of the product string, in upper or lower case; a string that cannot be read is not checked."""

    label: str
    vendor: int
    product: int
    product_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UsbListing:
    """A device on the bus, as far as it can be known without claiming it.

    Strings are None if the device has none, or if they cannot be read, for example without permission.
    """

    path: str
    serial: str | None
    product_name: str | None
    handle: Any = field(repr=False, compare=False, default=None)

    @property
    def address(self) -> str:
        """The device's address by serial number, or by path if it states none."""
        return f"usb:serial={self.serial}" if self.serial else f"usb:path={self.path}"


def attached(wanted: UsbId, backend: object | None = None) -> list[UsbListing]:
    """The attached devices of one kind, ordered by path. Claims nothing and changes nothing. backend: a pyusb backend;
    None: libusb. Raises `DeviceError` if libusb cannot be loaded."""
    ids = {"idVendor": wanted.vendor, "idProduct": wanted.product}
    devices = usb.core.find(find_all=True, backend=backend or _libusb(), **ids)
    with translated(wanted.label):
        listings = [_listing(device) for device in devices]
    return sorted((one for one in listings if _named(one, wanted.product_names)), key=lambda one: one.path)


def _named(listing: UsbListing, names: tuple[str, ...]) -> bool:
    if listing.product_name is None or not names:
        return True
    return any(name.casefold() in listing.product_name.casefold() for name in names)


class UsbDevice:
    """An open device with its interfaces claimed and in the wanted alternate settings.

    Any thread may call its methods, but two transfers on one endpoint must not overlap. `close` waits for no transfer,
    so first end the threads that use the device.
    """

    def __init__(self, listing: UsbListing, label: str, alternates: Mapping[int, int], tap: Tap | None = None) -> None:
        """Claim the interfaces in `alternates` and set each to its alternate setting. Usually called by `open_device`.

        alternates: alternate setting by number of the interface. tap: records what `write` and `read` pass.
        """
        self.listing = listing
        self.label = f"{label} at {listing.address}"
        self._device = listing.handle
        self._lock = RLock()
        self._open = True
        self._tap = tap
        try:
            with translated(self.label):
                self._configure(alternates)
        except BaseException:
            self.close()
            raise

    def _configure(self, alternates: Mapping[int, int]) -> None:
        try:
            self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:  # pyusb raises one without a number for 'not configured'
                raise
            self._device.set_configuration()
        for interface, alternate in alternates.items():
            usb.util.claim_interface(self._device, interface)
            # Always sent, also if the setting is the present one: it makes the firmware start afresh.
            self._device.set_interface_altsetting(interface, alternate)

    def set_alternate(self, interface: int, alternate: int) -> None:
        """Change the alternate setting of a claimed interface."""
        with self._lock, translated(self.label):
            self._device.set_interface_altsetting(interface, alternate)

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """Make one OUT transfer, interrupt or bulk as the descriptor says. Raises `DeviceTimeout` if not all of it went
        out.
        """
        if self._tap is not None:
            self._tap.note(f"{endpoint:02x}", OUT, data)
        with translated(self.label, endpoint, timeout_s):
            sent = self._device.write(endpoint, data, milliseconds(timeout_s))
        if sent != len(data):
            raise DeviceTimeout(
                f"{self.label}: {sent} of {len(data)} B went out on endpoint 0x{endpoint:02x} within {timeout_s:g} s"
            )

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """Make one IN transfer of at most `size` bytes, a whole number of packets. Raises `DeviceTimeout` if nothing
        came.
        """
        with translated(self.label, endpoint, timeout_s):
            data = bytes(self._device.read(endpoint, size, milliseconds(timeout_s)))
        if self._tap is not None:
            self._tap.note(f"{endpoint:02x}", IN, data)
        return data

    def read_into(self, endpoint: int, buffer: "array.array[int]", timeout_s: float) -> int:
        """Read into an existing array, whose size is whole packets; returns the number of bytes read. Raises
        `DeviceTimeout` if nothing came."""
        with translated(self.label, endpoint, timeout_s):
            return int(self._device.read(endpoint, buffer, milliseconds(timeout_s)))

    def drain(self, endpoint: int, size: int, timeout_s: float, most: int = 1000) -> int:
        """Read and drop until nothing comes for `timeout_s`; returns the number of transfers dropped.

        Raises `ProtocolError` after `most` transfers, since a device that never falls silent follows another protocol.
        """
        for dropped in range(most):
            try:
                self.read(endpoint, size, timeout_s)
            except DeviceTimeout:
                return dropped
        raise ProtocolError(f"{self.label}: endpoint 0x{endpoint:02x} talks without being asked; check the firmware")

    def control_in(
        self, request_type: int, request: int, value: int, index: int, length: int, timeout_s: float
    ) -> bytes:
        """Make a control transfer that reads. Raises `DeviceFault` if the device refuses it (stall)."""
        with translated(self.label, 0, timeout_s):
            reply = self._device.ctrl_transfer(request_type, request, value, index, length, milliseconds(timeout_s))
        return bytes(reply)

    @property
    def endpoints(self) -> frozenset[int]:
        """Addresses of all endpoints in the active configuration; bit 7 set = IN."""
        with translated(self.label):
            interfaces = list(self._device.get_active_configuration())
        return frozenset(endpoint.bEndpointAddress for interface in interfaces for endpoint in interface)

    def close(self) -> None:
        """Release the interfaces and the device; a second call does nothing. Never raises: the device may be gone."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            with suppress(usb.core.USBError, NotImplementedError):
                usb.util.dispose_resources(self._device)


def open_device(
    wanted: UsbId,
    address: str,
    alternates: Mapping[int, int],
    backend: object | None = None,
    tap: Tap | None = None,
) -> UsbDevice:
    """Find, open, configure and claim a device.

    Raises `DeviceNotFound` if there is none, or none at that address; `DeviceError` if the address is malformed or fits
    several; `DevicePermission` if this user may not open it; `DeviceBusy` if another program has claimed it.
    """
    return UsbDevice(find_device(wanted, address, backend), wanted.label, alternates, tap)


def find_device(wanted: UsbId, address: str, backend: object | None = None) -> UsbListing:
    """The only device that an address means. Errors as in `open_device`, except for those of claiming it."""
    key, _, value = address.removeprefix("usb:").partition("=")
    if address != "usb" and not (address.startswith("usb:") and key in ("serial", "path") and value):
        raise DeviceError(f"port {address!r} is no USB address; write usb, usb:serial=ABC or usb:path=1-2")
    listings = attached(wanted, backend)
    ids = f"{wanted.vendor:04x}:{wanted.product:04x}"
    if not listings:
        raise DeviceNotFound(f"{wanted.label}: no USB device {ids} is attached; plug it in and switch it on")
    chosen = [one for one in listings if address == "usb" or getattr(one, key) == value]
    choices = ", ".join(one.address for one in listings)
    if not chosen:
        hidden = any(one.serial is None and one.product_name is None for one in listings)
        if hidden and address.startswith("usb:serial="):
            raise DevicePermission(no_permission(wanted.label))
        raise DeviceNotFound(f"{wanted.label}: none is attached at {address}; attached: {choices}")
    if len(chosen) > 1:
        raise DeviceError(f"{wanted.label}: {len(chosen)} are attached; set port to one of {choices}")
    return chosen[0]


def _listing(device: Any) -> UsbListing:
    ports = device.port_numbers or (device.address or 0,)
    serial, product = (_string(device, index) for index in (device.iSerialNumber, device.iProduct))
    usb.util.dispose_resources(device)  # asking for strings opened it
    return UsbListing(
        path=f"{device.bus}-{'.'.join(str(port) for port in ports)}",
        serial=serial,
        product_name=product,
        handle=device,
    )


def _string(device: Any, index: int) -> str | None:
    """A string of the device; None if there is none or this user may not read it."""
    try:
        text = usb.util.get_string(device, index)
    except (usb.core.USBError, ValueError, NotImplementedError):  # ValueError: pyusb's 'no languages', mostly EACCES
        return None
    return printable(str(text)) if text is not None else None


def _libusb() -> Any:
    """pyusb's backend for the system's libusb, else for the one that package libusb-package carries."""
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        backend = usb.backend.libusb1.get_backend(find_library=libusb_package.find_library)
    if backend is None:
        raise DeviceError(
            "libusb cannot be loaded, and USB devices need it; run: pip install --force-reinstall libusb-package, "
            "or install libusb-1.0-0 with the system's packages"
        )
    return backend


def milliseconds(timeout_s: float) -> int:
    """The time in milliseconds, at least 1, because libusb takes 0 as 'wait for ever'."""
    return max(1, round(timeout_s * 1000))
