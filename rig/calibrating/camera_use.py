"""Whether the camera of `rig calibrate camera` may go into a calibration of the planes, by its verdict."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.files.camera_file import KnownCamera, load_camera
from rig.calibration_refusals import Refusal, check_content, failed_verdict, require_accepted


@dataclass(frozen=True, slots=True)
class CameraUse:
    """A camera that is known from elsewhere. accepted: what it was used in spite of."""

    known: KnownCamera
    accepted: tuple[Refusal, ...] = ()

    def content(self) -> dict[str, Any]:
        """For the provenance of what is made with it."""
        return check_content("unchecked" if self.known.verdict is None else "passed", self.accepted)


def camera_use(file: Path, *, accept: bool = False) -> CameraUse:
    """Read a camera file. UsageError where its verdict failed, unless `accept`; one that says nothing of a verdict, as
    written by hand or of old, is used unchecked. Raises CalibrationError where it cannot be read."""
    known = load_camera(file)
    found = failed_verdict(known.verdict, known.reasons)
    require_accepted(f"camera {file}", found, {each.code for each in found} if accept else ())
    return CameraUse(known, tuple(found))
