"""Cuts a part out of a recording, as a recording of its own: by maps, by frames of a start, or by time.

Frames keep their run id and number, so that the part's maps are bound as in the whole recording. Maps are numbered from
0 again. The part includes everything needed to estimate them again: plan, calibration, learned states and, if known,
the truth.
"""

import math
import re
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from drivers.recorded import RecordedRun, RunRecording
from rig.config.overrides import PathLike
from rig.errors import DamagedRecordingError, RecordingError, UsageError
from rig.progress import tell_stage
from rig.recording.check import require_own_frames
from rig.recording.open import MapSpan, fitted_ratio, manifest_or_none, map_spans, open_recording
from rig.recording.writer import Recording
from rig.requests import CutRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.manifest import MANIFEST, UNFINISHED, RunVerdict, known_missing, manifest_crc32, require_playable

OF_MAPS: Final = ("learned", "truth")
"""Folders with files of single maps, which are copied to the part."""
_VERDICT_WITHOUT_GAPS: Final = {RunVerdict.GAPS: RunVerdict.COMPLETE, UNFINISHED: RunVerdict.ABORTED}
"""Verdict of a part without gaps, by the verdict of the whole, where it differs. No part is still being recorded."""


@dataclass(frozen=True, slots=True)
class Part:
    """Frames first_frame to end_frame - 1 of a start. The recording's maps first_map to end_map - 1 lie completely in
    them; 0 and 0 if none does."""

    run: RecordedRun
    first_frame: int
    end_frame: int
    first_map: int
    end_map: int


def cut(run: PathLike, out: PathLike, request: CutRequest | None = None, **changes: Any) -> dict[str, Any]:
    """Write a part of a recording to the folder `out` and return the manifest of the part (`rig cut`).

    request, changes: which part, as a `CutRequest` or by the names of its fields: `cut("run", "part", maps="0:2")`. A
      range `A:B` ends before B; A may be left out for the first, B for the end; a single number means one map or frame.
    Raises UsageError for a part that does not exist or an `out` that cannot be used, DamagedRecordingError if the
    recording is damaged, RecordingError if frames or other files of the part cannot be written.
    """
    folder, asked = Path(run), replace(request or CutRequest(), **changes)
    recording = open_recording(folder)
    manifest, trouble = manifest_or_none(folder)
    if manifest is None:
        raise DamagedRecordingError(f"{folder}: {trouble}")
    require_playable(folder, manifest)
    require_own_frames(recording)
    spans = map_spans(recording, manifest)
    parts = _parts(recording, spans, asked)
    with RunFolder(out) as target:
        lost: list[list[int]] = []
        with closing(Recording(target.place("."), expected_bytes=0)) as written:
            for part in parts:
                written.begin(part.end_map - part.first_map)
                for block in recording.blocks(part.run, part.first_frame, part.end_frame):
                    written.append(block)
                    tell_stage("writing", written.blocks, unit="blocks")
                lost += [list(gap) for gap in part.run.gaps() if gap[0] < part.end_frame and gap[1] >= part.first_frame]
        if written.blocks == 0 or recording.problems:
            raise DamagedRecordingError(
                f"{folder} is damaged: {'; '.join(recording.problems[:3]) or 'no frame is left there'}; 'rig repair' it"
            )
        content = _manifest(manifest, parts, written.content(), lost)
        try:
            _copy_inputs(folder, target.place("."), manifest, parts)
        except OSError as error:
            raise RecordingError(
                f"cannot copy {error.filename} to {out}: {error.strerror or error}; free the space it needs or name "
                "another `out`"
            ) from error
        target.write_json(MANIFEST, content)
        target.publish()
    return content


def _parts(recording: RunRecording, spans: Sequence[MapSpan], asked: CutRequest) -> list[Part]:
    ways = {"`maps`": asked.maps, "`frames`": asked.frames, "`time`": asked.time}
    given = [(name, text) for name, text in ways.items() if text is not None]
    if len(given) != 1:
        raise UsageError(f"say what to cut by exactly one of {', '.join(ways)}; {len(given)} were given")
    run = asked.start
    if not 0 <= run < len(recording.runs):
        raise UsageError(f"`start={run}` is not in {recording.path}; it has {len(recording.runs)}, counted from 0")
    of = recording.runs[run]
    name, text = given[0]
    if name == "`maps`":
        return _map_parts(recording, spans, *_range(name, text, 0, len(spans)))
    first, end = _range(name, text, of.first_frame, of.end_frame) if name == "`frames`" else _time_range(text, of)
    first, end = max(first, of.first_frame), min(end, of.end_frame)
    if first >= end:
        raise UsageError(
            f"{name} {text} holds no frame of start {run}, which has {of.first_frame} to {of.end_frame - 1}"
        )
    inside = [i for i, s in enumerate(spans) if s.run == run and s.first_frame >= first and s.end_frame < end]
    maps_in = (inside[0], inside[-1] + 1) if inside else (0, 0)
    return [Part(of, first, end, *maps_in)]


