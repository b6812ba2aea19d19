"""What the devices of a recording said of themselves: from its manifest, or as far as the frames themselves tell."""

from fractions import Fraction
from pathlib import Path
from typing import Any

from drivers.errors import ProtocolError
from drivers.frames import BlockFlag, frame_bytes
from drivers.interfaces import BurstMode, SpadInfo, StreamMode
from drivers.json_text import parse_json
from drivers.recorded import RunRecording

MANIFEST = "manifest.json"


def recorded_device(recording: Path, slot: str) -> dict[str, Any] | None:
    """What the manifest of a recording notes of a device; None where there is no manifest or nothing in it.

    `ProtocolError` where the manifest cannot be read.
    """
    file = recording / MANIFEST
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise ProtocolError(f"{file} cannot be read ({error}); 'rig repair' writes it anew") from None
    devices = content.get("devices") if isinstance(content, dict) else None
    device = devices.get(slot) if isinstance(devices, dict) else None
    return device if isinstance(device, dict) else None


def recorded_info(recording: RunRecording) -> SpadInfo:
    """Of the SPAD that took the frames; only that a recording can always wait."""
    noted = recorded_device(recording.path, "spad")
    told = _told_by(recording)
    if noted is None:
        return told
    try:
        info = _read(noted["info"])
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise ProtocolError(
            f"{recording.path / MANIFEST}: devices.spad.info is no description of a SPAD ({error!r}); "
            "'rig repair' writes the manifest anew"
        ) from None
    if (info.width, info.height) != (told.width, told.height):
        raise ProtocolError(
            f"{recording.path / MANIFEST} is of a SPAD of {info.width} x {info.height} pixels, the frames are of one "
            f"of {told.width} x {told.height}; the manifest belongs to another recording"
        )
    return info


def _read(noted: dict[str, Any]) -> SpadInfo:
    """As the manifest has it."""
    return SpadInfo(
        model=str(noted["model"]),
        serial=str(noted["serial"]),
        width=int(noted["width"]),
        height=int(noted["height"]),
        rotation_deg=int(noted["rotation_deg"]),
        max_frame_rate_hz=Fraction(noted["max_frame_rate_hz"]),
        burst=None if noted["burst"] is None else BurstMode(**noted["burst"]),
        stream=None if noted["stream"] is None else StreamMode(**noted["stream"]),
        roi_step_px=int(noted["roi_step_px"]),
        markers=bool(noted["markers"]),
        trigger_modes=tuple(noted["trigger_modes"]),
        can_wait=True,
    )


def _told_by(recording: RunRecording) -> SpadInfo:
    """What the blocks alone say."""
    first = recording.runs[0].header
    rate = first.tick_hz / (first.frame_period_ticks or max(1, first.exposure_ticks))
    most = max(run.end_frame for run in recording.runs)
    link = float(rate) * frame_bytes(first.sensor_width, first.sensor_height)
    burst = bool(first.flags & BlockFlag.BURST)
    return SpadInfo(
        model="recorded",
        serial=recording.path.name,
        width=first.sensor_width,
        height=first.sensor_height,
        rotation_deg=0,
        max_frame_rate_hz=rate,
        burst=BurstMode(most, link) if burst else None,
        stream=None if burst else StreamMode(link),
        roi_step_px=64,
        markers=any(bool(run.entries["sweep"].any()) for run in recording.runs),
        trigger_modes=(),
        can_wait=True,
    )
