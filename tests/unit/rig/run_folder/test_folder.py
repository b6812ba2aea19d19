"""The run folder: whole or not there, and files that other programs can read."""

import json
import shutil
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.interfaces import SweepTruth
from drivers.recorded import RunRecording
from rig.depth.depth import DepthMap
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.errors import UsageError
from rig.geometry.stripe_table import StripeTable
from rig.recording.writer import Recording
from rig.run_folder.folder import RunFolder
from rig.run_folder.pictures import SCALE_PX
from rig.run_folder.plain_json import json_text
from tests.unit.rig.recording.recorded import run_blocks

ROWS, WIDTH, COLUMNS = 40, 60, 7


def a_map(depth: float = 2.0) -> MapResult:
    depth_m = np.full((ROWS, WIDTH), depth, np.float32)
    depth_m[:, 30:] *= 2
    depth_m[5:9, 10:20] = np.nan
    intensity = np.arange(ROWS * WIDTH, dtype=np.uint32).reshape(ROWS, WIDTH)
    known = DepthMap(depth_m, np.isfinite(depth_m).astype(np.float32), depth_m / 100)
    return MapResult(StripeTable.empty(ROWS, COLUMNS), *known, intensity, FogEstimate(None, None, None), 0.1)


def rays() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:ROWS, :WIDTH]
    return (x - 29.5) / 100, (y - 19.5) / 100


def published(out: Path, *maps: MapResult) -> Path:
    """A run folder of these maps."""
    with RunFolder(out) as folder:
        for index, result in enumerate(maps):
            folder.write_map(index, result, rays())
        return folder.publish()


def read_ply(file: Path) -> np.ndarray:
    """A reader that knows PLY, not our writer."""
    data = file.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex")]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    values = np.frombuffer(body, "<f4").reshape(count, len(names))
    return np.rec.fromarrays(values.T, names=names)  # type: ignore[call-overload,no-any-return]


def test_a_map_is_written_in_formats_others_read(tmp_path: Path) -> None:
    result = a_map()
    with RunFolder(tmp_path / "run") as folder:
        folder.write_map(3, result, rays())
        folder.write_truth(3, SweepTruth(result.stripe.x_px, result.depth_m))
        folder.write_json("summary.json", {"maps": 1})
        assert not (tmp_path / "run").exists()
        assert folder.publish() == tmp_path / "run"
    run = tmp_path / "run"
    depth = np.load(run / "depth/000003.npy", allow_pickle=False)
    assert depth.dtype == np.float32
    assert np.array_equal(depth, result.depth_m, equal_nan=True)
    with np.load(run / "stripe/000003.npz", allow_pickle=False) as table:
        stripe = dict(table)
    assert {stripe[key].shape for key in ("x_px", "confidence", "x_sd_px", "signal", "haze")} == {(ROWS, COLUMNS)}
    with np.load(run / "truth/000003.npz") as truth:
        assert set(truth) == {"x_px", "depth_m"}
    points = read_ply(run / "cloud/000003.ply")
    known = np.isfinite(depth)
    assert len(points) == known.sum()
    u, v = rays()
    assert np.allclose(points["z"], depth[known])
    assert np.allclose(points["x"], u[known] * depth[known], atol=1e-6)
    assert np.allclose(points["y"], v[known] * depth[known], atol=1e-6)
    assert np.array_equal(points["intensity"], result.intensity[known])
    assert {file.name for file in tmp_path.iterdir()} == {"run"}


