"""The pipeline under load and failure: policies, slow and dead stages, errors on each thread, every frame accounted."""

import errno
import itertools
import logging
import mmap
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import Lag
from drivers.errors import DeviceFault, RingOverflow
from drivers.recorded.contents import INDEX_FILE, segment_name
from drivers.spb1 import walk_blocks
from rig.errors import RecordingError
from rig.recording.segment import PAGE_BYTES, OpenSegment
from rig.recording.writer import Recording
from rig.scan import pipeline
from rig.scan.monitor import add_frames
from rig.scan.pipeline import Overload
from tests.unit.rig.count.streams import plan_of, scan, stream_of
from tests.unit.rig.scan.fakes import (
    PATIENCE_S,
    START,
    STOP,
    FakeMaker,
    acquisition,
    fake_rig,
    pipeline_threads,
    wait_until,
)

LAG = Lag(1e-4, 2e-4)
PLAN = plan_of(scan(), LAG)
MAPS = 6
STREAM = stream_of(PLAN, MAPS, lag=LAG)
N_BLOCKS = len(STREAM.blocks(itertools.repeat(16)))


@pytest.fixture(autouse=True)
def _eight_slots_and_little_patience(monkeypatch):
    monkeypatch.setattr(pipeline, "RING_BYTES", 0)
    monkeypatch.setattr(pipeline, "MONITOR_S", 0.05)
    yield
    assert [name for name in pipeline_threads() if name != "monitor"] == []


def rig_of(**spad):
    return fake_rig(PLAN, [STREAM, STREAM], **{"size": 16, **spad})


def accounted(maps):
    """Received and lost frames of all sweeps; every sweep's gaps are its losses."""
    for found in maps:
        frames = found.sweep.frames
        assert frames.expected == frames.received + frames.lost == found.sweep.end_frame - found.sweep.first_frame
        assert frames.lost == sum(last - first + 1 for first, last in found.sweep.gaps)
    return sum(found.sweep.frames.received for found in maps), sum(found.sweep.frames.lost for found in maps)


def paced(rig, unless=lambda: False):
    """Let the SPAD come no faster than the ring is emptied, unless something holds."""

    def behaviour(seq):
        wait_until(lambda: not rig.spad.ring.full or rig.spad.stopped.is_set() or unless())

    rig.spad.behaviour = behaviour
    return rig


def stalled_maker(rig, until_seq):
    """A maker that is stuck in its first map until the SPAD is at a block, and a SPAD paced from there on."""
    go_on = threading.Event()

    def behaviour(seq):
        if seq >= until_seq:
            go_on.set()
            wait_until(lambda: rig.spad.stopped.is_set() or not rig.spad.ring.full)

    rig.spad.behaviour = behaviour
    return FakeMaker(lambda index: index or go_on.wait(PATIENCE_S))


def blocks_in(folder):
    files = sorted(folder.glob("frames-*.spb"))
    found = [block for f in files for block in walk_blocks(np.fromfile(f, np.uint8), None, check_payload=True)]
    assert all(hasattr(block, "bits") for block in found), found
    return found


# The policies


