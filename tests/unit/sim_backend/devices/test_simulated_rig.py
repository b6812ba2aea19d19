"""The simulated devices together: what the SPAD records depends on mirror, gate and laser, and on its own crystal."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.files.rig_file import save_rig_model
from drivers.clock import VirtualClock
from drivers.errors import DeviceError, DeviceTimeout
from drivers.frames import BlockFlag, FrameBlock, Mark
from drivers.interfaces import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    OUT_GATE,
    BeamScanner,
    LineLaser,
    Pulse,
    ScanWaveform,
    SpadArray,
    SpadRequest,
    SyncSource,
    WindowTable,
)
from drivers.registry import Surroundings
from drivers.ring import BlockRing, OnFull
from sim_backend.devices import laser, scanner, spad, sync
from sim_backend.devices.spad import STEP_S, TickClock
from sim_backend.light.optics import Sensor
from sim_backend.world import SimulatedWorld, WorldConfig
from tests.unit.sim_backend.rigs import rig

_SENSOR = Sensor()
POINTS, RATE_HZ = 400, 100_000
GATE_OPEN_S, GATE_S = 5e-4, 3e-3


@dataclass
class Rig:
    """A small simulated rig, every device open."""

    clock: VirtualClock
    world: SimulatedWorld
    spad: SpadArray
    scanner: BeamScanner
    laser: LineLaser
    sync: SyncSource

    def start(
        self, *, frames: int | None = 1000, block_frames: int = 31, window: WindowTable | None = None
    ) -> BlockRing:
        """Everything started in the order of a scan: two sweeps of 4 ms, gate high from 0.5 to 3.5 ms of each."""
        timing = self.spad.configure(SpadRequest(Fraction(100_000), 1e-5, "stream", block_frames, window))
        command = -0.4 * np.cos(2 * np.pi * np.arange(POINTS) / POINTS)
        markers = np.zeros(POINTS, np.uint8)
        markers[0] |= MARKER_SCAN
        markers[50:350:10] |= MARKER_LINE
        markers[200:] |= LEVEL_BACKWARD
        rate = self.scanner.point_clock(RATE_HZ)
        self.scanner.load(ScanWaveform(command, markers, rate), 2)
        self.sync.program([Pulse(0, None), Pulse(0, GATE_OPEN_S), Pulse(OUT_GATE, GATE_S)], 2)
        self.spad.start(frames)
        self.laser.arm(0.1)
        self.sync.run()
        self.scanner.start()
        return BlockRing(4, timing.stride)


class Recording:
    """What came out of a run, copied."""

    def __init__(self, blocks: list[FrameBlock]) -> None:
        self.headers = [block.header for block in blocks]
        self.frames = np.concatenate([block.frame_numbers for block in blocks])
        self.records = np.concatenate([block.records for block in blocks])
        self.bits = np.concatenate([block.bits for block in blocks])
        self.ticks = np.concatenate([block.start_ticks for block in blocks])

    @property
    def ones(self) -> NDArray[np.int64]:
        """1s per frame."""
        return np.bitwise_count(self.bits).sum(axis=(1, 2), dtype=np.int64)

    def marked(self, mark: Mark) -> NDArray[np.bool_]:
        """Frames with a mark."""
        return (self.records["marks"] & mark) != 0


def _record(rig: Rig, ring: BlockRing) -> Recording:
    reader, blocks = ring.reader("test"), []
    more = True
    while more:
        more = rig.spad.fill(ring, 1.0)
        if not more:
            ring.finish()
        block = reader.next(0.1)
        if block is not None:  # None: the last frames of the run got lost
            blocks.append(FrameBlock(block.header, block.records.copy(), block.bits.copy()))
    return Recording(blocks)


def _open(folder: Path, seed: int = 1, sensor: Sensor = _SENSOR, **spad_config: object) -> Rig:
    geometry = folder / "rig.yaml"
    if not geometry.exists():
        save_rig_model(rig(size=(20, 70), focal_px=80.0), geometry)
    clock, config = VirtualClock(123_457), WorldConfig(geometry=str(geometry), scene="street-clear", sensor=sensor)
    world = SimulatedWorld(config, Surroundings(clock, None, seed))
    around = Surroundings(clock, world, seed)
    return Rig(
        clock,
        world,
        spad.KIND.create(spad.KIND.config.model_validate({"kind": "simulated", **spad_config}), around),
        scanner.KIND.create(scanner.SimulatedScannerConfig(), around),
        laser.KIND.create(laser.SimulatedLaserConfig(), around),
        sync.KIND.create(sync.SimulatedSyncConfig(), around),
    )


def _run(folder: Path, block_frames: int = 31, window: WindowTable | None = None, **config: Any) -> Recording:
    opened = _open(folder, **config)
    return _record(opened, opened.start(block_frames=block_frames, window=window))


def _runs(folder: Path, window: WindowTable | None = None, **config: Any) -> list[Recording]:
    """The same run in blocks of two sizes."""
    return [_run(folder, block_frames, window, **config) for block_frames in (31, 600)]


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Rig]:
    opened = _open(tmp_path)
    yield opened
    for device in (opened.sync, opened.laser, opened.scanner, opened.spad):
        device.close()


def test_frames_are_lit_exactly_while_the_gate_is_high_where_the_mirror_is(small: Rig) -> None:
    run = _record(small, small.start())
    lit = run.marked(Mark.GATE_HIGH)
    assert 2 * 298 <= lit.sum() <= 2 * 300
    assert run.marked(Mark.GATE_EDGE).sum() <= 4
    dark = ~lit & ~run.marked(Mark.GATE_EDGE)
    assert run.ones[lit].mean() > 3 * run.ones[dark].mean()
    columns = np.unpackbits(run.bits[np.flatnonzero(lit)[:290]], axis=-1)[:, :, :70].sum(axis=1)
    x = np.arange(70)
    early, late = columns[:20].sum(axis=0), columns[130:150].sum(axis=0)
    assert late @ x / late.sum() > early @ x / early.sum() + 8


def test_windows_move_with_the_markers_and_hold_the_bits_of_the_full_frames(tmp_path: Path) -> None:
    entries = np.arange(31) // 7 % 2 * 64
    window = WindowTable(64, (entries.astype(np.int32), 64 - entries.astype(np.int32)))
    lost = [200, 201, 430]
    full, runs = _run(tmp_path, lost_frames=lost), _runs(tmp_path, window, lost_frames=lost)
    for run in runs:
        assert np.array_equal(run.records["marks"], full.records["marks"])
        assert {header.width for header in run.headers} == {64}
        for i in range(1, len(run.frames)):
            if run.frames[i] - 1 != run.frames[i - 1]:
                continue  # the markers before it were lost with the frames
            before = full.records[i - 1]
            table = window.x0[max(int(before["sweep"]) - 1, 0) % 2]
            expected = table[min(int(before["line"]), 30)] if before["sweep"] else window.x0[0][0]
            assert run.records["x0"][i] == expected
        at = run.records["x0"] // 8
        for i in range(len(run.frames)):
            assert np.array_equal(run.bits[i], full.bits[i, :, at[i] : at[i] + 8])
        assert set(run.records["x0"].tolist()) == {0, 64}


def test_records_tell_markers_direction_and_counters(small: Rig) -> None:
    before = small.clock.now_ns()
    run = _record(small, small.start())
    assert small.clock.now_ns() - before == pytest.approx(10_000_000, abs=10)
    assert not np.unpackbits(run.bits, axis=-1)[:, :, 70:].any()
    scans, lines = np.flatnonzero(run.marked(Mark.SCAN)), np.flatnonzero(run.marked(Mark.LINE))
    assert len(scans) == 2
    assert len(lines) == 60
    assert run.records["sweep"][[scans[0] - 1, scans[0], scans[1]]].tolist() == [0, 1, 2]
    assert run.records["line"][[lines[0], lines[29], scans[1], lines[30]]].tolist() == [1, 30, 0, 1]
    backward = run.marked(Mark.BACKWARD)
    assert 390 <= backward.sum() <= 410
    # Sub-frame places: scan edges are 4 ms apart on a clock 20 ppm fast, so 400 frames less 0.8 hundredths.
    place = (run.records["marks"][scans] >> 8) & 0xFF
    times = run.ticks[scans] / 1000 + (place + 0.5) / 256
    assert np.diff(times)[0] == pytest.approx(400 / (1 + 20e-6), abs=1 / 256)
    assert 10 < place[0] < 246  # a scan does not start on a frame's border


@pytest.mark.parametrize("sensor", [_SENSOR, Sensor(afterpulsing="50 %", trap_lifetime="8 us")])
def test_lost_frames_close_the_block_and_are_counted(tmp_path: Path, sensor: Sensor) -> None:
    gappy = _open(tmp_path, sensor=sensor, lost_frames=(0, 140, 141, 999))
    whole, run = _run(tmp_path, sensor=sensor), _record(gappy, gappy.start())
    kept = np.setdiff1d(np.arange(1000), [0, 140, 141, 999])
    assert np.array_equal(run.frames, kept)
    assert np.array_equal(run.bits, whole.bits[kept])
    assert np.array_equal(run.records["sweep"], whole.records["sweep"][kept])
    after_gap = [h for h in run.headers if h.first_frame in (1, 142)]
    assert [h.lost_before for h in after_gap] == [1, 3]
    assert all(h.flags & BlockFlag.LOST_BEFORE for h in after_gap)
    counters = gappy.spad.counters
    assert (counters.exposed, counters.delivered, counters.lost) == (1000, 996, 4)


def test_a_frame_that_comes_twice_has_markers_counters_and_ticks_of_the_first_time(tmp_path: Path) -> None:
    doubled = _open(tmp_path, duplicate_probability=0.1)
    whole, run = _run(tmp_path), _record(doubled, doubled.start())
    assert np.array_equal(run.frames, whole.frames)
    twice = np.flatnonzero(np.diff(run.ticks) == 0) + 1
    assert 60 < len(twice) < 140
    assert not np.isin(twice, [header.first_frame for header in run.headers]).any()
    for name in ("marks", "line", "sweep"):
        assert np.array_equal(run.records[name][twice], run.records[name][twice - 1])
    assert np.array_equal(run.bits[twice], run.bits[twice - 1])
    once = np.setdiff1d(run.frames, twice)
    assert np.array_equal(run.ticks[once], whole.ticks[once])
    assert np.array_equal(run.bits[once], whole.bits[once])
    assert doubled.spad.counters.lost == 0


@pytest.mark.parametrize("wander", ["0 ppm", "900 ppm"])
def test_a_spad_clock_that_is_off_sees_the_scanner_run_by_its_own_ticks(tmp_path: Path, wander: str) -> None:
    run, other = _runs(tmp_path, clock_error="-900 ppm", clock_wander=wander)
    scans = np.flatnonzero(run.marked(Mark.SCAN))
    times = run.ticks[scans] / 1000 + (((run.records["marks"][scans] >> 8) & 0xFF) + 0.5) / 256
    expected = 400 * (1 - 900e-6) / (1 + 20e-6)
    assert np.diff(times)[0] == pytest.approx(expected, abs=1 / 256 if wander == "0 ppm" else 0.1)
    assert np.array_equal(other.records[["marks", "line", "sweep"]], run.records[["marks", "line", "sweep"]])
    assert np.array_equal(other.bits, run.bits)
    assert np.array_equal(other.ticks, run.ticks)


def test_a_spad_that_loses_everything_times_out(tmp_path: Path) -> None:
    opened = _open(tmp_path, loss_probability=1.0)
    ring = opened.start(frames=None)
    with pytest.raises(DeviceTimeout, match="got lost"):
        opened.spad.fill(ring, 0.01)
    with pytest.raises(DeviceError, match="no simulated world"):
        spad.KIND.create(spad.SimulatedSpadConfig(), Surroundings(VirtualClock(), None, 0))


def test_the_frames_of_a_column_share_the_flux_of_their_mean_position(small: Rig) -> None:
    commands = np.linspace(-0.3, 0.3, 13)
    small.world.hold_columns(commands)
    hold = small.world.grid.hold
    for step in (0.005, -0.005, 0.0071):  # 10 frames a column, 10 on the way back, 7 or 8
        at = 0.0013 + step * np.arange(-60, 60)
        column = np.rint(at / 0.05)
        whole = np.abs(column) < 4
        held = hold(at, np.full(120, step))
        for here in np.unique(column[whole]):
            assert np.all(held[column == here] == held[column == here][0])
            assert held[column == here][0] == pytest.approx(at[column == here].mean(), abs=1e-9)
    near, unknown = commands[4] + np.linspace(-0.45, 0.45, 10) * 0.05, np.full(10, np.nan)
    assert np.all(hold(near, unknown) == commands[4])
    assert hold(near[:1], np.array([0.06]))[0] == pytest.approx(near[0], abs=1e-9)  # one frame a column
    assert np.isnan(hold(np.array([1.2]), np.zeros(1))[0])
    assert hold(np.array([0.41]), unknown[:1])[0] == pytest.approx(0.4)


def test_where_the_ring_lets_it_not_wait_it_drops_whole_blocks_and_counts_them(small: Rig) -> None:
    stride = small.start(frames=155).stride
    ring = BlockRing(2, stride, on_full=OnFull.DROP)
    reader = ring.reader("test")
    for _ in range(4):
        assert small.spad.fill(ring, 1.0)
    assert (ring.dropped_blocks, ring.dropped_frames) == (2, 62)
    assert reader.next(0) is not None
    assert reader.next(0) is not None
    assert not small.spad.fill(ring, 1.0)
    last = reader.next(0)
    assert last is not None
    assert (last.header.first_frame, last.header.block_seq, last.header.lost_before) == (124, 2, 62)
    assert last.header.flags == BlockFlag.LAST | BlockFlag.LOST_BEFORE
    counters = small.spad.counters
    assert (counters.exposed, counters.delivered, counters.lost) == (155, 93, 62)


TICK_S, PERIOD = 1e-8, 1000
START_S = 12.5


def _clock(error: float, wander: float, seed: int = 1) -> TickClock:
    return TickClock(TICK_S, START_S, error, wander, [seed])


@pytest.mark.parametrize("error", [-200e-6, 0.0, 50e-6])
def test_a_fast_crystal_takes_its_frames_closer_together(error: float) -> None:
    times = _clock(error, 0.0).times_s(0, PERIOD, 100_001)
    assert times[0] == START_S
    assert times[-1] - START_S == pytest.approx(1 / (1 + error), abs=1e-12)
    assert np.all(np.diff(times) > 0)


def test_the_error_wanders_with_the_root_of_time() -> None:
    wander, seconds, runs = 1e-6, 0.5, 200
    late = []
    for seed in range(runs):
        times = _clock(20e-6, wander, seed).times_s(0, round(0.1 / TICK_S), 6)
        late.append((times[-1] - START_S) * (1 + 20e-6) - seconds)
    # The integral of a random walk over T has variance wander^2 T^3 / 3.
    expected = wander * np.sqrt(seconds**3 / 3)
    assert np.std(late) == pytest.approx(expected, rel=4 / np.sqrt(2 * runs))
    assert abs(np.mean(late)) < 4 * expected / np.sqrt(runs)


@pytest.mark.parametrize("block", [1, 450])
def test_times_do_not_depend_on_how_they_are_asked_for(block: int) -> None:
    frames = round(3.2 * STEP_S / TICK_S / PERIOD)
    whole = _clock(50e-6, 1e-3).times_s(0, PERIOD, frames + 1)
    clock = _clock(50e-6, 1e-3)
    for first in range(0, frames, block):
        n = min(block, frames - first)
        # As the SPAD asks: with the start of the frame behind, which is asked for again.
        assert np.array_equal(clock.times_s(first * PERIOD, PERIOD, n + 1), whole[first : first + n + 1])
