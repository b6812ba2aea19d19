"""The time of day of frames: UTC of each start of the SPAD, and of the first and the last frame of each map.

A frame has a tick of the device's clock, but no time of day. Two things bound it. A frame was not exposed before the
computer asked the SPAD to start, and its exposure was over when its block arrived. So frame 0 began between the call of
`start` and the earliest arrival, traced back by ticks. The middle of that interval is stated, with half its length as
uncertainty.

Blocks arrive late by varying times, never early. The line below all arrivals that lies closest to them has the
difference of the rates of the two clocks as its slope (Moon, Skelly and Towsley, INFOCOM 1999: one edge of the lower
convex hull). It is used from `LEAST_SPAN_S` and `LEAST_ARRIVALS` on; before that, the rates are taken to be equal
within `CLOCK_TOLERANCE`.

Arrivals are noted in the time of the host's monotonic clock, which no step of UTC changes. UTC is read together with
that clock at the beginning and again later. A step of UTC between the two is stated and added to the uncertainty. The
possible error of the host's UTC itself, as the kernel states it, is noted separately.
"""

import ctypes
import sys
import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any, Final, Literal, NamedTuple

from drivers.interfaces import SpadTiming

Scale = Literal["host", "virtual", "recorded"]
"""Sources of times of day: measured with the host's clock; a simulated rig's own time, in which nothing was
exposed at the moment stated; or taken over from a recording."""

NS: Final = 1_000_000_000
CLOCK_TOLERANCE: Final = 1e-4
"""Largest difference of the rates of two clocks that are not compared: crystals of 50 ppm each."""
LEAST_SPAN_S: Final = 10.0
"""Seconds of frames from which on the rates are compared: arrivals scatter by milliseconds."""
LEAST_ARRIVALS: Final = 64
"""Arrivals from which on the rates are compared: among fewer, few may be quick."""
_SLOPE_DELAYS: Final = 2.0
"""Median delays by which the two quickest arrivals may differ, as far as the slope between them goes."""
MOST_ARRIVALS: Final = 128
"""Arrivals kept of a start. Where there are more, the earlier of two neighbours is kept."""
STEP_S: Final = 1e-3
"""A smaller change of UTC against the monotonic clock is no step: reading the two takes a while."""
_READINGS: Final = 5


class HostReading(NamedTuple):
    """UTC (Unix time) and monotonic time of the same moment, in ns; `within_ns` is how far they may be apart."""

    utc_ns: int
    monotonic_ns: int
    within_ns: int

    def at(self, monotonic_ns: int) -> int:
        """UTC at another moment of the monotonic clock, unless UTC is stepped between the two."""
        return self.utc_ns + monotonic_ns - self.monotonic_ns


