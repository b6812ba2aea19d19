"""Binary frames from flux: exact Bernoulli bits, packed as in SPB1, the same for any block size and number of threads.

Per mirror position: the sheet is traced, its flux summed, p turned into bit planes; then each frame is drawn from the
planes. Rows are split over threads; every step works row by row, so the split does not matter. Measured on one core,
512 x 512: 7 kframes/s drawn, 5 to 6 ms per new mirror position in fog."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim_backend.flux import FluxModel
from sim_backend.light_sheet import LightSheet, empty_sheet
from sim_backend.photon_kernels import PLANES, WORD_PX, bit_planes, draw_frames

Array = NDArray[np.float64]
PlanesOf = Callable[[Array], Array]


class PhotonSource:
    """Draws the frames of one run. One thread calls it; it uses `threads` of its own."""

    def __init__(self, model: FluxModel, planes_of: PlanesOf, exposure_s: float, seed: int, threads: int) -> None:
        """planes_of: mirror commands (n,) to light planes (n, 4)."""
        rows, width = model.steady_per_s.shape
        words = -(-width // WORD_PX)
        self._model = model
        self._planes_of = planes_of
        self._exposure_s = exposure_s
        self._seed = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
        self._rate = np.zeros((rows, width))
        self._dark = np.zeros((rows, words, PLANES), np.uint64)
        self._lit = np.zeros((rows, words, PLANES), np.uint64)
        self._held = np.nan
        self._lit_for: tuple[float, float] | None = None
        cuts = np.linspace(0, rows, threads + 1).round().astype(int).tolist()
        self._bands = [(a, b) for a, b in pairwise(cuts) if b > a]
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="photons")
        nothing = np.zeros((0, words, PLANES), np.uint64)
        self._each_band(
            lambda a, b: bit_planes(model.steady_per_s, self._rate, exposure_s, 0.0, nothing, a, b, self._dark)
        )

    def expose(
        self, first_frame: int, held: Array, power_w: Array, x0: NDArray[np.int32], bits: NDArray[np.uint8]
    ) -> None:
        """Fill `bits` (n, rows, row bytes) with windows of frames first_frame, first_frame + 1, ...

        held: (n,) mirror positions, NaN = the light goes nowhere. power_w: (n,) power averaged over each exposure.
        x0: (n,) first pixel of each window, a multiple of 64; a window has the very bits of the whole frame.
        """
        words = bits.view(np.uint64)
        first_word = x0 // np.int32(WORD_PX)
        dark = np.isnan(held) | (power_w == 0)
        held = np.where(dark, 0.0, held)
        power_w = np.where(dark, 0.0, power_w)
        change = (np.diff(held) != 0) | (np.diff(power_w) != 0) | (dark[1:] != dark[:-1])
        starts = [0, *(np.flatnonzero(change) + 1).tolist()]
        for a, b in zip(starts, [*starts[1:], len(held)], strict=True):
            light = None if dark[a] else (float(held[a]), float(power_w[a]))
            self._draw(first_frame + a, light, first_word[a:b], words[a:b])

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _draw(
        self,
        first_frame: int,
        light: tuple[float, float] | None,
        first_word: NDArray[np.int32],
        words: NDArray[np.uint64],
    ) -> None:
        model, rate, lit = self._model, self._rate, self._lit
        if light is None:
            self._each_band(lambda a, b: draw_frames(self._dark, self._seed, first_frame, a, b, first_word, words))
            return
        held, power_w = light
        sheet: LightSheet | None = None
        if held != self._held:
            sheet = empty_sheet(self._planes_of(np.array([held]))[0], len(rate))
        fresh = light != self._lit_for

        def band(a: int, b: int) -> None:
            if sheet is not None:
                model.setting.view.trace(sheet, a, b)
                rate[a:b] = 0.0
                model.add_sheet(sheet, a, b, rate)
            if fresh:
                bit_planes(model.steady_per_s, rate, self._exposure_s, power_w, self._dark, a, b, lit)
            draw_frames(lit, self._seed, first_frame, a, b, first_word, words)

        self._each_band(band)
        self._held, self._lit_for = held, light

    def _each_band(self, work: Callable[[int, int], None]) -> None:
        if len(self._bands) == 1:
            work(*self._bands[0])
            return
        for job in [self._pool.submit(work, a, b) for a, b in self._bands]:
            job.result()
