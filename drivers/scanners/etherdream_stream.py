"""The points of an Ether Dream: their bytes, their rates, and whether all were played.

Every reply has the number of points in the buffer and of those played. Their sum must be the number sent: else a point
was lost or repeated, or another client sends points too. Firmware reads the two numbers one after the other, so the sum
may be one too high. Besides, the points must be played at the rate that was set. From each reply follow bounds on the
time at which the first point at this rate was played, and the bounds of all replies must agree. If either check fails,
`DeviceFault` ends the run.

Rates change without a pause: `q` queues a rate, and bit 15 of a point's control word makes it that point's rate. A
point takes floor(24e6 / rate) cycles of 24 MHz: the firmware writes that quotient to the match register of an LPC1758's
PWM, whose counter starts at 1. The clock of other generations is not public. An Ether Dream 2 that was told 30 kHz was
measured at 29 997 Hz, with an uncertainty of 3 Hz. Sources: docs/reference/devices/etherdream.md.
"""

import math
from fractions import Fraction

import numpy as np

from drivers.clock import Clock, now_s
from drivers.errors import DeviceFault
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.scanners.dac_scanner import PATIENCE_S, PointSlice, StartTime
from drivers.scanners.etherdream_line import (
    ACCEPTED,
    BY_EMERGENCY,
    PING,
    PLAYING,
    PREPARE,
    PREPARED,
    REPLY_S,
    STOPPED,
    UNDERFLOW,
    EtherDreamLine,
    Reply,
    begin,
    data,
    queue_rate,
)

TIMER_HZ = 24_000_000
MOST_PPS = 100_000
"""Highest rate of the first generation and of an Ether Dream 2. A higher one would be refused after one byte, and the
rest of the command read as further commands, some as emergency stops."""
MOST_POINTS = 400
"""Most points of one command. They fit into the 7500 B that the firmware takes before it acknowledges any."""
_X_SCALE = 32_760
"""Coordinate at drive 1. Firmware drops the lowest 4 bits of coordinate + 32768. With 32 760 the 12 bits that remain
are the value nearest to the drive, and drive 0 is the centre. A 16-bit converter gets all bits."""
_RATE_CHANGE, _FULL = 0x8000, 0xFFFF
_POINT = np.dtype([(name, "<i2" if name in "xy" else "<u2") for name in ("control", *"xyrgbi", "u1", "u2")])
_TOLERANCE_S = 0.002
"""Time by which two replies may contradict each other about when the first point was played."""
_LATE_S = 0.05
"""Time after the end of the queued points for which a reply is still waited for. Then the points have run dry."""
_MOST_AHEAD = 50
"""Most replies in a row whose count of played points is one ahead. In a sound board even one such reply is rare."""


def pps_of(rate_hz: Fraction) -> int:
    """The integer to request so that the board runs at a rate that `nearest_rate` gave."""
    return math.floor(rate_hz)


