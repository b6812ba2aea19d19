"""One run from its first map to its folder: the common part of `rig scan` and `rig reconstruct`.

`Run` takes the maps and writes the folder. The functions below it add up the sweeps of a scan: frames, synchronisation,
verdict, and an account of each sweep for the manifest.
"""

import gc
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from calibration.model.rig_model import RigModel
from drivers.interfaces import SpadCounters, SweepTruth
from drivers.transports.tap import CONTROL_FILE, TapFile
from rig.count.sweeps import Gap, SweepAccount
from rig.depth.fog_meter import FogEstimate
from rig.depth.reconstruct import MapResult
from rig.errors import UsageError
from rig.progress import tell_stage
from rig.recording.segment import Space
from rig.recording.writer import Recording
from rig.run_folder.disk import CLAIM_FILE
from rig.run_folder.folder import Rays, RunFolder, SavePolicy
from rig.run_folder.manifest import UNFINISHED, RunVerdict, file_crc32, package_versions
from rig.run_folder.summary import MapTally, RunFrames, Summary, Synchronisation
from rig.scan.control_check import ControlCheck
from rig.scan.on_request import PartsRecording, RecordingSwitch

OutFolder = str | os.PathLike[str] | None


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """Result of a run.

    last: the last map; None if the run ended before its first.
    truth: the truth of that map; None if it is not known.
    folder: where everything was written; None if nothing was.
    control: for a replay with drivers, the comparison of what they sent with the recording.
    earlier: the scans before this one in the same call, if `on_map` changed settings.
    """

    summary: Summary
    last: MapResult | None
    truth: SweepTruth | None
    folder: Path | None
    control: ControlCheck | None = None
    earlier: tuple["RunResult", ...] = ()

    def uninterrupted(self) -> Self:
        """The result itself, for callers that need the whole run. Raises KeyboardInterrupt if an interrupt ended it."""
        if self.summary.verdict is RunVerdict.ABORTED:
            raise KeyboardInterrupt
        return self


