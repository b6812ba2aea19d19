"""What works without the modules and functions that only POSIX systems have, and with files that are in use protected
as on Windows. It has not been tried on Windows.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rig import api
from tests.system.without_posix import PROTECTED, in_use

ROOT = Path(__file__).parents[2]


def rig(*commands: list[object], typed: str = "") -> subprocess.CompletedProcess[str]:
    """Commands of `rig` in one such process, with something typed on its standard input."""
    words = [[str(word) for word in command] for command in commands]
    code = f"from tests.system.without_posix import run, strip; strip(); run(*{words!r})"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, input=typed, capture_output=True, text=True, timeout=600
    )


@pytest.mark.slow
def test_scan_record_replay_reconstruct_and_the_commands_for_recordings_work(small: Path, tmp_path: Path) -> None:
    take, commands = tmp_path / "take", ("scan", "verify", "info", "replay", "reconstruct", "cut", "export", "repair")
    options: list[list[object]] = [
        [small, "--maps", 2, "--record", "--seed", 1, "--out", take],
        [take],
        [take],
        [take, "--clock", "max", "--out", tmp_path / "again"],
        [take, "--out", tmp_path / "once more"],
        [take, "--maps", "0:1", "--out", tmp_path / "part"],
        [take, "png"],
        [take],
    ]
    ran = rig(*([name, *rest] for name, rest in zip(commands, options, strict=True)))
    ends = [line for line in ran.stdout.splitlines() if " -> " in line]
    assert ends == [f"{name} -> 0" for name in commands], ran.stderr
    api.scan(small, maps=2, seed=1, out=tmp_path / "usual")
    for folder in ("take", "again", "once more"):
        for number in range(2):
            name = f"depth/{number:06d}.npy"
            assert np.array_equal(
                np.load(tmp_path / folder / name), np.load(tmp_path / "usual" / name), equal_nan=True
            ), folder


@pytest.mark.slow
def test_a_recording_is_compressed_and_a_torn_one_repaired_although_mapped_files_are_protected(run: Path) -> None:
    (segment,) = run.glob("frames-*.spb")
    with segment.open("ab") as file:
        file.write(b"torn")
    ran = rig(["repair", run], ["verify", run], ["compress", run], ["verify", run])
    ends = [line for line in ran.stdout.splitlines() if " -> " in line]
    assert ends == ["repair -> 0", "verify -> 0", "compress -> 0", "verify -> 0"], ran.stderr
    assert not segment.exists()


@pytest.mark.slow
def test_a_replay_by_steps_takes_lines_where_select_takes_only_sockets(run: Path, tmp_path: Path) -> None:
    ran = rig(["replay", run, "--clock", "step", "--out", tmp_path / "stepped"], typed="\n\n")
    assert "replay -> 0" in ran.stdout, ran.stderr
    assert len(list((tmp_path / "stepped" / "depth").glob("*.npy"))) == 2


@pytest.mark.long
@pytest.mark.slow
def test_pixels_and_lag_are_calibrated(small: Path, tmp_path: Path) -> None:
    ran = rig(
        ["calibrate", "pixels", small, "--out", tmp_path / "pixels"],
        ["calibrate", "sync", small, "--out", tmp_path / "sync"],
    )
    assert ran.stdout.count("calibrate -> 0") == 2, ran.stderr


@pytest.mark.slow
def test_real_and_emulated_light_is_refused_in_a_sentence_and_the_schema_still_has_all_kinds(tmp_path: Path) -> None:
    ran = rig(
        ["scan", "lab", "--arm", "--out", tmp_path / "real"],
        ["scan", "lab-emulated", "--out", tmp_path / "emulated"],
        ["config", "check", "lab"],
        ["config", "schema"],
    )
    refused = (
        "error: light is guarded by a process that takes it away if the program dies or hangs, which needs Linux; use "
        "a simulated laser and sync source here, or scan from a Linux PC"
    )
    assert [line for line in ran.stderr.splitlines() if line.startswith("error: ")] == [refused] * 2
    assert [line[-4:] for line in ran.stdout.splitlines() if " -> " in line] == ["-> 3", "-> 3", "-> 0", "-> 0"]
    assert not list(tmp_path.iterdir())


def test_the_stand_in_for_windows_protects_open_and_mapped_files(tmp_path: Path) -> None:
    file, free = tmp_path / "open", tmp_path / "free"
    file.write_bytes(bytes(4096))
    free.write_bytes(bytes(4096))
    with file.open("rb"):
        assert in_use(file)
        assert not in_use(free)
    mapped = np.memmap(file, np.uint8, "r")
    assert in_use(file)
    del mapped
    assert not in_use(file)
    code = (
        "import os, sys; from tests.system.without_posix import strip; strip(); held = open(sys.argv[1], 'rb')\n"
        "try: os.unlink(sys.argv[1])\nexcept PermissionError as error: print(error.strerror)\n"
        "try: import fcntl\nexcept ImportError: print('no fcntl', hasattr(os, 'memfd_create'))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, str(file)], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    assert ended.stdout.splitlines() == [PROTECTED, "no fcntl False"]
