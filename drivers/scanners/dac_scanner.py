"""The common part of all beam scanners that are a galvo behind a DAC: a laser DAC or an NI card.

The mirror moves along the paths of `galvo`, and only when the scanner is started, stopped, parked or closed. There are
two exceptions, in which it may jump to the centre: when a scanner is opened whose mirror another program left
elsewhere, and after a fault. Commands are drives: -1 to 1 is the DAC's range. A run here is one motion: the way to the
first point, the waveform and, if it is stopped, the way to rest; or only the way from one place of rest to another. The
points are fed to the DAC slice by slice, those of a waveform by a thread. Repeats are not written out: a waveform of a
million points that is repeated for hours takes only its own memory.
"""

import logging
import math
import os
import threading
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.errors import GONE, DeviceDisconnected, DeviceError, DeviceFault
from drivers.interfaces import BeamScanner, ScannerLimits, ScannerStatus, ScanWaveform
from drivers.interfaces.forgotten import watch_for_end
from drivers.scanners.galvo import GalvoConfig, brake, ramp
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import Tap
from drivers.transports.usb_device import UsbDevice, UsbId, open_device

_log = logging.getLogger(__name__)

FULL_SCALE, CENTRE = 4095, 0x800
"""Largest value of the 12-bit converters, and their value at the centre, drive 0."""
POLL_S = 0.002
"""Time between two queries of how far the board has played."""
PATIENCE_S = 1.0
"""Longest time in which a board may make no progress, beyond the time that its points take."""
DRIFT = 1e-3
"""Largest relative difference between a board's crystal and the host's clock."""
_NO_WAVE = ScanWaveform(np.zeros(1), np.zeros(1, np.uint8), Fraction(1))


@dataclass(frozen=True, slots=True, eq=False)
class PointSlice:
    """n successive points. command: float64 (n,), drives; markers: uint8 (n,), as in `ScanWaveform`; lit: bool (n,),
    True for points of the waveform, False for the ways to and from it."""

    command: NDArray[np.float64]
    markers: NDArray[np.uint8]
    lit: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.command)

    @property
    def steps(self) -> NDArray[np.uint16]:
        """The commands as values of 12-bit converters, uint16 (n,), 0 to `FULL_SCALE`."""
        return np.rint((self.command + 1) / 2 * FULL_SCALE).astype(np.uint16)

    def level(self, bit: int) -> NDArray[np.uint8]:
        """Values of a colour output that follows a marker bit, uint8 (n,)."""
        return colour(self.markers & bit)


def colour(high: NDArray[Any]) -> NDArray[np.uint8]:
    """Values of a colour output, uint8 (n,): 255 at the points where `high` is not 0, else 0."""
    return np.where(high, 255, 0).astype(np.uint8)


class PointSource:
    """Gives the points of a run in order: the way from rest at `position` to `end`, then a waveform that begins there,
    `repeats` times. For use by one thread at a time. `last` is the last command taken; before the first `take` it is
    `position`."""

    def __init__(
        self,
        position: float,
        end: float,
        limits: ScannerLimits,
        rate_hz: float,
        waveform: ScanWaveform = _NO_WAVE,
        repeats: int = 0,
    ) -> None:
        self._limits = limits
        self._rate_hz = rate_hz
        self.waveform, self.repeats = waveform, repeats
        self._way = ramp(position, end, limits, rate_hz)
        self._end = len(self._way) + repeats * len(waveform.command)
        self._at = 0
        self._before = self.last = position
        self._former = 0, position, position

    @property
    def left(self) -> int:
        """Number of points not taken yet."""
        return self._end - self._at

    def pad_start(self, points: int = 1) -> None:
        """Add points at the very beginning, at the mirror's rest position. Call it before the first `take`."""
        self._way = np.concatenate([np.full(points, self.last), self._way])
        self._end += points

    def pad_end(self) -> None:
        """Add one more point at the end of a way to rest, at the final position. Call it after `stop` and before
        `take`.
        """
        self._way = np.append(self._way, self._way[-1])
        self._end += 1

    def take(self, most: int) -> PointSlice:
        """The next points, at most `most` of them, none once `left` is 0."""
        self._former = self._at, self._before, self.last
        at = np.arange(self._at, min(self._at + most, self._end))
        self._at += len(at)
        lit = at >= len(self._way)
        command, markers = np.empty(len(at)), np.zeros(len(at), np.uint8)
        of_wave = (at[lit] - len(self._way)) % len(self.waveform.command)
        command[lit], markers[lit] = self.waveform.command[of_wave], self.waveform.markers[of_wave]
        command[~lit] = self._way[at[~lit]]
        if len(command):
            self._before = float(command[-2]) if len(command) > 1 else self.last
            self.last = float(command[-1])
        return PointSlice(command, markers, lit)

    def give_back(self) -> None:
        """Undo the last `take`, whose points were not played."""
        self._at, self._before, self.last = self._former

    def stop(self) -> None:
        """Replace the remaining points, if there are any, by the way to rest (`brake`)."""
        if self.left:
            self._way = brake(self.last, (self.last - self._before) * self._rate_hz, self._limits, self._rate_hz)
            self._at, self._end = 0, len(self._way)


