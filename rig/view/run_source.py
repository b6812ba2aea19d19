"""A finished run as the page shows it: its maps, and with a recording the counts of their rows.

Four kinds of folder can be shown: a run with maps, one with maps and recording, a recording without maps (of which the
counts are shown until a map is estimated), and imported frames, which have neither columns nor depth.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.recorded.segments import segment_files
from rig.errors import DamagedRecordingError, RigError, UsageError
from rig.exchange.npy import MapFiles, load
from rig.recording.inputs import holds_frames_alone, reconstruct_line
from rig.recording.map_rows import MapRows, RowCounts
from rig.recording.open import open_recording, require_recording
from rig.run_folder.manifest import read_manifest
from rig.run_folder.map_files import read_arrays
from rig.run_folder.pictures import ply_points
from rig.run_folder.runs import read_summary
from rig.scan.monitor import add_frames
from rig.simd import Float32
from rig.view.shown import ShownMap, at_pixels

FRAMES_A_PICTURE: Final = 1000
"""Imported frames that are summed for one picture, which stands in the place of a map."""
_ROWS_KEPT: Final = 64


class RunSource:
    """A run's folder.

    numbers: those of the maps that can be shown, or of the pictures of imported frames. notes: sentences on what the
    page cannot show, and why. manifest, summary: as the run wrote them; empty if they are missing or damaged. recorded:
    whether its frames can be estimated again.

    Raises UsageError if the folder holds neither maps nor a recording. If there are no maps, also DamagedRecordingError
    or another error for a recording that cannot be read; with maps, `notes` says so instead.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._maps = MapFiles(folder)
        if not self._maps.indices:
            require_recording(folder, wanted="a run with maps or a recording")
        self.manifest: Mapping[str, Any] = {}
        self.notes: list[str] = []
        try:
            self.manifest = read_manifest(folder) or {}
        except DamagedRecordingError as error:
            self.notes.append(f"{error}.")
        self.summary = _summary(folder)
        self.rows: MapRows | None = None
        self._sums: _ImportedFrames | None = None
        self.numbers = self._maps.indices
        if segment_files(folder):
            self._open_frames()
        else:
            self.notes.append("The frames of this run were not recorded, so there are no counts of rows.")
        if not self.numbers:
            raise UsageError(f"{folder} holds no whole map and no picture of frames; 'rig verify' tells what is there")
        self._row = lru_cache(_ROWS_KEPT)(self._counted_row)
        estimate = (self.manifest.get("config") or self.manifest).get("estimate") or {}
        self.min_confidence = float(estimate.get("min_confidence", 0.5))

    @property
    def fog(self) -> list[tuple[int, Mapping[str, Any]]]:
        """Number and reading of the fog meter of each map; of the last one alone in runs that kept no others."""
        readings = [sweep.get("fog") for sweep in self.manifest.get("sweeps") or ()]
        if any(readings):
            return [(number, fog) for number, fog in enumerate(readings) if isinstance(fog, Mapping)]
        last = self.summary.get("fog")
        return [(self.numbers[-1], last)] if isinstance(last, Mapping) else []

    @property
    def recorded(self) -> bool:
        """Whether maps can be estimated again."""
        return self.rows is not None

    def map(self, number: int) -> ShownMap:
        """A map as the run wrote it, or else the counts of its frames. Raises UsageError if its files cannot be read,
        and another RigError or a DeviceError if its frames cannot."""
        if self._sums is not None:
            return ShownMap(number, {}, counts=self._sums.picture(number).astype(np.float32))
        if number in self._maps.indices:
            rays = None if self.rows is None or self.rows.model is None else self.rows.geometry.rays
            return read_map(self.folder, number, rays, {"min_confidence": self.min_confidence})
        assert self.rows is not None, "its number is known by the recording"
        return ShownMap(number, {}, counts=self.rows.summed(number).astype(np.float32))

    def row(self, number: int, row: int) -> RowCounts | None:
        """Counts of one row of a map; None if there is no recording, no such row, or the map cannot be read."""
        return self._row(number, row)

    def _counted_row(self, number: int, row: int) -> RowCounts | None:
        try:
            if self._sums is not None:
                return self._sums.row(number, row)
            return None if self.rows is None or number not in self.rows.maps else self.rows.row(number, row)
        except (RigError, DeviceError):
            return None

    def _open_frames(self) -> None:
        try:
            if holds_frames_alone(self.folder):
                self._sums = _ImportedFrames(self.folder)
                self.numbers = list(range(self._sums.pictures))
                self.notes.append(
                    "Imported frames have no columns, so there is no depth: each picture sums "
                    f"{self._sums.frames} frames. Depth: {reconstruct_line(self.folder)}, then view DIR."
                )
                return
            self.rows = MapRows(self.folder)
        except (RigError, DeviceError) as error:
            if not self.numbers:
                raise
            self.notes.append(f"The recording cannot be read, so there are no counts of rows: {error}.")
            return
        self.numbers = sorted({*self.numbers, *self.rows.maps})
        if self.rows.model is None:
            self.notes.append("No depth: the rig was not calibrated when this was recorded.")