def read_host() -> HostReading:
    """UTC and the monotonic clock. Of a few readings, the one in which both clocks were read closest together."""
    readings = []
    for _ in range(_READINGS):
        before = time.monotonic_ns()
        utc = time.time_ns()
        after = time.monotonic_ns()
        readings.append(HostReading(utc, (before + after) // 2, (after - before + 1) // 2))
    return min(readings, key=lambda reading: reading.within_ns)


class Arrival(NamedTuple):
    """A frame that had arrived: its number, the tick at which its exposure began, and the host's monotonic time."""

    frame: int
    tick: int
    at_ns: int


class Stamp(NamedTuple):
    """A moment in UTC (Unix time, ns), and how far it may be off. uncertainty_s: None in virtual time, when nothing was
    exposed."""

    utc_ns: int
    uncertainty_s: float | None


@dataclass(frozen=True, slots=True)
class Anchor:
    """The place of the frames of one start in UTC: frame 0 at `utc_ns`, the others by their period.

    tick: of frame 0. uncertainty_s: of frame 0; None in virtual time. rate_error: by how much a second of the device is
    longer than one of the host, as a share; 0 where it is not measured. rate_uncertainty: how far rate_error may be
    off. period_s: from frame to frame, in seconds of the device.
    """

    run_id: int
    tick: int
    utc_ns: int
    uncertainty_s: float | None
    rate_error: float
    rate_uncertainty: float
    tick_hz: float
    period_s: float

    def of(self, frame: int) -> Stamp:
        """The beginning of a frame's exposure. frame: its number in the start."""
        since_s = frame * self.period_s
        utc_ns = self.utc_ns + round(since_s * (1 + self.rate_error) * NS)
        if self.uncertainty_s is None:
            return Stamp(utc_ns, None)
        return Stamp(utc_ns, self.uncertainty_s + abs(since_s) * self.rate_uncertainty)


class StartTimes:
    """Times of one start of the SPAD. `note` is called on the thread that fills the ring; all else on any thread.

    timing: of the SPAD. asked_ns: the host's monotonic time just before the SPAD was told to start. first_map: number
    of the first map of this start.
    """

    def __init__(self, timing: SpadTiming, asked_ns: int, first_map: int) -> None:
        self._timing = timing
        self.asked_ns = asked_ns
        self.first_map = first_map
        self.run_id: int | None = None
        self.pairs = 0
        self._arrivals: list[Arrival] = []
        self._known: tuple[int, Anchor | None] = 0, None
        """The anchor that was found by so many arrivals."""
        self._every, self._in_turn = 1, 0

    def ask(self) -> None:
        """Note that the SPAD is told to start only now. This replaces `asked_ns`."""
        self.asked_ns = time.monotonic_ns()

    def note(self, run_id: int, frame: int, tick: int) -> None:
        """Note that a frame has arrived just now, and the tick at which its exposure began."""
        arrival = Arrival(frame, tick, time.monotonic_ns())
        if self.run_id is None:
            self.run_id = run_id
        self.add(arrival)

    def add(self, arrival: Arrival) -> None:
        """Keep an arrival, unless it is of the same frame as the last one. The memory is bounded: once it is full, only
        the quicker of two neighbours is kept, and each place takes twice as many arrivals from then on."""
        if self._arrivals and self._arrivals[-1].frame == arrival.frame:
            return
        self.pairs += 1
        arrivals = self._arrivals
        arrivals = [*arrivals[:-1], self._quicker(arrivals[-1], arrival)] if self._in_turn else [*arrivals, arrival]
        self._in_turn = (self._in_turn + 1) % self._every
        if len(arrivals) > MOST_ARRIVALS:
            arrivals = [self._quicker(*arrivals[i : i + 2]) for i in range(0, MOST_ARRIVALS, 2)] + arrivals[-1:]
            self._every *= 2
            self._in_turn = 1
        self._arrivals = arrivals  # in one step: others may read meanwhile

    def anchor(self, scale: Scale, host: HostReading, step_s: float) -> Anchor | None:
        """The anchor by all arrivals so far; None before the first.

        host: a reading of the clocks. step_s: seconds by which UTC was stepped since then, added to the uncertainty.
        """
        pairs, known = self._known
        if pairs != self.pairs:
            pairs = self.pairs
            known = self._find(scale, host, self._arrivals)
            self._known = pairs, known
        if known is None or known.uncertainty_s is None:
            return known
        return replace(known, uncertainty_s=known.uncertainty_s + abs(step_s))

    def _find(self, scale: Scale, host: HostReading, arrivals: Sequence[Arrival]) -> Anchor | None:
        if not arrivals:
            return None
        timing, first = self._timing, arrivals[0]
        tick_hz = float(timing.tick_hz)
        zero = first.tick - first.frame * timing.frame_period_ticks
        # Latest moments at which frame 0 may have begun, by device time of the frame that arrived, both in seconds.
        exposure_s = timing.exposure_ticks / tick_hz
        since_s = [(each.tick - zero) / tick_hz for each in arrivals]
        late_s = [
            (each.at_ns - self.asked_ns) / NS - since - exposure_s
            for each, since in zip(arrivals, since_s, strict=True)
        ]
        offset_s, rate, rate_uncertainty = (0.0, 0.0, 0.0) if scale == "virtual" else line_below(since_s, late_s)
        most_s = max(0.0, offset_s)
        return Anchor(
            run_id=self.run_id or 0,
            tick=zero,
            utc_ns=host.at(self.asked_ns) + round(most_s / 2 * NS),
            uncertainty_s=None if scale == "virtual" else most_s / 2 + host.within_ns / NS,
            rate_error=rate,
            rate_uncertainty=rate_uncertainty,
            tick_hz=tick_hz,
            period_s=timing.frame_period_ticks / tick_hz,
        )

    def _quicker(self, first: Arrival, second: Arrival) -> Arrival:
        """The one of two arrivals that came sooner after its exposure."""
        apart_ns = (second.tick - first.tick) / float(self._timing.tick_hz) * NS
        return second if second.at_ns - first.at_ns < apart_ns else first


class TimeOfDay:
    """The times of day of a run. scale: `host` for frames that are exposed while it runs, else `virtual`.

    UTC is read now, and again by `content` and `of_maps`.
    """

    def __init__(self, timing: SpadTiming, scale: Scale) -> None:
        self._timing = timing
        self.scale: Scale = scale
        self._host = read_host()
        self._starts: list[StartTimes] = []

    def begin(self, first_map: int) -> StartTimes:
        """Begin the times of a start, just before the SPAD is told to start. first_map: number of the first map of this
        start."""
        self._starts.append(StartTimes(self._timing, time.monotonic_ns(), first_map))
        return self._starts[-1]

    def content(self) -> dict[str, Any]:
        """The anchors as plain values for the manifest. A start of which no frame has come yet has only `asked_utc`."""
        step_s = self._step_s()
        synchronised, error_s = host_clock_quality()
        return {
            "scale": self.scale,
            "host": {
                "utc": utc_text(self._host.utc_ns),
                "step_s": step_s,
                "synchronised": synchronised,
                "max_error_s": error_s,
            },
            "starts": [self._start_content(start, step_s) for start in self._starts],
        }

    def of_maps(self, maps: Sequence[tuple[int, int, int]]) -> list[dict[str, Any]]:
        """For each map, `utc` (of its first and its last frame) and `utc_uncertainty_s` as plain values; empty for a
        map without an anchor.

        maps: number, first frame and last frame of each.
        """
        step_s = self._step_s()
        first_maps = [start.first_map for start in self._starts]
        stamps = []
        for number, first, last in maps:
            at = bisect_right(first_maps, number) - 1
            anchor = self._starts[at].anchor(self.scale, self._host, step_s) if at >= 0 else None
            stamps.append({} if anchor is None else map_content(anchor, first, last))
        return stamps

    def _step_s(self) -> float:
        """Seconds by which UTC was stepped against the monotonic clock since the beginning; 0 for less than STEP_S."""
        now = read_host()
        step_s = (now.utc_ns - self._host.at(now.monotonic_ns)) / NS
        return step_s if abs(step_s) >= STEP_S else 0.0

    def _start_content(self, start: StartTimes, step_s: float) -> dict[str, Any]:
        content: dict[str, Any] = {"asked_utc": utc_text(self._host.at(start.asked_ns)), "first_map": start.first_map}
        anchor = start.anchor(self.scale, self._host, step_s)
        if anchor is None:
            return content
        return content | {
            "run_id": anchor.run_id,
            "frame": 0,
            "tick": anchor.tick,
            "tick_hz": anchor.tick_hz,
            "period_s": anchor.period_s,
            "utc": utc_text(anchor.utc_ns),
            "uncertainty_s": anchor.uncertainty_s,
            "rate_error": anchor.rate_error,
            "rate_uncertainty": anchor.rate_uncertainty,
            "pairs": start.pairs,
        }


def map_content(anchor: Anchor, first_frame: int, last_frame: int) -> dict[str, Any]:
    """UTC at which the first and the last frame of a map began, and the larger uncertainty, as plain values."""
    first, last = anchor.of(first_frame), anchor.of(last_frame)
    larger = None if first.uncertainty_s is None else max(first.uncertainty_s, last.uncertainty_s or 0.0)
    return {"utc": [utc_text(first.utc_ns), utc_text(last.utc_ns)], "utc_uncertainty_s": larger}


def read_anchors(manifest: Mapping[str, Any]) -> dict[int, Anchor]:
    """The anchors in a manifest, by the run id of the start. Those that cannot be read are left out."""
    anchors = {}
    for start in (manifest.get("time") or {}).get("starts") or ():
        try:
            anchor = Anchor(
                run_id=int(start["run_id"]),
                tick=int(start["tick"]),
                utc_ns=utc_ns(start["utc"]),
                uncertainty_s=None if start["uncertainty_s"] is None else float(start["uncertainty_s"]),
                rate_error=float(start["rate_error"]),
                rate_uncertainty=float(start["rate_uncertainty"]),
                tick_hz=float(start["tick_hz"]),
                period_s=float(start["period_s"]),
            )
        except (KeyError, TypeError, ValueError, OverflowError):
            continue
        anchors[anchor.run_id] = anchor
    return anchors


class RecordedTimes:
    """The times of day of a recording, for its replay.

    manifest: that of the recording; it must have the key `time`. numbers: of the recording's maps, those that are
    played, in order. A replay in a loop begins again with the first.
    """

    scale: Scale = "recorded"

    def __init__(self, manifest: Mapping[str, Any], numbers: Sequence[int]) -> None:
        self._noted: Mapping[str, Any] = manifest["time"]
        sweeps = manifest.get("sweeps") or []
        self._of_maps = [_time_keys(sweeps[number]) if number < len(sweeps) else {} for number in numbers]

    def content(self) -> dict[str, Any]:
        """The anchors as the recording has them, with the scale `recorded`."""
        return {
            **self._noted,
            "scale": self.scale,
            "recorded_scale": self._noted.get("recorded_scale", self._noted.get("scale")),
        }

    def of_maps(self, maps: Sequence[tuple[int, int, int]]) -> list[dict[str, Any]]:
        """The values of `TimeOfDay.of_maps` as they were recorded. Of each map, only its number in the replay is
        used."""
        return [self._of_maps[number % len(self._of_maps)] for number, _, _ in maps]


def _time_keys(sweep: Mapping[str, Any]) -> dict[str, Any]:
    return {key: sweep[key] for key in ("utc", "utc_uncertainty_s") if key in sweep}


@dataclass(frozen=True, slots=True)
class RunTime:
    """The time at which the maps of a run were taken: the first frame of the first map and the last frame of the last,
    in UTC.

    scale: as in the manifest. uncertainty_s: the larger of the two; None in virtual time.
    """

    scale: str
    first_frame_utc: str
    last_frame_utc: str
    uncertainty_s: float | None


def run_time(scale: str, of_maps: Sequence[Mapping[str, Any]]) -> RunTime | None:
    """The time of a run, from those of its maps (`TimeOfDay.of_maps`); None if no map has one."""
    known = [each for each in of_maps if each.get("utc")]
    if not known:
        return None
    ends = known[0], known[-1]
    uncertain = [each["utc_uncertainty_s"] for each in ends if each.get("utc_uncertainty_s") is not None]
    return RunTime(scale, known[0]["utc"][0], known[-1]["utc"][1], max(uncertain) if uncertain else None)


def utc_text(utc_ns: int) -> str:
    """A moment (Unix time, ns) as ISO 8601 text in UTC, to the microsecond: 2025-11-29T06:17:03.123456Z."""
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(utc_ns / 1000))
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def utc_ns(text: str) -> int:
    """The moment (Unix time, ns) that `utc_text` wrote. Raises ValueError for other text."""
    since = datetime.strptime(text, "%Y-%m-%dT%H:%M:%S.%fZ").replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1) * 1000


