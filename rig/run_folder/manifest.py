"""The manifest of a run, `manifest.json`. It is sealed with a checksum, since depth depends on its content.

The key `crc32` (the seal) has the CRC-32 (zlib) of all other content, written as JSON without spaces and with sorted
keys. So a digit that changed on the disk is detected, but different line breaks are accepted.
"""

import json
import zlib
from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.json_text import parse_json
from rig.errors import DamagedRecordingError, UsageError

MANIFEST: Final = "manifest.json"
SEAL: Final = "crc32"
UNFINISHED: Final = "recording"
"""Verdict of a run that is not over, or was killed."""
MOST_RUN_FRAMES: Final = 1 << 48
"""A run has fewer frames than this: 89 years at 100 kHz."""
_NEXT: Final = "'rig repair' writes a new one"

Count = Annotated[int, Field(ge=0, lt=MOST_RUN_FRAMES)]
Name = Annotated[str, Field(pattern=r"^[\w-][\w.-]*$")]
"""Name of a file in the run's folder itself: files are copied by it, so it must not lead elsewhere."""
Section = dict[str, Any] | None
Frames = Annotated[list[int], Field(min_length=3, max_length=3)]
RunGap = tuple[int, int, int]
"""Number of the start of the SPAD, and first and last missing frame."""


def package_versions(*names: str) -> dict[str, str]:
    """Versions of the named packages; those that are not installed under that name are left out."""
    return {name: text for name in names if (text := _version_of(name)) is not None}


