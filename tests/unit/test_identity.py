"""The identity check finds a single changed bit, and nothing where only containers or moments changed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.reference.identity import Results, bound_frames, differences, folder_hashes

DEPTH_M = np.array([[1.5, np.nan], [2.5, 0.0]], np.float32)
SUMMARY = {"maps": 1, "truth": {"median_abs": 0.1}, "compute_time_s": 3.0, "stages": {"counting_s": 1.0}}


def results(folder: Path, *, summary: dict[str, Any] = SUMMARY, **members: np.ndarray) -> Results:
    """Hashes of a run folder with one map, as one step of one case."""
    for part in ("depth", "stripe"):
        (folder / part).mkdir(parents=True)
    np.save(folder / "depth" / "000000.npy", members.pop("depth_m", DEPTH_M))
    np.savez(folder / "stripe" / "000000.npz", **({"x_px": np.arange(4.0), "confidence": np.ones(4)} | members))
    (folder / "summary.json").write_text(json.dumps(summary))
    return {"fog": {"edge": folder_hashes(folder)}}


def flipped(array: np.ndarray, index: int) -> np.ndarray:
    """The array with the lowest bit of one number changed."""
    changed = array.copy()
    changed.reshape(-1).view(f"u{array.itemsize}")[index] ^= 1
    return changed


@pytest.mark.parametrize("index", [0, 1, 3], ids=["number", "NaN", "zero"])
def test_a_changed_bit_of_the_depth_is_found(tmp_path: Path, index: int) -> None:
    before, now = results(tmp_path / "a"), results(tmp_path / "b", depth_m=flipped(DEPTH_M, index))
    assert differences(before, now) == ["fog, edge, depth/000000.npy differs"]


def test_a_changed_bit_or_type_of_a_member_is_found_by_its_name(tmp_path: Path) -> None:
    before = results(tmp_path / "a")
    now = results(tmp_path / "b", x_px=flipped(np.arange(4.0), 2), confidence=np.ones(4, np.float32))
    assert differences(before, now) == [
        "fog, edge, stripe/000000.npz:confidence differs",
        "fog, edge, stripe/000000.npz:x_px differs",
    ]


def test_moments_and_the_bytes_of_containers_do_not_count(tmp_path: Path) -> None:
    before = results(tmp_path / "a")
    now = results(tmp_path / "b", summary=SUMMARY | {"compute_time_s": 4.0, "stages": {}})
    folder = tmp_path / "b"
    np.savez_compressed(folder / "stripe" / "000000.npz", confidence=np.ones(4), x_px=np.arange(4.0))
    assert differences(before, {"fog": {"edge": folder_hashes(folder)}}) == differences(before, now) == []
    again = results(tmp_path / "c", summary=SUMMARY | {"truth": {"median_abs": 0.10000000000000002}})
    assert differences(before, again) == ["fog, edge, summary.json:truth differs"]


def test_frames_count_up_to_the_closing_marker_whenever_a_start_was() -> None:
    def frames(first_tick: int, behind: int) -> dict[str, np.ndarray]:
        """Two starts with 5 frames of a sweep each and some behind the marker that closes it, which is in frame 5."""
        number = np.concatenate([np.arange(6 + behind), np.arange(6)])
        run_id = np.repeat([4, 5], [6 + behind, 6])
        ticks = 10 * number + np.where(run_id == 5, first_tick, 0)
        return {"number": number, "run": run_id, "ticks": ticks, "bits": number * 3, "time_s": ticks / 1e6}

    manifest = {"sweeps": [{"end_frame": 5}] * 2, "recording": {"starts": [{"sweeps": 1}, {"sweeps": 1}]}}
    early, late = (bound_frames(frames(*each), manifest) for each in ((70, 0), (1000, 8)))
    assert early.keys() == late.keys() == {"number", "run", "ticks", "bits"}
    assert all(np.array_equal(early[name], late[name]) for name in early)
    assert early["number"].tolist() == [*range(6), *range(6)]
    assert early["ticks"].tolist() == [*range(0, 60, 10)] * 2


def test_what_is_missing_and_what_is_new_is_said_and_how_commands_ended() -> None:
    before: Results = {"fog": {"joint": {"exit code": "0", "depth/000000.npy": "aa"}}, "clear": {"edge": {"a": "1"}}}
    now: Results = {"fog": {"joint": {"exit code": "70: ValueError"}}, "clear": {"edge": {"a": "1", "b": "2"}}}
    assert differences(before, now) == [
        "clear, edge, b is new",
        "fog, joint, depth/000000.npy is missing",
        "fog, joint, exit code differs (0 before, 70: ValueError now)",
    ]
    assert differences(before, {})[0] == "clear, edge, a is missing"
