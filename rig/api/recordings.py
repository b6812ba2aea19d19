"""The calls for recordings: check, mend, describe, cut and compress them, and exchange them with other programs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.config.overrides import PathLike
from rig.progress import Progress
from rig.requests import CutRequest, ExportRequest, ImportRequest
from rig.scan.run import OutFolder

if TYPE_CHECKING:
    from rig.exchange.exporting import ExportResult
    from rig.exchange.importing import ImportResult
    from rig.recording.compress import Compression
    from rig.recording.open import RecordingInfo
    from rig.recording.repair import Repair
    from rig.recording.verify import Verification


def verify(run: PathLike) -> "Verification":
    """Read every byte of a recording and report whether it is what was recorded (`rig verify`)."""
    from rig.recording.verify import verify as read_all

    return read_all(Path(run))


def repair(run: PathLike) -> "Repair":
    """Make a torn recording whole; no frame is changed and no byte thrown away (`rig repair`)."""
    from rig.recording.repair import repair as mend

    return mend(Path(run))


def recording_info(run: PathLike) -> "RecordingInfo":
    """Describe a recording from its index and manifest, without reading the frames (`rig info`)."""
    from rig.recording.open import info

    return info(Path(run))


def cut(run: PathLike, out: PathLike, request: CutRequest | None = None, **changes: Any) -> dict[str, Any]:
    """Write a part of a recording to the folder `out` and return the manifest of the part (`rig cut`).

    request, changes: the part, as a `CutRequest` or by the names of its fields: `cut("run", "part", maps="0:2")`.
    """
    from rig.recording.cut import cut as cut_out

    asked = replace(request or CutRequest(), **changes)
    return cut_out(Path(run), Path(out), maps=asked.maps, frames=asked.frames, time=asked.time, run=asked.start)


def compress(run: PathLike) -> "Compression":
    """Compress a recording with zstd; it is read as any other (`rig compress`). Needs the extra `compress`."""
    from rig.recording.compress import compress as pack

    return pack(Path(run))


def import_frames(
    kind: str,
    files: Sequence[PathLike],
    out: PathLike,
    request: ImportRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> "ImportResult":
    """Make a recording from the frames of another program (`rig import`).

    kind: pi-imaging, swissspad2 or photoncube.
    files: in order; a folder stands for the files in it.
    request, changes: how they are read, as an `ImportRequest` or by the names of its fields.
    progress: called with frames done and frames to do.
    Raises UsageError, one line per problem.
    """
    from rig.exchange.importing import import_frames as take

    return take(kind, files, out, replace(request or ImportRequest(), **changes), progress)


def export_run(
    run: PathLike,
    kind: str,
    request: ExportRequest | None = None,
    *,
    out: OutFolder = None,
    progress: Progress | None = None,
    **changes: Any,
) -> "ExportResult":
    """Write a run for other programs (`rig export`): npy, hdf5, ply, png or mp4.

    request, changes: what pictures and films show, as an `ExportRequest` or by the names of its fields.
    out: where to; None is RUN-KIND beside the run.
    progress: called with frames done and frames to do.
    Raises UsageError where the run has nothing of that kind.
    """
    from rig.exchange.exporting import export_run as write

    return write(run, kind, out, replace(request or ExportRequest(), **changes), progress)
