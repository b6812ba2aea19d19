"""Opens recordings for the commands that read one, and finds what they hold and which frames belong to which map."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceNotFound, ProtocolError
from drivers.frames import FrameBlock, Mark
from drivers.recorded import RecordedRun, RunRecording
from drivers.recorded.contents import INDEX_FILE
from drivers.recorded.segments import PACKED_SUFFIX, segment_files, zstandard_or_error
from rig.config.overrides import PathLike
from rig.count.bind import MAX_RESIDUAL_COLUMNS
from rig.errors import DamagedRecordingError, UsageError, absent
from rig.plan.scan_plan import MAX_CLOCK_ERROR
from rig.progress import tell_stage
from rig.run_folder.manifest import MANIFEST, RunGap, ended_before_last_map, is_cut_short, known_missing, read_manifest
from rig.run_folder.time_of_day import Anchor, read_anchors, utc_text

SEGMENTS: Final = "frames-*.spb"
"""Pattern of the names of files that hold a recording's frames."""


def open_recording(folder: Path) -> RunRecording:
    """Open a run's recording. Raises UsageError if there is none, DamagedRecordingError if no block can be read."""
    require_recording(folder)
    try:
        return RunRecording(folder)
    except DeviceNotFound as error:
        raise UsageError(str(error)) from None
    except ProtocolError as error:
        raise DamagedRecordingError(str(error)) from None


def require_recording(path: Path, wanted: str = "a run taken with `record`") -> None:
    """Raise UsageError if a path is no folder with a recording, or zstandard is missing for a compressed one.

    wanted: description of such a folder, for the message.
    """
    files = segment_files(path).values() if path.is_dir() else ()
    if not files:
        name_one = f"name the folder of {wanted}"
        if not path.exists():
            raise UsageError(absent(path, name_one, lambda one: one.is_dir() and bool(segment_files(one))))
        raise UsageError(f"{path} {_instead(path, name_one)}")
    if any(file.name.endswith(PACKED_SUFFIX) for file in files):
        try:
            zstandard_or_error()
        except ProtocolError as error:
            raise UsageError(f"{path}: {error}") from None


def _instead(path: Path, name_one: str) -> str:
    """Say what a path without a recording is, and what to do next."""
    if path.is_file():
        return "is a file; " + ("name the folder that it lies in" if path.match(f"{SEGMENTS}*") else name_one)
    inside = sorted(part for part in path.iterdir() if part.is_dir() and segment_files(part))
    if inside:
        more = "" if len(inside) == 1 else f" or another of {len(inside)} in it"
        return f"is a folder without a recording ({SEGMENTS}) of its own; name {inside[0]}{more}"
    if (path / INDEX_FILE).exists():
        return f"has an index of recorded frames ({INDEX_FILE}), but no {SEGMENTS}; bring them back from a copy"
    if (path / MANIFEST).exists() or (path / "stripe").is_dir():
        return (
            f"holds no recording ({SEGMENTS}): the frames of this run were not recorded; take it again with "
            "'rig scan --record'"
        )
    if (path.parent / MANIFEST).exists():
        return f"is a folder inside a run; name {path.parent}"
    for suffix, kind in ((".npy", "photoncube"), (".bin", "swissspad2 (or pi-imaging)")):
        if any(path.glob(f"*{suffix}")):
            return (
                f"is a folder without a recording: no {SEGMENTS}, but {suffix} files; if these are frames, "
                f"'rig import {kind} {path} --out DIR' makes a recording of them"
            )
    what = "a folder without a recording" if any(path.iterdir()) else "an empty folder"
    return f"is {what}: no {SEGMENTS}; {name_one}"


def manifest_or_none(folder: Path) -> tuple[dict[str, Any] | None, str | None]:
    """(manifest, None), or (None, the reason) if it is missing or damaged."""
    try:
        manifest = read_manifest(folder)
    except DamagedRecordingError as error:
        return None, str(error)
    return manifest, None if manifest is not None else "manifest.json is missing; 'rig repair' writes one"


@dataclass(frozen=True, slots=True)
class MapSpan:
    """Frames first_frame to end_frame - 1 of a map, from its scan marker to the next. run: number of the start."""

    run: int
    first_frame: int
    end_frame: int