def nearest_rate(requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
    """The rate nearest to `requested_hz`, between `low_hz` and `high_hz`, at which the board can really run."""
    near = math.floor(requested_hz)
    cycles = round(TIMER_HZ / requested_hz)
    # If any whole number of pps gives n cycles a point, floor(24e6 / n) does.
    candidates = {near, near + 1} | {TIMER_HZ // n for n in (cycles - 1, cycles, cycles + 1)}
    rates = [Fraction(TIMER_HZ, TIMER_HZ // pps) for pps in candidates if pps <= MOST_PPS]
    return min((rate for rate in rates if low_hz <= rate <= high_hz), key=lambda rate: abs(float(rate) - requested_hz))


def encode(points: PointSlice, axis: str, *, rate_change: bool = False) -> bytes:
    """The 18 bytes of each point. R: lit, G: line marker, B: scan marker, I: backward, each 0 or full. The unused axis
    stays at the centre. rate_change: whether the queued rate begins with the first point.
    """
    cells = np.zeros(len(points), _POINT)
    cells["x" if axis == "x" else "y"] = np.rint(points.command * _X_SCALE)
    cells["r"][points.lit] = _FULL
    for name, bit in (("g", MARKER_LINE), ("b", MARKER_SCAN), ("i", LEVEL_BACKWARD)):
        cells[name][points.markers & bit != 0] = _FULL
    if rate_change:
        cells["control"][:1] = _RATE_CHANGE
    return cells.tobytes()


class PointStream:
    """The points sent since `PREPARE`. Every reply of the board is checked against them."""

    def __init__(self, line: EtherDreamLine, name: str, axis: str, capacity: int, clock: Clock) -> None:
        """Prepare the board, which must be idle. name: the board's name in messages. axis: "x" or "y", the output of
        the mirror. capacity: most points that the board's buffer holds. Raises what `EtherDreamLine.tell` raises."""
        self.sent = 0
        self.played = 0
        self._line, self._name, self._axis, self._capacity, self._clock = line, name, axis, capacity, clock
        self._began = self._turns = False
        self._from = self._most = self._pps = self._first_pps = self._ahead = 0
        self._rate_hz = 1.0
        self._start = StartTime()
        """Bounds of the time of the first point at the present rate."""
        self._moved_s = 0.0
        self._dry_s = math.inf
        """Time by which all points sent will have been played; inf: none was played yet."""
        line.tell(PREPARE)

    def change_rate(self, clock_hz: Fraction, most: int) -> None:
        """Play the points sent from here on at `clock_hz`. most: the largest number of them queued at a time."""
        pps = pps_of(clock_hz)
        self._turns = self.sent > 0 and pps != self._pps
        if self._turns:
            self._line.tell(queue_rate(pps))
        self._from, self._most, self._pps, self._rate_hz = self.sent, most, pps, float(clock_hz)
        self._first_pps = self._first_pps or pps
        self._start = StartTime()

    @property
    def room(self) -> int:
        """Number of points that may be sent with the next command."""
        at_this_rate = self.sent - max(self.played, self._from)
        free = self._capacity - (self.sent - self.played)
        return max(0, min(self._most - at_this_rate, free, MOST_POINTS))

    def is_played(self, n: int) -> bool:
        """Whether the first n points were played, according to the board's last reply. False after a reply whose sum is
        one too high: it proves nothing."""
        return self.played >= n and not self._ahead

    def send(self, points: PointSlice) -> None:
        """Append points to the board's buffer, no more than there is `room` for. Without points, only ask how far the
        board is. Raises `DeviceFault` if points were not played as they should be, and what `EtherDreamLine.ask`
        raises."""
        n = len(points)
        if not n:
            self.ping()
            return
        self._exchange(data(encode(points, self._axis, rate_change=self._turns), n), n)
        self._turns = False

    def hold(self, command: float) -> None:
        """Send dark copies of the point at which the mirror rests, as many as there is `room` for. Raises as `send`."""
        n = self.room
        self.send(PointSlice(np.full(n, command), np.zeros(n, np.uint8), np.zeros(n, bool)))

    def begin(self) -> None:
        """Make the board begin to play. Raises as `send`."""
        self._began = True
        self._moved_s = now_s(self._clock)
        self._exchange(begin(self._first_pps))

    def ping(self) -> None:
        """Ask how far the board is. Raises as `send`."""
        self._exchange(PING)

    def _exchange(self, command: bytes, n: int = 0) -> None:
        with self._line.lock:
            asked_s = now_s(self._clock)
            reply = self._line.ask(command, min(REPLY_S, max(self._dry_s - asked_s, 0.0) + _LATE_S))
            self.sent += n
            self._dry_s += n / self._rate_hz
            self._check(reply, asked_s, now_s(self._clock))

    def _check(self, reply: Reply, asked_s: float, answered_s: float) -> None:
        if reply.playback != (PLAYING if self._began else PREPARED):
            raise DeviceFault(f"{self._name}: {_why(reply)}")
        if reply.code != ACCEPTED:
            raise DeviceFault(f"{self._name}: refused points with {reply.code!r}; is another client sending, too?")
        played = self.sent - reply.fullness
        ahead = (reply.count - played) % 2**32
        self._ahead = self._ahead + 1 if ahead else 0
        if ahead > 1 or self._ahead > _MOST_AHEAD:
            raise DeviceFault(
                f"{self._name}: of {self.sent} points sent, {reply.fullness} are queued and {reply.count} were "
                "played: points were lost or repeated; end its other clients, then start again"
            )
        if played > self.played:
            self._moved_s = answered_s
        elif self._began and answered_s - self._moved_s > PATIENCE_S:
            raise DeviceFault(f"{self._name}: plays no points for {PATIENCE_S:g} s; power-cycle it")
        self.played = played
        if played > self._from:  # all that is queued plays at the present rate
            self._dry_s = answered_s + (self.sent - played) / self._rate_hz
        if played > self._from + 1:  # the timer takes a new rate over one point after the one that asks for it
            self._check_rate(reply.rate_hz, asked_s, answered_s)

    def _check_rate(self, said_hz: int, asked_s: float, answered_s: float) -> None:
        """Check the rate that the board states, and the one at which it plays."""
        n = self.played - self._from
        off_s = self._start.narrow(asked_s - n / self._rate_hz, answered_s - (n - 1) / self._rate_hz, answered_s)
        if said_hz != self._pps:
            raise DeviceFault(f"{self._name}: plays at {said_hz} Hz instead of {self._pps} Hz; end its other clients")
        if off_s > _TOLERANCE_S:
            raise DeviceFault(
                f"{self._name}: after {n} points at {self._pps} Hz it is {1e3 * off_s:.1f} ms off; its clock is not "
                "the expected one: choose another DAC"
            )


def _why(reply: Reply) -> str:
    """The reason for which the board does not play, and the next step."""
    if reply.light_engine == STOPPED or reply.flags & BY_EMERGENCY:
        why = "an emergency stop or a lost Ethernet link ended playback; find its cause, then start again"
    elif reply.flags & UNDERFLOW:
        why = "the points ran dry; lengthen buffer or unload host and network"
    else:
        why = f"playback was stopped from elsewhere (state {reply.playback}); end the board's other clients"
    return f"dark, and the mirror has jumped to the centre: {why}"
