"""One run of a LaserCube: samples into its ring, and a judgement whether each was played once (hardware.md 3.2).

Every question 'how many are queued' says when the first sample must have been played, if none was lost, played twice
or waited for: the moments that all answers allow must have one in common. Samples go out in whole transfers, so that a
lost one stands out. A run begins with copies of its first point: what is lost before the first answer is one of them.
It ends with copies of its last: what the device does when its ring runs empty is not documented (hold or repeat), so
that the ring is cleared while they are played.
"""

import math
import threading

import numpy as np

from drivers.clock import NS_PER_S
from drivers.errors import DeviceFault
from drivers.lasercube_link import SAMPLES_PER_TRANSFER, LaserCubeLink, encode
from drivers.point_source import Points, PointSource

_POLL_S = 0.002
_PATIENCE_S = 1.0
_HOLD_S = 0.03
"""Of the first and the last point, at least: the host may be late by this when it asks first and clears last."""
_DRIFT = 1e-3
"""Most that the device's crystal and the host's clock differ."""
_TOLERANCE_POINTS = 48
"""Less than a transfer, which is what gets lost as a whole; more than the device's own steps in counting."""


class LaserCubeRun:
    """Begin, then feed. Every wait has an end: what is queued and a second."""

    def __init__(
        self, link: LaserCubeLink, source: PointSource, rate_hz: int, *, buffer_s: float, axis: str, markers: bool
    ) -> None:
        self.source = source
        self._link = link
        self._rate_hz = rate_hz
        self._axis = axis
        self._markers = markers
        wanted = math.ceil(max(_HOLD_S, buffer_s / 2) * rate_hz / SAMPLES_PER_TRANSFER)
        # In whole transfers, and at most a quarter of the ring.
        self._hold = max(1, min(wanted, link.ring_points // 4 // SAMPLES_PER_TRANSFER)) * SAMPLES_PER_TRANSFER
        self._most = min(round(buffer_s * rate_hz), link.ring_points - 2 * self._hold)
        if source.left:
            source.pad_start(self._hold)
        self._waiting = b""
        """Samples short of a transfer."""
        self._sent = 0
        self._start_s = (-np.inf, np.inf)
        """When the first sample was played, at the earliest and at the latest."""
        self._asked_s = 0.0

    def begin(self) -> None:
        """Begin with copies of the first point; they play at once."""
        self._link.clear()
        self._link.set_rate(self._rate_hz)
        self._link.enable(self._markers)
        self._asked_s = self._now_s()
        self._send(self.source.take(self._hold))
        self._queued()
        self._send(self.source.take(self._most - self._hold))

    def feed(self, stopping: threading.Event) -> None:
        """Send all that is left; returns when the mirror rests. Brakes once `stopping` is set."""
        stopped = False
        while self.source.left:
            queued = self._queued()
            if not stopped and stopping.is_set():
                stopped = True
                self.source.stop()
            if queued < self._most:
                self._send(self.source.take(self._most - queued))
            self._link.clock.sleep(_POLL_S)
        self._finish()

    def _finish(self) -> None:
        """Copies of the last point, and an end among them."""
        hold = self._hold + -(len(self._waiting) // 8) % SAMPLES_PER_TRANSFER
        self._send(Points(np.full(hold, self.source.last), np.zeros(hold, np.uint8), np.zeros(hold, bool)))
        end_s = self._now_s() + (self._most + hold) / self._rate_hz * (1 + _DRIFT) + _PATIENCE_S
        seen = False
        while True:
            asked_s = self._now_s()
            queued = self._queued()
            # An answer that took long bounds nothing: one quick answer must have vouched for the last points.
            seen = seen or self._now_s() - asked_s < _TOLERANCE_POINTS / self._rate_hz
            if queued < self._hold - _TOLERANCE_POINTS:
                break
            if self._now_s() > end_s:
                raise DeviceFault(f"{self._link.name}: its buffer does not empty; unplug it and plug it in again")
            self._link.clock.sleep(_POLL_S)
        self._link.safe()
        if not seen:
            raise DeviceFault(f"{self._link.name}: answered too late to tell how the run ended; unload the host")

    def _send(self, points: Points) -> None:
        """Whole transfers; what is short of one waits."""
        self._waiting += encode(points, self._axis, markers=self._markers)
        whole = len(self._waiting) // (8 * SAMPLES_PER_TRANSFER) * 8 * SAMPLES_PER_TRANSFER
        self._link.send(self._waiting[:whole])
        empty_s = min(self._start_s) + self._sent / self._rate_hz
        if whole and np.isfinite(empty_s) and self._now_s() > empty_s:
            self._raise_dry()
        self._waiting = self._waiting[whole:]
        self._sent += whole // 8

    def _raise_dry(self) -> None:
        raise DeviceFault(f"{self._link.name}: the points ran dry; lengthen buffer or unload the host")

    def _queued(self) -> int:
        """Samples not yet played; `DeviceFault` where their number cannot be."""
        before_s = self._now_s()
        queued = self._link.queued()
        after_s = self._now_s()
        if queued == 0:
            self._raise_dry()
        played_s = (self._sent - queued) / self._rate_hz
        slack_s = _DRIFT * (after_s - self._asked_s)
        self._asked_s = after_s
        earliest_s = max(self._start_s[0] - slack_s, before_s - played_s)
        latest_s = min(self._start_s[1] + slack_s, after_s - played_s)
        if earliest_s - latest_s > _TOLERANCE_POINTS / self._rate_hz:
            raise DeviceFault(
                f"{self._link.name}: {(earliest_s - latest_s) * self._rate_hz:.0f} points were lost or played late; "
                "check the cable, then start again"
            )
        self._start_s = (earliest_s, latest_s)
        return queued

    def _now_s(self) -> float:
        return self._link.clock.now_ns() / NS_PER_S
