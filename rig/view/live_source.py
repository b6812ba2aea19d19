"""A running scan as the page shows it: reads the slot of the newest run of this user, and waits for the next one."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from rig.errors import UsageError
from rig.live.slot import RunningSlot, SlotReader, Value
from rig.recording.map_rows import RowCounts
from rig.simd import Float32
from rig.view.shown import ShownMap

LOOK_S: Final = 0.5
"""Time from one look for a running scan to the next."""
_STRIPE: Final = "stripe/"
"""Prefix of the names of the stripe table's arrays."""


class LiveState(StrEnum):
    """Whether there is a run. `lost`: its process is gone without having said that the run is over."""

    WAITING = "waiting"
    LIVE = "live"
    ENDED = "ended"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class LiveNews:
    """Whatever is new since the last look; None for what is not. setup, status, figures: headers of these sections.
    map: the newest one. frames: the newest frames summed, as a map of counts alone. profile: of an alignment."""

    setup: Mapping[str, Any] | None = None
    status: Mapping[str, Any] | None = None
    map: ShownMap | None = None
    frames: ShownMap | None = None
    figures: Mapping[str, Any] | None = None
    profile: Float32 | None = None


class LiveSource:
    """Follows the newest running scan. pid: only scans of this process are followed; None for those of any.

    slot: the run that was followed last; None before the first. state: that of this run. rays: (u, v) of its camera;
    None if it is not calibrated.
    """

    def __init__(self, pid: int | None = None) -> None:
        self._pid = pid
        self.state = LiveState.WAITING
        self.slot: RunningSlot | None = None
        self._reader: SlotReader | None = None
        self._numbers: dict[str, int] = {}
        self.rays: tuple[Float32, Float32] | None = None
        self._min_confidence = 0.5
        self._row: Value | None = None
        self._looked_s = -LOOK_S

    def poll(self, *, maps: bool = True) -> LiveNews:
        """Look for news, and attach to the newest run if none is followed. maps: if False, maps and frames are left for
        later, unless the run is over.

        Call it at least twice a second, or the run assumes that nobody watches. Raises UsageError if others can enter
        the folder of the slots.
        """
        if self._reader is None:
            self._attach()
        if self._reader is None:
            return LiveNews()
        self._reader.touch()
        alive = self._reader.alive
        news = self._news(maps or not alive)
        if not alive:
            self.state = LiveState.ENDED if self._reader.ended else LiveState.LOST
            self._detach()
        return news

    def follow(self, row: int) -> None:
        """Ask the run for the counts of an image row; they come with its next map."""
        if self._reader is not None:
            self._reader.touch(row)

    def row(self, number: int, row: int) -> RowCounts | None:
        """Counts of one row of a map, if the run has sent them."""
        value = self._row
        if value is None or (value.header["map"], value.header["row"]) != (number, row):
            return None
        counts = value.arrays["counts"]
        frames = np.full(len(counts), int(value.header["exposures"]), np.int32)
        return RowCounts(counts, frames, value.arrays["begin_px"], value.arrays["end_px"])

    @property
    def newest_row(self) -> object:
        """The counts of the row that was asked for; a new object each time new counts have come."""
        return self._row

    def stop(self) -> bool:
        """Ask the run to end as with Ctrl-C; False if none is going on."""
        if self._reader is None:
            return False
        self._reader.request_stop()
        return True

    def close(self) -> None:
        """Let go of the run."""
        self._detach()

    def _attach(self) -> None:
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_S:
            return
        self._looked_s = now_s
        found = SlotReader.newest(self._pid)
        if found is None:
            return
        try:
            self._reader = SlotReader.open(found.path)
        except (OSError, UsageError):  # it has just ended
            return
        self.slot, self.state = found, LiveState.LIVE
        self._numbers, self.rays, self._row = {}, None, None

    def _detach(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _new(self, section: str) -> Value | None:
        assert self._reader is not None, "asked for while attached"
        try:
            value = self._reader.read(section, self._numbers.get(section, 0))
        except KeyError:  # a run of another version
            return None
        if value is not None:
            self._numbers[section] = value.number
        return value

    def _news(self, maps: bool) -> LiveNews:
        setup, status, figures = self._new("setup"), self._new("status"), self._new("figures")
        if setup is not None:
            u, v = setup.arrays.get("u"), setup.arrays.get("v")
            self.rays = None if u is None or v is None else (u, v)
            estimate = (setup.header.get("config") or {}).get("estimate") or {}
            self._min_confidence = float(estimate.get("min_confidence", 0.5))
        found, frame = (self._new("map"), self._new("frame")) if maps else (None, None)
        row = self._new("row")
        self._row = row or self._row
        return LiveNews(
            setup=None if setup is None else setup.header,
            status=None if status is None else status.header,
            map=None if found is None else self._map(found),
            frames=None if frame is None else _frames(frame),
            figures=None if figures is None else figures.header,
            profile=None if figures is None else figures.arrays.get("profile"),
        )

    def _map(self, value: Value) -> ShownMap:
        arrays, header = value.arrays, value.header
        stripe = {name.removeprefix(_STRIPE): array for name, array in arrays.items() if name.startswith(_STRIPE)}
        depth_m = arrays["depth_m"]
        calibrated = self.rays is not None
        return ShownMap(
            int(header["index"]),
            stripe,
            depth_m if calibrated else None,
            arrays.get("confidence") if calibrated else None,
            arrays.get("depth_sd_m") if calibrated else None,
            arrays["intensity"].astype(np.float32),
            None,
            self.rays,
            {**header, "min_confidence": self._min_confidence},
        )


def _frames(value: Value) -> ShownMap:
    counts = value.arrays["counts"].astype(np.float32)
    return ShownMap(int(value.header["first_frame"]), {}, counts=counts, about=value.header)
