"""Times of day of frames: brackets of the true time, clocks of other rates, steps of UTC, and what a manifest keeps."""

import json
from datetime import UTC, datetime
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.interfaces import SpadTiming
from rig.run_folder import time_of_day
from rig.run_folder.time_of_day import (
    CLOCK_TOLERANCE,
    LEAST_ARRIVALS,
    LEAST_SPAN_S,
    MOST_ARRIVALS,
    NS,
    Anchor,
    Arrival,
    HostReading,
    RecordedTimes,
    StartTimes,
    TimeOfDay,
    host_clock_quality,
    line_below,
    map_content,
    read_anchors,
    read_host,
    run_time,
    utc_ns,
    utc_text,
)

TIMING = SpadTiming(Fraction(100_000_000), 1024, 1000, 4096)  # 97.65625 kHz: no whole number of ns
HOST = HostReading(1_700_000_000 * NS, 5_000 * NS, 100)
PERIOD_S = 1024e-8


def arrivals(
    start: StartTimes, frames: range, *, begins_s: float, rate: float, delays_s: np.ndarray, first_tick: int = 77
) -> None:
    """Frames of a device whose frame 0 begins `begins_s` after the call of start, at a clock that is `rate` slow."""
    for frame, delay_s in zip(frames, delays_s, strict=True):
        ends_s = begins_s + (frame * PERIOD_S + 1000e-8) * (1 + rate)
        start.add(Arrival(frame, first_tick + frame * 1024, start.asked_ns + round((ends_s + delay_s) * NS)))


