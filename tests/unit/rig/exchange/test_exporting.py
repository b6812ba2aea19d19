"""Exports: other programs read the very frames and maps of a run, and what is missing is told."""

import errno
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.frames import FrameBlock, Mark
from drivers.recorded import RunRecording
from rig.api import export_run, import_frames
from rig.depth.depth import DepthMap
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.errors import DamagedRecordingError, UsageError
from rig.geometry.stripe_table import StripeTable
from rig.run_folder.folder import RunFolder
from tests.unit.rig.recording.recorded import record, run_blocks

LOST = range(20, 31)


@pytest.fixture(scope="module")
def blocks() -> list[FrameBlock]:
    """One start of a SPAD that lost frames 20 to 30."""
    return run_blocks(lost=LOST)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, blocks: list[FrameBlock]) -> Path:
    return record(tmp_path_factory.mktemp("exported") / "run", [blocks])


@pytest.fixture
def mapped(tmp_path: Path) -> Path:
    """The folder of a run with two maps and no recording."""
    rays = np.zeros((7, 9)), np.zeros((7, 9))
    with RunFolder(tmp_path / "mapped") as folder:
        for index in (0, 5):
            depth = np.full((7, 9), 2.0 + index, np.float32)
            depth[0, 0] = np.nan
            intensity = np.full((7, 9), 40 * index, np.uint32)
            known = DepthMap(depth, np.isfinite(depth).astype(np.float32), depth / 100)
            folder.write_map(index, MapResult(StripeTable.empty(7, 4), *known, intensity, FogEstimate(), 0.1), rays)
        return folder.publish()


