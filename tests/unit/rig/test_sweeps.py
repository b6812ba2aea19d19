"""The account of a sweep's frames, beside what test_acquisition.py and test_windows.py pin."""

import itertools

import numpy as np

from rig.counting import BIN_DARK
from rig.sweeps import SweepAssembler
from tests.unit.rig.streams import plan_of, scan, stand_still, stream_of


class Noting:
    """A counter that counts the frames of each bin, and nothing of what is in them."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.bins = []

    def add(self, bits, bins, column, x0):
        self.bins += bins.tolist()

    def finish(self):
        return list(self.bins)


def test_frames_beyond_what_a_column_may_use_are_received_but_not_lit():
    plan = plan_of(scan(exposures=40, columns=30))
    stream = stream_of(plan, 1)
    stand_still(stream, 700)
    assembler = SweepAssembler(plan, Noting(), maps=1)
    (sweep,) = [found for block in stream.blocks(itertools.repeat(100)) for found in assembler.add(block)]
    bins = np.array(sweep.volume)
    assert np.bincount(bins[bins >= 0]).max() == 255
    assert sweep.frames.lit == np.count_nonzero(bins >= 0)
    assert sweep.frames.dark == np.count_nonzero(bins == BIN_DARK)
    assert sweep.frames.received == sweep.frames.expected == len(bins)
    assert sweep.frames.lost == 0
