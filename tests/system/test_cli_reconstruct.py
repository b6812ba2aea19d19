"""`rig reconstruct` on cubes that these tests write themselves: a tilted wall, a distorted camera, one bit per row."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.system.conftest import Ran, Rig

ROWS, WIDTH, COLUMNS, EXPOSURES = 24, 100, 61, 3
FOCAL, BASELINE, K1 = 110.0, 0.3, -0.1


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
    t = np.linspace(-0.25, 0.45, COLUMNS)
    np.save(folder / "planes.npy", np.stack([np.ones_like(t), 0 * t, -t, np.full_like(t, -BASELINE)], 1))
    camera = {
        "width": WIDTH,
        "height": ROWS,
        "matrix": [[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (ROWS - 1) / 2], [0, 0, 1]],
        "distortion": [K1, 0, 0, 0, 0],
    }
    write(folder / "calibration.yaml", format="spadrig-calibration", version=1, camera=camera, planes="planes.npy")
    write(folder / "plan.yaml", columns=COLUMNS, exposures=EXPOSURES, frame_rate="100 kHz", depth_range=["1 m", "8 m"])
    np.save(folder / "cube.npy", frames())
    return folder


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


def test_a_cube_of_several_maps_gives_each(rig: Rig, wall: Path) -> None:
    np.save(wall / "three.npy", frames(3))
    ran = reconstruct(rig, wall, "--estimator", "argmax", "--json", cube="three.npy")
    assert json.loads(ran.out)["maps"] == 3
    depths = [np.load(f"run/depth/{i:06d}.npy") for i in range(3)]
    assert np.array_equal(depths[0], depths[1], equal_nan=True)
    assert np.array_equal(depths[0], depths[2], equal_nan=True)


def test_bits_past_the_width_are_no_pixels(rig: Rig, wall: Path) -> None:
    dirty = frames()
    dirty[:, :, -1] |= 0xFF >> (WIDTH % 8)
    np.save(wall / "dirty.npy", dirty)
    for name in ("cube", "dirty"):
        assert reconstruct(rig, wall, "--estimator", "argmax", "--json", "--out", name, cube=f"{name}.npy").code == 0
    assert Path("cube/stripe/000000.npz").read_bytes() == Path("dirty/stripe/000000.npz").read_bytes()


def test_an_interrupt_exits_4(rig: Rig, wall: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rig.reconstruction import Reconstructor

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Reconstructor, "map", interrupted)
    ran = reconstruct(rig, wall, "--json")
    assert (ran.code, json.loads(ran.out)["verdict"]) == (4, "aborted")
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("edit", "more", "said"),
    [
        ({"exposures": 2}, [], "has 183 frames; 61 columns x 2 exposures need 122"),
        ({"columns": 183, "exposures": 1}, [], "61 planes, the plan 183 columns"),
        ({"exposures": -1}, [], "exposures is -1, it must be at least 1"),
        ({"frame_rate": 100000}, [], "has no unit"),
        ({"depth_range": ["1 m"]}, [], "depth_range"),
        ({"frames": 3}, [], "unknown key 'frames'"),
        ({}, ["--estimator", "best"], "estimator 'best' is unknown; choose one of argmax, edge, likelihood"),
        ({}, ["--filter", "mean"], "filter 'mean' is unknown; choose one of none, median"),
        ({}, ["--min-confidence", "-0.1"], "min_confidence is -0.1; it is a probability from 0 to 1"),
    ],
)
def test_a_plan_or_option_that_does_not_fit_is_one_line(
    rig: Rig, wall: Path, edit: dict[str, object], more: list[str], said: str
) -> None:
    plan = {"columns": COLUMNS, "exposures": EXPOSURES, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}
    write(wall / "bad.yaml", **(plan | edit))
    refused(reconstruct(rig, wall, *more, plan="bad.yaml"), said)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (np.zeros((0, ROWS, 13), np.uint8), "has 0 frames"),
        (
            np.zeros((COLUMNS * EXPOSURES, ROWS, 12), np.uint8),
            "the calibration's 100 x 24 sensor needs (frames, 24, 13)",
        ),
        (np.zeros((COLUMNS * EXPOSURES, ROWS), np.uint8), "needs (frames, 24, 13)"),
        (np.zeros((COLUMNS * EXPOSURES, ROWS, 13), np.int8), "make it with frames.view(numpy.uint8)"),
        (b"columns: 3", "is no whole .npy file"),
        (b"", "is no whole .npy file"),
        (None, "No such file or directory; check the path"),
    ],
    ids=["empty", "narrow", "flat", "signed", "text", "nothing", "absent"],
)
def test_a_file_that_is_no_cube_of_this_sensor_is_one_line(rig: Rig, wall: Path, content: object, said: str) -> None:
    if isinstance(content, bytes):
        (wall / "bad.npy").write_bytes(content)
    elif content is not None:
        np.save(wall / "bad.npy", content)
    refused(reconstruct(rig, wall, cube="bad.npy"), said)


def test_a_cube_torn_in_the_middle_is_one_line(rig: Rig, wall: Path) -> None:
    whole = (wall / "cube.npy").read_bytes()
    (wall / "torn.npy").write_bytes(whole[: len(whole) // 2])
    refused(reconstruct(rig, wall, cube="torn.npy"), "is no whole .npy file")


def test_a_calibration_of_mirror_commands_does_not_fit_a_bare_cube(rig: Rig, wall: Path) -> None:
    content = yaml.safe_load((wall / "calibration.yaml").read_text())
    del content["planes"]
    pivot = {"axis_point_m": [-0.3, 0, 0], "axis_direction": [0, 1, 0], "zero_normal": [1, 0, 0], "angle_rad": [0, 0.3]}
    write(wall / "calibration.yaml", **content, scanner={"pivot": pivot})
    refused(reconstruct(rig, wall), "needs 'planes', one per column")


def test_missing_options_are_one_line(rig: Rig, wall: Path) -> None:
    refused(rig("reconstruct", wall / "cube.npy"), "--out")
    refused(rig("reconstruct", "cubes.npy", "--out", "r"), "cubes.npy does not exist")


def refused(ran: Ran, said: str) -> None:
    assert ran.code == 2
    assert said in ran.err
    assert len(ran.err.splitlines()) == 1
    assert not list(Path().iterdir())
