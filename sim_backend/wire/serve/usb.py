"""Emulated USB devices for real pyusb, in this process: a `usb.backend.IBackend` without libusb and without a kernel.

    bus = EmulatedUsb(SystemClock())
    device = bus.plug(HeliosModel())
    usb.core.find(backend=bus, idVendor=0x1209)     # or open_device(..., backend=bus)

This is the fastest and most portable way to run a driver. libusb's queued (asynchronous) reads and the kernel's part
are not exercised. `usb_model` has the base of device models and the errors, which are pyusb's own.
"""

import errno
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from drivers.clock import Clock, now_s
from sim_backend.wire.serve.usb_model import (
    CONFIGURATION_FORM,
    DEVICE_FORM,
    ENDPOINT_FORM,
    INTERFACE_FORM,
    AlternateSpec,
    AttachedDevice,
    Setup,
    UsbModel,
)

FIRST_POLL_S, LONGEST_POLL_S = 250e-6, 1e-3
"""A transfer for which the device is not ready is tried again after the first of these times, then after twice as long
each time, up to the second."""

_BUS = 1
_SPEED = {"full": 2, "high": 3, "super": 4}

_DEVICE_FIELDS = (
    "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor idProduct "
    "bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
)
_CONFIGURATION_FIELDS = (
    "bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue iConfiguration bmAttributes bMaxPower"
)
_INTERFACE_FIELDS = (
    "bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass bInterfaceSubClass "
    "bInterfaceProtocol iInterface"
)
_ENDPOINT_FIELDS = "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"
"""Names of the descriptors' fields, as pyusb reads them (USB 2.0, tables 9-8, 9-10, 9-12 and 9-13)."""


@dataclass(eq=False)
class _Handle:
    device: AttachedDevice


