"""What a USB device says of itself: endpoints, alternate settings, strings, as bytes (USB 2.0 chapter 9.6)."""

import struct
from dataclasses import dataclass
from typing import Final, Literal

Speed = Literal["full", "high", "super"]

SPEED_MBIT: Final = {"full": 12, "high": 480, "super": 5000}
"""As the file `speed` of /sys/bus/usb/devices says it."""

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
    """What the descriptors say: one configuration, numbered 1."""

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
