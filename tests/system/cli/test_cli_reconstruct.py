"""`rig reconstruct` on cubes that these tests write themselves: a tilted wall, a distorted camera, one bit per row."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.system.conftest import Ran, Rig

ROWS, WIDTH, COLUMNS, EXPOSURES = 24, 100, 61, 3
FOCAL, BASELINE, K1 = 110.0, 0.3, -0.1
PLAN = {"columns": COLUMNS, "exposures": EXPOSURES, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}


def tangents() -> tuple[np.ndarray, np.ndarray]:
    """(u, v) of every pixel by fixed-point iteration."""
    y, x = np.mgrid[:ROWS, :WIDTH]
    seen_u, seen_v = (x - (WIDTH - 1) / 2) / FOCAL, (y - (ROWS - 1) / 2) / FOCAL
    u, v = seen_u, seen_v
    for _ in range(60):
        s = 1 + K1 * (u * u + v * v)
        u, v = seen_u / s, seen_v / s
    return u, v


def wall_depth() -> np.ndarray:
    u, v = tangents()
    return np.asarray(2.2 / (1 - 0.4 * u - 0.2 * v))


def frames(maps: int = 1) -> np.ndarray:
    """(maps x columns x exposures, rows, bytes): in each frame the pixel of each row that the plane meets."""
    u, _ = tangents()
    crossing = u + BASELINE / wall_depth()
    bits = np.zeros((COLUMNS, ROWS, WIDTH), np.uint8)
    for column, tangent in enumerate(np.linspace(-0.25, 0.45, COLUMNS)):
        nearest = np.abs(crossing - tangent).argmin(axis=1)
        inside = (crossing[:, 0] < tangent) & (tangent < crossing[:, -1])
        bits[column, np.flatnonzero(inside), nearest[inside]] = 1
    return np.tile(np.repeat(np.packbits(bits, axis=-1), EXPOSURES, axis=0), (maps, 1, 1))


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    folder = tmp_path / "wall"
    folder.mkdir()
    write_calibration(folder, ROWS, WIDTH, K1, np.linspace(-0.25, 0.45, COLUMNS))
    write(folder / "plan.yaml", **PLAN)
    np.save(folder / "cube.npy", frames())
    return folder


def write_calibration(folder: Path, rows: int, width: int, k1: float, tangents: np.ndarray) -> None:
    """Write a camera, and for each column the plane that stands at a tangent."""
    ones = np.ones_like(tangents)
    np.save(folder / "planes.npy", np.stack([ones, 0 * ones, -tangents, -BASELINE * ones], 1))
    matrix = [[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (rows - 1) / 2], [0, 0, 1]]
    camera = {"width": width, "height": rows, "matrix": matrix, "distortion": [k1, 0, 0, 0, 0]}
    write(folder / "calibration.yaml", format="spadrig-calibration", version=1, camera=camera, planes="planes.npy")


def write(file: Path, **content: object) -> None:
    file.write_text(yaml.safe_dump(content))


def reconstruct(rig: Rig, wall: Path, *more: object, cube: str = "cube.npy", plan: str = "plan.yaml") -> Ran:
    given = ["--plan", wall / plan, "--calibration", wall / "calibration.yaml", "--out", "run", *more]
    return rig("reconstruct", wall / cube, *given)


@pytest.mark.parametrize("estimator", ["argmax", "likelihood", "joint"])
def test_a_foreign_cube_gives_its_wall(rig: Rig, wall: Path, estimator: str) -> None:
    ran = reconstruct(rig, wall, "--estimator", estimator, "--json")
    summary = json.loads(ran.out)
    assert (ran.code, summary["verdict"]) == (0, "complete")
    n = COLUMNS * EXPOSURES
    assert summary["frames"] == {"expected": n, "received": n, "lost": 0, "crc_errors": None, "lit": n}
    assert summary["sensor_time_s"] == pytest.approx(n * 1e-5)
    assert "truth" not in summary
    assert json.loads(Path("run/summary.json").read_text()) == summary
    depth = np.load("run/depth/000000.npy")
    error = np.abs(depth - wall_depth())
    assert np.isfinite(error[:, 12:-12]).mean() > 0.8
    # Half a pixel of rounding at this focal length is 0.1 m at 2.5 m.
    assert np.nanmedian(error) < 0.06
    assert np.nanpercentile(error, 95) < 0.2


def test_progress_says_which_estimator_auto_stands_for_and_why(
    rig: Rig, wall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.cli.progress.PATIENCE_S", 0.0)
    why = "joint: no frame waits for its maps"
    assert why in reconstruct(rig, wall).err
    assert why not in reconstruct(rig, wall, "--estimator", "joint", "--out", "named").err


def test_a_cube_that_speaks_against_its_depth_is_doubtful(rig: Rig, wall: Path) -> None:
    right = frames(2)
    maps = right.reshape(2, COLUMNS * EXPOSURES, ROWS, -1)
    np.save(wall / "bits.npy", np.packbits(np.unpackbits(right, axis=-1), axis=-1, bitorder="little"))
    np.save(wall / "backwards.npy", np.concatenate([maps[0], maps[1, ::-1]]))
    np.save(wall / "dark.npy", np.zeros_like(right))
    seen = {
        "bits": ("columns do not follow one another", [0, 1]),  # of lines a pixel wide no order is smoother
        "backwards": ("columns do not follow one another", [1]),
        "dark": ("no light", [0, 1]),
    }
    for name, (reason, of) in seen.items():
        ran = reconstruct(rig, wall, "--estimator", "argmax", "--json", "--out", name, cube=f"{name}.npy")
        summary = json.loads(ran.out)
        assert (ran.code, summary["verdict"]) == (1, "doubtful")
        (doubt,) = summary["verdict_reasons"]
        assert doubt["reason"].startswith(reason)
        assert doubt["maps"] == of
        assert json.loads(Path(name, "manifest.json").read_text())["verdict"] == "doubtful"
    told = reconstruct(rig, wall, "--estimator", "argmax", "--out", "told", cube="backwards.npy")
    assert told.code == 1
    assert "verdict  doubtful: " in told.out
    assert "because  map 1: columns do not follow one another" in told.out


def test_an_interrupt_exits_4(rig: Rig, wall: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rig.depth.reconstruct import Reconstructor

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Reconstructor, "map", interrupted)
    ran = reconstruct(rig, wall, "--json")
    assert (ran.code, json.loads(ran.out)["verdict"]) == (4, "aborted")
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("edit", "more", "said"),
    [
        ({"columns": 183, "exposures": 1}, [], "61 planes, the plan 183 columns"),
        ({"depth_range": ["2 m", "2 m"]}, [], "depth_range runs from 2 m to 2 m; it must be [near, far]"),
        ({}, ["--estimator", "best"], "estimator 'best' is unknown; choose one of auto, argmax, edge"),
        ({}, ["--filter", "best"], "filter 'best' is unknown; choose one of "),
        ({}, ["--min-confidence", "-0.1"], "min_confidence is -0.1; it is a probability from 0 to 1"),
    ],
)
def test_a_plan_or_option_that_does_not_fit_is_one_line(
    rig: Rig, wall: Path, edit: dict[str, object], more: list[str], said: str
) -> None:
    write(wall / "bad.yaml", **(PLAN | edit))
    refused(reconstruct(rig, wall, *more, plan="bad.yaml"), said)


def test_missing_options_are_one_line(rig: Rig, wall: Path) -> None:
    refused(rig("reconstruct", wall / "cube.npy"), "--out")
    refused(rig("reconstruct", wall / "cube.npy", "--out", "r"), "--plan and --calibration")
    refused(rig("reconstruct", "cubes.npy", "--out", "r"), "cubes.npy does not exist")


def refused(ran: Ran, said: str, *kept: Path) -> None:
    assert ran.code == 2
    assert said in ran.err
    assert len(ran.err.splitlines()) == 1
    assert sorted(Path().iterdir()) == sorted(kept)


def imported(rig: Rig, wall: Path, frames: np.ndarray, *more: str, **beside: object) -> Path:
    """The folder that `rig import` makes of frames; beside: what `frames.json` says of them."""
    folder = wall / "foreign"
    folder.mkdir()
    np.save(folder / "frames.npy", frames)
    content = {"format": "spadrig-frames", "width": WIDTH, **beside}
    (folder / "frames.json").write_text(json.dumps(content))
    ran = rig("import", "photoncube", folder / "frames.npy", "--out", wall / "imported", *more)
    assert ran.code == 0, ran.err
    return wall / "imported"


def test_imported_frames_give_the_depth_of_their_cube(rig: Rig, wall: Path) -> None:
    np.save(wall / "cube.npy", frames(2))
    folder = imported(rig, wall, frames(2), "--frame-rate", "100 kHz")
    assert reconstruct(rig, wall, "--estimator", "argmax").code == 0
    ran = reconstruct(rig, wall, "--estimator", "argmax", "--json", "--out", "again", cube=folder.name)
    summary = json.loads(ran.out)
    assert (ran.code, summary["maps"], summary["verdict"]) == (0, 2, "complete")
    for file in ("depth/000001.npy", "stripe/000001.npz", "cloud/000001.ply"):
        assert (Path("run") / file).read_bytes() == (Path("again") / file).read_bytes()


def test_frames_that_were_lost_are_gaps_and_the_others_stay_in_their_columns(rig: Rig, wall: Path) -> None:
    n = COLUMNS * EXPOSURES
    lost = [*range(41, 46), n - 1, n]
    there = [number for number in range(2 * n) if number not in lost]
    folder = imported(rig, wall, frames(2)[there], ranges=[[1, 0, 41], [1, 46, n - 47], [1, n + 1, n - 1]])
    ran = reconstruct(rig, wall, "--estimator", "argmax", "--json", cube=folder.name)
    summary = json.loads(ran.out)
    assert (ran.code, summary["verdict"]) == (1, "gaps")
    received = 2 * n - len(lost)
    counts = {"expected": 2 * n, "received": received, "lost": len(lost), "crc_errors": None, "lit": received}
    assert summary["frames"] == counts
    manifest = json.loads(Path("run/manifest.json").read_text())
    assert manifest["gaps"] == [[41, 45], [n - 1, n - 1], [n, n]]
    assert reconstruct(rig, wall, "--estimator", "argmax", "--out", "whole").code == 0
    whole, gaps = (np.load(f"{run}/stripe/000000.npz")["x_px"] for run in ("whole", "run"))
    # Every frame of a column is the same, so that one is enough: but those of column 14, 42 to 44, are all gone.
    missing = 14
    assert np.isnan(gaps[:, missing]).all()
    others = np.delete(np.arange(COLUMNS), missing)
    assert np.array_equal(whole[:, others], gaps[:, others], equal_nan=True)


def test_a_part_of_imported_frames_is_of_the_same_columns(rig: Rig, wall: Path) -> None:
    n = COLUMNS * EXPOSURES
    folder = imported(rig, wall, frames(3))
    assert rig("cut", folder, "--frames", f"{n}:{3 * n}", "--out", wall / "whole-maps").code == 0
    assert rig("cut", folder, "--frames", f"7:{n + 7}", "--out", wall / "astride").code == 0
    assert json.loads(reconstruct(rig, wall, "--estimator", "argmax", "--json", cube="whole-maps").out)["maps"] == 2
    refused(
        reconstruct(rig, wall, "--out", "no", cube="astride"), "begins with frame 7, which is no first one", Path("run")
    )


def test_every_command_for_imported_frames_names_the_one_that_works(rig: Rig, wall: Path) -> None:
    folder = imported(rig, wall, frames())
    works = f"rig reconstruct {folder} --plan PLAN --calibration CALIBRATION --out DIR"
    for arguments in (["replay", folder], ["export", folder, "ply"], ["export", folder, "png", "--view", "depth"]):
        refused(rig(*arguments), works)
    refused(rig("reconstruct", folder, "--out", "run"), "add --plan and --calibration")
    refused(rig("reconstruct", folder, "--plan", wall / "plan.yaml", "--out", "run"), "add --calibration")


def test_a_file_of_ours_that_is_no_plan_of_a_cube_is_called_what_it_is(rig: Rig, wall: Path) -> None:
    write(wall / "compiled.yaml", format="spadrig-plan", version=1, plan={"columns": 3})
    refused(
        reconstruct(rig, wall, plan="compiled.yaml"),
        "compiled.yaml is the compiled plan of a recording, which is found beside its frames; leave --plan out",
    )
    refused(reconstruct(rig, wall, plan="calibration.yaml"), "calibration.yaml is a calibration; the plan of frames")
    refused(rig("scan", wall / "calibration.yaml", "--dry-run"), "is a calibration; name the config of a rig")


@pytest.mark.parametrize(
    ("rows", "width", "columns", "exposures"), [(24, 1, 5, 3), (1, 100, 5, 3), (8, 8, 5, 1), (24, 100, 1, 3)]
)
@pytest.mark.parametrize("estimator", ["argmax", "edge", "likelihood", "joint"])
def test_the_smallest_cubes_give_maps_of_their_size(
    rig: Rig, tmp_path: Path, rows: int, width: int, columns: int, exposures: int, estimator: str
) -> None:
    write_calibration(tmp_path, rows, width, 0, np.linspace(-0.05, 0.2, columns))
    write(tmp_path / "plan.yaml", **(PLAN | {"columns": columns, "exposures": exposures}))
    bits = np.random.default_rng(1).random((columns * exposures, rows, width)) < 0.2
    np.save(tmp_path / "cube.npy", np.packbits(bits, axis=2))
    ran = reconstruct(rig, tmp_path, "--estimator", estimator, "--filter", "median")
    if ran.code == 2:
        refused(ran, "no column meets the picture")
    else:
        assert ran.code == 0, ran.err
        assert np.load("run/depth/000000.npy").shape == (rows, width)
