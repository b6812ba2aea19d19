"""What is attached to this computer, and the laser's way to safety without a scan."""

from dataclasses import asdict, dataclass
from typing import Any

from serial.tools import list_ports

from drivers.errors import DeviceError
from drivers.helios_link import HELIOS
from drivers.lasercube_link import LASERCUBE
from drivers.spb_usb_chips import USB_IDS
from drivers.transports.usb_device import attached as attached_usb
from rig.config import RigConfig
from rig.errors import DevicesError
from rig.session import open_light

KNOWN = (("helios", HELIOS), ("lasercube", LASERCUBE), *(("spb-usb", one) for one in USB_IDS))
"""USB devices by the kind of their driver; those on serial ports say what they are only when asked."""


@dataclass(frozen=True, slots=True)
class Attached:
    """One device. address: what a config's `port` says to mean it; kind: its driver's, None: a port that may be any."""

    address: str
    what: str
    kind: str | None

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def attached() -> list[Attached]:
    """USB devices that a driver knows, then serial ports. Opens nothing."""
    found = [
        Attached(one.address, f"{kind}: {one.product_name or wanted.label}", kind)
        for kind, wanted in KNOWN
        for one in attached_usb(wanted)
    ]
    for port in list_ports.comports():
        serial = f", serial={port.serial_number}" if port.serial_number else ""
        found.append(Attached(port.device, f"serial port: {port.description}{serial}", None))
    return found


def laser_off(config: RigConfig) -> list[str]:
    """Gate low, emission off; says what was done. Each is tried whatever the other did: DevicesError names failures."""
    done: list[str] = []
    trouble: list[str] = []
    with open_light(config, trouble) as (sync, laser):
        for slot, device, what in (("sync", sync, "all outputs low"), ("laser", laser, "emission off")):
            if device is None:
                continue
            try:
                (sync.abort if device is sync else laser.disarm)()  # type: ignore[union-attr]
                done.append(f"{device.name}: {what}")
            except DeviceError as error:
                trouble.append(f"{slot}: {error}")
    if trouble:
        raise DevicesError("\n".join([*trouble, *done]))
    return done
