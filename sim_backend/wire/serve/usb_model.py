"""An emulated USB device, whatever transport serves it: descriptors, answers, and the rules of the bus.

A device model is a pure state machine: the transport tells it the time and what the host did, and it answers. It has no
thread and never waits. `AttachedDevice` puts the bus around it: claims, settings, packets, stalls, unplugging.
`DeviceSpec` gives its descriptors (endpoints, alternate settings, strings) as bytes (USB 2.0 chapter 9.6).
"""

import errno
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal, NoReturn

import usb.core

Speed = Literal["full", "high", "super"]

DEVICE, CONFIGURATION, STRING = 1, 2, 3
"""Types of descriptors that a host asks for."""
_INTERFACE, _ENDPOINT, _COMPANION = 4, 5, 0x30
_LANGUAGE_EN_US = 0x0409
DEVICE_FORM, CONFIGURATION_FORM, INTERFACE_FORM, ENDPOINT_FORM = "<BBHBBBBHHHBBBB", "<BBHBBBBB", "<9B", "<BBBBHB"
"""Layouts of the descriptors, as `struct` takes them."""


@dataclass(frozen=True, slots=True)
class EndpointSpec:
    """An endpoint. Bit 7 of the address is set for IN."""

    address: int
    kind: Literal["bulk", "interrupt"]
    packet_bytes: int
    interval: int = 0

    def descriptor(self) -> bytes:
        """The endpoint descriptor: 7 bytes, USB 2.0 table 9-13."""
        kind = 2 if self.kind == "bulk" else 3
        return struct.pack(ENDPOINT_FORM, 7, _ENDPOINT, self.address, kind, self.packet_bytes, self.interval)


@dataclass(frozen=True, slots=True)
class AlternateSpec:
    """One alternate setting of an interface of vendor-specific class."""

    interface: int
    alternate: int
    endpoints: tuple[EndpointSpec, ...] = ()

    def descriptor(self) -> bytes:
        """The interface descriptor: 9 bytes, USB 2.0 table 9-12."""
        head = 9, _INTERFACE, self.interface, self.alternate, len(self.endpoints)
        return struct.pack(INTERFACE_FORM, *head, 0xFF, 0xFF, 0xFF, 0)


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """Contents of the descriptors: one configuration, numbered 1."""

    vendor: int
    product: int
    manufacturer: str
    product_name: str
    serial: str | None
    speed: Speed
    alternates: tuple[AlternateSpec, ...]
    release: int = 0x0100
    max_power_ma: int = 100

    @property
    def strings(self) -> tuple[str, ...]:
        """The strings, from index 1 on."""
        return (self.manufacturer, self.product_name) + ((self.serial,) if self.serial is not None else ())

    def device_descriptor(self) -> bytes:
        """The device descriptor: 18 bytes, USB 2.0 table 9-8."""
        usb = {"full": 0x0110, "high": 0x0200, "super": 0x0300}[self.speed]
        packet = 9 if self.speed == "super" else 64  # USB 3: an exponent
        serial = 3 if self.serial is not None else 0
        return struct.pack(
            DEVICE_FORM,
            *(18, DEVICE, usb, 0, 0, 0, packet),
            *(self.vendor, self.product, self.release, 1, 2, serial, 1),
        )

    def configuration_descriptor(self) -> bytes:
        """The whole configuration: header, interfaces, endpoints (with companions on SuperSpeed)."""
        companion = bytes((6, _COMPANION, 15, 0, 0, 0)) if self.speed == "super" else b""
        body = b""
        for one in self.alternates:
            body += one.descriptor() + b"".join(end.descriptor() + companion for end in one.endpoints)
        interfaces = len({one.interface for one in self.alternates})
        power = self.max_power_ma // (8 if self.speed == "super" else 2)  # USB 3 counts in 8 mA
        return struct.pack(CONFIGURATION_FORM, 9, CONFIGURATION, 9 + len(body), interfaces, 1, 0, 0x80, power) + body

    def string_descriptor(self, index: int) -> bytes | None:
        """The string descriptor of an index. Index 0 lists the languages; None if there is no such string."""
        if index == 0:
            return struct.pack("<BBH", 4, STRING, _LANGUAGE_EN_US)
        if index > len(self.strings):
            return None
        text = self.strings[index - 1].encode("utf-16-le")
        return bytes((2 + len(text), STRING)) + text


_GET_STATUS, _CLEAR_FEATURE, _GET_DESCRIPTOR, _GET_CONFIGURATION, _GET_INTERFACE = 0, 1, 6, 8, 10
_TO_ENDPOINT, _ENDPOINT_HALT = 0x02, 0


class Stall(Enum):
    """The answer 'refused' (EPIPE at the host). A bulk or interrupt endpoint stays halted until it is cleared."""

    STALL = "stall"


STALL: Final = Stall.STALL

Answer = bytes | memoryview | Stall | None
"""Bytes that arrived; `STALL`; None: not ready, ask again later (NAK)."""