def _map_parts(recording: RunRecording, spans: Sequence[MapSpan], first: int, end: int) -> list[Part]:
    """For each start with some of the maps: its part, up to and with the frame whose marker ends the last of them."""
    if not any(run.entries["sweep"].any() for run in recording.runs):
        raise UsageError(
            f"{recording.path} has no markers to tell maps apart (sweeps are found by the light of a whole run, if at "
            "all); cut it with `frames` or `time`"
        )
    if not 0 <= first < end <= len(spans):
        raise UsageError(f"maps {first}:{end} are not all in {recording.path}; it has {len(spans)}, counted from 0")
    parts = []
    for run in recording.runs:
        mine = [i for i in range(first, end) if spans[i].run == run.number]
        if mine:
            last = spans[mine[-1]].end_frame + 1
            parts.append(Part(run, spans[mine[0]].first_frame, min(last, run.end_frame), mine[0], mine[-1] + 1))
    return parts


def _range(name: str, text: str, first: int, end: int) -> tuple[int, int]:
    match = re.fullmatch(r"(\d*)(:?)(\d*)", text.strip())
    if match is None or not (match[1] or match[2]):
        raise UsageError(f"{name} {text!r} is no range; write 3 or 2:5, which is 2, 3 and 4")
    if not match[2]:
        return int(match[1]), int(match[1]) + 1
    return int(match[1] or first), int(match[3] or end)


def _time_range(text: str, of: RecordedRun) -> tuple[int, int]:
    try:
        first_s, end_s = (float(part) if part.strip() else None for part in text.split(":"))
        if not all(math.isfinite(one) for one in (first_s, end_s) if one is not None):
            raise ValueError(text)
    except ValueError:
        raise UsageError(f"`time` {text!r} is no range; write seconds from the first frame, as 0.5:1.25") from None
    first = of.first_frame if first_s is None else of.frame_at(first_s)
    return first, of.end_frame if end_s is None else of.frame_at(end_s)


def _manifest(
    manifest: dict[str, Any], parts: Sequence[Part], recording: dict[str, object], lost: list[list[int]]
) -> dict[str, Any]:
    """The manifest of the part: that of the whole recording, with the part's frames, maps and verdict."""
    first_map, end_map = parts[0].first_map, parts[-1].end_map
    sweeps, verdict = manifest.get("sweeps"), manifest.get("verdict", UNFINISHED)
    content = {
        key: value
        for key, value in manifest.items()
        if key not in ("counters", "counters_when_recorded", "missing", "repaired", "gaps", "sweeps")
    }
    before = (manifest.get("cut") or {}).get("maps", [0])[0]
    content |= {
        "command": "cut",
        "verdict": RunVerdict.GAPS if lost else _VERDICT_WITHOUT_GAPS.get(verdict, verdict),
        "recording": recording,
        "gaps": lost,
        "cut": {
            "of_id": manifest_crc32(manifest),
            "maps": [before + first_map, before + end_map],
            "frames": [[part.run.header.run_id, part.first_frame, part.end_frame] for part in parts],
            "clock_ratios": [_clock_ratio(manifest, part, i == 0) for i, part in enumerate(parts)],
        },
    }
    if (known := known_missing(manifest)) is not None:
        missing = [
            [number, first, last]
            for number, part in enumerate(parts)
            for run, first, last in known
            if run == part.run.number and part.first_frame < first and last < part.end_frame - 1
        ]
        content |= {"repaired": manifest["repaired"], "missing": missing}
    if sweeps is not None:
        content["sweeps"] = sweeps[first_map:end_map]
        content["maps"] = end_map - first_map
    return content


def _clock_ratio(manifest: dict[str, Any], part: Part, is_first: bool) -> float:
    """Ratio of the scanner's clock to nominal for binding a part's first map: the last one fitted before it."""
    sweeps = manifest.get("sweeps") or []
    known = (manifest.get("cut") or {}).get("clock_ratios") or []
    ratio = float(known[part.run.number]) if part.run.number < len(known) else 1.0
    return fitted_ratio(ratio, sweeps[: part.first_map] if is_first else ())


def _copy_inputs(folder: Path, out: Path, manifest: dict[str, Any], parts: Sequence[Part]) -> None:
    """Copy the files beside the frames. Files of maps get the part's numbers, which begin with 0. Raises OSError."""
    for name in manifest.get("inputs") or {}:
        shutil.copyfile(folder / name, out / name)
    for kind in OF_MAPS:
        for number, i in enumerate(range(parts[0].first_map, parts[-1].end_map)):
            file = folder / kind / f"{i:06d}.npz"
            if file.exists():
                (out / kind).mkdir(exist_ok=True)
                shutil.copyfile(file, out / kind / f"{number:06d}.npz")
