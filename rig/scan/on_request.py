"""A recording that is switched on and off while a scan goes on, and that reaches back to before it was switched on.

Until it is switched on, the recorder only holds the newest blocks in the ring: those of `before_s` seconds and of one
sweep. Once on, it writes straight from the slots of the ring, from the sweep that was under way `before_s` ago. Once
off, it ends with the sweep under way. Each such part is a complete recording in the run's folder (`part-000` and so
on), as if `rig cut` had cut it from a recording of the whole scan. The run's manifest lists the frames that were not
recorded.

A separate thread prepares the folder of the next part and closes the last one, since both wait for the disk. To hold
blocks copies nothing and makes nobody wait: the ring has additional slots for them.
"""

import logging
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from drivers.frames import FrameBlock, Mark
from drivers.ring import BlockRing, RingReader
from drivers.units import parse_quantity
from rig.errors import RecordingError, UsageError
from rig.recording.open import fitted_ratio
from rig.recording.writer import WRITERS, Recording, next_block
from rig.run_folder.disk import replace_file
from rig.run_folder.manifest import MANIFEST, UNFINISHED, RunVerdict, file_crc32, sealed_text
from rig.run_folder.plain_json import json_text

_log = logging.getLogger(__name__)

OF_MAPS: Final = ("learned", "truth")
"""Folders with files of single maps that a part gets a copy of."""
MOST_SHARE_OF_MEMORY: Final = 0.5
"""Largest share of the computer's memory that held blocks may take."""


class RecordingSwitch:
    """Switches the recording of a running scan on and off. Pass it to `rig.api.scan` as `switch`. `on` and `off` may be
    called from any thread, before and during the scan; only the recorder calls `take`.

    before: a part begins with the sweep that was under way this long before `on` was called: seconds, or text such as
      '2 s'.

    Raises UsageError for text that is not a time, and for a time that is negative or not finite.
    """

    def __init__(self, before: str | float = 0.0) -> None:
        try:
            self.before_s = parse_quantity(before, "time") if isinstance(before, str) else float(before)
        except (TypeError, ValueError) as error:
            raise UsageError(f"`before` is {before!r}: {error}") from None
        if not 0 <= self.before_s < float("inf"):
            raise UsageError(f"`before` is {before!r}; it must be 0 s or more")
        self._wanted = False
        self._pending = False
        self.parts: list[RecordedPart] = []
        """The parts so far, of all scans of the call; the last one may still grow."""

    @property
    def wanted(self) -> bool:
        """Whether it is switched on."""
        return self._wanted

    @property
    def recording(self) -> bool:
        """Whether blocks are being written."""
        return bool(self.parts) and not self.parts[-1].ended

    def on(self) -> None:
        """Begin a part, with what came from `before` ago on. Does nothing if the switch is on already. A part is
        recorded even if `off` is called at once."""
        self._pending = self._pending or not self._wanted
        self._wanted = True

    @property
    def asked(self) -> bool:
        """Whether a part is to begin or, while one is recorded, to go on after the sweep under way."""
        return self._pending or self._wanted

    def take(self) -> None:
        """Note that the part that was asked for begins. Called by the recorder."""
        self._pending = False

    def off(self) -> None:
        """End the part with the sweep under way. Does nothing if it is off already."""
        self._wanted = False


@dataclass(slots=True)
class RecordedPart:
    """One part: frames first_frame to end_frame - 1 of one start of the SPAD, without those lost on the way.

    start: number of the start in the run, from 0. run_id: that in the headers of the part's blocks.
    first_sweep: number of the part's first whole sweep; the first sweep of the start has 0. sweeps: number of whole
    sweeps.
    lost: (first, last) of each range of frames lost between the part's blocks. ended: whether no block will be added.
    """

    folder: Path
    start: int
    run_id: int = 0
    first_frame: int = 0
    end_frame: int = 0
    first_sweep: int = 0
    sweeps: int = 0
    lost: list[tuple[int, int]] = field(default_factory=list)
    ended: bool = False

    def content(self) -> dict[str, Any]:
        """The part as plain values for the run's manifest."""
        return {
            "folder": self.folder.name,
            "start": self.start,
            "frames": [self.first_frame, self.end_frame],
            "whole_sweeps": self.sweeps,
        }


