"""The bench: its frames are what it says, its rows are complete, its stream accounts for every frame."""

import itertools
import json
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import LimitExceeded
from drivers.frames import Mark
from drivers.interfaces import SpadRequest, SpadTiming
from drivers.ring import BlockRing
from rig import api
from rig.bench import soak, speed, stages
from rig.bench.frames import (
    ROWS,
    WINDOW,
    count_columns,
    draw_frames,
    window_frames,
)
from rig.bench.soak import LEAD_FRAMES, Loop, LoopedSpad
from rig.bench.speed import Extent, measure_speed
from rig.cli import main as cli
from rig.cli.tables import speed_table
from rig.count.kernels import CHUNK, new_planes, planes_for
from rig.count.sweeps import SweepAssembler
from rig.count.volume import SweepCounter, SweepLayout
from rig.errors import UsageError
from rig.threads import RowWorkers
from tests.unit.rig.count.streams import SPAD, plan_of, scan, stream_of

pytestmark = pytest.mark.slow

SMALL = Extent(
    windows=(128,), exposures=(1, 10), rounds=1, moment_s=1e-3, count_moment_s=1e-3, latency_s=0.02,
    frames_bytes=2**22, read_bytes=2**20, map_rows=64, map_columns=128,
)  # fmt: skip
KEYS = {
    "stage", "window", "exposures", "threads", "frames_per_s", "times_real_time", "of_memory_bandwidth", "times_numpy",
    "error_px", "median_error_px", "missing", "ms_per_map", "times_sgbm",
}  # fmt: skip


@pytest.fixture(scope="module")
def frames():
    with RowWorkers(2) as workers:
        return window_frames(64, workers, 2**22)


@pytest.fixture(scope="module")
def report():
    return measure_speed(2, SMALL)


# Frames


def test_pixels_detect_as_often_as_their_threshold_says():
    threshold = np.full((16, 64), 2**14, np.uint32)
    threshold[:, 32:] = 0
    bits = np.zeros((200, 16, 8), np.uint8)
    draw_frames(threshold, 1, bits)
    pixels = np.unpackbits(bits, axis=2)
    assert not pixels[:, :, 32:].any()
    share = pixels[:, :, :32].mean()
    assert share == pytest.approx(0.25, abs=5 * math.sqrt(0.25 * 0.75 / pixels[:, :, :32].size))


# Stages


