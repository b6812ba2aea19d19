"""Folders of runs as the page shows them: with and without recording, without maps, imported, damaged."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.errors import UsageError
from rig.view.run_source import RunSource
from tests.system.small_rig import HEIGHT, config, write_rig


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    api.scan(write_rig(folder / "rig"), maps=2, out=folder / "run", record=True)
    return folder / "run"


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "run"))


def test_a_recorded_run_has_maps_rays_worth_and_rows(recorded: Path) -> None:
    source = RunSource(recorded)
    assert (source.numbers, source.notes, source.recorded) == ([0, 1], [], True)
    shown = source.map(1)
    assert shown.depth_m is not None
    np.testing.assert_array_equal(shown.depth_m, np.load(recorded / "depth" / "000001.npy"))
    assert shown.rays is not None
    assert np.isfinite(shown.rays[0]).all()
    assert shown.confidence is not None
    assert shown.depth_sd_m is not None
    known = np.isfinite(shown.depth_m)
    assert (shown.confidence[known] >= 0.5).all()
    assert (shown.depth_sd_m[known] > 0).all()
    assert shown.picture_of_counts == (recorded / "intensity" / "000001.png").read_bytes()
    row = source.row(1, 7)
    assert row is not None
    assert shown.counts is not None
    np.testing.assert_array_equal(row.counts.sum(axis=0)[known[7]], shown.counts[7][known[7]])
    assert source.row(1, HEIGHT) is None


def test_the_fog_of_every_map_is_kept_and_of_older_runs_that_of_the_last(run: Path, tmp_path: Path) -> None:
    assert [number for number, _ in RunSource(run).fog] == [0, 1]
    foggy = tmp_path / "foggy"
    scene = {"scene": "street", "estimator": "likelihood", "exposures": 8}
    api.scan(write_rig(tmp_path / "rig"), maps=2, out=foggy, **scene)
    summary = json.loads((foggy / "summary.json").read_text())
    (first, of_first), (last, of_last) = RunSource(foggy).fog
    assert (first, last) == (0, 1)
    assert of_last == summary["fog"]
    assert of_first.keys() == of_last.keys()
    (foggy / "manifest.json").unlink()
    assert RunSource(foggy).fog == [(1, summary["fog"])]


def test_without_the_recording_rays_come_from_the_points_and_there_are_no_rows(run: Path) -> None:
    whole = RunSource(run).map(0)
    for file in run.glob("frames*"):
        file.unlink()
    source = RunSource(run)
    assert not source.recorded
    assert source.notes == ["The frames of this run were not recorded, so there are no counts of rows."]
    shown = source.map(0)
    assert shown.depth_m is not None
    assert shown.rays is not None
    assert whole.rays is not None
    known = np.isfinite(shown.depth_m)
    for ours, true in zip(shown.rays, whole.rays, strict=True):
        np.testing.assert_allclose(ours[known], true[known], atol=1e-5)
        assert np.isnan(ours[~known]).all()
    assert source.row(0, 3) is None


def test_a_run_that_kept_only_the_confidence_of_stripes_shows_that(run: Path) -> None:
    shutil.rmtree(run / "confidence")
    shown = RunSource(run).map(0)
    assert shown.depth_m is not None
    assert shown.confidence is not None
    known = np.isfinite(shown.depth_m)
    assert (shown.confidence[known] >= 0.5).all()
    assert not shown.confidence[~known].any()
    assert shown.depth_sd_m is None


def test_a_recording_without_maps_shows_the_counts_of_each(run: Path) -> None:
    for name in ("stripe", "depth", "cloud", "intensity", "confidence"):
        shutil.rmtree(run / name)
    source = RunSource(run)
    assert source.numbers == [0, 1]
    shown = source.map(0)
    assert shown.depth_m is None
    assert shown.counts is not None
    row = source.row(0, 5)
    assert row is not None
    np.testing.assert_array_equal(shown.counts[5], row.counts.sum(axis=0))


def test_an_uncalibrated_run_has_stripes_without_depth(tmp_path: Path) -> None:
    content = config()
    content.pop("calibration")
    api.scan(write_rig(tmp_path / "rig", content), maps=1, out=tmp_path / "run", record=True)
    source = RunSource(tmp_path / "run")
    assert source.notes == ["No depth: the rig was not calibrated when this was recorded."]
    shown = source.map(0)
    assert shown.depth_m is None
    assert shown.column_at(10, 40) is not None
    assert source.row(0, 10) is not None


def test_imported_frames_are_summed_and_say_how_to_get_depth(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).random((2500, 8, 32)) < 0.1
    np.save(tmp_path / "frames.npy", np.packbits(frames, axis=2))
    api.import_frames("photoncube", [tmp_path / "frames.npy"], tmp_path / "run")
    source = RunSource(tmp_path / "run")
    assert source.numbers == [0, 1]
    assert not source.recorded
    assert "no columns, so there is no depth" in source.notes[0]
    assert f"rig reconstruct {tmp_path / 'run'} --plan PLAN --calibration CALIBRATION" in source.notes[0]
    shown = source.map(1)
    assert shown.counts is not None
    np.testing.assert_array_equal(shown.counts, frames[1000:2000].sum(axis=0))
    row = source.row(1, 3)
    assert row is not None
    np.testing.assert_array_equal(row.counts[0], frames[1000:2000, 3].sum(axis=0))
    assert source.row(1, 8) is None


def test_exported_frames_are_no_run(recorded: Path, tmp_path: Path) -> None:
    api.export_run(recorded, "npy", out=tmp_path / "cube")
    with pytest.raises(UsageError, match=r"cube is a folder without a recording"):
        RunSource(tmp_path / "cube")


def test_a_damaged_recording_leaves_the_maps_and_says_so(run: Path) -> None:
    (run / "plan.yaml").write_text("nothing")
    source = RunSource(run)
    assert source.numbers == [0, 1]
    assert source.row(0, 0) is None
    assert len(source.notes) == 1
    assert "cannot be read, so there are no counts of rows" in source.notes[0]


def test_a_damaged_manifest_and_summary_are_told_and_the_maps_shown(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps({**manifest, "seed": 99}))
    (run / "summary.json").write_text("[1")
    for file in run.glob("frames*"):
        file.unlink()
    source = RunSource(run)
    assert "checksum does not fit" in source.notes[0]
    assert source.summary == {}
    assert source.map(0).depth_m is not None


def test_a_map_whose_file_is_cut_short_is_named(run: Path) -> None:
    file = run / "stripe" / "000001.npz"
    file.write_bytes(file.read_bytes()[:100])
    source = RunSource(run)
    with pytest.raises(UsageError, match=r"cannot read .*000001\.npz"):
        source.map(1)
    assert source.map(0).depth_m is not None


def test_a_picture_that_cannot_be_read_is_named(run: Path) -> None:
    file = run / "intensity" / "000001.png"
    file.unlink()
    file.mkdir()
    with pytest.raises(UsageError, match=r"cannot read .*000001\.png"):
        RunSource(run).map(1)


@pytest.mark.parametrize("name", ["nowhere", "empty", "file"])
def test_what_is_no_run_is_refused_with_the_next_step(name: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"name the folder of a run"):
        RunSource(tmp_path / name)