def map_spans(recording: RunRecording, manifest: dict[str, Any] | None) -> list[MapSpan]:
    """The frames of the whole maps of a recording, in order."""
    manifest = manifest or {}
    sweeps = manifest.get("sweeps")
    if sweeps is None:
        return list(_marked(recording))
    spans = list(_stated(recording, sweeps))
    while spans and is_cut_short(manifest) and spans[-1].end_frame >= recording.runs[spans[-1].run].end_frame:
        del spans[-1]  # the run made a map of frames that are not in the recording
    if ended_before_last_map(manifest):
        made = (spans[-1].run, spans[-1].end_frame) if spans else (0, 0)
        spans += [span for span in _marked(recording) if (span.run, span.first_frame) >= made]
    return spans


def _stated(recording: RunRecording, sweeps: list[dict[str, Any]]) -> Iterator[MapSpan]:
    """Spans of the starts that are there, as the manifest states them. Frame numbers begin anew with each start."""
    run, end = 0, 0
    for sweep in sweeps:
        first = int(sweep["first_frame"])
        if first < end:
            run += 1
        end = int(sweep["end_frame"])
        if run < len(recording.runs):
            yield MapSpan(run, first, end)


def _marked(recording: RunRecording) -> Iterator[MapSpan]:
    """Spans between markers. If a map's first or last frames were lost, its span covers those that are left."""
    for run in recording.runs:
        yield from (MapSpan(run.number, a, b) for a, b in pairwise(_sweep_begins(recording, run)))


def _sweep_begins(recording: RunRecording, run: RecordedRun) -> Iterator[int]:
    """Numbers of a start's frames with a scan marker. For a lost one: the number of the first frame after it."""
    entries = run.entries
    changes = np.flatnonzero(np.diff(entries["sweep"].astype(np.int64), prepend=-1) != 0)
    look_into = sorted({0, len(entries) - 1, *changes.tolist(), *(changes[1:] - 1).tolist()})
    seen = 0
    for i in look_into:
        block = recording.read(run, entries[i])
        if block is None or block.n_frames == 0:
            continue
        counts = markers_seen(block)
        before = counts[0] if i == 0 and not begins_sweep(block) else seen
        yield from (block.header.first_frame + np.flatnonzero(np.diff(counts, prepend=before) > 0)).tolist()
        seen = int(counts[-1])


def markers_seen(block: FrameBlock) -> NDArray[np.int64]:
    """Number of scan markers of the start up to each frame, int64 (n,): the 16 bits of its record, extended by the
    header."""
    sweep = block.header.sweep
    return np.asarray(sweep + ((block.records["sweep"].astype(np.int64) - sweep) & 0xFFFF))


def begins_sweep(block: FrameBlock) -> bool:
    """Whether the first frame of a block has a scan marker. The block must not be empty."""
    return bool(int(block.records["marks"][0]) & Mark.SCAN)


