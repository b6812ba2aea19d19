"""The calls for recordings: check, mend, describe, cut and compress them, and exchange them with other programs."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.units import parse_exact
from rig.config.overrides import PathLike
from rig.errors import UsageError
from rig.progress import Progress
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


def cut(
    run: PathLike,
    out: PathLike,
    *,
    maps: str | None = None,
    frames: str | None = None,
    time: str | None = None,
    start: int = 0,
) -> dict[str, Any]:
    """Write a part of a recording to the folder `out` and return the manifest of the part (`rig cut`).

    Give exactly one of `maps`, `frames` and `time` (seconds from the first frame), each as 'A:B', from A to before B.
    start: number of the SPAD start that frames and time are counted in, from 0.
    """
    from rig.recording.cut import cut as cut_out

    return cut_out(Path(run), Path(out), maps=maps, frames=frames, time=time, run=start)


def compress(run: PathLike) -> "Compression":
    """Compress a recording with zstd; it is read as any other (`rig compress`). Needs the extra `compress`."""
    from rig.recording.compress import compress as pack

    return pack(Path(run))


def import_frames(
    kind: str,
    files: Sequence[PathLike],
    out: PathLike,
    *,
    form: str | None = None,
    frame_rate: str | Fraction | None = None,
    turn_deg: int | None = None,
    rows: int | None = None,
    progress: Progress | None = None,
) -> "ImportResult":
    """Make a recording from the frames of another program (`rig import`).

    kind: pi-imaging, swissspad2 or photoncube.
    files: in order; a folder stands for the files in it.
    form: packed or sparse, half or full, where the kind has several.
    frame_rate: '97.7 kHz', or hertz as an exact fraction; None where it is not known.
    turn_deg: turn of the picture, counter-clockwise.
    rows: rows of a SPAD512S, 512 or 1024.
    progress: called with frames done and frames to do.
    Raises UsageError, one line per problem.
    """
    from rig.exchange.importing import ImportOptions
    from rig.exchange.importing import import_frames as take

    try:
        rate = parse_exact(frame_rate, "frequency") if isinstance(frame_rate, str) else frame_rate
    except ValueError as error:
        raise UsageError(f"frame rate {error}") from None
    return take(kind, files, out, ImportOptions(form, rate, turn_deg, rows), progress)


def export_run(
    run: PathLike,
    kind: str,
    *,
    out: OutFolder = None,
    view: str | None = None,
    frames_per_picture: int | None = None,
    pictures_per_s: float | None = None,
    progress: Progress | None = None,
) -> "ExportResult":
    """Write a run for other programs (`rig export`): npy, hdf5, ply, png or mp4.

    out: where to; None is RUN-KIND beside the run.
    view: what png and mp4 show: depth, intensity or frames; None is the first of these that the run has.
    frames_per_picture: number of frames summed in a picture of frames; None is 100.
    pictures_per_s: rate of a film; None is 25.
    progress: called with frames done and frames to do.
    Raises UsageError where the run has nothing of that kind.
    """
    from rig.exchange.exporting import ExportOptions
    from rig.exchange.exporting import export_run as write

    return write(run, kind, out, ExportOptions(view, frames_per_picture, pictures_per_s), progress)
