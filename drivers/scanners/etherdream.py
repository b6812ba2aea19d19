"""Scanner kind `etherdream`: a galvo behind an Ether Dream laser DAC on the network.

    outputs   X (or Y): mirror. R: lit, i.e. a waveform is being played. G: line marker. B: scan marker. I: backward

The board plays points from a buffer that a thread keeps filled, without frames or seams. Whenever it stops playing (the
buffer ran empty, a stop, an emergency stop, its Ethernet link lost) it sets all colours to 0 and the mirror to the
centre, in one jump. So a mirror that is to rest anywhere else must be held there: after each run a thread sends copies
of the last point, all dark, at 1 kHz, until the next run or `close`. If the host dies, the points run out within
`HOLD_S` or `buffer`, and the mirror jumps to the centre in the dark. A board of the second generation stops at once if
its connection closes. The shutter output is high while the board plays, and so also while the mirror is held: it blocks
no light then.

Whether every point was played exactly once, and at its rate, shows in the replies (`etherdream_stream`). Facts and
sources: docs/reference/devices/etherdream.md.
"""

import logging
import threading
from fractions import Fraction
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.clock import Clock, SystemClock, now_s
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceError, DeviceFault, DeviceNotFound, EmergencyStop
from drivers.interfaces import ScannerStatus
from drivers.registry import Kind, Surroundings, config_of
from drivers.scanners.dac_scanner import PATIENCE_S, POLL_S, DacRun, DacScanner, PointSource
from drivers.scanners.etherdream_line import (
    CLEAR,
    EMERGENCY,
    IDLE,
    PING,
    PLAYING,
    PREPARED,
    READY,
    STILL_STOPPED,
    STOP,
    EtherDreamLine,
    Reply,
    listen,
)
from drivers.scanners.etherdream_stream import MOST_PPS, PointStream, nearest_rate
from drivers.scanners.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.tap import Tap
from drivers.units import Hertz, Seconds

_log = logging.getLogger(__name__)

LEAST_CAPACITY = 1799
"""Points that the buffer of the first generation holds. An Ether Dream 2 holds 3899."""
HOLD_PPS, HOLD_S = 1000, 0.25
"""Rate at which a resting mirror is held, and time for which points are queued meanwhile. A run begins that much
later."""
_HOLD_POLL_S = 0.02
_HARDWARE_KNOWN = (0, 1, 2, 10)
"""Hardware revisions of the first generation, and of the Ether Dream 2 that was measured."""


class EtherDreamConfig(GalvoConfig):
    """Config of an Ether Dream and of the galvo behind it."""

    kind: Literal["etherdream"] = "etherdream"
    port: str
    """Port: the board's address in the network, "HOST" or "HOST:PORT"; or "emulated:NAME"."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=MOST_PPS)] = 30_000.0
    """Most points per second; the board may allow less."""
    buffer: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Duration of the points queued in the board: the host may be late by as much, and a stop takes as long. The
    board's buffer is the limit: 1799 points last 60 ms at 30 kHz."""


