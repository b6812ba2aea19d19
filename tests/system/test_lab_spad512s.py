"""A SPAD without markers, all the way: TCP -> driver -> blanking pattern -> depth map through fog."""

import json

import pytest

from rig import api


def test_a_scan_with_a_spad_without_markers_ends_in_a_depth_map(tmp_path):
    api.scan("lab-spad512s-emulated", out=tmp_path / "run")
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