class EmulatedUsb(usb.backend.IBackend):  # type: ignore[misc] # pyusb carries no types
    """A bus. `plug` may be called at any time from any thread. Waiting uses the clock that is passed in.

    A transfer returns the number of bytes that passed. It raises USBTimeoutError if its timeout ended before any did,
    and ValueError for a timeout of 0 ms.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._devices: list[AttachedDevice] = []

    def plug(self, model: UsbModel) -> AttachedDevice:
        """Attach a model at the next free port. Plugging in again gives a new address, as on a real bus."""
        with self._lock:
            device = AttachedDevice(model, _BUS, len(self._devices) + 1, partial(now_s, self._clock))
            self._devices.append(device)
            return device

    # Called by pyusb, with its names and arguments. Transfers return the number of bytes that passed in time.

    def enumerate_devices(self) -> Iterator[AttachedDevice]:
        """The devices on the bus."""
        with self._lock:
            return iter([one for one in self._devices if one.present])

    def get_device_descriptor(self, dev: AttachedDevice) -> SimpleNamespace:
        """The device descriptor, with the device's bus, port and address."""
        place = {"address": dev.address, "bus": dev.bus, "port_number": dev.port, "port_numbers": (dev.port,)}
        descriptor = dev.spec.device_descriptor()
        return _named(_DEVICE_FIELDS, DEVICE_FORM, descriptor, **place, speed=_SPEED[dev.spec.speed])

    def get_configuration_descriptor(self, dev: AttachedDevice, config: int) -> SimpleNamespace:
        """The descriptor of the only configuration, which has index 0; IndexError for any other index."""
        if config != 0:
            raise IndexError(f"no configuration index {config}")
        descriptor = dev.spec.configuration_descriptor()
        return _named(_CONFIGURATION_FIELDS, CONFIGURATION_FORM, descriptor, extra_descriptors=[])

    def get_interface_descriptor(self, dev: AttachedDevice, intf: int, alt: int, config: int) -> SimpleNamespace:
        """The interface descriptor by index; IndexError past the end."""
        descriptor = _alternate(dev, intf, alt).descriptor()
        return _named(_INTERFACE_FIELDS, INTERFACE_FORM, descriptor, extra_descriptors=[])

    def get_endpoint_descriptor(
        self, dev: AttachedDevice, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """The endpoint descriptor by index; IndexError past the end."""
        descriptor = _alternate(dev, intf, alt).endpoints[ep].descriptor()
        return _named(_ENDPOINT_FIELDS, ENDPOINT_FORM, descriptor, bRefresh=0, bSynchAddress=0, extra_descriptors=[])

    def open_device(self, dev: AttachedDevice) -> _Handle:
        """A handle of the opened device."""
        dev.open()
        return _Handle(dev)

    def close_device(self, dev_handle: _Handle) -> None:
        """Close the device and release the interfaces that were claimed."""
        dev_handle.device.close(dev_handle)

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        """Set configuration 0 or 1."""
        dev_handle.device.set_configuration(config_value)

    def get_configuration(self, dev_handle: _Handle) -> int:
        """Number of the present configuration."""
        return dev_handle.device.configuration

    def set_interface_altsetting(self, dev_handle: _Handle, intf: int, altsetting: int) -> None:
        """Choose an alternate setting of a claimed interface."""
        dev_handle.device.set_alternate(intf, altsetting, dev_handle)

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Claim an interface for this handle."""
        dev_handle.device.claim(intf, dev_handle)

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Release an interface that this handle claimed."""
        dev_handle.device.release(intf, dev_handle)

    def bulk_write(self, dev_handle: _Handle, ep: int, intf: int, data: Any, timeout: int) -> int:
        """Send to a bulk endpoint."""
        payload, sent = bytes(data), 0
        for _ in self._until(timeout):
            sent += dev_handle.device.out(ep, payload[sent:], dev_handle)
            if sent == len(payload):
                return sent
        return _or_timeout(sent)

    def bulk_read(self, dev_handle: _Handle, ep: int, intf: int, buff: Any, timeout: int) -> int:
        """Read from a bulk endpoint."""
        view, got = memoryview(buff).cast("B"), 0
        for _ in self._until(timeout):
            while (data := dev_handle.device.inp(ep, len(view) - got, dev_handle)) is not None:
                view[got : got + len(data)] = data
                got += len(data)
                if got == len(view) or dev_handle.device.ends_transfer(ep, len(data)):
                    return got
        return _or_timeout(got)

    intr_write, intr_read = bulk_write, bulk_read

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
        """Make a control transfer."""
        view = memoryview(data).cast("B")
        setup = Setup(bmRequestType, bRequest, wValue, wIndex, len(view))
        host_to_device = not bmRequestType & 0x80
        for _ in self._until(timeout):
            reply = dev_handle.device.control(setup, bytes(view) if host_to_device else b"")
            if reply is not None:
                if host_to_device:
                    return len(view)
                view[: len(reply)] = reply
                return len(reply)
        return _or_timeout(0)

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        """End a stall."""
        dev_handle.device.clear_halt(ep)

    def reset_device(self, dev_handle: _Handle) -> None:
        """Reset the device's port."""
        dev_handle.device.reset()

    def _until(self, timeout_ms: int) -> Iterator[None]:
        """Yield for each attempt until the timeout is over, at least once. Raises ValueError for a timeout of 0."""
        if timeout_ms <= 0:
            raise ValueError("a timeout of 0 waits for ever in libusb; give the transfer a deadline")
        end_s, poll_s = now_s(self._clock) + timeout_ms / 1000, FIRST_POLL_S
        yield
        while now_s(self._clock) < end_s:
            self._clock.sleep(poll_s)
            poll_s = min(2 * poll_s, LONGEST_POLL_S)
            yield


def _alternate(dev: AttachedDevice, interface: int, index: int) -> AlternateSpec:
    numbers = sorted({one.interface for one in dev.spec.alternates})
    return [one for one in dev.spec.alternates if one.interface == numbers[interface]][index]


def _named(fields: str, form: str, descriptor: bytes, **more: object) -> SimpleNamespace:
    """A descriptor as pyusb takes it: an object with one attribute for each field."""
    return SimpleNamespace(**dict(zip(fields.split(), struct.unpack_from(form, descriptor), strict=True)), **more)


def _or_timeout(passed: int) -> int:
    """The bytes that passed within the time. Raises USBTimeoutError if none did."""
    if passed == 0:
        raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
    return passed