class EtherDreamDac:
    """An Ether Dream as a `Dac`. While the board is idle, the mirror is at the centre."""

    def __init__(self, config: EtherDreamConfig, endpoint: Endpoint, clock: Clock, tap: Tap | None = None) -> None:
        """Connect, identify the board and make it idle. Raises `DeviceBusy` if the board plays for another program, and
        another `DeviceError` if it cannot be used."""
        self.name = "Ether Dream"
        self.config = config
        self.clock = clock
        self._line = EtherDreamLine(self.name, endpoint, tap)
        self._stream: PointStream | None = None
        self._holder: threading.Thread | None = None
        self._letting_go = threading.Event()
        self.fault: DeviceError | None = None
        """The error that ended the holding of the mirror."""
        try:
            # Nothing broadcasts on a loopback interface; an emulated board must not cost the wait.
            heard = None if self._line.peer.startswith("127.") else listen(self._line.peer)
            version = self._version(heard) if heard is None or heard.software >= 2 else "unnamed"
            self._settle()
        except BaseException:
            self._line.close()
            raise
        self.identity = f"{self.name}, firmware {version}"
        self.serial = None if heard is None else heard.mac
        self.capacity = LEAST_CAPACITY if heard is None else heard.capacity
        self.highest_rate_hz = config.max_point_rate
        if heard is not None:
            self.highest_rate_hz = min(config.max_point_rate, float(heard.highest_rate_hz))
            self.identity += f", MAC {heard.mac}, hardware {heard.hardware}, software {heard.software}"
            if heard.hardware not in _HARDWARE_KNOWN:
                _log.warning("%s: the point clock of hardware %d is not known", self.name, heard.hardware)

    def _version(self, heard: Any) -> str:
        try:
            return self._line.version()
        except DeviceDisconnected as error:
            if heard is not None:
                raise
            raise DeviceNotFound(
                f"{self.name}: {self._line.peer} hangs up when asked for its version, as the oldest firmware does; let "
                "its broadcasts through this computer's firewall (UDP port 7654)"
            ) from error

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The rate nearest to the requested one that the divider of the board's timer can make."""
        return nearest_rate(requested_hz, low_hz, high_hz)

    def run(self, source: PointSource, clock_hz: Fraction) -> "EtherDreamRun":
        """See `Dac`."""
        return EtherDreamRun(self, source, clock_hz)

    def check(self) -> None:
        """Raise `DeviceError` if the board does not answer, or the error that ended the holding of the mirror."""
        if self.fault is not None:
            raise self.fault
        if self._stream is None:
            self._line.ask(PING)
        else:
            self._stream.ping()

    def halt(self) -> float:
        """Stop the board by its emergency stop, and clear that again; returns 0, the centre, to which the mirror
        jumps."""
        self._let_go()
        self._stream = None
        self._line.tell(EMERGENCY)
        self._clear()
        return 0.0

    def take_over(self) -> PointStream:
        """End the thread that holds the mirror, and return its stream. The points queued in that stream hold the mirror
        for up to `HOLD_S` more. If the board is idle, the stream is a new one. Raises the error that ended the holding,
        if one did."""
        if (fault := self._let_go()) is not None:
            raise fault
        if self._stream is None:
            self._stream = PointStream(self._line, self.name, self.config.axis, self.capacity, self.clock)
        return self._stream

    def hold(self, stream: PointStream, command: float) -> None:
        """Start a thread that holds the mirror at `command`, the position at which it rests."""
        self._letting_go = threading.Event()  # a new one: it is never cleared for a thread that is about to end
        run = (stream, command, self._letting_go)
        self._holder = threading.Thread(target=self._hold, args=run, name=f"{self.name} hold", daemon=True)
        self._holder.start()

    def close(self) -> None:
        """Make the board idle and close the connection. Raises the error by which the connection was lost, if it
        was."""
        try:
            self._let_go()
            if self._line.ask(PING).playback != IDLE:
                self._line.tell(STOP)
        finally:
            self._line.close()

    def _let_go(self) -> DeviceError | None:
        """End the thread that holds the mirror; returns the error that had ended it before, None if none had."""
        holder, self._holder = self._holder, None
        self._letting_go.set()
        if holder is not None and holder.ident is not None:
            holder.join()
        fault, self.fault = self.fault, None
        return fault

    def _hold(self, stream: PointStream, command: float, letting_go: threading.Event) -> None:
        try:
            while not letting_go.is_set():
                stream.hold(command)
                self.clock.sleep(_HOLD_POLL_S)
        except Exception as error:
            self.fault = error if isinstance(error, DeviceError) else DeviceFault(f"{self.name} failed: {error!r}")
            _log.error("%s", error)

    def _settle(self) -> None:
        """Make the board idle and ready, once it has played what an earlier program left in its buffer. Raises
        `DeviceBusy` if it goes on playing or plays from a source of its own, and as `_clear`."""
        end_s = now_s(self.clock) + LEAST_CAPACITY / HOLD_PPS + PATIENCE_S
        while (reply := self._line.ask(PING)).playback == PLAYING and reply.source == 0 and now_s(self.clock) < end_s:
            self.clock.sleep(_HOLD_POLL_S)
        if reply.source != 0:
            raise DeviceBusy(f"{self.name}: plays from its own source {reply.source}; select the network as its source")
        if reply.playback == PLAYING:
            raise DeviceBusy(f"{self.name}: plays for another client; end that one")
        if reply.playback == PREPARED:
            self._line.tell(STOP)
        if reply.light_engine != READY:
            _log.warning("%s: found in emergency stop or with its link just lost; clearing that", self.name)
            self._clear()

    def _clear(self) -> None:
        """Leave the emergency stop. Raises `DeviceFault` if its cause persists."""
        reply: Reply = self._line.ask(CLEAR)
        if reply.code == STILL_STOPPED or reply.light_engine != READY or reply.playback != IDLE:
            raise EmergencyStop(
                f"{self.name}: stays in emergency stop (state {reply.light_engine}); release its stop input, then "
                "start again"
            )


