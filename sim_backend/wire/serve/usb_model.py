"""An emulated USB device, whatever transport serves it: descriptors, answers, and the rules of the bus.

A device model is a pure state machine: the transport tells it what the host did and the time, and it answers. It has no
thread and never waits. `AttachedDevice` puts the bus around it: claims, settings, packets, stalls, unplugging.
`DeviceSpec` gives its descriptors (endpoints, alternate settings, strings) as bytes (USB 2.0 chapter 9.6).
"""

import errno
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

Speed = Literal["full", "high", "super"]

SPEED_MBIT: Final = {"full": 12, "high": 480, "super": 5000}
"""Speeds in Mbit/s, as in the file `speed` of /sys/bus/usb/devices."""

DEVICE, CONFIGURATION, STRING = 1, 2, 3
"""Types of descriptors that a host asks for."""
_INTERFACE, _ENDPOINT, _COMPANION = 4, 5, 0x30
_LANGUAGE_EN_US = 0x0409


@dataclass(frozen=True, slots=True)
class EndpointSpec:
    """An endpoint; bit 7 of the address set = IN."""

    address: int
    kind: Literal["bulk", "interrupt"]
    packet_bytes: int
    interval: int = 0


@dataclass(frozen=True, slots=True)
class AlternateSpec:
    """One alternate setting of an interface, vendor-specific class."""

    interface: int
    alternate: int
    endpoints: tuple[EndpointSpec, ...] = ()


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
        """Strings from index 1 on."""
        return (self.manufacturer, self.product_name) + ((self.serial,) if self.serial is not None else ())

    def device_descriptor(self) -> bytes:
        """18 bytes, USB 2.0 table 9-8."""
        usb = {"full": 0x0110, "high": 0x0200, "super": 0x0300}[self.speed]
        packet = 9 if self.speed == "super" else 64  # USB 3: an exponent
        serial = 3 if self.serial is not None else 0
        return struct.pack(
            "<BBHBBBBHHHBBBB",
            *(18, DEVICE, usb, 0, 0, 0, packet),
            *(self.vendor, self.product, self.release, 1, 2, serial, 1),
        )

    def configuration_descriptor(self) -> bytes:
        """The whole configuration: header, interfaces, endpoints (with companions on SuperSpeed)."""
        body = b"".join(self._alternate(one) for one in self.alternates)
        interfaces = len({one.interface for one in self.alternates})
        power = self.max_power_ma // (8 if self.speed == "super" else 2)  # USB 3 counts in 8 mA
        return struct.pack("<BBHBBBBB", 9, CONFIGURATION, 9 + len(body), interfaces, 1, 0, 0x80, power) + body

    def _alternate(self, one: AlternateSpec) -> bytes:
        head = struct.pack("<9B", 9, _INTERFACE, one.interface, one.alternate, len(one.endpoints), 0xFF, 0xFF, 0xFF, 0)
        return head + b"".join(self._endpoint(end) for end in one.endpoints)

    def _endpoint(self, end: EndpointSpec) -> bytes:
        kind = 2 if end.kind == "bulk" else 3
        text = struct.pack("<BBBBHB", 7, _ENDPOINT, end.address, kind, end.packet_bytes, end.interval)
        return text + (bytes((6, _COMPANION, 15, 0, 0, 0)) if self.speed == "super" else b"")

    def string_descriptor(self, index: int) -> bytes | None:
        """Index 0 lists the languages; None where there is no such string."""
        if index == 0:
            return struct.pack("<BBH", 4, STRING, _LANGUAGE_EN_US)
        if index > len(self.strings):
            return None
        text = self.strings[index - 1].encode("utf-16-le")
        return bytes((2 + len(text), STRING)) + text


_GET_STATUS, _GET_DESCRIPTOR, _GET_CONFIGURATION, _GET_INTERFACE = 0, 6, 8, 10


class Stall(Enum):
    """The answer 'refused' (EPIPE at the host); a bulk or interrupt endpoint stays halted until it is cleared."""

    STALL = "stall"


STALL: Final = Stall.STALL

Answer = bytes | memoryview | Stall | None
"""Bytes that arrived; `STALL`; None: not ready, ask again later (NAK)."""


