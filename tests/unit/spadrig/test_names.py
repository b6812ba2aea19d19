"""Import names that lead elsewhere are found by `import rig` and by the command, in a process of its own each."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = ("rig", "drivers", "calibration", "sim_backend", "spadrig")


def python(*arguments: str, work: Path, path: Path | str = ROOT) -> subprocess.CompletedProcess[str]:
    """Python in the folder `work`, with `path` as the only addition to its import path."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=work,
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the packages as an installer leaves them; only `rig` and `spadrig` may be changed."""
    top = tmp_path / "site"
    top.mkdir()
    for name in PACKAGES:
        if name in ("rig", "spadrig"):
            shutil.copytree(ROOT / name, top / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (top / name).symlink_to(ROOT / name)
    return top


def overwrite_rig(top: Path) -> None:
    """Install another distribution `rig` over ours, as pip does it."""
    (top / "rig" / "__init__.py").write_text('"""Rig of somebody else."""\n')
    info = top / "rig-2.4.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rig\nVersion: 2.4.5\n")
    (info / "top_level.txt").write_text("rig\n")


@pytest.mark.parametrize("name", ["drivers.py", "calibration/__init__.py", "sim_backend.py"])
def test_a_labs_own_module_beside_a_notebook_is_named_when_rig_is_imported(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("GALVO = 1\n")
    ended = python("-c", "import rig", work=tmp_path)
    assert ended.returncode == 1
    said = ended.stderr.splitlines()[-1]
    hiding = tmp_path / name.removesuffix("/__init__.py")
    package = name.split("/")[0].removesuffix(".py")
    assert said.startswith(f"ImportError: {hiding} hides the package '{package}' of spadrig in {ROOT / package}; ")
    assert "rename it" in said


def test_a_labs_own_config_folder_and_module_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "__init__.py").write_text("")
    (tmp_path / "config" / "lab.yaml").write_text("nothing of ours")
    look = "import config; from rig.config.bundled import bundled_rigs; print(bundled_rigs()[-1].name, config.__file__)"
    ended = python("-c", look, work=tmp_path)
    assert (ended.stderr, ended.stdout) == ("", f"small {tmp_path / 'config' / '__init__.py'}\n")


def test_the_command_names_a_foreign_rig_on_the_path_in_one_line_and_as_json(tmp_path: Path) -> None:
    foreign = tmp_path / "ros" / "rig"
    foreign.mkdir(parents=True)
    (foreign / "__init__.py").write_text("")
    ended = python("-m", "spadrig", "--json", "scan", work=tmp_path, path=f"{foreign.parent}{os.pathsep}{ROOT}")
    (said,) = ended.stderr.splitlines()
    assert ended.returncode == 2
    assert said.startswith(f"error: {foreign} hides the package 'rig' of spadrig in {ROOT / 'rig'}; ")
    assert "PYTHONPATH" in said
    assert json.loads(ended.stdout) == {"error": {"code": 2, "problems": [said.removeprefix("error: ")]}}


def test_another_distribution_that_overwrote_ours_is_named_with_what_to_do(installed: Path, tmp_path: Path) -> None:
    overwrite_rig(installed)
    ends = [
        python("-c", "from rig import api", work=tmp_path, path=installed),
        python("-m", "spadrig", "--help", work=tmp_path, path=installed),
    ]
    for ended in ends:
        said = ended.stderr.splitlines()[-1]
        assert f"{installed / 'rig' / '__init__.py'} was overwritten by the package 'rig'; " in said
        assert "'python -m pip uninstall rig', then 'python -m pip install --force-reinstall --no-deps spadrig'" in said
    assert [ended.returncode for ended in ends] == [1, 2]


def test_what_an_uninstaller_took_along_is_named(installed: Path, tmp_path: Path) -> None:
    (installed / "rig" / "__init__.py").unlink()
    ended = python("-S", "-m", "spadrig", "--version", work=tmp_path, path=installed)
    (said,) = ended.stderr.splitlines()
    assert ended.returncode == 2
    assert said.startswith(f"error: {installed / 'rig' / '__init__.py'} is missing; call 'python -m pip install")


def test_nothing_is_in_the_way_of_a_clean_install_and_the_look_imports_none_of_ours(
    installed: Path, tmp_path: Path
) -> None:
    look = (
        "import sys; from spadrig.names import intruder; print(intruder());"
        "print([n for n in ('rig', 'drivers', 'calibration', 'importlib.metadata') if n in sys.modules])"
    )
    ended = python("-S", "-c", look, work=tmp_path, path=installed)
    assert (ended.stderr, ended.stdout) == ("", "None\n[]\n")
    version = python("-m", "spadrig", "--version", work=tmp_path, path=installed)
    assert (version.returncode, version.stderr) == (0, "")
