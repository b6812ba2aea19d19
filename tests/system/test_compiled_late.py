"""Nothing is left to compile once a laser is armed: seconds in which an application takes no frames end its light."""

import os
import subprocess
import sys
from pathlib import Path

from rig.estimate.registry import ESTIMATORS

ROOT = Path(__file__).parents[2]


def test_no_kernel_is_compiled_after_arming(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.system.compiled_late", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("scanned") == 1 + len(ESTIMATORS)
    assert "late:" not in ran.stdout, ran.stdout
