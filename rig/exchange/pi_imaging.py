"""Files of the SPAD512S (Pi Imaging): 1-bit RAW files, dumps of the TCP stream, sparse lists
(docs/reference/hardware.md).

Packed: rows of 64 bytes, most significant bit first, no header; a dump of the stream may end with `DONE`, which pixels
may read as well: what counts is the length. Sparse: u32 little-endian numbers of the pixels that fired, row by row; the
number of pixels closes a frame.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.errors import UsageError
from rig.exchange.foreign import ForeignFrames, bytes_of, chunks_of, open_each

FORMS: Final = ("packed", "sparse")
COLUMNS: Final = 512
ROWS: Final = 512
DONE: Final = b"DONE"
_SPARSE_BATCH: Final = 64
"""Number of frames expanded at a time."""


def open_pi_imaging(files: Sequence[Path], form: str | None, rows: int | None) -> ForeignFrames:
    """Open files as frames one after the other. form: one of FORMS; None to see from each file which it is.

    rows: 512, or 1024 of the 1M flavour. UsageError, a line per file, for contents that are no whole number of frames.
    """
    rows = rows or ROWS
    opened = open_each(files, lambda file: _open(file, form, rows))
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


def _open(file: Path, form: str | None, rows: int) -> tuple[str, NDArray[np.uint8]]:
    """Find out the form of a file, and return it with the bytes of the frames."""
    content = bytes_of(file)
    frame_bytes = rows * COLUMNS // 8
    ended = content[-len(DONE) :].tobytes() == DONE
    packed = content[: len(content) - len(content) % frame_bytes]
    # Pixels may read DONE: it is an ending only where it is too much.
    is_packed = len(packed) > 0 and (len(packed) == len(content) or (ended and len(content) - len(packed) == len(DONE)))
    listed = content[: len(content) - len(DONE)] if ended else content
    is_sparse = _is_list(listed, rows * COLUMNS)
    if form is None and is_packed and is_sparse:
        raise UsageError(f"{file} can be read as packed frames and as a sparse list; say which with --form")
    if is_packed and form != "sparse":
        return "packed", packed
    if is_sparse and form != "packed":
        return "sparse", listed
    forms = FORMS if form is None else (form,)
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