class StartTime:
    """Bounds of the time at which the first point was played. Each answer of a board narrows them, on the assumption
    that no point was lost, repeated or delayed.
    """

    def __init__(self) -> None:
        self.earliest_s, self.latest_s = -math.inf, math.inf
        self._at_s = 0.0

    def narrow(self, earliest_s: float, latest_s: float, at_s: float) -> float:
        """Narrow the bounds by those of an answer that came at `at_s`. Before that they are widened by the possible
        drift of the clocks since the last answer. Returns earliest minus latest time in seconds: above 0 they
        contradict each other."""
        slack_s, self._at_s = DRIFT * (at_s - self._at_s), at_s
        self.earliest_s = max(self.earliest_s - slack_s, earliest_s)
        self.latest_s = min(self.latest_s + slack_s, latest_s)
        return self.earliest_s - self.latest_s


class DacRun(Protocol):
    """One run on one device. Every wait in it has a time limit. `begin` and `feed` may raise `DeviceError`."""

    source: PointSource

    def begin(self) -> None:
        """Send the first points, to be played at once, or as soon as the points that hold the mirror are over or an
        external clock or trigger comes."""

    def feed(self, stopping: threading.Event) -> None:
        """Send the other points; returns when the mirror rests. Brakes once another thread sets `stopping`."""

    def give_up(self) -> None:
        """Make safe what is left of a run whose `begin` or `feed` has failed. Raises no DeviceError."""
        return


class Dac(Protocol):
    """An open board. Closing it puts the mirror at the centre, drive 0, in one jump if it is elsewhere."""

    name: str
    identity: str
    """See `Device.identity`."""
    serial: str | None
    """See `Device.serial`."""
    highest_rate_hz: float

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The exact rate nearest to the requested one that the board can run, between low and high."""

    def run(self, source: PointSource, clock_hz: Fraction) -> DacRun:
        """A run of these points, at a rate that `point_clock` returned."""

    def check(self) -> None:
        """Raise `DeviceError` if the board does not answer. May be called from any thread."""

    def halt(self) -> float:
        """Stop what the board plays, after a fault; returns the drive at which the mirror then rests."""

    def close(self) -> None:
        """Make the outputs safe and release the device."""


class _Motion:
    """State of a mirror, shared by its scanner and the thread that feeds the board. Does not refer to the scanner."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.position: float | None = 0.0
        """Command at which the mirror rests; None: it is moving, or its place is unknown after a fault."""
        self.stopping = threading.Event()
        self.thread: threading.Thread | None = None
        self.error: DeviceError | None = None
        """The error that ended the last waveform, or the holding of the mirror after it; None: there was none."""

    def join(self) -> None:
        """Wait for the thread that feeds the board. Several threads may wait at once."""
        thread = self.thread
        if thread is not None:
            with suppress(RuntimeError):  # an interrupt came before it was started
                thread.join()
            if self.thread is thread:
                self.thread = None