_LIBUSB = {
    errno.EACCES: (-3, "Access denied (insufficient permissions)"),
    errno.ENODEV: (-4, "No such device (it may have been disconnected)"),
    errno.ENOENT: (-5, "Entity not found"),
    errno.EBUSY: (-6, "Resource busy"),
    errno.EOVERFLOW: (-8, "Overflow"),
    errno.EPIPE: (-9, "Pipe error"),
}
"""libusb's code and text for an errno, as `libusb_strerror` gives them."""


class UsbFailure(usb.core.USBError):  # type: ignore[misc] # pyusb carries no types
    """A transfer or request that fails at the host, as pyusb raises it; `number` is the errno."""

    def __init__(self, number: int) -> None:
        code, text = _LIBUSB.get(number, (-99, "Other error"))
        super().__init__(text, code, number)
        self.number = number


@dataclass(frozen=True, slots=True)
class Setup:
    """The eight bytes that open a control transfer."""

    request_type: int
    request: int
    value: int
    index: int
    length: int


class UsbModel:
    """Base of device models. By itself it refuses every transfer. Times are seconds of the transport's clock and never
    decrease."""

    spec: DeviceSpec
    gone: bool = False
    """Whether the device cut its own connection: the transport unplugs it at the next call."""

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Note that the host chose an alternate setting. It returns to 0 if the host releases the interface or dies."""

    def halt_cleared(self, endpoint: int, now_s: float) -> None:
        """Note that the host cleared a halt, which it may do without any halt before (USB 2.0, 9.4.5)."""

    def configured(self, now_s: float) -> None:
        """Note that the host chose the configuration: by SET_CONFIGURATION, or after a reset of the port."""

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        """Answer a class or vendor request: the reply for IN, b"" ('taken') for OUT, None while not ready, or STALL."""
        return STALL

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """Take one complete OUT transfer.

        Returns the number of bytes taken (the rest is offered again until the host's timeout), None for not ready
        (NAK), or STALL to refuse it, as here.
        """
        return STALL

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Data for an IN transfer, at most `length` (whole packets). A short or empty answer ends the transfer."""
        return STALL

    def unplugged(self, now_s: float) -> None:
        """Note that the cable was pulled and the bus power is gone."""


class AttachedDevice:
    """A model on the bus. Enforces the rules of a kernel and a host controller. Thread-safe.

    All errors are `UsbFailure`, named here by their errno. Any call but `close` may raise ENODEV (the device is
    unplugged), any transfer EPIPE (refused, or its endpoint is halted), `out` and `inp` also ENOENT (not claimed).
    """

    def __init__(self, model: UsbModel, bus: int, port: int, now: Callable[[], float]) -> None:
        self.model = model
        self.spec = model.spec
        self.bus = bus
        self.port = port
        self.address = port + 1
        self.present = True
        self.denied = False
        """Whether this user may not open it (EACCES)."""
        self.configuration = 1
        self.lock = threading.RLock()
        """Held around every call of the model; hold it to read the model's attributes."""
        self._now = now
        self._claims: dict[int, object] = {}
        self._alternates: dict[int, int] = {}
        self._halted: set[int] = set()

    def unplug(self) -> None:
        """Pull the cable: every call but `close` fails with ENODEV from now on."""
        with self.lock:
            if self.present:
                self.present = False
                self._claims.clear()
                self.model.unplugged(self._now())

    def open(self) -> None:
        """Open the device. Raises EACCES if this user may not."""
        with self._alive():
            if self.denied:
                raise UsbFailure(errno.EACCES)

    def close(self, owner: object) -> None:
        """Handle a host that closed its handle or died: its interfaces are released and go back to alternate 0."""
        with self.lock:
            for interface in [number for number, holder in self._claims.items() if holder is owner]:
                self._give_back(interface)

    def set_configuration(self, value: int) -> None:
        """Choose a configuration: 1, or 0 for none. Raises EBUSY while an interface is claimed, ENOENT for any other
        configuration."""
        with self._alive():
            if self._claims:
                raise UsbFailure(errno.EBUSY)
            if value not in (0, 1):
                raise UsbFailure(errno.ENOENT)
            self.configuration = value
            self._alternates.clear()
            self._halted.clear()
            self.model.configured(self._now())

    def reset(self) -> None:
        """Reset the port: the host then chooses the configuration again. Claims stay, since libusb renews them."""
        with self._alive():
            self.configuration = 1
            self._alternates.clear()
            self._halted.clear()
            self.model.configured(self._now())

    def claim(self, interface: int, owner: object) -> None:
        """Claim an interface. Raises EBUSY if another owner holds it, ENOENT for an unknown one."""
        with self._alive():
            if all(one.interface != interface for one in self.spec.alternates):
                raise UsbFailure(errno.ENOENT)
            if self._claims.get(interface, owner) is not owner:
                raise UsbFailure(errno.EBUSY)
            self._claims[interface] = owner

    def release(self, interface: int, owner: object) -> None:
        """Release an interface; it returns to alternate setting 0, as on Linux. Raises ENOENT if it is not claimed."""
        with self._alive():
            self._require_claim(interface, owner)
            self._give_back(interface)

    def set_alternate(self, interface: int, alternate: int, owner: object) -> None:
        """Choose an alternate setting. Raises ENOENT for an unknown one or an interface that is not claimed."""
        with self._alive():
            self._require_claim(interface, owner)
            if all((one.interface, one.alternate) != (interface, alternate) for one in self.spec.alternates):
                raise UsbFailure(errno.ENOENT)
            self._alternates[interface] = alternate
            self._halted.clear()
            self.model.set_interface(interface, alternate, self._now())

    def clear_halt(self, endpoint: int) -> None:
        """End a stall."""
        with self._alive():
            self._halted.discard(endpoint)
            self.model.halt_cleared(endpoint, self._now())

    def control(self, setup: Setup, data: bytes) -> bytes | None:
        """Make a control transfer. Returns the reply (b"" for OUT), or None while the device is not ready."""
        with self._alive():
            if setup.request_type & 0x60 == 0:
                answer = self._standard(setup)
            else:
                answer = self.model.control(setup, data, self._now())
            self._require_plugged()
            if isinstance(answer, Stall):
                raise UsbFailure(errno.EPIPE)
            return None if answer is None else bytes(answer[: setup.length])

    def out(self, endpoint: int, data: bytes, owner: object) -> int:
        """Offer bytes to an OUT endpoint; returns the number that the device takes now."""
        with self._alive():
            self._usable(endpoint, owner)
            taken = self.model.out(endpoint, data, self._now())
            self._require_plugged()
            if isinstance(taken, Stall):
                self._halt(endpoint)
            return taken or 0

    def inp(self, endpoint: int, room: int, owner: object) -> bytes | memoryview | None:
        """Data that the device has now, or None. Raises EOVERFLOW if there is more data than room."""
        with self._alive():
            packet = self._usable(endpoint, owner).packet_bytes
            answer = self.model.inp(endpoint, -(-room // packet) * packet, self._now())
            self._require_plugged()
            if isinstance(answer, Stall):
                self._halt(endpoint)
            if answer is not None and len(answer) > room:
                raise UsbFailure(errno.EOVERFLOW)
            return answer

    def ends_transfer(self, endpoint: int, received: int) -> bool:
        """Whether an IN transfer ends after that many bytes, because the last packet was short."""
        return received % self._endpoint(endpoint)[1].packet_bytes != 0 or received == 0

    @contextmanager
    def _alive(self) -> Iterator[None]:
        """Hold the lock. Raises ENODEV if the device is no longer there."""
        with self.lock:
            self._require_plugged()
            yield

    def _require_plugged(self) -> None:
        if self.model.gone:
            self.unplug()
        if not self.present:
            raise UsbFailure(errno.ENODEV)

    def _require_claim(self, interface: int, owner: object) -> None:
        if self._claims.get(interface) is not owner:
            raise UsbFailure(errno.ENOENT)

    def _give_back(self, interface: int) -> None:
        del self._claims[interface]
        if self._alternates.pop(interface, 0):
            self.model.set_interface(interface, 0, self._now())

    def _halt(self, endpoint: int) -> NoReturn:
        self._halted.add(endpoint)
        raise UsbFailure(errno.EPIPE)

    def _usable(self, endpoint: int, owner: object) -> EndpointSpec:
        interface, end = self._endpoint(endpoint)
        self._require_claim(interface, owner)
        if endpoint in self._halted:
            raise UsbFailure(errno.EPIPE)
        return end

    def _endpoint(self, address: int) -> tuple[int, EndpointSpec]:
        """Interface and spec of an endpoint in the present alternate settings. Raises ENOENT for an unknown one."""
        for one in self.spec.alternates:
            for end in one.endpoints if one.alternate == self._alternates.get(one.interface, 0) else ():
                if end.address == address:
                    return one.interface, end
        raise UsbFailure(errno.ENOENT)

    def _standard(self, setup: Setup) -> Answer:
        """The requests of USB 2.0 chapter 9 that a host sends outside of enumeration."""
        if setup.request == _GET_DESCRIPTOR:
            return self._descriptor(setup.value >> 8, setup.value & 0xFF)
        if setup.request == _CLEAR_FEATURE and setup.request_type == _TO_ENDPOINT and setup.value == _ENDPOINT_HALT:
            self.clear_halt(setup.index)
            return b""
        if setup.request == _GET_STATUS:
            return b"\0\0"
        if setup.request == _GET_CONFIGURATION:
            return bytes((self.configuration,))
        if setup.request == _GET_INTERFACE:
            return bytes((self._alternates.get(setup.index, 0),))
        return STALL

    def _descriptor(self, kind: int, index: int) -> Answer:
        if kind == DEVICE:
            return self.spec.device_descriptor()
        if kind == CONFIGURATION:
            return self.spec.configuration_descriptor()
        if kind == STRING:
            text = self.spec.string_descriptor(index)
            return STALL if text is None else text
        return STALL
