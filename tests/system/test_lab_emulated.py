"""The whole way with real drivers: config -> driver -> pyusb, pyserial -> emulated devices -> depth map through fog."""

import json

import pytest

from rig import api
from sim_backend.wire.emulated_world import EmulatedWorld

TRUE_EXTINCTION_PER_M = 0.087


@pytest.fixture
def dark_at_the_end(monkeypatch):
    """What gate and laser were when the emulated devices were unplugged: light, not commands."""
    seen = []
    close = EmulatedWorld.close

    def look(world):
        with world._gate_wire.lock:
            now_s = world.bench.clock.now_ns() / 1e9
            world.sync.advance(now_s)
            gate = world.sync.gate_level(now_s)
        seen.append(not (gate and world.laser.emitting))
        close(world)

    monkeypatch.setattr(EmulatedWorld, "close", look)
    return seen


def test_a_scan_over_emulated_wires_ends_in_a_depth_map_through_fog(tmp_path, dark_at_the_end):
    result = api.scan("lab-emulated", out=tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["verdict"] == "complete"
    frames = summary["frames"]
    assert frames["lost"] == 0
    assert frames["expected"] == frames["received"]
    assert summary["truth"]["stripe_error_px"]["median_abs"] < 0.25
    assert summary["fog"]["extinction_per_m"] == pytest.approx(TRUE_EXTINCTION_PER_M, abs=0.02)
    assert result.folder == tmp_path / "run"
    assert dark_at_the_end == [True]


def test_the_doctor_says_that_it_could(tmp_path, dark_at_the_end):
    findings = {one.name: one for one in api.doctor("lab-emulated", out=tmp_path)}
    assert all(one.ok for one in findings.values()), findings
    assert "owns laser and gate" in findings["guard"].text
    assert dark_at_the_end == [True]


def test_the_laser_is_switched_off_without_a_scan(dark_at_the_end):
    done = api.laser_off("lab-emulated")
    assert any("all outputs low" in line for line in done)
    assert any("emission off" in line for line in done)
    assert dark_at_the_end == [True]
