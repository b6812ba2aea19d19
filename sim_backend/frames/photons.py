"""Binary frames from flux: exact Bernoulli bits, packed as in SPB1, the same for any block size and number of threads.

Consecutive frames with the same light (one mirror position, power and time) form a span. For a span the sheet is
traced, and its flux is summed and turned into levels (thresholds for random numbers, see `photon_kernels`). Each frame
is drawn from the levels. Each thread has some of the rows, and goes by itself through all spans of a block (or of one
moment, if things move). All steps work row by row, so the result does not depend on the threads. The sensor's effects
on bits act on whole frames, and windows are cut out afterwards. Flux is float32 (rows, width), frames uint8 (frames,
rows, row bytes). Measured for 512 x 512 pixels, the street in fog: 12 us per frame and 0.45 ms per mirror position on
one core, 6.4 us and 0.26 ms on two (`python -m tests.benchmarks.simulator`).
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, FrameTimes, Words
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photon_kernels import Levels, Places, draw_frames, new_levels, set_levels
from sim_backend.light.line import ONE_LINE, LineFan, SheetsOf
from sim_backend.light.sheet import LightSheet
from sim_backend.random_numbers import WORD_PX

_SLACK = 1e-6
"""Slack, as a share of a time step, by which times may miss a multiple of it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Span:
    """Frames first..last-1 of a block. moment_s: time, for moving things. power_w: 0 in the dark. sheets:
    of all lines, still to be traced; None in the dark, or if those of the last lit span still apply. fresh: whether the
    levels change.
    """

    first: int
    last: int
    moment_s: float
    power_w: float
    sheets: list[LightSheet] | None
    fresh: bool


