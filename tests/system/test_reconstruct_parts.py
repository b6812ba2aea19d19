"""A recording that is reconstructed by parts gives the very files of one that is reconstructed in one go."""

import filecmp
import json
from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.depth.knocks import KNOCKED
from rig.errors import UsageError
from rig.run_folder.manifest import RunVerdict

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


@pytest.fixture
def of_dask():
    """The address of a dask scheduler with two workers, each with processes of its own for cases."""
    distributed = pytest.importorskip("distributed")
    options = {"processes": False, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(n_workers=2, **options) as cluster:
        yield {"cluster": cluster.scheduler_address}


@pytest.fixture
def of_this_computer():
    """Two worker processes of this computer."""
    return {"workers": 2}


@pytest.mark.parametrize("whose", ["of_this_computer", "of_dask"])
def test_all_files_of_maps_are_the_same_and_so_are_the_figures(recording, whole, whose, tmp_path, monkeypatch, request):
    monkeypatch.setattr("rig.api.studies.parts.MAPS_OF_A_PART", 2)
    workers = request.getfixturevalue(whose)
    result = api.reconstruct_parts(recording, request=api.ReconstructRequest(out=tmp_path / "parts"), **workers)
    assert result.folder == tmp_path / "parts"
    names = sorted(str(file.relative_to(whole)) for file in whole.glob("*/*"))
    assert len(names) > 8 * MAPS
    assert sorted(str(file.relative_to(result.folder)) for file in result.folder.glob("*/*")) == names
    assert filecmp.cmpfiles(whole, result.folder, names, shallow=False) == (names, [], [])
    one, parts = (json.loads((folder / "summary.json").read_text()) for folder in (whole, result.folder))
    assert {name: one[name] for name in FIGURES} == {name: parts[name] for name in FIGURES}
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (whole, result.folder)]
    for name in ("sweeps", "config", "devices", "calibration"):
        assert manifests[0][name] == manifests[1][name]
    assert list(tmp_path.iterdir()) == [result.folder]


def test_what_needs_the_map_before_is_refused_with_the_reason(recording, tmp_path):
    request = api.ReconstructRequest(out=tmp_path / "parts", estimator="likelihood")
    with pytest.raises(UsageError, match=r"likelihood learns .*, and the scan has kept the states of joint"):
        api.reconstruct_parts(recording, request=request)
    assert not list(tmp_path.iterdir())


def test_a_scheduler_that_does_not_answer_leaves_no_folder(recording, tmp_path):
    request = api.ReconstructRequest(out=tmp_path / "maps")
    with pytest.raises(UsageError, match="no scheduler answers"):
        api.reconstruct_parts(recording, request=request, cluster="tcp://127.0.0.1:9")
    assert not list(tmp_path.iterdir())


def test_a_knock_between_two_parts_is_doubted(recording, tmp_path, monkeypatch):
    monkeypatch.setattr("rig.api.studies.parts.MAPS_OF_A_PART", 2)
    compared = []

    def all_but_the_first(before, after, geometry):
        compared.append((before.x_px, after.x_px, geometry.columns))
        return len(compared) > 1

    monkeypatch.setattr("rig.api.studies.parts.knocked", all_but_the_first)
    result = api.reconstruct_parts(recording, request=api.ReconstructRequest(out=tmp_path / "parts"), workers=2)
    stripes = [np.load(file)["x_px"] for file in sorted((tmp_path / "parts" / "stripe").iterdir())]
    for (before, after, columns), seam in zip(compared, (2, 4), strict=True):
        assert np.array_equal(before, stripes[seam - 1], equal_nan=True)
        assert np.array_equal(after, stripes[seam], equal_nan=True)
        assert columns == before.shape[1]
    assert result.summary.verdict == RunVerdict.DOUBTFUL
    assert {doubt.reason: doubt.maps for doubt in result.summary.verdict_reasons} == {KNOCKED: (4,)}
    assert json.loads((tmp_path / "parts" / "manifest.json").read_text())["verdict"] == "doubtful"
