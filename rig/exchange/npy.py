"""Writes a recording as a photon cube: `frames.npy` for `photoncube`, `visionsim` and `rig reconstruct`, and its JSON.

The array is uint8 (frames, height, ceil(width / 8)), most significant bit first, with the received frames one after the
other. `frames.json` has what the array cannot hold: clock, numbers and gaps, markers, windows, collected block by block
by `FrameLog`. If frames are whole and their camera is known, `transforms.json` makes it a data set for visionsim.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from drivers.frames import BlockHeader, FrameBlock, Mark
from rig.errors import UsageError
from rig.exchange.photoncube import SIDECAR_FORMAT, TRANSFORMS
from rig.run_folder.folder import RunFolder
from rig.run_folder.map_files import map_numbers, read_depth, read_stripe
from rig.run_folder.plain_json import json_text

CUBE: Final = "frames.npy"
Ranges = list[tuple[int, int, int]]
"""(run id of the start, first frame, number of frames) of stretches without a gap; (run id, first, last) of gaps."""
_POSE: Final = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
"""Pose for visionsim: the camera does not move, and its own frame is the world's."""


class FrameLog:
    """The records of all frames, in the order in which their blocks are added. All blocks have the size and the clock
    of the first one."""

    def __init__(self) -> None:
        self._header: BlockHeader | None = None
        self._parts: list[tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.void]]] = []
        """Run id, numbers, ticks and records of each block."""
        self.n_frames = 0

    def add(self, block: FrameBlock) -> None:
        """Add a block's records. Raises UsageError if its size or clock differs from the first block's."""
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
        """The first block's header. Raises UsageError if there was no block."""
        if self._header is None:
            raise UsageError("the recording holds no whole block of frames; see rig verify")
        return self._header

    def columns(self) -> dict[str, NDArray[Any]]:
        """Arrays (frames,) by name: number, run (its id), ticks and time_s of the SPAD's clock, and marks, x0, y0, line
        and sweep of the records."""
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
        """(run id, first frame, number of frames) of each stretch without a gap, in order."""
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
        """(run id, first, last) of the frames missing between those of one start."""
        return [
            (run, first + n, next_first - 1)
            for (run, first, n), (next_run, next_first, _) in pairwise(self.ranges())
            if run == next_run
        ]

    def content(self) -> dict[str, Any]:
        """All that an array of pixels cannot hold, for a JSON file. Markers and changes are at indices of the array."""
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
    """(first, last) index of every stretch of True."""
    edges = np.flatnonzero(np.diff(true, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2):
        yield int(first), int(end) - 1


def _changes(values: NDArray[np.integer[Any]]) -> Iterator[tuple[int, int]]:
    """(index, value) of the first value and of each that differs from the one before."""
    for index in np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]])) if len(values) else ():
        yield int(index), int(values[index])


def write_npy(
    blocks: Iterable[FrameBlock], folder: RunFolder, source: Mapping[str, Any], camera: Camera | None
) -> FrameLog:
    """Write the cube of `blocks` and the files beside it. Raises UsageError if the blocks do not make one array."""
    log = FrameLog()
    with folder.place(CUBE).open("wb") as file:
        for block in blocks:
            if log.n_frames == 0:
                _write_header(file, block, 0)
            log.add(block)
            file.write(np.ascontiguousarray(block.bits[:, :, : -(-block.header.width // 8)]).data)
        header = log.header
        file.seek(0)
        _write_header(file, block, log.n_frames)
    content = {"format": SIDECAR_FORMAT, "version": 1, "array": CUBE, **log.content(), "source": source}
    lines = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in json.loads(json_text(content)).items())
    sidecar = folder.place(CUBE).with_suffix(".json")
    sidecar.write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")
    whole = (header.width, header.height) == (header.sensor_width, header.sensor_height)
    if camera is not None and whole and (camera.width, camera.height) == (header.width, header.height):
        folder.place(TRANSFORMS).write_text(_transforms(camera, log.n_frames), encoding="utf-8")
    return log


def _write_header(file: BinaryIO, block: FrameBlock, n_frames: int) -> None:
    """Write the header. It has the same size for any number of frames, since numpy leaves room for arrays that grow."""
    shape = (n_frames, block.header.height, -(-block.header.width // 8))
    np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})


def _transforms(camera: Camera, n_frames: int) -> str:
    """Describe the data set as visionsim does (visionsim 0.1, dataset/schema.py)."""
    (fl_x, _, cx), (_, fl_y, cy), _ = camera.matrix.tolist()
    content = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, "w": camera.width, "h": camera.height, "c": 1}
    content |= {"bitpack": True, "bitpack_dim": 2, "file_path": CUBE}
    frames = ",\n".join([f'{{"transform_matrix": {_POSE}}}'] * n_frames)
    return f'{json.dumps(content)[:-1]}, "frames": [\n{frames}\n]}}\n'


class MapFiles:
    """The maps of a run, as docs/reference/run-folder.md describes them. A run that was only recorded has none."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self.indices = map_numbers(run)

    def files(self, folder: str, suffix: str) -> list[Path]:
        """Files of one kind (such as 'depth', '.npy') in the order of the maps."""
        return sorted(self._run.glob(f"{folder}/*{suffix}"))

    def arrays(self, index: int) -> dict[str, NDArray[np.float32]]:
        """Stripe table of a map, (rows, columns) each, and depth_m (height, width) if the rig is calibrated. Raises
        UsageError if a file cannot be read."""
        arrays = load(self._run / "stripe" / f"{index:06d}.npz", read_stripe)
        file = self._run / "depth" / f"{index:06d}.npy"
        return {**arrays, "depth_m": load(file, read_depth)} if file.exists() else arrays


def load(file: Path, read: Callable[[Path], Any]) -> Any:
    """Read a numpy file with `read`. Raises UsageError, with one line, if that fails."""
    try:
        return read(file)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {file}: {error}; make the maps again with rig reconstruct") from error
