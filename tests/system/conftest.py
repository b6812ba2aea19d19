"""Runs the command line inside the test's own process."""

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest

from rig import api
from rig.cli.main import main
from rig.count.volume import FrameTally
from rig.depth.reconstruct import MapResult, Reconstructor
from rig.run_folder.folder import RunFolder
from tests.system.small_rig import write_rig


@dataclass(frozen=True, slots=True)
class Ran:
    """What a command printed and how it ended."""

    code: int
    out: str
    err: str

    @property
    def problems(self) -> list[str]:
        """Its error lines."""
        return [line for line in self.err.splitlines() if line.startswith("error: ")]


Rig = Callable[..., Ran]


@pytest.fixture
def rig(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """`rig` with the given arguments, in an empty working directory."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr("rig.cli.progress.PATIENCE_S", 3600.0)  # however slow the machine, progress is not in `err`

    def run(*arguments: object) -> Ran:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return Ran(ended.value.code, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of two maps of the small rig with their recording, which stays as it is."""
    folder = tmp_path_factory.mktemp("scanned")
    api.scan(write_rig(folder / "rig"), maps=2, out=folder / "run", record=True)
    return folder / "run"


@pytest.fixture
def run(scanned: Path, tmp_path: Path) -> Path:
    """A copy of it of the test's own."""
    return Path(shutil.copytree(scanned, tmp_path / "run"))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Config file of a small simulated rig."""
    return write_rig(tmp_path / "small-rig")


def at_map(index: int, act: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """Do something as soon as the estimation of a map begins, and again at the next one where it raises."""
    estimate = Reconstructor.map
    begun: list[FrameTally] = []

    def acting(self: Reconstructor, sweep: FrameTally) -> MapResult:
        if len(begun) == index:
            act()
        begun.append(sweep)
        return estimate(self, sweep)

    monkeypatch.setattr(Reconstructor, "map", acting)


def stop_at_map(index: int, error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the estimation of a map raise."""
    at_map(index, Mock(side_effect=error), monkeypatch)


def fill_disk_at_map(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let writing fail half done, as on a full disk, behind the third file of a map."""
    write_map, write = RunFolder.write_map, Path.write_bytes

    def limited(self: RunFolder, number: int, *rest: object) -> None:
        files = count()

        def full(file: Path, data: bytes) -> int:
            if next(files) < 3:
                return write(file, data)
            write(file, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patch:
            if number == index:
                patch.setattr(Path, "write_bytes", full)
            write_map(self, number, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(RunFolder, "write_map", limited)
