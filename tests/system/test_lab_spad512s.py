"""A SPAD without markers, all the way: TCP -> driver -> blanking pattern -> depth map through fog."""

import json
from fractions import Fraction

import pytest

from rig import api
from rig.config.overrides import configure
from rig.devices import prepare


def test_a_scan_with_a_spad_without_markers_ends_in_a_depth_map(tmp_path, monkeypatch):
    """Slower than the bundled rig, so that a host with much else to do starts the scanner within the burst."""
    monkeypatch.setattr(prepare, "HOST_LEAD_S", 0.8)
    usual = configure("lab-spad512s-emulated")
    slow = usual.model_copy(
        update={
            "scan": usual.scan.model_copy(update={"frame_rate": Fraction(6250), "power": 12e-3}),
            "scanner": usual.scanner.model_copy(update={"frame": 0.5, "max_point_rate": 8e3}),
        }
    )
    api.scan(slow, out=tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["verdict"] == "complete"
    assert summary["frames"]["lost"] == 0
    assert summary["frames"]["lit"] == pytest.approx(1200, abs=3)
    assert summary["truth"]["stripe_error_px"]["median_abs"] < 0.35
    sync = summary["sync"]
    assert sync["by"] == "blanking pattern"
    assert sync["detection_probability"] > 0.999
    assert sync["residual_columns"] < 0.05
    assert sync["clock_error"] == pytest.approx(20e-6, abs=5e-5)  # the emulated scanner's, as configured
