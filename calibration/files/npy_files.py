"""Reading .npy and .npz files from any source. The size of an array that a header states is not trusted, and any
exception of numpy, zipfile and zlib for damaged bytes becomes a ValueError.

numpy allocates an array as large as its header says before it reads the first number. Here an array of that size must
first fit into the file.
"""

import math
import os
import zipfile
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from calibration.errors import plain_text

_MAGIC_BYTES: Final = 8
_LENGTH_BYTES: Final = {1: 2, 2: 4, 3: 4}
"""Bytes that hold the length of the header, by version of the format."""
_MOST_HEADER_BYTES: Final = 10_000
"""numpy's own limit, which numpy checks only after it has read the whole header."""
_DEFLATE_RATIO: Final = 1032
"""Bytes that one compressed byte can stand for at most (zlib's technical details)."""
_MOST_RATIO: Final = 64
_MOST_UNPACKED: Final = 256 << 20
"""All arrays of an archive together may have so many times its bytes, or so many bytes: a stripe table of 1024 rows and
1000 columns has a tenth of them."""


def load_array(file: str | os.PathLike[str]) -> NDArray[Any]:
    """The array of a .npy file. Raises OSError if it cannot be opened, ValueError (one line) if it holds no array."""
    loaded = _load(Path(file))
    if isinstance(loaded, dict):
        raise ValueError("it is an archive of arrays, not a single one")
    return loaded


def load_arrays(file: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name. Raises OSError if it cannot be opened, ValueError (one line) if it holds no
    arrays."""
    loaded = _load(Path(file))
    if not isinstance(loaded, dict):
        raise ValueError("it is a single array, not an archive of arrays")
    return loaded


def _load(file: Path) -> NDArray[Any] | dict[str, NDArray[Any]]:
    with file.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            is_archive = stream.read(4) == b"PK\x03\x04"
            stream.seek(0)
            if is_archive:
                _check_archive(stream, size)
            else:
                _check_array(stream, size)
            stream.seek(0)
            loaded = np.load(stream, allow_pickle=False)
            return dict(loaded) if is_archive else loaded
        except Exception as error:
            raise ValueError(plain_text(" ".join(str(error).split())) or type(error).__name__) from error


def _check_archive(stream: IO[bytes], size: int) -> None:
    """Raise ValueError for an archive that would take much more memory than it is large, or whose arrays do not fit."""
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if sum(member.compress_size for member in members) > size:  # several may share the same bytes
            raise ValueError(f"its {len(members)} arrays overlap")
        unpacked = sum(member.file_size for member in members)
        if unpacked > max(_MOST_UNPACKED, _MOST_RATIO * size):
            raise ValueError(f"its arrays take {unpacked >> 20} MiB, it has {size} bytes")
        for member in members:
            if member.file_size > _DEFLATE_RATIO * member.compress_size + _MOST_HEADER_BYTES:
                raise ValueError(f"{member.filename} says that it holds {member.file_size} bytes, which it cannot")
            if not member.filename.endswith(".npy"):
                raise ValueError(f"{member.filename} in it is no .npy file")
            with archive.open(member) as inside:
                _check_array(inside, member.file_size)


def _check_array(stream: IO[bytes], size: int) -> None:
    """Raise ValueError unless the array at the stream's position fits into a file of `size` bytes."""
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