class Run:
    """Takes the maps of a run one by one, writes those to be kept, and completes the folder with manifest and summary.

    Leaving the context without `finish` removes everything that was written, unless a block was recorded.

    out: folder; None writes nothing. save: which maps are written; None for all. record: whether the folder is that of
    a recording. rays: the camera's (u, v) of every pixel, to be set before the first map; None for an uncalibrated rig.
    """

    def __init__(
        self, out: OutFolder, tally: MapTally, save: SavePolicy | None = None, *, record: bool = False
    ) -> None:
        """Claim the folder. Raises UsageError if it cannot be written."""
        self.tally = tally
        self.switch: RecordingSwitch | None = None
        self.extra: dict[str, Any] = {}
        """Further keys of the manifest."""
        self._folder = None if out is None else RunFolder(out, in_place=record)
        self.rays: Rays | None = None
        self.save = save or SavePolicy()
        self._last: tuple[int, MapResult, SweepTruth | None] | None = None
        self._recording: Recording | PartsRecording | None = None
        self._inputs: dict[str, int] = {}
        self._tap: TapFile | None = None

    def start_tap(self) -> TapFile:
        """Start to record the traffic on the ports of the devices, and return its file."""
        assert self._folder is not None, "asked for with a recording, which needs a folder"
        self._tap = TapFile.begin(self._folder.place(CONTROL_FILE))
        return self._tap

    @property
    def worth_keeping(self) -> bool:
        """Whether there is a whole map or a recorded block."""
        return self.tally.maps > 0 or (self._recording is not None and self._recording.blocks > 0)

    @property
    def path(self) -> Path | None:
        """The run's folder; None if nothing is written."""
        return None if self._folder is None else self._folder.path

    def start_recording(
        self,
        manifest: Callable[[], Mapping[str, Any]],
        write_inputs: Callable[[Path], None],
        space: Space,
    ) -> Recording:
        """Begin the recording of a run in its folder; it is closed with the run.

        manifest: gives what is known so far; it is on the disk before this returns, and written again with each start
          of the SPAD.
        write_inputs: writes the files that belong beside the frames.
        space: the most room that frames and maps will take.
        Raises UsageError if the disk has less room or files beside the frames cannot be written, RecordingError if the
        recording itself cannot be.
        """
        folder = self._folder
        assert folder is not None, "its space was looked at"
        space.require()

        def begun() -> None:
            assert recording is not None, "tells of its starts only"
            content = {"versions": versions(), **manifest(), "inputs": self._inputs, "verdict": UNFINISHED}
            content["recording"] = recording.content()
            folder.write_json("manifest.json", content)

        recording: Recording | None = None
        try:
            write_inputs(folder.path)
            self._inputs = {
                file.name: file_crc32(file)
                for file in sorted(folder.path.iterdir())
                if file.is_file() and file.name not in (CONTROL_FILE, CLAIM_FILE)
            }
        except OSError as error:
            raise UsageError(f"cannot write {folder.path}: {error.strerror or error}; name another `out`") from error
        sync = None if self._tap is None else self._tap.sync
        expected = space.recording_bytes
        self._recording = recording = Recording(folder.path, expected_bytes=expected, on_begin=begun, on_sync=sync)
        begun()
        return recording

    def record_on_request(
        self,
        keep_blocks: int,
        held_bytes: int,
        manifest: Callable[[], Mapping[str, Any]],
        write_inputs: Callable[[Path], None],
    ) -> PartsRecording:
        """Begin a recording in parts, which the run's `switch` turns on and off; it is closed with the run. The
        arguments and errors are those of `PartsRecording`."""
        assert self._folder is not None, "asked for with a folder"
        assert self.switch is not None, "asked for with a switch"

        def known() -> Mapping[str, Any]:
            return {"versions": versions(), **manifest()}

        parts = PartsRecording(self._folder.path, self.switch, keep_blocks, held_bytes, known, write_inputs)
        self._recording = parts
        self._folder.write_json("manifest.json", {**known(), "verdict": UNFINISHED})
        return parts

    def __enter__(self) -> Self:
        """The run itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove a folder that was not finished, unless a block was recorded: 'rig repair' completes such a recording.

        Also collect garbage, which gives back the memory of the run's ring and maps.
        """
        try:
            if self._recording is not None:
                self._recording.close()
        finally:
            if self._folder is not None and self._recording is not None and self._recording.blocks:
                self._folder.keep()
            elif self._folder is not None:
                self._folder.discard()
            # Threads and callbacks of a scan refer to one another and to its ring and maps, hundreds of MB. Python
            # would collect them so seldom that a notebook's hundredth scan ran out of memory.
            gc.collect()

    def add(self, result: MapResult, compute_s: float, truth: SweepTruth | None = None) -> None:
        """Take the next map. If an error or interrupt comes in between, the map counts completely or not at all. Raises
        UsageError if the map cannot be written."""
        index = self.tally.maps
        before = self._last
        try:
            if self._folder is not None and self.save.keeps(index):
                tell_stage("writing")
                self._write(index, result, truth)
            self._last = index, result, truth
            self.tally.add(result, compute_s, truth)
        except BaseException:
            if self.tally.maps == index:
                self._last = before
                if self._folder is not None:
                    self._folder.remove_map(index)
            raise

    def finish(self, summary: Summary, manifest: Mapping[str, Any]) -> RunResult:
        """Write manifest and summary and make the folder appear. If there is no map and no recorded block, the result
        has no folder. Raises UsageError if a file cannot be written, RecordingError if a recording cannot be completed.
        """
        index, result, truth = self._last or (None, None, None)
        folder = None
        if self._folder is not None and self.worth_keeping:
            tell_stage("writing")
            if self.save.step is None and index is not None and result is not None:
                self._write(index, result, truth)
            content = {"versions": versions(), **manifest, "verdict": summary.verdict.value}
            if self._recording is not None:
                self._recording.close()
            if isinstance(self._recording, Recording):
                content |= {"inputs": self._inputs, "recording": self._recording.content()}
            elif self._recording is not None:
                content["on_request"] = self._recording.content()
                self._recording.finish(content)
            self._folder.write_json("manifest.json", content)
            self._folder.write_json("summary.json", summary.as_json())
            folder = self._folder.publish()
        return RunResult(summary, result, truth, folder)

    def _write(self, index: int, result: MapResult, truth: SweepTruth | None) -> None:
        assert self._folder is not None, "asked for where there is one"
        self._folder.write_map(index, result, self.rays)
        if truth is not None:
            self._folder.write_truth(index, truth)


