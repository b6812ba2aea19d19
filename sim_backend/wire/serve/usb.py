"""Emulated USB devices for real pyusb, in this process: a `usb.backend.IBackend` without libusb and without a kernel.

    bus = EmulatedUsb(SystemClock())
    device = bus.plug(HeliosModel())
    usb.core.find(backend=bus, idVendor=0x1209)     # or open_device(..., backend=bus)

The fastest and most portable way to run a driver; what it leaves out is libusb (no transfers in flight) and the kernel.
Errors are the triples that pyusb makes of libusb's: class, errno, libusb code. The model protocol is in `usb_model`.
"""

import errno
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from drivers.clock import NS_PER_S, Clock
from sim_backend.wire.serve.usb_model import AlternateSpec, AttachedDevice, Setup, UsbFailure, UsbModel

FIRST_POLL_S, LONGEST_POLL_S = 250e-6, 1e-3
"""Waits until a transfer that the device is not ready for asks again: each twice as long, from the first up to the
second."""

_LIBUSB = {
    errno.EIO: (-1, "Input/Output Error"),
    errno.EACCES: (-3, "Access denied (insufficient permissions)"),
    errno.ENODEV: (-4, "No such device (it may have been disconnected)"),
    errno.ENOENT: (-5, "Entity not found"),
    errno.EBUSY: (-6, "Resource busy"),
    errno.ETIMEDOUT: (-7, "Operation timed out"),
    errno.EOVERFLOW: (-8, "Overflow"),
    errno.EPIPE: (-9, "Pipe error"),
    errno.ENOMEM: (-11, "Insufficient memory"),
}
"""libusb's code and text for an errno, as `libusb_strerror` gives them."""

_BUS = 1
_SPEED = {"full": 2, "high": 3, "super": 4}


@dataclass(eq=False)
class _Handle:
    device: AttachedDevice


