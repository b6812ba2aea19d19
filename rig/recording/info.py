"""What a recording holds, as its index and manifest tell; `verify` is what reads all of it."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivers.recorded import RecordedRun
from drivers.recorded.segments import PACKED_SUFFIX, segment_files
from rig.recording.manifest import known_missing
from rig.recording.maps import MapSpan, map_spans
from rig.recording.opening import manifest_or_none, open_recording


@dataclass(frozen=True, slots=True)
class RunInfo:
    """One start of the SPAD. Frames first_frame to end_frame - 1; gaps: how many pieces are missing between them and,
    as a repair found, at their ends; lost: frames of those.
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


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """A recording. bytes: on the disk. verdict: the run's; problems: seen without reading the frames."""

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

    def as_json(self) -> dict[str, Any]:
        """As plain values."""
        return {**asdict(self), "folder": str(self.folder)}


def info(folder: Path) -> RecordingInfo:
    """Contents of a recording (`rig info`). UsageError where there is none."""
    recording = open_recording(folder)
    manifest, trouble = manifest_or_none(folder)
    spans = map_spans(recording, manifest)
    files = list(segment_files(folder).values())
    content = manifest or {}
    maps_of = {run.number: [i for i, span in enumerate(spans) if span.run == run.number] for run in recording.runs}
    known = known_missing(manifest) or []
    runs = [_run_info(run, maps_of[run.number], [g[1:] for g in known if g[0] == run.number]) for run in recording.runs]
    return RecordingInfo(
        folder=folder,
        verdict=content.get("verdict"),
        segments=len(files),
        compressed=sum(file.name.endswith(PACKED_SUFFIX) for file in files),
        bytes=sum(file.stat().st_size for file in files),
        blocks=sum(len(run.entries) for run in recording.runs),
        frames=recording.frames,
        maps=sum(_is_there(span, recording.runs[span.run], content) for span in spans),
        runs=runs,
        config=(content.get("config") or {}).get("name"),
        devices={slot: str(of.get("name")) for slot, of in (content.get("devices") or {}).items()},
        versions=content.get("versions") or {},
        problems=[*recording.problems, *([] if trouble is None else [trouble])],
    )


def _is_there(span: MapSpan, run: RecordedRun, manifest: dict[str, Any]) -> bool:
    """Whether a map can be made of what a repair left: of a part, which has none before it, the whole ones only."""
    if "repaired" not in manifest:
        return True
    begin = span.first_frame if "cut" in manifest else span.end_frame - 1
    return begin >= run.first_frame and span.end_frame < run.end_frame


def _run_info(run: RecordedRun, maps: list[int], known: list[tuple[int, int]]) -> RunInfo:
    header = run.header
    ends = {gap for gap in known if gap[1] < run.first_frame or gap[0] >= run.end_frame}
    gaps = [*run.gaps(), *ends]
    period = header.frame_period_ticks
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
        duration_s=_duration_s(run),
        first_map=maps[0] if maps else None,
        end_map=maps[-1] + 1 if maps else None,
    )


def _duration_s(run: RecordedRun) -> float:
    """From the first frame to the end of the last one, to the precision of its last block where that has no period."""
    entries, header = run.entries, run.header
    last = int(entries["n_frames"][-1]) * header.frame_period_ticks
    return float((int(entries["t0_ticks"][-1]) - int(entries["t0_ticks"][0]) + last) / header.tick_hz)
