"""Writes a recording as a photon cube: `frames.npy` for `photoncube`, `visionsim` and `rig reconstruct`, and its JSON.

The array is uint8 (frames, height, ceil(width / 8)), most significant bit first, the frames that were received one
after the other. `frames.json` says what it cannot: clock, numbers and gaps, markers, windows. `transforms.json`, where
there is a camera, makes it a data set of visionsim.
"""

import json
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from calibration.files.npy_files import load_numpy
from calibration.model.camera import Camera
from drivers.frames import FrameBlock
from rig.errors import UsageError
from rig.exchange.frame_log import FrameLog
from rig.exchange.photoncube import SIDECAR_FORMAT, TRANSFORMS
from rig.run_folder.folder import RunFolder, json_text

CUBE: Final = "frames.npy"
_POSE: Final = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
"""Pose for visionsim: the camera does not move, and its own frame is the world's."""


def write_npy(
    blocks: Iterable[FrameBlock], folder: RunFolder, source: Mapping[str, Any], camera: Camera | None
) -> FrameLog:
    """Write the cube of `blocks` and the files beside it. UsageError where the blocks do not make one array."""
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
    """Write the header, which takes the same room for any number of frames (numpy leaves it for arrays that grow)."""
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
    """The maps of a run as `docs/reference/run-folder.md` describes them; a run that only recorded has none."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self.indices = sorted(int(file.stem) for file in run.glob("stripe/*.npz") if file.stem.isdigit())

    def files(self, folder: str, suffix: str) -> list[Path]:
        """Files of one kind, in order of the maps: depth, .npy; intensity, .png; cloud, .ply."""
        return sorted(self._run.glob(f"{folder}/*{suffix}"))

    def arrays(self, index: int) -> dict[str, NDArray[np.float32]]:
        """Stripe table of a map, (rows, columns) each, and its depth_m (height, width) where the rig is calibrated."""
        with load(self._run / "stripe" / f"{index:06d}.npz") as table:
            arrays = dict(table)
        file = self._run / "depth" / f"{index:06d}.npy"
        return {**arrays, "depth_m": load(file)} if file.exists() else arrays


def load(file: Path) -> Any:
    """Load a file with numpy; UsageError, one line, where that fails."""
    try:
        return load_numpy(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"cannot read {file}: {error}; make the maps again with rig reconstruct") from error
