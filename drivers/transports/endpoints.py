"""The address of a device: a real one, or one that an emulating world created in this process."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.errors import DeviceNotFound

UDEV_RULES = str(Path(__file__).parents[2] / "config" / "udev" / "70-spadrig.rules")
"""Path of the file that gives devices and ports to group plugdev. Its first lines say how to install it; messages about
permissions name it."""
EMULATED_PREFIX = "emulated:"
"""`port: emulated:laser` in a config means the endpoint that the rig's emulating world calls "laser"."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An address that a transport can open."""

    address: str
    usb_backend: object | None = None
    """The `usb.backend.IBackend` that serves an emulated USB device; None: libusb."""
    serial_port: Callable[[], Any] | None = None
    """Function that opens an emulated serial port: an object like `serial.Serial` that waits on its own `clock`. None:
    pyserial opens the address."""
    tcp_stream: Callable[[], Any] | None = None
    """Function that connects to an emulated program: an object like `TcpStream`. None: a socket to the address."""
    usb_ids: tuple[int, int] | None = None
    """Vendor and product of an emulated serial port's USB device. None: an emulated port has none, and those of a real
    one are looked up."""


def printable(text: str) -> str:
    """Text from a device, for messages and lists. Characters that a terminal cannot show, or would obey, are replaced
    by their escapes."""
    return text if text.isprintable() else "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def one_line(said: object) -> str:
    """The text of another library's error, or of a device, as a single line that a terminal can show (`printable`)."""
    return printable(" ".join(str(said).split()))


def resolve(port: str, ports: Mapping[str, Endpoint]) -> Endpoint:
    """The endpoint that a config's `port` means. ports: those that the emulating world created, by name.

    Raises `DeviceNotFound` for an emulated port that is not among them. A real address is not checked before it is
    opened.
    """
    if not port.startswith(EMULATED_PREFIX):
        return Endpoint(port)
    name = port.removeprefix(EMULATED_PREFIX)
    if name in ports:
        return ports[name]
    if ports:
        raise DeviceNotFound(f"port {port}: no such emulated device; choose one of: {', '.join(sorted(ports))}")
    raise DeviceNotFound(
        f"port {port}: this rig emulates no devices; give a real port, or use a config with an emulating world"
    )
