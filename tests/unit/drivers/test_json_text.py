"""JSON that nests too deep or counts too far is damage like any other, for whatever reads it."""

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.pixel_map import load_pixels
from drivers.errors import ProtocolError
from drivers.json_text import MAX_DEPTH, parse_json
from drivers.replay.spad import recorded_device
from drivers.transports.tap import read_taps
from rig.calibrate.session import session_rig
from rig.errors import DamagedRecordingError, UsageError
from rig.run_folder.manifest import read_manifest

DEEP = "[" * 100_000 + "]" * 100_000
LARGE = f'{{"a": {"9" * 400}}}'


def test_json_is_read_as_it_is_within_limits() -> None:
    nested = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    assert json.dumps(parse_json(nested)) == nested
    assert parse_json(b'{"a": [18446744073709551615, -9223372036854775808, 1.5, null]}') == {
        "a": [2**64 - 1, -(2**63), 1.5, None]
    }


@pytest.mark.parametrize(
    "text",
    [
        DEEP,
        "[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1),
        LARGE,
        "9" * 5000,
        "{",
        "",
        "NaN",
        "-Infinity",
        "1e999",
        r'{"\u001b[2J": 1}',
        r'[{"a\nb": 1}]',
        r'["\ud800"]',
    ],
)
def test_anything_else_is_a_value_error_of_one_line(text: str) -> None:
    with pytest.raises(ValueError) as refused:
        parse_json(text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", [DEEP, LARGE], ids=["deep", "large"])
def test_every_file_of_json_is_read_within_limits(tmp_path: Path, text: str) -> None:
    for name in ("manifest.json", "rig.json", "control.jsonl"):
        (tmp_path / name).write_text(text + "\n")
    np.savez(tmp_path / "pixels.npz", about=np.array(text))
    with pytest.raises(DamagedRecordingError, match="'rig repair'"):
        read_manifest(tmp_path)
    with pytest.raises(ProtocolError, match="'rig repair'"):
        recorded_device(tmp_path, "spad")
    with pytest.raises(ProtocolError, match="line 1 is not as it was written"):
        read_taps(tmp_path / "control.jsonl")
    with pytest.raises(UsageError, match="remove it"):
        session_rig(tmp_path)
    with pytest.raises(CalibrationError, match="holds no map of pixels"):
        load_pixels(tmp_path / "pixels.npz")