class DacScanner(BeamScanner):
    """One mirror axis. While a waveform is played, a thread feeds the board. A scanner that nobody closes is stopped
    and closed when the object is deleted or Python ends."""

    @classmethod
    def at(
        cls,
        endpoint: Endpoint,
        wanted: UsbId,
        alternates: Mapping[int, int],
        config: GalvoConfig,
        identify: Callable[[UsbDevice], Dac],
        tap: Tap | None = None,
    ) -> Self:
        """Open the board at an address on USB; returns its scanner. wanted: USB ids of the board. alternates: alternate
        setting by USB interface. identify: makes the `Dac` of an open device, or raises an error. Raises what
        `open_device` and `identify` raise."""
        usb = open_device(wanted, endpoint.address, alternates, endpoint.usb_backend, tap)
        try:
            return cls(identify(usb), config)
        except BaseException:
            usb.close()
            raise

    def __init__(self, dac: Dac, config: GalvoConfig) -> None:
        """Take over `dac`, which is closed with the scanner."""
        super().__init__(dac.name)
        self._dac = dac
        self._park = config.park
        self._limits = config.limits(dac.highest_rate_hz)
        self._loaded: tuple[ScanWaveform, int] | None = None
        self._motion = _Motion(dac.name)
        self._forgotten = watch_for_end(self, partial(_end, self._motion, dac, os.getpid()))

    @property
    def identity(self) -> str:
        """The board's name, and what it reports about itself."""
        return self._dac.identity

    @property
    def serial(self) -> str | None:
        """Serial number, stored name or MAC address of the board; None if none is known. Mirrors cannot be asked."""
        return self._dac.serial

    @property
    def limits(self) -> ScannerLimits:
        """The config's limits. The highest point rate is `Dac.highest_rate_hz`."""
        return self._limits

    def _do_status(self) -> ScannerStatus:
        motion = self._motion
        thread = motion.thread
        moving = thread is not None and thread.is_alive()
        if isinstance(motion.error, DeviceDisconnected):
            raise motion.error
        if not moving and motion.error is None:
            self._dac.check()
        fault = None if motion.error is None else str(motion.error)
        return ScannerStatus(moving=moving, fault=fault, position=None if moving else motion.position)

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        return self._dac.point_clock(requested_hz, *self._limits.point_rate_hz)

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        self._motion.join()
        self._loaded = (ScanWaveform(waveform.command.copy(), waveform.markers.copy(), clock_hz), repeats)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        waveform, repeats = self._loaded
        clock_hz = waveform.point_rate_hz
        first = float(waveform.command[0])
        source = PointSource(self._rest(), first, self._limits, float(clock_hz), waveform, repeats)
        run = self._dac.run(source, clock_hz)
        self._begin(run)
        fed = run, self._motion, weakref.ref(self)
        self._motion.thread = threading.Thread(target=_feed, args=fed, name=self.name, daemon=True)
        self._motion.thread.start()

    def _do_stop(self) -> None:
        self._motion.stopping.set()
        self._rest()

    def _do_park(self) -> None:
        self._go(self._park)

    def _make_safe(self) -> None:
        # A lost laser DAC has no power or no points. A lost NI card keeps its levels, which nothing here can change.
        with suppress(*GONE):
            super()._make_safe()

    def _do_close(self) -> None:
        self._motion.stopping.set()
        self._motion.join()  # no other thread may talk to the board while it is closed
        try:
            try:
                if self._motion.position is not None:
                    self._go(0.0)
            finally:
                self._forgotten.detach()
                self._dac.close()
        except GONE as error:
            self._lost_at_close(error)

    def _go(self, command: float) -> None:
        """Bring the mirror to rest at `command` by a ramp at the highest point rate, unless it rests there already."""
        clock_hz = self._do_point_clock(self._limits.point_rate_hz[1])
        run = self._dac.run(PointSource(self._rest(), command, self._limits, float(clock_hz)), clock_hz)
        if run.source.left:
            self._begin(run)
            try:
                run.feed(self._motion.stopping)
            except BaseException:
                run.give_up()
                raise
            self._motion.position = run.source.last
        self._motion.error = None

    def _begin(self, run: DacRun) -> None:
        self._motion.stopping.clear()
        self._motion.position = self._motion.error = None
        try:
            run.begin()
        except BaseException:
            run.give_up()
            raise

    def _rest(self) -> float:
        """Wait for a run to end; returns the drive at which the mirror rests. If that is unknown, halts the board."""
        self._motion.join()
        if self._motion.position is None:
            self._motion.position = self._dac.halt()
        return self._motion.position


def _feed(run: DacRun, motion: _Motion, of: "weakref.ref[DacScanner]") -> None:
    """Feed the device, in the thread. An error ends the run, and `status` reports it or raises it."""
    try:
        run.feed(motion.stopping)
        motion.position = run.source.last
    except Exception as error:  # a driver's own fault too must end a scan: its frames have no markers any more
        told = error if isinstance(error, DeviceError) else DeviceFault(f"{motion.name} failed: {error!r}")
        motion.error = told
        _log.error("%s", told)
        scanner = of()
        try:
            if scanner is not None and scanner.on_fault is not None:
                scanner.on_fault()
        except Exception:  # the run is given up all the same
            _log.exception("%s: on_fault", motion.name)
        run.give_up()


def _end(motion: _Motion, dac: Dac, process: int) -> None:
    """Brake the mirror of a scanner that nobody closed, and close its board. Errors are only logged.

    process: number of the process that opened it; in another one, forked from it, nothing is done.
    """
    if os.getpid() != process:
        return
    moved = motion.thread is not None or motion.position != 0.0
    motion.stopping.set()
    try:
        motion.join()
        dac.close()
    except Exception as error:
        _log.error("%s: was not closed, and could not be stopped: %s", motion.name, error)
        return
    if moved:
        _log.warning("%s: was not closed; its mirror was stopped and is at the centre", motion.name)


Config = TypeVar("Config", bound=GalvoConfig)
