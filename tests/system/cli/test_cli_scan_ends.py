"""How `rig scan` ends where it does not end well: lost frames, full disks, interrupts, mistakes of the program."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rig.depth.reconstruct import MapResult, Reconstructor
from rig.run_folder.folder import RunFolder
from tests.system.conftest import Rig, fill_disk_at_map, stop_at_map
from tests.system.run_files import FILES, files, strict
from tests.system.small_rig import config, write_rig


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


@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 3 GiB"), ZeroDivisionError("by 0")])
def test_an_error_of_any_kind_keeps_the_whole_maps(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    stop_at_map(2, error, monkeypatch)
    ran = rig("scan", small, "--maps", 5, "--out", "run")
    assert sorted(file.name for file in Path("run/depth").glob("*.npy")) == ["000000.npy", "000001.npy"]
    assert strict(Path("run/summary.json").read_text())["verdict"] == "aborted"
    if isinstance(error, MemoryError):
        told = "out of memory: Unable to allocate 3 GiB; end other programs, or take less at a time"
        assert (ran.code, ran.problems) == (3, [f"error: {told}"])
        assert "Traceback" not in ran.err
    else:
        assert ran.code == 70


def test_an_aborted_run_says_what_of_it_is_kept(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        stop_at_map(0, KeyboardInterrupt(), patch)
        nothing = rig("scan", small, "--out", "run")
        frames = rig("scan", small, "--record", "--out", "recorded")
    with monkeypatch.context() as patch:
        stop_at_map(1, KeyboardInterrupt(), patch)
        maps = rig("scan", small, "--maps", 3, "--out", "run")
    before = "verdict aborted: the run ended before its first map was whole;"
    told = [" ".join(ran.out.split()) for ran in (nothing, frames, maps)]
    assert told[0].endswith(f"{before} nothing is kept")
    assert told[1].endswith(f"{before} the recorded frames are kept in {Path('recorded').absolute()}")
    after = "verdict aborted: the run ended before its last map;"
    assert told[2].endswith(f"{after} whole maps are kept, and with --record every frame that came")


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_real_signal_ends_a_scan_in_order(small: Path, tmp_path: Path, name: str) -> None:
    # Background shells and nohup leave signals ignored, and a child would inherit that.
    handler = "default_int_handler" if name == "SIGINT" else "SIG_DFL"
    program = f"import signal; signal.signal(signal.{name}, signal.{handler}); from rig.cli.main import main; main()"
    command = [sys.executable, "-c", program, "scan", str(small), "--maps", "100000"]
    out = tmp_path / "run"
    with subprocess.Popen([*command, "--json", "--out", str(out)], stdout=-1, stderr=-1, text=True) as process:
        began = time.monotonic()
        while not list(tmp_path.glob(".run.*.part/depth/000001.npy")) and time.monotonic() - began < 300:
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.05)
        process.send_signal(getattr(signal, name))
        try:
            printed, said = process.communicate(timeout=300)
        finally:
            process.kill()
    assert process.returncode == 4, said
    assert strict(printed)["verdict"] == "aborted"
    assert "Traceback" not in said
    assert (out / "summary.json").exists()
    assert not list(tmp_path.glob(".run*"))


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


def test_a_disk_that_fills_later_keeps_the_whole_maps(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_disk_at_map(2, monkeypatch)
    ran = rig("scan", small, "--maps", 4, "--out", "run")
    assert ran.code == 3
    assert "2 of 4 maps were whole" in ran.err
    assert not [name for name in files(Path("run")) if "000002" in name]
    assert strict(Path("run/summary.json").read_text())["verdict"] == "aborted"


@pytest.mark.parametrize(
    ("command", "options", "at"),
    [(["effects"], [], 0), (["effects"], [], 2), (["calibrate", "pixels"], ["--light", "--out", "out"], 1)],
)
def test_ctrl_c_in_a_scan_within_another_command_ends_that_in_one_line(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], options: list[str], at: int
) -> None:
    stop_at_map(at, KeyboardInterrupt(), monkeypatch)
    ran = rig(*command, small, *options)
    assert (ran.code, ran.err) == (4, "aborted\n")
    assert not list(Path().iterdir())


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(("then", "ended"), [("raise KeyboardInterrupt", (4, "aborted\n")), ("return []", (0, ""))])
def test_further_signals_change_nothing_of_how_a_command_has_ended(then: str, ended: tuple[int, str]) -> None:
    program = (
        "import atexit, os, signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "signal.signal(signal.SIGTERM, signal.SIG_DFL)\n"
        "atexit.register(lambda: [os.kill(os.getpid(), number) for number in (signal.SIGINT, signal.SIGTERM)])\n"
        "from rig import api\n"
        "from rig.cli.main import main\n"
        f"def found(*given, **options): {then}\n"
        "api.runs = found\n"
        "main()\n"
    )
    ran = subprocess.run([sys.executable, "-c", program, "runs", "--json"], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stderr) == ended


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_reader_that_goes_away_changes_nothing_of_how_a_command_ends(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    try:
        command = [sys.executable, "-m", "spadrig", "runs", str(tmp_path)]
        ran = subprocess.run(command, stdout=write, stderr=write, timeout=60, check=False)
        failed = subprocess.run([*command, "--since", "never"], stdout=write, stderr=write, timeout=60, check=False)
    finally:
        os.close(write)
    assert (ran.returncode, failed.returncode) == (0, 2)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_closed_terminal_which_sends_its_signal_twice_interrupts_once() -> None:
    program = (
        "import os, signal\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "from rig import api\n"
        "from rig.cli.main import main\n"
        "def found(*given, **options):\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGHUP)\n"
        "    finally:\n"
        "        os.kill(os.getpid(), signal.SIGHUP)\n"
        "        print('all is put away')\n"
        "api.runs = found\n"
        "main()\n"
    )
    ran = subprocess.run([sys.executable, "-c", program, "runs"], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout, ran.stderr) == (4, "all is put away\n", "aborted\n")


def test_an_interrupt_that_python_drops_comes_again() -> None:
    program = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from rig import api\n"
        "from rig.cli.main import main\n"
        "class Interrupts:\n"
        "    def __del__(self): raise KeyboardInterrupt\n"
        "def found(*given, **options):\n"
        "    Interrupts()\n"
        "    ends_at = time.monotonic() + 20\n"
        "    while time.monotonic() < ends_at: pass\n"
        "    return []\n"
        "api.runs = found\n"
        "main()\n"
    )
    ran = subprocess.run([sys.executable, "-c", program, "runs", "--json"], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stderr) == (4, "aborted\n")


def test_an_interrupt_before_a_command_has_begun_is_one_too(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("typer.core.TyperGroup.resolve_command", lambda *_: interrupted())
    ran = rig("config", "check")
    assert (ran.code, ran.err) == (4, "aborted\n")


@pytest.mark.parametrize("loaded", ["rig.kernel_cache", "typer"])
@pytest.mark.parametrize("options", [[], ["--json"]])
def test_an_interrupt_while_the_program_is_loaded_is_one_too(loaded: str, options: list[str]) -> None:
    program = (
        "import sys\n"
        "class Interrupts:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == '{loaded}':\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupts())\n"
        "from spadrig.__main__ import main\n"
        "main()\n"
    )
    ran = subprocess.run([sys.executable, "-c", program, *options], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (4, "aborted\n")
    printed = [json.loads(line) for line in ran.stdout.splitlines()]
    assert printed == [{"error": {"code": 4, "problems": ["aborted"]}} for _ in options]
