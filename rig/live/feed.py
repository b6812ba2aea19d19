"""Publishes a run in a slot: its settings, progress, newest frames and map, for viewers in other processes.

The run's own threads only leave references to what they have just made. A thread of the feed looks ten times a second
whether anybody watches, and only then copies the newest values into the slot. While a reader follows an image row, the
feed also keeps the counts of the newest sweep, which are as large as one more sweep in memory. An error in the feed is
logged once and ends the feed, never the run. A reader may ask for the run to stop; it is then stopped as by Ctrl-C.
"""

import logging
import math
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from rig.count.followed_row import FollowedRow, RowWish
from rig.count.sweeps import SweepData
from rig.count.volume import CountVolume
from rig.devices.open import OpenRig
from rig.errors import UsageError
from rig.geometry.stripe_table import StripeTable
from rig.live.slot import SlotWriter
from rig.recording.replay import ENDLESS
from rig.scan.counting import AcquiredMap
from rig.scan.monitor import Listeners, MonitorView, RunBegun, ScanProgress
from rig.threads import StageThread

T = TypeVar("T")
_log = logging.getLogger(__name__)

INTERVAL_S: Final = 0.1
"""Time from one look at the slot to the next, and so from one value of a section to the next."""
MOST_GAPS: Final = 100
"""Gaps of a map that are listed; all are counted."""
_RATE_MAPS = 10
"""The newest maps over which the map rate is taken."""
_END_S = 1.0
"""Longest wait for the feed at the end of a run: a disk that hangs when asked for its free space must not delay it."""
_MAP_ARRAYS = 4
"""Arrays of a map on the camera's pixels, of 4 bytes a value: depth, confidence, standard deviation, intensity."""
_MOST_COUNT = 0xFFFF
_TEXT = 256 * 1024
"""Bytes of a section for its header."""


