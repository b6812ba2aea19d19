"""The wheel and the source distribution, as another lab gets them: their content, and the program installed from the
wheel in an environment of its own, outside the checkout. `make packages` tries the same with a scan.
"""

import json
import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import numpy
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("calibration", "drivers", "rig", "sim_backend", "spadrig")


def run(*command: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """A command in a folder, without the environment's import path."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(list(map(str, command)), cwd=folder, env=kept, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the wheel and the source distribution."""
    folder = tmp_path_factory.mktemp("built")
    made = run(sys.executable, "-m", "hatchling", "build", "-d", folder, folder=ROOT)
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (found,) = built.glob("spadrig-*.whl")
    return found


@pytest.fixture(scope="module")
def lab(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel and, from the present one, all else that it needs. Its programs are in `bin`."""
    place = tmp_path_factory.mktemp("lab") / "venv"
    venv.create(place, with_pip=False, symlinks=True)
    python = place / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-index", "--no-deps"]
    made = run(*pip, "--no-compile", "--disable-pip-version-check", wheel, folder=place)
    assert made.returncode == 0, made.stderr
    (site,) = place.glob("lib/python*/site-packages")
    # Not by a link: an editable install of the checkout, which is a .pth file there, must not be read.
    (site / "others.pth").write_text(f"{Path(numpy.__file__).parents[1]}\n")
    return place / "bin"


def test_the_wheel_has_packages_types_configs_and_licence_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {*PACKAGES, "config"}
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(names)
    bundled = {path.relative_to(ROOT).as_posix() for path in (ROOT / "config").rglob("*") if path.is_file()}
    assert {name for name in names if name.startswith("config/")} == bundled
    sources = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert {name for name in names if name.endswith(".py")} == sources
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert wheel.stat().st_size < 3e6


def test_the_source_distribution_has_all_that_its_own_tests_need(built: Path) -> None:
    (archive,) = built.glob("spadrig-*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    tracked = run("git", "ls-files", folder=ROOT).stdout.split()  # nothing outside a checkout: then there is no claim
    assert {name for name in tracked if not name.startswith((".", "docs/_"))} <= names
    assert not [name for name in names if name.startswith("docs/_build") or "__pycache__" in name]


def test_the_installed_program_finds_its_configs_kinds_and_itself_from_any_folder(lab: Path, tmp_path: Path) -> None:
    rig = lab / "rig"
    assert "Usage: rig" in run(rig, "--help", folder=tmp_path).stdout
    listed = json.loads(run(rig, "scenes", "--json", folder=tmp_path).stdout)
    assert {"lab", "lab-emulated", "simulated"} <= {one["name"] for one in listed["rigs"]}
    assert "street" in {one["name"] for one in listed["scenes"]}
    for name in ("lab", "lab-emulated"):
        checked = run(rig, "config", "check", name, folder=tmp_path)
        assert (checked.returncode, checked.stdout.split(": ")[0]) == (0, name), checked.stderr
    schema = json.loads(run(rig, "config", "schema", folder=tmp_path).stdout)
    assert len(schema["properties"]["laser"]["oneOf"]) >= 6
    places = (
        "import rig, drivers, calibration, sim_backend, spadrig; print([m.__file__ for m in (rig, drivers, spadrig)])"
    )
    shown = run(lab / "python", "-c", places, folder=tmp_path)
    assert shown.stdout.count(str(lab.parent)) == 3, shown.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_labs_script_is_typed_strictly_against_the_installed_packages(lab: Path, tmp_path: Path) -> None:
    script = tmp_path / "lab_script.py"
    script.write_text((ROOT / "examples" / "lab_script.py").read_text() + "\nreveal_type(scan)\n")
    wrong = tmp_path / "wrong.py"
    wrong.write_text("from rig.api import scan\nscan('simulated', live=3)\n")
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", lab / "python", "--cache-dir", os.devnull]
    checked = run(*mypy, "--config-file=", script, wrong, folder=tmp_path)
    assert 'wrong.py:2: error: Argument "live" to "scan" has incompatible type "int"' in checked.stdout
    assert "Found 1 error in 1 file (checked 2 source files)" in checked.stdout, checked.stdout + checked.stderr
    assert "rig.scan.run.RunResult" in checked.stdout  # reveal_type: the packages' own types, not Any
