"""Scanner kind `helios`: a galvo behind a Helios laser DAC on USB (hardware.md 3.1; vendor's firmware v6 and SDK v11).

    config    kind: helios, port: usb or usb:path=1-2, max_velocity, max_acceleration of the galvo behind it
    outputs   X (or Y): mirror. R: lit, i.e. a waveform is being played. G: line marker. B: scan marker. I: backward

The device plays frames of up to 4095 points from two buffers, one playing and one pending, and has neither a trigger
nor a clock output: synchronisation comes from the markers in the SPAD's stream. A thread keeps the pending buffer full.
Every frame is SINGLE: a dead host leaves a mirror that stands after two frames, not one that scans for ever. STOP
centres the mirror in one jump, so that it is for emergencies and for the end; scans end with a brake ramp. The shutter
pin is never raised and flash is never written; opcode DE (bootloader) does not exist here.
"""

import logging
from fractions import Fraction
from typing import Annotated, Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.dac_scanner import DacScanner, open_scanner
from drivers.errors import DeviceNotFound, DeviceTimeout
from drivers.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.helios_frames import MOST_PPS, nearest_rate
from drivers.helios_link import ENABLED, HELIOS, INTERFACE, HeliosLink
from drivers.helios_run import HeliosRun
from drivers.point_source import PointSource
from drivers.registry import Kind, Surroundings
from drivers.transports.usb_device import UsbDevice
from drivers.units import Hertz, Seconds

_log = logging.getLogger(__name__)

_TESTED_FIRMWARE = 6


class HeliosConfig(GalvoConfig):
    """Config of a Helios and of the galvo behind it."""

    kind: Literal["helios"] = "helios"
    name: str | None = None
    """Name stored in the device; another one is refused."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=MOST_PPS)] = 65535.0
    """Lower it where the host's USB is busy: 40 kHz leaves a margin."""
    frame: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Length of one frame: what the host may be late by, and half of what a stop takes."""


class HeliosDac:
    """A `Dac`. Where STOP and the alternate setting without endpoints leave the mirror is the centre."""

    closes_at: float | None = 0.0

    def __init__(self, config: HeliosConfig, link: HeliosLink, clock: Clock) -> None:
        self.name = link.name
        self.identity = f"{link.name}, {link.stored_name!r}, firmware {link.firmware}"
        self.serial = link.stored_name or None
        self.highest_rate_hz = config.max_point_rate
        self._config = config
        self._link = link
        self._clock = clock

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """What the divider of its timer makes of it."""
        return nearest_rate(requested_hz, low_hz, high_hz)

    def run(self, source: PointSource, clock_hz: Fraction) -> HeliosRun:
        """See `Dac`."""
        config = self._config
        return HeliosRun(self._link, self._clock, source, clock_hz, frame_s=config.frame, axis=config.axis)

    def check(self) -> None:
        """DeviceTimeout where it is asked twice in vain."""
        if self._link.free() is None and self._link.free() is None:
            raise DeviceTimeout(f"{self.name}: gives no status; unplug it and plug it in again")

    def halt(self) -> float:
        """STOP: at the centre, in one jump."""
        self._link.stop()
        return 0.0

    def close(self) -> None:
        """See `HeliosLink.close`."""
        self._link.close()


def create(config: HeliosConfig, surroundings: Surroundings) -> DacScanner:
    """Open the Helios at the config's port."""

    def identify(usb: UsbDevice) -> HeliosDac:
        link = HeliosLink(usb, surroundings.clock)
        if link.firmware < _TESTED_FIRMWARE:
            _log.warning("%s: firmware %d is older than the tested %d", link.name, link.firmware, _TESTED_FIRMWARE)
        if config.name not in (None, link.stored_name):
            raise DeviceNotFound(f"{link.name}: its name is {link.stored_name!r}, not {config.name!r}; correct port")
        return HeliosDac(config, link, surroundings.clock)

    return open_scanner(HELIOS, {INTERFACE: ENABLED}, config, surroundings, identify)


KIND = Kind(config=HeliosConfig, create=create)
