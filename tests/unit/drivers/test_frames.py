"""Frame blocks number and time their frames without overflow."""

from dataclasses import replace

import numpy as np

from drivers.frames import FRAME_RECORD, FrameBlock, packed_row_bytes
from tests.unit.drivers.spb1.spb1_bytes import GOLDEN_HEADER


def test_rows_are_padded_to_whole_words() -> None:
    assert [packed_row_bytes(width) for width in (1, 64, 65, 320, 500, 512)] == [8, 8, 16, 40, 64, 64]


def test_frame_numbers_and_times_stay_exact_beyond_32_bits() -> None:
    header = replace(GOLDEN_HEADER, first_frame=2**40, t0_ticks=2**50)
    late = FrameBlock(header, np.zeros(3, FRAME_RECORD), np.zeros((3, 2, 8), np.uint8))
    late.records["ticks"] = [0, 1000, 2**32 - 1]
    assert late.frame_numbers.tolist() == [2**40, 2**40 + 1, 2**40 + 2]
    assert late.start_ticks.tolist() == [2**50, 2**50 + 1000, 2**50 + 2**32 - 1]
    assert late.frame_numbers.dtype == late.start_ticks.dtype == np.int64
