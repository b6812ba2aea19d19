"""A recording in a SPAD's place: the same frames, whatever the blocks."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceFault, DeviceNotFound, LimitExceeded
from drivers.frames import BlockFlag, FrameBlock, Mark
from drivers.interfaces import ScanWaveform, SpadRequest, WindowTable
from drivers.registry import Surroundings
from drivers.replay.spad import KIND, ReplaySpad, ReplaySpadConfig
from drivers.replay.stand_ins import SCANNER, StandInConfig
from drivers.ring import BlockRing, OnFull
from drivers.spb1 import HEADER_BYTES, BlockLayout, block_parts, block_views, seal_block
from tests.unit.drivers.spb1.spb1_bytes import GOLDEN_HEADER
from tests.wire.spad_runs import finish

WIDTH, HEIGHT = 96, 4
PERIOD = 1000
REQUEST = SpadRequest(Fraction(100_000), 9e-6, "stream", block_frames=16)
SCANS = (5, 40, 75)


def block(run_id: int, seq: int, first: int, n: int, lost: int, **header_fields: int) -> FrameBlock:
    """Frames whose pixels say their number and run."""
    layout = BlockLayout(n, WIDTH, HEIGHT)
    buffer = np.zeros(layout.min_stride, np.uint8)
    records, bits = block_views(buffer, layout)
    numbers = np.arange(first, first + n)
    records["ticks"] = np.arange(n) * PERIOD
    records["marks"] = np.where(np.isin(numbers, SCANS), int(Mark.SCAN), 0)
    records["sweep"] = (70_000 + np.searchsorted(SCANS, numbers, "right")) & 0xFFFF
    bits[:, 0, 0], bits[:, 1, 0] = numbers, run_id
    header = replace(
        GOLDEN_HEADER,
        flags=BlockFlag.FIRST if seq == 0 else BlockFlag(0),
        run_id=run_id,
        block_seq=seq,
        first_frame=first,
        t0_ticks=10**12 + first * PERIOD,
        lost_before=lost,
        sweep=70_000 + int(np.searchsorted(SCANS, first, "right")),
        width=WIDTH,
        height=HEIGHT,
        sensor_width=WIDTH,
        sensor_height=HEIGHT,
        **header_fields,
    )
    return seal_block(buffer, header, layout, payload_crc=True)


def two_starts() -> list[FrameBlock]:
    """Frames 0 to 99 of run 7, without 30 to 33, and 0 to 49 of run 8."""
    first = (7, 0, 0, 10, 0), (7, 1, 10, 20, 0), (7, 2, 34, 30, 4), (7, 3, 64, 36, 4)
    return [block(*one) for one in (*first, (8, 0, 0, 25, 0), (8, 1, 25, 25, 0))]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    for one in two_starts():
        with (tmp_path / f"frames-{one.header.run_id - 7:06d}.spb").open("ab") as file:
            file.writelines(block_parts(one))
    return tmp_path


@contextmanager
def replay(folder: Path, **config: Any) -> Iterator[ReplaySpad]:
    settings = ReplaySpadConfig(recording=folder, **{"clock": "max", **config})
    with KIND.create(settings, Surroundings(VirtualClock(), None, 0)) as device:
        yield device


def played(device: ReplaySpad, block_frames: int = 16) -> list[FrameBlock]:
    """One start."""
    return next_start(device, device.configure(replace(REQUEST, block_frames=block_frames)).stride)


def next_start(device: ReplaySpad, stride: int) -> list[FrameBlock]:
    ring = BlockRing(200, stride)
    reader = ring.reader("test")
    device.start(None)
    finish(device, ring)
    return list(reader)


def frames(blocks: list[FrameBlock]) -> list[tuple[int, int, int, int, bytes]]:
    """Number, time, sweep, marks and pixels of every frame."""
    return [
        (int(n), int(t), sweep + ((int(r["sweep"]) - sweep) & 0xFFFF), int(r["marks"]), b.tobytes())
        for one in blocks
        for sweep in (one.header.sweep,)
        for n, t, r, b in zip(one.frame_numbers, one.start_ticks, one.records, one.bits, strict=True)
    ]


@pytest.mark.parametrize("block_frames", [1, 7, 64, 1000])
def test_the_frames_are_those_recorded_whatever_the_blocks(recording: Path, block_frames: int) -> None:
    recorded = frames([one for one in two_starts() if one.header.run_id == 7])
    with replay(recording) as device:
        blocks = played(device, block_frames)
        assert frames(blocks) == recorded
        assert max(one.n_frames for one in blocks) <= block_frames
        assert [one.header.first_frame for one in blocks if one.header.flags & BlockFlag.LOST_BEFORE] == [34]
        assert device.counters.delivered == 96
        assert device.counters.lost == 4
        assert blocks[-1].header.flags & BlockFlag.LAST


def test_starts_follow_one_another_and_end_unless_they_loop(recording: Path) -> None:
    with replay(recording) as device:
        stride = device.configure(REQUEST).stride
        ids = [next_start(device, stride)[0].header.run_id for _ in range(2)]
        assert ids == [7, 8]
        with pytest.raises(DeviceFault, match="2 starts are played"):
            device.start(None)
        device.configure(REQUEST)
        assert next_start(device, stride)[0].header.run_id == 7
    with replay(recording, loop=True) as device:
        device.configure(REQUEST)
        ids = [next_start(device, stride)[0].header.run_id for _ in range(5)]
        assert len(set(ids)) == 5


def test_no_two_starts_of_a_loop_have_the_same_number_where_one_is_left_out(recording: Path) -> None:
    third = block(9, 0, 0, 25, 0)
    (recording / "frames-000002.spb").write_bytes(b"".join(map(bytes, block_parts(third))))
    with replay(recording, loop=True) as device:
        device.leave_out({1})
        stride = device.configure(REQUEST).stride
        assert [next_start(device, stride)[0].header.run_id for _ in range(5)] == [7, 9, 10, 12, 13]


def test_a_block_whose_payload_is_damaged_is_left_out_and_counted(recording: Path) -> None:
    file = recording / "frames-000000.spb"
    data = bytearray(file.read_bytes())
    place = data.index(bytes([45, 0, 0, 0, 0, 0, 0, 0]), 4096)  # the pixels of frame 45
    data[place] ^= 1
    file.write_bytes(data)
    with replay(recording) as device:
        numbers = [frame[0] for frame in frames(played(device))]
        assert numbers == [*range(30), *range(64, 100)]
        assert device.counters.crc_errors == 1
        assert device.counters.lost == 34


def test_what_was_not_recorded_cannot_be_asked_for(recording: Path) -> None:
    with replay(recording) as device:
        for other in (
            replace(REQUEST, frame_rate_hz=Fraction(50_000)),
            replace(REQUEST, exposure_s=5e-6),
            replace(REQUEST, window=WindowTable(64, (np.zeros(1, np.int32),))),
        ):
            with pytest.raises(LimitExceeded):
                device.configure(other)


def test_frames_without_a_rate_are_not_played_and_the_next_step_is_said(tmp_path: Path) -> None:
    unpaced = block(7, 0, 0, 10, 0, frame_period_ticks=0, exposure_ticks=0)
    (tmp_path / "frames-000000.spb").write_bytes(b"".join(bytes(part) for part in block_parts(unpaced)))
    with replay(tmp_path) as device, pytest.raises(LimitExceeded, match=r"at what rate .* import them again with"):
        device.configure(REQUEST)


def test_a_full_ring_that_does_not_wait_loses_frames_and_says_so(recording: Path) -> None:
    with replay(recording) as device:
        timing = device.configure(REQUEST)
        ring = BlockRing(2, timing.stride, on_full=OnFull.DROP)
        reader = ring.reader("test")
        device.start(None)
        blocks = []
        while device.fill(ring, 1.0):
            if ring.dropped_blocks and not ring._free:  # from here on there is room
                blocks.append(reader.next(0))
                reader.release()
        ring.finish()
        blocks += list(reader)
        counters = device.counters
        assert counters.exposed == 100
        assert counters.lost == 4 + ring.dropped_frames
        assert any(one.header.flags & BlockFlag.LOST_BEFORE for one in blocks)


def test_a_step_ends_with_the_next_scan_marker(recording: Path) -> None:
    with replay(recording, clock="step") as device:
        timing = device.configure(replace(REQUEST, block_frames=1000))
        ring = BlockRing(20, timing.stride)
        reader = ring.reader("test")
        device.start(None)
        ends = []
        for _ in range(10):
            device.pace.step()
            if not device.fill(ring, 1.0):
                break
            found = reader.next(0)
            assert found is not None
            ends.append(int(found.frame_numbers[-1]))
        assert ends == [5, 29, 40, 75]  # 29: the gap


@pytest.mark.parametrize("damaged", [False, True])
def test_real_time_is_that_of_the_recording_also_if_its_first_block_is_lost(recording: Path, damaged: bool) -> None:
    clock = VirtualClock()
    if damaged:
        file = recording / "frames-000000.spb"
        data = bytearray(file.read_bytes())
        data[HEADER_BYTES] ^= 1
        file.write_bytes(data)
    with KIND.create(ReplaySpadConfig(recording=recording, clock="x0.01"), Surroundings(clock, None, 0)) as device:
        played(device)
        assert clock.now_ns() / 1e9 == pytest.approx(100 * 1e-5 / 0.01)
        assert device.pace.report.late_max_s == pytest.approx(0, abs=1e-6)


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="--record"), replay(tmp_path):
        pass
    with pytest.raises(DeviceNotFound, match="rig replay RUN"):
        KIND.create(ReplaySpadConfig(), Surroundings(VirtualClock(), None, 0))


@pytest.mark.parametrize("rate", [Fraction(112_000_000, 110_017), Fraction(48_000_000, 47_999), Fraction(25_000)])
def test_the_stand_in_for_the_scanner_runs_at_the_very_rate_of_the_one_recorded(rate: Fraction) -> None:
    command = np.zeros(4)
    with SCANNER.create(StandInConfig(), Surroundings(VirtualClock(), None, 0)) as scanner:
        assert scanner.load(ScanWaveform(command, command.astype(np.uint8), rate), 1) == rate
