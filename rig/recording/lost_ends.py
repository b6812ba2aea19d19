"""Frames that a recording had before its first and behind its last sound blocks, as index, manifest and part tell.

A gap between two blocks shows in their numbers; one at an end only in what else is known of the run.
"""

from collections.abc import Sequence
from typing import Any

from drivers.recorded.contents import MOST_FRAMES, Contents
from drivers.recorded.order import Entries, in_order
from drivers.spb1 import BlockLayout
from rig.recording.checking import Continuity, Gap, SoundBlock, in_step
from rig.recording.manifest import device_counters, ended_early

Run = Sequence[SoundBlock]


def lost_ends(
    contents: Contents, runs: Sequence[Run], joined: Continuity, manifest: dict[str, Any] | None
) -> list[Gap]:
    """What is gone at either end of each run; starts of which nothing is left come behind the others.

    The index tells, then, where blocks are gone that it does not tell of, the range of frames of a part and the frames
    that the device delivered.
    """
    cut = (manifest or {}).get("cut")
    ranges = _told_ranges(contents, runs)
    if cut is not None and _blocks_are_gone(manifest or {}, runs):
        for run_id, first, end in cut["frames"]:
            began, ended = ranges.get(run_id, (first, end))
            ranges[run_id] = min(began, first), max(ended, end)
    gaps: list[Gap] = []
    for number, run in enumerate(runs):
        first, end = ranges.pop(run[0].run_id, (run[0].first_frame, run[-1].end_frame))
        if cut is not None and first < run[0].first_frame:  # of a whole run the first frame is number 0
            gaps.append((number, first, run[0].first_frame - 1))
        if end > run[-1].end_frame:
            gaps.append((number, run[-1].end_frame, end - 1))
    for number, (first, end) in enumerate(ranges.values(), len(runs)):
        gaps.append((number, first if cut is not None else 0, end - 1))
    return gaps + _delivered_behind(runs, [*joined.missing, *gaps], manifest)


def _told_ranges(contents: Contents, runs: Sequence[Run]) -> dict[int, tuple[int, int]]:
    """First and end frame of each run as the index tells; none where most of its records are of something else."""
    sound = {block.entry for run in runs for block in run}
    if len(contents.told) == 0 or 2 * sum(entry.tobytes() in sound for entry in contents.told) < len(sound):
        return {}
    of_run = {run[0].run_id: run for run in runs}
    ranges: dict[int, tuple[int, int]] = {}
    for entry in in_order(_believed(contents.told), contents.told, [], folder=True)[0]:
        run_id, first = int(entry["run_id"]), int(entry["first_frame"])
        end = first + int(entry["n_frames"])
        if run_id in of_run and not _reaches_beyond(entry, of_run[run_id]):
            continue
        began, ended = ranges.get(run_id, (first, end))
        ranges[run_id] = min(began, first), max(ended, end)
    return ranges


def _believed(told: Entries) -> Entries:
    return told[(told["first_frame"] < 1 << 62) & (told["t0_ticks"] < 1 << 62)]


def _reaches_beyond(entry: Any, run: Run) -> bool:
    """Whether the index tells here of frames beyond the ends of a run, of the right size and at the right time."""
    n_frames, first = int(entry["n_frames"]), int(entry["first_frame"])
    near = run[-1] if first >= run[-1].end_frame else run[0]
    if near is run[0] and first + n_frames > near.first_frame:
        return False
    header = near.header
    if n_frames > MOST_FRAMES or int(entry["length"]) != BlockLayout(n_frames, header.width, header.height).block_bytes:
        return False
    return in_step(first - near.first_frame, int(entry["t0_ticks"]) - header.t0_ticks, header)


def _blocks_are_gone(manifest: dict[str, Any], runs: Sequence[Run]) -> bool:
    stated = (manifest.get("recording") or {}).get("blocks")
    return isinstance(stated, int) and stated > sum(map(len, runs))


def _delivered_behind(runs: Sequence[Run], missing: Sequence[Gap], manifest: dict[str, Any] | None) -> list[Gap]:
    """Frames that the device delivered and nobody else tells of: behind the end of the last run."""
    if manifest is None or not runs or ended_early(manifest) is not None:
        return []
    delivered = device_counters(manifest)[0].get("delivered", 0)
    there = sum(block.n_frames for run in runs for block in run)
    left = delivered - there - sum(last + 1 - first for _, first, last in missing)
    number = len(runs) - 1
    end = max([runs[-1][-1].end_frame, *(last + 1 for of, _, last in missing if of == number)])
    return [(number, end, end + left - 1)] if left > 0 else []