@dataclass(slots=True)
class _Start:
    """One start of the SPAD: number of its first map, and the frames that came, first to end - 1."""

    first_map: int
    first: int | None = None
    end: int = 0


@dataclass(slots=True)
class _Held:
    """A block in a slot of the ring. written: done once it counts; None if it is not recorded (yet)."""

    block: FrameBlock
    written: "Future[None] | None" = None


class PartsRecording:
    """The recording of one scan in parts; used in place of a `Recording`.

    folder: the run's. keep_blocks: number of newest blocks to hold while the switch is off; they take held_bytes.
    manifest: returns what is known of the run so far, for the manifest of a part.
    write_inputs: writes the files that belong beside the frames.
    Raises UsageError if held blocks would take more than half of the memory, or the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        switch: RecordingSwitch,
        keep_blocks: int,
        held_bytes: int,
        manifest: Callable[[], Mapping[str, Any]],
        write_inputs: Callable[[Path], None],
    ) -> None:
        _require_memory(held_bytes, switch.before_s)
        self.keep_blocks = keep_blocks
        self.parts: list[RecordedPart] = []
        """The parts of this scan, in order."""
        self._folder = folder
        self._switch = switch
        self._manifest = manifest
        self._write_inputs = write_inputs
        self._starts: list[_Start] = []
        self._recordings: list[Recording] = []
        self._inputs: dict[str, int] = {}
        self._part: RecordedPart | None = None
        self._since: int | None = None
        """Tick from which on a part was asked for."""
        self._planned = 0
        """Sweeps that the present start is to give."""
        self._failure: BaseException | None = None
        self._lock = threading.Lock()
        self._helper = ThreadPoolExecutor(1, "recording parts")
        try:
            self._next = self._helper.submit(self._prepare, 0)
            self._next.result()  # the first one, before anything moves
        except OSError as error:
            self._helper.shutdown()
            raise UsageError(f"cannot write {folder}: {error.strerror or error}; name another `out`") from error
        except BaseException:
            self._helper.shutdown()
            raise

    @property
    def blocks(self) -> int:
        """Number of blocks in all parts that are written and count (`WritesBlocks.blocks`)."""
        return sum(recording.blocks for recording in self._recordings)

    @property
    def bytes(self) -> int:
        """Bytes that the blocks counted by `blocks` take."""
        return sum(recording.bytes for recording in self._recordings)

    @property
    def busy_s(self) -> float:
        """Time for checksums and writing, summed over the writers."""
        return sum(recording.busy_s for recording in self._recordings)

    def holds(self, ring: BlockRing) -> int:
        """Number of blocks of the ring that `write_from` holds at a time; at least 1."""
        return max(1, min(self.keep_blocks + WRITERS, ring.slots - WRITERS))

    def begin(self, sweeps: int) -> None:
        """Begin a start of the SPAD that is to give `sweeps` sweeps. Its blocks come next."""
        before = self._starts[-1].first_map + self._planned if self._starts else 0
        self._starts.append(_Start(before))
        self._planned = sweeps

    def write_from(self, reader: RingReader) -> None:
        """Write those blocks of one start that the switch asks for; returns after the last block. Raises RecordingError
        if one cannot be written."""
        held: deque[_Held] = deque()
        try:
            while (block := next_block(reader)) is not None:
                self._note(block)
                held.append(_Held(block))
                self._step(held)
                while len(held) >= reader.holds:  # `next` gives the oldest slot back
                    self._finish(held.popleft())
            if self._part is None and held and self._switch.asked:
                self._next.exception()  # a wish of the last moment may wait for its folder: no frame comes any more
                self._begin_part(held)
            while held:
                self._finish(held.popleft())
        finally:
            self._since = None
            for each in held:
                if each.written is not None:
                    each.written.exception()  # slots go back only once nobody reads them
            self._end_part()

    def close(self) -> None:
        """Wait until everything is written and end the files. Raises RecordingError if that fails. A second call only
        raises the same error again."""
        self._end_part()
        self._helper.shutdown()
        with self._lock:
            unused, self._next = self._next, Future()
            self._next.cancel()
        if not unused.cancelled() and unused.exception() is None:
            spare = self._recordings.pop()
            spare.close()
            shutil.rmtree(spare.folder, ignore_errors=True)
        if self._failure is not None:
            raise self._failure

    def content(self) -> dict[str, Any]:
        """The parts, and the frames (start, first, last) that came and were not recorded, as plain values."""
        return {
            "before_s": self._switch.before_s,
            "parts": [part.content() for part in self.parts],
            "not_recorded": [list(gap) for gap in self._not_recorded()],
        }

    def finish(self, manifest: Mapping[str, Any]) -> None:
        """Write the manifest of each part, and copy the files of its maps (in the folders of `OF_MAPS`) into it. Call
        it after `close`.

        manifest: that of the run. Raises RecordingError if a part cannot be completed.
        """
        try:
            self._finish_parts(manifest)
        except OSError as error:
            raise RecordingError(
                f"cannot complete the parts in {self._folder}: {error.strerror or error}; free the space it needs, "
                "then 'rig repair' each part"
            ) from error

    def _finish_parts(self, manifest: Mapping[str, Any]) -> None:
        sweeps = manifest["sweeps"]
        for part, recording in zip(self.parts, self._recordings, strict=True):
            first = self._starts[part.start].first_map + part.first_sweep
            end = first + part.sweeps
            known = end <= len(sweeps)
            content = {key: value for key, value in manifest.items() if key not in ("counters", "on_request", "sweeps")}
            recording.starts[0]["sweeps"] = part.sweeps
            verdict = manifest["verdict"]
            content |= {
                "inputs": self._inputs,
                "recording": recording.content(),
                "gaps": [list(gap) for gap in part.lost],
                "verdict": RunVerdict.GAPS if part.lost else _WITHOUT_GAPS.get(verdict, verdict),
                "cut": {
                    "maps": [first, end],
                    "frames": [[part.run_id, part.first_frame, part.end_frame]],
                    "clock_ratios": [fitted_ratio(1.0, sweeps[self._starts[part.start].first_map : first])],
                },
            }
            if known:
                content |= {"sweeps": sweeps[first:end], "maps": part.sweeps}
                self._copy_maps(part.folder, range(first, end))
            _write_manifest(part.folder, content)

    # On the recorder's thread

    def _note(self, block: FrameBlock) -> None:
        start, header = self._starts[-1], block.header
        if start.first is None:
            start.first = header.first_frame
        start.end = header.first_frame + block.n_frames

    def _step(self, held: deque[_Held]) -> None:
        """Do what the switch asks for with the newest block, the last of `held`."""
        part, newest = self._part, held[-1]
        if part is None:
            self._begin_part(held)
            return
        closes = bool((newest.block.records["marks"] & Mark.SCAN).any())
        self._write(newest)
        if closes and not self._switch.wanted:
            self._end_part()

    def _begin_part(self, held: deque[_Held]) -> None:
        """Begin a part, if one is asked for and its folder is ready, with the sweep that was under way `before_s` ago,
        or with the oldest block that is held."""
        if not self._switch.asked:
            return
        if self._since is None:
            newest = held[-1].block.header
            self._since = newest.t0_ticks - round(self._switch.before_s * newest.tick_hz)
        if not self._next.done():
            return
        self._switch.take()
        try:
            recording = self._next.result()
        except OSError as error:
            raise RecordingError(
                f"cannot write the next part of {self._folder}: {error.strerror or error}; free the space it needs"
            ) from error
        number = len(self.parts)
        first = _first_of(held, self._since)
        self._since = None
        header = held[first].block.header
        part = RecordedPart(recording.folder, len(self._starts) - 1, header.run_id, header.first_frame)
        begins = held[first].block.n_frames and int(held[first].block.records["marks"][0]) & Mark.SCAN
        part.first_sweep = header.sweep - bool(begins)
        recording.begin(0)
        self._part = part
        self.parts.append(part)
        self._switch.parts.append(part)
        for each in list(held)[first:]:
            self._write(each)
        self._helper.submit(self._tell, part, recording)
        self._next = self._helper.submit(self._prepare, number + 1)

    def _write(self, each: _Held) -> None:
        part, block = self._part, each.block
        assert part is not None, "called within a part"
        each.written = self._recordings[len(self.parts) - 1].submit(block)
        first = block.header.first_frame
        if part.end_frame and first > part.end_frame:
            part.lost.append((part.end_frame, first - 1))
        part.end_frame = first + block.n_frames
        if block.n_frames:
            sweep = block.header.sweep + ((int(block.records["sweep"][-1]) - block.header.sweep) & 0xFFFF)
            part.sweeps = max(0, sweep - 1 - part.first_sweep)

    def _finish(self, each: _Held) -> None:
        if each.written is not None:
            each.written.result()

    def _end_part(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            part.ended = True
            self._helper.submit(self._close, self._recordings[len(self.parts) - 1])

    # On the helper's thread

    def _prepare(self, number: int) -> Recording:
        folder = self._folder / f"part-{number:03d}"
        folder.mkdir()
        self._write_inputs(folder)
        self._inputs = {file.name: file_crc32(file) for file in sorted(folder.iterdir()) if file.is_file()}
        _write_manifest(folder, {**self._manifest(), "inputs": self._inputs, "verdict": UNFINISHED})
        recording = Recording(folder, expected_bytes=0)
        self._recordings.append(recording)
        return recording

    def _tell(self, part: RecordedPart, recording: Recording) -> None:
        """Write that a part has begun, for a repair, should the program be killed."""
        cut = {"maps": [0, 0], "frames": [[part.run_id, part.first_frame, part.first_frame]], "clock_ratios": [1.0]}
        with suppress(OSError):
            _write_manifest(
                recording.folder, {**self._manifest(), "inputs": self._inputs, "verdict": UNFINISHED, "cut": cut}
            )

    def _close(self, recording: Recording) -> None:
        try:
            recording.close()
        except RecordingError as error:
            with self._lock:
                self._failure = self._failure or error

    # After the scan

    def _not_recorded(self) -> list[tuple[int, int, int]]:
        gaps = []
        for number, start in enumerate(self._starts):
            if start.first is None:
                continue
            spans = [(part.first_frame, part.end_frame) for part in self.parts if part.start == number]
            for before, after in pairwise([(0, start.first), *spans, (start.end, 0)]):
                if before[1] < after[0]:
                    gaps.append((number, before[1], after[0] - 1))
        return gaps

    def _copy_maps(self, folder: Path, maps: range) -> None:
        for kind in OF_MAPS:
            for number, index in enumerate(maps):
                file = self._folder / kind / f"{index:06d}.npz"
                if file.exists():
                    (folder / kind).mkdir(exist_ok=True)
                    shutil.copyfile(file, folder / kind / f"{number:06d}.npz")


_WITHOUT_GAPS: Final = {RunVerdict.GAPS: RunVerdict.COMPLETE}
"""Verdict of a part without gaps, by the run's, where it differs."""


def _first_of(held: Sequence[_Held], since_tick: int) -> int:
    """Index of the block in which the sweep begins that was under way at this tick; of the oldest one if that sweep is
    gone."""
    at = max((i for i, each in enumerate(held) if each.block.header.t0_ticks <= since_tick), default=0)
    marked = [i for i in range(at + 1) if (held[i].block.records["marks"] & Mark.SCAN).any()]
    return marked[-1] if marked else 0


def _require_memory(held_bytes: int, before_s: float) -> None:
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on Windows
        return
    if held_bytes > MOST_SHARE_OF_MEMORY * memory:
        raise UsageError(
            f"`before` is {before_s:g} s: with a sweep, {held_bytes / 1e9:.1f} GB of frames would be held, this "
            f"computer has {memory / 1e9:.1f} GB and half may be used; ask for less"
        )


def _write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    replace_file(folder / MANIFEST, (sealed_text(json_text(content)) + "\n").encode())
