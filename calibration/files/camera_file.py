"""The file of a camera alone, which a calibration of the light planes can begin with.

format: spadrig-camera
version: 1
camera: {width, height, matrix, distortion}              # as in a calibration file
covariance: {names: [fx, fy, ...], matrix: [[...]]}      # how well that is known
views: [16 hexadecimal digits, ...]                      # corners it was made of: they must not count twice
verdict: passed or failed                                # left out: nobody judged it
reasons: [too-few-poses, ...]                            # why it failed, by their codes
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from calibration.files.sections import CameraSection, FileSection, Number, read_yaml_file
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance
from calibration.verdict import Verdict, VerdictWord
from calibration.views import View

CAMERA_FORMAT = "spadrig-camera"
CAMERA_VERSION = 1
CORNERS = "corners"
"""Key in the provenance of a rig's calibration: digests of the views it was made of, those of its camera too."""


class _CovarianceRows(FileSection):
    names: list[str]
    matrix: list[list[Number]]


class _CameraFile(FileSection):
    format: Literal["spadrig-camera"]
    version: Literal[1]
    camera: CameraSection
    covariance: _CovarianceRows
    views: tuple[str, ...] = ()
    verdict: VerdictWord | None = None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """A camera, how well it is known, the digests of the views that told it, its verdict (None: nobody judged it)."""

    camera: Camera
    covariance: Covariance
    views: frozenset[str]
    verdict: VerdictWord | None = None
    reasons: tuple[str, ...] = ()


def load_camera(path: Path) -> KnownCamera:
    """Read a camera file. Raises CalibrationError, one line."""
    parsed = read_yaml_file(path, "a camera", CAMERA_FORMAT, CAMERA_VERSION, _CameraFile)
    covariance = Covariance(tuple(parsed.covariance.names), np.array(parsed.covariance.matrix, dtype=np.float64))
    camera, views = build_camera(parsed.camera), frozenset(parsed.views)
    return KnownCamera(camera, covariance, views, parsed.verdict, parsed.reasons)


def camera_file_text(camera: Camera, covariance: Covariance, views: list[str], verdict: Verdict) -> str:
    """The text of a camera file."""
    content: dict[str, Any] = {
        "format": CAMERA_FORMAT,
        "version": CAMERA_VERSION,
        "camera": camera_content(camera),
        "covariance": {"names": list(covariance.names), "matrix": covariance.matrix.tolist()},
        "views": views,
        "verdict": verdict.word,
    }
    if verdict.reasons:
        content["reasons"] = list(verdict.codes)
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def corners_digest(view: View) -> str:
    """Sixteen hexadecimal digits of a view's corners; of none where it has none."""
    digest = hashlib.sha256()
    if view.corners is not None:
        digest.update(np.ascontiguousarray(view.corners.ids, "<i4").tobytes())
        digest.update(np.ascontiguousarray(view.corners.px, "<f8").tobytes())
    return digest.hexdigest()[:16]


def camera_content(camera: Camera) -> dict[str, Any]:
    """The `camera` section of a file."""
    return {
        "width": camera.width,
        "height": camera.height,
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
    }


def build_camera(section: CameraSection) -> Camera:
    """The camera of such a section. CalibrationError where its numbers describe none."""
    return Camera(
        width=section.width,
        height=section.height,
        matrix=np.array(section.matrix, dtype=np.float64),
        distortion=np.array(section.distortion, dtype=np.float64),
    )
