"""Recordings with random damage: `rig verify` finds it or it is harmless, and no frame is read that was not recorded.

    python -m tests.campaigns.recording.corruptions --sequences 100000 --seed 1

A small recording of two starts, plain or compressed, with or without frames that the device lost, gets one to three
wounds: bytes flipped, cut off, doubled, swapped or zeroed, in a segment, the index or the manifest, or whole files lost
or swapped. Some of the plain ones get false numbers with the right checksums besides, in headers, trailers and index.
It ends wrong where

- `verify` calls it what it was before, and a frame or a word of the manifest is not as it was;
- a frame is read that is not one of those recorded, or not in order without a problem being told;
- anything is raised but an error of ours on one line, or the sequence takes longer than `DEADLINE_S`;
- after `repair` (one of five sequences) damage is left or a sound block is gone;
- after `repair` of false numbers `verify` says anything but whole, or whole with gaps, or a second repair does more.
"""

import struct
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError
from drivers.recorded import INDEX_FILE, RunRecording
from drivers.recorded.contents import HEADER_BYTES as INDEX_HEADER_BYTES
from drivers.recorded.contents import INDEX_RECORD, PAGE_BYTES
from drivers.spb1.layout import HEADER, TRAILER
from rig.errors import DamagedRecordingError, RigError
from rig.recording.compress import compress
from rig.recording.repair import repair
from rig.recording.verify import Integrity, verify
from rig.run_folder.manifest import MANIFEST, read_manifest
from tests.campaigns.outcomes import Ending, ending, options, run
from tests.unit.rig.recording.forging import (
    HEADER_FIELDS,
    TRAILER_FIELDS,
    forge_header,
    forge_record,
    forge_trailer,
    most_of,
)
from tests.unit.rig.recording.recorded import record, run_blocks

DEADLINE_S = 10.0
FORGED = 3
"""One of so many sequences gets false numbers with the right checksums."""
REPAIRED = 5
"""One of so many sequences is repaired afterwards."""
ODDS = (0.5, 0.2, 0.2, 0.1)
"""Of a plain recording, one with frames lost, a compressed one, and one that is both."""

Frames = dict[tuple[int, int], bytes]
"""Record, time and pixels of each frame, by run and number, in order."""


class Pristine:
    """A recording without damage and what is in it."""

    def __init__(self, folder: Path, *, lost: bool, packed: bool) -> None:
        blocks = run_blocks(maps=1, run_id=1), run_blocks(lost=range(40, 45) if lost else (), maps=1, run_id=2, seed=1)
        self.folder = record(folder, blocks, config={"depth_range": ["1 m", "8 m"]}, sweeps_of=[1, 1])
        if packed:
            compress(folder)
        self.files = {file.name: file.read_bytes() for file in sorted(folder.iterdir())}
        self.frames = frames_of(RunRecording(folder))
        self.manifest = read_manifest(folder)
        self.verdict = verify(folder).verdict


def frames_of(recording: RunRecording) -> Frames:
    """All that can be read."""
    frames: Frames = {}
    for run_ in recording.runs:
        for block in recording.blocks(run_):
            ticks, records = block.start_ticks, block.records.copy()
            records["ticks"] = 0
            for i, number in enumerate(block.frame_numbers.tolist()):
                key = block.header.run_id, number
                assert key not in frames, f"frame {number} of run {block.header.run_id} comes twice"
                frames[key] = ticks[i].tobytes() + records[i].tobytes() + block.bits[i].tobytes()
    return frames


def wound(files: dict[str, bytes], rng: np.random.Generator) -> str:
    """Damage one file, or two, trying until something is changed by it; what was done."""
    segments = sorted(name for name in files if name.startswith("frames-"))
    target = str(rng.choice([*segments, *segments, INDEX_FILE, MANIFEST, "files"]))
    if target == "files":
        one, other = rng.choice(sorted(files), 2, replace=False).tolist()
        if rng.integers(2):
            del files[one]
            return "file lost"
        files[one], files[other] = files[other], files[one]
        return "files swapped"
    before = files.get(target)
    if not before:
        return wound(files, rng)
    kind, data = str(rng.choice(["flipped", "cut off", "doubled", "swapped", "zeroed"])), bytearray(before)
    piece, at = _piece(data, rng), _piece(data, rng).start
    other = slice(at, at + piece.stop - piece.start)
    if kind == "flipped":
        for _ in range(int(rng.integers(1, 9))):
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    elif kind == "cut off":
        del data[at:]
    elif kind == "doubled":
        data[at : other.stop if rng.integers(2) else at] = data[piece]
    elif kind == "zeroed":
        data[piece] = bytes(piece.stop - piece.start)
    elif other.stop <= len(data) and (other.stop <= piece.start or piece.stop <= other.start):
        data[piece], data[other] = data[other], data[piece]
    files[target] = bytes(data)
    return kind if files[target] != before else wound(files, rng)


