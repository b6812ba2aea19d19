"""The example recording (`rig example`): small, the same for everybody, and made in seconds.

It is made instead of shipped, so that no binary file is needed. Its frames are drawn with a fixed seed; a digest says
whether they are the very bits that the documentation speaks of.
"""

import hashlib
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rig.api.scans import scan
from rig.config.overrides import PathLike
from rig.recording.cut import cut
from rig.recording.open import open_recording

RIG: Final = "small"
"""The bundled rig that takes it."""
SEED: Final = 1
SHA256: Final = "fc06215f8f192530a360886411df38e4f43442787ce75b55f462899401ce3099"
"""Digest of all frames in order: of the records and of the packed pixels of each block. Another processor or library
may round a light level differently, and then some photons fall elsewhere: the recording is as good, but another one."""


@dataclass(frozen=True, slots=True)
class ExampleRecording:
    """The recording in `folder`. bytes: size of all its files. sha256: digest of its frames. as_published: whether that
    is SHA256, the digest that the documentation states."""

    folder: Path
    frames: int
    bytes: int
    sha256: str
    as_published: bool

    def as_json(self) -> dict[str, Any]:
        """The fields as plain values."""
        return asdict(self) | {"folder": str(self.folder)}


def example_recording(out: PathLike) -> ExampleRecording:
    """Make the example recording: the frames of one map of the bundled rig RIG, less than 1 MB (`rig example`).

    out: folder to make. Raises UsageError if it cannot be written.
    """
    folder = Path(out)
    with tempfile.TemporaryDirectory(prefix="spadrig-example-") as scratch:
        scan(RIG, seed=SEED, estimator="argmax", record=True, out=Path(scratch) / "whole").uninterrupted()
        cut(Path(scratch) / "whole", folder, maps="0:1")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    frames, digest = frames_digest(folder)
    return ExampleRecording(folder, frames, size, digest, digest == SHA256)


def frames_digest(run: PathLike) -> tuple[int, str]:
    """Number of frames of a recording, and the SHA-256 of their records and pixels, whatever blocks they are in."""
    recording = open_recording(Path(run))
    records, pixels = hashlib.sha256(), hashlib.sha256()
    for each in recording.runs:
        for block in recording.blocks(each):
            records.update(block.records.tobytes())
            pixels.update(block.bits.tobytes())
    return recording.frames, hashlib.sha256(records.digest() + pixels.digest()).hexdigest()
