"""Scanner kind `lasercube`: a galvo behind a LaserCube / LaserDock USB board (hardware.md 3.2).

    config    kind: lasercube, port: usb or usb:serial=ABC, max_velocity, max_acceleration of its galvo
    outputs   X (or Y): mirror. With `colours: markers` R: backward. G: line marker. B: scan marker. X is not
              turned round as the vendor's program does: which way a command leads is for the calibration to say

The board has a ring of samples that is topped up by a thread: no frames, no seams. Its colour outputs drive lasers of
its own unless these are unplugged, so that they stay off until the config says where they lead. Clear and disable are
its only stop; nothing at all happens when the host dies, so that the gate must not depend on it.
"""

from fractions import Fraction
from typing import Annotated, Literal

from pydantic import Field

from drivers.dac_scanner import DacScanner, open_scanner
from drivers.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.lasercube_link import ALTERNATES, LASERCUBE, LaserCubeLink
from drivers.lasercube_run import LaserCubeRun
from drivers.point_source import PointSource
from drivers.registry import Kind, Surroundings
from drivers.transports.usb_device import UsbDevice
from drivers.units import Hertz, Seconds


class LaserCubeConfig(GalvoConfig):
    """Config of a LaserCube and of its galvo."""

    kind: Literal["lasercube"] = "lasercube"
    colours: Literal["dark", "markers"] = "dark"
    """markers: its lasers are unplugged and the colour outputs lead to the marker inputs. dark: never enabled."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=100_000)] = 30_000.0
    """The device may allow less."""
    buffer: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Samples queued in the device: what the host may be late by, and what a stop takes."""


class LaserCubeDac:
    """A `Dac`. Where its mirror stands when it is opened nobody can ask: the first run begins at the centre."""

    closes_at: float | None = None

    def __init__(self, config: LaserCubeConfig, link: LaserCubeLink) -> None:
        self.name = link.name
        self.identity = f"{link.name}, firmware {link.firmware[0]}.{link.firmware[1]}"
        self.serial = link.serial
        self.highest_rate_hz = min(config.max_point_rate, float(link.highest_rate_hz))
        self._config = config
        self._link = link

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """Whole numbers of Hz are what the device can be told; a run reads them back."""
        return Fraction(min(max(round(requested_hz), int(low_hz)), int(high_hz)))

    def run(self, source: PointSource, clock_hz: Fraction) -> LaserCubeRun:
        """See `Dac`."""
        config = self._config
        markers = config.colours == "markers"
        return LaserCubeRun(
            self._link, source, int(clock_hz), buffer_s=config.buffer, axis=config.axis, markers=markers
        )

    def check(self) -> None:
        """Any question will do."""
        self._link.queued()

    def halt(self) -> float:
        """Clear the ring. Where that leaves the mirror nobody knows: the next run goes to the centre in one jump."""
        self._link.safe()
        return 0.0

    def close(self) -> None:
        """See `LaserCubeLink.close`."""
        self._link.close()


def create(config: LaserCubeConfig, surroundings: Surroundings) -> DacScanner:
    """Open the LaserCube at the config's port."""

    def identify(usb: UsbDevice) -> LaserCubeDac:
        return LaserCubeDac(config, LaserCubeLink(usb, surroundings.clock))

    return open_scanner(LASERCUBE, ALTERNATES, config, surroundings, identify)


KIND = Kind(config=LaserCubeConfig, create=create)
