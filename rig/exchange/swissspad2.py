"""`.bin` files of SwissSPAD2: no header, least significant bit first; half or full array (docs/reference/hardware.md).

Half array: 256 rows of 512 pixels, 512 frames in the camera's files of 8 MiB. Full array: 512 x 512, 256 frames a file,
read out as 256 rows of 1024 pixels in 8 zones of 128: a quarter of the upper half's row, the same quarter of the lower
half's row counted from the bottom, the next quarter, ... (WISION-Lab/photoncube2video, src/cube.rs). Nothing in a file
says which it is.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.errors import UsageError
from rig.exchange.foreign import LSB_FIRST, ForeignFrames, bytes_of, chunks_of, open_each

FORMS: Final = ("half", "full")
WIDTH: Final = 512
HALF_ROWS: Final = 256
_ROW_BYTES: Final = WIDTH // 8
_HALF_BYTES: Final = HALF_ROWS * _ROW_BYTES
_QUARTERS: Final = 4
_ZONE_BYTES: Final = _ROW_BYTES // _QUARTERS
_JUDGED_FRAMES: Final = 512
_JUDGED_SIGMAS: Final = 10.0
"""Standard deviations by which even and odd frames of one scene do not differ by chance."""


def open_swissspad2(files: Sequence[Path], form: str | None) -> ForeignFrames:
    """Open files as frames one after the other; form None is half. UsageError, a line per file, for parts of frames."""
    full = form == "full"
    frame_bytes = _HALF_BYTES * (2 if full else 1)

    def open_one(file: Path) -> NDArray[np.uint8]:
        content = bytes_of(file)
        if len(content) == 0 or len(content) % frame_bytes:
            raise UsageError(
                f"{file} has {len(content)} bytes, no whole number of {'full' if full else 'half'} frames of "
                f"{frame_bytes}; was it cut off?"
            )
        return content

    contents = open_each(files, open_one)

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for content in contents:
            for raw in chunks_of(content.reshape(-1, frame_bytes)):
                yield full_frames(raw) if full else LSB_FIRST[raw.reshape(-1, HALF_ROWS, _ROW_BYTES)]

    rows = 2 * HALF_ROWS if full else HALF_ROWS
    hints = []
    if not full and _alternates(contents[0]):
        hints.append(
            f"every second frame of {files[0].name} shows something else, as full frames do that are read as halves; "
            "if the whole array was read out, import with --form full"
        )
    n_frames = sum(len(content) for content in contents) // frame_bytes
    return ForeignFrames(WIDTH, rows, n_frames, chunks, {"form": "full" if full else "half"}, hints=hints)


def full_frames(raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(n, 512, 64), most significant bit first, of full frames as read out (n, 32768)."""
    zones = LSB_FIRST[raw.reshape(-1, HALF_ROWS, _QUARTERS, 2, _ZONE_BYTES)]
    frames = np.empty((len(zones), 2 * HALF_ROWS, _ROW_BYTES), np.uint8)
    halves = frames.reshape(len(zones), 2, HALF_ROWS, _QUARTERS, _ZONE_BYTES)
    halves[:, 0] = zones[:, :, :, 0]
    halves[:, 1] = zones[:, ::-1, :, 1]
    return frames


def _alternates(content: NDArray[np.uint8]) -> bool:
    """Whether even and odd half frames differ by more than photons scatter, as the halves of full frames do."""
    frames = content[: 2 * _HALF_BYTES * (_JUDGED_FRAMES // 2)].reshape(-1, _HALF_BYTES)
    even, odd = frames[0 : len(frames) // 2 * 2 : 2], frames[1::2]
    counts = [np.unpackbits(part, axis=1).sum(axis=0, dtype=np.float64) for part in (even, odd)]
    total = counts[0] + counts[1]
    seen = total > 0
    # Of Poisson numbers the squared difference over the sum has mean 1 and, at these counts, variance 2 at most.
    excess = float(((counts[0] - counts[1])[seen] ** 2 / total[seen] - 1).sum())
    return excess > _JUDGED_SIGMAS * float(np.sqrt(2.0 * max(1, int(seen.sum()))))
