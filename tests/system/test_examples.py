"""The programs in `examples/`, run as a lab would."""

import subprocess
import sys
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
