"""Raw `.bin` files of two cameras, whose frames have no header (docs/reference/hardware.md).

SPAD512S (Pi Imaging): 1-bit RAW files, dumps of the TCP stream, sparse lists. Packed files have rows of 64 bytes, most
significant bit first. A dump of the stream may end with `DONE`; as pixels may have the same bytes, the length decides.
Sparse lists are u32 little-endian numbers of the pixels that fired, counted row by row; the number rows x 512 ends a
frame.

SwissSPAD2: least significant bit first. Half array: 256 rows of 512 pixels, 512 frames in the camera's files of 8 MiB.
Full array: 512 x 512, 256 frames a file, read out as 256 rows of 1024 pixels in 8 zones of 128: a quarter of the upper
half's row, the same quarter of the lower half's row counted from the bottom, the next quarter, ...
(WISION-Lab/photoncube2video, src/cube.rs). Nothing in a file says which of the two it is.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.errors import UsageError, each_or_problems
from rig.exchange.foreign import ForeignFrames, bytes_of, chunks_of
from rig.requests import ImportRequest

COLUMNS: Final = 512
_ROW_BYTES: Final = COLUMNS // 8
PI_IMAGING_FORMS: Final = ("packed", "sparse")
ROWS: Final = 512
DONE: Final = b"DONE"
_SPARSE_BATCH: Final = 64
"""Number of frames expanded at a time."""
SWISSSPAD2_FORMS: Final = ("half", "full")
HALF_ROWS: Final = 256
_HALF_BYTES: Final = HALF_ROWS * _ROW_BYTES
_QUARTERS: Final = 4
_ZONE_BYTES: Final = _ROW_BYTES // _QUARTERS
_LSB_FIRST: Final = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8), bitorder="little"))
"""Bytes with their bits reversed."""
_JUDGED_FRAMES: Final = 512
_JUDGED_SIGMAS: Final = 10.0
"""Even and odd half frames of one scene differ by fewer standard deviations than this."""


def open_pi_imaging(files: Sequence[Path], asked: ImportRequest) -> ForeignFrames:
    """Open files as one sequence of frames. The form of each file is recognised unless the request states it.

    Raises UsageError with a line for each file that cannot be read, holds no whole number of frames, or could have both
    forms.
    """
    form, rows = asked.form, asked.rows or ROWS
    opened = each_or_problems(files, lambda file: _open_pi_imaging(file, form, rows))
    forms = sorted({kind for kind, _ in opened})

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for kind, content in opened:
            packed = kind == "packed"
            yield from chunks_of(content.reshape(-1, rows, COLUMNS // 8)) if packed else _sparse(content, rows)

    frame_bytes = rows * COLUMNS // 8
    n_frames = sum(
        len(content) // frame_bytes if kind == "packed" else int((content.view("<u4") == rows * COLUMNS).sum())
        for kind, content in opened
    )
    return ForeignFrames(COLUMNS, rows, n_frames, chunks, {"form": "+".join(forms)})


def _open_pi_imaging(file: Path, form: str | None, rows: int) -> tuple[str, NDArray[np.uint8]]:
    """Find out the form of a file, 'packed' or 'sparse'; return it with the bytes of the frames, without `DONE`."""
    content = bytes_of(file)
    frame_bytes = rows * COLUMNS // 8
    ended = content[-len(DONE) :].tobytes() == DONE
    packed = content[: len(content) - len(content) % frame_bytes]
    # Pixels may have the same bytes as DONE: they are an ending only if they come after whole frames.
    is_packed = len(packed) > 0 and (len(packed) == len(content) or (ended and len(content) - len(packed) == len(DONE)))
    listed = content[: len(content) - len(DONE)] if ended else content
    is_sparse = _is_list(listed, rows * COLUMNS)
    if form is None and is_packed and is_sparse:
        raise UsageError(f"{file} can be read as packed frames and as a sparse list; say which with `form`")
    if is_packed and form != "sparse":
        return "packed", packed
    if is_sparse and form != "packed":
        return "sparse", listed
    forms = PI_IMAGING_FORMS if form is None else (form,)
    what = {
        "packed": f"no whole number of frames of {frame_bytes} bytes, with or without {DONE.decode()} behind them",
        "sparse": f"no list of pixel numbers that ends with {rows * COLUMNS}",
    }
    raise UsageError(
        f"{file} has {len(content)} bytes: {', and '.join(what[one] for one in forms)}; was it cut off, or taken with "
        f"other than {rows} rows or with more than one bit per pixel?"
    )


def _is_list(content: NDArray[np.uint8], end: int) -> bool:
    if len(content) == 0 or len(content) % 4:
        return False
    words = content.view("<u4")
    return bool(words[-1] == end) and all(bool((piece <= end).all()) for piece in chunks_of(words))


def _sparse(content: NDArray[np.uint8], rows: int) -> Iterator[NDArray[np.uint8]]:
    words = content.view("<u4")
    ends = np.flatnonzero(words == rows * COLUMNS)
    start = 0
    for first in range(0, len(ends), _SPARSE_BATCH):
        batch = ends[first : first + _SPARSE_BATCH]
        listed = words[start : batch[-1] + 1]
        frame = np.searchsorted(batch, np.arange(start, batch[-1] + 1))
        fired = listed != rows * COLUMNS
        pixels = np.zeros((len(batch), rows * COLUMNS), np.uint8)
        pixels[frame[fired], listed[fired]] = 1
        yield np.packbits(pixels.reshape(len(batch), rows, COLUMNS), axis=2)
        start = int(batch[-1]) + 1


def open_swissspad2(files: Sequence[Path], asked: ImportRequest) -> ForeignFrames:
    """Open files as one sequence of frames, of half arrays unless the request says full. Raises UsageError with a line
    for each file that cannot be read or holds no whole number of frames."""
    full = asked.form == "full"
    frame_bytes = _HALF_BYTES * (2 if full else 1)

    def open_one(file: Path) -> NDArray[np.uint8]:
        content = bytes_of(file)
        if len(content) == 0 or len(content) % frame_bytes:
            raise UsageError(
                f"{file} has {len(content)} bytes, no whole number of {'full' if full else 'half'} frames of "
                f"{frame_bytes}; was it cut off?"
            )
        return content

    contents = each_or_problems(files, open_one)

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for content in contents:
            for raw in chunks_of(content.reshape(-1, frame_bytes)):
                yield full_frames(raw) if full else _LSB_FIRST[raw.reshape(-1, HALF_ROWS, _ROW_BYTES)]

    rows = 2 * HALF_ROWS if full else HALF_ROWS
    hints = []
    if not full and _alternates(contents[0]):
        hints.append(
            f"every second frame of {files[0].name} shows something else, as full frames do that are read as halves; "
            "if the whole array was read out, import with `form='full'`"
        )
    n_frames = sum(len(content) for content in contents) // frame_bytes
    return ForeignFrames(COLUMNS, rows, n_frames, chunks, {"form": "full" if full else "half"}, hints=hints)


def full_frames(raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames (n, 512, 64), most significant bit first, from full frames as read out (n, 32768); both uint8."""
    zones = _LSB_FIRST[raw.reshape(-1, HALF_ROWS, _QUARTERS, 2, _ZONE_BYTES)]
    frames = np.empty((len(zones), 2 * HALF_ROWS, _ROW_BYTES), np.uint8)
    halves = frames.reshape(len(zones), 2, HALF_ROWS, _QUARTERS, _ZONE_BYTES)
    halves[:, 0] = zones[:, :, :, 0]
    halves[:, 1] = zones[:, ::-1, :, 1]
    return frames


def _alternates(content: NDArray[np.uint8]) -> bool:
    """Whether even and odd half frames differ by more than photon noise, as the halves of full frames do."""
    frames = content[: 2 * _HALF_BYTES * (_JUDGED_FRAMES // 2)].reshape(-1, _HALF_BYTES)
    even, odd = frames[0 : len(frames) // 2 * 2 : 2], frames[1::2]
    counts = [np.unpackbits(part, axis=1).sum(axis=0, dtype=np.float64) for part in (even, odd)]
    total = counts[0] + counts[1]
    seen = total > 0
    # Of Poisson numbers the squared difference over the sum has mean 1 and, at these counts, variance 2 at most.
    excess = float(((counts[0] - counts[1])[seen] ** 2 / total[seen] - 1).sum())
    return excess > _JUDGED_SIGMAS * float(np.sqrt(2.0 * max(1, int(seen.sum()))))
