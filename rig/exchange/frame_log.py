"""Gathers what a recording says of its frames beside their pixels, block by block, while the pixels go elsewhere."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.frames import BlockHeader, FrameBlock, Mark
from rig.errors import UsageError

Ranges = list[tuple[int, int, int]]
"""[run id, first frame, frames] of consecutive numbers."""


class FrameLog:
    """The records of all frames in order; UsageError where a block has another size or clock than the first one."""

    def __init__(self) -> None:
        self._header: BlockHeader | None = None
        self._parts: list[tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.void]]] = []
        """Run, numbers, ticks and records of each block."""
        self.n_frames = 0

    def add(self, block: FrameBlock) -> None:
        """Add a block's records."""
        header = block.header
        first = self._header = self._header or header
        if (header.width, header.height) != (first.width, first.height):
            raise UsageError(
                f"the recording goes from windows of {first.width} x {first.height} to {header.width} x "
                f"{header.height} pixels at frame {header.first_frame}; an array has one size, split it with rig cut"
            )
        if (header.tick_hz, header.frame_period_ticks) != (first.tick_hz, first.frame_period_ticks):
            raise UsageError(
                f"the recording's frame clock changes at frame {header.first_frame} of run {header.run_id}; "
                "split it with rig cut"
            )
        self._parts.append((header.run_id, block.frame_numbers, block.start_ticks, block.records.copy()))
        self.n_frames += block.n_frames

    @property
    def header(self) -> BlockHeader:
        """The first block's header; UsageError where there was no block."""
        if self._header is None:
            raise UsageError("the recording holds no whole block of frames; see rig verify")
        return self._header

    def columns(self) -> dict[str, NDArray[Any]]:
        """Arrays (frames,): number, run, ticks and the fields of the records."""
        runs, *arrays = zip(*self._parts, strict=True)
        number, ticks, records = map(np.concatenate, arrays)
        return {
            "number": number,
            "run": np.repeat(np.array(runs, np.uint16), [len(part) for part in arrays[0]]),
            "ticks": ticks,
            **{name: records[name] for name in ("marks", "x0", "y0", "line", "sweep")},
            "time_s": ticks / float(self.header.tick_hz),
        }

    def ranges(self) -> Ranges:
        """Ranges of consecutive frames, in order."""
        ranges: Ranges = []
        for run, numbers, *_ in self._parts:
            if len(numbers) == 0:
                continue
            first, n = int(numbers[0]), len(numbers)
            if ranges and ranges[-1][0] == run and ranges[-1][1] + ranges[-1][2] == first:
                ranges[-1] = run, ranges[-1][1], ranges[-1][2] + n
            else:
                ranges.append((run, first, n))
        return ranges

    def gaps(self) -> Ranges:
        """Frames that are missing between others of their run, [run id, first, last]."""
        return [
            (run, first + n, next_first - 1)
            for (run, first, n), (next_run, next_first, _) in pairwise(self.ranges())
            if run == next_run
        ]

    def content(self) -> dict[str, Any]:
        """Describe, for a JSON file, all that an array of the pixels cannot say. Places are indices of the array."""
        header, columns = self.header, self.columns()
        marks = columns["marks"]
        return {
            "width": header.width,
            "height": header.height,
            "sensor": [header.sensor_width, header.sensor_height],
            "bit_order": "most significant bit first",
            "packed_axis": 2,
            "frames": self.n_frames,
            "clock": {
                "tick_hz": [header.tick_hz.numerator, header.tick_hz.denominator],
                "frame_period_ticks": header.frame_period_ticks,
                "exposure_ticks": header.exposure_ticks,
                "first_ticks": int(columns["ticks"][0]) if self.n_frames else None,
            },
            "ranges": self.ranges(),
            "gaps": self.gaps(),
            "lit": list(_spans(marks & Mark.GATE_HIGH > 0)),
            "backward": list(_spans(marks & Mark.BACKWARD > 0)),
            "scan_markers": np.flatnonzero(marks & Mark.SCAN),
            "line_markers": np.flatnonzero(marks & Mark.LINE),
            "x0": list(_changes(columns["x0"])),
            "y0": list(_changes(columns["y0"])),
        }


def _spans(true: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """[first, last] index of every run of True."""
    edges = np.flatnonzero(np.diff(true, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2):
        yield int(first), int(end) - 1


def _changes(values: NDArray[np.integer[Any]]) -> Iterator[tuple[int, int]]:
    """[index, value] wherever the value is another than the one before."""
    for index in np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]])) if len(values) else ():
        yield int(index), int(values[index])
