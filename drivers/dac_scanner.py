"""A beam scanner that is a galvo behind a DAC on USB: all that is the same whatever the DAC.

A `Dac` is one board with its link: it says at what rates it runs, and plays points. The mirror moves only when it is
started or parked, always along ramps; opening a scanner asks the board who it is, no more.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Protocol

from drivers.galvo import GalvoConfig
from drivers.interfaces import BeamScanner, ScannerLimits, ScannerStatus, ScanWaveform
from drivers.point_source import PointSource, park_from, scan_from
from drivers.registry import Surroundings
from drivers.run_player import Run, RunPlayer
from drivers.transports.endpoints import resolve
from drivers.transports.usb_device import UsbDevice, UsbId, open_device


class Dac(Protocol):
    """An open board. Powered up its mirror stands at the centre, drive 0."""

    name: str
    identity: str
    """See `Device.identity`."""
    serial: str | None
    """See `Device.serial`."""
    highest_rate_hz: float
    closes_at: float | None
    """Drive that giving the board back jumps to; None: it holds."""

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The exact rate nearest to the requested one, within low to high."""
        ...

    def run(self, source: PointSource, clock_hz: Fraction) -> Run:
        """These points at a rate that `point_clock` returned."""
        ...

    def check(self) -> None:
        """Raise where it does not answer. Any thread."""
        ...

    def halt(self) -> float:
        """End whatever it plays, in an emergency; where the mirror rests then."""
        ...

    def close(self) -> None:
        """Outputs safe, and the board given back."""
        ...


class DacScanner(BeamScanner):
    """One mirror axis. While a waveform is played a thread of its own does the talking."""

    def __init__(self, dac: Dac, config: GalvoConfig) -> None:
        """`dac` is its own from here on."""
        super().__init__(dac.name)
        self._dac = dac
        self._park = config.park
        self._limits = config.limits(dac.highest_rate_hz)
        self._player = RunPlayer(dac.name, dac.halt, position=0.0)
        self._loaded: tuple[ScanWaveform, int] | None = None

    @property
    def identity(self) -> str:
        """What the board says of itself."""
        return self._dac.identity

    @property
    def serial(self) -> str | None:
        """Of the board: which mirror hangs on it nobody can ask."""
        return self._dac.serial

    @property
    def limits(self) -> ScannerLimits:
        """The config's, on the rates that the device allows."""
        return self._limits

    def _do_status(self) -> ScannerStatus:
        return self._player.status(self._dac.check)

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        return self._dac.point_clock(requested_hz, *self._limits.point_rate_hz)

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        self._player.join()
        self._loaded = (ScanWaveform(waveform.command.copy(), waveform.markers.copy(), clock_hz), repeats)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        waveform, repeats = self._loaded
        clock_hz = waveform.point_rate_hz
        source = scan_from(self._player.rest(), waveform, repeats, self._limits, float(clock_hz))
        self._player.start(self._dac.run(source, clock_hz))

    def _do_stop(self) -> None:
        self._player.stop()

    def _do_park(self) -> None:
        self._go(self._park)

    def _do_close(self) -> None:
        self._player.end()  # nobody talks while the device is given back
        try:
            if self._dac.closes_at is not None and self._player.position is not None:
                self._go(self._dac.closes_at)
        finally:
            self._dac.close()

    def _go(self, command: float) -> None:
        """To rest at `command`, as fast as the board plays."""
        clock_hz = self._do_point_clock(self._limits.point_rate_hz[1])
        source = park_from(self._player.rest(), command, self._limits, float(clock_hz))
        self._player.play(self._dac.run(source, clock_hz))


def open_scanner(
    wanted: UsbId,
    alternates: Mapping[int, int],
    config: GalvoConfig,
    surroundings: Surroundings,
    identify: Callable[[UsbDevice], Dac],
) -> DacScanner:
    """The scanner at the config's port. identify: makes the `Dac` of an open device, or raises."""
    endpoint = resolve(config.port, surroundings.ports)
    usb = open_device(wanted, endpoint.address, alternates, endpoint.usb_backend, surroundings.tap)
    try:
        return DacScanner(identify(usb), config)
    except BaseException:
        usb.close()
        raise
