"""Packed frames turned by quarter turns are the pixels turned by numpy."""

import numpy as np
import pytest

from drivers.spads.orientation import QuarterTurn, turn_packed, turned_size


@pytest.mark.parametrize("turn_deg", [0, 90, 180, 270])
@pytest.mark.parametrize(("height", "width"), [(8, 64), (64, 8), (24, 128), (512, 512), (1024, 512)])
def test_turning_packed_bits_is_turning_pixels(height: int, width: int, turn_deg: QuarterTurn) -> None:
    pixels = np.random.default_rng(height).integers(0, 2, (11, height, width), dtype=np.uint8)
    out_width, out_height = turned_size(width, height, turn_deg)
    out = np.full((11, out_height, out_width // 8), 0xAA, np.uint8)
    turn_packed(np.packbits(pixels, axis=2), turn_deg, out)
    assert np.array_equal(np.unpackbits(out, axis=2), np.rot90(pixels, turn_deg // 90, axes=(1, 2)))
