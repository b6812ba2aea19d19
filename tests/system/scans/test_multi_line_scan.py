"""`rig scan` with several lines at once: as many maps more, depth as from one line, replayed and re-estimated."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from rig import api
from rig.config.files import load_config
from rig.config.overrides import with_lines
from tests.system import small_rig
from tests.system.conftest import Rig


@pytest.fixture
def two_lines(tmp_path: Path) -> Path:
    """The small rig with two lines, each with a laser of its own; its windows do not overlap."""
    content = small_rig.config()
    content["scan"] |= {"command_range": [-0.4, 0.4], "bidirectional": True, "depth_range": ["2 m", "15 m"]}
    content |= {"line_offsets": [-0.4, 0.4], "line_power": "each", "estimate": {"estimator": "likelihood"}}
    return small_rig.write_rig(tmp_path / "two-lines", content)


def test_a_scan_with_two_lines_gives_the_depth_of_one_in_half_the_time_and_replays_to_the_bit(
    two_lines: Path, rig: Rig, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    ran = rig("scan", two_lines, "--maps", 3, "--record", "--out", out, "--json")
    assert ran.code == 0, ran.err
    summary = json.loads(ran.out)
    manifest = json.loads((out / "manifest.json").read_text())
    assert (summary["columns"], summary["exposures"], summary["verdict"]) == (200, 4, "complete")
    # 100 places of the mirror, 4 frames each.
    assert summary["frames"]["lit"] == pytest.approx(3 * 400, abs=6)
    assert summary["map_rate_hz"] == pytest.approx(1 / manifest["plan"]["sweep_s"])
    assert manifest["config"]["line_offsets"] == [-0.4, 0.4]
    assert summary["truth"]["stripe_error_px"]["missing"] <= 0.05
    assert summary["truth"]["stripe_error_px"]["within_1px"] > 0.85
    assert summary["truth"]["depth_error_m"]["median_abs"] < 0.15

    replayed = rig("reconstruct", out, "--out", tmp_path / "again", "--json")
    assert replayed.code == 0, replayed.err
    for name in ("000000", "000001", "000002"):
        assert np.array_equal(
            np.load(out / f"depth/{name}.npy"), np.load(tmp_path / f"again/depth/{name}.npy"), equal_nan=True
        )
    plan = yaml.safe_load((out / "plan.yaml").read_text())["plan"]
    assert plan["lines"]["offsets"] == [-0.4, 0.4]
    assert plan["lines"]["overlap"] == 0


def test_the_truth_is_each_lines_own(tmp_path: Path) -> None:
    """Columns of two lines are the columns of one: the world says so, map for map."""
    content = small_rig.config() | {"estimate": {"estimator": "argmax"}}
    one = load_config(small_rig.write_rig(tmp_path, content))
    results = [api.scan(config, seed=3) for config in (one, with_lines(one, 2))]
    truths = [result.truth for result in results]
    assert all(truth is not None for truth in truths)
    a, b = (truth.x_px for truth in truths if truth is not None)
    both = np.isfinite(a) & np.isfinite(b)
    assert both.mean() > 0.3
    assert np.mean(np.abs(a - b)[both] < 0.1) > 0.97  # where the mirror is late differs by parts of a column


def test_the_dry_run_of_the_bundled_rig_prints_what_lines_share(rig: Rig) -> None:
    ran = rig("scan", "simulated-4-lines", "--dry-run")
    assert ran.code == 0, ran.err
    assert "125 x 10 frames at 100 kHz, 100 us each, for 4 lines at once: 500 columns" in ran.out
    assert "21% of a column's window is other lines' too" in ran.out


def test_a_row_of_flux_holds_the_stripes_of_all_lines_that_are_lit_at_once() -> None:
    first, last = (
        api.flux_row("simulated-4-lines", scene="street-clear", row=256, column=column)["stripe"]
        for column in (60, 435)  # of the first line and of the fourth, 125 columns each
    )
    peaks = (first[1:-1] > first[:-2]) & (first[1:-1] >= first[2:]) & (first[1:-1] > 0.05 * first.max())
    assert peaks.sum() == 4
    np.testing.assert_array_equal(first, last)


def test_lines_that_leave_gaps_are_a_usage_error(two_lines: Path, rig: Rig) -> None:
    content = yaml.safe_load(two_lines.read_text())
    content["scan"]["command_range"] = [-0.2, 0.2]
    two_lines.write_text(yaml.safe_dump(content))
    ran = rig("scan", two_lines, "--dry-run")
    assert ran.code == 2
    assert len(ran.problems) == 1
    assert "what lies between them is never lit; widen it to 0.8" in ran.problems[0]


@pytest.mark.long
def test_four_lines_at_few_exposures_are_told_apart() -> None:
    """Which of four haze densities a first map begins with is decided on little light here."""
    result = api.scan("simulated-4-lines", exposures=3)
    assert result.last is not None
    assert result.truth is not None
    error = np.abs(result.last.stripe.x_px - result.truth.x_px)
    assert np.nanmean(error) < 0.2
