"""The maps in a run's folder: which there are, and their arrays."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.npy_files import load_numpy
from rig.errors import UsageError


class MapFiles:
    """The maps of a run as `docs/run-folder.md` describes them; a run that only recorded has none."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self.indices = sorted(int(file.stem) for file in run.glob("stripe/*.npz") if file.stem.isdigit())

    def files(self, folder: str, suffix: str) -> list[Path]:
        """Files of one sort, in order of the maps: depth, .npy; intensity, .png; cloud, .ply."""
        return sorted(self._run.glob(f"{folder}/*{suffix}"))

    def depth_m(self, index: int) -> NDArray[np.float32] | None:
        """float32 (height, width); None of an uncalibrated rig."""
        file = self._run / "depth" / f"{index:06d}.npy"
        return load(file) if file.exists() else None

    def stripe(self, index: int) -> Mapping[str, NDArray[np.float32]]:
        """The stripe table, float32 (rows, columns) each."""
        with load(self._run / "stripe" / f"{index:06d}.npz") as table:
            return {name: table[name] for name in table.files}


def load(file: Path) -> Any:
    """What numpy loads of `file`; UsageError, one line, where it cannot."""
    try:
        return load_numpy(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"cannot read {file}: {error}; make the maps again with rig reconstruct") from error
