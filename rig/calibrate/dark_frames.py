"""Takes frames for the map of the pixels: dark ones from the SPAD alone, or the dark and lit ones of a recorded run.

In the dark nothing moves and no light leaves: the gate is low, the laser is not armed, the scanner stands. The frames
come in short starts spread over a while, since rates that jump do so within milliseconds or minutes.
"""

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calibration.pixel_map import DarkTally
from drivers.frames import FrameBlock, frame_bytes
from drivers.interfaces import SpadInfo, SpadMode, SpadRequest
from drivers.ring import BlockRing
from rig.config.models import ScanConfig
from rig.count.sweeps import SweepData
from rig.count.volume import BIN_DARK, CountVolume, SweepCounter, SweepLayout
from rig.devices.open import OpenRig
from rig.errors import UsageError
from rig.geometry.windows import WORD_PX
from rig.progress import Progress, counted
from rig.recording.inputs import read_plan
from rig.requests import RunRequest
from rig.run_folder.summary import MapTally
from rig.scan.monitor import Listeners, ScanProgress
from rig.scan.pipeline import JOIN_S
from rig.scan.run import Run
from rig.scan.scan import run_scan
from rig.scan.source import Source, blocks
from rig.threads import RowWorkers

STARTS: Final = 32
"""Number of starts of the SPAD, and so of blocks whose counts are compared."""
BLOCK_FRAMES: Final = 128
SPARE_SLOTS: Final = 4
"""Slots of the ring beyond those needed, for a device that sends shorter blocks than asked for, and would drop some."""
SILENCE_S: Final = 5.0
SPREAD_S: Final = 10.0
"""Seconds from the first start to the last one."""

Sums = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Ones and frames of every pixel, (rows, width) each."""


@runtime_checkable
class CoversLens(Protocol):
    """A world that can put the cap on the lens."""

    def cover_lens(self) -> None:
        """Let no light in any more."""
        ...


@dataclass(slots=True)
class SweepSums:
    """Adds up the dark and the lit frames of counted sweeps; `add` fits the `sweeps` option of a scan."""

    tally: DarkTally | None = None
    lit: Sums | None = None

    def add(self, sweep: SweepData) -> None:
        """Add a sweep; its dark frames are one block."""
        volume = sweep.volume
        if not isinstance(volume, CountVolume) or volume.dark_counts is None:
            return
        shape = volume.dark_counts.shape
        self.tally = self.tally or DarkTally((shape[0], shape[1]))
        dark_frames = volume.n_dark if volume.dark_frames is None else volume.dark_frames
        self.tally.add(volume.dark_counts.astype(np.int64), np.asarray(dark_frames, np.int64))
        ones, frames = self.lit or (np.zeros(shape, np.int64), np.zeros(shape, np.int64))
        self.lit = ones + volume.intensity(), frames + _frames_in_windows(volume)


def take_dark(
    rig: OpenRig,
    frames: int,
    *,
    progress: Progress | None = None,
    covered: Callable[[], None] | None = None,
) -> tuple[DarkTally, float]:
    """Take at least so many frames with an open rig in the dark; returns them with their exposure in seconds.

    covered: called before the first start, where a person has to cover the lens. Raises DeviceError.
    """
    if isinstance(rig.world, CoversLens):
        rig.world.cover_lens()
    elif covered is not None:
        covered()
    info = rig.spad.info
    burst = info.burst.capacity_frames if info.stream is None and info.burst is not None else None
    per_start = min(math.ceil(frames / STARTS), burst or frames)
    request = _request(rig.config.scan, info, per_start)
    timing = rig.spad.configure(request)
    rig.sync.gate_low()
    workers = RowWorkers(rig.config.estimate.threads or os.cpu_count() or 1)
    counter = SweepCounter(_layout(info.height, info.width), workers)
    tally = DarkTally((info.height, info.width))
    starts = math.ceil(frames / per_start)
    rest_s = max(0.0, (SPREAD_S - frames / float(request.frame_rate_hz)) / max(starts - 1, 1))
    told = counted("taking dark frames", "frames", progress)
    for start in range(starts):
        if start:
            rig.clock.sleep(rest_s)
        counter.reset()
        for block in _blocks(rig, per_start, timing.stride, request.block_frames):
            _count(counter, block)
        sums = counter.finish()
        if sums.dark_counts is not None:
            tally.add(sums.dark_counts.astype(np.int64), sums.n_dark)
        told((start + 1) * per_start, frames)
    return tally, float(timing.exposure_ticks / timing.tick_hz)


def take_sweeps(rig: OpenRig, maps: int | None = None, progress: Progress | None = None) -> SweepSums:
    """Take the frames of a scan with light, or of all sweeps of a recording. An interrupt is raised again."""
    scan, sums = rig.config.scan, SweepSums()

    def live(now: ScanProgress) -> None:
        if progress is not None:
            progress(now.frames, now.frames_planned)

    with Run(None, MapTally(scan.columns, scan.exposures, "argmax", "none")) as run:
        request = RunRequest(maps=maps, accept_calibration=True)
        run_scan(rig, run, request, Listeners(sweeps=sums.add, live=live)).uninterrupted()
    if sums.tally is None:
        raise UsageError(f"{rig.spad.name} gave no sweep with dark frames in one piece; scan again")
    return sums


def recorded_exposure_s(run: Path) -> float:
    """Exposure of a recording's frames, seconds."""
    return float(read_plan(run).exposure_s)


def _request(scan: ScanConfig, info: SpadInfo, frames: int) -> SpadRequest:
    """Request for full frames of the scan's exposure, as fast as the link carries them."""
    rate = Fraction(scan.frame_rate)
    if info.stream is not None:
        rate = min(rate, Fraction(math.floor(info.stream.bytes_per_s / frame_bytes(info.width, info.height))))
    mode: SpadMode = "burst" if info.stream is None else "stream"
    return SpadRequest(rate, scan.exposure_s, mode, min(BLOCK_FRAMES, frames))


def _layout(rows: int, width: int) -> SweepLayout:
    """Layout for dark frames only: no column will ever be counted."""
    return SweepLayout(1, rows, width, np.zeros(1, np.int32), WORD_PX, 1)


def _blocks(rig: OpenRig, frames: int, stride: int, block_frames: int) -> Iterator[FrameBlock]:
    """Blocks of a start of so many frames, for all of which the ring has room."""
    ring = BlockRing(-(-frames // block_frames) + SPARE_SLOTS, stride)
    source = Source(rig.spad, ring, SILENCE_S, lambda: None)
    with ring.reader("pixels") as reader:
        rig.spad.start(frames)
        source.start()
        try:
            yield from blocks(reader, source, SILENCE_S)
        finally:
            source.end()
            rig.spad.stop()
            source.join(JOIN_S)


def _count(counter: SweepCounter, block: FrameBlock) -> None:
    n = block.n_frames
    if n:
        counter.add(block.bits, np.full(n, BIN_DARK, np.int32), np.zeros(n), np.zeros(n, np.int32))


def _frames_in_windows(volume: CountVolume) -> NDArray[np.int64]:
    """Frames (width,) in which each pixel of a row lay within the counted window."""
    window = volume.counts.shape[2]
    change = np.zeros(max(volume.width, int(volume.x0.max(initial=0)) + window) + 1, np.int64)
    np.add.at(change, volume.x0, volume.n_frames)
    np.add.at(change, volume.x0 + window, -volume.n_frames)
    return np.cumsum(change)[: volume.width]
