"""The account of a sweep's frames, beside what test_acquisition.py and test_windows.py pin."""

import itertools
from dataclasses import dataclass

import numpy as np

from drivers.recorded.reader import block_part
from rig.count.sweeps import FirstSweep, SweepAssembler
from rig.count.volume import BIN_DARK, BIN_UNUSABLE, FrameTally
from tests.unit.rig.count.streams import plan_of, scan, stand_still, stream_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Noted(FrameTally):
    """The bins of a sweep's frames."""

    bins: list[int]


class Noting:
    """A counter that counts the frames of each bin, and nothing of what is in them."""

    def __init__(self):
        self.calls = 0
        self.reset()

    def reset(self):
        self.bins = []

    def add(self, bits, bins, column, x0):
        self.bins += bins.tolist()
        self.calls += 1

    def settle(self, under_way=0):
        self.settled = under_way

    def finish(self):
        nothing = np.zeros(0)
        return Noted(
            n_frames=nothing.astype(np.int32), column=nothing, dark_counts=None, n_dark=0, width=0, bins=list(self.bins)
        )


def test_frames_beyond_what_a_column_may_use_are_received_but_not_lit():
    plan = plan_of(scan(exposures=40, columns=30))
    stream = stream_of(plan, 1)
    stand_still(stream, 700)
    (sweep,) = sweeps(plan, stream.blocks(itertools.repeat(100)))
    bins = np.array(sweep.tally.bins)
    assert np.bincount(bins[bins >= 0]).max() == 255
    assert sweep.frames.lit == np.count_nonzero(bins >= 0)
    assert sweep.frames.dark == np.count_nonzero(bins == BIN_DARK)
    assert sweep.frames.received == sweep.frames.expected == len(bins)
    assert sweep.frames.lost == 0


def test_blocks_that_may_be_given_back_are_waited_for_by_what_they_added():
    plan = plan_of(scan(columns=30))
    stream = stream_of(plan, 2)
    counter = Noting()
    assembler = SweepAssembler(plan, counter, maps=2)
    added = []
    for block in stream.blocks(itertools.repeat(100)):
        before = counter.calls
        list(assembler.add(block))
        added.append(counter.calls - before)
        for blocks in (0, 1, 3):
            assembler.settle(blocks)
            assert counter.settled == (sum(added[-blocks:]) if blocks else 0)
        if assembler.complete:
            break
    assert max(added) == 2  # a block in which one sweep ends and the next one begins


def test_a_sweep_whose_first_marker_got_lost_has_lost_frames():
    plan = plan_of(scan(columns=30))
    stream = stream_of(plan, 1)
    lost = range(stream.scan_frames[0] - 5, stream.scan_frames[0] + 3)
    (sweep,) = sweeps(plan, stream.blocks(itertools.repeat(100), lost))
    assert (sweep.first_frame, sweep.frames.lost) == (lost.start, len(lost))
    assert sweep.gaps == ((lost.start, lost.stop - 1),)


def test_maps_of_a_part_begin_with_the_sweep_that_is_whole():
    plan = plan_of(scan(columns=30))
    stream = stream_of(plan, 3)
    blocks = stream.blocks(itertools.repeat(100))
    whole = sweeps(plan, blocks, maps=3)
    first = stream.scan_frames[0] + 50  # in the middle of sweep 0
    part = SweepAssembler(plan, Noting(), 2, 0, FirstSweep(1, 1 + whole[0].clock_error))
    kept = [block_part(block, first, 10**6) for block in blocks if block.header.first_frame + block.n_frames > first]
    found = [sweep for block in kept for sweep in part.add(block)]
    assert [sweep.index for sweep in found] == [0, 1]
    assert [sweep.tally.bins for sweep in found] == [sweep.tally.bins for sweep in whole[1:]]
    assert part.complete


def test_a_frame_that_comes_twice_is_lost_where_it_comes_again_whatever_the_blocks():
    plan = plan_of(scan(columns=30))
    whole, doubled = stream_of(plan, 1), stream_of(plan, 1)
    twice = [doubled.scan_frames[0] + 5, doubled.scan_frames[0] + 100, doubled.scan_frames[0] + 101]
    for frame in twice:
        doubled.records[frame], doubled.ticks[frame] = doubled.records[frame - 1], doubled.ticks[frame - 1]
    (missed,) = sweeps(plan, whole.blocks(itertools.repeat(50), twice))
    for size in (1, 7, twice[0], 500):
        (sweep,) = sweeps(plan, doubled.blocks(itertools.repeat(size)))
        assert sweep.frames == missed.frames
        assert [gap for first, last in sweep.gaps for gap in range(first, last + 1)] == twice
        bins = np.array(sweep.tally.bins)
        assert bins[bins != BIN_UNUSABLE].tolist() == [found for found in missed.tally.bins if found != BIN_UNUSABLE]


def sweeps(plan, blocks, maps=1):
    assembler = SweepAssembler(plan, Noting(), maps)
    return [found for block in blocks for found in assembler.add(block)]


def test_sweeps_know_how_fast_and_which_way_the_command_ran():
    plan = plan_of(scan(columns=30, bidirectional=True))
    stream = stream_of(plan, 3)
    found = sweeps(plan, stream.blocks(itertools.repeat(100)), maps=3)
    first, last = plan.command_range
    lit_s = 30 * float(plan.column_s)
    assert [sweep.direction for sweep in found] == [1, -1, 1]
    for sweep in found:
        assert np.isclose(sweep.tally.velocity_per_s, sweep.direction * abs(last - first) / lit_s)
