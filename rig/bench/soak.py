"""Plays a long stream at the sensor's rate through the acquisition of `rig scan`, to see what is lost and what grows.

The bundled simulated rig records a few sweeps, once. A SPAD that cannot wait plays them in real time, with running
frame numbers. Everything else is as in a scan: ring, binding, counting, estimation, maps, a monitor, and the overload
policy. Copying a block into its ring slot stands for the transfer that a device does by itself.
"""

import logging
import math
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded, RingOverflow
from drivers.frames import BlockFlag, BlockHeader, FrameBlock, Mark, frame_bytes
from drivers.interfaces import SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, walk_blocks
from rig.bench.machine import machine
from rig.config.estimators import AUTO, estimator_names, is_estimator
from rig.config.files import load_config
from rig.config.models import MOST_THREADS, EstimateConfig
from rig.depth.warm_up import warm_up
from rig.devices.open import OpenRig, open_rig
from rig.devices.prepare import prepare
from rig.errors import UsageError
from rig.plan.scan_plan import ScanPlan
from rig.progress import Progress
from rig.recording.writer import Recording
from rig.requests import SoakRequest
from rig.run_folder.summary import PipelineStats
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import Listeners, MonitorView, ScanProgress
from rig.scan.pipeline import Overload, require_policy
from rig.scan.scan import make_reconstructor

LEAD_FRAMES = 200
"""Largest number of frames before the first scan marker: the end of a sweep of a scanner that already runs."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Frames of whole sweeps, from the frame with one scan marker to just before the frame with another.

    records: (n,) of `FRAME_RECORD`; bits: uint8 (n, rows, row bytes); sweeps: number of sweeps; width: width of a frame
    in px.
    """

    records: NDArray[np.void]
    bits: NDArray[np.uint8]
    sweeps: int
    width: int

    @classmethod
    def of(cls, blocks: Iterable[FrameBlock], sweeps: int) -> Self:
        """The first `sweeps` whole sweeps of a stream without gaps."""
        kept = list(blocks)
        records = np.concatenate([block.records for block in kept])
        scans = np.flatnonzero(records["marks"] & int(Mark.SCAN))
        first, end = int(scans[0]), int(scans[sweeps])
        bits = np.concatenate([block.bits for block in kept])[first:end]
        return cls(records[first:end].copy(), bits, sweeps, kept[0].header.width)