def test_the_depth_picture_is_black_where_there_is_no_depth_and_bright_where_it_is_near(tmp_path: Path) -> None:
    run = published(tmp_path / "run", a_map())
    picture = cv2.imread(str(run / "depth/000000.png"))
    assert picture.shape == (ROWS, WIDTH + SCALE_PX, 3)
    assert not picture[5:9, 10:20].any()
    near, far = picture[20, 10].astype(int), picture[20, 50].astype(int)
    assert near.sum() > far.sum() + 200 > 300
    assert picture[:, WIDTH:].any()
    worth = np.load(run / "confidence/000000.npz")
    np.testing.assert_array_equal(worth["confidence"] > 0, picture[:, :WIDTH].any(axis=2))
    np.testing.assert_allclose(worth["depth_sd_m"][20, [10, 50]], [0.02, 0.04], rtol=1e-3)
    sure = cv2.imread(str(run / "confidence/000000.png"))
    assert sure.shape == picture.shape
    np.testing.assert_array_equal(sure[:, :WIDTH].any(axis=2), picture[:, :WIDTH].any(axis=2))
    grey = cv2.imread(str(run / "intensity/000000.png"), cv2.IMREAD_UNCHANGED)
    assert (grey.shape, grey.dtype) == ((ROWS, WIDTH), np.uint8)


def test_all_maps_share_the_colours_of_the_first_and_one_without_depth_is_written_all_the_same(tmp_path: Path) -> None:
    run = published(tmp_path / "run", a_map(2.0), a_map(1.9), a_map(float("nan")))
    scales = [cv2.imread(str(run / f"depth/00000{i}.png"))[:, WIDTH:] for i in (0, 1)]
    assert np.array_equal(*scales)
    assert len(read_ply(run / "cloud/000002.ply")) == 0


