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
from drivers.errors import DeviceNotFound, DeviceTimeout
from drivers.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.helios_frames import MOST_PPS, nearest_pps, rate_of
from drivers.helios_link import ENABLED, HELIOS, INTERFACE, HeliosLink
from drivers.helios_run import HeliosRun
from drivers.interfaces import BeamScanner, ScannerLimits, ScannerStatus, ScanWaveform
from drivers.point_source import PointSource, park_from, scan_from
from drivers.registry import Kind, Surroundings
from drivers.run_player import RunPlayer
from drivers.transports.endpoints import resolve
from drivers.transports.usb_device import open_device
from drivers.units import Hertz, Seconds

_log = logging.getLogger(__name__)

_TESTED_FIRMWARE = 6


class HeliosConfig(GalvoConfig):
    """Config of a Helios and of the galvo behind it."""

    kind: Literal["helios"] = "helios"
    port: str = "usb"
    """usb, usb:path=1-2 where several are attached (they have no serial number), or emulated:NAME."""
    name: str | None = None
    """Name stored in the device; another one is refused."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=MOST_PPS)] = 65535.0
    """Lower it where the host's USB is busy: 40 kHz leaves a margin."""
    frame: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Length of one frame: what the host may be late by, and half of what a stop takes."""


class HeliosScanner(BeamScanner):
    """One mirror axis. While a waveform is played a thread of its own does the talking."""

    def __init__(self, config: HeliosConfig, link: HeliosLink, clock: Clock) -> None:
        """`link` is its own from here on."""
        super().__init__(link.name)
        self._config = config
        self._link = link
        self._clock = clock
        self._limits = config.limits(config.max_point_rate)
        # Entering alternate setting 1 centres the mirror, and so does STOP.
        self._player = RunPlayer(link.name, self._halt, position=0.0)
        self._loaded: tuple[ScanWaveform, int] | None = None

    @property
    def limits(self) -> ScannerLimits:
        """The config's."""
        return self._limits

    @property
    def firmware(self) -> int:
        """Version of the device's firmware."""
        return self._link.firmware

    def _do_status(self) -> ScannerStatus:
        return self._player.status(self._check_alive)

    def _check_alive(self) -> None:
        if self._link.free() is None and self._link.free() is None:
            raise DeviceTimeout(f"{self._name}: gives no status; unplug it and plug it in again")

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        return rate_of(self._pps(requested_hz))

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        self._player.join()
        self._loaded = (ScanWaveform(waveform.command.copy(), waveform.markers.copy(), clock_hz), repeats)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        waveform, repeats = self._loaded
        rate_hz = float(waveform.point_rate_hz)
        self._player.start(self._run(scan_from(self._player.rest(), waveform, repeats, self._limits, rate_hz), rate_hz))

    def _do_stop(self) -> None:
        self._player.stop()

    def _do_park(self) -> None:
        rate_hz = float(self._do_point_clock(self._limits.point_rate_hz[1]))
        source = park_from(self._player.rest(), self._config.park, self._limits, rate_hz)
        self._player.play(self._run(source, rate_hz))

    def _do_close(self) -> None:
        self._player.end()  # nobody talks while the device is given back (pull request 36)
        self._link.close()

    def _run(self, source: PointSource, rate_hz: float) -> HeliosRun:
        pps = self._pps(rate_hz)
        return HeliosRun(self._link, self._clock, source, pps, frame_s=self._config.frame, axis=self._config.axis)

    def _pps(self, rate_hz: float) -> int:
        return nearest_pps(rate_hz, *self._limits.point_rate_hz)

    def _halt(self) -> float:
        self._link.stop()
        return 0.0


def create(config: HeliosConfig, surroundings: Surroundings) -> HeliosScanner:
    """Open the Helios at the config's port."""
    endpoint = resolve(config.port, surroundings.ports)
    usb = open_device(HELIOS, endpoint.address, {INTERFACE: ENABLED}, endpoint.usb_backend)
    try:
        link = HeliosLink(usb, surroundings.clock)
        if link.firmware < _TESTED_FIRMWARE:
            _log.warning("%s: firmware %d is older than the tested %d", link.name, link.firmware, _TESTED_FIRMWARE)
        if config.name not in (None, link.stored_name):
            raise DeviceNotFound(f"{link.name}: its name is {link.stored_name!r}, not {config.name!r}; correct port")
    except BaseException:
        usb.close()
        raise
    return HeliosScanner(config, link, surroundings.clock)


KIND = Kind(config=HeliosConfig, create=create)