class EmulatedUsb(usb.backend.IBackend):  # type: ignore[misc] # pyusb carries no types
    """A bus. `plug` and `unplug` at any time, from any thread. Waiting goes through the clock."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._devices: list[AttachedDevice] = []
        self._ports = 0

    def plug(self, model: UsbModel) -> AttachedDevice:
        """Attach a model at the next free port; plugging in again gives a new address, as on a real bus."""
        with self._lock:
            self._ports += 1
            device = AttachedDevice(model, _BUS, self._ports, self._now_s)
            self._devices.append(device)
            return device

    def unplug(self, device: AttachedDevice) -> None:
        """Pull the cable."""
        with self._lock:
            self._devices = [one for one in self._devices if one is not device]
        device.unplug()

    def _now_s(self) -> float:
        return self._clock.now_ns() / NS_PER_S

    # What pyusb calls. Names and arguments are pyusb's.

    def enumerate_devices(self) -> Iterator[AttachedDevice]:
        """The devices on the bus."""
        with self._lock:
            return iter(list(self._devices))

    def get_parent(self, dev: AttachedDevice) -> None:
        """None: all devices hang on the root."""
        return None

    def get_device_descriptor(self, dev: AttachedDevice) -> SimpleNamespace:
        """The fields pyusb reads."""
        d = dev.spec.device_descriptor()
        return SimpleNamespace(
            bLength=d[0],
            bDescriptorType=d[1],
            bcdUSB=int.from_bytes(d[2:4], "little"),
            bDeviceClass=d[4],
            bDeviceSubClass=d[5],
            bDeviceProtocol=d[6],
            bMaxPacketSize0=d[7],
            idVendor=dev.spec.vendor,
            idProduct=dev.spec.product,
            bcdDevice=dev.spec.release,
            iManufacturer=d[14],
            iProduct=d[15],
            iSerialNumber=d[16],
            bNumConfigurations=d[17],
            address=dev.address,
            bus=dev.bus,
            port_number=dev.port,
            port_numbers=(dev.port,),
            speed=_SPEED[dev.spec.speed],
        )

    def get_configuration_descriptor(self, dev: AttachedDevice, config: int) -> SimpleNamespace:
        """The only configuration."""
        if config != 0:
            raise IndexError(f"no configuration index {config}")
        d = dev.spec.configuration_descriptor()
        return SimpleNamespace(
            bLength=d[0],
            bDescriptorType=d[1],
            wTotalLength=len(d),
            bNumInterfaces=d[4],
            bConfigurationValue=d[5],
            iConfiguration=d[6],
            bmAttributes=d[7],
            bMaxPower=d[8],
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, dev: AttachedDevice, intf: int, alt: int, config: int) -> SimpleNamespace:
        """The interface descriptor by index; IndexError past the end."""
        one = _alternate(dev, intf, alt)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=one.interface,
            bAlternateSetting=one.alternate,
            bNumEndpoints=len(one.endpoints),
            bInterfaceClass=0xFF,
            bInterfaceSubClass=0xFF,
            bInterfaceProtocol=0xFF,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: AttachedDevice, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """The endpoint descriptor by index; IndexError past the end."""
        end = _alternate(dev, intf, alt).endpoints[ep]
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=end.address,
            bmAttributes=2 if end.kind == "bulk" else 3,
            wMaxPacketSize=end.packet_bytes,
            bInterval=end.interval,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev: AttachedDevice) -> _Handle:
        """A handle of the device."""
        with _pyusb_errors():
            dev.open()
        return _Handle(dev)

    def close_device(self, dev_handle: _Handle) -> None:
        """Close the device; the interfaces that were claimed fall free."""
        dev_handle.device.close(dev_handle)

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        """Set configuration 0 or 1."""
        with _pyusb_errors():
            dev_handle.device.set_configuration(config_value)

    def get_configuration(self, dev_handle: _Handle) -> int:
        """Number of the present configuration."""
        return dev_handle.device.configuration

    def set_interface_altsetting(self, dev_handle: _Handle, intf: int, altsetting: int) -> None:
        """Choose an alternate setting of a claimed interface."""
        with _pyusb_errors():
            dev_handle.device.set_alternate(intf, altsetting, dev_handle)

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Claim an interface for this handle."""
        with _pyusb_errors():
            dev_handle.device.claim(intf, dev_handle)

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Release an interface that this handle claimed."""
        with _pyusb_errors():
            dev_handle.device.release(intf, dev_handle)

    def bulk_write(self, dev_handle: _Handle, ep: int, intf: int, data: Any, timeout: int) -> int:
        """Send to a bulk endpoint; returns the number of bytes sent, fewer on a timeout."""
        return self._write(dev_handle, ep, bytes(data), timeout)

    def bulk_read(self, dev_handle: _Handle, ep: int, intf: int, buff: Any, timeout: int) -> int:
        """Read from a bulk endpoint; returns the number of bytes read, fewer on a timeout."""
        return self._read(dev_handle, ep, buff, timeout)

    def intr_write(self, dev_handle: _Handle, ep: int, intf: int, data: Any, timeout: int) -> int:
        """Write to an interrupt endpoint, as to a bulk one."""
        return self._write(dev_handle, ep, bytes(data), timeout)

    def intr_read(self, dev_handle: _Handle, ep: int, intf: int, buff: Any, timeout: int) -> int:
        """Read from an interrupt endpoint, as from a bulk one."""
        return self._read(dev_handle, ep, buff, timeout)

    def ctrl_transfer(
        self,
        dev_handle: _Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        """Make a control transfer; returns the number of bytes of the data stage."""
        view = memoryview(data).cast("B")
        setup = Setup(bmRequestType, bRequest, wValue, wIndex, len(view))
        host_to_device = not bmRequestType & 0x80
        for _ in self._until(timeout):
            with _pyusb_errors():
                reply = dev_handle.device.control(setup, bytes(view) if host_to_device else b"")
            if reply is not None:
                if host_to_device:
                    return len(view)
                view[: len(reply)] = reply
                return len(reply)
        raise _error(errno.ETIMEDOUT)

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        """End a stall."""
        with _pyusb_errors():
            dev_handle.device.clear_halt(ep)

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        """False: vendor-specific interfaces have no kernel driver."""
        return False

    def _write(self, handle: _Handle, endpoint: int, data: bytes, timeout_ms: int) -> int:
        sent = 0
        for _ in self._until(timeout_ms):
            with _pyusb_errors():
                sent += handle.device.out(endpoint, data[sent:], handle)
            if sent == len(data):
                return sent
        if sent:
            return sent
        raise _error(errno.ETIMEDOUT)

    def _read(self, handle: _Handle, endpoint: int, buffer: Any, timeout_ms: int) -> int:
        view = memoryview(buffer).cast("B")
        got = 0
        for _ in self._until(timeout_ms):
            while True:
                with _pyusb_errors():
                    data = handle.device.inp(endpoint, len(view) - got, handle)
                if data is None:
                    break
                view[got : got + len(data)] = data
                got += len(data)
                if got == len(view) or handle.device.ends_transfer(endpoint, len(data)):
                    return got
        if got:
            return got
        raise _error(errno.ETIMEDOUT)

    def _until(self, timeout_ms: int) -> Iterator[None]:
        """Yield now and then until the time is over, at least once."""
        if timeout_ms <= 0:
            raise ValueError("a timeout of 0 waits for ever in libusb; give the transfer a deadline")
        end_s, poll_s = self._now_s() + timeout_ms / 1000, FIRST_POLL_S
        yield
        while self._now_s() < end_s:
            self._clock.sleep(poll_s)
            poll_s = min(2 * poll_s, LONGEST_POLL_S)
            yield


def _alternate(dev: AttachedDevice, interface: int, index: int) -> AlternateSpec:
    numbers = sorted({one.interface for one in dev.spec.alternates})
    return [one for one in dev.spec.alternates if one.interface == numbers[interface]][index]


@contextmanager
def _pyusb_errors() -> Iterator[None]:
    """Turn the bus's failures into pyusb's exceptions."""
    try:
        yield
    except UsbFailure as failure:
        raise _error(failure.number) from None


def _error(number: int) -> Exception:
    code, text = _LIBUSB[number]
    sort = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    error: Exception = sort(text, code, number)
    return error
