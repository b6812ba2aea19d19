"""Which frames of a recording belong to which map: as its manifest says and, of a run that ended early, its markers."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from drivers.frames import FrameBlock, Mark
from drivers.recorded import RecordedRun, RunRecording
from rig.recording.manifest import ended_before_last_map, is_cut_short


@dataclass(frozen=True, slots=True)
class MapSpan:
    """A map's frames: of one run, from the one with its scan marker to before the one with the next."""

    run: int
    first_frame: int
    end_frame: int


def map_spans(recording: RunRecording, manifest: dict[str, Any] | None) -> list[MapSpan]:
    """The whole maps of a recording, in order."""
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
    """As the manifest says: frames are counted anew with each run."""
    run, end = 0, 0
    for sweep in sweeps:
        first = int(sweep["first_frame"])
        if first < end:
            run += 1
        end = int(sweep["end_frame"])
        if run < len(recording.runs):
            yield MapSpan(run, first, end)


def _marked(recording: RunRecording) -> Iterator[MapSpan]:
    """As the markers say; a map whose begin or end was lost begins and ends with the frames that are left."""
    for run in recording.runs:
        begins = [frame for _, frame in _sweep_begins(recording, run)]
        yield from (MapSpan(run.number, a, b) for a, b in pairwise(begins))


def _sweep_begins(recording: RunRecording, run: RecordedRun) -> Iterator[tuple[int, int]]:
    """(scan markers so far, number of the first frame with them), for each scan marker but those before the run."""
    entries = run.entries
    changes = np.flatnonzero(np.diff(entries["sweep"].astype(np.int64), prepend=-1) != 0)
    look_into = sorted({0, len(entries) - 1, *changes.tolist(), *(changes[1:] - 1).tolist()})
    seen = 0
    for i in look_into:
        block = recording.read(run, entries[i])
        if block is None or block.n_frames == 0:
            continue
        counts = _markers_seen(block)
        before = counts[0] if i == 0 and not _marked_first(block) else seen
        for at in np.flatnonzero(np.diff(counts, prepend=before) > 0):
            yield int(counts[at]), block.header.first_frame + int(at)
        seen = int(counts[-1])


def _markers_seen(block: FrameBlock) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Scan markers of the run up to each frame: a record's low 16 bits, continued from the header's 32."""
    sweep = block.header.sweep
    return sweep + ((block.records["sweep"].astype(np.int64) - sweep) & 0xFFFF)


def _marked_first(block: FrameBlock) -> bool:
    """Whether the first frame has a scan marker of its own."""
    return bool(int(block.records["marks"][0]) & Mark.SCAN)