class LoopedSpad(SpadArray):
    """A SPAD that plays a loop. timing: timing of the SPAD that took the frames. info: info of the SPAD to imitate."""

    def __init__(self, loop: Loop, info: SpadInfo, timing: SpadTiming) -> None:
        super().__init__("looped SPAD")
        self._loop = loop
        self._info = info
        self._timing = timing
        self._frame_s = float(timing.frame_period_ticks / timing.tick_hz)
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._run_id = 0
        self._lead = min(LEAD_FRAMES, len(loop.records) // (2 * loop.sweeps))
        self.started_s = 0.0
        """Time of the newest start, by `time.perf_counter`."""
        self.late_max_s = 0.0
        """Largest lateness of a block, in s: the source, too, needs its share of the processor."""

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        rate = Fraction(self._timing.tick_hz, self._timing.frame_period_ticks)
        width = self._info.width if request.window is None else request.window.width_px
        if request.frame_rate_hz != rate or width != self._loop.width:
            raise LimitExceeded(
                f"{self.name}: has frames {self._loop.width} pixels wide at {float(rate):g} Hz, not {width} at "
                f"{float(request.frame_rate_hz):g} Hz; ask for those"
            )
        self._block_frames = request.block_frames
        self._timing = replace(self._timing, stride=self._layout(request.block_frames).min_stride)
        return self._timing

    def _do_start(self, n_frames: int | None) -> None:
        self._n_frames = n_frames
        self._next_frame = self._block_seq = 0
        self._just_lost = False
        self._run_id = (self._run_id + 1) & 0xFFFF
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self.started_s = time.perf_counter()

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        first = self._next_frame
        n = self._block_frames if self._n_frames is None else min(self._block_frames, self._n_frames - first)
        self._wait_until_exposed(first + n)
        memory = ring.claim(0.0)
        self._next_frame += n
        if memory is None:
            self._count(n, lost=n)
            self._just_lost = True
            ring.mark_overflow(n)
        else:
            block = self._copied(memory, first, n)
            self._count(n, lost=0)
            ring.publish(block)
            self._block_seq += 1
            self._just_lost = False
        return self._next_frame != self._n_frames

    def _do_stop(self) -> None:
        pass  # a block is exposed and published in one go: nothing is on its way

    def _do_close(self) -> None:
        pass  # no handles

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _wait_until_exposed(self, frames: int) -> None:
        due_s = self.started_s + frames * self._frame_s
        left_s = due_s - time.perf_counter()
        if left_s > 0:
            time.sleep(left_s)
        self.late_max_s = max(self.late_max_s, time.perf_counter() - due_s)

    def _count(self, n: int, *, lost: int) -> None:
        old = self._counters
        self._counters = SpadCounters((old.exposed or 0) + n, old.delivered + n - lost, (old.lost or 0) + lost, 0, 0)

    def _copied(self, memory: NDArray[np.uint8], first: int, n: int) -> FrameBlock:
        """The block of frames first..first+n-1, in `memory`."""
        loop = self._loop
        length = len(loop.records)
        records, bits = block_views(memory, self._layout(n))
        done = sweep = 0
        while done < n:
            cycle, at = divmod(first + done + length - self._lead, length)
            size = min(n - done, length - at)
            records[done : done + size] = loop.records[at : at + size]
            # The loop counts its sweeps from 1 on; before the first marker, in cycle 0, its last one becomes number 0.
            before = (cycle - 1) * loop.sweeps
            if not done:  # the header's count is longer than the 16 bits of records
                sweep = int(loop.records["sweep"][at]) + before
            records["sweep"][done : done + size] += np.uint16(before & 0xFFFF)
            np.copyto(bits[done : done + size], loop.bits[at : at + size])
            done += size
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        return FrameBlock(self._header(first, sweep), records, bits)

    def _header(self, first: int, sweep: int) -> BlockHeader:
        timing = self._timing
        return BlockHeader(
            flags=BlockFlag.LOST_BEFORE if self._just_lost else BlockFlag(0), run_id=self._run_id,
            block_seq=self._block_seq, first_frame=first, t0_ticks=first * timing.frame_period_ticks,
            lost_before=self._counters.lost or 0, tick_hz=timing.tick_hz,
            frame_period_ticks=timing.frame_period_ticks, exposure_ticks=timing.exposure_ticks, sweep=sweep,
            frame_step=1, width=self._loop.width, height=self._info.height, sensor_width=self._info.width,
            sensor_height=self._info.height,
        )  # fmt: skip

    def _layout(self, n: int) -> BlockLayout:
        return BlockLayout(n, self._loop.width, self._info.height)


SECONDS = 60.0
"""Length of the stream if the caller names none."""
CONFIG = "simulated"
EXIT_DEVICE = 3
"""Exit code of a scan that the overload policy ended."""
LOOP_S = 0.2
"""Least time in s that the recorded sweeps last. Their frames take many times as much memory as a cache has."""
DEPTH_RANGE = ["4 m", "15 m"]
"""Range whose stripes lie within 128 pixels of a row, the window for which speeds are stated."""
LINK_MARGIN = 1.02
"""Rate of the link, relative to the rate that windows moving with the line need; too low for whole frames."""
SETTLED = 0.1
"""Share of the maps after which memory should no longer grow."""
_STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class SoakFrames:
    """Frames by the SPAD's own count (exposed = received + lost) and by that of the sweeps, from marker to marker.

    agree: whether both counts add up and the SPAD lost exactly the frames that the ring dropped.
    """

    exposed: int
    received: int
    lost: int
    expected_in_sweeps: int
    received_in_sweeps: int
    lost_in_sweeps: int
    agree: bool


@dataclass(frozen=True, slots=True)
class SoakReport:
    """Findings of a soak.

    seconds: length of the stream that was played. maps: number of maps made, of maps_planned. times_real_time: time
    span of the received frames, divided by the time spent on binding, counting and making maps of them; the first map
    is left out. resident_*: memory of the process after a tenth of the maps and at the end, and its growth as a share;
    None if the system does not report it.
    source_late_max_s: largest lateness of a block. ended_by: the error that ended the run early; None if none did.
    """

    seconds: float
    frame_width: int
    on_overload: str
    slow_consumer_ms: float
    maps: int
    maps_planned: int
    frames: SoakFrames
    times_real_time: float | None
    resident_settled_bytes: int | None
    resident_end_bytes: int | None
    resident_growth: float | None
    source_late_max_s: float
    ended_by: str | None
    stages: PipelineStats
    machine: dict[str, Any]

    @property
    def exit_code(self) -> int:
        """The exit code, as for a scan: 3 if the ring ended the stream, 1 if frames were lost or do not add up."""
        if self.ended_by is not None:
            return EXIT_DEVICE
        return int(self.frames.lost > 0 or not self.frames.agree)


def soak(request: SoakRequest | None = None, *, progress: Progress | None = None, **changes: Any) -> SoakReport:
    """Play a stream of 100 kHz in real time through the acquisition (`rig bench --soak`). A stream that the
    overload policy ends gives a report too.

    request, changes: options, as a `SoakRequest` or by the names of its fields: `soak(seconds=10, window=True)`.
    progress: called with frames done and frames planned.

    Raises UsageError for a request that cannot be met.
    """
    request = replace(request or SoakRequest(), **changes)
    seconds = SECONDS if request.seconds is None else request.seconds
    policy, slow_s = Overload.parse(request.on_overload), request.slow_consumer_ms / 1e3
    if not (seconds > 0 and slow_s >= 0):
        raise UsageError(f"a soak of {seconds:g} s, slowed by {slow_s:g} s; ask for more than 0 s")

    def tell(done: ScanProgress) -> None:
        if progress is not None:
            progress(done.frames, done.frames_planned)

    listeners = Listeners(
        live=tell,
        monitor=MonitorView.row_profile,  # what a viewer would show
        sweeps=(lambda _: time.sleep(slow_s)) if slow_s else None,
    )
    if request.estimator == AUTO or not is_estimator(request.estimator):
        known = ", ".join(estimator_names())
        raise UsageError(f"estimator {request.estimator!r} is unknown; choose one of {known}")
    if request.threads is not None and not 1 <= request.threads <= MOST_THREADS:
        raise UsageError(f"{request.threads} threads were asked for; give 1 to {MOST_THREADS}")
    with looped_rig(policy, request) as (rig, spad), quiet_sweeps():
        plan, timing = prepare(rig)
        maps = max(2, 1 + math.ceil(seconds / float(plan.sweep_s)))  # the first one is taken alone
        warm_up(request.estimator, "none", plan.exposures, dark=True)
        settings = EstimateConfig.model_validate({"estimator": request.estimator, "threads": request.threads})
        maker = make_reconstructor(rig, plan, settings)
        asked = AcquisitionRequest(maps=maps, policy=policy, first_alone=True, learns=True, listeners=listeners)
        return _played(Acquisition(rig, plan, timing, maker, asked), spad, plan, asked, request.slow_consumer_ms)


@contextmanager
def quiet_sweeps() -> Iterator[None]:
    """A context that logs no line for a sweep that lost frames: there may be thousands, and the report counts them."""
    log = logging.getLogger("rig.count.sweeps")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


@contextmanager
def looped_rig(
    policy: Overload, request: SoakRequest, changes: Mapping[str, object] | None = None
) -> Iterator[tuple[OpenRig, LoopedSpad]]:
    """A context that gives the simulated rig with a looped SPAD in place of its own, and this SPAD by itself.

    The looped SPAD plays what the rig's own SPAD recorded.

    changes: further settings of the config, by their keys.
    """
    # With clocks that agree exactly, the loop closes without a jump.
    settings: dict[str, object] = {
        "scanner.clock_error": "0 ppm",
        "scan.depth_range": DEPTH_RANGE,
        "scan.exposures": request.exposures,
        **(changes or {}),
    }
    if request.window:
        settings["spad.link"] = f"{_window_bytes_per_s(settings) / 1e6:.6f} MB/s"
    with open_rig(load_config(CONFIG, settings)) as rig:
        info = replace(rig.spad.info, model="looped", can_wait=False)
        require_policy(policy, info)
        plan, timing = prepare(rig)
        with LoopedSpad(_recorded(rig, plan, timing), info, timing) as spad:
            yield replace(rig, spad=spad), spad


def _window_bytes_per_s(settings: dict[str, object]) -> float:
    with open_rig(load_config(CONFIG, settings)) as rig:
        plan, _ = prepare(rig)
    assert plan.windows is not None, "the bundled rig has moving windows"
    return LINK_MARGIN * float(plan.frame_rate_hz) * frame_bytes(plan.windows.width_px, plan.rows)


def _recorded(rig: OpenRig, plan: ScanPlan, timing: SpadTiming) -> Loop:
    """Record sweeps of the simulated rig, so many that together they take a whole number of frames."""
    whole = plan.frames_per_sweep.denominator
    sweeps = math.ceil(math.ceil(LOOP_S / float(plan.sweep_s)) / whole) * whole
    with tempfile.TemporaryDirectory(prefix="spadrig-bench-") as folder:
        maker = make_reconstructor(rig, plan, EstimateConfig(estimator="argmax", threads=1))
        with closing(Recording(Path(folder))) as recording:
            request = AcquisitionRequest(maps=sweeps, recording=recording)
            for _ in Acquisition(rig, plan, timing, maker, request).run():
                pass
        files = (np.memmap(Path(folder) / name, np.uint8, "r") for name in recording.files)
        items = (item for file in files for item in walk_blocks(file, None, check_payload=False))
        return Loop.of((item for item in items if isinstance(item, FrameBlock)), sweeps)


def _played(
    acquisition: Acquisition, spad: LoopedSpad, plan: ScanPlan, asked: AcquisitionRequest, slow_consumer_ms: float
) -> SoakReport:
    """Run the acquisition to its end and report on it."""
    resident: list[int] = []
    settled = expected = received = lost = worked_off = 0
    compute_s = 0.0
    ended_by: str | None = None
    try:
        for found in acquisition.run():
            frames = found.sweep.frames
            expected, received, lost = expected + frames.expected, received + frames.received, lost + frames.lost
            if resident:  # the first map takes longer, since the model is learned from it
                worked_off, compute_s = worked_off + frames.received, compute_s + found.compute_s
            resident.append(_resident_bytes())
            if len(resident) <= max(1, SETTLED * asked.maps):
                settled = len(resident) - 1
    except RingOverflow as error:
        ended_by = str(error)
    counters, stages = acquisition.counters, acquisition.stages
    exposed, gone = counters.exposed or 0, counters.lost or 0
    agree = (
        exposed == counters.delivered + gone
        and expected == received + lost
        and gone == stages.dropped_frames
        and lost <= gone
        and received <= counters.delivered
    )
    first, last = (resident[settled], resident[-1]) if resident and resident[-1] else (None, None)
    return SoakReport(
        seconds=exposed / float(plan.frame_rate_hz),
        frame_width=plan.frame_width,
        on_overload=asked.policy.value,
        slow_consumer_ms=slow_consumer_ms,
        maps=len(resident),
        maps_planned=asked.maps,
        frames=SoakFrames(exposed, counters.delivered, gone, expected, received, lost, agree),
        times_real_time=worked_off / float(plan.frame_rate_hz) / compute_s if compute_s else None,
        resident_settled_bytes=first,
        resident_end_bytes=last,
        resident_growth=None if first is None or last is None else last / first - 1,
        source_late_max_s=spad.late_max_s,
        ended_by=ended_by,
        stages=stages,
        machine=machine(),
    )


def _resident_bytes() -> int:
    """Resident memory of this process; 0 if the system does not report it."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
