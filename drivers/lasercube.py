"""Scanner kind `lasercube`: a galvo behind a LaserCube / LaserDock USB board (hardware.md 3.2).

    config    kind: lasercube, port: usb or usb:serial=ABC, max_velocity, max_acceleration of its galvo
    outputs   X (or Y): mirror. With `colours: markers` R: backward. G: line marker. B: scan marker

The board has a ring of samples that is topped up by a thread: no frames, no seams. Its colour outputs drive lasers of
its own unless these are unplugged, so that they stay off until the config says where they lead. Clear and disable are
its only stop; nothing at all happens when the host dies, so that the gate must not depend on it.
"""

from fractions import Fraction
from typing import Annotated, Literal

from pydantic import Field

from drivers.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.interfaces import BeamScanner, ScannerLimits, ScannerStatus, ScanWaveform
from drivers.lasercube_link import ALTERNATES, LASERCUBE, LaserCubeLink
from drivers.lasercube_run import LaserCubeRun
from drivers.point_source import PointSource, park_from, scan_from
from drivers.registry import Kind, Surroundings
from drivers.run_player import RunPlayer
from drivers.transports.endpoints import resolve
from drivers.transports.usb_device import open_device
from drivers.units import Hertz, Seconds


class LaserCubeConfig(GalvoConfig):
    """Config of a LaserCube and of its galvo."""

    kind: Literal["lasercube"] = "lasercube"
    port: str = "usb"
    """usb, usb:serial=ABC or usb:path=1-2 where several are attached, or emulated:NAME."""
    colours: Literal["dark", "markers"] = "dark"
    """markers: its lasers are unplugged and the colour outputs lead to the marker inputs. dark: never enabled."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=100_000)] = 30_000.0
    """The device may allow less."""
    buffer: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Samples queued in the device: what the host may be late by, and what a stop takes."""


class LaserCubeScanner(BeamScanner):
    """One mirror axis. While a waveform is played a thread of its own does the talking."""

    def __init__(self, config: LaserCubeConfig, link: LaserCubeLink) -> None:
        """`link` is its own from here on."""
        super().__init__(link.name)
        self._config = config
        self._link = link
        self._limits = config.limits(min(config.max_point_rate, float(link.highest_rate_hz)))
        # Where the mirror really stands nobody can ask; powered up it stands at the centre.
        self._player = RunPlayer(link.name, self._halt, position=0.0)
        self._loaded: tuple[ScanWaveform, int] | None = None

    @property
    def limits(self) -> ScannerLimits:
        """The config's, on the rates that the device allows."""
        return self._limits

    @property
    def firmware(self) -> tuple[int, int]:
        """Major and minor version."""
        return self._link.firmware

    def _do_status(self) -> ScannerStatus:
        return self._player.status(self._check_alive)

    def _check_alive(self) -> None:
        self._link.queued()

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        """Whole numbers of Hz are what the device can be told; `start` reads them back."""
        low, high = self._limits.point_rate_hz
        return Fraction(min(max(round(requested_hz), int(low)), int(high)))

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        self._player.join()
        self._loaded = (ScanWaveform(waveform.command.copy(), waveform.markers.copy(), clock_hz), repeats)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        waveform, repeats = self._loaded
        rate_hz = int(waveform.point_rate_hz)
        source = scan_from(self._player.rest(), waveform, repeats, self._limits, rate_hz)
        self._player.start(self._run(source, rate_hz))

    def _do_stop(self) -> None:
        self._player.stop()

    def _do_park(self) -> None:
        rate_hz = int(self._do_point_clock(self._limits.point_rate_hz[1]))
        source = park_from(self._player.rest(), self._config.park, self._limits, rate_hz)
        self._player.play(self._run(source, rate_hz))

    def _do_close(self) -> None:
        self._player.end()
        self._link.close()

    def _run(self, source: PointSource, rate_hz: int) -> LaserCubeRun:
        config = self._config
        return LaserCubeRun(
            self._link,
            source,
            rate_hz,
            buffer_s=config.buffer,
            axis=config.axis,
            markers=config.colours == "markers",
        )

    def _halt(self) -> float:
        """Clear the ring. Where that leaves the mirror nobody knows: the next run goes to the centre in one jump."""
        self._link.safe()
        return 0.0


def create(config: LaserCubeConfig, surroundings: Surroundings) -> LaserCubeScanner:
    """Open the LaserCube at the config's port."""
    endpoint = resolve(config.port, surroundings.ports)
    usb = open_device(LASERCUBE, endpoint.address, ALTERNATES, endpoint.usb_backend)
    try:
        link = LaserCubeLink(usb, surroundings.clock)
    except BaseException:
        usb.close()
        raise
    return LaserCubeScanner(config, link)


KIND = Kind(config=LaserCubeConfig, create=create)