class _Timex(ctypes.Structure):
    """`struct timex` of Linux (linux/timex.h), as far as it is read here."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


_UNSYNCHRONISED: Final = 0x0040
"""STA_UNSYNC of linux/timex.h."""


def host_clock_quality() -> tuple[bool | None, float | None]:
    """Whether the host's UTC follows a time server, and how far UTC may then be off in seconds, as the kernel says.

    None where the kernel does not say, as on systems other than Linux.
    """
    if not sys.platform.startswith("linux"):
        return None, None
    state = _Timex()
    try:
        if ctypes.CDLL(None).adjtimex(ctypes.byref(state)) < 0:
            return None, None
    except (OSError, AttributeError):
        return None, None
    synchronised = not state.status & _UNSYNCHRONISED
    return synchronised, state.maxerror / 1e6 if synchronised else None


def line_below(x: Sequence[float], y: Sequence[float]) -> tuple[float, float, float]:
    """The line below all points that lies closest to them: its largest possible height at x = 0, its slope, and the
    uncertainty of the slope.

    x, y: seconds, x from 0 on, at least one point. For fewer than `LEAST_ARRIVALS` points or less than `LEAST_SPAN_S`
    of x the slope is 0 +- `CLOCK_TOLERANCE`. Otherwise it is that of the edge of the hull, and its uncertainty is
    `_SLOPE_DELAYS` median delays divided by the length of the edge; if either is above `CLOCK_TOLERANCE`, the slope is
    again 0 +- `CLOCK_TOLERANCE`.
    """
    span = max(x) - min(x)
    if span >= LEAST_SPAN_S and len(x) >= LEAST_ARRIVALS:
        hull = _lower_hull(sorted(zip(x, y, strict=True)))
        middle = sum(x) / len(x)
        at = min(max(bisect_right([point[0] for point in hull], middle), 1), len(hull) - 1)
        (x0, y0), (x1, y1) = hull[at - 1], hull[at]
        slope = (y1 - y0) / (x1 - x0)
        above = sorted(b - y0 - slope * (a - x0) for a, b in zip(x, y, strict=True))
        uncertainty = _SLOPE_DELAYS * above[len(above) // 2] / (x1 - x0)
        if max(abs(slope), uncertainty) <= CLOCK_TOLERANCE:  # else what is known of crystals says more
            return y0 - (slope - uncertainty) * x0, slope, uncertainty
    return min(b + CLOCK_TOLERANCE * a for a, b in zip(x, y, strict=True)), 0.0, CLOCK_TOLERANCE


def _lower_hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The lower convex hull of sorted points (Andrew 1979), at least two of different x."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            continue  # sorted: the one that is there is lower
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (x - hull[-2][0]) >= (y - hull[-2][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            del hull[-1]
        hull.append((x, y))
    return hull