@cache
def _version_of(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


class RunVerdict(StrEnum):
    """Verdict on a run. Any but `complete` means that the result cannot be trusted as it is."""

    COMPLETE = "complete"
    GAPS = "gaps"
    UNSYNCHRONISED = "unsynchronised"
    DOUBTFUL = "doubtful"
    UNCALIBRATED = "uncalibrated"
    ABORTED = "aborted"

    @property
    def exit_code(self) -> int:
        """Exit code of the command line for this verdict."""
        return {RunVerdict.COMPLETE: 0, RunVerdict.ABORTED: 4}.get(self, 1)


class _Part(BaseModel):
    """The keys of a part of the manifest that commands read. Other keys are allowed."""

    model_config = ConfigDict(strict=True, extra="ignore")


class _Sweep(_Part):
    first_frame: Count
    end_frame: Count
    clock_error: float | None = None
    residual_columns: float | None = None


class _Start(_Part):
    sweeps: Count
    segment: Count


class _Recording(_Part):
    blocks: Count | None = None
    failed: str | None = None
    starts: list[_Start] | None = None


class _Cut(_Part):
    frames: list[Frames] | None = None
    maps: Annotated[list[Count], Field(min_length=2, max_length=2)] | None = None
    clock_ratios: list[float] | None = None


class _Config(_Part):
    name: str | None = None
    world: Section = None
    spad: Section = None
    scanner: Section = None
    laser: Section = None
    sync: Section = None
    scan: Section = None
    estimate: Section = None


class _Calibration(_Part):
    id: str | None = None
    accepted: list[Annotated[list[str], Field(min_length=2, max_length=2)]] | None = None


class _Rig(_Part):
    kinds: dict[str, str] | None = None
    serials: dict[str, str] | None = None


class _OnRequest(_Part):
    parts: list[dict[str, Any]] | None = None


class _Time(_Part):
    starts: list[dict[str, Any]] | None = None


class _Manifest(_Part):
    """The form of the manifest, as far as commands read it. A device's own counts are checked by `device_counters`."""

    verdict: str = ""
    maps: int | None = None
    config: _Config | None = None
    calibration: _Calibration | None = None
    rig: _Rig | None = None
    devices: dict[str, dict[str, Any]] | None = None
    versions: dict[str, str] | None = None
    inputs: dict[Name, Count] | None = None
    counters: Section = None
    recording: _Recording | None = None
    sweeps: list[_Sweep] | None = None
    time: _Time | None = None
    cut: _Cut | None = None
    missing: list[Frames] | None = None
    repaired: list[Any] | None = None
    request: Section = None
    on_request: _OnRequest | None = None
    note: str | None = None
    tags: list[str] | None = None


def sealed_text(text: str) -> str:
    """The text of a manifest, which must be strict JSON, with the seal added."""
    content = json.loads(text)
    return json.dumps({**content, SEAL: manifest_crc32(content)}, indent=1, ensure_ascii=False)


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Read the manifest of a run without its seal; None if there is none. Raises DamagedRecordingError if it is damaged
    or cannot be read.
    """
    try:
        raw = (folder / MANIFEST).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DamagedRecordingError(f"{folder / MANIFEST} cannot be read: {error.strerror or error}") from error
    try:
        content = parse_json(raw)
    except ValueError as error:
        raise DamagedRecordingError(f"{MANIFEST} is no JSON any more: {str(error).splitlines()[0]}; {_NEXT}") from None
    if not isinstance(content, dict) or content.get(SEAL) != manifest_crc32(content):
        raise DamagedRecordingError(f"{MANIFEST} is not as it was written, its checksum does not fit; {_NEXT}")
    try:
        _Manifest.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise DamagedRecordingError(f"{MANIFEST}: {place} cannot be so: {first['msg']}; {_NEXT}") from None
    del content[SEAL]
    return content


def is_cut_short(manifest: Mapping[str, Any]) -> bool:
    """Whether frames after the first maps may be missing: the recording ended before the run, or was repaired."""
    return "repaired" in manifest or ended_early(manifest) is not None


def ended_early(manifest: Mapping[str, Any]) -> str | None:
    """Reason why a recording ended before its run, such as a full disk; None if it did not, and after a repair."""
    if "repaired" in manifest:
        return None
    failed = (manifest.get("recording") or {}).get("failed")
    return None if failed is None else str(failed)


def ended_before_last_map(manifest: Mapping[str, Any]) -> bool:
    """Whether a run ended before it had made maps of all sweeps, so that whole sweeps may follow those listed."""
    starts = (manifest.get("recording") or {}).get("starts") or []
    return len(manifest.get("sweeps") or []) < sum(int(start["sweeps"]) for start in starts)


def known_missing(manifest: Mapping[str, Any] | None) -> list[RunGap] | None:
    """Frames that a repair noted as missing; None without a repair or without a manifest."""
    if manifest is None or "repaired" not in manifest:
        return None
    return [(int(run), int(first), int(last)) for run, first, last in manifest.get("missing") or []]


def device_counters(manifest: Mapping[str, Any]) -> tuple[dict[str, int], list[str]]:
    """The SPAD's own counts of a run's frames that have possible values, and a line for each of the others."""
    counters = {key: value for key, value in (manifest.get("counters") or {}).items() if value is not None}
    sane = {key: value for key, value in counters.items() if isinstance(value, int) and 0 <= value < MOST_RUN_FRAMES}
    return sane, [
        f"{MANIFEST}: the device's count '{key}' is {value}, which cannot be"
        for key, value in counters.items()
        if key not in sane
    ]


def file_crc32(path: Path) -> int:
    """CRC-32 of a file, for the manifest. Raises OSError if it cannot be read, or is something else, such as a pipe,
    which may have no end."""
    if path.exists() and not path.is_file():
        raise OSError(f"{path.name} is no file")
    crc = 0
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            crc = zlib.crc32(piece, crc)
    return crc


def inputs_problems(folder: Path, manifest: Mapping[str, Any]) -> list[str]:
    """Lines on the files beside the frames that differ from what the manifest says or cannot be read."""
    problems = []
    for name, stated in (manifest.get("inputs") or {}).items():
        try:
            if file_crc32(folder / name) != stated:
                problems.append(f"{name} is not as it was written, its checksum does not fit")
        except OSError as error:
            problems.append(f"{name} cannot be read: {error.strerror or error}")
    return problems


def require_playable(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Raise DamagedRecordingError, with one line each, for files beside the frames that cannot be read or differ
    from what the manifest says.

    Raises UsageError for an adaptive recording (`passes` in the manifest): each of its maps was put together from
    several partial sweeps.
    """
    if problems := inputs_problems(folder, manifest):
        raise DamagedRecordingError("\n".join(f"{line}; take it from a copy of the recording" for line in problems))
    if "passes" in manifest:
        raise UsageError(
            f"{folder} was scanned adaptively, in passes that this version cannot put together; scan again"
        )


def manifest_crc32(content: Mapping[str, Any]) -> int:
    """The CRC-32 that a manifest's seal must have. content: with or without the seal."""
    bare = {key: value for key, value in content.items() if key != SEAL}
    return zlib.crc32(json.dumps(bare, sort_keys=True, separators=(",", ":")).encode())
