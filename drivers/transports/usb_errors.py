"""What goes wrong on USB, as one line and one class of `drivers.errors`.

Errors as libusb 1.0 numbers them and as Linux means them: unplugging shows as ENODEV, EIO or ESHUTDOWN; a read shorter
than a packet overflows and loses the packet; the sum of all queued transfers is limited by `usbfs_memory_mb` (16).
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import usb.core

from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.endpoints import UDEV_RULES

USBFS_HINT = "echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb"
"""Linux lets all queued transfers hold 16 MB unless told otherwise."""

_LOST = (errno.ENODEV, errno.EIO, errno.ESHUTDOWN, errno.ENOTCONN)


def no_permission(label: str) -> str:
    """For a device that is there and may not be opened."""
    return f"{label}: no permission to open it; install {UDEV_RULES} (its first lines say how) and plug it in again"


@contextmanager
def translated(label: str, endpoint: int | None = None, timeout_s: float | None = None) -> Iterator[None]:
    """Turn what pyusb raises inside into one line and one class of `drivers.errors`."""
    try:
        yield
    except usb.core.USBError as error:
        raise usb_failure(label, error.errno, error.strerror or str(error), endpoint, timeout_s) from None
    except (ValueError, NotImplementedError) as error:  # no such endpoint or setting; a call libusb cannot do here
        raise ProtocolError(f"{label}: {error}; check the device's firmware") from None


def usb_failure(
    label: str, number: int | None, text: str, endpoint: int | None = None, timeout_s: float | None = None
) -> DeviceError:
    """The error of ours for an errno of libusb's, None where it has none; `text` is libusb's own."""
    where = "" if endpoint is None else f" on endpoint 0x{endpoint:02x}"
    if number == errno.ETIMEDOUT:
        return DeviceTimeout(f"{label}: nothing{where} within {timeout_s or 0:g} s")
    if number in _LOST:
        return DeviceDisconnected(f"{label}: the device is gone ({text}); check cable and power, open again")
    if number == errno.EACCES:
        return DevicePermission(no_permission(label))
    if number == errno.EBUSY:
        return DeviceBusy(f"{label}: another program holds it; end that program")
    if number == errno.EPIPE:
        return DeviceFault(f"{label}: the device refused the transfer{where} (stall)")
    if number == errno.EOVERFLOW:
        return ProtocolError(f"{label}: more bytes than asked for{where}; check the firmware")
    if number == errno.ENOMEM:
        return DeviceError(f"{label}: the kernel's USB memory is used up; run: {USBFS_HINT}")
    return DeviceError(f"{label}: USB error{where}: {text}")
