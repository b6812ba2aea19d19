"""`rig export`: writes a run for other programs, as arrays, one HDF5 file, point clouds, pictures or a film."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from drivers.errors import DeviceNotFound, ProtocolError
from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from drivers.recorded.segments import segment_files
from rig.config.overrides import PathLike
from rig.errors import DamagedRecordingError, UsageError, absent
from rig.exchange import hdf5, pictures
from rig.exchange.npy import FrameLog, MapFiles, write_npy
from rig.exchange.pictures import VIEWS, View
from rig.progress import Progress, counted
from rig.recording.inputs import read_model, reconstruct_line
from rig.recording.open import SEGMENTS, require_recording
from rig.requests import ExportRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.manifest import read_manifest
from rig.run_folder.pictures import Picture
from rig.run_folder.runs import is_run

EXPORT_KINDS: Final = ("npy", "hdf5", "ply", "png", "mp4")
PICTURE_KINDS: Final = ("png", "mp4")
"""Kinds of pictures, which show depth, intensity or sums of frames (`View`)."""
FILMS_PER_S: Final = 25.0
FRAMES_PER_PICTURE: Final = 100


@dataclass(frozen=True, slots=True)
class ExportResult:
    """Result of an export. gaps: missing frames, (run id, first, last). damage: a line for each unreadable part."""

    folder: Path
    kind: str
    files: tuple[str, ...]
    frames: int
    maps: int
    gaps: tuple[tuple[int, int, int], ...] = ()
    damage: tuple[str, ...] = ()


def export_run(
    run: PathLike,
    kind: str,
    request: ExportRequest | None = None,
    *,
    out: PathLike | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> ExportResult:
    """Write a run for other programs (`rig export`): npy, hdf5, ply, png or mp4.

    request, changes: what pictures and films show, as an `ExportRequest` or by the names of its fields.
    out: the folder to write, which appears only once it is complete; None means RUN-KIND beside the run.
    progress: called with the number of frames done and the total.
    Raises UsageError if the run has nothing of that kind, the request does not fit the kind, `out` cannot be written or
    h5py is not installed; DamagedRecordingError if no block of a recording can be read.
    """
    run, request = Path(run), replace(request or ExportRequest(), **changes)
    _check(run, kind, request)
    target = Path(out) if out is not None else run.absolute().with_name(f"{run.absolute().name}-{kind}")
    with RunFolder(target) as folder:
        export = _Export(run, folder, request, progress)
        try:
            getattr(export, f"write_{kind}")()
        except OSError as error:
            raise UsageError(
                f"cannot export {run} to {target}: {error.strerror or error}; free the space it needs or name another "
                "folder as `out`"
            ) from error
        files = tuple(sorted(file.name for file in folder.place("").iterdir()))
        log = export.log
        path = folder.publish()
    frames, gaps = (export.n_frames, []) if log is None else (log.n_frames, log.gaps())
    return ExportResult(path, kind, files, frames, export.n_maps, tuple(gaps), tuple(export.damage))


class _Export:
    """An export under way, with a method for each kind."""

    def __init__(self, run: Path, folder: RunFolder, request: ExportRequest, progress: Progress | None) -> None:
        self._run, self._folder, self._asked = run, folder, request
        self._told = counted("writing", "frames", progress)
        self._maps = MapFiles(run)
        self.log: FrameLog | None = None
        self.n_maps = self.n_frames = 0
        self.damage: list[str] = []

    def write_npy(self) -> None:
        """Write the frames as a cube."""
        if not self._recorded:
            require_recording(self._run)
        model = read_model(self._run)
        source = {"run": self._run.absolute().name, "manifest": self._manifest()}
        self.log = write_npy(self._blocks(), self._folder, source, None if model is None else model.camera)

    def write_hdf5(self) -> None:
        """Write frames and maps, if there are any, to one file."""
        if not self._maps.indices and not self._recorded:
            require_recording(self._run)
        blocks = self._blocks() if self._recorded else iter(())
        log = hdf5.write_hdf5(blocks, self._maps, self._manifest(), self._folder.place(hdf5.FILE))
        self.log = log if self._recorded else None
        self.n_maps = len(self._maps.indices)

    def write_ply(self) -> None:
        """Write the point clouds of all maps."""
        clouds = self._maps.files("cloud", ".ply")
        if not clouds:
            raise UsageError(f"{self._run} holds no point clouds; {self._make_maps()}")
        for file in clouds:
            shutil.copyfile(file, self._folder.place(file.name))
        self.n_maps = len(clouds)

    def write_png(self) -> None:
        """Write pictures as separate files."""
        self._write_pictures(lambda shown, view: pictures.write_pngs(shown, self._folder, view))

    def write_mp4(self) -> None:
        """Write a film."""
        per_s = self._asked.pictures_per_s or FILMS_PER_S
        self._write_pictures(lambda shown, view: pictures.write_mp4(shown, self._folder.place(f"{view}.mp4"), per_s))

    def _write_pictures(self, write: Callable[[Iterator[Picture], View], int]) -> None:
        view = self._view()
        if view != "frames":
            self.n_maps = write(pictures.map_pictures(self._maps, view), view)
            return
        summed = self._asked.frames_per_picture or FRAMES_PER_PICTURE
        self.n_frames = summed * write(pictures.frame_pictures(self._blocks(), summed), view)
        if self.n_frames == 0:
            raise UsageError(f"{self._run} holds fewer than {summed} frames, one picture's; lower `frames_per_picture`")

    @property
    def _recorded(self) -> bool:
        return bool(segment_files(self._run)) and (self._run.is_dir() or self._run.match(f"{SEGMENTS}*"))

    def _blocks(self) -> Iterator[FrameBlock]:
        """Yield all sound blocks of the recording, and note problems with others as damage."""
        try:
            recording = RunRecording(self._run)
            done = 0
            for run in recording.runs:
                for block in recording.blocks(run):
                    yield block
                    done += block.n_frames
                    self._told(done, recording.frames)
        except (ProtocolError, DeviceNotFound) as error:
            raise DamagedRecordingError(str(error)) from error
        self.damage += recording.problems

    def _manifest(self) -> dict[str, Any]:
        """The run's manifest; empty if it is missing or damaged. Damage is noted."""
        try:
            return read_manifest(self._run) or {}
        except DamagedRecordingError as error:
            self.damage.append(str(error))
            return {}

    def _view(self) -> View:
        """The view to show. Raises UsageError if the run lacks it, or if frames are to be summed for another view."""
        there = {
            "depth": bool(self._maps.files("depth", ".npy")),
            "intensity": bool(self._maps.files("intensity", ".png")),
            "frames": self._recorded,
        }
        view = next((one for one in VIEWS if one == self._asked.view or (not self._asked.view and there[one])), None)
        if view == "frames" and not there[view]:
            require_recording(self._run)
        if view is None or not there[view]:
            what = f"no {view}" if view else "nothing to show"
            raise UsageError(f"{self._run} holds {what}; {self._make_maps()}")
        if self._asked.frames_per_picture and view != "frames":
            raise UsageError(
                f"pictures of {view} sum no frames; name `view='frames'`, or leave `frames_per_picture` out"
            )
        return view

    def _make_maps(self) -> str:
        """Advice on how to make missing maps. Raises UsageError if there is no recording to make them of."""
        require_recording(self._run)
        return f"make them first: {reconstruct_line(self._run)}, and export that folder"


