"""Counts of single image rows of a recorded map: the same frames in the same columns as when the run counted them.

The frames of a map are bound to columns once. Reading a row then takes a few milliseconds. Only the frames of the map
that was read last are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from rig.count.followed_row import add_row
from rig.count.sweeps import FirstSweep, SweepAssembler
from rig.count.volume import FrameTally
from rig.depth.reconstruct import map_geometry
from rig.errors import UsageError
from rig.geometry.windows import SweepGeometry
from rig.plan.scan_plan import ScanPlan
from rig.recording.inputs import read_model, read_plan
from rig.recording.open import fitted_ratio, open_recording
from rig.recording.replay import RecordedStart, recorded_sweeps
from rig.run_folder.manifest import read_manifest

_Piece = tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32]]
"""Packed frames (n, rows, row bytes), their bins (n,), and first pixels (n,) if their rows are shorter than the
sensor's."""


@dataclass(frozen=True, slots=True, eq=False)
class RowCounts:
    """One image row of a map. counts: uint16 (columns, width), how often each pixel fired over the frames of a column;
    0 outside the windows that were recorded. frames: int32 (columns,), their number. begin_px, end_px: int32
    (columns,), the search window, end excluded; both 0 where the column has none on this row."""

    counts: NDArray[np.uint16]
    frames: NDArray[np.int32]
    begin_px: NDArray[np.int32]
    end_px: NDArray[np.int32]


class MapRows:
    """The rows of a recording's maps. Raises UsageError if there is no recording or it has no plan, and
    DamagedRecordingError if it cannot be read.

    maps: numbers of its whole maps. problems: a line for each damaged part of the recording, as `rig verify` has them.
    """

    def __init__(self, folder: Path) -> None:
        self._recording = open_recording(folder)
        self.problems = tuple(self._recording.problems)
        self.plan: ScanPlan = read_plan(folder)
        self.model: RigModel | None = read_model(folder)
        manifest = read_manifest(folder) or {}
        self._sweeps: list[dict[str, Any]] = manifest.get("sweeps") or []
        self._starts: Sequence[RecordedStart] = recorded_sweeps(self._recording, self.plan, manifest)
        self.maps = [start.first_map + i for start in self._starts for i in range(start.sweeps)]
        self._kept: tuple[int, _KeptFrames] | None = None

    @cached_property
    def geometry(self) -> SweepGeometry:
        """Rays and search windows of the maps. Without a calibration, whole rows."""
        plan = self.plan
        return map_geometry(
            self.model, plan.commands, plan.depth_range_m, sensor=(plan.rows, plan.width), lines=plan.lines
        )

    def row(self, number: int, row: int) -> RowCounts:
        """Count one row of a map. Raises UsageError for a map or row that does not exist, DamagedRecordingError or
        ProtocolError if frames of the map cannot be read or bound."""
        plan, geometry = self.plan, self.geometry
        if not 0 <= row < plan.rows:
            raise UsageError(f"row {row} is not in the picture, which has {plan.rows}")
        frames = self.frames(number)
        counts = np.zeros((len(frames.n_frames), plan.width), np.uint16)
        for bits, bins, x0 in frames.pieces:
            add_row(counts, bits[:, row], bins, x0)
        seen = geometry.x_lo[row] <= geometry.x_hi[row]
        begin, end = (np.where(seen, px, 0).astype(np.int32) for px in (geometry.x_lo[row], geometry.x_hi[row] + 1))
        if plan.lines is not None:
            counts, n_frames = counts[plan.lines.place], frames.n_frames[plan.lines.place]
        else:
            n_frames = frames.n_frames
        return RowCounts(counts, n_frames, begin, end)

    def summed(self, number: int) -> NDArray[np.uint32]:
        """Counts of a map's lit frames summed, uint32 (rows, width). Raises as `row` does."""
        plan = self.plan
        summed = np.zeros((plan.rows, plan.width), np.uint32)
        for bits, bins, x0 in self.frames(number).pieces:
            whole = bits.shape[2] * 8 >= plan.width
            for first in (0,) if whole else np.unique(x0):
                of_it = bins >= 0 if whole else (bins >= 0) & (x0 == first)
                pixels = np.unpackbits(bits[of_it], axis=2)
                window = summed[:, first : first + pixels.shape[2]]
                window += pixels.sum(axis=0, dtype=np.uint32)[:, : window.shape[1]]
        return summed

    def frames(self, number: int) -> "_KeptFrames":
        """The frames of a map, bound. Raises as `row` does."""
        if self._kept is None or self._kept[0] != number:
            self._kept = None  # before the next map's are read: uncompressed ones take 100 MB and more
            self._kept = number, self._bind(number)
        return self._kept[1]

    def _bind(self, number: int) -> "_KeptFrames":
        start = next((one for one in self._starts if 0 <= number - one.first_map < one.sweeps), None)
        if start is None:
            there = f"it has {self.maps[0]} to {self.maps[-1]}" if self.maps else "no map of it is whole"
            raise UsageError(f"map {number} is not in {self._recording.path}; {there}")
        run, local = self._recording.runs[start.number], number - start.first_map
        noted = self._sweeps[start.first_map : start.first_map + local + 1]
        if self.plan.blanking is None and len(noted) == local + 1:
            ratio = fitted_ratio(start.begin.clock_ratio, noted[:-1])
            begin, maps = FirstSweep(start.begin.sweep + local, ratio), 1
            first, end = int(noted[-1]["first_frame"]), int(noted[-1]["end_frame"]) + 1
        else:  # nobody noted where the map begins, or it shows only in the light of the frames before it
            begin, maps, first, end = start.begin, local + 1, run.first_frame, run.end_frame
        assembler = SweepAssembler(self.plan, _FrameKeeper(self.plan), maps, start=begin)
        for block in self._recording.blocks(run, first, end):
            for sweep in assembler.add(block):
                if assembler.complete:
                    assert isinstance(sweep.tally, _KeptFrames), "the keeper made it"
                    return sweep.tally
        raise UsageError(
            f"the marker that ends map {number} of {self._recording.path} is gone; 'rig verify' tells more"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _KeptFrames(FrameTally):
    """A bound sweep with its frames."""

    pieces: list[_Piece] = field(default_factory=list)


class _FrameKeeper:
    """A `Counter` that counts nothing and keeps the frames."""

    def __init__(self, plan: ScanPlan) -> None:
        self._bins = plan.columns if plan.lines is None else plan.lines.places
        self._width = plan.width
        self.reset()

    def reset(self) -> None:
        """Begin the next sweep."""
        self._pieces: list[_Piece] = []

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Keep frames, as in `Counter`."""
        self._pieces.append((bits, bins, x0))

    def settle(self, under_way: int = 0) -> None:
        """Do nothing: frames of a recording stay where they are."""

    def finish(self) -> _KeptFrames:
        """The frames so far."""
        n_frames = np.zeros(self._bins, np.int32)
        for _, bins, _ in self._pieces:
            n_frames += np.bincount(bins[bins >= 0], minlength=self._bins).astype(np.int32)
        column = np.arange(self._bins, dtype=np.float64)
        return _KeptFrames(
            n_frames=n_frames, column=column, dark_counts=None, n_dark=0, width=self._width, pieces=self._pieces
        )
