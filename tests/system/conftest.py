"""Runs the command line inside the test's own process."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from rig import api
from rig.cli.main import main
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