def _check(run: Path, kind: str, request: ExportRequest) -> None:
    if not run.exists():
        raise UsageError(absent(run, "name the folder of a run", is_run))
    known, view = kind in EXPORT_KINDS, request.view
    summed, per_s = request.frames_per_picture, request.pictures_per_s
    fps = f"{per_s or 0.0:g}"
    no_pictures = f"{kind} has none; export png or mp4, or leave it out" if known and kind not in PICTURE_KINDS else ""
    no_film = known and kind != "mp4"
    checks = [
        (not known, f"export kind {kind!r} is unknown; choose one of {', '.join(EXPORT_KINDS)}"),
        (view not in (None, *VIEWS), f"view {view!r} is unknown; choose one of {', '.join(VIEWS)}"),
        (view in VIEWS and no_pictures, f"view {view!r} is of pictures, {no_pictures}"),
        (summed is not None and no_pictures, f"`frames_per_picture={summed}` are summed for pictures, {no_pictures}"),
        (summed is not None and summed < 1, f"{summed} frames make no picture; sum at least 1"),
        (
            per_s is not None and no_film,
            f"`pictures_per_s={fps}` is of a film, {kind} is none; export mp4, or leave it out",
        ),
        (
            per_s is not None and not 0 < per_s <= 1000,
            f"a film of {fps} pictures a second; choose 1000 or less, above 0",
        ),
    ]
    if problems := [line for wrong, line in checks if wrong]:
        raise UsageError.of(problems)
    if kind == "hdf5":
        hdf5.require_h5py()