@dataclass(frozen=True, slots=True)
class RunInfo:
    """One start of the SPAD, with frames first_frame to end_frame - 1 and maps first_map to end_map - 1 (None: none).

    frames: number recorded. gaps: number of stretches of frames missing between the recorded ones and, if a repair
    found some, at the ends. lost: number of frames in the gaps. width, height: pixels of a frame. frame_rate_hz: None
    if triggered from outside. duration_s: time from the first frame to the end of the last one or, without a rate, to
    the start of the last block. first_frame_utc: when the exposure of the first frame began, as text; None if the
    recording does not say. utc_uncertainty_s: how far that time may be off; None if it is not known, or if a simulated
    rig ran in its own time.
    """

    run_id: int
    first_frame: int
    end_frame: int
    frames: int
    gaps: int
    lost: int
    width: int
    height: int
    sensor_width: int
    sensor_height: int
    frame_rate_hz: float | None
    duration_s: float
    first_map: int | None
    end_map: int | None
    first_frame_utc: str | None = None
    utc_uncertainty_s: float | None = None


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Contents of a recording.

    verdict: the one in the run's manifest. segments, compressed: number of all segments and of the compressed ones.
    bytes: size of all segments on the disk. maps: number of whole maps. config: name of the config. devices: names of
    the devices by slot. versions: versions of the software. All three are those at the time of recording. Without a
    manifest, verdict and config are None, devices and versions empty. problems: one line each, as far as a look at a
    few blocks shows.
    """

    folder: Path
    verdict: str | None
    segments: int
    compressed: int
    bytes: int
    blocks: int
    frames: int
    maps: int
    runs: list[RunInfo]
    config: str | None
    devices: dict[str, str]
    versions: dict[str, str]
    problems: list[str]


def info(run: PathLike) -> RecordingInfo:
    """Describe a recording from its index, its manifest and a few of its blocks (`rig info`).

    Raises UsageError if there is no recording, DamagedRecordingError if no block can be read.
    """
    folder = Path(run)
    tell_stage("reading the index")
    recording = open_recording(folder)
    manifest, trouble = manifest_or_none(folder)
    spans = map_spans(recording, manifest)
    files = list(segment_files(folder).values())
    content = manifest or {}
    known, anchors = known_missing(manifest) or [], read_anchors(content)
    return RecordingInfo(
        folder=folder,
        verdict=content.get("verdict"),
        segments=len(files),
        compressed=sum(file.name.endswith(PACKED_SUFFIX) for file in files),
        bytes=sum(file.stat().st_size for file in files),
        blocks=sum(len(run.entries) for run in recording.runs),
        frames=recording.frames,
        maps=sum(_is_there(span, recording.runs[span.run], content) for span in spans),
        runs=[_run_info(run, spans, known, anchors.get(run.header.run_id)) for run in recording.runs],
        config=(content.get("config") or {}).get("name"),
        devices={slot: str(of.get("name")) for slot, of in (content.get("devices") or {}).items()},
        versions=content.get("versions") or {},
        problems=[*recording.problems, *([] if trouble is None else [trouble])],
    )


def _is_there(span: MapSpan, run: RecordedRun, manifest: dict[str, Any]) -> bool:
    """Whether a repair left a map's last frame and closing marker (of a part, its first too); True without a repair."""
    if "repaired" not in manifest:
        return True
    begin = span.first_frame if "cut" in manifest else span.end_frame - 1
    return begin >= run.first_frame and span.end_frame < run.end_frame


def _run_info(run: RecordedRun, spans: Sequence[MapSpan], known: Sequence[RunGap], anchor: Anchor | None) -> RunInfo:
    header, entries = run.header, run.entries
    maps = [i for i, span in enumerate(spans) if span.run == run.number]
    of_run = {(first, last) for number, first, last in known if number == run.number}
    gaps = [*run.gaps(), *(gap for gap in of_run if gap[1] < run.first_frame or gap[0] >= run.end_frame)]
    period = header.frame_period_ticks
    taken = None if anchor is None else anchor.of(run.first_frame)
    last_tick = int(entries["t0_ticks"][-1]) + int(entries["n_frames"][-1]) * period
    return RunInfo(
        run_id=header.run_id,
        first_frame=run.first_frame,
        end_frame=run.end_frame,
        frames=run.frames,
        gaps=len(gaps),
        lost=sum(last + 1 - first for first, last in gaps),
        width=header.width,
        height=header.height,
        sensor_width=header.sensor_width,
        sensor_height=header.sensor_height,
        frame_rate_hz=float(header.tick_hz / period) if period else None,
        duration_s=float((last_tick - int(entries["t0_ticks"][0])) / header.tick_hz),
        first_map=maps[0] if maps else None,
        end_map=maps[-1] + 1 if maps else None,
        first_frame_utc=None if taken is None else utc_text(taken.utc_ns),
        utc_uncertainty_s=None if taken is None else taken.uncertainty_s,
    )


def fitted_ratio(ratio: float, sweeps: Sequence[dict[str, Any]]) -> float:
    """Ratio of the scanner's clock to nominal after these sweeps of a manifest. ratio: before the first of them."""
    for i, sweep in enumerate(sweeps):
        if i and sweep["first_frame"] < sweeps[i - 1]["end_frame"]:
            ratio = 1.0  # another start of the SPAD
        residual, error = sweep.get("residual_columns"), float(sweep.get("clock_error") or 0.0)
        if residual is not None and residual <= MAX_RESIDUAL_COLUMNS and abs(error) <= MAX_CLOCK_ERROR:
            ratio = 1 + error
    return ratio
