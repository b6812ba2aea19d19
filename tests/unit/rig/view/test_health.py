"""Figures of a run in words, and which of them need attention."""

from typing import Any

import pytest

from rig.view.health import BAD, GOOD, WARN, Figure, fog_of, of_alignment, of_status, of_summary


def levels(figures: list[Figure]) -> dict[str, str]:
    return {figure.name: figure.level for figure in figures}


def values(figures: list[Figure]) -> dict[str, str]:
    return {figure.name: figure.value for figure in figures}


def test_a_status_without_anything_yet_is_told_too() -> None:
    assert values(of_status({})) == {"stage": "unknown", "frames": "0", "lost": "none", "maps": "0"}


@pytest.mark.parametrize(
    ("status", "name", "level"),
    [
        ({"lost": 1}, "lost", BAD),
        ({"gaps": 1}, "lost", BAD),
        ({"ring": {"fill": 0.5, "slots": 8, "high_water": 8}}, "ring", GOOD),
        ({"ring": {"fill": 0.95, "slots": 8, "high_water": 8}}, "ring", WARN),
        ({"ring": {"fill": 0.0, "slots": 8, "high_water": 8, "dropped_frames": 3}}, "ring", BAD),
        ({"disk": {"written_bytes": 1, "free_bytes": 5e9}}, "disk", WARN),
        ({"disk": {"written_bytes": 1, "free_bytes": 5e10}}, "disk", GOOD),
        ({"disk": {"written_bytes": 1, "free_bytes": None}}, "disk", GOOD),
        ({"laser": {"name": "x", "armed": False, "emission": False}}, "laser", GOOD),
        ({"laser": {"name": "x", "armed": True, "emission": True}}, "laser", WARN),
        ({"laser": {"name": "x", "armed": True, "emission": True, "interlock_closed": False}}, "laser", BAD),
        ({"laser": {"name": "x", "fault": "over-temperature"}}, "laser", BAD),
        ({"verdict_reasons": ["no light"]}, "doubt", BAD),
    ],
)
def test_a_status_says_what_needs_attention(status: dict[str, Any], name: str, level: str) -> None:
    assert levels(of_status(status))[name] == level


def test_a_laser_is_told_in_all_that_it_says() -> None:
    laser = {
        "name": "cobolt", "armed": True, "emission": False, "interlock_closed": False, "key_on": False,
        "warming_up": True, "power_w": 0.0123, "fault": "F1",
    }  # fmt: skip
    said = values(of_status({"laser": laser, "temperatures": {"laser": 25.04, "spad": 31}}))
    assert said["laser"] == "cobolt: armed, dark, warming up, interlock open, key off, 12.3 mW, fault: F1"
    assert said["temperatures"] == "laser 25.0 °C, spad 31.0 °C"
    assert values(of_status({"laser": {"name": "cobolt"}}))["laser"] == "cobolt: has said nothing"


def test_a_summary_is_told_with_its_verdict_and_doubts() -> None:
    summary = {
        "verdict": "doubtful", "verdict_reasons": [{"reason": "no light", "maps": [0, 3]}],
        "frames": {"received": 12345, "expected": 12346, "lost": 1}, "maps": 4, "map_rate_hz": 17.26,
        "valid_fraction": 0.5, "estimator": "joint", "stages": {"ring_high_water": 2, "ring_slots": 8},
    }  # fmt: skip
    manifest = {"gaps": [[5, 5]], "recording": {"bytes": 2.5e6}, "devices": {"laser": {"name": "cobolt"}}}
    said = values(of_summary(summary, manifest))
    assert said["verdict"] == "doubtful"
    assert said["doubt"] == "no light (maps 0, 3)"
    assert said["frames"] == "12\u202f345 of 12\u202f346"
    assert said["lost"] == "1 frames, 1 gaps in whole maps"
    assert said["maps"] == "4, 17.3 a second of sensor time"
    assert said["disk"] == "2.5 MB recorded"
    found = levels(of_summary(summary, manifest))
    assert (found["verdict"], found["doubt"], found["lost"]) == (BAD, BAD, BAD)
    assert of_summary({}, {}) == []
    assert levels(of_summary({"verdict": "complete"}, {})) == {"verdict": GOOD}


def test_an_alignment_says_where_no_line_stands_out_and_where_it_saturates() -> None:
    figures = {
        "focus_px": 1.5, "left_px": 1.25, "middle_px": None, "right_px": 2.0, "line_seen": 0.875, "peak_rate": 0.25,
        "scan_peak_rate": 0.75, "saturated_fraction": 0.02, "mean_rate": 0.0123, "power_w": 0.005, "limit_w": 0.05,
    }  # fmt: skip
    said = of_alignment(figures)
    assert [figure.value for figure in said] == [
        "1.50 px (left 1.25, middle none, right 2.00)", "88% of rows and columns",
        "0.25 per exposure, in a scan 0.75", "2.0% of the line", "0.012 per exposure and pixel", "5 of 50 mW",
    ]  # fmt: skip
    assert levels(said)["saturated"] == WARN
    assert of_alignment({}) == [Figure("line width", "no line stands out", BAD)]


def test_fog_is_a_reading_or_none() -> None:
    assert fog_of(None) is None
    assert fog_of({"extinction_per_m": None, "visibility_m": None}) is None
    read = {"extinction_per_m": 0.1, "extinction_sd_per_m": 0.01, "visibility_m": 39.1, "visibility_sd_m": None, "x": 1}
    assert fog_of(read) == {"extinction_per_m": 0.1, "extinction_sd_per_m": 0.01, "visibility_m": 39.1}