def pixels(blocks: list[FrameBlock]) -> np.ndarray:
    """uint8 (frames, height, bytes) without the padding of rows."""
    return np.concatenate([block.bits[:, :, : -(-block.header.width // 8)] for block in blocks])


def moving(blocks: list[FrameBlock]) -> list[FrameBlock]:
    """The same blocks as windows on a larger sensor, which jump from block to block."""
    moved = []
    for number, block in enumerate(blocks):
        records = block.records.copy()
        records["x0"] = 64 * (number % 2)
        header = replace(block.header, sensor_width=block.header.width + 64)
        moved.append(FrameBlock(header, records, block.bits, block.status))
    return moved


def test_npy_holds_the_frames_and_its_sidecar_the_rest(run: Path, blocks: list[FrameBlock], tmp_path: Path) -> None:
    result = export_run(run, "npy", out=tmp_path / "out")
    assert result.damage == ()
    np.save(tmp_path / "own.npy", pixels(blocks))
    assert (tmp_path / "out" / "frames.npy").read_bytes() == (tmp_path / "own.npy").read_bytes()
    sidecar = json.loads((tmp_path / "out" / "frames.json").read_text())
    marks = np.concatenate([block.records["marks"] for block in blocks])
    numbers = np.concatenate([block.frame_numbers for block in blocks])
    assert sidecar["gaps"] == [[1, 20, 30]] == [list(gap) for gap in result.gaps]
    assert sidecar["ranges"] == [[1, 0, 20], [1, 31, int(numbers[-1]) - 30]]
    assert sidecar["scan_markers"] == np.flatnonzero(marks & Mark.SCAN).tolist()
    assert sidecar["line_markers"] == np.flatnonzero(marks & Mark.LINE).tolist()
    lit = np.zeros(len(marks), bool)
    for first, last in sidecar["lit"]:
        lit[first : last + 1] = True
    assert np.array_equal(lit, marks & Mark.GATE_HIGH > 0)


def test_npy_comes_back_with_its_clock_and_gaps(run: Path, blocks: list[FrameBlock], tmp_path: Path) -> None:
    export_run(run, "npy", out=tmp_path / "out")
    result = import_frames("photoncube", [tmp_path / "out"], tmp_path / "back")
    assert result.gaps == ((20, 30),)
    again = RunRecording(tmp_path / "back")
    taken = [block for one in again.runs for block in again.blocks(one)]
    assert np.array_equal(pixels(taken), pixels(blocks))
    rate, ours = (one.header.tick_hz / one.header.frame_period_ticks for one in (blocks[0], taken[0]))
    assert rate == ours
    numbers = [np.concatenate([block.frame_numbers for block in part]) for part in (blocks, taken)]
    assert np.array_equal(*numbers)


def test_photoncube_opens_what_was_exported(run: Path, blocks: list[FrameBlock], tmp_path: Path) -> None:
    tool = pytest.importorskip("photoncube", reason="pip install photoncube")
    export_run(run, "npy", out=tmp_path / "out")
    cube = tool.PhotonCube.open(str(tmp_path / "out" / "frames.npy"))
    assert tuple(cube.shape) == pixels(blocks).shape
    cube.process_cube(str(tmp_path / "made.npy"))  # a cube of the tool's own making
    made = np.load(tmp_path / "made.npy")
    import_frames("photoncube", [tmp_path / "made.npy"], tmp_path / "back")
    export_run(tmp_path / "back", "npy", out=tmp_path / "again")
    assert np.array_equal(np.load(tmp_path / "again" / "frames.npy"), made)


def test_hdf5_opens_in_h5py_and_as_a_mat_file(run: Path, blocks: list[FrameBlock], tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    export_run(run, "hdf5", out=tmp_path / "out")
    header = (tmp_path / "out" / "run.h5").read_bytes()[:128]
    assert header.startswith(b"MATLAB 7.3 MAT-file")
    assert header[124:] == b"\x00\x02IM"
    with h5py.File(tmp_path / "out" / "run.h5") as file:
        frames = file["frames"]
        assert np.array_equal(frames["bits"][:], pixels(blocks))
        for name in ("marks", "x0", "line", "sweep"):
            wanted = np.concatenate([block.records[name] for block in blocks])
            assert np.array_equal(frames[name][0], wanted), name
        assert np.array_equal(frames["number"][0], np.concatenate([block.frame_numbers for block in blocks]))
        assert np.array_equal(frames["ticks"][0], np.concatenate([block.start_ticks for block in blocks]))
        rate = blocks[0].header.tick_hz
        assert file["clock/tick_hz_numerator"][0, 0] / file["clock/tick_hz_denominator"][0, 0] == float(rate)
        assert json.loads(file["manifest"][:].tobytes().decode("utf-16-le"))["verdict"] == "complete"
        arrays: list[Any] = []
        file.visititems(lambda _, item: arrays.append(item))
        assert all("MATLAB_class" in item.attrs for item in arrays)
        assert all(item.ndim >= 2 for item in arrays if isinstance(item, h5py.Dataset))


def test_hdf5_holds_the_maps(mapped: Path, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    result = export_run(mapped, "hdf5", out=tmp_path / "out")
    assert (result.maps, result.frames) == (2, 0)
    with h5py.File(tmp_path / "out" / "run.h5") as file:
        assert file["maps/number"][0].tolist() == [0, 5]
        assert np.array_equal(file["maps/depth_m"][1], np.load(mapped / "depth/000005.npy"), equal_nan=True)
        assert file["maps/x_px"].shape == (2, 7, 4)
        assert "frames" not in file


def test_without_room_or_h5py_nothing_is_left_and_the_next_step_is_told(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rig.exchange.npy._write_header", full)
    monkeypatch.setattr("rig.exchange.hdf5.shutil.disk_usage", lambda folder: SimpleNamespace(free=1 << 20))
    for kind in ("npy", "hdf5"):
        with pytest.raises(UsageError, match="No space left on device; free the space it needs"):
            export_run(run, kind, out=tmp_path / "out")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UsageError, match=r"needs h5py; install it: .* -m pip install .*(\[exchange\]|h5py)"):
        export_run(run, "hdf5", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_pictures_of_frames_show_windows_where_they_lay(blocks: list[FrameBlock], tmp_path: Path) -> None:
    run = record(tmp_path / "run", [moving(blocks)])
    result = export_run(run, "png", out=tmp_path / "out", view="frames", frames_per_picture=40)
    total = sum(block.n_frames for block in blocks)
    assert len(result.files) == total // 40
    header = blocks[0].header
    counts = np.zeros((header.height, header.width + 64), np.int64)
    left = 40
    for number, block in enumerate(blocks[:4]):
        part = np.unpackbits(block.bits[:left], axis=2, count=header.width).sum(axis=0, dtype=np.int64)
        counts[:, 64 * (number % 2) :][:, : header.width] += part
        left -= len(block.bits[:left])
    picture = cv2.imread(str(tmp_path / "out" / "frames-000000.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    levels = [set(picture[counts == n].tolist()) for n in np.unique(counts)]
    assert all(len(level) == 1 for level in levels)
    assert [max(level) for level in levels] == sorted(max(level) for level in levels)
    assert np.array_equal(picture > 0, counts > 0)


@pytest.mark.parametrize("view", ["depth", "intensity"])
def test_films_and_pictures_of_the_maps(mapped: Path, tmp_path: Path, view: str) -> None:
    film = export_run(mapped, "mp4", out=tmp_path / "film", view=view, pictures_per_s=5)
    assert film.files == (f"{view}.mp4",)
    opened = cv2.VideoCapture(str(tmp_path / "film" / f"{view}.mp4"))
    assert (opened.get(cv2.CAP_PROP_FRAME_COUNT), opened.get(cv2.CAP_PROP_FPS)) == (2, 5)
    assert opened.read()[0]
    assert export_run(mapped, "png", out=tmp_path / "png", view=view).maps == 2


def test_the_folder_is_named_after_run_and_kind(mapped: Path) -> None:
    assert export_run(mapped, "ply").folder == mapped.with_name("mapped-ply")
    with pytest.raises(UsageError, match="not empty"):
        export_run(mapped, "ply")


def test_damage_is_left_out_and_told(blocks: list[FrameBlock], tmp_path: Path) -> None:
    run = record(tmp_path / "run", [blocks])
    with (run / "frames-000000.spb").open("r+b") as file:
        file.seek(4096 + 200)  # within the second block's pixels
        file.write(b"\xff\x00" * 8)
    result = export_run(run, "npy", out=tmp_path / "out")
    assert result.damage
    assert result.frames == sum(block.n_frames for block in blocks) - blocks[1].n_frames
    for file in run.glob("frames*"):
        file.write_bytes(bytes(8192))
    with pytest.raises(DamagedRecordingError):
        export_run(run, "npy", out=tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_runs_of_two_sizes_make_no_array(tmp_path: Path) -> None:
    small = [
        replace(block, header=replace(block.header, height=block.header.height - 1), bits=block.bits[:, :-1].copy())
        for block in run_blocks(run_id=2)
    ]
    run = record(tmp_path / "run", [run_blocks(), small])
    with pytest.raises(UsageError, match="rig cut"):
        export_run(run, "npy", out=tmp_path / "out")


@pytest.mark.parametrize(
    ("kind", "options", "why"),
    [
        ("tiff", {}, "choose one of npy"),
        ("npy", {}, "holds no recording"),
        ("png", {"view": "frames"}, "frames of this run were not recorded"),
        ("png", {"view": "x"}, "choose one of depth"),
        ("ply", {"view": "depth"}, "ply has none; export png or mp4"),
        ("mp4", {"pictures_per_s": 0.0}, "a second"),
        ("png", {"frames_per_picture": 0}, "at least 1"),
        ("png", {"pictures_per_s": 5.0}, "png is none; export mp4"),
        ("ply", {"frames_per_picture": 5}, "ply has none; export png or mp4"),
        ("png", {"frames_per_picture": 5}, "depth sum no frames; name `view='frames'`"),
    ],
)
def test_what_a_run_has_not_is_refused(mapped: Path, kind: str, options: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        export_run(mapped, kind, **options)


def test_a_run_that_only_recorded_says_how_to_get_maps(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="rig reconstruct"):
        export_run(run, "ply", out=tmp_path / "out")
    assert export_run(run, "png", out=tmp_path / "png", frames_per_picture=50).files[0] == "frames-000000.png"
    with pytest.raises(UsageError, match="lower `frames_per_picture`"):
        export_run(run, "mp4", out=tmp_path / "film", frames_per_picture=10**6)
