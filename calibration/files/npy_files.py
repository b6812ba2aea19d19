"""Reading .npy and .npz files from any source. The size of an array that a header states is not trusted.

numpy allocates an array as large as its header says before it reads the first number. Here an array of that size must
first fit into the file.
"""

import math
import os
import zipfile
from pathlib import Path
from typing import IO, Any, Final, Literal

import numpy as np

_MAGIC_BYTES: Final = 8
_LENGTH_BYTES: Final = {1: 2, 2: 4, 3: 4}
"""Bytes that hold the length of the header, by version of the format."""
_MOST_HEADER_BYTES: Final = 10_000
"""numpy's own limit, which it looks at only once it has read so much."""
_DEFLATE_RATIO: Final = 1032
"""Bytes that one compressed byte can stand for at most (zlib's technical details)."""


def load_numpy(file: str | os.PathLike[str], mmap_mode: Literal["r"] | None = None) -> Any:
    """An array, or an archive of arrays; pickles are refused. Raises OSError; ValueError or BadZipFile for other
    files; for a few damaged ones zlib.error, TokenError, TypeError or NotImplementedError.
    """
    with Path(file).open("rb") as stream:
        is_archive = stream.read(4) == b"PK\x03\x04"
        stream.seek(0)
        if is_archive:
            _check_archive(stream)
        else:
            _check_array(stream, os.fstat(stream.fileno()).st_size)
    return np.load(file, mmap_mode=mmap_mode, allow_pickle=False)


def _check_archive(stream: IO[bytes]) -> None:
    with zipfile.ZipFile(stream) as archive:
        for member in archive.infolist():
            if member.file_size > _DEFLATE_RATIO * member.compress_size + _MOST_HEADER_BYTES:
                raise ValueError(f"{member.filename} says that it holds {member.file_size} bytes, which it cannot")
            if member.filename.endswith(".npy"):
                with archive.open(member) as inside:
                    _check_array(inside, member.file_size)


def _check_array(stream: IO[bytes], size: int) -> None:
    """Raises ValueError unless the array of a file of `size` bytes, from where the stream is at, has room in it."""
    magic = stream.read(_MAGIC_BYTES)
    if len(magic) < _MAGIC_BYTES or not magic.startswith(np.lib.format.MAGIC_PREFIX):
        raise ValueError("it is no array of numpy's")
    length_bytes = _LENGTH_BYTES.get(magic[6])
    if length_bytes is None:
        raise ValueError(f"it is of version {magic[6]} of the format, which is not known")
    header_bytes = int.from_bytes(stream.read(length_bytes), "little")
    if header_bytes > min(size, _MOST_HEADER_BYTES):
        raise ValueError(f"its header of {header_bytes} bytes is longer than {min(size, _MOST_HEADER_BYTES)}")
    stream.seek(-length_bytes, os.SEEK_CUR)
    if magic[6] == 1:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    room = size - _MAGIC_BYTES - length_bytes - header_bytes
    if any(side < 0 for side in shape) or math.prod(shape) * max(1, dtype.itemsize) > room:
        raise ValueError(f"it says that it holds {dtype} of shape {shape}, which do not fit its {size} bytes")