class Feed:
    """The slot of one run, from the beginning of the run to the end of the `with` block.

    kind: 'scan', 'replay' or 'align'. name: of the config or recording.
    Give the run `listeners(...)`. Nothing is published before the run has begun, see `Listeners.begun`.
    """

    def __init__(self, kind: str, name: str) -> None:
        self._kind, self._name = kind, name
        self._slot: SlotWriter | None = None
        self._thread = StageThread(lambda: self._safely(self._run), "live feed")
        self._over = threading.Event()
        self._on_main_thread = True
        self._failed = False
        self._stopped = False
        """Whether the run was interrupted because a reader asked for it."""
        self._written: dict[str, object] = {}
        """The object from which each section was written last."""
        self._shown_row: tuple[int, int] | None = None
        """Map and image row of the section `row`."""
        self._begun: RunBegun | None = None
        self._progress: ScanProgress | None = None
        self._view: MonitorView | None = None
        self._sweep: SweepData | None = None
        self._row: FollowedRow | None = None
        """Counts of a row of the sweep that is about to be noted."""
        self._followed: tuple[int, FollowedRow] | None = None
        """Map, and counts of a row of its sweep, whose other counts were not kept."""
        self._map: AcquiredMap | None = None
        self._figures: tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]] | None = None
        self._map_times: deque[float] = deque(maxlen=_RATE_MAPS)
        self._gaps = 0
        self._doubts: dict[str, None] = {}
        self._laser: dict[str, Any] = {}
        self._spad_c: dict[str, float] = {}

    def listeners(self, others: Listeners) -> Listeners:
        """Listeners to give to a run. Each callback serves the feed and then calls that of `others`; `row` is the
        feed's alone."""
        return replace(
            others,
            live=_each(self._note_progress, others.live),
            monitor=_each(self._note_view, others.monitor),
            watched=(lambda: True) if others.monitor is not None else self._watched,
            sweeps=_each(self._note_sweep, others.sweeps),
            row=RowWish(self._wanted_row, self._note_row),
            begun=_each(self.begin, others.begun),
            maps=_each(self.show_map, others.maps),
        )

    def begin(self, begun: RunBegun) -> None:
        """Make the slot of a run that is about to start, on the run's thread. If it cannot be made, that is logged."""
        self._safely(lambda: self._begin(begun))

    def show_map(self, found: AcquiredMap) -> None:
        """Publish a map. The caller must not change it afterwards."""
        self._map = found
        self._map_times.append(time.monotonic())
        self._gaps += len(found.sweep.gaps)
        self._doubts |= dict.fromkeys(found.result.doubts)

    def show_figures(self, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Publish the figures of an alignment. The caller must not change the arrays afterwards."""
        self._figures = finite(header), arrays

    def close(self) -> None:
        """Publish what came last, if anybody watches, and tell the readers that the run is over."""
        self._over.set()
        if not self._thread.join(_END_S):
            _log.warning("the live view hangs and is left behind; nothing of the run is lost")
        elif self._slot is not None:
            self._slot.close()
        self._written.clear()  # hundreds of megabytes must not wait for garbage collection
        self._begun = self._view = self._sweep = self._map = self._followed = None

    def __enter__(self) -> Self:
        """The feed itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()

    # On the run's threads

    def _watched(self) -> bool:
        return self._slot is not None and not self._failed and self._slot.watched

    def _note_progress(self, now: ScanProgress) -> None:
        self._progress = now
        if self._slot is not None and self._slot.stop_requested and not self._on_main_thread and not self._stopped:
            self._stopped = True  # a signal would interrupt the main thread, which is at something else
            raise KeyboardInterrupt

    def _note_view(self, view: MonitorView) -> None:
        self._view = view

    def _note_sweep(self, sweep: SweepData) -> None:
        followed, row = self._wanted_row() is not None, self._row
        self._sweep = sweep if followed and isinstance(sweep.tally, CountVolume) else None
        self._followed = (sweep.index, row) if self._sweep is None and row is not None else None
        self._row = None

    def _wanted_row(self) -> int | None:
        return self._slot.wanted_row if self._watched() and self._slot is not None else None

    def _note_row(self, found: FollowedRow) -> None:
        self._row = found

    def _begin(self, begun: RunBegun) -> None:
        self._begun = begun
        self._on_main_thread = threading.current_thread() is threading.main_thread()
        try:
            self._slot = SlotWriter.create(self._kind, self._name, capacities(begun))
        except (OSError, UsageError) as error:
            _log.warning("nobody can watch this run: %s", error)
            return
        if begun.rig.config.spad.real_time:  # once, as during a run it cannot be asked
            with suppress(DeviceError):
                self._spad_c = dict(begun.rig.spad.health.temperatures_c)
        self._thread.start()

    # On the feed's thread

    def _run(self) -> None:
        slot, ends = self._slot, False
        while slot is not None and not ends:
            ends = self._over.wait(INTERVAL_S)
            if slot.stop_requested and self._on_main_thread and not (self._stopped or ends):
                self._stopped = True
                interrupt()
            if slot.watched:
                self._publish(slot)

    def _publish(self, slot: SlotWriter) -> None:
        begun, view, found = self._begun, self._view, self._map
        if begun is None:
            return
        if self._new("setup", begun):
            slot.write("setup", *self._setup(begun))
        slot.write("status", self._status(begun))
        if view is not None and self._new("frame", view):
            shown = {"first_frame": view.first_frame, "frames": view.frames}
            slot.write("frame", shown, {"counts": view.counts})
        if found is not None and self._new("map", found):
            slot.write("map", *map_content(found, begun.rig.config.estimate.estimator))
        if self._figures and self._new("figures", self._figures):
            slot.write("figures", *self._figures)
        self._publish_row(slot, begun)

    def _publish_row(self, slot: SlotWriter, begun: RunBegun) -> None:
        """Write the section `row` if it is of another map or image row than before: any row of a sweep whose counts
        were kept, or the one that was followed."""
        wanted, sweep, followed = slot.wanted_row, self._sweep, self._followed
        kept = None if sweep is None or not isinstance(sweep.tally, CountVolume) else sweep.tally
        if sweep is not None and kept is not None and wanted is not None:
            if self._is_new_row(sweep.index, wanted, begun):
                slot.write("row", *row_content(sweep.index, wanted, row_of(kept, wanted), begun))
        elif followed is not None and self._is_new_row(followed[0], followed[1].row, begun):
            counts, lines = followed[1].counts, begun.plan.lines
            by_column = counts if lines is None else counts[lines.place]
            slot.write("row", *row_content(followed[0], followed[1].row, by_column, begun))

    def _is_new_row(self, index: int, row: int, begun: RunBegun) -> bool:
        before, self._shown_row = self._shown_row, (index, row)
        return 0 <= row < begun.geometry.rows and before != (index, row)

    def _new(self, section: str, value: object) -> bool:
        """Whether a section is to be written from this value; it is remembered."""
        before = self._written.get(section)
        self._written[section] = value
        return value is not before

    def _setup(self, begun: RunBegun) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        rig, plan, geometry = begun.rig, begun.plan, begun.geometry
        header = {
            "kind": self._kind,
            "name": self._name,
            "config": rig.config.model_dump(mode="json"),
            "columns": plan.columns,
            "exposures": plan.exposures,
            "rows": geometry.rows,
            "width": geometry.width,
            "depth_range_m": list(plan.depth_range_m),
            "estimator": rig.config.estimate.estimator,
            "frame_rate_hz": float(plan.frame_rate_hz),
            "folder": None if begun.folder is None else str(begun.folder),
            "maps": begun.maps if begun.maps < ENDLESS else None,
        }
        u, v = geometry.rays
        return header, {} if rig.model is None else {"u": u, "v": v}

    def _status(self, begun: RunBegun) -> dict[str, Any]:
        rig, now, times = begun.rig, self._progress, list(self._map_times)
        between_s = times[-1] - times[0] if len(times) > 1 else 0.0
        with suppress(DeviceError):  # a rig that is closed; what it said last is still shown
            self._laser = laser_content(rig)
        laser_c = self._laser.get("temperature_c")
        status: dict[str, Any] = {
            "stage": "preparing",
            "frames": 0,
            "frames_planned": None,
            "lost": 0,
            "sweeps": 0,
            "maps": begun.maps if begun.maps < ENDLESS else None,
            "map_rate_hz": (len(times) - 1) / between_s if between_s > 0 else None,
            "ring": None,
            "disk": None,
            "gaps": self._gaps,
            "laser": self._laser,
            "temperatures": self._spad_c if laser_c is None else {**self._spad_c, "laser": laser_c},
            "fog": None,
            "unix_time_s": time.time(),
            "verdict_reasons": list(self._doubts),
        }
        if now is not None:
            status |= {name: getattr(now, name) for name in ("stage", "frames", "lost", "sweeps")}
            status["frames_planned"] = now.frames_planned if now.maps < ENDLESS else None
            status["fog"] = None if now.fog is None else asdict(now.fog)
            status["ring"] = {
                "fill": now.ring_used / max(now.stages.ring_slots, 1),
                "slots": now.stages.ring_slots,
                "high_water": now.stages.ring_high_water,
                "bytes": now.stages.ring_bytes,
                "dropped_frames": now.stages.dropped_frames,
                "waits": rig.spad.info.can_wait,  # then a full ring holds the source up, and nothing is lost
            }
        if begun.folder is not None:
            written = None if now is None else now.stages.recorder_bytes
            status["disk"] = {"written_bytes": written or 0, "free_bytes": free_bytes(begun.folder)}
        return finite(status)

    def _safely(self, work: Callable[[], None]) -> None:
        """Do a part of the feed's work. If it fails, that is logged and the feed does nothing more."""
        try:
            if not self._failed:
                work()
        except Exception as error:  # nobody's view is worth a run
            self._failed = True
            _log.warning("the live view of this run ends: %s: %s", type(error).__name__, error, exc_info=error)
            if self._slot is not None:
                self._slot.close()


def capacities(begun: RunBegun) -> dict[str, int]:
    """Most bytes of each section's value for this run."""
    plan, geometry = begun.plan, begun.geometry
    pixels, stripes = geometry.rows * geometry.width, geometry.rows * plan.columns
    return {
        "setup": 2 * 4 * pixels + _TEXT,
        "status": _TEXT,
        "frame": 2 * plan.rows * plan.width + _TEXT,
        "map": 4 * (_MAP_ARRAYS * pixels + len(fields(StripeTable)) * stripes) + _TEXT,
        "row": 2 * plan.columns * (geometry.width + 4) + _TEXT,
        "figures": 8 * geometry.width + _TEXT,
    }


def map_content(found: AcquiredMap, estimator: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of the section `map`. Of the gaps, the first MOST_GAPS are listed."""
    result = found.result
    header = {
        "index": found.sweep.index,
        "fog": asdict(result.fog),
        "compute_s": found.compute_s,
        "estimator": estimator,
        "direction": found.sweep.direction,
        "gaps": [list(gap) for gap in found.sweep.gaps[:MOST_GAPS]],
        "doubts": list(result.doubts),
        "unix_time_s": time.time(),
        **found.taken,
    }
    camera = {name: getattr(result, name) for name in ("depth_m", "confidence", "depth_sd_m", "intensity")}
    # The stripe table has a `confidence` too, (rows, columns), which a run's folder keeps in another file.
    stripes = {f"stripe/{name}": array for name, array in result.stripe.arrays().items()}
    return finite(header), camera | stripes


def row_of(volume: CountVolume, row: int) -> NDArray[np.uint16]:
    """Counts of one row of a sweep, uint16 (columns, up to the last pixel of any window), 0 outside the windows. Larger
    counts are given as 65535."""
    columns, _, window = volume.counts.shape
    counts = np.zeros((columns, int(volume.x0.max(initial=0)) + window), np.uint16)
    for column, first in enumerate(volume.x0.tolist()):
        counts[column, first : first + window] = np.minimum(volume.counts[column, row], np.uint32(_MOST_COUNT))
    return counts


def row_content(
    index: int, row: int, counts: NDArray[np.uint16], begun: RunBegun
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of the section `row`, for the map with number `index`.

    counts: of each column on that row. The arrays `begin_px` and `end_px` have, for each column, the first pixel of the
    search window and the pixel after its last one; no pixel is searched where begin_px >= end_px.
    """
    geometry = begun.geometry
    header = {"map": index, "row": row, "exposures": begun.plan.exposures}
    windows = {"begin_px": geometry.x_lo[row], "end_px": geometry.x_hi[row] + 1}
    return header, {"counts": counts[:, : geometry.width], **windows}


def laser_content(rig: OpenRig) -> dict[str, Any]:
    """The laser's name and its last known status, by the names of `LaserStatus`; the name alone if there is no status
    yet.

    A real laser is not asked here: the guard asks it every second while it is armed. Raises DeviceError for a simulated
    laser that is closed.
    """
    guarded = rig.guard is not None and rig.config.laser.real_time
    status = rig.guard.laser_status if guarded and rig.guard is not None else rig.laser.status
    return {"name": rig.laser.name} | ({} if status is None else asdict(status))


def free_bytes(folder: Path) -> int | None:
    """Free bytes on the disk of a folder, which need not exist yet; None if the system does not say."""
    there = next((each for each in (folder, *folder.parents) if each.exists()), None)
    with suppress(OSError):
        return None if there is None else shutil.disk_usage(there).free
    return None


def interrupt() -> None:
    """Interrupt this process's main thread as Ctrl-C does. If the program was started with Ctrl-C ignored, as shells
    start programs in the background, it gets SIGTERM instead; if it handles neither, that is logged."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if callable(signal.getsignal(number)):
            main = threading.main_thread().ident
            if hasattr(signal, "pthread_kill") and main is not None:
                signal.pthread_kill(main, number)  # to that thread, so that a wait of its ends now
            else:
                signal.raise_signal(number)
            return
    _log.warning("a stop was asked for in the live view, but this program handles neither SIGINT nor SIGTERM")


def finite(value: Mapping[str, Any]) -> dict[str, Any]:
    """Content for JSON, with None in place of numbers that are not finite, and numpy's numbers as Python's."""
    return {str(name): _finite(item) for name, item in value.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return finite(value)
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _each(first: Callable[[T], None], second: Callable[[T], object] | None) -> Callable[[T], None]:
    def both(value: T) -> None:
        first(value)
        if second is not None:
            second(value)

    return both