def test_drop_counts_every_frame_it_drops_and_goes_on():
    rig, log = rig_of(can_wait=False)
    maker = stalled_maker(rig, N_BLOCKS // 2)
    told = []
    acquired = acquisition(rig, PLAN, MAPS, maker, policy=Overload.DROP, live=told.append)
    maps = list(acquired.run())
    received, lost = accounted(maps)
    stages, counters = acquired.stages, acquired.counters
    assert len(maps) == MAPS
    assert lost == len(rig.spad.dropped) == stages.dropped_frames == counters.lost == told[-1].lost > 0
    assert stages.dropped_blocks == lost / 16
    assert counters.exposed == counters.delivered + counters.lost
    inside = range(maps[0].sweep.first_frame, maps[-1].sweep.end_frame)
    assert received == sum(frame in inside for frame in rig.spad.delivered)
    missing = {frame for found in maps for a, b in found.sweep.gaps for frame in range(a, b + 1)}
    assert missing == set(rig.spad.dropped)
    assert log == START + STOP


def test_abort_ends_the_run_at_the_first_block_without_a_slot_and_keeps_the_whole_maps():
    rig, log = rig_of(can_wait=False)
    stuck = threading.Event()

    def before(index):  # goes on only once the rig was made safe
        if index == 1:
            stuck.set()
            assert rig.spad.stopped.wait(PATIENCE_S)

    paced(rig, unless=stuck.is_set)
    maps = []
    with pytest.raises(RingOverflow, match=r"all 8 slots .* s of the stream.*lower frame_rate.*--on-overload drop"):
        maps.extend(acquisition(rig, PLAN, MAPS, FakeMaker(before)).run())
    assert 2 <= len(maps) < MAPS
    assert accounted(maps)[1] == 0
    assert len(rig.spad.dropped) == 16
    assert log == START + STOP


@pytest.mark.parametrize("policy", [Overload.ABORT, Overload.BLOCK])
def test_a_source_that_can_wait_waits_for_a_slow_caller_longer_than_the_time_out(policy):
    rig, _ = rig_of()
    acquired = acquisition(rig, PLAN, MAPS, policy=policy, silence_s=0.02)
    maps = []
    for found in acquired.run():
        if not maps:
            wait_until(lambda: acquired.stages.source_wait_s > 0.1)
            wait_until(lambda: acquired.stages.map_queue_high_water == pipeline.MAPS_AHEAD)
        maps.append(found)
    received, lost = accounted(maps)
    assert (len(maps), lost) == (MAPS, 0)
    assert acquired.counters.lost == 0
    assert received == maps[-1].sweep.end_frame - maps[0].sweep.first_frame
    assert acquired.stages.ring_high_water == acquired.stages.ring_slots == 8
    assert acquired.stages.map_queue_high_water == acquired.stages.map_queue == pipeline.MAPS_AHEAD


def test_the_rig_is_safe_and_the_ring_cannot_overflow_while_the_last_map_is_estimated():
    rig, log = fake_rig(PLAN, [stream_of(PLAN, MAPS + 3, lag=LAG)], size=16, can_wait=False)
    maker = FakeMaker(lambda index: index == MAPS - 1 and rig.spad.stopped.wait(PATIENCE_S))
    maps = list(acquisition(paced(rig), PLAN, MAPS, maker, policy=Overload.ABORT).run())
    assert (len(maps), accounted(maps)[1]) == (MAPS, 0)
    assert log == START + STOP


def test_the_ring_of_a_source_that_cannot_wait_has_a_size_in_bytes(monkeypatch):
    made = []
    monkeypatch.setattr(pipeline, "RING_BYTES", 1 << 28)
    monkeypatch.setattr(pipeline, "BlockRing", lambda slots, stride, **rest: made.append((slots, rest)))
    for stride, slots in ((4096, 1024), (1 << 20, 256), (1 << 28, 8)):
        made.clear()
        for can_wait in (False, True):
            info = rig_of(can_wait=can_wait)[0].spad.info
            pipeline.ring_for(Overload.ABORT, info, PLAN, type("Timing", (), {"stride": stride}))
        assert [n for n, _ in made] == [slots, 8]
        assert made[0][1]["holds_s"] == pytest.approx(slots * (stride // PLAN.frame_bytes) / 1e5)


# A first map that is learned from


def test_a_first_map_of_its_own_is_made_before_the_stream_goes_on():
    rig, log = rig_of(can_wait=False)
    at_maps = []
    maker = FakeMaker(lambda index: at_maps.append(log.count("spad.start")))
    maps = list(acquisition(paced(rig), PLAN, 4, maker, first_alone=True).run())
    assert [found.sweep.index for found in maps] == [0, 1, 2, 3]
    assert at_maps == [1, 2, 2, 2]
    assert log == 2 * (START + STOP)


# The recorder


def test_a_slow_recorder_loses_by_the_policy_and_both_readers_have_the_same_frames(tmp_path, monkeypatch):
    rig, _ = rig_of(can_wait=False)
    recording = Recording(tmp_path)
    submit, go_on = recording.submit, threading.Event()
    monkeypatch.setattr(recording, "submit", lambda block: (go_on.wait(PATIENCE_S), submit(block))[1])
    stalled_maker(rig, N_BLOCKS // 2)
    behaviour = rig.spad.behaviour

    def slow(seq):
        if seq == N_BLOCKS // 2:
            go_on.set()
        behaviour(seq)

    rig.spad.behaviour = slow
    acquired = acquisition(rig, PLAN, MAPS, policy=Overload.DROP, recording=recording)
    maps = list(acquired.run())
    _, lost = accounted(maps)
    recording.close()
    assert acquired.stages.dropped_frames == len(rig.spad.dropped) > 0
    # The few frames behind the last sweep may be dropped too, when the scan has ended and nobody waits for them.
    inside = range(maps[0].sweep.first_frame, maps[-1].sweep.end_frame)
    assert lost == sum(frame in inside for frame in rig.spad.dropped)
    recorded = np.concatenate([block.frame_numbers for block in blocks_in(tmp_path)]).tolist()
    assert recorded == rig.spad.delivered


def fill_up(monkeypatch, whole):
    """Let the disk be full in the middle of the block behind `whole` ones: a page of it fits."""
    write = OpenSegment._write

    def full(segment, pieces, offset):
        size = sum(len(piece) for piece in pieces)
        if offset < size * whole:
            return write(segment, pieces, offset)
        if offset == size * whole:
            write(segment, [memoryview(mmap.mmap(-1, PAGE_BYTES))], offset)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(OpenSegment, "_write", full)


@pytest.mark.parametrize("whole", [0, 5])
def test_a_full_disk_ends_the_run_in_a_line_and_what_was_before_it_is_whole(tmp_path, monkeypatch, whole):
    rig, log = rig_of()
    recording = Recording(tmp_path)
    fill_up(monkeypatch, whole)
    with pytest.raises(RecordingError, match=r"frames-000000.spb beyond .*: No space left on device; free") as caught:
        list(acquisition(rig, PLAN, MAPS, recording=recording).run())
    assert caught.value.exit_code == 3
    recording.close()
    assert log == START + STOP
    assert len(blocks_in(tmp_path)) == recording.blocks == whole
    assert sorted(file.name for file in tmp_path.iterdir()) == [segment_name(0)] * (whole > 0) + [INDEX_FILE]


# The monitor


def test_the_monitor_sees_the_newest_block_small(tmp_path):
    rig, _ = rig_of()
    views = []
    acquired = acquisition(rig, PLAN, MAPS, monitor=views.append)
    list(acquired.run())
    stages = acquired.stages
    assert len(views) == stages.monitor_updates >= 1
    view = views[0]
    block = STREAM.blocks(itertools.repeat(16))[view.first_frame // 16]
    np.testing.assert_array_equal(view.counts, np.unpackbits(block.bits, axis=2).sum(axis=0))
    np.testing.assert_allclose(view.row_profile(), view.counts.mean(axis=0) / block.n_frames)
    assert view.stages.ring_slots == 8
    assert stages.monitor_updates + stages.monitor_skipped_blocks <= N_BLOCKS


def test_a_monitor_that_nobody_watches_sees_nothing_until_somebody_does():
    rig, _ = rig_of()
    views, looks = [], []

    def watched():
        looks.append(None)
        return len(looks) > 1

    unwatched = acquisition(rig, PLAN, MAPS, monitor=views.append, watched=lambda: False)
    list(unwatched.run())
    assert (views, unwatched.stages.monitor_updates) == ([], None)
    rig, _ = rig_of()
    acquired = acquisition(
        rig,
        PLAN,
        MAPS,
        maker=FakeMaker(lambda index: wait_until(lambda: len(looks) > 1)),
        monitor=views.append,
        watched=watched,
    )
    list(acquired.run())
    assert len(views) == acquired.stages.monitor_updates >= 1


def test_windows_are_shown_where_they_lie():
    block = STREAM.blocks(itertools.repeat(16))[0]
    records = block.records.copy()
    records["x0"] = np.where(np.arange(16) < 10, 0, 64)
    header = replace(block.header, sensor_width=192, sensor_height=6)
    image = np.zeros((6, 192), np.uint16)
    add_frames(image, replace(block, header=header, records=records), 0, 16)
    pixels = np.unpackbits(block.bits, axis=2).astype(int)
    np.testing.assert_array_equal(image[:4, :64], pixels[:10].sum(axis=0))
    np.testing.assert_array_equal(image[:4, 64:128], pixels[10:].sum(axis=0))
    assert image[4:].sum() == image[:, 128:].sum() == 0


def test_a_monitor_that_raises_is_told_of_once_and_called_no_more(caplog):
    rig, _ = rig_of(can_wait=False)
    seen = []

    def watch(view):
        seen.append(view)
        raise ValueError("no window to draw in")

    maps = list(acquisition(paced(rig), PLAN, 4, monitor=watch, first_alone=True).run())
    assert len(maps) == 4
    assert len(seen) == 1
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "ValueError" in caplog.text


def test_a_monitor_that_hangs_costs_nothing_and_is_left_behind_with_a_warning(caplog):
    rig, log = rig_of()
    release, seen = threading.Event(), []
    acquired = acquisition(rig, PLAN, MAPS, monitor=lambda view: (seen.append(view), release.wait(PATIENCE_S)))
    maps = list(acquired.run())
    assert (len(maps), accounted(maps)[1]) == (MAPS, 0)
    assert len(seen) == 1
    assert log == START + STOP
    assert [record.getMessage() for record in caplog.records if "left behind" in record.getMessage()]
    assert len(caplog.records) == 1
    release.set()
    wait_until(lambda: not pipeline_threads())


# Failures


def failing_at(n, error):
    """Raises `error` at its n-th call, whatever it is called with."""
    calls = itertools.count()

    def call(*_):
        if next(calls) == n:
            raise error

    return call


def run_with_failure(stage, n, error, policy=Overload.ABORT, folder=None, can_wait=True):
    """Run with a failure in one stage; the maps that came out, the error raised and the devices' log."""
    fail = failing_at(n, error)
    rig, log = rig_of(behaviour=fail if stage == "source" else lambda seq: None, can_wait=can_wait)
    maker = FakeMaker(fail if stage == "estimation" else lambda index: None)
    recording = None
    if folder is not None:
        recording = Recording(folder)
        if stage == "recorder":
            submit = recording.submit
            recording.submit = lambda block: (fail(), submit(block))[1]
    listeners = {
        "monitor": fail if stage == "monitor" else lambda view: None,
        "live": fail if stage == "progress" else None,
    }
    acquired = acquisition(rig, PLAN, MAPS, maker, policy=policy, recording=recording, **listeners)
    maps, run = [], acquired.run()
    try:
        for found in run:
            if stage == "caller":
                fail()
            maps.append(found)
    except BaseException as caught:
        run.close()
        return maps, caught, log, recording
    finally:
        if recording is not None:
            recording.close()
    return maps, None, log, recording


@settings(max_examples=20, deadline=None)
@given(
    stage=st.sampled_from(["source", "estimation", "recorder", "monitor", "progress", "caller"]),
    n=st.integers(0, 12),
    error=st.sampled_from([KeyboardInterrupt, DeviceFault, ValueError]),
    policy=st.sampled_from([Overload.ABORT, Overload.DROP]),
    can_wait=st.booleans(),
)
def test_no_failure_anywhere_deadlocks_or_leaves_the_rig_unsafe(tmp_path_factory, stage, n, error, policy, can_wait):
    folder = tmp_path_factory.mktemp("run")
    maps, caught, log, recording = run_with_failure(stage, n, error("made to fail"), policy, folder, can_wait)
    assert log == START + STOP
    assert [found.sweep.index for found in maps] == list(range(len(maps)))
    assert caught is None or isinstance(caught, error | RingOverflow | DeviceFault)
    if caught is None:
        assert len(maps) == MAPS or accounted(maps)[1] > 0
    accounted(maps)
    assert len(blocks_in(folder)) == recording.blocks
