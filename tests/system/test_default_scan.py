"""`rig scan` with no options at all: the first thing a new user does."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

RIG = Path(sys.executable).parent / "rig"
LARGEST_KIB = 2 * 1024 * 1024


def test_the_default_scan_is_accurate_and_stays_below_two_gib(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource", reason="peak memory is read the POSIX way")
    done = subprocess.run([str(RIG), "scan", "--json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["verdict"] == "complete"
    assert summary["truth"]["stripe_error_px"]["mean_abs"] < 0.5
    assert summary["truth"]["stripe_error_px"]["missing"] <= 0.05
    (folder,) = (tmp_path / "runs").iterdir()
    for name in ("depth/000000.png", "intensity/000000.png", "cloud/000000.ply", "learned/000000.npz"):
        assert (folder / name).stat().st_size > 1000
    # The largest child of this process so far: a bound on the scan's own peak.
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < LARGEST_KIB
