"""Writes a run as one HDF5 file. h5py opens it, and so does MATLAB with `h5read` or `load` (MAT-file of version 7.3).

    /frames/bits uint8 (frames, height, row bytes)  /frames/number run ticks time_s marks x0 y0 line sweep (1, frames)
    /maps/depth_m float32 (maps, height, width), if the rig is calibrated
    /maps/number (1, maps)  /manifest UTF-16 (n, 1)
    /maps/x_px confidence x_sd_px signal haze, also x2_px confidence2 if the estimator has them (maps, rows, columns)
    /clock/tick_hz tick_hz_numerator tick_hz_denominator frame_period_ticks exposure_ticks (1, 1)

MATLAB sees dimensions in reverse order, and its arrays have two or more. A MAT-file has 512 bytes of header before the
HDF5 part, and the name of a MATLAB class with each array and group (MAT-file format 7.3, as MATLAB writes it).
"""

import errno
import json
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FrameBlock
from drivers.optional_packages import install_command
from rig.errors import UsageError
from rig.exchange.npy import FrameLog, MapFiles
from rig.run_folder.plain_json import json_text

FILE: Final = "run.h5"
_USER_BLOCK: Final = 512
_HEADER_TEXT: Final = 116
_HEADER_END: Final = b"\0" * 8 + b"\x00\x02" + b"IM"
"""End of the MAT-file's header: no subsystem data, version 2.0, little-endian."""
_CHUNK_BYTES: Final = 1 << 20
_CLASSES: Final = {"float32": "single", "float64": "double"}
"""MATLAB's names of types; integers have the same names as in numpy."""
_ROOM_BYTES: Final = 16 << 20
"""Bytes left free for data that HDF5 buffers and writes late."""


def require_h5py() -> Any:
    """The h5py module. If it is missing, raises UsageError with the command that installs it."""
    try:
        import h5py
    except ImportError as error:
        raise UsageError(f"export as hdf5 needs h5py; install it: {install_command('h5py')}") from error
    return h5py


def write_hdf5(blocks: Iterable[FrameBlock], maps: MapFiles, manifest: Mapping[str, Any], path: Path) -> FrameLog:
    """Write frames, maps and manifest to a new file. Without frames or maps, their group is left out.

    Raises UsageError without h5py or if the frames do not make one array, OSError if the disk has too little room left.
    """
    h5py = require_h5py()
    log = FrameLog()
    with h5py.File(path, "w", userblock_size=_USER_BLOCK) as file:
        bits: Any = None
        for block in blocks:
            log.add(block)
            _require_room(path, block.bits.nbytes)
            pixels = block.bits[:, :, : -(-block.header.width // 8)]
            if bits is None:
                bits = _growing(_group(file, "frames"), "bits", pixels)
            bits.resize(log.n_frames, axis=0)
            bits[log.n_frames - len(pixels) :] = pixels
        if bits is not None:
            _write_frames(file, log)
        if maps.indices:
            _write_maps(_group(file, "maps"), maps)
        text = json.dumps(json.loads(json_text(manifest)), ensure_ascii=False)
        units = np.frombuffer(text.encode("utf-16-le"), "<u2")
        characters = _array(file, "manifest", units[:, None], matlab="char")
        characters.attrs["MATLAB_int_decode"] = np.int32(2)
    made = datetime.now(UTC).strftime("%a %b %d %H:%M:%S %Y")
    title = f"MATLAB 7.3 MAT-file, Platform: spadrig, Created on: {made} HDF5 schema 1.00 ."
    with path.open("r+b") as raw:
        raw.write(title.encode("ascii").ljust(_HEADER_TEXT) + _HEADER_END)
    return log


def _require_room(path: Path, n_bytes: int) -> None:
    """Raise OSError if n_bytes nearly fill the disk. On a full disk HDF5 cannot close a file and ends the process."""
    if shutil.disk_usage(path.parent).free < n_bytes + _ROOM_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _write_frames(file: Any, log: FrameLog) -> None:
    header = log.header
    frames = file["frames"]
    for name, values in log.columns().items():
        _array(frames, name, values[None])
    frames.attrs["width_px"] = header.width
    frames.attrs["bit_order"] = np.bytes_("most significant bit first, packed along the width")
    clock = _group(file, "clock")
    rate = header.tick_hz
    numbers = {"tick_hz": float(rate), "tick_hz_numerator": rate.numerator, "tick_hz_denominator": rate.denominator}
    numbers |= {"frame_period_ticks": header.frame_period_ticks, "exposure_ticks": header.exposure_ticks}
    for name, value in numbers.items():
        _array(clock, name, np.array([[value]], np.float64 if isinstance(value, float) else np.int64))


def _write_maps(group: Any, maps: MapFiles) -> None:
    """Write the maps one by one, since they may not fit into memory together."""
    for place, index in enumerate(maps.indices):
        arrays = maps.arrays(index)
        _require_room(Path(group.file.filename), sum(values.nbytes for values in arrays.values()))
        for name, values in arrays.items():
            if name not in group:
                _growing(group, name, values[None]).resize(len(maps.indices), axis=0)
            group[name][place] = values
    _array(group, "number", np.array([maps.indices], np.int64))


def _group(file: Any, name: str) -> Any:
    group = file.create_group(name)
    group.attrs["MATLAB_class"] = np.bytes_("struct")
    return group


def _array(group: Any, name: str, values: NDArray[Any], matlab: str | None = None) -> Any:
    made = group.create_dataset(name, data=values)
    made.attrs["MATLAB_class"] = np.bytes_(matlab or _CLASSES.get(values.dtype.name, values.dtype.name))
    return made


def _growing(group: Any, name: str, first: NDArray[Any]) -> Any:
    """Make an empty dataset that can grow along its first axis, for arrays like `first` (n, ...)."""
    shape = first.shape[1:]
    chunk = max(1, _CHUNK_BYTES // max(1, math.prod(shape) * first.itemsize))
    fill = np.nan if first.dtype.kind == "f" else 0
    made = group.create_dataset(
        name, (0, *shape), first.dtype, maxshape=(None, *shape), chunks=(chunk, *shape), fillvalue=fill
    )
    made.attrs["MATLAB_class"] = np.bytes_(_CLASSES.get(first.dtype.name, first.dtype.name))
    return made
