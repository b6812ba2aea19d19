"""An Ether Dream laser DAC of the first generation as its firmware behaves, traps included (j4cbo/j4cDAC 12ecbe5, the
same as release v0.5.5 in all that is modelled; docs/reference/devices/etherdream.md).

Points go over TCP into a ring that is played at a timer's rate. The firmware deviates from the page
ether-dream.com/protocol.html: data that does not fit is taken in part and then refused with NAK I, never F; b, q and c
are acknowledged although nothing happens; a rate that is too high costs one byte, so that the next bytes are read as
commands; an unknown command closes the connection; a rate of 0 stops the processor. A client that goes away does not
stop playing. `by_page=True` models a device that does as the page says; newer, closed firmware may.

Not public, and chosen here: whether the timer's period is MR0 ticks, as the author of the firmware intends, or one
more (`extra_ticks`); which level of an output deflects to which side; what reads the stop input, which the page has but
this firmware has not. The commands of plugins (I, P, D) count as unknown.
"""

import struct
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.helios import CENTRE, DAC_STEPS, Array, DacHistory, Played

TIMER_HZ = 24_000_000
"""Clock of the timer: the processor's 96 MHz, divided by 4."""
MAX_RATE_HZ = 100_000
CAPACITY = 1799
"""Most points in the ring, whose 1800 places are never all used."""
QUEUED_RATES = 199
POINT_BYTES = 18
PORT = 7765
START_RATE_HZ = 30_000

IDLE, PREPARED, PLAYING = 0, 1, 2
"""States of playback."""
READY, ESTOP = 0, 3
"""States of the light engine. Nothing enters 1 (warm-up) and 2 (cool-down)."""
SHUTTER, UNDERFLOW, STOPPED = 1, 2, 4
"""Bits of the playback flags: shutter open, stream ended by underflow, stream ended by an emergency stop."""
BY_PACKET, BY_INPUT, INPUT_NOW, LINK_LOST = 1, 2, 4, 32
"""Causes of an emergency stop: bits of the light engine's flags."""
_CLEARABLE = BY_PACKET | BY_INPUT | LINK_LOST
_LENGTHS = {ord("b"): 7, ord("u"): 7, ord("q"): 5, ord("d"): 3}
"""Bytes of the commands that have more than one, without the points."""
_HARDWARE, _SOFTWARE = 1, 2


