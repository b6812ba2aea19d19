"""The calls for recordings: verify, repair, describe, cut and compress them, and exchange them with other programs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rig.config.overrides import PathLike
from rig.exchange import exporting, importing
from rig.progress import Progress
from rig.recording import compress as compressing
from rig.recording import cut as cutting
from rig.recording import open as opening
from rig.recording import repair as mending
from rig.recording import verify as verifying
from rig.requests import CutRequest, ExportRequest, ImportRequest
from rig.scan.run import OutFolder


def verify(run: PathLike) -> verifying.Verification:
    """Read every byte of a recording and report whether it is what was recorded (`rig verify`)."""
    return verifying.verify(Path(run))


def repair(run: PathLike) -> mending.Repair:
    """Make a torn recording whole. No frame is changed and no byte thrown away (`rig repair`)."""
    return mending.repair(Path(run))


def recording_info(run: PathLike) -> opening.RecordingInfo:
    """Describe a recording from its index and manifest, without reading the frames (`rig info`)."""
    return opening.info(Path(run))


def cut(run: PathLike, out: PathLike, request: CutRequest | None = None, **changes: Any) -> dict[str, Any]:
    """Write a part of a recording to the folder `out` and return the manifest of the part (`rig cut`).

    request, changes: which part, as a `CutRequest` or by the names of its fields: `cut("run", "part", maps="0:2")`.
    """
    asked = replace(request or CutRequest(), **changes)
    return cutting.cut(Path(run), Path(out), maps=asked.maps, frames=asked.frames, time=asked.time, run=asked.start)


def compress(run: PathLike) -> compressing.Compression:
    """Compress a recording with zstd. It can be read like any other (`rig compress`). Needs the extra `compress`."""
    return compressing.compress(Path(run))


def import_frames(
    kind: str,
    files: Sequence[PathLike],
    out: PathLike,
    request: ImportRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> importing.ImportResult:
    """Make a recording from the frames of another program (`rig import`).

    kind: pi-imaging, swissspad2 or photoncube.
    files: in order; a folder stands for the files in it.
    request, changes: how they are read, as an `ImportRequest` or by the names of its fields.
    progress: called with the number of frames done and the total.
    Raises UsageError, one line per problem.
    """
    return importing.import_frames(kind, files, out, replace(request or ImportRequest(), **changes), progress)


def export_run(
    run: PathLike,
    kind: str,
    request: ExportRequest | None = None,
    *,
    out: OutFolder = None,
    progress: Progress | None = None,
    **changes: Any,
) -> exporting.ExportResult:
    """Write a run for other programs (`rig export`): npy, hdf5, ply, png or mp4.

    request, changes: what pictures and films show, as an `ExportRequest` or by the names of its fields.
    out: the folder to write; None is RUN-KIND beside the run.
    progress: called with the number of frames done and the total.
    Raises UsageError if the run has nothing of that kind.
    """
    return exporting.export_run(run, kind, out, replace(request or ExportRequest(), **changes), progress)