def test_an_uncalibrated_map_has_no_depth_files(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as folder:
        folder.write_map(0, a_map(), None)
        folder.publish()
    assert {file.name for file in (tmp_path / "run").iterdir()} == {"stripe", "intensity"}


def test_what_is_not_published_leaves_no_trace(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "deep/er/run") as folder:
        folder.write_map(0, a_map(), rays())
    assert not list(tmp_path.iterdir())

    def fails() -> None:
        with RunFolder(tmp_path / "run") as folder:
            folder.write_json("summary.json", {})
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fails()
    assert not list(tmp_path.iterdir())


def test_an_interrupt_in_the_middle_of_a_map_leaves_none_of_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, done = Path.write_bytes, []

    def interrupted(self: Path, data: bytes) -> int:
        done.append(write(self, data))
        if len(done) == 2:
            raise KeyboardInterrupt
        return done[-1]

    with RunFolder(tmp_path / "run") as folder:
        monkeypatch.setattr(Path, "write_bytes", interrupted)
        with pytest.raises(KeyboardInterrupt):
            folder.write_map(0, a_map(), rays())
        folder.write_json("summary.json", {})
        run = folder.publish()
    assert [file.name for file in run.rglob("*") if file.is_file()] == ["summary.json"]


def test_what_somebody_removes_while_the_folder_is_written_is_missed(tmp_path: Path) -> None:
    def removed_after_first_file(name: str) -> None:
        with RunFolder(tmp_path / name) as folder:
            folder.write_json("strategies.json", {})
            shutil.rmtree(folder.place(""))
            folder.write_text("strategies.csv", "a,b\n")
            folder.publish()

    with pytest.raises(UsageError, match=r"cannot write .*all: No such file"):
        removed_after_first_file("all")
    assert not list(tmp_path.iterdir())

    def published_without(*names: str) -> None:
        with RunFolder(tmp_path / "run") as folder:
            folder.write_map(0, a_map(), rays())
            folder.write_map(1, a_map(), rays())
            folder.remove_map(1)
            folder.write_json("summary.json", {})
            for name in names:
                place = folder.place(name)
                shutil.rmtree(place) if place.is_dir() else place.unlink()
            folder.publish()

    lacks = r"run lacks summary\.json, 1 of 1 files of cloud, 1 of 2 files of depth: somebody removed them"
    with pytest.raises(UsageError, match=lacks):
        published_without("summary.json", "depth/000000.npy", "cloud")
    shutil.rmtree(tmp_path / "run")
    published_without()


def test_a_run_whose_name_was_taken_meanwhile_is_kept_beside_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "run"
    with RunFolder(out) as first, RunFolder(out) as second, RunFolder(out) as third:
        for folder in (first, second, third):
            folder.write_json("summary.json", {})
        published = [folder.publish().name for folder in (first, second, third)]
    assert published == ["run", "run-2", "run-3"]
    assert all((tmp_path / name / "summary.json").exists() for name in published)
    assert len(list(tmp_path.iterdir())) == 3
    assert [record.getMessage().rpartition("/")[2] for record in caplog.records] == ["run-2", "run-3"]


def test_a_run_is_not_moved_into_the_empty_folder_that_a_recording_has_claimed_meanwhile(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with RunFolder(out) as folder:
        folder.write_json("summary.json", {})
        with RunFolder(out, in_place=True):  # fails before its first frame
            published = folder.publish()
    assert published == tmp_path / "run-2"
    assert list(tmp_path.rglob("*")) == [published, published / "summary.json"]


def test_a_folder_that_grows_in_place_is_claimed_before_anything_is_in_it(tmp_path: Path) -> None:
    with RunFolder(tmp_path, in_place=True) as mine:
        with pytest.raises(UsageError, match="exists and is not empty"):
            RunFolder(tmp_path, in_place=True)
        recording = Recording(mine.place(""), expected_bytes=0)
        recording.append(run_blocks()[0])
        recording.close()
        with pytest.raises(UsageError, match="exists and is not empty"):
            RunFolder(tmp_path, in_place=True)
        mine.keep()
    assert RunRecording(tmp_path).frames == 16
    assert {file.name for file in tmp_path.iterdir()} == {"frames-000000.spb", "frames.idx"}
    with RunFolder(tmp_path / "views", in_place=True) as views:
        (views.place("view")).touch()
        views.publish()
    assert [file.name for file in (tmp_path / "views").iterdir()] == ["view"]


def test_two_runs_may_make_the_folder_above_at_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Path.mkdir

    def other_first(folder: Path) -> None:
        monkeypatch.setattr(Path, "mkdir", made)
        folder.mkdir()
        (folder / "other").mkdir()
        folder.mkdir()

    monkeypatch.setattr(Path, "mkdir", other_first)
    with RunFolder(tmp_path / "runs" / "mine") as folder:
        folder.write_text("note.txt", "mine")
        folder.publish()
    assert sorted(each.name for each in (tmp_path / "runs").iterdir()) == ["mine", "other"]


def test_an_empty_folder_is_filled_stays_when_nothing_comes_of_it_and_is_left_to_who_was_faster(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    with RunFolder(out) as folder:
        folder.write_json("summary.json", {})
    assert not list(out.iterdir())
    with RunFolder(out) as folder:
        folder.write_json("summary.json", {"mine": 1})
        (out / "summary.json").write_text("theirs")
        assert folder.publish() == tmp_path / "run-2"
    assert (out / "summary.json").read_text() == "theirs"
    assert list(out.iterdir()) == [out / "summary.json"]
    (out / "summary.json").unlink()
    assert published(out, a_map()) == out
    assert {file.name for file in out.iterdir()} == {"depth", "confidence", "intensity", "stripe", "cloud"}
    assert published(tmp_path / "deep/er/run", a_map()).exists()


def test_json_is_strict() -> None:
    content = {
        "none": [float("nan"), np.float32("inf"), {"x": (1, float("-inf"))}, None],
        "array": np.array([1.5, np.nan]),
        "numbers": [Fraction(1, 4), np.int64(3), np.bool_(True), True],
        "path": Path("a"),
    }
    assert json.loads(json_text(content), parse_constant=lambda word: pytest.fail(word)) == {
        "none": [None, None, {"x": [1, None]}, None],
        "array": [1.5, None],
        "numbers": [0.25, 3, True, True],
        "path": "a",
    }