class EtherDreamModel:
    """The firmware. Its attributes are the truth, for tests to look at; the driver sees only the replies.

    `history` reaches to the end of the point that is shown: later points can still be stopped.
    """

    def __init__(
        self,
        *,
        axis: Literal["x", "y"] = "x",
        clock_error: float = 0.0,
        extra_ticks: int = 0,
        by_page: bool = False,
        capacity: int = CAPACITY,
        mac: bytes = b"\x00\x04\xa3\x87\x28\xcd",
        build: str = "v0.5.5",
    ) -> None:
        """axis: the one whose mirror the history follows. clock_error: relative error of its crystal, positive if it
        runs fast. extra_ticks, by_page: see the module. capacity: most points in the ring. build: text of its version.
        """
        self.history = DacHistory(CENTRE, lines=4)
        self.deaf = False
        """Test knob: whether the firmware hears and says nothing, while its outputs play on."""
        self.panicked = False
        """Whether the processor has stopped, outputs dark and centred, until the power comes anew."""
        self.hung_up = False
        """Whether the firmware has closed the connection."""
        self.refused = 0
        """Points that were not taken."""
        self.lost_rates = 0
        """Rate changes that were acknowledged and dropped."""
        self.playback = IDLE
        self.causes = 0
        """Causes of the emergency stop, as bits."""
        self.flags = 0
        """Playback flags."""
        self.rate_hz = START_RATE_HZ
        self.point_count = 0
        self.queued_rates: list[int] = []
        self._axis, self._hz = axis, TIMER_HZ * (1 + clock_error)
        self._extra_ticks, self._by_page, self._capacity = extra_ticks, by_page, capacity
        self._mac, self._build = mac, build
        self._ring = np.empty((0, 9), np.uint16)
        self._written: NDArray[np.uint16] | None = None
        """The point (1, 9) that the converters show from the timer's next period on."""
        self._next_s = 0.0
        """Time at which the timer's next period begins."""
        self._received = self._replies = b""
        self._points_left = 0
        self._aborting = False

    @property
    def light_engine(self) -> int:
        """State of the light engine."""
        return ESTOP if self.causes else READY

    @property
    def fullness(self) -> int:
        """Number of points in the ring. A stop leaves them there until the next command p."""
        return len(self._ring)

    def connected(self, now_s: float) -> None:
        """Greet a client as if it had pinged. Playback is as the last client left it."""
        self.advance(now_s)
        self._forget_client()
        if not (self.deaf or self.panicked):
            self._answer("a", ord("?"))

    def disconnected(self, now_s: float) -> None:
        """Note that the client is gone: the ring plays on until it is empty."""
        self.advance(now_s)
        self._forget_client()

    def receive(self, data: bytes, now_s: float) -> None:
        """Take commands and points from the client, in pieces of any size."""
        self.advance(now_s)
        if self.deaf:
            return
        self._received += data
        while self._received and not (self.hung_up or self.panicked):
            used = self._take_points() if self._points_left else self._take_command(now_s)
            if not used:
                return
            self._received = self._received[used:]

    def send(self, limit: int, now_s: float) -> bytes:
        """The next bytes for the client."""
        out, self._replies = self._replies[:limit], self._replies[limit:]
        return out

    def broadcast(self, now_s: float) -> bytes:
        """The datagram of 36 bytes that goes to UDP port 7654 of the local network once a second."""
        self.advance(now_s)
        head = struct.pack("<6sHHHI", self._mac, _HARDWARE, _SOFTWARE, self._capacity, MAX_RATE_HZ)
        return head + self._status()

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        self.advance(now_s)
        return self.playback == PLAYING

    def advance(self, now_s: float) -> None:
        """Play on until now. Each period of the timer shows the point that was read out before it, and reads out the
        next one. If that one changes the rate, the new rate holds from the period that shows it. If there is no next
        one, all outputs go to 0 V at once, and the point read out last is never shown."""
        while self.playback == PLAYING and self._next_s <= now_s:
            if not len(self._ring):
                self._stop(UNDERFLOW, self._next_s)
                return
            period_s = self._period_s()
            due = int((now_s - self._next_s) / period_s + 1e-9) + 1
            block = self._ring[:due]
            changes = np.flatnonzero(block[:, 0] & 0x8000)
            if len(changes):
                block = block[: changes[0] + 1]
            self._ring = self._ring[len(block) :]
            self.point_count += len(block)
            self._show(block, period_s)
            if len(changes) and self.queued_rates:
                self._set_rate(self.queued_rates.pop(0), self._next_s - period_s)

    def stop_input(self, active: bool, now_s: float) -> None:
        """Open the interlock (active) or close it. A stop remains until the command c is sent with the interlock
        closed."""
        self.advance(now_s)
        if active:
            self._emergency_stop(BY_INPUT | INPUT_NOW, now_s)
        elif self.causes & INPUT_NOW:
            self.causes = self.causes & ~INPUT_NOW | BY_INPUT

    def link(self, up: bool, now_s: float) -> None:
        """Pull the network's cable, which is an emergency stop, or plug it in, which ends this stop without the command
        c. The connection survives.
        """
        self.advance(now_s)
        if up:
            self.causes &= ~LINK_LOST
        else:
            self._emergency_stop(LINK_LOST, now_s)

    def power_up(self, now_s: float) -> None:
        """Switch the supply off and on. The board forgets its client without closing the connection."""
        self.advance(now_s)
        self._stop(0, now_s)
        self._forget_client()
        self.causes = self.flags = 0
        self.rate_hz, self.queued_rates, self.panicked = START_RATE_HZ, [], False
        self._ring = self._ring[:0]

    def _period_s(self) -> float:
        return (TIMER_HZ // self.rate_hz + self._extra_ticks) / self._hz

    def _show(self, block: NDArray[np.uint16], period_s: float) -> None:
        """Let the timer begin as many periods as the block has points, and read these out."""
        start_s, self._next_s = self._next_s, self._next_s + len(block) * period_s
        if self._written is None:  # the first period after b shows nothing yet
            shown, start_s = block[:-1], start_s + period_s
        else:
            shown = np.concatenate([self._written, block[:-1]])
        self._written = block[-1:]
        if len(shown):
            self.history.play(Played(start_s, self._next_s, period_s, self._command(shown), _levels(shown)))

    def _command(self, points: NDArray[np.uint16]) -> Array:
        """Normalised drive of the mirror: the upper 12 of 16 bits, of which 0 is the centre."""
        position = points[:, 1 if self._axis == "x" else 2].astype(np.int16).astype(np.int64)
        steps = (position + 0x8000) >> 4
        return np.asarray(steps / DAC_STEPS * 2 - 1)

    def _take_points(self) -> int:
        """Take whole points as far as there is room; once there is none, the rest of the packet is dropped."""
        points = min(len(self._received) // POINT_BYTES, self._points_left)
        if not points:
            return 0
        raw = np.frombuffer(self._received, "<u2", points * 9).reshape(points, 9).astype(np.uint16)
        room = 0 if self._aborting or self.playback == IDLE else self._capacity - self.fullness
        self._ring = np.concatenate([self._ring, raw[:room]])
        self._aborting |= points > room
        self.refused += max(0, points - room)
        self._points_left -= points
        if not self._points_left:
            refusal = "F" if self._by_page and self.playback != IDLE else "I"
            self._answer(refusal if self._aborting else "a", ord("d"))
        return points * POINT_BYTES

    def _take_command(self, now_s: float) -> int:
        """Obey one command; returns the number of its bytes, 0 while some are missing."""
        code = self._received[0]
        length = _LENGTHS.get(code, 1)
        if len(self._received) < length:
            return 0
        (number,) = struct.unpack("<I", self._received[length - 4 : length]) if length >= 5 else (0,)
        if number > MAX_RATE_HZ or (self._by_page and length >= 5 and not number):
            self._answer("I", code)
            return length if self._by_page else 1
        match chr(code):
            case "d":
                self._begin_data()
            case "v":
                self._replies += self._build.encode()[:31].ljust(32, b"\0")
            case command:
                self._obey(command, number, now_s)
        return length

    def _begin_data(self) -> None:
        (self._points_left,) = struct.unpack("<H", self._received[1:3])
        self._aborting = False
        if self._by_page and self.playback == IDLE and not self._points_left:
            self._answer("I", ord("d"))
        elif self._by_page and self.playback != IDLE and self._points_left > self._capacity - self.fullness:
            self._aborting = True
        elif not self._points_left:
            self._answer("a", ord("d"))

    def _obey(self, command: str, number: int, now_s: float) -> None:
        code, response = ord(command), "a"
        match command:
            case "p":
                response = self._prepare()
            case "b":
                response = self._begin(number, now_s)
            case "u":
                self._set_rate(number, now_s)
            case "q":
                response = self._queue_rate(number)
            case "s" if self.playback == IDLE:
                response = "I"
            case "s":
                self._stop(0, now_s)
            case "\0" | "\xff":
                self._emergency_stop(BY_PACKET, now_s)
            case "c":
                response = "I" if self._by_page and not self.causes else "a"
                self.causes &= ~_CLEARABLE
                response = "!" if self.causes else response
            case "?":
                pass
            case _ if self._by_page:
                self._emergency_stop(BY_PACKET, now_s)
            case _:
                self.hung_up, self._received = True, b""
        if not (self.hung_up or self.panicked):
            self._answer(response, code)

    def _prepare(self) -> str:
        if self.playback != IDLE or self.causes:
            return "I"
        self._ring, self.queued_rates, self.point_count = self._ring[:0], [], 0
        self.flags &= SHUTTER
        self.playback = PREPARED
        return "a"

    def _begin(self, rate_hz: int, now_s: float) -> str:
        """Begin to play. Acknowledged, and the rate is set, even if nothing was prepared; if the ring is empty, the
        first period ends with an underflow."""
        if self._by_page and (self.playback != PREPARED or not self.fullness):
            return "I"
        self._set_rate(rate_hz, now_s)
        if self.playback == PREPARED and not self.panicked:
            self.playback = PLAYING
            self.flags |= SHUTTER
            self._written, self._next_s = None, now_s + self._period_s()
        return "a"

    def _queue_rate(self, rate_hz: int) -> str:
        """Queue a rate for the next point that asks for one. It is acknowledged even if it is dropped."""
        if self.playback != IDLE and len(self.queued_rates) < QUEUED_RATES:
            self.queued_rates.append(rate_hz)
            return "a"
        self.lost_rates += 1
        if not self._by_page:
            return "a"
        return "I" if self.playback == IDLE else "F"

    def _set_rate(self, rate_hz: int, now_s: float) -> None:
        """Set the rate from the timer's next period on. A rate of 0 fails an assertion, which ends everything."""
        if rate_hz:
            self.rate_hz = rate_hz
        else:
            self._stop(0, now_s)
            self.panicked = True

    def _emergency_stop(self, causes: int, now_s: float) -> None:
        self.causes |= causes
        self._stop(STOPPED, now_s)

    def _stop(self, flags: int, now_s: float) -> None:
        """End playing: colours low, mirrors at the centre, shutter closed; the ring keeps its points."""
        if self.playback == PLAYING:
            self.history.cut(now_s, CENTRE)
        self.playback, self.point_count, self._written = IDLE, 0, None
        self.flags = self.flags & ~SHUTTER | flags

    def _answer(self, response: str, command: int) -> None:
        self._replies += bytes((ord(response), command)) + self._status()

    def _status(self) -> bytes:
        """Status of 20 bytes. The firmware says the light engine's state where its flags belong."""
        reported = self.playback == PLAYING or (self._by_page and self.playback == PREPARED)
        return struct.pack(
            "<BBBBHHHHII",
            0,
            self.light_engine,
            self.playback,
            0,
            self.causes if self._by_page else self.light_engine,
            self.flags,
            0,
            self.fullness,
            self.rate_hz if reported else 0,
            self.point_count,
        )

    def _forget_client(self) -> None:
        self._received = self._replies = b""
        self._points_left, self._aborting, self.hung_up = 0, False, False


def _levels(points: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Levels (n, 4) of r, g, b and i: their upper 12 bits in steps of 16, rounded up, so that 0 is dark."""
    levels: NDArray[np.uint8] = np.minimum(((points[:, 3:7] >> 4) + 15) >> 4, 255).astype(np.uint8)
    return levels
