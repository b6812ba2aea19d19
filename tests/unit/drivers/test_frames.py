"""Frame blocks number and time their frames without overflow."""

from fractions import Fraction

import numpy as np
import pytest

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock, packed_row_bytes


def block(n_frames: int, *, first_frame: int, t0_ticks: int) -> FrameBlock:
    header = BlockHeader(
        BlockFlag(0), 1, 0, first_frame, t0_ticks, 0, Fraction(10**8), 1000, 900, 0, 1, 16, 2, 16, 2
    )  # fmt: skip
    return FrameBlock(header, np.zeros(n_frames, FRAME_RECORD), np.zeros((n_frames, 2, 8), np.uint8))


def test_a_record_takes_sixteen_bytes() -> None:
    assert FRAME_RECORD.itemsize == 16


@pytest.mark.parametrize(("width", "row_bytes"), [(1, 8), (64, 8), (65, 16), (320, 40), (500, 64), (512, 64)])
def test_rows_are_padded_to_whole_words(width: int, row_bytes: int) -> None:
    assert packed_row_bytes(width) == row_bytes


def test_frame_numbers_and_times_stay_exact_beyond_32_bits() -> None:
    late = block(3, first_frame=2**40, t0_ticks=2**50)
    late.records["ticks"] = [0, 1000, 2**32 - 1]
    assert late.frame_numbers.tolist() == [2**40, 2**40 + 1, 2**40 + 2]
    assert late.start_ticks.tolist() == [2**50, 2**50 + 1000, 2**50 + 2**32 - 1]
    assert late.frame_numbers.dtype == late.start_ticks.dtype == np.int64


def test_a_block_without_frames_is_a_block() -> None:
    empty = block(0, first_frame=7, t0_ticks=9)
    assert (empty.n_frames, len(empty.frame_numbers), len(empty.start_ticks)) == (0, 0, 0)