def versions() -> dict[str, str]:
    """Versions of the program and of the packages on which its results depend."""
    packages = package_versions("spadrig", "numpy", "numba", "opencv-contrib-python-headless")
    return {"python": platform.python_version(), **packages}


def frames_of(sweeps: list[SweepAccount], crc_errors: int | None, outside: Sequence[Gap] = ()) -> RunFrames:
    """Add up the frames of the sweeps.

    crc_errors: as the SPAD counts them; None if it does not. outside: ranges (first, last) of frames known to be lost
    outside the sweeps.
    """
    beside = sum(last + 1 - first for first, last in outside)
    return RunFrames(
        expected=beside + sum(sweep.frames.expected for sweep in sweeps),
        received=sum(sweep.frames.received for sweep in sweeps),
        lost=beside + sum(sweep.frames.lost for sweep in sweeps),
        crc_errors=crc_errors,
        lit=sum(sweep.frames.lit for sweep in sweeps),
    )


def frames_that_came(of_maps: RunFrames, counters: SpadCounters, dropped: int) -> RunFrames:
    """Frames of a run that ended before its last map: all that came, including those after its last whole map.

    of_maps: those of its whole maps; `lit` and `crc_errors` stay as they are there. counters: the SPAD's own. dropped:
    frames that found no room in the ring; they count as the lost ones if the SPAD does not count lost frames.
    """
    lost = dropped if counters.lost is None else counters.lost
    return replace(of_maps, expected=counters.delivered + lost, received=counters.delivered, lost=lost)


def synchronisation_of(sweeps: list[SweepAccount]) -> Synchronisation | None:
    """Summary of how well the sweeps were bound: the worst of each figure; None without sweeps."""
    if not sweeps:
        return None
    residuals = [sweep.residual_columns for sweep in sweeps]
    found = [sweep.detection for sweep in sweeps if sweep.detection is not None]
    return Synchronisation(
        by="blanking pattern" if found else "markers",
        residual_columns=None if any(map(math.isnan, residuals)) else max(residuals),
        clock_error=max((sweep.clock_error for sweep in sweeps), key=abs),
        detection_probability=min(found) if found else None,
    )


def verdict_of(
    sweeps: list[SweepAccount],
    model: RigModel | None,
    *,
    aborted: bool,
    doubtful: bool,
    outside: Sequence[Gap] = (),
) -> RunVerdict:
    """The gravest verdict that applies. doubtful: whether a check of a map's light found a doubt
    (`rig.count.map_checks`). outside: as in `frames_of`.
    """
    if aborted:
        return RunVerdict.ABORTED
    if not all(sweep.synchronised or _markers_lost(sweep) for sweep in sweeps):
        return RunVerdict.UNSYNCHRONISED
    if doubtful:
        return RunVerdict.DOUBTFUL
    if outside or any(sweep.frames.lost for sweep in sweeps):
        return RunVerdict.GAPS
    return RunVerdict.COMPLETE if model is not None else RunVerdict.UNCALIBRATED


def _markers_lost(sweep: SweepAccount) -> bool:
    """Whether so many frames were lost that too few markers are left to judge the sweep's clock."""
    return sweep.frames.lost > 0 and math.isnan(sweep.residual_columns)


def sweep_content(sweep: SweepAccount, fog: FogEstimate) -> dict[str, Any]:
    """The account of one sweep as plain values for the manifest. fog: the reading of its map."""
    return {
        "direction": sweep.direction,
        "first_frame": sweep.first_frame,
        "end_frame": sweep.end_frame,
        "lost": sweep.frames.lost,
        "dark": sweep.frames.dark,
        "clock_error": sweep.clock_error,
        "residual_columns": sweep.residual_columns,
        "detection_probability": sweep.detection,
        "fog": asdict(fog),
    }
