"""The beam scanner: one mirror that plays a compiled waveform. Each point is a drive command with marker bits."""

import logging
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.interfaces.device import OPEN_STATES, Device, DeviceState, whole_number

_log = logging.getLogger(__name__)

MARKER_LINE = 1
MARKER_SCAN = 2
LEVEL_BACKWARD = 4
"""Bits of a waveform's marker words. A bit at point i is high from the start of point i for one point.

A sweep begins where MARKER_SCAN, the scan marker, rises. It stays high until just before the sweep's light ends. The
sync source lets light out only while it is high, so the light ends too if the scanner stops or is unplugged.
MARKER_LINE marks places within a sweep; LEVEL_BACKWARD is high throughout a sweep in the backward direction.
"""

_SLOWER = "make the command slower or smaller (in a scan: raise exposures or narrow command_range)"
_ROUNDING = 1e-6
"""Share by which a computed value may exceed its limit: differences of float64 commands are that uncertain."""


@dataclass(frozen=True, slots=True)
class ScannerLimits:
    """Limits of what the mirror can follow. Commands are normalised: -1 to 1 is the full range of the DAC."""

    command_range: tuple[float, float]
    """Smallest and largest command."""
    velocity_per_s: float
    """Largest speed of the command, drive units per second."""
    acceleration_per_s2: float
    """Largest acceleration of the command, drive units per second squared."""
    step: float
    """Largest change of command from one point to the next."""
    rms_duty: float
    """Largest RMS acceleration of a waveform as a share of `acceleration_per_s2`. It bounds the mirror's heat."""
    max_points: int
    """Most points of a waveform."""
    point_rate_hz: tuple[float, float]
    """Lowest and highest point rate."""


@dataclass(frozen=True, slots=True)
class ScanWaveform:
    """One period of a scan.

    command: float64 (points,), normalised drive.
    markers: uint8 (points,), OR of `MARKER_LINE`, `MARKER_SCAN`, `LEVEL_BACKWARD`.
    point_rate_hz: a rate that `BeamScanner.point_clock` returned.
    """

    command: NDArray[np.float64]
    markers: NDArray[np.uint8]
    point_rate_hz: Fraction


@dataclass(frozen=True, slots=True)
class ScannerStatus:
    """The scanner's report on itself at the time when `status` was read."""

    moving: bool
    """A waveform is being played, or the mirror is on its way to rest."""
    fault: str | None
    """The fault in one line; None: there is none."""
    position: float | None
    """Position of the mirror, normalised drive; None if the device does not say."""


