"""`pixels.npz`: what is known of a sensor's pixels, with the number of its version, its date and its predecessor.

Arrays as in `PixelMap`, by their names (`dead` is left out where nobody could tell), and `about`, JSON text: format,
version, created, parent, sensor, exposure_s, frames, judged, lit_judged,
ordinary_per_s.
"""

import hashlib
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibration.errors import CalibrationError
from calibration.npy_files import load_numpy
from calibration.pixels.pixel_map import PixelMap

FORMAT: Final = "spadrig-pixels"
_ARRAYS: Final = ("rate_per_s", "rate_sd_per_s", "jump_per_s", "limit_per_s", "hot", "noisy", "defects")
_NEXT: Final = "name a pixels.npz that 'rig calibrate pixels' wrote"


@dataclass(frozen=True, slots=True, eq=False)
class PixelVersion:
    """A map of the pixels in the row of those of its sensor.

    version: 1 for the first. created: ISO 8601 date and time. parent: id of the one that it was compared with. sensor:
    model and serial number, as far as known.
    """

    pixels: PixelMap
    version: int
    created: str
    parent: str | None = None
    sensor: str = ""

    @property
    def id(self) -> str:
        """Sixteen hexadecimal digits that change with its date and any number in it."""
        digest = hashlib.sha256(f"{self.created} {self.version} {self.parent} {self.sensor}".encode())
        for name in _ARRAYS:
            digest.update(np.ascontiguousarray(getattr(self.pixels, name)).tobytes())
        return digest.hexdigest()[:16]


def save_pixels(version: PixelVersion, path: str | os.PathLike[str]) -> None:
    """Write it, whole or not at all. Raises OSError."""
    file, pixels = Path(path), version.pixels
    about = {
        "format": FORMAT,
        "version": version.version,
        "created": version.created,
        "parent": version.parent,
        "sensor": version.sensor,
        "exposure_s": pixels.exposure_s,
        "frames": pixels.frames,
        "judged": pixels.judged,
        "lit_judged": pixels.lit_judged,
        "ordinary_per_s": pixels.ordinary_per_s,
    }
    arrays = {name: getattr(pixels, name) for name in _ARRAYS}
    if pixels.dead is not None:
        arrays["dead"] = pixels.dead
    scratch = file.with_name(f".{file.name}.part")
    with scratch.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)
    scratch.replace(file)


_DAMAGE = (
    ArithmeticError, AttributeError, EOFError, KeyError, RecursionError, TypeError, ValueError, zipfile.BadZipFile,
)  # fmt: skip
"""What reading a file raises that is not as it was written."""


def load_pixels(path: str | os.PathLike[str]) -> PixelVersion:
    """Read one. CalibrationError where there is none."""
    file = Path(path)
    try:
        with load_numpy(file) as archive:
            about: dict[str, Any] = json.loads(str(archive["about"]))
            arrays = {name: archive[name] for name in _ARRAYS}
            dead = archive["dead"] if "dead" in archive.files else None
        if about["format"] != FORMAT or len({array.shape for array in arrays.values()}) != 1:
            raise ValueError(f"'format' is {about['format']!r}")
        pixels = PixelMap(
            **arrays, dead=dead, judged=float(about["judged"]), lit_judged=float(about["lit_judged"]),
            frames=int(about["frames"]), exposure_s=float(about["exposure_s"]),
            ordinary_per_s=float(about["ordinary_per_s"]),
        )  # fmt: skip
        return PixelVersion(pixels, int(about["version"]), str(about["created"]), about["parent"], str(about["sensor"]))
    except OSError as error:
        raise CalibrationError(f"cannot read {file}: {error.strerror or error}; {_NEXT}") from error
    except _DAMAGE as error:
        raise CalibrationError(f"{file} holds no map of pixels ({error}); {_NEXT}") from error
