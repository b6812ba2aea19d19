"""Counts around one stripe, and their mean over columns whose stripes are brought together."""

import numpy as np
import pytest

from rig.recording.map_rows import RowCounts
from rig.report.profiles import NEIGHBOURS, mean_profile, row_profiles
from rig.report.run_facts import read_run
from tests.unit.rig.report.pages import made_run

COLUMNS, WIDTH, FRAMES = 60, 200, 8


def moving_stripe():
    """A row whose stripe moves by 1.6 px a column, with haze before it: its stripe table and its counts."""
    x = 30 + 1.6 * np.arange(COLUMNS)
    pixels = np.arange(WIDTH)
    level = np.where(pixels < np.round(x)[:, None], 2, 0)
    level[np.arange(COLUMNS), np.round(x).astype(int)] = 7
    begin, end = np.full(COLUMNS, 10, np.int32), np.full(COLUMNS, 180, np.int32)
    counts = RowCounts(level.astype(np.uint16), np.full(COLUMNS, FRAMES, np.int32), begin, end)
    stripe = {
        "x_px": x[None].astype(np.float32),
        "confidence": np.ones((1, COLUMNS), np.float32),
        "haze": np.full((1, COLUMNS), 0.2, np.float32),
        "signal": np.ones((1, COLUMNS), np.float32),
    }
    return stripe, counts


@pytest.mark.parametrize("column", [0, 30, COLUMNS - 1])
def test_the_mean_over_columns_has_all_stripes_in_one_place(column):
    stripe, counts = moving_stripe()
    mean = mean_profile(counts, stripe, 0, column)
    at = round(float(stripe["x_px"][0, column]))
    assert abs(int(np.nanargmax(mean)) - at) <= 1
    assert np.nanmax(mean) > 0.4
    np.testing.assert_allclose(mean[at - 15 : at - 2], 2 / FRAMES)
    np.testing.assert_allclose(mean[at + 3 : at + 15], 0)


def test_columns_without_a_sure_stripe_or_without_frames_are_left_out():
    stripe, counts = moving_stripe()
    clean = mean_profile(counts, stripe, 0, 30)
    stripe["confidence"][0, 25:28] = 0.1
    counts.counts[25:28] = 8
    counts.frames[33] = 0
    counts.counts[33] = 8
    np.testing.assert_allclose(mean_profile(counts, stripe, 0, 30), clean, atol=0.06)
    stripe["confidence"][0, :] = 0.0
    assert np.isnan(mean_profile(counts, stripe, 0, 30)).all()


def test_rows_with_counts_show_stripe_haze_and_the_mean(tmp_path):
    from dataclasses import replace

    facts = read_run(made_run(tmp_path / "run"))
    stripe, counts = moving_stripe()
    counted = replace(facts, stripe=stripe, rows=(0,), counted={0: counts}, truth={}, depth_m=None)
    html = row_profiles([counted])
    assert "<title>Counts, column 30</title>" in html
    assert f"mean of {2 * NEIGHBOURS + 1} columns, aligned" in html
    assert "level of haze and ambient light" in html
    assert "true stripe" not in html
    true = replace(counted, truth={"x_px": stripe["x_px"], "depth_m": np.full((1, WIDTH), np.nan, np.float32)})
    assert "true stripe" in row_profiles([true])


def test_a_run_without_stripes_has_no_profiles(tmp_path):
    assert row_profiles([read_run(made_run(tmp_path / "run", maps=0))]) == ""