class EtherDreamRun(DacRun):
    """One run: `begin`, then `feed`. No wait is longer than the queued points take plus two seconds."""

    def __init__(self, dac: EtherDreamDac, source: PointSource, clock_hz: Fraction) -> None:
        self.source = source
        self._dac = dac
        self._clock_hz = clock_hz
        self._most = max(2, round(dac.config.buffer * float(clock_hz)))
        self._stream: PointStream
        self._end: int | None = None
        """Number of points that the stream had sent with the run's last one; None: that was not sent yet."""

    def begin(self) -> None:
        """Send the first points. They play at once if the board is idle, else after the points that hold the mirror."""
        self._stream = self._dac.take_over()
        idle = self._stream.sent == 0
        self._stream.change_rate(self._clock_hz, self._most)
        self._pump()
        while idle and self._stream.room:
            self._pump()
        if idle:
            self._stream.begin()

    def feed(self, stopping: threading.Event) -> None:
        """Send the other points; returns when the last one was played. A thread then holds the mirror there. Brakes
        once another thread sets `stopping`."""
        stopped = False
        while self._end is None or not self._stream.is_played(self._end):
            if not stopped and stopping.is_set():
                stopped = True
                self.source.stop()
            self._pump()
            self._dac.clock.sleep(POLL_S)
        self._dac.hold(self._stream, self.source.last)

    def _pump(self) -> None:
        """Send what there is room for: points of the run, then those that hold the mirror."""
        if self.source.left:
            self._stream.send(self.source.take(self._stream.room))
        if not self.source.left:
            if self._end is None:
                self._end = self._stream.sent
                self._stream.change_rate(Fraction(HOLD_PPS), round(HOLD_S * HOLD_PPS))
            self._stream.hold(self.source.last)


class EtherDream(DacScanner):
    """A galvo behind an Ether Dream."""

    _dac: EtherDreamDac

    @classmethod
    def open(
        cls,
        port: str,
        *,
        max_velocity_per_s: float,
        max_acceleration_per_s2: float,
        max_point_rate_hz: float = 30_000.0,
        buffer_s: float = 0.06,
        clock: Clock | None = None,
        **settings: Any,
    ) -> "EtherDream":
        """Open an Ether Dream by itself. Commands are drives from -1 to 1, so the galvo's limits are in drive per
        second and per second squared.

        port: "HOST" or "HOST:PORT". max_point_rate_hz, buffer_s: the most points per second; the duration of the points
        queued in the board. settings: axis, max_step, rms_duty, command_range, park, as in `EtherDreamConfig`. clock:
        that of an emulator; None: the system's clock. Raises `LimitExceeded` for a setting that is not possible, and
        another `DeviceError` if the board cannot be opened.
        """
        config = config_of(
            EtherDreamConfig,
            port=port,
            max_velocity_per_s=max_velocity_per_s,
            max_acceleration_per_s2=max_acceleration_per_s2,
            max_point_rate_hz=max_point_rate_hz,
            buffer_s=buffer_s,
            **settings,
        )
        return _opened(config, Endpoint(port), clock or SystemClock())

    def _do_status(self) -> ScannerStatus:
        try:
            return super()._do_status()
        except DeviceFault:
            self._note_lost_hold()
            return super()._do_status()

    def _make_safe(self) -> None:
        try:
            super()._make_safe()
        except EmergencyStop as error:  # somebody holds its stop input: it is dark, with the mirror at the centre
            _log.warning("%s", error)

    def _rest(self) -> float:
        self._note_lost_hold()
        return super()._rest()

    def _note_lost_hold(self) -> None:
        """Note if the mirror is not held any more where it rested."""
        fault = self._dac.fault
        if fault is not None and self._motion.error is None:
            self._motion.position, self._motion.error = None, fault


def _opened(config: EtherDreamConfig, endpoint: Endpoint, clock: Clock, tap: Tap | None = None) -> EtherDream:
    dac = EtherDreamDac(config, endpoint, clock, tap)
    try:
        return EtherDream(dac, config)
    except BaseException:
        dac.close()
        raise


def create(config: EtherDreamConfig, surroundings: Surroundings) -> EtherDream:
    """Open the Ether Dream at the config's port."""
    return _opened(config, resolve(config.port, surroundings.ports), surroundings.clock, surroundings.tap)


KIND = Kind(config=EtherDreamConfig, create=create)
