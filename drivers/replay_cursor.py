"""The place in a recorded start of a SPAD: the next frames, cut and joined as they are asked for."""

from collections import deque
from collections.abc import Generator
from typing import cast

import numpy as np

from drivers.frames import BlockStatus, FrameBlock, Mark
from drivers.recorded import RecordedRun, RunRecording

_SCAN = int(Mark.SCAN)

Piece = tuple[FrameBlock, int, int]
"""Frames [a, b) of a recorded block."""


class Cursor:
    """From the first frame of a start to its end, or to frame number `n_frames`. For one thread.

    by_block: steps are blocks, since there are no markers.
    """

    def __init__(self, recording: RunRecording, run: RecordedRun, n_frames: int | None, *, by_block: bool) -> None:
        begins = run.entries["first_frame"].astype(np.int64)
        self._begins = begins if n_frames is None else begins[begins < n_frames]
        self._end_frame = run.end_frame if n_frames is None else min(n_frames, run.end_frame)
        self._blocks = cast(Generator[FrameBlock, None, None], recording.blocks(run, None, self._end_frame))
        self._ahead: deque[FrameBlock] = deque()
        self._at = 0
        self._taken = 0
        self._by_block = by_block
        self.next_frame = 0
        """One past the last frame that was played."""
        self.step_due = by_block
        """Whether the frames that come next wait for a step: those behind a scan marker, or without markers all."""
        self.damaged = 0
        """Blocks that could not be read, so far."""

    @property
    def over(self) -> bool:
        """Whether no frame is left."""
        return not self._look_ahead(0)

    def ends_with(self, block: FrameBlock, end: int) -> bool:
        """Whether the frames before `end` of this block are the last ones."""
        return block.header.first_frame + end >= self._end_frame

    def gather(self, most: int, *, to_marker: bool) -> list[Piece]:
        """The next consecutive frames, at most so many; up to a scan marker and no further where asked for."""
        pieces: list[Piece] = []
        n, index = 0, 0
        while n < most and self._look_ahead(index):
            block, at = self._ahead[index], 0 if index else self._at
            if pieces and not _continues(block, pieces[-1][0]):
                break
            end = min(block.n_frames, at + most - n)
            markers = np.flatnonzero(block.records["marks"][at:end] & _SCAN)[: int(to_marker)]
            end = at + int(markers[0]) + 1 if len(markers) else end
            pieces.append((block, at, end))
            if len(markers):
                break
            n, index = n + end - at, index + 1
        return pieces

    def move_on(self, pieces: list[Piece]) -> None:
        """Past frames that were gathered."""
        block, _, end = pieces[-1]
        self.step_due = self._by_block or bool(block.records["marks"][end - 1] & _SCAN)
        self.next_frame = block.header.first_frame + end
        while self._ahead[0] is not block:
            self._ahead.popleft()
        self._at = end
        if end == block.n_frames:
            self._ahead.popleft()
            self._at = 0

    def close(self) -> None:
        """Read no further ahead."""
        self._blocks.close()

    def _look_ahead(self, index: int) -> bool:
        """Whether there is a block at this place behind the present one, which is then in `_ahead`."""
        while len(self._ahead) <= index:
            block = next(self._blocks, None)
            if block is None:
                self.damaged = len(self._begins) - self._taken
                return False
            if block.n_frames:
                self._ahead.append(block)
            self._taken += 1
            self.damaged = int(np.searchsorted(self._begins, block.header.first_frame, "right")) - self._taken
        return True


def _continues(block: FrameBlock, before: FrameBlock) -> bool:
    """Whether a block's frames follow those of the one before, both being whole."""
    whole = before.status == block.status == BlockStatus.OK
    return whole and block.header.first_frame == before.header.first_frame + before.n_frames
