"""`rig scan` on a small simulated rig: what it prints, what it writes, and how it ends."""

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from drivers.frames import FrameBlock
from drivers.ring import BlockRing
from drivers.spb1 import walk_blocks
from rig.outputs import RunFolder
from rig.reconstruction import MapResult, Reconstructor
from rig.recording.segment import Segment, Staging
from tests.system.conftest import Rig
from tests.system.small_rig import HEIGHT, WIDTH, config, write_rig

KEYS = {
    "maps", "map_rate_hz", "columns", "exposures", "estimator", "filter", "frames", "sensor_time_s", "compute_time_s",
    "realtime_factor", "valid_fraction", "fog", "truth", "verdict", "stages", "sync",
}  # fmt: skip
FILES = {
    "depth/000000.npy", "depth/000000.png", "intensity/000000.png", "stripe/000000.npz", "cloud/000000.ply",
    "truth/000000.npz", "manifest.json", "summary.json",
}  # fmt: skip


def strict(text: str) -> dict[str, object]:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is not JSON")

    content: dict[str, object] = json.loads(text, parse_constant=refuse)
    return content


def files(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def test_a_scan_prints_its_summary_and_writes_one_folder(rig: Rig, small: Path, tmp_path: Path) -> None:
    ran = rig("scan", small, "--json", "--out", "run", "--seed", 1)
    summary = strict(ran.out)
    assert ran.code == 0
    assert ran.err == ""
    assert set(summary) == KEYS
    assert summary["verdict"] == "complete"
    frames = summary["frames"]
    assert isinstance(frames, dict)
    assert set(frames) == {"expected", "received", "lost", "crc_errors", "lit"}
    assert frames["expected"] == frames["received"] + frames["lost"]
    assert frames["lit"] == pytest.approx(800, abs=4)
    assert files(Path("run")) == FILES
    assert strict(Path("run/summary.json").read_text()) == summary
    depth = np.load("run/depth/000000.npy")
    assert (depth.dtype, depth.shape) == (np.float32, (HEIGHT, WIDTH))
    assert summary["valid_fraction"] == pytest.approx(np.isfinite(depth).mean())
    with np.load("run/stripe/000000.npz") as table:
        stripe = dict(table)
    assert set(stripe) >= {"x_px", "confidence", "x_sd_px", "signal", "haze"}
    assert all(stripe[key].shape == (HEIGHT, 200) for key in stripe)
    manifest = strict(Path("run/manifest.json").read_text())
    assert set(manifest) >= {"versions", "config", "plan", "calibration", "seed", "gaps"}
    assert not list(Path().glob(".*"))


def test_the_same_seed_gives_the_same_depth_and_another_one_another(rig: Rig, small: Path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert rig("scan", small, "--out", name, "--seed", seed).code == 0
    first, again, other = (np.load(f"{name}/depth/000000.npy") for name in "abc")
    assert np.array_equal(first, again, equal_nan=True)
    assert not np.array_equal(first, other, equal_nan=True)


def test_people_are_told_the_errors_the_verdict_and_where_the_pictures_lie(rig: Rig, small: Path) -> None:
    ran = rig("scan", small, "--out", "run")
    assert "stripe error" in ran.out
    assert "complete" in ran.out
    assert str(Path("run/depth/000000.png").absolute()) in ran.out


def test_a_recording_holds_every_frame_of_the_scan(rig: Rig, small: Path) -> None:
    summary = strict(rig("scan", small, "--maps", 2, "--record", "--json", "--out", "run").out)
    assert files(Path("run")) > {"frames-000000.spb", "summary.json"}
    blocks = list(walk_blocks(np.fromfile("run/frames-000000.spb", np.uint8), None, check_payload=True))
    assert all(isinstance(block, FrameBlock) for block in blocks)
    numbers = np.concatenate([block.frame_numbers for block in blocks])  # type: ignore[union-attr]
    assert numbers.tolist() == list(range(len(numbers)))
    assert len(numbers) >= summary["frames"]["received"]  # type: ignore[index]
    stages, recording = summary["stages"], strict(Path("run/manifest.json").read_text())["recording"]
    assert isinstance(stages, dict)
    assert isinstance(recording, dict)
    assert (recording["files"], recording["blocks"]) == (["frames-000000.spb"], stages["recorder_blocks"])
    assert recording["sync_interval_s"] == 0.2
    assert recording["bytes"] == Path("run/frames-000000.spb").stat().st_size
    assert recording["starts"] == [{"sweeps": 2, "segment": 0}]


def test_recording_and_policies_change_no_result(rig: Rig, small: Path) -> None:
    for name, options in (("plain", ()), ("recorded", ("--record", "--on-overload", "block"))):
        assert rig("scan", small, "--seed", 4, "--out", name, *options).code == 0
    plain, recorded = (np.load(f"{name}/depth/000000.npy") for name in ("plain", "recorded"))
    assert np.array_equal(plain, recorded, equal_nan=True)


def test_frames_dropped_for_a_slow_estimate_are_gaps(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    estimate, dropping = Reconstructor.map, threading.Event()
    mark = BlockRing.mark_overflow

    def marked(self: BlockRing, n_frames: int = 0) -> None:
        mark(self, n_frames)
        dropping.set()

    def slow(self: Reconstructor, volume: object) -> MapResult:
        assert dropping.wait(60)
        return estimate(self, volume)  # type: ignore[arg-type]

    monkeypatch.setattr(BlockRing, "mark_overflow", marked)
    monkeypatch.setattr(Reconstructor, "map", slow)
    ran = rig("scan", small, "--maps", 8, "--on-overload", "drop", "--json", "--out", "run")
    summary, manifest = strict(ran.out), strict(Path("run/manifest.json").read_text())
    frames, gaps = summary["frames"], manifest["gaps"]
    assert isinstance(frames, dict)
    assert isinstance(gaps, list)
    assert (ran.code, summary["verdict"], summary["maps"]) == (1, "gaps", 8)
    assert frames["expected"] == frames["received"] + frames["lost"]
    assert frames["lost"] == sum(last - first + 1 for first, last in gaps) > 0
    assert summary["stages"]["dropped_frames"] >= frames["lost"]  # type: ignore[index]
    assert manifest["on_overload"] == "drop"


def test_a_disk_that_the_recording_fills_ends_the_scan_in_a_line_and_keeps_what_is_whole(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Segment.write

    def full(self: Segment, block: FrameBlock, offset: int, staging: Staging) -> None:
        if block.header.block_seq == 3:
            os.write(-1, b"")
        write(self, block, offset, staging)

    monkeypatch.setattr(Segment, "write", full)
    ran = rig("scan", small, "--maps", 20, "--record", "--out", "run")
    assert (ran.code, len(ran.problems)) == (3, 1)
    assert "cannot write the recording frames-000000.spb" in ran.problems[0]
    assert "of 20 maps were whole" in ran.err
    assert strict(Path("run/summary.json").read_text())["verdict"] == "aborted"
    blocks = list(walk_blocks(np.fromfile("run/frames-000000.spb", np.uint8), None, check_payload=True))
    assert [isinstance(block, FrameBlock) for block in blocks] == [True] * 3


def test_without_out_the_folder_is_named_after_the_time(rig: Rig, small: Path) -> None:
    assert rig("scan", small, "--json").code == 0
    (folder,) = Path("runs").iterdir()
    assert files(folder) == FILES


@pytest.mark.parametrize(
    ("save", "kept"), [(["all"], [0, 1, 2]), (["last"], [2]), (["every", "2"], [0, 2]), (["every:3"], [0])]
)
def test_save_says_which_maps_are_written(rig: Rig, small: Path, save: list[str], kept: list[int]) -> None:
    ran = rig("scan", small, "--maps", 3, "--save", *save, "--out", "run", "--json")
    assert strict(ran.out)["maps"] == 3
    assert sorted(file.name for file in Path("run/depth").glob("*.npy")) == [f"{i:06d}.npy" for i in kept]


def test_options_change_the_config(rig: Rig, small: Path) -> None:
    ran = rig("scan", small, "--exposures", 2, "--estimator", "edge", "--filter", "median", "--json", "--out", "run")
    summary = strict(ran.out)
    assert (summary["exposures"], summary["estimator"], summary["filter"]) == (2, "edge", "median")


def test_confidence_decides_what_enters_the_depth_map(rig: Rig, small: Path) -> None:
    shares = [
        strict(rig("scan", small, "--min-confidence", limit, "--json", "--out", f"run{limit}").out)["valid_fraction"]
        for limit in (0, 1)
    ]
    assert shares[0] > shares[1]  # type: ignore[operator]


def test_a_dry_run_prints_the_plan_and_writes_nothing(rig: Rig, small: Path) -> None:
    people, programs = rig("scan", small, "--dry-run"), rig("scan", small, "--dry-run", "--json")
    assert people.code == programs.code == 0
    assert "sweep" in people.out
    assert strict(programs.out)["plan"]["columns"] == 200  # type: ignore[index]
    assert not list(Path().iterdir())


def test_lost_frames_are_a_verdict_and_exit_code(rig: Rig, tmp_path: Path) -> None:
    content = config()
    content["spad"]["lost_frames"] = list(range(400, 410))
    ran = rig("scan", write_rig(tmp_path / "lossy", content), "--json", "--out", "run")
    summary = strict(ran.out)
    assert (ran.code, summary["verdict"]) == (1, "gaps")
    assert summary["frames"]["lost"] == 10  # type: ignore[index]
    assert strict(Path("run/manifest.json").read_text())["gaps"] == [[400, 409]]


def test_without_a_calibration_there_are_stripes_but_no_depth(rig: Rig, tmp_path: Path) -> None:
    content = config()
    content["calibration"] = None
    ran = rig("scan", write_rig(tmp_path / "bare", content), "--json", "--out", "run")
    assert (ran.code, strict(ran.out)["verdict"]) == (1, "uncalibrated")
    assert "stripe/000000.npz" in files(Path("run"))
    assert not [name for name in files(Path("run")) if name.startswith(("depth", "cloud"))]


def test_ctrl_c_keeps_the_whole_maps_and_exits_4(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stop_at_map(2, KeyboardInterrupt(), monkeypatch)
    ran = rig("scan", small, "--maps", 5, "--json", "--out", "run")
    summary = strict(ran.out)
    assert (ran.code, summary["verdict"], summary["maps"]) == (4, "aborted", 2)
    assert sorted(file.name for file in Path("run/depth").glob("*.npy")) == ["000000.npy", "000001.npy"]
    assert strict(Path("run/summary.json").read_text()) == summary


def test_ctrl_c_before_the_first_map_leaves_nothing(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stop_at_map(0, KeyboardInterrupt(), monkeypatch)
    ran = rig("scan", small, "--json", "--out", "run")
    assert (ran.code, strict(ran.out)["maps"]) == (4, 0)
    assert not list(Path().iterdir())


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_real_signal_ends_a_scan_in_order(small: Path, tmp_path: Path, name: str) -> None:
    # Background shells and nohup leave signals ignored, and a child would inherit that.
    handler = "default_int_handler" if name == "SIGINT" else "SIG_DFL"
    program = f"import signal; signal.signal(signal.{name}, signal.{handler}); from rig.cli import main; main()"
    command = [sys.executable, "-c", program, "scan", str(small), "--maps", "100000"]
    out = tmp_path / "run"
    with subprocess.Popen([*command, "--json", "--out", str(out)], stdout=-1, stderr=-1, text=True) as process:
        began = time.monotonic()
        while not list(tmp_path.glob(".run.*.part/depth/000001.npy")) and time.monotonic() - began < 60:
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.05)
        process.send_signal(getattr(signal, name))
        try:
            printed, said = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 4, said
    assert strict(printed)["verdict"] == "aborted"
    assert "Traceback" not in said
    assert (out / "summary.json").exists()
    assert not list(tmp_path.glob(".run*"))


def test_signals_are_as_before_after_a_command(rig: Rig) -> None:
    before = signal.getsignal(signal.SIGTERM)
    rig("config", "check")
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_interrupt_while_a_map_is_written_leaves_no_part_of_it(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_truth = RunFolder.write_truth

    def interrupted(self: RunFolder, index: int, *rest: object) -> None:
        if index == 1:
            raise KeyboardInterrupt
        write_truth(self, index, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(RunFolder, "write_truth", interrupted)
    ran = rig("scan", small, "--maps", 3, "--json", "--out", "run")
    summary = strict(ran.out)
    assert (ran.code, summary["verdict"], summary["maps"]) == (4, "aborted", 1)
    assert files(Path("run")) == FILES
    assert len(strict(Path("run/manifest.json").read_text())["sweeps"]) == 1  # type: ignore[arg-type]


def test_a_mistake_of_the_program_prints_its_traceback_and_exits_70(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_at_map(0, ZeroDivisionError("ours"), monkeypatch)
    ran = rig("scan", small, "--out", "run")
    assert (ran.code, ran.out) == (70, "")
    assert "Traceback" in ran.err
    assert "ZeroDivisionError: ours" in ran.err
    assert not list(Path().iterdir())


def test_a_map_without_any_depth_is_warned_of(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    estimate = Reconstructor.map

    def empty(self: Reconstructor, volume: object) -> MapResult:
        result = estimate(self, volume)  # type: ignore[arg-type]
        return dataclasses.replace(result, depth_m=np.full_like(result.depth_m, np.nan))

    monkeypatch.setattr(Reconstructor, "map", empty)
    ran = rig("scan", small, "--out", "run", "--json")
    assert ran.err.splitlines() == [
        "warning: no pixel has a depth; raise --exposures, lower --min-confidence or check the depth range"
    ]


def test_the_calibration_of_a_cube_is_refused_as_such(rig: Rig, tmp_path: Path) -> None:
    from tests.system.small_rig import calibration

    file = write_rig(tmp_path / "cube", config())
    content = calibration()
    del content["scanner"], content["source_m"], content["lag_s"]
    np.save(file.parent / "planes.npy", np.array([[1.0, 0.0, 0.3, 0.1]] * 200))
    (file.parent / "planes.yaml").write_text(yaml.safe_dump({**content, "planes": "planes.npy"}))
    file.write_text(file.read_text().replace("calibration: rig.yaml", "calibration: planes.yaml"))
    ran = rig("scan", file, "--dry-run")
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "is for a bare cube" in ran.problems[0]


def test_problems_of_spad_and_scanner_are_listed_together(rig: Rig, tmp_path: Path) -> None:
    content = config()
    content["scan"] |= {"frame_rate": "1 MHz", "columns": 3}
    ran = rig("scan", write_rig(tmp_path / "fast", content))
    assert ran.code == 2
    assert "the most the" in ran.problems[0]
    assert "scan of 3 columns" in ran.problems[-1]
    assert len(ran.problems) >= 2


def test_a_full_disk_is_one_line_and_leaves_nothing(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_disk_after(3, monkeypatch)
    ran = rig("scan", small, "--json", "--out", "run")
    assert ran.code == 2
    assert ran.out == ""
    assert len(ran.problems) == 1
    assert "No space left on device" in ran.problems[0]
    assert not list(Path().iterdir())


def test_a_disk_that_fills_later_keeps_the_whole_maps(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_map = RunFolder.write_map

    def limited(self: RunFolder, index: int, *rest: object) -> None:
        if index == 2:
            with monkeypatch.context() as patch:
                fill_disk_after(3, patch)
                write_map(self, index, *rest)  # type: ignore[arg-type]
        write_map(self, index, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(RunFolder, "write_map", limited)
    ran = rig("scan", small, "--maps", 4, "--out", "run")
    assert ran.code == 2
    assert "2 of 4 maps were whole" in ran.err
    assert not [name for name in files(Path("run")) if "000002" in name]
    assert strict(Path("run/summary.json").read_text())["verdict"] == "aborted"


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"scan.colums": 500}, "unknown key 'scan.colums'; did you mean 'columns'?"),
        ({"scan.frame_rate": 100000}, 'has no unit; write the frequency with a unit, like "100 kHz"'),
        ({"scan.depth_range": ["1 m", 8]}, "has no unit"),
        ({"scan.exposures": -4}, "exposures is -4, it must be at least 1"),
        ({"scan.columns": 3, "scan.exposures": 1}, "raise scan.exposures to"),
        ({"scan.depth_range": ["8 m", "1 m"]}, "near < far"),
        ({"spad.kind": "simulatd"}, "choose one of"),
        ({"world.scene": "nowhere"}, "scene 'nowhere'"),
        ({"calibration": "absent.yaml"}, "cannot read calibration"),
        ({"calibration": "other.yaml"}, "sensor of 128 x 40 pixels, this one has 96 x 40"),
        ({"scan.command_range": [-1, 1]}, "command"),
    ],
)
def test_a_bad_config_is_refused_in_a_line_and_nothing_is_left(
    rig: Rig, tmp_path: Path, edit: dict[str, object], said: str
) -> None:
    from tests.system.small_rig import calibration

    content = config()
    for key, value in edit.items():
        *section, name = key.split(".")
        (content[section[0]] if section else content)[name] = value
    file = write_rig(tmp_path / "bad", content)
    (file.parent / "other.yaml").write_text(yaml.safe_dump(calibration(width=128)))
    ran = rig("scan", file, "--out", "deep/run", "--json")
    assert ran.code == 2
    assert ran.out == ""
    assert said in ran.err
    assert ran.err.splitlines() == ran.problems
    assert len(ran.problems) == 1
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--no-such-option"], "No such option"),
        (["--on-overload", "ignore"], "write 'abort', 'drop' or 'block'"),
        (["--dry-run", "--on-overload", "ignore"], "write 'abort', 'drop' or 'block'"),
        (["--exposures", "-1"], "--exposures is -1, it must be at least 1; write for example '--exposures 10'"),
        (["--exposures", "many"], "write a whole number or see 'rig scan --help'"),
        (["--min-confidence", "high"], "write a number or see 'rig scan --help'"),
        (["--maps", "0"], "maps is 0; it must be at least 1"),
        (["--seed", "-3"], "seed is -3; it must be 0 or more"),
        (["--seed", str(2**63)], "at most 2^63 - 1"),
        (["--dry-run", "--maps", "0"], "maps is 0; it must be at least 1"),
        (["--dry-run", "--seed", "-5"], "seed is -5; it must be 0 or more"),
        (["--dry-run", "--save", "never"], "write 'all', 'last' or 'every N'"),
        (["--estimator", "best"], "choose 'argmax', 'edge'"),
        (["--filter", "mean"], "choose 'none' or 'median'"),
        (["--min-confidence", "1.5"], "--min-confidence is 1.5, it must be at most 1"),
        (["--save", "some"], "write 'all', 'last' or 'every N'"),
        (["--save", "every", "0"], "'every N' with N of 1 or more"),
        (["--scene", "nowhere"], "scene 'nowhere' is no file, no folder and none of the bundled"),
    ],
)
def test_a_bad_option_is_refused_in_a_line(rig: Rig, small: Path, arguments: list[str], said: str) -> None:
    ran = rig("scan", small, *arguments)
    assert ran.code == 2
    assert said in ran.err
    assert len(ran.err.splitlines()) == 1
    assert not list(Path().iterdir())


def test_several_problems_are_listed_together(rig: Rig, tmp_path: Path) -> None:
    content = config()
    content["scan"] |= {"exposures": -4, "frame_rate": 1e5, "colums": 3}
    ran = rig("scan", write_rig(tmp_path / "bad", content))
    assert len(ran.problems) == 3


def test_an_out_folder_that_cannot_be_is_refused_before_anything_runs(rig: Rig, small: Path) -> None:
    Path("file").write_text("")
    Path("full").mkdir()
    Path("full/notes.txt").write_text("mine")
    for out, said in (("file", "is a file"), ("file/run", "cannot write"), ("full", "not empty")):
        ran = rig("scan", small, "--out", out)
        assert (ran.code, len(ran.problems)) == (2, 1)
        assert said in ran.problems[0]
    assert files(Path()) == {"file", "full/notes.txt"}


def stop_at_map(index: int, error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the estimation of a map raise."""
    estimate = Reconstructor.map
    done: list[int] = []

    def limited(self: Reconstructor, volume: object) -> MapResult:
        if len(done) == index:
            raise error
        done.append(1)
        return estimate(self, volume)  # type: ignore[arg-type]

    monkeypatch.setattr(Reconstructor, "map", limited)


def fill_disk_after(files: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every write but the first few fail, half done, as on a full disk."""
    write = Path.write_bytes
    done: list[int] = []

    def limited(self: Path, data: bytes) -> int:
        done.append(1)
        if len(done) <= files:
            return write(self, data)
        write(self, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", limited)
