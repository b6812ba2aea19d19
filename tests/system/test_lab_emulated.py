"""The whole way with real drivers: config -> driver -> pyusb, pyserial -> emulated devices -> depth map through fog."""

import json
import threading
import time
from fractions import Fraction

import numpy as np
import pytest

from drivers.interfaces import OUT_GATE
from drivers.spb1.control import Op
from rig import api
from rig.config.overrides import configure
from rig.devices import prepare
from sim_backend.wire.emulated_world import KEPT_S, EmulatedWorld
from tests.wire.scans.scan_rig import light, mirror

TRUE_EXTINCTION_PER_M = 0.087
SLOW_HELIOS = {"frame": 0.5, "max_point_rate": 8e3}
SLOW_CARD = {"buffer": 2.0}
SLOW_BOARD = {"buffer": 0.5, "max_point_rate": 3.5e3}


@pytest.fixture
def worlds(monkeypatch):
    """The emulated worlds, each with what was recorded of it when its devices were unplugged."""
    seen = []
    close = EmulatedWorld.close

    def look(world):
        if world not in [one for one, _ in seen]:
            now_s = world.bench.clock.now_ns() / 1e9
            seen.append((world, now_s))
            with world.gate_wire.lock, world.laser_wire.lock:
                world.sync.advance(now_s)
                assert not (world.sync.outputs_at(now_s) & OUT_GATE and world.laser.emitting)
        close(world)

    monkeypatch.setattr(EmulatedWorld, "close", look)
    return seen


@pytest.fixture
def scan_slowly(tmp_path, monkeypatch):
    """A scan slower than the bundled rig's, so that a host with much else to do starts the scanner within the burst."""
    monkeypatch.setattr(prepare, "HOST_LEAD_S", 0.8)

    def scan(name, scanner=SLOW_HELIOS, **changes):
        usual = configure(name)
        scanner = usual.scanner.model_copy(update=scanner)
        slow = usual.model_copy(update={"scan": usual.scan.model_copy(update=changes), "scanner": scanner})
        api.scan(slow, out=tmp_path / "run")
        return json.loads((tmp_path / "run" / "summary.json").read_text())

    return scan


def test_a_scan_over_emulated_wires_ends_in_a_depth_map_through_fog(scan_slowly, worlds):
    summary = scan_slowly("lab-emulated", columns=125, frame_rate=Fraction(20_000), power=10e-3)
    assert summary["verdict"] == "complete"
    frames = summary["frames"]
    assert frames["lost"] == 0
    assert frames["expected"] == frames["received"]
    assert summary["truth"]["stripe_error_px"]["median_abs"] < 0.25
    assert summary["fog"]["extinction_per_m"] == pytest.approx(TRUE_EXTINCTION_PER_M, abs=0.02)
    ((world, ended_s),) = worlds
    # What is known of the light is forgotten by frames, not by time: a slow machine may estimate for long after them.
    assert light(world, ended_s - 60 * KEPT_S, ended_s)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("photons")]


@pytest.mark.parametrize(
    ("name", "scanner"),
    [("lab-nidaq-emulated", SLOW_CARD), pytest.param("lab-etherdream-emulated", SLOW_BOARD, marks=pytest.mark.long)],
)
def test_a_small_scan_with_cards_and_boxes_that_labs_have_ends_in_a_depth_map(scan_slowly, tmp_path, name, scanner):
    summary = scan_slowly(name, scanner, columns=30, frame_rate=Fraction(6250))
    assert summary["verdict"] == "complete"
    assert summary["frames"]["lost"] == 0
    # A column is 15 px wide; a point of so slow a board is 3 px.
    assert summary["truth"]["stripe_error_px"]["median_abs"] < 1.5
    assert np.isfinite(np.load(tmp_path / "run" / "depth" / "000000.npy")).any()


@pytest.mark.long
def test_a_scan_with_a_spad_without_markers_ends_in_a_depth_map(scan_slowly):
    summary = scan_slowly("lab-spad512s-emulated", frame_rate=Fraction(6250), power=12e-3)
    assert summary["verdict"] == "complete"
    assert summary["frames"]["lost"] == 0
    assert summary["frames"]["lit"] == pytest.approx(1200, abs=3)
    assert summary["truth"]["stripe_error_px"]["median_abs"] < 0.35
    sync = summary["sync"]
    assert sync["by"] == "blanking pattern"
    assert sync["detection_probability"] > 0.999
    assert sync["residual_columns"] < 0.05
    assert sync["clock_error"] == pytest.approx(20e-6, abs=5e-5)  # the emulated scanner's, as configured


def test_a_dry_run_opens_every_device_and_neither_moves_nor_shines(worlds):
    begun_s = time.monotonic()
    plan = api.plan_scan("lab-emulated")
    assert plan.columns == 250
    ((world, ended_s),) = worlds
    assert len(world.laser.commands) > 5
    assert Op.READ in [op for op, _, _ in world.spad.commands]
    assert not any(power_w for _, power_w in world._emission)
    assert light(world, begun_s, ended_s) == []
    assert np.ptp(mirror(world, np.linspace(begun_s, ended_s, 1000))) == 0