class PhotonSource:
    """Draws the frames of a configured SPAD. Call its methods from one thread only. That thread works too: it is one of
    the `threads` that draw at the same time."""

    def __init__(
        self,
        model: FluxModel,
        sheets_of: SheetsOf,
        times: FrameTimes,
        seed: int,
        threads: int,
        fan: LineFan = ONE_LINE,
        command_range: tuple[float, float] = (-np.inf, np.inf),
    ) -> None:
        """sheets_of: makes sheets from mirror commands. fan: the laser lines. A line whose command is outside
        command_range is dark.
        """
        rows, width = model.steady_per_s.shape
        words = -(-width // WORD_PX)
        self._model = model
        self._sheets_of = sheets_of
        self._fan, self._command_range = fan, command_range
        self._times = times
        self._seed = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
        self._steady = (times.exposure_s * model.steady_per_s).astype(np.float32)
        self._rate: Any = np.zeros((rows, width), np.float32)
        self._of_line: Any = None if fan == ONE_LINE else np.zeros_like(self._rate)
        self._dark, self._levels = new_levels(rows, words), new_levels(rows, words)
        self._lit = np.ones((rows, words), np.bool_)
        self._traced: tuple[float, ...] | None = None
        """Positions of the mirror and the moment of the sheets that were traced last."""
        self._levels_power_w = 0.0
        self._whole = np.zeros((0, rows, words), np.uint64)
        self._before = [np.zeros((rows, words), np.uint64) for _ in model.bits]
        self._next_frame = -1
        cuts = np.linspace(0, rows, threads + 1).round().astype(int).tolist()
        self._bands = [(a, b) for a, b in pairwise(cuts) if b > a]
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="photons")
        self._each_band(lambda a, b: self._set_levels(0.0, new_levels(0, words), self._dark, a, b))

    def expose(
        self, first_frame: int, held: Array, power_w: Array, x0: Places, bits: NDArray[np.uint8], time_s: Array
    ) -> None:
        """Fill `bits` (n, rows, row bytes) with windows of frames first_frame, first_frame + 1, ...

        held: mirror positions (n,), or (n, 2) for the exposure of the first and the last row; NaN if no light meets the
        scene. power_w: (n,) of the laser, mean over each exposure. x0: (n,) first pixel of each window, multiple of 64.
        time_s: (n,) start of each exposure, for scenes that move.
        """
        words = bits.view(np.uint64)
        first_word = x0 // np.int32(WORD_PX)
        spans = self._spans(held, power_w, time_s)
        if not self._model.bits:
            self._draw(spans, first_frame, first_word, words)
            return
        if len(held) > len(self._whole):
            self._whole = np.empty((len(held), *self._lit.shape), np.uint64)
        whole = self._whole[: len(held)]
        self._draw(spans, first_frame, np.zeros(len(held), np.int32), whole)
        self._apply_bit_effects(first_frame, whole)
        _cut_windows(whole, first_word, words)

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _spans(self, held: Array, power_w: Array, time_s: Array) -> list[_Span]:
        """Split the frames into spans; remembers position, time and power of the last lit one."""
        held = held if held.ndim == 2 else held[:, None]
        dark = np.isnan(held).any(axis=1) | (power_w == 0)
        power_w = np.where(dark, 0.0, power_w)
        hold_s = self._model.hold_s
        moved_s = np.zeros(len(held)) if hold_s == 0 else np.floor(time_s / hold_s + _SLACK) * hold_s
        light = np.where(dark, 0.0, np.stack([*held.T, moved_s, power_w])).T
        change = np.flatnonzero((np.diff(light, axis=0) != 0).any(axis=1) | (dark[1:] != dark[:-1])) + 1
        starts = np.array([0, *change.tolist()])
        lit = starts[~dark[starts]]
        rows, limits = len(self._rate), self._command_range
        found = self._fan.sheets(self._sheets_of, held[lit], rows, moved_s[lit].tolist(), limits)
        sheets = dict(zip(lit.tolist(), found, strict=True))
        spans = []
        for a, b in pairwise([*starts.tolist(), len(held)]):
            if a not in sheets:
                spans.append(_Span(a, b, float(moved_s[a]), 0.0, None, False))
                continue
            *where, power = light[a].tolist()
            moves = tuple(where) != self._traced
            spans.append(
                _Span(a, b, where[-1], power, sheets[a] if moves else None, moves or power != self._levels_power_w)
            )
            self._traced, self._levels_power_w = tuple(where), power
        return spans

    def _draw(self, spans: list[_Span], first_frame: int, first_word: Places, words: Words) -> None:
        model, rate, exposure_s = self._model, self._rate, self._times.exposure_s

        def band(spans: list[_Span], a: int, b: int) -> None:
            for span in spans:
                if span.sheets is not None:
                    self._set_rate(span.sheets, a, b)
                if span.fresh:
                    self._set_levels(span.power_w, self._dark, self._levels, a, b)
                light, part = (model.steady_per_s, rate, exposure_s, span.power_w), slice(span.first, span.last)
                levels = self._levels if span.power_w > 0 else self._dark
                draw_frames(levels, light, self._seed, first_frame + span.first, (a, b), first_word[part], words[part])

        try:
            # Spans of the same moment are drawn together, so that the view of moving things is made once for all bands.
            for _, together in groupby(spans, lambda span: span.moment_s):
                group = list(together)
                bowed = [sheet for span in group for sheet in span.sheets or () if sheet.bowed is not None]
                if bowed:  # all rows first: drops and flakes read the planes of rows that other bands trace
                    self._each_band(partial(self._trace, bowed))
                self._each_band(partial(band, group))
        except BaseException:
            self._traced = None
            raise

    def _trace(self, sheets: list[LightSheet], a: int, b: int) -> None:
        for sheet in sheets:
            self._model.setting.view.trace(sheet, a, b)

    def _set_rate(self, sheets: list[LightSheet], a: int, b: int) -> None:
        """Set rows a..b-1 of `_rate`: detections per second and watt of all sheets. Bowed sheets are traced before."""
        model, rate, of_line = self._model, self._rate, self._of_line
        rate[a:b] = 0
        for sheet in sheets:
            if sheet.bowed is None:
                self._trace([sheet], a, b)
            if of_line is None:
                model.add_sheet(sheet, a, b, rate)
                continue
            of_line[a:b] = 0  # an effect may change the light that earlier ones added, but never another line's
            model.add_sheet(sheet, a, b, of_line)
            of_line[a:b] *= np.float32(self._fan.share)
            rate[a:b] += of_line[a:b]

    def _set_levels(self, power_w: float, dark: Levels, levels: Levels, a: int, b: int) -> None:
        exposure_w_s = self._times.exposure_s * power_w
        set_levels(self._steady, self._rate, exposure_w_s, (a, b), dark, self._lit, levels)

    def _apply_bit_effects(self, first_frame: int, whole: Words) -> None:
        """Apply the sensor's effects to whole frames, in as many parts as there are threads. Each part also gets the
        frame before it, as it was before the effect."""
        if first_frame != self._next_frame:
            for kept in self._before:
                kept[:] = 0
        self._next_frame = first_frame + len(whole)
        parts = len(self._bands)
        cuts = sorted({round(i * len(whole) / parts) for i in range(parts + 1)})
        for effect, kept in zip(self._model.bits.values(), self._before, strict=True):
            found = [kept.copy(), *(whole[cut - 1].copy() for cut in cuts[1:-1])]
            kept[:] = whole[-1]
            self._each(
                partial(effect.apply, self._seed, first_frame + a, whole[a:b], before, self._times)
                for (a, b), before in zip(pairwise(cuts), found, strict=True)
            )

    def _each_band(self, work: Callable[[int, int], None]) -> None:
        self._each(partial(work, a, b) for a, b in self._bands)

    def _each(self, jobs: Iterable[Callable[[], None]]) -> None:
        """Do all jobs at once; errors are raised when all have ended."""
        first, *others = jobs
        running = [self._pool.submit(job) for job in others]
        try:
            first()
        finally:
            wait(running)
        for job in running:
            job.result()


@numba.njit(cache=True, nogil=True)
def _cut_windows(whole: Words, first_word: Places, words: Words) -> None:
    """Copy each frame's window out of whole frames into `words` (frames, rows, words of a window)."""
    for f in range(len(words)):
        first = first_word[f]
        for y in range(words.shape[1]):
            for k in range(words.shape[2]):
                words[f, y, k] = whole[f, y, first + k]
