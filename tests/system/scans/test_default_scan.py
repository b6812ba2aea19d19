"""`rig scan` with no options at all: the first thing a new user does."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

RIG = Path(sys.executable).parent / "rig"
LARGEST_KIB = 2 * 1024 * 1024
# A child's peak counts the memory of whoever started it, up to the start of its own program: pytest's, which may be
# larger than the scan's. So a small program starts the scan, and says the scan's peak as its last line of errors.
START_AND_TELL_PEAK = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
sys.exit(done.returncode)
"""


def test_the_default_scan_is_accurate_and_stays_below_two_gib(tmp_path: Path) -> None:
    pytest.importorskip("resource", reason="peak memory is read the POSIX way")
    command = [sys.executable, "-c", START_AND_TELL_PEAK, str(RIG), "scan", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["verdict"] == "complete"
    assert (summary["estimator"], summary["estimator_why"]) == ("joint", "no frame waits for its maps")
    assert summary["truth"]["stripe_error_px"]["mean_abs"] < 0.1
    assert summary["truth"]["stripe_error_px"]["missing"] <= 0.05
    (folder,) = (tmp_path / "runs").iterdir()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["config"]["estimate"]["estimator"] == "joint"
    for name in ("depth/000000.png", "intensity/000000.png", "cloud/000000.ply", "learned/000000.npz"):
        assert (folder / name).stat().st_size > 1000
    assert int(done.stderr.splitlines()[-1]) < LARGEST_KIB