def test_counting_alone_counts_all_frames_of_a_column(frames):
    exposures, rows, row_words = 10, ROWS, 1
    planes = new_planes(ROWS * row_words // CHUNK)
    words = frames.bits[: 2 * exposures].reshape(-1).view(np.uint64)
    count_columns(words, rows, row_words, exposures, planes, 0, len(planes))
    used = planes_for(exposures)
    bits = np.unpackbits(planes[:, :used].copy().view(np.uint8), axis=2).astype(np.int64)
    counts = (bits << np.arange(used)[:, None]).sum(axis=1).reshape(rows, 64)
    last = np.unpackbits(frames.bits[exposures : 2 * exposures], axis=2).sum(axis=0)
    np.testing.assert_array_equal(counts, last)


# The report


@pytest.fixture(scope="module")
def rows(report):
    return {(row.stage, row.window, row.exposures, row.threads): row for row in report.rows}


def test_the_report_has_a_row_for_every_stage_window_exposures_and_threads(report, rows):
    content = json.loads(json.dumps(report.as_json()))
    assert {"machine", "memory_read_gb_per_s", "rows", "latency_us"} <= set(content)
    assert all(set(row) == KEYS for row in content["rows"])
    assert len(rows) == len(report.rows)
    for window, k, threads in itertools.product((128,), (1, 10), (1, 2)):
        assert {("count", window, k, threads), ("likelihood", window, k, threads), ("numpy", window, k, 1)} <= set(rows)
    for k, threads in itertools.product((1, 3, 10), (1, 2)):
        assert {("joint", 64, k, threads), ("sgbm", 64, None, threads)} <= set(rows)
        assert (("joint-sweep", 64, k, threads) in rows) == (k > 1)
    assert {row[0] for row in rows} == {
        "count", "likelihood", "likelihood-full", "likelihood-sweep", "disk", "numpy", "joint", "joint-sweep", "sgbm",
    }  # fmt: skip


def test_quotients_are_of_the_run_itself(report, rows):
    row, naive = rows["likelihood", 128, 10, 1], rows["numpy", 128, 10, 1]
    assert row.times_real_time == pytest.approx(row.frames_per_s / 1e5)
    assert row.times_numpy == pytest.approx(row.frames_per_s / naive.frames_per_s)
    assert naive.times_numpy == 1
    assert row.of_memory_bandwidth == pytest.approx(row.frames_per_s * ROWS * 16 / 1e9 / report.memory_read_gb_per_s)
    for row in report.rows:
        assert (row.times_sgbm is None) == (row.stage != "joint")


def test_estimating_rows_tell_their_error_and_others_none(report, rows):
    for row in report.rows:
        assert (row.error_px is None) == (row.stage == "count")
    for stage in ("likelihood", "likelihood-full", "likelihood-sweep", "disk"):
        row = rows[stage, 128, 10, 1]
        assert row.error_px < min(1, rows["numpy", 128, 10, 1].error_px)
        assert row.missing == 0


def test_rows_of_whole_maps_tell_the_time_of_one(report, rows):
    joint = {("joint", k, threads) for k, threads in itertools.product((1, 3, 10), (1, 2))}
    for stage, k, threads in {("joint-sweep", 3, 2), ("joint-sweep", 10, 2), *joint}:
        row = rows[stage, 64, k, threads]
        # Each is a median over rounds of its own: their product is that of one round where all are alike, else more.
        assert 0.99 < row.ms_per_map * row.frames_per_s / (1e3 * SMALL.map_columns * k) < 10
        assert row.error_px < 1
        assert row.missing == 0
    row = rows["sgbm", 64, None, 2]
    assert row.ms_per_map > 0
    assert row.median_error_px < 1
    assert row.missing >= WINDOW / SMALL.map_columns
    assert (row.frames_per_s, row.times_real_time, row.times_numpy, row.of_memory_bandwidth) == (None,) * 4
    assert all((row.ms_per_map is None) == (not row.stage.startswith(("joint", "sgbm"))) for row in report.rows)


def test_the_quotient_with_sgbm_is_of_maps_made_by_turns(monkeypatch):
    made = []

    def beside():
        made.append("sgbm")
        clock[0] += 4.0

    def make():
        made.append("joint")
        clock[0] += 1.0 if len(made) < 4 else 3.0  # the machine is busier later, but for both

    clock = [0.0]
    monkeypatch.setattr(stages.time, "perf_counter", lambda: clock[0])
    found = stages._timed(make, 0.0, 10, None, beside)
    assert made == ["joint", "sgbm"] * stages.PAIRS
    assert (found.maps, found.frames, found.seconds, found.times_sgbm) == (5, 50, 11.0, 0.75)


# The command


def test_the_command_prints_one_json_object_or_a_table_of_100_columns(report, monkeypatch, capsys):
    monkeypatch.setattr(speed, "measure_speed", lambda threads, progress: report)
    with pytest.raises(SystemExit) as caught:
        cli.main(["bench", "--json"])
    assert caught.value.code == 0
    assert len(json.loads(capsys.readouterr().out)["rows"]) == len(report.rows)
    with pytest.raises(SystemExit):
        cli.main(["bench"])
    told = capsys.readouterr().out.splitlines()
    assert max(map(len, told)) <= 100
    assert any("GB/s" in line for line in told)


def test_the_report_begins_with_whether_this_machine_keeps_up(report, monkeypatch, capsys):
    rows = {(row.stage, row.exposures): row for row in report.rows if row.threads == 2}
    speeds = {("likelihood-sweep", 10): 310_000.0, ("joint-sweep", 10): 16_000.0}
    told = replace(report, rows=tuple(replace(rows[key], frames_per_s=speed) for key, speed in speeds.items()))
    said = [
        "keeps up: 20 maps a second at K = 10 with likelihood on 2 threads, 62 would be possible",
        "does not keep up: 3.2 of 20 maps a second at K = 10 with joint on 2 threads",
    ]
    assert told.as_json()["advice"] == said
    assert [point["keeps_up"] for point in told.as_json()["working_points"]] == [True, False]
    speed_table(told)
    assert capsys.readouterr().out.splitlines()[:2] == said


def test_options_without_effect_are_refused_before_a_minute_has_passed(monkeypatch, capsys):
    monkeypatch.setattr(speed, "measure_speed", lambda threads, progress: pytest.fail("measured"))
    with pytest.raises(SystemExit) as caught:
        cli.main(["bench", "--on-overload", "drop"])
    assert caught.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_what_cannot_be_asked_for_is_refused():
    for threads in (0, 257):
        with pytest.raises(UsageError, match=f"threads is {threads}; .* at most 256"):
            api.bench(threads=threads)
        with pytest.raises(UsageError, match=f"{threads} threads"):
            api.soak(threads=threads)
    with pytest.raises(UsageError, match="more than 0 s"):
        api.soak(seconds=0)
    with pytest.raises(UsageError, match="`on_overload`"):
        api.soak(seconds=1, on_overload="wait")


# The looped SPAD

PLAN = plan_of(scan())
SWEEPS = 2
TICKS = 1000


def looped(rate_hz=100_000):
    """A loop of two sweeps, and a SPAD that plays it."""
    loop = Loop.of(stream_of(PLAN, SWEEPS + 1).blocks(itertools.repeat(16)), SWEEPS)
    spad = LoopedSpad(loop, SPAD, SpadTiming(Fraction(rate_hz * TICKS), TICKS, TICKS, 4096))
    spad.configure(SpadRequest(Fraction(rate_hz), 1 / rate_hz, "stream", 16))
    return loop, spad


@pytest.fixture
def in_no_time(monkeypatch):
    """Time that passes only while the SPAD sleeps."""
    clock = VirtualClock()
    monkeypatch.setattr(soak.time, "perf_counter", lambda: clock.now_ns() / 1e9)
    monkeypatch.setattr(soak.time, "sleep", clock.sleep)
    return clock


def test_frames_go_on_across_the_ends_of_the_loop_in_real_time(in_no_time):
    loop, spad = looped()
    counter = SweepCounter(SweepLayout(PLAN.columns, PLAN.rows, PLAN.width, PLAN.x0, PLAN.window, 4), RowWorkers(1))
    assembler = SweepAssembler(PLAN, counter, 3 * SWEEPS)
    ring = BlockRing(8, spad.configure(SpadRequest(Fraction(100_000), 1e-5, "stream", 16)).stride)
    reader = ring.reader("counting")
    lead = len(loop.records) // (2 * SWEEPS)
    assert lead < LEAD_FRAMES
    spad.start(None)
    begun_s = in_no_time.now_ns() / 1e9
    found = []
    while not assembler.complete:
        assert spad.fill(ring, 1.0)
        block = reader.next(1.0)
        assert in_no_time.now_ns() / 1e9 - begun_s == pytest.approx((block.header.first_frame + 16) * 1e-5, rel=1e-3)
        found += assembler.add(block)
    assert [sweep.index for sweep in found] == list(range(3 * SWEEPS))
    assert all(sweep.frames.lost == 0 and sweep.frames.expected == sweep.frames.received for sweep in found)
    assert found[0].first_frame == lead
    assert found[SWEEPS].first_frame - found[0].first_frame == len(loop.records)
    np.testing.assert_array_equal(found[0].tally.counts, found[SWEEPS].tally.counts)
    assert spad.late_max_s == pytest.approx(0, abs=1e-6)
    spad.close()


def test_the_count_of_sweeps_goes_on_where_that_of_records_begins_again(in_no_time):
    sweep = 65537
    loop, spad = looped()
    ring = BlockRing(1, 2**16)
    reader = ring.reader("counting")
    first = int(np.searchsorted(loop.records["sweep"], 1 + (sweep - 1) % SWEEPS))
    spad.start(None)
    # As after so many sweeps, an hour and more.
    spad._next_frame = spad._lead + (sweep - 1) // SWEEPS * len(loop.records) + first
    assert spad.fill(ring, 1.0)
    block = reader.next(1.0)
    assert block.header.sweep == sweep
    assert set(block.records["sweep"]) == {sweep & 0xFFFF}
    assert int(block.records["marks"][0]) & int(Mark.SCAN)


def test_a_plan_of_another_rate_is_refused():
    _, spad = looped()
    with pytest.raises(LimitExceeded, match="100000 Hz"):
        spad.configure(SpadRequest(Fraction(50_000), 2e-5, "stream", 16))
