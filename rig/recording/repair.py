"""Makes a damaged or unfinished recording whole: sound blocks, with an index and a manifest that agree with them.

No frame is changed, and no byte but zeros is thrown away. Bytes that are not part of a sound block go to
`frames-000000.torn`, at the place they had in the segment, a damaged compressed segment to `frames-000000.torn.zst` and
a damaged manifest to `manifest.damaged.json`. What a later repair keeps gets a number: `frames-000000-1.torn`, ...
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from drivers.errors import CorruptBlock
from drivers.recorded.contents import INDEX_FILE, INDEX_RECORD, index_header, round_up_to_page, segment_name
from drivers.recorded.segments import PACKED_SUFFIX, PlainSegment, SegmentReader, segment_files
from rig.config.overrides import PathLike
from rig.errors import RecordingError, UsageError
from rig.recording.check import FRAMES_SEAL, sealed
from rig.recording.verify import Examination, Verification, examine, verify
from rig.recording.writer import RESERVE_FILE
from rig.run_folder.disk import is_held, new_file, replace_file, sync_folder
from rig.run_folder.manifest import MANIFEST, UNFINISHED, RunVerdict, device_counters, ended_early, sealed_text

_PIECE_BYTES: Final = 1 << 24
Range = tuple[int, int]
"""Bytes of a segment, from the first to before the second number."""


@dataclass(frozen=True, slots=True)
class Repair:
    """Result of a repair: a line for each thing done, and the result of a `verify` afterwards."""

    done: list[str]
    after: Verification


def repair(run: PathLike) -> Repair:
    """Make a damaged or unfinished recording whole (`rig repair`). No frame is changed or thrown away.

    Raises UsageError if there is no recording, its run still goes on or a segment is a link, RecordingError if it
    cannot be written.
    """
    folder = Path(run)
    if is_held(folder / INDEX_FILE):
        raise UsageError(f"{folder} is still being recorded; let the run end, or end it, and repair it then")
    if links := [file.name for file in segment_files(folder).values() if file.is_symlink()]:
        raise UsageError(f"{folder}: {links[0]} is a link, and a repair changes files in place; repair a copy")
    found = examine(folder)
    done: list[str] = []
    try:
        if _put_in_order(found, done):
            found = examine(folder)
        for segment in found.segments:
            mine = np.sort(found.entries[found.entries["segment"] == segment.number], order="offset")
            ends = (mine["offset"] + mine["length"]).tolist()
            mend = _clear if isinstance(segment, PlainSegment) else _unpack
            mend(segment, list(zip(mine["offset"].tolist(), ends, strict=True)), done)
        index = index_header() + np.sort(found.entries, order=["segment", "offset"]).tobytes()
        if not ((folder / INDEX_FILE).exists() and (folder / INDEX_FILE).read_bytes() == index):
            replace_file(folder / INDEX_FILE, index)
            done.append(f"{INDEX_FILE} written anew, of {len(found.entries)} blocks")
        _write_manifest(folder, found, done)
        (folder / RESERVE_FILE).unlink(missing_ok=True)
        sync_folder(folder)
    except OSError as error:
        raise RecordingError(
            f"cannot repair {folder}: {error.strerror or error}; free the space it needs or work on a copy"
        ) from error
    return Repair(done, verify(folder))


def _put_in_order(found: Examination, done: list[str]) -> bool:
    """Rename segments so that their order is that of the frames in them; return whether that was necessary."""
    paths = {segment.number: segment.path for segment in found.segments}
    numbers = list(dict.fromkeys(found.entries["segment"].tolist()))  # entries are in the order of their frames
    if numbers == sorted(numbers):
        return False
    moves = [(paths[old], new) for old, new in zip(numbers, sorted(numbers), strict=True) if old != new]
    for segment in found.segments:
        segment.release()
    # First to free numbers, so that all files are still segments if the repair is killed.
    aside = [_numbered(path, number) for number, (path, _) in enumerate(moves, max(paths) + 1)]
    for (path, new), moved in zip(moves, aside, strict=True):
        done.append(f"{path.name} is {_numbered(moved, new).name} now, by the frames in it")
    return True


def _numbered(segment: Path, number: int) -> Path:
    """Rename a segment so that it has this number; returns its new path."""
    name = segment_name(number)
    return segment.rename(segment.with_name(name + segment.name[len(name) :]))


def _clear(segment: SegmentReader, blocks: list[Range], done: list[str]) -> None:
    """Move everything but sound blocks (ranges `blocks`) from a plain segment to its torn file, leaving zeros, and end
    the segment after the last sound block. Without a sound block it is removed."""
    end = round_up_to_page(blocks[-1][1]) if blocks else 0
    others = [(a, used) for a, b in _between(blocks, segment.size) if (used := _used(segment, a, b)) > a]
    if others:
        torn = _free(segment.path.with_suffix(".torn"))
        with new_file(torn) as copy:
            _copy(segment, others, copy)
        done.append(f"{segment.path.name}: {len(others)} pieces that are no sound block are kept in {torn.name}")
    if not blocks:
        segment.release()
        segment.path.unlink()
        done.append(f"{segment.path.name} removed, it holds no sound block")
        return
    if not others and segment.size == end:
        return
    segment.release()
    with segment.path.open("rb+") as file:
        for begin, stop in others:
            file.seek(begin)
            file.write(bytes(min(stop, end) - begin if begin < end else 0))
        file.truncate(end)
        os.fsync(file.fileno())
    if segment.size != end:
        done.append(f"{segment.path.name} ends at byte {end}, not {segment.size}")


def _unpack(segment: SegmentReader, blocks: list[Range], done: list[str]) -> None:
    """Unless a compressed segment holds only sound blocks, write these to a plain one and keep the old file as torn."""
    end = round_up_to_page(blocks[-1][1]) if blocks else 0
    if blocks and segment.size == end and not any(_is_damaged(segment, a, b) for a, b in _between(blocks, end)):
        return
    plain = segment.path.with_name(segment.path.name.removesuffix(PACKED_SUFFIX))
    torn = _free(plain.with_suffix(f".torn{PACKED_SUFFIX}"))
    if blocks:
        scratch = plain.with_name(f"{plain.name}.part")
        with new_file(scratch) as file:
            file.truncate(end)
            _copy(segment, blocks, file)
        scratch.replace(plain)
    segment.release()
    segment.path.rename(torn)
    kept = f"its sound blocks are in {plain.name}, plain" if blocks else "it holds no sound block"
    done.append(f"{segment.path.name} is kept as {torn.name}; {kept}")


def _free(path: Path) -> Path:
    """The path, with a number in its name if the file or link exists: what an earlier repair kept stays as it is."""
    stem, _, rest = path.name.partition(".")
    numbered = (path.with_name(f"{stem}-{number}.{rest}") for number in count(1))
    return next(one for one in chain([path], numbered) if not os.path.lexists(one))


def _is_damaged(segment: SegmentReader, begin: int, stop: int) -> bool:
    """Whether a range holds anything but zeros or cannot be read."""
    try:
        return _used(segment, begin, stop) > begin
    except CorruptBlock:
        return True


def _between(blocks: list[Range], size: int) -> Iterator[Range]:
    """Ranges before, between and behind the blocks, in pieces of at most `_PIECE_BYTES`."""
    begin = 0
    for start, stop in [*blocks, (size, size)]:
        for piece in range(begin, start, _PIECE_BYTES):
            yield piece, min(start, piece + _PIECE_BYTES)
        begin = stop


def _used(segment: SegmentReader, begin: int, stop: int) -> int:
    """Offset after the last byte from `begin` to before `stop` that is not zero; `begin` if all are zero."""
    data = segment.at(begin, stop - begin)
    return stop - int((data[::-1] != 0).argmax()) if data.any() else begin


def _copy(segment: SegmentReader, pieces: list[Range], file: BinaryIO) -> None:
    """Copy pieces of a segment to the same places of another file, and sync it."""
    for begin, stop in pieces:
        file.seek(begin)
        file.write(segment.at(begin, stop - begin).data)
    file.flush()
    os.fsync(file.fileno())


def _write_manifest(folder: Path, found: Examination, done: list[str]) -> None:
    manifest = found.manifest
    if manifest is None:
        damaged = folder / MANIFEST
        if damaged.exists():
            kept = damaged.rename(_free(folder / "manifest.damaged.json"))
            done.append(f"the damaged {MANIFEST} is kept as {kept.name}")
        done.append(f"{MANIFEST} written anew, from the blocks alone: plan and calibration are as they lie here")
        manifest = {"verdict": UNFINISHED}
    elif manifest.get("verdict") == UNFINISHED:
        done.append(f"{MANIFEST}: the run was not over; its verdict is '{RunVerdict.ABORTED}' now")
    elif (why := ended_early(manifest)) is not None:
        done.append(f"{MANIFEST}: says that the recording ended before the run ({why}), and how many frames it has")
    elif not (done or found.problems):
        return
    recording = {**(manifest.get("recording") or {}), **_recording(found)}
    missing = [*(manifest.get("missing") or []), *map(list, found.joined.missing)]
    done += [
        f"start {number}: frames {first} to {last} are not there; they count as lost"
        for number, first, last in dict.fromkeys(found.joined.missing)
    ]
    done += [f"{line}; left out" for line in device_counters(manifest)[1]]
    verdict, blocks = manifest["verdict"], (manifest.get("recording") or {}).get("blocks")
    if missing or (verdict != UNFINISHED and blocks is not None and blocks > recording["blocks"]):
        verdict = RunVerdict.GAPS
    elif verdict == UNFINISHED:
        verdict = RunVerdict.ABORTED
    content: dict[str, Any] = {
        **{key: value for key, value in manifest.items() if key != "counters"},
        "verdict": verdict,
        "recording": recording,
        "missing": missing,
        "repaired": [*(manifest.get("repaired") or []), *done],
    }
    if "counters" in manifest:  # they are of what was recorded, not of what is left of it
        content["counters_when_recorded"] = manifest["counters"]
    replace_file(folder / MANIFEST, (sealed_text(json.dumps(content)) + "\n").encode())


def _recording(found: Examination) -> dict[str, Any]:
    """The part of `Recording.content` that a repair changes. A missing list of starts is made from the blocks."""
    segments = [np.frombuffer(b"".join(block.entry for block in run), INDEX_RECORD)["segment"] for run in found.runs]
    with_blocks = set(found.entries["segment"].tolist())
    content: dict[str, Any] = {
        "files": [s.path.name.removesuffix(PACKED_SUFFIX) for s in found.segments if s.number in with_blocks],
        "index": INDEX_FILE,
        "blocks": len(found.entries),
        "bytes": found.bytes,
        FRAMES_SEAL: sealed(block.payload_crc for run in found.runs for block in run),
    }
    starts = ((found.manifest or {}).get("recording") or {}).get("starts")
    if starts is None:  # count whole sweeps
        starts = [{"sweeps": max(0, run[-1].last_sweep - max(1, run[0].header.sweep))} for run in found.runs]
    if len(starts) == len(found.runs):
        content["starts"] = [{**start, "segment": int(of.min())} for start, of in zip(starts, segments, strict=True)]
    return content
