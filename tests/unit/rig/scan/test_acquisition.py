import dataclasses
import itertools
import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import Lag
from drivers.errors import DeviceDisconnected, DeviceError, DeviceFault, DeviceTimeout, ProtocolError
from drivers.interfaces import BurstMode, ScannerStatus
from rig.count.sweeps import SweepAssembler
from rig.count.volume import SweepCounter, SweepLayout
from rig.errors import DevicesError
from rig.run_folder.manifest import RunVerdict
from rig.scan import pipeline
from rig.scan.run import verdict_of
from rig.threads import RowWorkers
from tests.unit.rig.count.streams import HEIGHT, SPAD, WIDTH, plan_of, scan, stream_of
from tests.unit.rig.scan.fakes import PATIENCE_S, START, STOP, FakeLaser, FakeMaker, acquisition, fake_rig

LAG = Lag(1e-4, 2e-4)
PLAN = plan_of(scan(), LAG)


def rig_of(sweeps, failing=None, **spad):
    return fake_rig(PLAN, [stream_of(PLAN, sweeps, lag=LAG)], failing, **spad)


def begun(failing=None):
    """A scan of five sweeps that has given its first map, and what its devices were told."""
    rig, log = rig_of(5, failing)
    run = acquisition(rig, PLAN, 5).run()
    next(run)
    assert log == START
    return run, log


def test_devices_start_in_order_and_are_made_safe_gate_first():
    rig, log = rig_of(2)
    maps = list(acquisition(rig, PLAN, 2).run())
    assert [found.sweep.index for found in maps] == [0, 1]
    assert log == START + STOP
    assert rig.laser.power_w == 0.05  # the limit, since the config names none
    assert rig.clock.now_ns() > 0  # it waited until the laser was warm
    assert rig.laser.cold <= 0
    assert rig.spad.n_frames is None
    assert rig.scanner.repeats == 3


@pytest.mark.parametrize("error", [None, KeyboardInterrupt(), ValueError("estimate failed")])
def test_leaving_the_iteration_early_makes_the_rig_safe(error):
    run, log = begun()
    if error is None:
        run.close()
    else:
        with pytest.raises(type(error)):
            run.throw(error)
    assert log == START + STOP


@pytest.mark.parametrize("verb", ["sync.gate_low", "laser.arm", "spad.start", "sync.run", "scanner.start"])
def test_a_device_that_fails_to_start_leaves_all_of_them_safe(verb):
    device, name = verb.split(".")
    rig, log = rig_of(1, {device: {name: DeviceFault("broken")}})
    with pytest.raises(DeviceFault, match="broken"):
        list(acquisition(rig, PLAN, 1).run())
    assert log == [*START[: START.index(verb) + 1], *STOP]


def test_a_step_that_fails_does_not_keep_the_others_from_running():
    failing = {"sync": {"abort": DeviceFault("gate reads high")}, "laser": {"pause": OSError("port is gone")}}
    rig, log = rig_of(1, failing)
    with pytest.raises(DevicesError, match="gate: gate reads high\nlaser: port is gone"):
        list(acquisition(rig, PLAN, 1).run())
    assert log == START + STOP


def test_a_second_interrupt_while_stopping_still_makes_everything_safe(caplog):
    run, log = begun({"sync": {"abort": KeyboardInterrupt()}})
    with pytest.raises(KeyboardInterrupt):
        run.throw(ValueError("first"))
    assert log == START + STOP
    assert "gate: KeyboardInterrupt" in caplog.text


def test_trouble_while_stopping_is_noted_on_the_error_that_led_there():
    run, _ = begun({"scanner": {"park": DeviceFault("stuck")}})
    with pytest.raises(ValueError) as caught:
        run.throw(ValueError("first"))
    assert caught.value.__notes__ == ["scanner: stuck"]


def test_a_gate_that_does_not_obey_is_worse_where_nothing_else_ends_the_light(monkeypatch):
    monkeypatch.setattr(FakeLaser, "gate_only", True)
    run, _ = begun({"sync": {"abort": DeviceFault("gate reads high")}})
    with pytest.raises(ValueError) as caught:
        run.throw(ValueError("first"))
    hand = "laser: only that gate ends the light of laser: switch it off by hand"
    assert caught.value.__notes__ == ["gate: gate reads high", hand]


def test_a_guard_that_took_the_light_ends_a_scan_whose_spad_is_silent():
    rig, log = rig_of(2)
    failure = DeviceTimeout("the guard took the light")
    guard = SimpleNamespace(failure=None, beat=lambda frame: None, expect=lambda limits: None, wait=lambda: None)
    rig = dataclasses.replace(rig, guard=guard)
    one_map = int(PLAN.frames_for(1)) // rig.spad.size + 2

    def silent(seq):
        if seq == one_map:
            guard.failure = failure
            assert rig.spad.stopped.wait(PATIENCE_S)

    rig.spad.behaviour = silent
    run = acquisition(rig, PLAN, 2, silence_s=2 * PATIENCE_S).run()
    assert next(run).sweep.index == 0
    with pytest.raises(DeviceTimeout, match="the guard took the light"):
        next(run)
    assert log == START + STOP


