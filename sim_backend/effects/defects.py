"""Hot and dead pixels: pixels whose electronics read 1, or 0, in every frame, whatever their diode does.

A real colour SPAD has 4 % of defective pixels (crop of 254 x 496, public data of wision-lab/photoncube), in no
clusters: pairs of neighbours are as frequent as chance has it (0.98 times along the row, 0.92 along the column, each
+-0.07). So a pixel is dead with probability `dead_share`, hot with `hot_share`, never both, and independent of all
others; which ones they are follows from `pixel_seed`. Diodes that fire too often are the tail of the dark counts.

Called for by `world.sensor.dead_share` or `hot_share` above 0. Cost per frame of 512 x 512: 3 us.
"""

import numpy as np

from sim_backend.effects.rare_bits import packed
from sim_backend.effects.setting import FrameTimes, Setting, Words

_STREAM = 2
"""Stream of the sensor's seed, apart from the one that says which pixels are hot in the dark."""


class Defects:
    """Acts on the bits as the pixels' memories hold them, after all that diodes do to one another."""

    reads_before = False

    def __init__(self, setting: Setting) -> None:
        sensor = setting.sensor
        # One number a pixel for both, so that a larger share has the pixels of the smaller one, and more.
        lot = np.random.default_rng([sensor.pixel_seed, _STREAM]).random(setting.view.u.shape)
        self._alive = packed(lot >= sensor.dead_share)
        self._hot = packed(lot >= 1 - sensor.hot_share)

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        np.bitwise_and(words, self._alive, out=words)
        np.bitwise_or(words, self._hot, out=words)
