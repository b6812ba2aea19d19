"""Where the starts of a recording begin and end: with which sound blocks, and what is gone there."""

from drivers.frames import FrameBlock
from drivers.recorded import RecordedRun, RunRecording
from rig.recording.manifest import known_missing, read_manifest

EndGap = tuple[int, int, int]
"""Number of the start, first and last frame that is gone."""


def end_block(recording: RunRecording, run: RecordedRun, *, last: bool) -> FrameBlock | None:
    """The first or the last sound block of a start with a frame in it; None where there is none."""
    entries = run.entries[::-1] if last else run.entries
    return next((b for entry in entries if (b := recording.read(run, entry)) is not None and b.n_frames), None)


def readable_range(recording: RunRecording, run: RecordedRun) -> tuple[int, int]:
    """First frame of a start and one behind its last, of its sound blocks; (first, first) where none is."""
    first, last = (end_block(recording, run, last=end) for end in (False, True))
    if first is None or last is None:
        return run.first_frame, run.first_frame
    return first.header.first_frame, last.header.first_frame + last.n_frames


def end_gaps(recording: RunRecording) -> list[EndGap]:
    """What a repair found missing, and the frames of blocks at the ends of starts that are damaged."""
    known = known_missing(read_manifest(recording.path)) if recording.path.is_dir() else None
    gaps = list(dict.fromkeys(known or ()))
    for run in recording.runs:
        first, end = readable_range(recording, run)
        gaps += [(run.number, run.first_frame, first - 1)] if first > run.first_frame else []
        gaps += [(run.number, end, run.end_frame - 1)] if end < run.end_frame else []
    return sorted(gaps)
