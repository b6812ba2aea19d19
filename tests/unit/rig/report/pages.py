"""Runs without a scan, and what can be said of any page."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rig.depth.depth import DepthMap
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.geometry.stripe_table import StripeTable
from rig.run_folder.folder import RunFolder
from tests.system.small_rig import calibration

ROWS, WIDTH, COLUMNS = 40, 96, 60
OFF_M = 0.02
"""Error of every depth of a made run."""


def true_depth(rows: int = ROWS, width: int = WIDTH) -> np.ndarray:
    """A wall 2 m away, and one 4 m away in the right half, float32."""
    return np.where(np.arange(width) < width // 2, 2.0, 4.0)[None].repeat(rows, axis=0).astype(np.float32)


def a_map(rows: int = ROWS, width: int = WIDTH, seed: int | None = None) -> MapResult:
    """A map with stripes on every third pixel; noise all over if there is a seed."""
    rng = np.random.default_rng(seed or 0)
    depth = true_depth(rows, width) + np.float32(OFF_M)
    if seed is not None:
        depth = rng.uniform(1, 9, depth.shape).astype(np.float32)
    depth[: rows // 8, : width // 8] = np.nan
    known = np.isfinite(depth)
    confidence = np.where(known, rng.uniform(0.5, 1, depth.shape), 0).astype(np.float32)
    x = np.linspace(4, width - 5, COLUMNS, dtype=np.float32)[None].repeat(rows, axis=0)
    stripe = StripeTable(x, np.full_like(x, 0.9), np.full_like(x, 0.1), np.full_like(x, 1.5), np.full_like(x, 0.02))
    counts = rng.poisson(40, depth.shape).astype(np.uint32)
    return MapResult(stripe, *DepthMap(depth, confidence, depth * np.float32(0.01)), counts, FogEstimate(), 0.1)


def manifest(**changes: Any) -> dict[str, Any]:
    """The parts of a manifest that a report shows."""
    return {
        "command": "scan",
        "verdict": "complete",
        "versions": {"spadrig": "1.2.3", "numpy": "2.0"},
        "config": {"name": "lab", "calibration": "/labs/rig.yaml", "world": {"scene": "street"},
                   "scan": {"exposures": 4, "columns": COLUMNS}},
        "request": {"maps": 1, "seed": 7},
        "rig": {"name": "lab", "taken": "2025-11-29T10:00:00+00:00", "serials": {"spad": "SN-7"}},
        "devices": {"spad": {"name": "a SPAD"}},
        "calibration": {"id": "abc", "provenance": {"by": "rig calibrate planes"}, "check": "matches"},
        "gaps": [],
        **changes,
    }  # fmt: skip


def summary(**changes: Any) -> dict[str, Any]:
    """A summary of one map."""
    return {
        "maps": 1, "columns": COLUMNS, "exposures": 4, "estimator": "joint", "filter": "none",
        "frames": {"expected": 300, "received": 300, "lost": 0, "crc_errors": 0, "lit": 240},
        "sensor_time_s": 0.003, "compute_time_s": 0.5, "realtime_factor": 0.006, "valid_fraction": 0.984,
        "fog": {"extinction_per_m": 0.08, "extinction_sd_per_m": 0.003, "visibility_m": 48.9, "visibility_sd_m": 2.0},
        "truth": {"stripe_error_px": {"mean_abs": 0.2, "median_abs": 0.1, "within_1px": 0.99, "missing": 0.01},
                  "depth_error_m": {"mean_abs": 0.021, "median_abs": OFF_M}},
        "stages": {"counting_s": 0.1, "estimation_s": 0.4, "ring_high_water": 3, "ring_slots": 8},
        "verdict": "complete", **changes,
    }  # fmt: skip


def made_run(
    folder: Path, *, truth: bool = True, calibrated: bool = True, maps: int = 1, noisy: bool = False,
    size: tuple[int, int] = (ROWS, WIDTH), of_manifest: dict[str, Any] | None = None,
    of_summary: dict[str, Any] | None = None,
) -> Path:  # fmt: skip
    """The folder of a run with these maps."""
    rows, width = size
    rays = (np.zeros(size), np.zeros(size)) if calibrated else None
    with RunFolder(folder) as run:
        for index in range(maps):
            run.write_map(index, a_map(rows, width, seed=index + len(folder.name) if noisy else None), rays)
            if truth:
                x = np.linspace(4, width - 5, COLUMNS, dtype=np.float32)[None].repeat(rows, axis=0) + np.float32(0.1)
                np_truth = {"x_px": x, "depth_m": true_depth(rows, width)}
                file = run.place(f"truth/{index:06d}.npz")
                file.parent.mkdir(exist_ok=True)
                np.savez(file, **np_truth)
        run.write_json("manifest.json", manifest(**(of_manifest or {})))
        run.write_json("summary.json", summary(**(of_summary or {})))
        return run.publish()


def calibration_file(file: Path, **changes: Any) -> Path:
    """A calibration of the lab's rig, dated five days before the made runs."""
    content = calibration() | {
        "identity": {"rig": "1f", "created": "2025-11-24T10:00:00+00:00", "name": "lab", "verdict": "passed"},
        "provenance": {"by": "rig calibrate planes", "views": 12},
        **changes,
    }
    file.write_text(yaml.safe_dump(content))
    return file


class _Reader(HTMLParser):
    """Notes what a page loads, and whether its tags are closed in order."""

    VOID = frozenset({"meta", "img", "br", "path", "circle", "rect", "link"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [
            value or "" for name, value in attrs if name in ("src", "href", "srcset", "xlink:href", "action")
        ]
        assert tag not in ("script", "link", "iframe", "object", "embed", "base")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "body" in self.open and "svg" not in self.open:
            self.text.append(data)


def words_of(html: str) -> str:
    """The text of a page, after checks that hold for all: well formed, alone, readable on a phone and on paper."""
    reader = _Reader()
    reader.feed(html)
    reader.close()
    assert not reader.open
    assert all(value.startswith("data:image/") for value in reader.loads)
    style = html[html.index("<style>") : html.index("</style>")]
    assert not re.search(r"url\(|@import|expression\(", style)
    assert "@media print" in style
    assert 'name="viewport" content="width=device-width' in html
    assert "http" not in re.sub(r'xmlns="http://www\.w3\.org/2000/svg"', "", re.sub(r"data:[^\"]*", "", html))
    return " ".join(" ".join(reader.text).split())


def json_of(file: Path) -> Any:
    """Content of a JSON file."""
    return json.loads(file.read_text())
