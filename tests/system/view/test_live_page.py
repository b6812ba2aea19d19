"""The page of a running scan in a real browser. The scan is played by the test, which writes the slot."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.live.slot import SlotWriter
from tests.system.view.conftest import PATIENCE_S, Open, Served, Tab, served

ROWS, WIDTH, COLUMNS, EXPOSURES = 48, 64, 80, 5
CAPACITIES = {name: 1 << 20 for name in ("setup", "status", "frame", "map", "row", "figures")}


@pytest.fixture(scope="module")
def live(slots: Path) -> Iterator[Served]:
    with served("--live", "--view-points", "2000", folder=slots) as viewer:
        yield viewer


@contextmanager
def scanning(name: str = "bench", kind: str = "scan", **setup: Any) -> Iterator[SlotWriter]:
    """The slot of a scan that has begun."""
    with SlotWriter.create(kind, name, CAPACITIES) as slot:
        v, u = np.meshgrid(np.linspace(-0.3, 0.3, ROWS), np.linspace(-0.4, 0.4, WIDTH), indexing="ij")
        header = {
            "kind": kind, "name": name, "config": {"estimate": {"min_confidence": 0.5}, "calibration": "rig.yaml"},
            "columns": COLUMNS, "exposures": EXPOSURES, "rows": ROWS, "width": WIDTH, "depth_range_m": [1.0, 9.0],
            "estimator": "argmax", "frame_rate_hz": 1e5, "folder": None, "maps": 100, **setup,
        }  # fmt: skip
        slot.write("setup", header, {"u": u.astype(np.float32), "v": v.astype(np.float32)})
        slot.write("status", status())
        yield slot


def status(**changes: Any) -> dict[str, Any]:
    return {
        "stage": "scanning", "frames": 1234, "frames_planned": 50000, "lost": 0, "sweeps": 3, "maps": 100,
        "map_rate_hz": 4.25, "ring": {"fill": 0.25, "slots": 8, "high_water": 4, "bytes": 1, "dropped_frames": 0},
        "disk": {"written_bytes": 2.5e9, "free_bytes": 7.7e10}, "gaps": 0,
        "laser": {"name": "laser of the test", "armed": True, "emission": True, "interlock_closed": True},
        "temperatures": {"laser": 31.25}, "fog": None, "unix_time_s": time.time(), "verdict_reasons": [], **changes,
    }  # fmt: skip


def write_map(
    slot: SlotWriter, number: int, depth_m: float, extinction_per_m: float = 0.1, *, gap_m: float = 0.0
) -> np.ndarray:
    """Write a map of a wall, the right half of which stands `gap_m` farther away; its depth."""
    depth = np.full((ROWS, WIDTH), depth_m, np.float32) + np.linspace(0, 1, WIDTH, dtype=np.float32)
    depth[:, :6] = np.nan
    depth[:, WIDTH // 2 :] += np.float32(gap_m)
    x_px = np.tile(np.linspace(6, WIDTH - 1, COLUMNS, dtype=np.float32), (ROWS, 1))
    ones = np.ones_like(x_px)
    fog = {
        "extinction_per_m": extinction_per_m,
        "extinction_sd_per_m": 0.01,
        "visibility_m": 39.0,
        "visibility_sd_m": 3.0,
    }
    header = {"index": number, "fog": fog, "compute_s": 0.1, "estimator": "argmax", "direction": 1, "gaps": [],
              "doubts": [], "unix_time_s": time.time()}  # fmt: skip
    arrays = {
        "depth_m": depth, "confidence": np.where(np.isnan(depth), 0, 0.97).astype(np.float32),
        "depth_sd_m": np.full_like(depth, 0.012),
        "intensity": np.arange(ROWS * WIDTH, dtype=np.uint32).reshape(ROWS, -1),
        "stripe/x_px": x_px, "stripe/confidence": 0.97 * ones, "stripe/x_sd_px": 0.1 * ones, "stripe/signal": 2 * ones,
        "stripe/haze": 0.05 * ones,
    }  # fmt: skip
    slot.write("map", header, arrays)
    return depth


def eventually(found: Callable[[], object]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not found():
        assert time.monotonic() < until_s
        time.sleep(0.02)


def wait_for(tab: Tab, slot: SlotWriter, script: str, again: Callable[[], object] = lambda: None) -> None:
    """Wait for the page while the scan goes on."""
    until_s = time.monotonic() + PATIENCE_S
    while not tab.page.evaluate(script):
        assert time.monotonic() < until_s, script
        slot.write("status", status())
        again()
        tab.page.wait_for_timeout(100)


def test_without_a_scan_the_page_says_so_and_waits(live: Served, open_tab: Open) -> None:
    tab = open_tab(live.url)
    tab.until("latest.state && latest.state.state === 'waiting'")
    assert "No scan of yours is running" in tab.page.inner_text("#state")
    assert tab.page.is_disabled("#stop")
    with scanning("comes later") as slot:
        wait_for(tab, slot, "latest.state.state === 'live'")
        wait_for(tab, slot, "document.getElementById('title').textContent === 'comes later'")


def test_a_new_map_changes_points_pictures_fog_and_label(live: Served, open_tab: Open) -> None:
    with scanning() as slot:
        tab = open_tab(live.url)
        wait_for(tab, slot, "latest.state && latest.state.state === 'live'")
        eventually(lambda: slot.watched)
        write_map(slot, 0, 2.0)
        wait_for(tab, slot, "latest.map && latest.map.number === 0")
        before = tab.cloud()
        assert 1500 < tab.page.evaluate("latest.map.points") <= 2000
        assert "of 2\u202f784 points shown, evenly thinned" in tab.page.inner_text("#points")
        write_map(slot, 1, 2.0, 0.2, gap_m=5.0)
        wait_for(tab, slot, "latest.map.number === 1")
        assert tab.page.inner_text("#label") == "map 1"
        tab.cloud(unlike=before)
        readings = tab.page.evaluate("latest.fog.readings")
        assert [one["extinction_per_m"] for one in readings] == [0.1, 0.2]
        assert "visibility 39 ± 3 m" in tab.page.inner_text("#fog-text")
        health = tab.page.inner_text("#health")
        for said in ("1\u202f234 of 50\u202f000", "4.25 a second", "25% full", "2.5 GB written, 77 GB free", "31.2 °C"):
            assert said in health
        assert "armed, emits while the gate is open" in health
        tab.screenshot("live-desktop")


def test_the_row_under_the_cursor_is_asked_of_the_scan_and_its_counts_are_shown(live: Served, open_tab: Open) -> None:
    counts = np.random.default_rng(1).integers(0, EXPOSURES + 1, (COLUMNS, WIDTH)).astype(np.uint16)
    windows = np.arange(COLUMNS, dtype=np.int32) // 4, np.arange(COLUMNS, dtype=np.int32) // 4 + 30
    with scanning() as slot:
        tab = open_tab(live.url)
        eventually(lambda: slot.watched)
        depth = write_map(slot, 0, 3.0)
        wait_for(tab, slot, "bitmaps.depth && latest.map && latest.map.number === 0")
        tab.hover("depth", 20, 40)
        wait_for(tab, slot, "latest.row.why")
        assert tab.tells("row")["why"] == "the counts of this row come with the next map"
        eventually(lambda: slot.wanted_row == 20)
        slot.write("row", {"map": 0, "row": 20, "exposures": EXPOSURES}, {
            "counts": counts, "begin_px": windows[0], "end_px": windows[1],
        })  # fmt: skip
        wait_for(tab, slot, "latest.row.profile")
        told = tab.tells("row")
        column = told["column"]
        assert isinstance(column, int)
        assert abs(np.linspace(6, WIDTH - 1, COLUMNS)[column] - 40) < 0.5
        assert told["profile"] == counts[column].tolist()
        assert told["window_px"] == [int(windows[0][column]), int(windows[1][column])]
        assert told["counts"] == 20 * WIDTH + 40
        assert f"{depth[20, 40]:.3f} m ± 12 mm" in tab.page.inner_text("#pixel")
        tab.screenshot("live-row")


def test_stop_asks_once_more_and_then_the_scan_is_told(live: Served, open_tab: Open) -> None:
    with scanning() as slot:
        tab = open_tab(live.url)
        wait_for(
            tab, slot, "latest.state && latest.state.state === 'live' && !document.getElementById('stop').disabled"
        )
        tab.page.click("#stop")
        tab.page.click("#go-on")
        tab.page.click("#stop")
        assert not slot.stop_requested
        tab.page.click("#do-stop")
        eventually(lambda: slot.stop_requested)
        wait_for(tab, slot, "latest.notice && latest.notice.text.includes('asked to stop')")


def test_the_question_whether_to_stop_goes_with_its_scan(live: Served, open_tab: Open) -> None:
    with scanning() as slot:
        tab = open_tab(live.url)
        wait_for(tab, slot, "!document.getElementById('stop').disabled")
        tab.page.click("#stop")
        assert tab.page.is_visible("#do-stop")
    tab.until("latest.state.state === 'ended' && !document.getElementById('really').open")


def test_the_last_map_stays_when_the_scan_ends(live: Served, open_tab: Open) -> None:
    with scanning() as slot:
        tab = open_tab(live.url)
        eventually(lambda: slot.watched)
        write_map(slot, 7, 2.0)
        wait_for(tab, slot, "latest.map && latest.map.number === 7")
    tab.until("latest.state.state === 'ended'")
    assert "The scan has ended. This is its last map" in tab.page.inner_text("#state")
    assert tab.page.inner_text("#label") == "map 7"
    assert tab.page.is_disabled("#stop")
    tab.cloud()


@pytest.mark.long
def test_a_page_of_one_process_never_shows_the_scan_of_another(slots: Path, open_tab: Open) -> None:
    """Its button would stop that scan. `rig scan --view` and `rig demo` start such a page."""
    with served("--live", "--process", os.getpid(), folder=slots) as viewer:
        tab = open_tab(viewer.url)
        with scanning("mine") as slot:
            wait_for(tab, slot, "document.getElementById('title').textContent === 'mine'")
        tab.until("latest.state.state === 'ended'")
        assert "shows no other scan" in tab.page.inner_text("#state")
        code = (
            "import sys, time\nfrom tests.system.view.test_live_page import scanning\n"
            "with scanning('of another process'):\n    print('begun', flush=True)\n    time.sleep(4)\n"
        )
        ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert "begun" in ran.stdout
        assert tab.page.inner_text("#title") == "mine"
        assert tab.tells("state")["state"] == "ended"


def test_a_scan_whose_process_is_killed_is_told_apart_from_one_that_ended(live: Served, open_tab: Open) -> None:
    code = f"""
