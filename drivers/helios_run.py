"""One run of a Helios: frames into its two buffers, and a judgement whether they ever ran dry (hardware.md 3.1).

The host sees when the pending buffer falls free, no more. Between the last status 'full' and the first 'free' the
pending frame began to play; that bounds when it ends. A frame that arrives after the earliest such end may have left
the mirror standing: the run ends with a fault. A buffer that falls free before the playing frame can have ended means
that the device dropped a frame in silence. What was really played only the markers in the SPAD's stream tell.
"""

import threading
from fractions import Fraction

from drivers.clock import NS_PER_S, Clock
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.helios_frames import FLAG_SINGLE, FLAG_START, MOST_POINTS, encode, pps_of, sendable, slice_points
from drivers.helios_link import HeliosLink
from drivers.point_source import PointSource

_POLL_S = 0.002
_SILENT_S = 0.5
"""So long no proper status: the device hangs."""
_PATIENCE_S = 1.0
"""Beyond the time its frames take, for the buffer to fall free."""
_WIRE_BYTES_PER_S = 1.216e6
"""Most that a full-speed bulk endpoint carries: 19 packets of 64 bytes a millisecond (USB 2.0, table 5-9)."""
_DRIFT = 1e-3
"""Most that the device's crystal and the host's clock differ."""


class HeliosRun:
    """Begin, then feed. Every wait has an end: at most two frames and two seconds."""

    def __init__(
        self, link: HeliosLink, clock: Clock, source: PointSource, clock_hz: Fraction, *, frame_s: float, axis: str
    ) -> None:
        self.source = source
        self._link = link
        self._clock = clock
        self._pps = pps_of(clock_hz)
        self._rate_hz = float(clock_hz)
        self._axis = axis
        most = min(MOST_POINTS, max(2, round(frame_s * self._rate_hz)))
        self._most = most if sendable(most) else most - 1
        self._sent = 0
        self._playing_s = self._pending_s = 0.0
        """Durations of the frames in the two buffers; 0: none."""
        self._earliest_end_s = self._latest_end_s = 0.0
        """When the playing frame ends, on the host's clock."""
        self._next: tuple[bytes, float] | None = None
        """The frame to be sent next and its duration: made while another plays, not when the time for it has come."""
        if self._unsendable():
            source.pad_start()

    def begin(self) -> None:
        """Send the first frame; it plays once it is whole."""
        self._wait_until_idle()
        first, duration_s = self._made(FLAG_SINGLE | FLAG_START)
        earliest_s, arrived_s = self._send(first)
        self._playing_s = duration_s
        self._earliest_end_s = earliest_s + duration_s * (1 - _DRIFT)
        self._latest_end_s = arrived_s + duration_s * (1 + _DRIFT)
        self._next = self._made() if self.source.left else None

    def feed(self, stopping: threading.Event) -> None:
        """Send all that is left; returns when the mirror rests. Brakes once `stopping` is set."""
        stopped = False
        while self._next is not None:
            if not stopped and stopping.is_set():
                stopped = True
                self._brake()
            elif self._wait_until_free(None if stopped else stopping):
                self._append(*self._next)
            else:
                continue
            self._next = self._made() if self.source.left else None
        latest_s = self._latest_end_s + self._pending_s * (1 + _DRIFT)
        self._clock.sleep(latest_s - self._now_s())

    def _append(self, frame: bytes, duration_s: float) -> None:
        """One more frame, behind the playing one."""
        _, arrived_s = self._send(frame)
        late_s = arrived_s - self._earliest_end_s
        if late_s > 0:
            raise DeviceFault(
                f"{self._link.name}: the points ran dry, frame {self._sent} came up to {1e3 * late_s:.1f} ms late; "
                "lengthen frame or unload the host"
            )
        self._pending_s = duration_s
        self._check_kept()

    def _check_kept(self) -> None:
        """A frame that was taken and kept means 'full' until the playing one ends."""
        free = None
        while free is None and self._now_s() < self._earliest_end_s:
            free = self._link.free()
        if free is False:
            return
        if self._now_s() < self._earliest_end_s:
            self._raise_dropped()
        raise DeviceFault(
            f"{self._link.name}: answered too late to tell whether it kept frame {self._sent}; "
            "lengthen frame or unload the host"
        )

    def _raise_dropped(self) -> None:
        raise DeviceFault(f"{self._link.name}: dropped a frame in silence; check the cable, then start again")

    def _made(self, flags: int = FLAG_SINGLE) -> tuple[bytes, float]:
        """The next frame and its duration."""
        points = self.source.take(slice_points(self.source.left, self._most))
        return encode(points, self._axis, self._pps, flags), len(points) / self._rate_hz

    def _send(self, frame: bytes) -> tuple[float, float]:
        """The host's times between which the frame arrived."""
        began_s = self._now_s()
        self._link.send_frame(frame)
        self._sent += 1
        return began_s + len(frame) / _WIRE_BYTES_PER_S, self._now_s()

    def _brake(self) -> None:
        self.source.give_back()
        self.source.stop()
        if self._unsendable():
            self.source.pad_end()

    def _unsendable(self) -> bool:
        return self.source.left <= self._most and not sendable(self.source.left)

    def _wait_until_idle(self) -> None:
        end_s = self._now_s() + _SILENT_S
        while not self._link.free():
            if self._now_s() > end_s:
                raise DeviceTimeout(f"{self._link.name}: takes no frame; unplug it and plug it in again")
            self._clock.sleep(_POLL_S)

    def _wait_until_free(self, stopping: threading.Event | None) -> bool:
        """True once the pending buffer is free; False where a stop came first."""
        heard_s, full_s = self._now_s(), self._earliest_end_s
        while stopping is None or not stopping.is_set():
            asked_s = self._now_s()
            free = self._link.free()
            now_s = self._now_s()
            if free:
                self._note_swap(max(full_s, self._earliest_end_s), now_s)
                return True
            if free is None and now_s - heard_s > _SILENT_S:
                raise DeviceTimeout(f"{self._link.name}: gives no status; unplug it and plug it in again")
            if free is False:
                heard_s, full_s = now_s, asked_s
            if now_s > self._latest_end_s + _PATIENCE_S:
                raise DeviceFault(f"{self._link.name}: its frame buffer stays full; unplug it and plug it in again")
            self._clock.sleep(_POLL_S)
        return False

    def _note_swap(self, earliest_s: float, latest_s: float) -> None:
        """The pending frame, if any, began to play between these times."""
        if not self._pending_s:
            return
        if latest_s < self._earliest_end_s - _POLL_S:
            self._raise_dropped()
        self._playing_s, self._pending_s = self._pending_s, 0.0
        self._earliest_end_s = earliest_s + self._playing_s * (1 - _DRIFT)
        self._latest_end_s = min(latest_s, self._latest_end_s) + self._playing_s * (1 + _DRIFT)

    def _now_s(self) -> float:
        return self._clock.now_ns() / NS_PER_S
