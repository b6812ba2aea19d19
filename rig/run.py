"""One run from its first map to its folder: what `rig scan` and `rig reconstruct` have in common."""

import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from drivers.interfaces import SweepTruth
from rig.outputs import Rays, RunFolder
from rig.reconstruction import MapResult
from rig.saving import SavePolicy
from rig.summary import MapTally, RunFrames, Summary, Verdict

Progress = Callable[[int, int], None]
"""Called now and then with what is done and what there is to do, in frames or maps."""
OutFolder = str | os.PathLike[str] | None


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a run gives back.

    last: the last map, None where the run ended before its first. truth: that map's, where a world knows it.
    folder: where everything was written, None where nothing was.
    """

    summary: Summary
    last: MapResult | None
    truth: SweepTruth | None
    folder: Path | None


class Run:
    """Takes the maps of a run one by one, writes those to be kept, and closes with manifest and summary.

    Leaving the context without `finish` removes everything that was written. out: folder, None to write nothing.
    rays: the camera's (u, v) of every pixel, to be set before the first map; None for an uncalibrated rig.
    """

    def __init__(self, out: OutFolder, tally: MapTally, save: SavePolicy | None = None) -> None:
        """Claim the folder. Raises UsageError where it cannot be written."""
        self.tally = tally
        self._folder = None if out is None else RunFolder(out)
        self.rays: Rays | None = None
        self._save = save or SavePolicy()
        self._last: tuple[int, MapResult, SweepTruth | None] | None = None

    def __enter__(self) -> Self:
        """The run itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove what was not finished."""
        if self._folder is not None:
            self._folder.discard()

    def add(self, result: MapResult, compute_s: float, truth: SweepTruth | None = None) -> None:
        """Take the next map: whole, or, where anything ends it before it is counted, not at all."""
        index = self.tally.maps
        before = self._last
        try:
            if self._save.keeps(index):
                self._write(index, result, truth)
            self._last = index, result, truth
            self.tally.add(result, compute_s, truth)
        except BaseException:
            if self.tally.maps == index:
                self._last = before
                if self._folder is not None:
                    self._folder.remove_map(index)
            raise

    def finish(
        self, frames: RunFrames, sensor_time_s: float, verdict: Verdict, manifest: Mapping[str, Any]
    ) -> RunResult:
        """Write manifest and summary and make the folder appear; a run without a single map leaves none."""
        summary = self.tally.summary(frames, sensor_time_s, verdict)
        if self._last is None:
            return RunResult(summary, None, None, None)
        index, result, truth = self._last
        folder = None
        if self._folder is not None:
            if self._save.step is None:
                self._write(index, result, truth)
            self._folder.write_json("manifest.json", {"versions": versions(), **manifest})
            self._folder.write_json("summary.json", summary.as_json())
            folder = self._folder.publish()
        return RunResult(summary, result, truth, folder)

    def _write(self, index: int, result: MapResult, truth: SweepTruth | None) -> None:
        if self._folder is None:
            return
        self._folder.write_map(index, result, self.rays)
        if truth is not None:
            self._folder.write_truth(index, truth)


def versions() -> dict[str, str]:
    """Versions of the program and of what its figures depend on."""
    found = {"python": platform.python_version()}
    for name in ("spadrig", "numpy", "numba", "opencv-contrib-python-headless"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # installed under another name, as distributions repackage it
            continue
    return found