def _piece(data: bytearray, rng: np.random.Generator) -> slice:
    """Any bytes, or such that begin and end where blocks or index records do."""
    step = int(rng.choice([1, 64, 1024, 4096]))
    begin = int(rng.integers(len(data))) // step * step
    length = int(rng.choice([1, 4, 64, 1000, 4096, 8192, 20_000]))
    return slice(begin, min(len(data), begin + -(-length // step) * step))


def judge(folder: Path, pristine: Pristine) -> str:
    """'found' or 'harmless'. AssertionError where it is neither."""
    told, frames, manifest = _read(folder)
    _require_true(frames, pristine.frames)
    whole = frames == pristine.frames
    in_order = _in_order(frames, pristine)
    assert told or in_order, "frames are astray, and nobody says so"
    try:
        found = verify(folder)
    except RigError as error:
        _require_one_line(error)
        return "found"
    if found.problems or found.verdict is not pristine.verdict:
        return "found"
    assert whole, f"verify finds nothing, and {len(pristine.frames) - len(frames)} frames are missing"
    assert in_order, "verify finds nothing, and the frames are not in order"
    assert manifest == pristine.manifest, "verify finds nothing, and the manifest is another"
    return "harmless"


def _read(folder: Path) -> tuple[bool, Frames, Any]:
    """Whether a problem was told, and what is read all the same."""
    manifest = None
    try:
        manifest = read_manifest(folder)
    except DamagedRecordingError as error:
        _require_one_line(error)
    try:
        recording = RunRecording(folder)
        frames = frames_of(recording)
    except DeviceError as error:
        _require_one_line(error)
        return True, {}, manifest
    return bool(recording.problems), frames, manifest


def _in_order(frames: Frames, pristine: Pristine) -> bool:
    return list(frames) == [key for key in pristine.frames if key in frames]


def _require_true(frames: Frames, true: Frames) -> None:
    wrong = [key for key, content in frames.items() if true.get(key) != content]
    assert not wrong, f"frame {wrong[0][1]} of run {wrong[0][0]} is not as it was recorded, and {len(wrong) - 1} more"
    assert all(a < b for a, b in zip(frames, list(frames)[1:], strict=False) if a[0] == b[0]), "frames are out of order"


def _require_one_line(error: Exception) -> None:
    assert "\n" not in str(error), f"an error of several lines: {error}"


def mend(folder: Path, pristine: Pristine) -> None:
    """Repair. AssertionError where damage is left, a frame is wrong or a sound block is gone."""
    before = _read(folder)[1]
    try:
        after = repair(folder).after
    except RigError as error:
        _require_one_line(error)
        return
    assert after.verdict is not Integrity.DAMAGED or after.frames == 0, f"left: {after.problems}"
    frames = _read(folder)[1]
    _require_true(frames, pristine.frames)
    assert frames.keys() >= before.keys(), f"{len(before.keys() - frames.keys())} frames were there before repair"
    assert _in_order(frames, pristine) or not _in_order(before, pristine), "repair changed the order of the starts"
    again = repair(folder)
    assert again.done == [] or after.frames == 0, f"repaired twice: {again.done}"


def forge(files: dict[str, bytes], rng: np.random.Generator) -> str:
    """Give one block or one record of the index a false number with the right checksum; what was done."""
    data = bytearray(files.get(INDEX_FILE, b""))
    records = (len(data) - INDEX_HEADER_BYTES) // INDEX_RECORD.itemsize
    if rng.integers(4) == 0 and records > 0:
        name = str(rng.choice([name for name in INDEX_RECORD.names or () if name != "crc"]))
        most = 2 ** (8 * INDEX_RECORD[name].itemsize) - 1
        forge_record(data, int(rng.integers(records)), name, _number(rng, most))
        files[INDEX_FILE] = bytes(data)
        return "index forged"
    segments = sorted(name for name in files if name.endswith(".spb") and len(files[name]) >= PAGE_BYTES)
    if not segments:
        return "nothing forged"
    target = str(rng.choice(segments))
    data = bytearray(files[target])
    at = int(rng.integers(len(data) // PAGE_BYTES)) * PAGE_BYTES
    name = str(rng.choice(HEADER_FIELDS[1:-1]))
    with suppress(struct.error):  # what is there is no block any more
        forge_header(data, at, **{name: _number(rng, most_of(HEADER, HEADER_FIELDS, name))})
        if rng.integers(3) == 0:
            fields = dict(zip(HEADER_FIELDS, HEADER.unpack_from(data, at), strict=True))
            name = str(rng.choice(TRAILER_FIELDS[1:-1]))
            end = at + fields["header_len"] + fields["payload_len"]
            forge_trailer(data, end, **{name: _number(rng, most_of(TRAILER, TRAILER_FIELDS, name))})
    files[target] = bytes(data)
    return "block forged"


def _number(rng: np.random.Generator, most: int) -> int:
    """Small, extreme or anything."""
    kind = int(rng.integers(3))
    if kind == 0:
        return min(most, int(rng.integers(400)))
    return most >> int(rng.integers(3)) if kind == 1 else int(rng.random() * most)


def salvage(folder: Path) -> str:
    """Repair whatever there is. AssertionError where `verify` is not content with it, or a second repair does more."""
    try:
        after = repair(folder).after
    except RigError as error:
        _require_one_line(error)
        return "refused"
    assert after.verdict in (Integrity.INTACT, Integrity.GAPS), f"{after.verdict.value}: {after.problems}"
    assert after.lost >= 0, f"{after.lost} frames lost"
    assert verify(folder) == after, "verify says something else the second time"
    assert repair(folder).done == [], "repaired twice"
    assert RunRecording(folder).problems == [], "the reader sees what verify does not"
    return after.verdict.value


def make_sequence(root: Path) -> Callable[[int], Ending]:
    """A sequence of `tests.campaigns.outcomes`, working below `root`."""
    made = [Pristine(root / f"pristine-{i}", lost=bool(i & 1), packed=bool(i & 2)) for i in range(len(ODDS))]

    def sequence(seed: int) -> Ending:
        rng = np.random.default_rng(seed)
        pristine = made[int(rng.choice(len(made), p=ODDS))]
        files = dict(pristine.files)
        wounds = int(rng.choice([1, 2, 3], p=[0.8, 0.15, 0.05]))
        forged = seed % FORGED == 0 and not any(name.endswith(".zst") for name in files)
        kinds = {forge(files, rng) for _ in range(wounds)} if forged else {wound(files, rng)}
        kinds |= {wound(files, rng) for _ in range(wounds - 1)}

        def act(folder: Path) -> str:
            if forged:
                return f"forged: {salvage(folder)}"
            outcome = judge(folder, pristine)
            if seed % REPAIRED == 0:
                mend(folder, pristine)
            return f"{outcome} ({', '.join(kinds) if len(kinds) == 1 else 'several'})"

        return ending_with(files, root, act, DEADLINE_S)

    return sequence


def ending_with(files: dict[str, bytes], root: Path, act: Callable[[Path], str], deadline_s: float) -> Ending:
    """The ending of what is done with these files, in a folder below root that is gone afterwards."""
    with tempfile.TemporaryDirectory(dir=root) as name:
        folder = Path(name)
        for file, data in files.items():
            (folder / file).write_bytes(data)
        return ending(lambda: act(folder), time.monotonic, deadline_s)


def sequence_here() -> Callable[[int], Ending]:
    """The sequence of one process."""
    return make_sequence(Path(tempfile.mkdtemp()))


if __name__ == "__main__":
    raise SystemExit(run("tests.campaigns.recording.corruptions:sequence_here", options(__doc__).parse_args()))