@settings(max_examples=150, deadline=None)
@given(
    begins_s=st.floats(0, 0.3),
    rate=st.floats(-9e-5, 9e-5),
    seed=st.integers(0, 10**6),
    blocks=st.integers(1, 3000) | st.integers(1000, 100_000).map(lambda blocks: -blocks),
    least_s=st.floats(0, 0.01),
)
def test_the_true_time_of_every_frame_lies_within_the_uncertainty(
    begins_s: float, rate: float, seed: int, blocks: int, least_s: float
) -> None:
    """Whatever the delay of the blocks, the difference of the clocks and the length of the start."""
    rng = np.random.default_rng(seed)
    start = StartTimes(TIMING, HOST.monotonic_ns + 3 * NS, 0)
    step = 500 if blocks > 0 else 50_000  # a long start, of which few arrivals are told
    blocks = blocks if blocks > 0 else -blocks // 100
    frames = range(step - 1, step * blocks, step)
    arrivals(start, frames, begins_s=begins_s, rate=rate, delays_s=least_s + rng.exponential(0.003, len(frames)))
    anchor = start.anchor("host", HOST, 0.0)
    assert anchor is not None
    assert anchor.tick == 77
    asked_ns = HOST.utc_ns + 3 * NS
    for frame in (0, step * blocks // 2, frames[-1]):
        true_ns = asked_ns + round((begins_s + frame * PERIOD_S * (1 + rate)) * NS)
        stamp = anchor.of(frame)
        assert stamp.uncertainty_s is not None
        assert abs(stamp.utc_ns - true_ns) / NS <= stamp.uncertainty_s + 1e-6


def test_the_uncertainty_is_half_of_the_time_from_the_call_to_the_earliest_arrival() -> None:
    start = StartTimes(TIMING, HOST.monotonic_ns, 0)
    arrivals(start, range(499, 5000, 500), begins_s=0.004, rate=0.0, delays_s=np.linspace(0.010, 0.002, 10))
    anchor = start.anchor("host", HOST, 0.0)
    assert anchor is not None
    # Frame 0 begins 4 ms after the call; the quickest block comes 2 ms after its last exposure.
    assert anchor.uncertainty_s == pytest.approx(0.003, abs=4e-6)
    assert (anchor.utc_ns - HOST.utc_ns) / NS == pytest.approx(0.003, abs=4e-6)
    assert (anchor.rate_error, anchor.rate_uncertainty) == (0.0, CLOCK_TOLERANCE)
    assert anchor.of(10**6).uncertainty_s == pytest.approx(0.003 + 10.24 * CLOCK_TOLERANCE, abs=4e-6)


def test_over_a_long_start_the_rate_of_the_clocks_is_measured() -> None:
    rng = np.random.default_rng(1)
    start = StartTimes(TIMING, HOST.monotonic_ns, 0)
    frames = range(499, 60_000_000, 50_000)  # ten minutes
    arrivals(start, frames, begins_s=0.0, rate=4e-5, delays_s=0.001 + rng.exponential(0.002, len(frames)))
    anchor = start.anchor("host", HOST, 0.0)
    assert anchor is not None
    assert start.pairs == len(frames)
    assert anchor.rate_error == pytest.approx(4e-5, abs=1e-6)
    assert anchor.rate_uncertainty < 1e-5
    last = anchor.of(frames[-1])
    assert last.uncertainty_s is not None
    assert last.uncertainty_s < 0.004  # at the tolerance of crystals it would be 60 ms


def test_the_memory_for_arrivals_is_bounded_and_keeps_the_quickest() -> None:
    start = StartTimes(TIMING, HOST.monotonic_ns, 0)
    delays = np.full(20_000, 0.05)
    delays[12_345] = 0.001
    arrivals(start, range(499, 500 * 20_000, 500), begins_s=0.0, rate=0.0, delays_s=delays)
    assert len(start._arrivals) <= MOST_ARRIVALS
    assert 12_345 * 500 + 499 in {arrival.frame for arrival in start._arrivals}
    steps = np.diff([arrival.frame for arrival in start._arrivals])
    assert steps.max() <= 4 * np.median(steps)  # no stretch is thinner than the others


def test_a_frame_that_is_told_twice_counts_once() -> None:
    start = StartTimes(TIMING, HOST.monotonic_ns, 0)
    for _ in range(3):
        start.note(9, 100, 4000)
    assert (start.pairs, start.run_id) == (1, 9)


@pytest.mark.parametrize("slope", [-8e-5, 0.0, 3e-5])
def test_the_line_below_exact_points_is_theirs(slope: float) -> None:
    x = np.linspace(0, 100, LEAST_ARRIVALS)
    height, found, _ = line_below(x.tolist(), (0.25 + slope * x).tolist())
    assert height == pytest.approx(0.25, abs=1e-12)
    assert found == pytest.approx(slope, abs=1e-14)


def test_the_line_lies_below_all_points_and_touches_two() -> None:
    rng = np.random.default_rng(4)
    x = np.sort(rng.uniform(0, 50, 80))
    y = 0.1 + 2e-5 * x + rng.exponential(0.0003, 80)
    most, slope, uncertainty = line_below(x.tolist(), y.tolist())
    assert 0 < abs(slope) < CLOCK_TOLERANCE
    height = (y - slope * x).min()
    assert height <= most <= height + 50 * uncertainty
    above = y - height - slope * x
    assert above.min() >= -1e-12
    assert np.count_nonzero(above < 1e-12) == 2
    assert 0 < uncertainty <= CLOCK_TOLERANCE
    # Of all lines below the points that touch two of them, it has the least sum of distances.
    best = np.inf
    for i in range(80):
        for j in range(i):
            steep = (y[i] - y[j]) / (x[i] - x[j])
            distances = y - y[i] - steep * (x - x[i])
            if distances.min() >= -1e-12:
                best = min(best, distances.sum())
    assert above.sum() == pytest.approx(best)


@pytest.mark.parametrize("delays", ["exponential", "uniform", "lognormal", "gamma"])
def test_the_slope_is_off_by_less_than_is_said(delays: str) -> None:
    """Decision 44: whatever the delays are drawn from, alone or as the least of sixteen."""
    rng = np.random.default_rng(7)
    draw = {
        "exponential": lambda size: rng.exponential(0.003, size),
        "uniform": lambda size: rng.uniform(0, 0.01, size),
        "lognormal": lambda size: rng.lognormal(-6, 1, size),
        "gamma": lambda size: rng.gamma(4, 0.001, size),
    }[delays]
    x = np.linspace(0, 200, LEAST_ARRIVALS).tolist()
    off = []
    for many in (1, 16):
        for _ in range(150):
            _, slope, uncertainty = line_below(x, draw((LEAST_ARRIVALS, many)).min(axis=1).tolist())
            off.append(abs(slope) / uncertainty)
    assert np.count_nonzero(off) > 100
    assert max(off) < 0.7


def test_short_starts_and_absurd_clocks_leave_the_rate_alone() -> None:
    short = [0.0, LEAST_SPAN_S * 0.99]
    assert line_below(short, [0.5, 0.4]) == (0.4 + CLOCK_TOLERANCE * short[1], 0.0, CLOCK_TOLERANCE)
    few = [20.0 * i / (LEAST_ARRIVALS - 2) for i in range(LEAST_ARRIVALS - 1)]
    assert line_below(few, [1e-5 * x for x in few])[1:] == (0.0, CLOCK_TOLERANCE)
    many = [20.0 * i / (LEAST_ARRIVALS - 1) for i in range(LEAST_ARRIVALS)]
    assert line_below(many, [1e-5 * x for x in many])[1] == pytest.approx(1e-5)
    assert line_below(many, [0.025 * x for x in many]) == (0.0, 0.0, CLOCK_TOLERANCE)
    assert line_below([3.0], [0.2]) == (0.2 + 3 * CLOCK_TOLERANCE, 0.0, CLOCK_TOLERANCE)


def test_a_step_of_utc_is_told_and_added_and_moves_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = [HOST, HostReading(HOST.utc_ns + 12 * NS, HOST.monotonic_ns + 10 * NS, 50)]
    monkeypatch.setattr(time_of_day, "read_host", lambda: readings.pop(0) if len(readings) > 1 else readings[0])
    monkeypatch.setattr(time_of_day.time, "monotonic_ns", lambda: HOST.monotonic_ns + NS)
    times = TimeOfDay(TIMING, "host")
    start = times.begin(0)
    arrivals(start, range(499, 5000, 500), begins_s=0.0, rate=0.0, delays_s=np.full(10, 0.002))
    content = times.content()
    assert content["host"]["step_s"] == pytest.approx(2.0)
    assert content["starts"][0]["uncertainty_s"] == pytest.approx(2.001, abs=1e-5)
    assert utc_ns(content["starts"][0]["utc"]) == HOST.utc_ns + NS + NS // 1000


def test_virtual_time_begins_at_the_call_and_has_no_uncertainty_to_tell() -> None:
    times = TimeOfDay(TIMING, "virtual")
    start = times.begin(0)
    arrivals(start, range(499, 5000, 500), begins_s=0.0, rate=0.0, delays_s=np.full(10, 3.0))
    (only,) = times.content()["starts"]
    assert only["utc"] == only["asked_utc"]
    assert only["uncertainty_s"] is None
    (told,) = times.of_maps([(0, 0, 97_656)])
    assert told["utc_uncertainty_s"] is None
    assert (utc_ns(told["utc"][1]) - utc_ns(told["utc"][0])) / NS == pytest.approx(97_656 * PERIOD_S, abs=2e-6)


def test_each_map_has_the_times_of_its_own_start() -> None:
    times = TimeOfDay(TIMING, "host")
    for first_map in (0, 1, 4):
        start = times.begin(first_map)
        start.asked_ns += first_map * NS
        arrivals(start, range(499, 5000, 500), begins_s=0.0, rate=0.0, delays_s=np.full(10, 0.002))
    times.begin(7)  # no frame of it came
    told = times.of_maps([(0, 0, 9), (1, 0, 9), (3, 0, 9), (4, 0, 9), (7, 0, 9)])
    starts = [start.get("utc") for start in times.content()["starts"]]
    assert [one.get("utc", [None])[0] for one in told] == [starts[0], starts[1], starts[1], starts[2], None]
    assert starts[3] is None
    assert "asked_utc" in times.content()["starts"][3]


def test_a_manifest_gives_the_anchors_back_and_bad_ones_are_left_out() -> None:
    times = TimeOfDay(TIMING, "host")
    start = times.begin(0)
    arrivals(start, range(499, 5000, 500), begins_s=0.0, rate=0.0, delays_s=np.full(10, 0.002))
    start.run_id = 4711
    content = json.loads(json.dumps({"time": times.content()}))
    anchor = read_anchors(content)[4711]
    told = times.of_maps([(0, 100, 4000)])[0]
    again = map_content(anchor, 100, 4000)
    assert abs(utc_ns(again["utc"][0]) - utc_ns(told["utc"][0])) <= 2000
    assert again["utc_uncertainty_s"] == told["utc_uncertainty_s"]
    for wrong in ({"utc": "soon"}, {"tick": None}, {"period_s": "x"}, {"run_id": []}):
        assert read_anchors({"time": {"starts": [content["time"]["starts"][0] | wrong]}}) == {}
    assert read_anchors({}) == read_anchors({"time": {"starts": [{"asked_utc": "x"}]}}) == {}


def test_a_replay_has_the_times_of_the_recording() -> None:
    sweeps = [
        {"first_frame": 0, "utc": [f"2025-11-29T06:00:0{i}.000000Z"] * 2, "utc_uncertainty_s": 0.002} for i in (0, 1, 2)
    ]
    times = RecordedTimes({"time": {"scale": "virtual", "starts": []}, "sweeps": sweeps}, [1, 2])
    assert times.content() == {"scale": "recorded", "recorded_scale": "virtual", "starts": []}
    told = times.of_maps([(0, 0, 1), (1, 0, 1), (2, 0, 1)])
    assert [one["utc"][0][17:19] for one in told] == ["01", "02", "01"]
    twice = RecordedTimes({"time": times.content(), "sweeps": sweeps}, [0])
    assert twice.content()["recorded_scale"] == "virtual"


def test_a_run_is_summed_up_by_its_first_and_last_map() -> None:
    maps = [
        {},
        {"utc": ["a", "b"], "utc_uncertainty_s": 0.001},
        {"utc": ["c", "d"], "utc_uncertainty_s": 0.003},
    ]
    found = run_time("host", maps)
    assert found is not None
    assert (found.first_frame_utc, found.last_frame_utc, found.uncertainty_s) == ("a", "d", 0.003)
    assert run_time("host", [{}, {}]) is None


def test_text_keeps_a_moment_to_the_microsecond() -> None:
    moment = datetime(2025, 11, 29, 6, 17, 3, 123_456, UTC)
    text = "2025-11-29T06:17:03.123456Z"
    assert utc_text(round(moment.timestamp()) * NS + 123_456_400) == text
    assert utc_ns(text) == round(moment.timestamp()) * NS + 123_456_000
    with pytest.raises(ValueError):
        utc_ns("2025-11-29")


def test_the_host_is_read_in_one_go() -> None:
    first = read_host()
    second = read_host()
    assert first.within_ns >= 0
    assert second.monotonic_ns >= first.monotonic_ns
    assert first.at(first.monotonic_ns + 5) == first.utc_ns + 5
    synchronised, error_s = host_clock_quality()
    assert synchronised in (True, False, None)
    assert (error_s is not None) == bool(synchronised)


def test_an_anchor_spreads_with_distance() -> None:
    anchor = Anchor(1, 0, 0, 0.001, 0.0, 1e-5, 1e8, 1e-5)
    assert anchor.of(0).uncertainty_s == 0.001
    assert anchor.of(10**8).uncertainty_s == pytest.approx(0.001 + 0.01)


def test_an_anchor_is_found_anew_only_with_new_arrivals_and_a_step_is_added_each_time() -> None:
    start = StartTimes(TIMING, HOST.monotonic_ns, 0)
    arrivals(start, range(499, 5000, 500), begins_s=0.0, rate=0.0, delays_s=np.full(10, 0.004))
    first = start.anchor("host", HOST, 0.0)
    stepped = start.anchor("host", HOST, -2.0)
    again = start.anchor("host", HOST, 0.0)
    assert first is not None
    assert stepped is not None
    assert again == first
    assert stepped.uncertainty_s == pytest.approx((first.uncertainty_s or 0) + 2.0)
    arrivals(start, range(5499, 5500), begins_s=0.0, rate=0.0, delays_s=np.full(1, 0.001))
    better = start.anchor("host", HOST, 0.0)
    assert better is not None
    assert (better.uncertainty_s or 0) < 0.5 * (first.uncertainty_s or 0)
