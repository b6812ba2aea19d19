"""A link too slow for full frames: windows that move with the line, and the same maps to the last bit."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.api import configure, scan
from rig.devices.open import open_rig
from rig.devices.prepare import prepare
from tests.system.conftest import Rig
from tests.system.run_files import assert_same
from tests.system.small_rig import config, write_rig

WIDTH = 320

FAST, SLOW = "8 GB/s", "100 MB/s"
"""What carries full frames of 320 x 40 pixels at 100 kHz, 162 MB/s, and what carries no more than windows of 192."""


def wide_rig(
    folder: Path, link: str, *, width: int = WIDTH, height: int = 40, spad: dict[str, Any] | None = None, **scan: Any
) -> Path:
    """Config file of a small rig with 320 pixels a row, of which a column takes 128, and a link."""
    content = config()
    content["scan"] |= {"depth_range": ["2 m", "15 m"], **scan}
    content["spad"] |= {"link": link, **(spad or {})}
    return write_rig(folder, content, width=width, height=height)


@pytest.mark.parametrize(
    ("estimator", "changes"),
    [
        ("argmax", {"command_range": [0.8, -0.8]}),
        ("likelihood", {"bidirectional": True}),
        ("likelihood", {"exposures": 1, "columns": 300}),
    ],
    ids=["downward", "both ways", "one exposure"],
)
def test_windows_give_the_very_maps_of_the_full_frames(tmp_path: Path, estimator: Any, changes: dict[str, Any]) -> None:
    runs = {link: tmp_path / link / "run" for link in (FAST, SLOW)}
    full, windows = (
        scan(wide_rig(tmp_path / link, link, **changes), estimator=estimator, maps=2, seed=3, out=out)
        for link, out in runs.items()
    )
    assert full.summary.frames == windows.summary.frames
    assert full.summary.frames.lost == 0
    assert full.summary.truth == windows.summary.truth
    assert_same(*runs.values())


def test_lost_frames_are_lost_alike_also_where_rows_end_in_padding(tmp_path: Path) -> None:
    lost = {"lost_frames": [*range(400, 431), 900, 901], "loss_probability": 0.01}
    full, windows = (
        scan(wide_rig(tmp_path / link, link, width=300, spad=lost), maps=1, seed=5) for link in (FAST, SLOW)
    )
    assert windows.summary.frames == full.summary.frames
    assert windows.summary.frames.lost > 30
    np.testing.assert_array_equal(windows.last.depth_m, full.last.depth_m)
    np.testing.assert_array_equal(windows.last.stripe.x_px, full.last.stripe.x_px)


def test_a_dry_run_tells_the_rates_of_the_link(rig: Rig, tmp_path: Path) -> None:
    plan = json.loads(rig("scan", wide_rig(tmp_path / "rig", SLOW), "--dry-run", "--json").out)["plan"]
    told = ("windowed", "frame_width_px", "windows_px", "link_bytes_per_s")
    assert [plan[name] for name in told] == [True, 192, 192, 1e8]
    assert plan["bytes_per_s"] == 1e5 * (40 * 24 + 16)
    assert plan["full_frames_hz"] == pytest.approx(1e8 / (40 * 40 + 16))
    assert plan["windows_hz"] == pytest.approx(1e8 / (40 * 24 + 16))


def test_a_spad_that_rounds_its_frame_rate_gets_the_windows_of_the_rate_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_rig(configure(wide_rig(tmp_path, SLOW))) as opened:
        spad = opened.spad
        requests = []
        do_configure = spad._do_configure

        def coarse(request: Any) -> Any:
            requests.append(request)
            timing = do_configure(request)
            return type(timing)(timing.tick_hz, timing.frame_period_ticks + 1, timing.exposure_ticks, timing.stride)

        monkeypatch.setattr(spad, "_do_configure", coarse)
        plan, timing = prepare(opened)
    assert len(requests) == 2
    assert plan.frame_rate_hz == timing.tick_hz / timing.frame_period_ticks
    assert plan.windows is not None
    for ours, theirs in zip(requests[-1].window.x0, plan.windows.x0, strict=True):
        np.testing.assert_array_equal(ours, theirs)