class _ImportedFrames:
    """Frames without a plan, summed in groups. pictures: number of groups. frames: number in each."""

    def __init__(self, folder: Path) -> None:
        self._recording = open_recording(folder)
        self._run = self._recording.runs[0]
        self.frames = min(FRAMES_A_PICTURE, self._run.frames)
        self.pictures = max(1, self._run.frames // self.frames) if self.frames else 0
        self._summed = lru_cache(1)(self._sum)

    def picture(self, number: int) -> NDArray[np.uint32]:
        """The sum of one group, (height, width)."""
        return self._summed(number)

    def row(self, number: int, row: int) -> RowCounts | None:
        """A row of the sum, as that of a single column; None if there is no such row."""
        summed = self._summed(number)
        if not 0 <= row < len(summed):
            return None
        ends = np.array([0], np.int32), np.array([summed.shape[1]], np.int32)
        return RowCounts(summed[row : row + 1].astype(np.uint16), np.array([self.frames], np.int32), *ends)

    def _sum(self, number: int) -> NDArray[np.uint32]:
        header = self._run.header
        summed = np.zeros((header.sensor_height, header.sensor_width), np.uint32)
        first = self._run.first_frame + number * self.frames
        for block in self._recording.blocks(self._run, first, first + self.frames):
            for at in range(0, block.n_frames, 64):  # unpacked, a whole block would take a hundred megabytes
                add_frames(summed, block, at, min(at + 64, block.n_frames))
        return summed


def read_map(folder: Path, number: int, rays: tuple[Float32, Float32] | None, about: Mapping[str, Any]) -> ShownMap:
    """Read the files of a map. rays: (u, v) by the calibration; None: taken from the points that the run wrote. about:
    kept with the map; its `min_confidence` is used.

    Raises UsageError if a file cannot be read.
    """
    arrays = MapFiles(folder).arrays(number)
    depth_m = arrays.pop("depth_m", None)
    if depth_m is None:
        return ShownMap(number, arrays, picture_of_counts=_bytes(folder, "intensity", number, ".png"), about=about)
    ply = _bytes(folder, "cloud", number, ".ply")
    counts: Float32 | None = None
    known = np.isfinite(depth_m)
    found = None if ply is None else ply_points(ply)
    if found is not None and len(found) == np.count_nonzero(known):
        counts = np.full(depth_m.shape, np.nan, np.float32)
        counts[known] = found["intensity"]
        if rays is None:
            u, v = np.full_like(counts, np.nan), np.full_like(counts, np.nan)
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # what is not finite is no ray
                u[known], v[known] = found["x"] / found["z"], found["y"] / found["z"]
            rays = u, v
    worth = _worth(folder, number, depth_m.shape)
    if not worth:  # a run that kept only the confidence of stripes
        worth = {"confidence": np.nan_to_num(at_pixels(arrays, "confidence", depth_m, about.get("min_confidence")))}
    return ShownMap(
        number, arrays, depth_m, worth.get("confidence"), worth.get("depth_sd_m"), counts,
        _bytes(folder, "intensity", number, ".png"), rays, about,
    )  # fmt: skip


def _summary(folder: Path) -> Mapping[str, Any]:
    try:
        return read_summary(folder)
    except DamagedRecordingError:
        return {}


def _bytes(folder: Path, kind: str, number: int, suffix: str) -> bytes | None:
    file = folder / kind / f"{number:06d}{suffix}"
    try:
        return file.read_bytes() if file.exists() else None
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}; choose another map") from error


def _worth(folder: Path, number: int, shape: tuple[int, ...]) -> dict[str, Float32]:
    """Confidence and standard deviation of each pixel's depth; empty if the run did not keep them."""
    file = folder / "confidence" / f"{number:06d}.npz"
    arrays = load(file, read_arrays) if file.exists() else {}
    return {name: array for name, array in arrays.items() if array.shape == shape}
