"""The page of a finished run in a real browser: points, pictures, the row under the cursor, downloads."""

import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from drivers.recorded import RunRecording
from rig import api
from rig.recording.map_rows import MapRows
from rig.run_folder.pictures import POINT
from tests.system.small_rig import HEIGHT, WIDTH, write_rig
from tests.system.view.conftest import Open, Served, served


@pytest.fixture(scope="module")
def shown(scanned: Path, slots: Path) -> Iterator[Served]:
    with served(scanned, folder=slots) as viewer:
        yield viewer


def test_points_and_pictures_appear_and_nothing_is_asked_of_another_host(shown: Served, open_tab: Open) -> None:
    tab = open_tab(shown.url)
    tab.cloud()
    tab.until("bitmaps.depth && bitmaps.counts && bitmaps.confidence")
    assert tab.page.evaluate("[bitmaps.depth.width, bitmaps.depth.height]") == [WIDTH, HEIGHT]
    assert tab.page.inner_text("#label") == "map 1"
    assert "complete" in tab.page.inner_text("#health")
    assert len([address for address in tab.asked if address.startswith("ws:")]) == 2
    tab.screenshot("run-desktop")


def test_from_another_address_the_page_asks_for_its_token_and_outlives_a_flood(
    scanned: Path, slots: Path, open_tab: Open
) -> None:
    """As from another computer: by the address of this one in its network, which is not loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
        try:
            route.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this computer is in no network: it has loopback alone")
        address = str(route.getsockname()[0])
    with served(scanned, "--host", address, folder=slots) as viewer:
        assert urlsplit(viewer.url).hostname == address
        without_token = viewer.url.partition("?")[0]
        tab = open_tab(without_token)
        assert "token" in tab.page.inner_text("body")
        assert tab.page.evaluate("typeof latest") == "undefined"
        tab = open_tab(viewer.url)
        points = tab.cloud()
        cookies = {each["name"]: each["value"] for each in tab.page.context.cookies()}
        headers = {"Cookie": "; ".join(f"{name}={value}" for name, value in cookies.items())}
        origin = Origin(without_token.rstrip("/"))
        with connect(f"ws://{address}:{viewer.port}/data", origin=origin, additional_headers=headers) as flood:
            for _ in range(100_000):
                with suppress(ConnectionClosed):
                    flood.send('{"ask": "colour", "by": "signal"}')
                if flood.close_code is not None:
                    break
            assert flood.close_code == 1008
        tab.page.select_option("#colour", "confidence")
        tab.cloud(unlike=points)


def test_the_page_fits_a_phone(shown: Served, open_tab: Open) -> None:
    tab = open_tab(shown.url, 390, 844)
    tab.cloud()
    tab.until("bitmaps.depth")
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 390
    tab.hover("depth", 20, 40)
    tab.screenshot("run-phone")


def test_the_profile_follows_the_cursor_and_equals_the_counts_of_the_file(
    shown: Served, scanned: Path, open_tab: Open
) -> None:
    tab, rows = open_tab(shown.url), MapRows(scanned)
    tab.until("bitmaps.depth && latest.map.number === 1")
    depth_m = np.load(scanned / "depth" / "000001.npy")
    stripe = np.load(scanned / "stripe" / "000001.npz")
    for row, x in ((20, 30), (21, 60), (5, 80)):
        tab.hover("depth", row, x)
        tab.until("latest.row.profile")
        told = tab.tells("row")
        column = told["column"]
        assert isinstance(column, int)
        assert abs(stripe["x_px"][row, column] - x) <= np.nanmin(np.abs(stripe["x_px"][row] - x)) + 3
        assert told["profile"] == rows.row(1, row).counts[column].tolist()
        assert told["exposures"] == 4
        if np.isfinite(depth_m[row, x]):
            assert told["depth_m"] == pytest.approx(float(depth_m[row, x]))
            assert f"{depth_m[row, x]:.3f} m ±" in tab.page.inner_text("#pixel")
        else:
            assert "no depth" in tab.page.inner_text("#pixel")
    # The bits themselves: all columns together have the detections of the map's lit frames.
    recording = RunRecording(scanned)
    sweep = rows._sweeps[1]
    blocks = recording.blocks(recording.runs[0], sweep["first_frame"], sweep["end_frame"])
    bits = np.concatenate([np.unpackbits(block.bits[:, 20], axis=1)[:, :WIDTH] for block in blocks])
    lit = np.concatenate([bins >= 0 for _, bins, _ in rows.frames(1).pieces])
    assert tab.page.evaluate("cursor.row") == 5
    tab.hover("counts", 20, 33)
    assert tab.tells("row")["counts"] == int(bits[lit, 33].sum())


def test_another_map_another_colour_and_a_least_confidence_change_points_and_pictures(
    shown: Served, scanned: Path, open_tab: Open
) -> None:
    tab = open_tab(shown.url)
    before = tab.cloud()
    tab.page.click("#before")
    tab.until("latest.map.number === 0 && latest.map.label === 'map 0'")
    assert tab.page.inner_text("#map-number") == "0 (0 to 1)"
    tab.page.select_option("#colour", "counts")
    tab.until("latest.map.colour === 'counts'")
    assert tab.cloud(unlike=before) != before
    assert "counts" in tab.page.inner_text("#legend")
    all_points = tab.page.evaluate("latest.map.points")
    confidence = np.load(scanned / "confidence" / "000000.npz")["confidence"].astype(np.float32)
    tab.page.locator("#least").fill("9")
    tab.until("latest.map.least === 0.995")
    kept = int(np.count_nonzero((confidence >= np.float32(0.995)) & (confidence > 0)))
    assert tab.page.evaluate("latest.map.points") == kept < all_points
    tab.page.locator("#least").fill("10")
    tab.until("latest.map.least === 0.999")
    tab.page.locator("#least").fill("0")
    tab.page.select_option("#colour", "depth")
    tab.page.click("#after")
    tab.until("latest.map.number === 1 && latest.map.least === 0 && latest.map.colour === 'depth'")


def test_points_and_screenshot_are_downloaded(shown: Served, scanned: Path, open_tab: Open, tmp_path: Path) -> None:
    tab = open_tab(shown.url)
    tab.cloud()
    tab.until("latest.map.number === 1 && bitmaps.depth")
    with tab.page.expect_download() as begun:
        tab.page.click("#ply")
    begun.value.save_as(tmp_path / "points.ply")
    assert begun.value.suggested_filename == f"{scanned.name}-000001.ply"
    ours = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")[2]
    theirs = (scanned / "cloud" / "000001.ply").read_bytes().partition(b"end_header\n")[2]
    assert np.array_equal(np.frombuffer(ours, POINT)["z"], np.frombuffer(theirs, POINT)["z"])
    with tab.page.expect_download() as begun:
        tab.page.click("#screenshot")
    begun.value.save_as(tmp_path / "shot.png")
    png = (tmp_path / "shot.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", png[16:24])
    assert min(width, height) > 400
    assert len(png) > 20_000


def test_keys_move_the_cursor(shown: Served, open_tab: Open) -> None:
    tab = open_tab(shown.url)
    tab.until("bitmaps.depth")
    tab.hover("depth", 10, 10)
    tab.page.focus("#depth")
    for key in ("ArrowDown", "ArrowDown", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowLeft"):
        tab.page.keyboard.press(key)
    tab.until("latest.row.row === 11 && latest.row.x === 9")


@pytest.mark.slow
def test_a_map_is_estimated_again_while_the_page_goes_on(shown: Served, open_tab: Open) -> None:
    tab = open_tab(shown.url)
    tab.until("bitmaps.depth && latest.map.number === 1")
    tab.page.select_option("#estimator", "edge")
    tab.page.click("#again")
    tab.until("latest.estimate && latest.estimate.busy")
    tab.hover("depth", 12, 40)
    tab.until("!latest.estimate.busy && latest.map.again")
    assert "estimated again with edge" in tab.page.inner_text("#label")
    tab.until("document.getElementById('health').innerText.includes('edge')")
    tab.page.click("#recorded")
    tab.until("!latest.map.again && latest.map.label === 'map 1'")


def test_a_run_without_recording_says_that_it_has_no_counts_of_rows(
    slots: Path, open_tab: Open, tmp_path: Path
) -> None:
    api.scan(write_rig(tmp_path / "rig"), maps=1, out=tmp_path / "run")
    with served(tmp_path / "run", folder=slots) as viewer:
        tab = open_tab(viewer.url)
        tab.cloud()
        tab.until("bitmaps.depth")
        assert tab.page.is_hidden("#estimator-control")
        assert tab.page.is_hidden("#stop")
        assert "were not recorded" in tab.page.inner_text("#notes")
        tab.hover("depth", 20, 40)
        assert tab.tells("row")["why"] == "this run has no recording"
