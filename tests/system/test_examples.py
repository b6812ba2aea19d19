"""The programs in `examples/`, run as a lab would."""

import shutil
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest

from tests.system.small_rig import HEIGHT, WIDTH

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
def test_a_labs_script_scans_watches_reads_its_files_and_uses_one_laser(small: Path, tmp_path: Path) -> None:
    script = [sys.executable, str(EXAMPLES / "lab_script.py"), str(tmp_path / "out"), str(small)]
    ended = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stderr) == (0, "")
    said = ended.stdout.splitlines()
    assert said[0].startswith("complete: 2 sweeps counted, ")
    depths = [np.load(tmp_path / "out" / "depth" / f"{number:06d}.npy") for number in range(2)]
    assert said[1] == "median depth of each map: " + ", ".join(f"{np.nanmedian(each):.2f} m" for each in depths)
    assert depths[0].shape == (HEIGHT, WIDTH)
    assert said[3].endswith(", emits")


WRONG = """
import numpy as np
import pytest
from dataclasses import replace
from drivers.clock import VirtualClock
from foglab.centroid import Centroid
from foglab.filtered_laser import FilteredLaser
from spadrig.conformance import EstimatorSuite, LaserCase, LineLaserSuite, SyncSourceSuite


class StaysOn(FilteredLaser):
    def _do_pause(self) -> None:
        self._emission = False


class Shifted(Centroid):
    def estimate(self, sweep, geometry):
        table = super().estimate(sweep, geometry)
        return replace(table, x_px=table.x_px + np.float32(1.5))


class TestLaser(LineLaserSuite):
    @pytest.fixture
    def laser(self):
        light_w = [0.0]
        with StaysOn(0.5, 0.2, light_w.append) as device:
            yield LaserCase(device, VirtualClock(), lambda: light_w[-1] > 0)


class TestShifted(EstimatorSuite):
    @pytest.fixture
    def create_estimator(self):
        return Shifted


class TestForgotten(SyncSourceSuite):
    pass
"""


@pytest.fixture(scope="module")
def plugged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment in which the package of `examples/plugin` is installed, beside this one's packages."""
    place = tmp_path_factory.mktemp("plugged") / "venv"
    venv.create(place, with_pip=False, symlinks=True)
    python = place / "bin" / "python"
    (site,) = place.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(f"{Path(np.__file__).parents[1]}\n{EXAMPLES.parent}\n")
    source = shutil.copytree(EXAMPLES / "plugin", tmp_path_factory.mktemp("source") / "plugin")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-index", "--no-deps"]
    run = [*pip, "--disable-pip-version-check", "--no-build-isolation", source]
    subprocess.run(list(map(str, run)), check=True, capture_output=True, text=True)
    return python


def run_pytest(python: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *arguments]
    return subprocess.run(list(map(str, command)), cwd=folder, capture_output=True, text=True, timeout=600)


@pytest.mark.slow
def test_the_plugin_passes_the_suites_that_we_ship_and_scans_by_its_names(plugged: Path, tmp_path: Path) -> None:
    shutil.copytree(EXAMPLES / "plugin", tmp_path / "plugin")
    shutil.rmtree(tmp_path / "plugin" / "foglab")  # so that the installed one is tested
    ended = run_pytest(plugged, tmp_path / "plugin", "tests")
    assert ended.returncode == 0, ended.stdout
    assert "22 passed" in ended.stdout
    names = "from rig.config.estimators import estimator_names; from drivers.registry import kinds;"
    shown = subprocess.run(
        [plugged, "-c", f"{names} print(estimator_names()[-1], 'foglab-filtered' in kinds('laser'))"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert shown.stdout == "foglab-centroid True\n"


@pytest.mark.slow
def test_the_suites_find_a_laser_that_stays_on_a_shifted_estimator_and_a_forgotten_fixture(
    plugged: Path, tmp_path: Path
) -> None:
    (tmp_path / "test_wrong.py").write_text(WRONG)
    said = run_pytest(plugged, tmp_path, "test_wrong.py").stdout
    assert "FAILED test_wrong.py::TestLaser::test_a_pause_is_dark_and_armed_and_ends_with_the_next_arm" in said
    assert "FAILED test_wrong.py::TestShifted::test_a_clear_stripe_is_found_and_believed" in said
    assert "write a fixture 'sync' that yields a spadrig.conformance.SyncCase; see docs/how-to/plugin.md" in said
    assert "+  where True = " in said  # assertions of the suites are told in detail


def test_pytest_loads_the_plug_in_without_anything_of_the_project(tmp_path: Path) -> None:
    (tmp_path / "test_other.py").write_text(
        "import sys\n\n\ndef test_other():\n"
        "    assert 'spadrig.pytest_plugin' in sys.modules\n"
        "    assert not {'numpy', 'drivers', 'rig', 'spadrig.conformance'} & set(sys.modules)\n"
    )
    ended = run_pytest(Path(sys.executable), tmp_path, "-W", "error", "-p", "no:hypothesispytest", "test_other.py")
    assert ended.returncode == 0, ended.stdout
