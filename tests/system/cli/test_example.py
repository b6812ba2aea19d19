"""The example recording: small, made in one command, verified, and the same bits each time."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rig.api.example import SHA256, frames_digest
from tests.system.conftest import Rig


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


def test_it_is_below_a_megabyte_verified_replayed_and_has_its_published_checksum(rig: Rig, kept: Path) -> None:
    made = json.loads(rig("example", "--out", "example", "--json").out)
    assert made["bytes"] < 1e6
    assert made["frames"] == 691
    assert made["as_published"] == (made["sha256"] == SHA256)
    assert (made["frames"], made["sha256"]) == frames_digest("example")
    verified = rig("verify", "example", "--json")
    assert (verified.code, json.loads(verified.out)["verdict"]) == (0, "intact")
    ran = rig("replay", "example", "--clock", "max", "--estimator", "argmax", "--out", "again")
    assert ran.code == 0
    assert np.isfinite(np.load("again/depth/000000.npy")).mean() > 0.2
    shutil.copytree("example", kept / "example")


def test_made_again_it_has_the_same_bits_and_a_changed_bit_is_found(rig: Rig, kept: Path) -> None:
    made = rig("example", "--out", "again")
    assert made.out.split()[-1] == frames_digest(kept / "example")[1]
    assert frames_digest("again")[1] == made.out.split()[-1]
    segment = Path("again/frames-000000.spb")
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(data)
    assert rig("verify", "again").code == 1


def test_a_folder_that_is_taken_is_refused(rig: Rig) -> None:
    Path("example").mkdir()
    Path("example/mine.txt").write_text("")
    assert rig("example").problems == [
        f"error: --out {Path('example').absolute()} exists and is not empty; name a new folder or empty this one"
    ]