class UsbFailure(Exception):  # noqa: N818 - it is what libusb calls a failure, with its number
    """A transfer or request that fails at the host; `number` is the errno."""

    def __init__(self, number: int) -> None:
        super().__init__(errno.errorcode[number])
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
    """Base of device models: refuses every transfer. Times are seconds of the transport's clock, never decreasing."""

    spec: DeviceSpec
    gone: bool = False
    """Whether the device cut its own connection: the transport unplugs it at the next call."""

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Take note that the host chose an alternate setting; 0 also when it released the interface or died."""

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        """A class or vendor request. IN: the reply; OUT: b"" is 'taken'. None: not ready."""
        return STALL

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """One OUT transfer, whole; its last packet is short unless the length is a multiple of the packet size.

        Returns the bytes taken (fewer: the rest is offered again, until the host's timeout); None: not ready (NAK).
        """
        return STALL

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Data for an IN transfer, at most `length` (whole packets). A short or empty answer ends the transfer."""
        return STALL

    def unplugged(self, now_s: float) -> None:
        """The cable is out: bus power is gone."""


class AttachedDevice:
    """A model on the bus. Enforces what a kernel and a host controller enforce. Thread-safe."""

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
        self._now = now
        self._lock = threading.RLock()
        self._claims: dict[int, object] = {}
        self._alternates: dict[int, int] = {}
        self._halted: set[int] = set()

    @property
    def lock(self) -> threading.RLock:
        """Held around every call of the model; hold it to look at it."""
        return self._lock

    def unplug(self) -> None:
        """Pull the cable: every call fails with ENODEV from now on."""
        with self._lock:
            if self.present:
                self.present = False
                self._claims.clear()
                self.model.unplugged(self._now())

    def open(self) -> None:
        """Open the device. EACCES where this user may not."""
        with self._lock:
            self._alive()
            if self.denied:
                raise UsbFailure(errno.EACCES)

    def close(self, owner: object) -> None:
        """Deal with a host that closed its handle or died: interfaces fall free and back to alternate 0."""
        with self._lock:
            for interface in [number for number, holder in self._claims.items() if holder is owner]:
                self._give_back(interface)

    def set_configuration(self, value: int) -> None:
        """Choose a configuration. EBUSY while an interface is claimed, ENOENT for an unknown one."""
        with self._lock:
            self._alive()
            if self._claims:
                raise UsbFailure(errno.EBUSY)
            if value not in (0, 1):
                raise UsbFailure(errno.ENOENT)
            self.configuration = value
            self._alternates.clear()
            self._halted.clear()

    def claim(self, interface: int, owner: object) -> None:
        """Claim an interface. EBUSY where another holds it."""
        with self._lock:
            self._alive()
            if all(one.interface != interface for one in self.spec.alternates):
                raise UsbFailure(errno.ENOENT)
            if self._claims.get(interface, owner) is not owner:
                raise UsbFailure(errno.EBUSY)
            self._claims[interface] = owner

    def release(self, interface: int, owner: object) -> None:
        """Give an interface back. As Linux does, the device returns to alternate setting 0."""
        with self._lock:
            self._alive()
            if self._claims.get(interface) is not owner:
                raise UsbFailure(errno.ENOENT)
            self._give_back(interface)

    def _give_back(self, interface: int) -> None:
        del self._claims[interface]
        if self._alternates.pop(interface, 0):
            self.model.set_interface(interface, 0, self._now())

    def set_alternate(self, interface: int, alternate: int, owner: object) -> None:
        """Choose an alternate setting. ENOENT for an unknown one or an interface that is not claimed."""
        with self._lock:
            self._alive()
            if self._claims.get(interface) is not owner or self._setting(interface, alternate) is None:
                raise UsbFailure(errno.ENOENT)
            self._alternates[interface] = alternate
            self._halted.clear()
            self.model.set_interface(interface, alternate, self._now())

    def clear_halt(self, endpoint: int) -> None:
        """End a stall."""
        with self._lock:
            self._alive()
            self._halted.discard(endpoint)

    def control(self, setup: Setup, data: bytes) -> bytes | None:
        """A control transfer: the reply (b"" for OUT), or None while the device is not ready."""
        with self._lock:
            self._alive()
            if setup.request_type & 0x60 == 0:
                answer = self._standard(setup)
            else:
                answer = self.model.control(setup, data, self._now())
            self._alive()
            if answer is None:
                return None
            if isinstance(answer, Stall):
                raise UsbFailure(errno.EPIPE)
            return bytes(answer[: setup.length])

    def out(self, endpoint: int, data: bytes, owner: object) -> int:
        """Bytes that the device takes now."""
        with self._lock:
            self._usable(endpoint, owner)
            taken = self.model.out(endpoint, data, self._now())
            self._alive()
            if isinstance(taken, Stall):
                self._halted.add(endpoint)
                raise UsbFailure(errno.EPIPE)
            return taken or 0

    def inp(self, endpoint: int, room: int, owner: object) -> bytes | memoryview | None:
        """Data that the device has now, or None. EOVERFLOW where its packet is larger than the room left."""
        with self._lock:
            packet = self._usable(endpoint, owner).packet_bytes
            answer = self.model.inp(endpoint, -(-room // packet) * packet, self._now())
            self._alive()
            if isinstance(answer, Stall):
                self._halted.add(endpoint)
                raise UsbFailure(errno.EPIPE)
            if answer is not None and len(answer) > room:
                raise UsbFailure(errno.EOVERFLOW)
            return answer

    def ends_transfer(self, endpoint: int, received: int) -> bool:
        """Whether an IN transfer ends after a burst of that many bytes: the last packet was short."""
        return received % self._endpoint(endpoint).packet_bytes != 0 or received == 0

    def _usable(self, endpoint: int, owner: object) -> EndpointSpec:
        self._alive()
        end = self._endpoint(endpoint)
        interface = next(one.interface for one in self._current() if end in one.endpoints)
        if self._claims.get(interface) is not owner:
            raise UsbFailure(errno.ENOENT)
        if endpoint in self._halted:
            raise UsbFailure(errno.EPIPE)
        return end

    def _endpoint(self, address: int) -> EndpointSpec:
        for one in self._current():
            for end in one.endpoints:
                if end.address == address:
                    return end
        raise UsbFailure(errno.ENOENT)

    def _current(self) -> list[AlternateSpec]:
        return [one for one in self.spec.alternates if one.alternate == self._alternates.get(one.interface, 0)]

    def _setting(self, interface: int, alternate: int) -> AlternateSpec | None:
        matches = (one for one in self.spec.alternates if (one.interface, one.alternate) == (interface, alternate))
        return next(matches, None)

    def _alive(self) -> None:
        if self.model.gone:
            self.unplug()
        if not self.present:
            raise UsbFailure(errno.ENODEV)

    def _standard(self, setup: Setup) -> Answer:
        """The requests of USB 2.0 chapter 9 that a host sends outside of enumeration."""
        if setup.request == _GET_DESCRIPTOR:
            return self._descriptor(setup.value >> 8, setup.value & 0xFF)
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