@pytest.mark.parametrize("error", [DeviceDisconnected("spad: unplugged"), DeviceTimeout("spad: nothing came")])
def test_an_error_or_silence_of_the_spad_reaches_the_caller_in_its_own_words(error):
    def behaviour(seq):
        if seq:
            time.sleep(0.1)
            raise error

    rig, log = rig_of(5, behaviour=behaviour)
    with pytest.raises(type(error), match=str(error)):
        list(acquisition(rig, PLAN, 5).run())
    assert log == START + STOP


def test_a_stream_that_ends_without_the_closing_marker_is_an_error():
    rig, _ = rig_of(2)
    with pytest.raises(DeviceFault, match="ended after 2 of 4 sweeps"):
        list(acquisition(rig, PLAN, 4).run())


def test_a_scanner_that_stops_early_ends_the_scan():
    rig, log = rig_of(5)
    rig.scanner.fault = "scanner: the points ran dry"
    with pytest.raises(DeviceFault, match="ran dry"):
        list(acquisition(rig, PLAN, 5).run())
    assert log == START + STOP


def log_of_a_scanner_that_fails(**of_sync):
    """What the devices are told where the scanner notices a fault on its own thread; of_sync: replaces its methods."""

    def fails(seq):
        if seq == 2:
            vars(rig.sync).update(of_sync)
            rig.scanner.on_fault()
            log.append("noticed")
            rig.scanner.fault = "scanner: the points ran dry"

    rig, log = rig_of(5, behaviour=fails)
    with pytest.raises(DeviceFault, match="ran dry"):
        list(acquisition(rig, PLAN, 5).run())
    return log


def test_gate_and_laser_are_dark_on_the_thread_of_a_scanner_that_fails():
    assert log_of_a_scanner_that_fails() == [*START, "sync.gate_low", "laser.pause", "noticed", *STOP]


def test_a_gate_that_does_not_go_low_has_the_laser_paused_on_that_thread():
    def silent():
        raise DeviceTimeout("sync: no answer")

    assert log_of_a_scanner_that_fails(gate_low=silent) == [*START, "laser.pause", "noticed", *STOP]