import time
from rig.live.slot import SlotWriter
with SlotWriter.create("scan", "to be killed", {{"setup": 10000}}) as slot:
    print("there", flush=True)
    time.sleep({PATIENCE_S})
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        tab = open_tab(live.url)
        tab.until("latest.state && latest.state.state === 'live'")
        process.kill()
        tab.until("latest.state.state === 'lost'")
    assert "is gone without an end" in tab.page.inner_text("#state")


def test_doubts_lost_frames_and_an_uncalibrated_rig_catch_the_eye(live: Served, open_tab: Open) -> None:
    with scanning(config={"calibration": None, "estimate": {}}) as slot:
        tab = open_tab(live.url)
        eventually(lambda: slot.watched)
        bad = status(lost=17, gaps=2, verdict_reasons=["no light"], laser={"name": "x", "fault": "too warm"})
        wait_for(tab, slot, "latest.health && document.getElementById('health').textContent.includes('too warm')",
                 lambda: slot.write("status", bad))  # fmt: skip
        found = tab.page.eval_on_selector_all("#health .bad", "cells => cells.map((cell) => cell.textContent)")
        assert found == ["17 frames, 2 gaps in whole maps", "x: fault: too warm", "no light"]
        assert "not calibrated" in tab.page.inner_text("#notes")


def test_an_alignment_shows_its_frames_figures_and_profile(live: Served, open_tab: Open) -> None:
    with scanning("bench", "align") as slot:
        tab = open_tab(live.url, 390, 844)
        eventually(lambda: slot.watched)
        profile = np.linspace(0, 0.5, WIDTH)

        def write() -> None:
            slot.write("frame", {"first_frame": 5, "frames": 16}, {"counts": np.ones((ROWS, WIDTH), np.uint16)})
            slot.write(
                "figures", {"focus_px": 1.25, "saturated_fraction": 0.5, "mean_rate": 0.01}, {"profile": profile}
            )

        figures = "latest.health.figures.some(([name]) => name === 'line width')"
        wait_for(tab, slot, f"bitmaps.counts && latest.profile && {figures}", write)
        assert tab.page.inner_text("#row-title") == "Row profile, mean of all rows"
        assert tab.page.evaluate("latest.profile.profile.length") == WIDTH
        assert "1.25 px (left none, middle none, right none)" in tab.page.inner_text("#health")
        assert tab.page.is_hidden(".cloud")
        assert tab.page.is_visible("#counts")
        tab.screenshot("align-phone")