class BeamScanner(Device):
    """A galvanometer with its DAC. Use: `load`, `start`, then `stop` or the waveform's end after its repeats, then
    `park`.

    Opening the scanner moves nothing, except that a mirror which another program left elsewhere may jump to the centre.
    Closing it before the first `start` or `park` moves nothing.
    """

    _has_moved = False
    on_fault: Callable[[], None] | None = None
    """Function that is called at once, unless None, on the driver's own thread, if a run fails. Take the gate low in
    it, and read `status` later. Its errors are only logged. Drivers without a thread of
    their own never call it."""

    @property
    @abstractmethod
    def limits(self) -> ScannerLimits:
        """Limits of what the mirror can follow: the stricter of the device's own and the config's."""

    @property
    def status(self) -> ScannerStatus:
        """The scanner's status, asked anew each time. Raises `WrongState` after close, and another `DeviceError` if the
        device is lost. May be called from any thread."""
        self._require("status", *OPEN_STATES)
        return self._do_status()

    def point_clock(self, requested_hz: float) -> Fraction:
        """The exact point rate nearest to `requested_hz` that the device can run. Asking for that rate again returns it
        unchanged. Raises `LimitExceeded` for a rate outside the limits.
        """
        self._require("point_clock", *OPEN_STATES)
        low, high = self.limits.point_rate_hz
        if not low <= requested_hz <= high:
            raise LimitExceeded(
                f"{self._name}: point rate {requested_hz:g} Hz is outside {low:g} to {high:g} Hz; "
                "choose a rate within the limits"
            )
        return self._do_point_clock(requested_hz)

    def load(self, waveform: ScanWaveform, repeats: int) -> Fraction:
        """Load a waveform, to be played `repeats` times without a seam; returns the exact point clock at which it will
        run.

        Nothing moves. Raises `LimitExceeded`, with the value, for the first limit that the waveform breaks, and
        `WrongState` while another one is played.
        """
        self._note_end()
        self._require("load", DeviceState.READY, DeviceState.CONFIGURED, first="stop")
        repeats = whole_number(self._name, "repeats", repeats)
        if repeats < 1:
            raise LimitExceeded(f"{self._name}: {repeats} repeats; give at least 1")
        clock_hz = self.point_clock(float(waveform.point_rate_hz))
        try:
            check_waveform(waveform, self.limits, clock_hz, seamless=repeats > 1)
        except LimitExceeded as error:
            raise LimitExceeded(f"{self._name}: {error}") from None
        self._do_load(waveform, repeats, clock_hz)
        self._state = DeviceState.CONFIGURED
        _log.info("%s: %d points at %g Hz, %d times", self._name, len(waveform.command), float(clock_hz), repeats)
        return clock_hz

    def start(self) -> None:
        """Play the waveform. Before that, the mirror is brought to its first point within the limits. Does not wait for
        the waveform's end."""
        self._note_end()
        self._require("start", DeviceState.CONFIGURED, first="load" if self._state is DeviceState.READY else "stop")
        _log.info("%s: start", self._name)
        self._has_moved = True
        self._do_start()
        self._state = DeviceState.RUNNING

    def stop(self) -> None:
        """Bring the mirror to rest; the waveform stays loaded. Does nothing if no waveform is being played. Allowed
        from any thread.
        """
        self._require("stop", *OPEN_STATES)
        if self._state is DeviceState.RUNNING:
            _log.info("%s: stop", self._name)
            self._do_stop()
            self._state = DeviceState.CONFIGURED

    def park(self) -> None:
        """Stop, and turn the mirror to where the beam is dumped. Allowed until `close` and from any thread."""
        self.stop()
        _log.info("%s: park", self._name)
        self._has_moved = True
        self._do_park()

    def _note_end(self) -> None:
        """Update the state if a waveform has ended by itself. Called where the state matters."""
        if self._state is DeviceState.RUNNING and not self._do_status().moving:
            self._state = DeviceState.CONFIGURED

    def _make_safe(self) -> None:
        if self._has_moved:
            self.park()

    @abstractmethod
    def _do_status(self) -> ScannerStatus: ...

    @abstractmethod
    def _do_point_clock(self, requested_hz: float) -> Fraction: ...

    @abstractmethod
    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None: ...

    @abstractmethod
    def _do_start(self) -> None: ...

    @abstractmethod
    def _do_stop(self) -> None: ...

    @abstractmethod
    def _do_park(self) -> None: ...


def check_waveform(waveform: ScanWaveform, limits: ScannerLimits, clock_hz: Fraction, *, seamless: bool) -> None:
    """Raise `LimitExceeded` if a waveform is malformed or, played at `clock_hz`, asks for more than these limits allow.

    seamless: whether the waveform repeats. The steps across its end are then checked like any other.
    """
    command = waveform.command
    if not (isinstance(command, np.ndarray) and isinstance(waveform.markers, np.ndarray)):
        raise LimitExceeded("commands and markers are no arrays; make them with numpy, float64 and uint8")
    points = len(command)
    if not 2 <= points <= limits.max_points:
        raise LimitExceeded(f"{points} points are outside 2 to {limits.max_points}; use a lower point rate")
    if command.shape != (points,) or waveform.markers.shape != (points,):
        raise LimitExceeded(f"commands {command.shape} and markers {waveform.markers.shape} are not of one length")
    if not np.isfinite(command).all():
        raise LimitExceeded(f"command {int(np.argmin(np.isfinite(command)))} is not finite; compile the scan anew")
    low, high = limits.command_range
    if command.min() < low or command.max() > high:
        raise LimitExceeded(
            f"commands {command.min():.6g} to {command.max():.6g} are outside {low:.6g} to {high:.6g}; narrow the range"
        )
    rate_hz = float(clock_hz)
    steps = np.diff(command, append=command[:1]) if seamless else np.diff(command)
    turns = np.diff(steps, append=steps[:1]) if seamless else np.diff(steps)
    acceleration = np.abs(turns) * rate_hz**2
    rms = float(np.sqrt(np.mean(acceleration**2))) if acceleration.size else 0.0
    peak = float(acceleration.max(initial=0.0))
    step = float(np.abs(steps).max())
    most_rms = limits.rms_duty * limits.acceleration_per_s2
    for what, value, limit in (
        ("step of {:.6g} from point to point exceeds {:.6g}; raise the point rate,", step, limits.step),
        ("velocity of {:.6g} /s exceeds {:.6g} /s;", step * rate_hz, limits.velocity_per_s),
        ("acceleration of {:.6g} /s2 exceeds {:.6g} /s2;", peak, limits.acceleration_per_s2),
        ("RMS acceleration of {:.6g} /s2 exceeds {:.6g} /s2;", rms, most_rms),
    ):
        if value > limit * (1 + _ROUNDING):
            raise LimitExceeded(f"{what.format(value, limit)} {_SLOWER}")