@pytest.mark.parametrize("unplugged", [False, True])
def test_maps_that_are_whole_when_the_scanner_stops_early_are_still_given(unplugged, monkeypatch):
    monkeypatch.setattr("rig.scan.acquisition.TELL_S", PATIENCE_S)  # the scanner is asked once map 0 was taken
    rig, log = rig_of(5)
    at_work = threading.Event()

    def ask(scanner):  # the counting thread waits at the end of map 3, for one of 1 and 2 to be taken
        assert at_work.wait(PATIENCE_S)
        if unplugged:
            raise DeviceDisconnected("the points ran dry")
        return ScannerStatus(True, "the points ran dry", None)

    rig.scanner.__class__ = type("Failing", (type(rig.scanner),), {"status": property(ask)})
    run = acquisition(rig, PLAN, 5, FakeMaker(lambda index: index == 3 and at_work.set())).run()
    assert [next(run).sweep.index for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(DeviceError, match="ran dry"):
        list(run)
    assert log == START + STOP


def test_a_spad_that_hangs_meanwhile_does_not_hide_why_the_scan_was_ended(monkeypatch):
    monkeypatch.setattr(pipeline, "JOIN_S", 0.01)
    over = threading.Event()
    rig, log = rig_of(5, behaviour=lambda seq: seq < 3 or over.wait(PATIENCE_S))
    rig.scanner.fault = "scanner: the points ran dry"
    with pytest.raises(DeviceFault, match="ran dry") as caught:
        list(acquisition(rig, PLAN, 5).run())
    over.set()
    assert "spad did not return" in caught.value.__notes__[0]
    assert log == START + STOP


def test_progress_ends_with_the_frames_planned_and_is_never_above_them():
    told = []
    rig, _ = rig_of(2, size=1000)  # the last block goes on behind the last marker
    list(acquisition(rig, PLAN, 2, live=told.append).run())
    assert [p.frames for p in told] == sorted(p.frames for p in told)
    assert {p.frames_planned for p in told} == {math.ceil(PLAN.frames_for(2))}
    assert told[-1].frames == told[-1].frames_planned
    assert (told[-1].sweeps, told[-1].maps, told[-1].lost) == (2, 2, 0)


@pytest.mark.parametrize("learns", [True, False])
def test_progress_names_the_stage_that_the_run_is_at(learns):
    stages, heard = [], threading.Event()

    def told(progress):
        stages.append(progress.stage)
        heard.set()

    def wait_to_be_told(_):
        heard.clear()
        assert heard.wait(PATIENCE_S)

    rig, _ = rig_of(2, size=16, behaviour=lambda seq: seq or wait_to_be_told(seq))
    maker = FakeMaker(lambda index: (wait_to_be_told(index), wait_to_be_told(index)))
    list(acquisition(rig, PLAN, 2, maker, learns=learns, live=told, silence_s=PATIENCE_S).run())
    assert list(dict.fromkeys(stages)) == ["rendering", *["learning"] * learns, "estimating"]


def test_bursts_are_taken_in_groups_and_numbered_through():
    spad = dataclasses.replace(SPAD, stream=None, burst=BurstMode(900, 1e6))
    plan = plan_of(scan(columns=40), LAG, spad=spad)
    assert int((900 - 500) / float(plan.frames_per_sweep)) == 1  # sweeps a start
    streams = [stream_of(plan, 1, lag=LAG, latency_s=t) for t in (1e-4, 3e-4, 7e-4)]
    rig, log = fake_rig(plan, streams)
    maps = list(acquisition(rig, plan, 3).run())
    assert [found.sweep.index for found in maps] == [0, 1, 2]
    assert log == 3 * (START + STOP)
    assert rig.spad.n_frames <= 900


@pytest.mark.parametrize(("started_s", "late"), [(0.001, False), (2.0, True)])
def test_a_burst_that_is_over_before_its_sweep_is_laid_to_a_scanner_that_started_late(started_s, late):
    plan = plan_of(scan(columns=40), LAG, spad=dataclasses.replace(SPAD, stream=None, burst=BurstMode(900, 1e6)))
    rig, log = fake_rig(plan, [SimpleNamespace(blocks=lambda *_: [])])
    rig.scanner.start = lambda: rig.clock.sleep(started_s)
    with pytest.raises(DeviceFault, match="without the scan marker that closes the last one") as failed:
        list(acquisition(rig, plan, 1).run())
    notes = getattr(failed.value, "__notes__", [])
    assert [note.partition(",")[0] for note in notes] == late * ["scanner started 2 s after the SPAD"]
    assert log[-len(STOP) :] == STOP


def test_sweeps_are_taken_in_groups_that_a_program_holds():
    rig, log = fake_rig(PLAN, [stream_of(PLAN, 2, lag=LAG), stream_of(PLAN, 1, lag=LAG)])
    rig.sync.most = 2
    assert [found.sweep.index for found in acquisition(rig, PLAN, 3).run()] == [0, 1, 2]
    assert log == 2 * (START + STOP)


def sweeps_of(plan, blocks, maps):
    layout = SweepLayout(plan.columns, HEIGHT, WIDTH, plan.x0, plan.window, plan.exposures)
    counter = SweepCounter(layout, RowWorkers(1))
    assembler = SweepAssembler(plan, counter, maps)
    found = []
    for block in blocks:
        found += assembler.add(block)
        if assembler.complete:
            break
    return found


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(1, 200), min_size=1, max_size=8), st.lists(st.integers(0, 400), max_size=6))
def test_counted_sweeps_do_not_depend_on_the_size_of_blocks(sizes, lost):
    plan = plan_of(scan(bidirectional=True, columns=11), LAG)
    stream = stream_of(plan, 3, lag=LAG, clock_error=6e-5)
    whole = sweeps_of(plan, stream.blocks(itertools.repeat(10**6), lost), 3)
    parts = sweeps_of(plan, stream.blocks(itertools.cycle(sizes), lost), 3)
    assert len(whole) == 3
    for one, other in zip(whole, parts, strict=True):
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if field.name not in ("tally", "count_s"):
                assert a == b or a != a, field.name
        for name in ("counts", "x0", "n_frames", "column", "dark_counts"):
            np.testing.assert_array_equal(getattr(one.tally, name), getattr(other.tally, name))


def test_blocks_of_another_run_or_size_are_refused():
    blocks = stream_of(PLAN, 1, lag=LAG).blocks(itertools.repeat(32))
    stale = dataclasses.replace(blocks[1], header=dataclasses.replace(blocks[1].header, run_id=9))
    small = dataclasses.replace(blocks[0], header=dataclasses.replace(blocks[0].header, height=2))
    with pytest.raises(ProtocolError, match="of start 9, not of start 1"):
        sweeps_of(PLAN, [blocks[0], stale], 1)
    with pytest.raises(ProtocolError, match="64 x 2 pixels, the plan is for 64 x 4"):
        sweeps_of(PLAN, [small], 1)
    with pytest.raises(ProtocolError, match="before frame 32"):
        sweeps_of(PLAN, [blocks[0], blocks[0]], 1)


def test_a_map_that_its_own_light_speaks_against_makes_the_run_doubtful():
    assert verdict_of([], None, aborted=False, doubtful=True) is RunVerdict.DOUBTFUL
