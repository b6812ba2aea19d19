"""A recording that is reconstructed by parts gives the very files of one that is reconstructed in one go."""

import filecmp
import json
from pathlib import Path

import pytest

from rig import api
from rig.errors import UsageError

MAPS = 5
FIGURES = ("maps", "frames", "valid_fraction", "floating_points", "fog", "truth", "verdict", "sync", "time")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "run"
    api.scan("small", maps=MAPS, exposures=3, estimator="joint", record=True, out=out, seed=4)
    return out


@pytest.fixture(scope="module")
def whole(recording, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    api.reconstruct(recording, out=out)
    return out


def test_all_files_of_maps_are_the_same_and_so_are_the_figures(recording, whole, tmp_path, monkeypatch):
    monkeypatch.setattr("rig.api.studies.parts.MAPS_OF_A_PART", 2)
    result = api.reconstruct_parts(recording, request=api.ReconstructRequest(out=tmp_path / "parts"), workers=2)
    assert result.folder == tmp_path / "parts"
    names = sorted(str(file.relative_to(whole)) for file in whole.glob("*/*"))
    assert len(names) > 8 * MAPS
    assert sorted(str(file.relative_to(result.folder)) for file in result.folder.glob("*/*")) == names
    assert filecmp.cmpfiles(whole, result.folder, names, shallow=False) == (names, [], [])
    one, parts = (json.loads((folder / "summary.json").read_text()) for folder in (whole, result.folder))
    assert {name: one[name] for name in FIGURES} == {name: parts[name] for name in FIGURES}
    assert (
        json.loads((whole / "manifest.json").read_text())["sweeps"]
        == json.loads((result.folder / "manifest.json").read_text())["sweeps"]
    )
    assert list(tmp_path.iterdir()) == [result.folder]


def test_what_needs_the_map_before_is_refused_with_the_reason(recording, tmp_path):
    request = api.ReconstructRequest(out=tmp_path / "parts", estimator="likelihood")
    with pytest.raises(UsageError, match=r"likelihood learns .*, and the scan has kept the states of joint"):
        api.reconstruct_parts(recording, request=request)
    assert not list(tmp_path.iterdir())
