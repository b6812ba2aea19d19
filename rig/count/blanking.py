"""Finds the sweeps of frames without markers by the blanking pattern in their light, and writes the missing marks.

The pattern is a known order of laser flashes just before the lit part of each sweep (`rig.plan.scan_plan.Blanking`).

Finding the pattern (`PatternSearch`). Time t is in frames; the exposure of frame i begins at i. If the pattern begins
at t, the number of ones (detections) n_i in frame i is modelled as

    n_i = level + drift i + brightness g_i(t),     g_i = share of frame i's exposure with the gate open

The model is fitted by least squares (float64) for many t; the best t explains most. Detections of laser light, daylight
and dark counts all have the same (Poisson) noise, so their shares need not be known. `score` is brightness over its
standard deviation. To distinguish the pattern from other light that comes and goes, the residual in excess of photon
noise must not exceed what the pattern explains.

Finding the sweeps (`BlankingSync`). Scan markers are equally spaced in time. So a straight line, time over sweep, is
fitted to all patterns found so far (`MarkerLine`). If a pattern is missing, because frames were lost or nothing
reflected the light, its place is taken from that line. For counting, a sweep begins with the frame at which its pattern
has certainly passed, just before the gate opens for the lit part. All this depends only on earlier frames, not on the
size of blocks, and never on the host's time or on the clock that the device states.
"""

import logging
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from drivers.errors import DeviceFault
from drivers.frames import BlockFlag, BlockHeader, FrameBlock, Mark
from rig.geometry.windows import WORD_PX
from rig.plan.scan_plan import MARGIN_FRAMES, MAX_CLOCK_ERROR, Blanking, ScanPlan

Array = NDArray[np.float64]

LEAST_SCORE = 4.0
"""Least score of a pattern, in standard deviations. Noise reaches it in every other burst, but twice at the right
distance only in one burst of some ten thousand; in that case the pattern after the first map is missing."""
MOST_UNEXPLAINED = 1.0
"""Largest residual in excess of photon noise, relative to what the pattern explains. It is 7 in the wrong place."""
LEAST_SHARE = 0.7
"""Least share of the frames of a measurement that must have been received."""
EDGE_FRAMES = 2
"""Frames used before and after the pattern."""
STEPS = 8
"""Places tried per frame; the best place is then interpolated."""
PHASES = np.arange(4) / 4
"""Places tried within each frame by the rough search, in frames."""
_FIT_STEPS = 4
_NO_LIGHT = 1e-300
"""Ones per frame, fewer than any light gives. They make scores 0 instead of 0/0 in frames without any ones."""
_GRAIN = 64
"""The rough search rounds shares of a frame to multiples of 1/64, so that its sums are exact in any order."""


@dataclass(frozen=True, slots=True)
class PatternFit:
    """A fitted pattern. place: its first edge, in frames; sd: the place's standard deviation. score: see the module.
    level: ones of a frame without the pattern's light. brightness: extra ones of a lit frame."""

    place: float
    sd: float
    score: float
    brightness: float
    level: float


@dataclass(frozen=True, slots=True, eq=False)
class PatternShape:
    """A blanking pattern. flashes: (m, 2), open and close in frames from the first edge. exposure: in frame periods."""

    flashes: Array
    exposure: float

    @property
    def length(self) -> float:
        """Number of frames from the first edge to the last."""
        return float(self.flashes[-1, 1])

    def shares(self, places: Array, frames: Array) -> Array:
        """Share of each frame's exposure with the gate open, (places, frames), for a pattern at each place."""
        opened, closed = (places[:, None, None] + self.flashes[:, edge] for edge in (0, 1))
        start = frames[None, :, None]
        lit: Array = np.minimum(start + self.exposure, closed) - np.maximum(start, opened)
        return np.asarray(np.clip(lit, 0, None).sum(axis=2) / self.exposure)


class PatternSearch:
    """Looks for one pattern in the ones of consecutive frames."""

    def __init__(self, shape: PatternShape) -> None:
        self._shape = shape
        self.window = math.ceil(shape.length) + 1 + 2 * EDGE_FRAMES
        """Number of frames in a window of the rough search."""
        frames = np.arange(self.window, dtype=np.float64)
        shares = shape.shares(EDGE_FRAMES + PHASES, frames)
        self._time = 2 * frames - (self.window - 1)
        self._shares = np.round(shares * _GRAIN)

    def scores(self, ones: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Best score in each window of `ones` (n,), NaN if one of its frames is lost, and whether the pattern may lie
        in it.

        Both are (n - window + 1,). Raises ValueError for fewer frames than a window has.
        """
        n = self.window
        windows = sliding_window_view(ones, n)
        mean, drift = windows.sum(axis=1) / n, windows @ self._time
        time2 = float(self._time @ self._time)
        total = (windows * windows).sum(axis=1) - n * mean**2 - drift**2 / time2
        score = np.full(len(windows), np.nan)
        unexplained = np.full(len(windows), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            for g in self._shares:
                along = float(g @ self._time)
                left = float(g @ g) - float(g.sum()) ** 2 / n - along**2 / time2
                cross = windows @ g - mean * float(g.sum()) - drift * along / time2
                here, beyond = _judged(cross, left, total, mean, n)
                better = ~(here <= score)
                score, unexplained = np.where(better, here, score), np.where(better, beyond, unexplained)
            return score, (score >= LEAST_SCORE) & (unexplained <= MOST_UNEXPLAINED)

    def measure(self, ones: Array, first: int, place: float, radius: float) -> PatternFit | None:
        """The pattern within `radius` frames of `place`; None if it is not there.

        ones: of frames `first`, first + 1, ... , NaN if missing. place: of the first edge, in frames. None also if
        frames of `span` lie outside `ones`, or too many are missing.
        """
        begin, end = self.span(place, radius)
        if begin < first or end > first + len(ones):
            return None
        here = ones[begin - first : end - first]
        frames = np.arange(begin, end, dtype=np.float64)
        got = np.isfinite(here)
        if np.count_nonzero(got) < LEAST_SHARE * len(here):
            return None
        steps = math.ceil(radius * STEPS)
        places = place + np.arange(-steps, steps + 1) / STEPS
        return _best(self._shape.shares(places, frames[got]), places, frames[got], here[got])

    def span(self, place: float, radius: float) -> tuple[int, int]:
        """Number of the first frame that `measure` needs, and of the frame after the last."""
        return (
            math.floor(place - radius) - EDGE_FRAMES,
            math.ceil(place + radius + self._shape.length) + EDGE_FRAMES,
        )


def _judged(cross: Array, left: float, total: Array, mean: Array, n: int) -> tuple[Array, Array]:
    """(score, excess). excess: the residual beyond photon noise, divided by what the pattern explains. Sums without
    level and drift: left, of squared shares; cross, of shares times ones; total, of squared ones. mean: of the ones."""
    explained = cross**2 / left
    rest = np.maximum(total - explained, 0)
    scatter = np.maximum(rest / (n - 4), np.maximum(mean, _NO_LIGHT))
    return np.sign(cross) * np.sqrt(explained / scatter), np.maximum(rest - n * mean, 0) / explained


def _best(shares: Array, places: Array, frames: Array, ones: Array) -> PatternFit | None:
    basis, _ = np.linalg.qr(np.stack([np.ones(len(frames)), frames - frames.mean()], axis=1))
    ones_left = ones - basis @ (basis.T @ ones)
    left = shares - (shares @ basis) @ basis.T
    size = np.einsum("pf,pf->p", left, left)
    cross = left @ ones_left
    explained = np.where((cross > 0) & (size > 0), cross**2 / np.where(size > 0, size, 1), 0.0)
    at = int(np.argmax(explained))
    a, b = max(at - _FIT_STEPS, 0), min(at + _FIT_STEPS + 1, len(places))
    if explained[at] <= 0 or b - a < 2 * _FIT_STEPS + 1:  # best at the edge of the range: it lies elsewhere
        return None
    n, mean = len(ones), np.array(ones.mean())
    score, unexplained = _judged(cross[at], float(size[at]), np.array(ones_left @ ones_left), mean, n)
    if not (score >= LEAST_SCORE and unexplained <= MOST_UNEXPLAINED):
        return None
    curve, slope, _ = np.polyfit(places[a:b] - places[at], explained[a:b], 2)
    if curve >= 0:
        return None
    scatter = explained[at] / score**2
    brightness = float(cross[at] / size[at])
    level = float(mean) - brightness * float(shares[at].mean())
    shift = float(np.clip(-slope / (2 * curve), -1 / 2, 1 / 2))
    return PatternFit(float(places[at]) + shift, math.sqrt(scatter / -curve), float(score), brightness, level)


def detection_probability(score: float) -> float:
    """Chance that a pattern with this mean score is found."""
    return 0.5 * math.erfc((LEAST_SCORE - score) / math.sqrt(2))


LEAST_SD_FRAMES = 1e-3
"""Least standard deviation of a place: one bright pattern must not outweigh all others."""


@dataclass(slots=True)
class MarkerLine:
    """Scan markers found so far: index of each one's sweep, its place in frames, standard deviation of the place."""

    index: list[int] = field(default_factory=list)
    place: list[float] = field(default_factory=list)
    sd: list[float] = field(default_factory=list)

    def add(self, index: int, place: float, sd: float) -> None:
        """Add one more scan marker; its standard deviation counts as LEAST_SD_FRAMES at least."""
        self.index.append(index)
        self.place.append(place)
        self.sd.append(max(sd, LEAST_SD_FRAMES))

    def fit(self, index: int) -> tuple[float, float, float]:
        """Place of the scan marker of sweep `index` in frames, its standard deviation, and the number of frames per
        sweep, from a straight line through the markers found. Needs two markers or more."""
        weight = np.array(self.sd) ** -2.0
        x = np.array(self.index, np.float64) - index
        middle = float(weight @ x / weight.sum())
        spread = float(weight @ (x - middle) ** 2)
        place = np.array(self.place)
        level = float(weight @ place / weight.sum())
        slope = float((weight * (x - middle)) @ (place - level) / spread)
        return level - slope * middle, math.sqrt(1 / weight.sum() + middle**2 / spread), slope


_log = logging.getLogger(__name__)

SEARCH_S = 10.0
"""Seconds, plus three sweeps, after which the search for two patterns that are one sweep apart is given up."""
CLEAR_SCORE = 2 * LEAST_SCORE
"""Score of a pattern beyond doubt. If it is reached and sweeps are not found, the reason is not lack of light."""
ASIDE_PX = 64
"""Pixels counted on both sides of the window of a leg's first column: in the run-in the stripe lies beside it."""


@dataclass(frozen=True, slots=True)
class SweepPlace:
    """Place of a sweep among the frames.

    number: of the sweep, see `BlankingSync`. frame: the first one that counts. scan_frame: place of its scan marker, in
    frames. ratio: of the scanner's clock to nominal, in the SPAD's time. patterns: number of patterns that scan_frame
    and ratio are fitted to. found: the sweep's own pattern; None if the place is taken from the line through the
    others. residual_frames: distance of its pattern from the place predicted by earlier ones, or that distance's
    standard deviation if larger; NaN without a pattern.
    """

    number: int
    frame: int
    scan_frame: float
    ratio: float
    patterns: int
    found: PatternFit | None
    residual_frames: float

    @property
    def detection(self) -> float:
        """Chance that a pattern as bright as this one is found; 0 if it was not."""
        return 0.0 if self.found is None else detection_probability(self.found.score)


class BlankingSync:
    """Finds the sweeps of one start of the SPAD, block by block.

    The index of a sweep counts all sweeps of the waveform. The first ones are pilots, which have only the pattern. The
    number of a sweep counts from the first map on, so it is negative for pilots.
    end_sweep: number of the last sweep that is marked, which follows all wanted ones; None to mark all.
    """

    def __init__(self, plan: ScanPlan, end_sweep: int | None = None) -> None:
        assert plan.blanking is not None, "only such a plan is bound by its light"
        self._plan = plan
        self._end_sweep = end_sweep
        self._blanking: Blanking = plan.blanking
        self._rate = float(plan.frame_rate_hz)
        self._period = float(plan.frames_per_sweep)
        self._tolerance = self._blanking.tolerance_s * self._rate
        exposure = min(plan.exposure_s * self._rate, 1.0)
        self._shapes = [
            PatternShape(np.array(self._blanking.flashes_s(leg)) * self._rate, exposure) for leg in range(plan.pilots)
        ]
        self._searches = [PatternSearch(shape) for shape in self._shapes]
        self._delay = [plan.pattern_s(leg) * self._rate for leg in plan.legs]
        """Frames from the scan marker to the pattern, by leg."""
        self._words = [_words(plan, leg.columns_rise) for leg in plan.legs]
        self._kept = math.ceil(3 * self._shapes[0].length + 2 * self._tolerance) + 8 * math.ceil(MARGIN_FRAMES)
        self._ones: Array = np.empty((len(plan.legs), 0))
        self._ones_first = 0
        self._origin: int | None = None
        self._best: tuple[float, int, int] | None = None
        """Score, last frame and leg of the best of the latest windows that look like a pattern; None: there is none."""
        self._most: tuple[float, int] = (0.0, 0)
        """Highest score of all, and the first frame of its window, for the message if nothing is found."""
        self._pilots: list[tuple[int, PatternFit]] = []
        """Patterns that may be the first of the start, each with the index of its sweep."""
        self._line = MarkerLine()
        self._next: int | None = None
        """Index of the sweep whose pattern is expected next; None: nothing is known yet."""
        self._places: dict[int, SweepPlace] = {}
        self._now: SweepPlace | None = None

    def mark(self, block: FrameBlock, records: NDArray[np.void]) -> None:
        """Fill marks, line and sweep of the block's `records` (n,).

        Raises DeviceFault if the frames end, or `SEARCH_S` and the time of three sweeps have passed, before two
        patterns one sweep apart are found."""
        header, n = block.header, block.n_frames
        self._count(block)
        records["line"] = 0
        at, last = header.first_frame, header.first_frame + n - 1
        if self._next is None:
            self._look(header.first_frame, last)
        while (place := self._begin_next(last)) is not None:
            begin = max(place.frame, at)  # later if the sweep's first frames were lost
            self._write(records[at - header.first_frame : begin - header.first_frame], at)
            self._now, at = place, begin
        self._write(records[at - header.first_frame :], at)
        if self._next is None:
            self._give_up(header, last)

    def places(self, first: int, last: int) -> list[SweepPlace]:
        """Places of the sweeps of maps `first` to `last`. All but the last one are dropped afterwards."""
        return [*(self._places.pop(number) for number in range(first, last)), self._places[last]]

    def _count(self, block: FrameBlock) -> None:
        """Append each frame's ones in the words that see a leg's run-in, for each leg; lost frames are NaN."""
        first = block.header.first_frame
        if self._origin is None:
            self._origin = self._ones_first = first
        words = block.bits.view(np.uint64)
        ones = np.stack([np.bitwise_count(words[:, :, a:b]).sum(axis=(1, 2), dtype=np.float64) for a, b in self._words])
        gap = min(first - self._ones_first - self._ones.shape[1], self._kept)
        lost = np.full((len(ones), gap), np.nan)
        self._ones = np.concatenate([self._ones[:, max(0, self._ones.shape[1] - self._kept) :], lost, ones], axis=1)
        self._ones_first = first + block.n_frames - self._ones.shape[1]

    def _look(self, first: int, last: int) -> None:
        """Search the frames so far for patterns, and keep those found as possible pilots."""
        hits: list[tuple[int, float, int]] = []
        for leg, search in enumerate(self._searches):
            begin = max(first - search.window + 1, self._ones_first)
            ones = self._ones[leg, begin - self._ones_first :]
            if len(ones) < search.window:
                continue
            score, like = search.scores(ones)
            frames = begin + np.arange(len(score)) + search.window - 1
            highest = int(np.argmax(np.nan_to_num(score)))
            if score[highest] > self._most[0]:
                self._most = float(score[highest]), int(frames[highest]) - search.window + 1
            hits += [(int(frames[i]), float(score[i]), leg) for i in np.flatnonzero(like)]
        hold = math.ceil(self._shapes[0].length)
        for frame, score_here, leg in [*sorted(hits), (last + 1, 0.0, 0)]:
            if self._best is not None and frame > self._best[1] + hold:
                self._take_up(*self._best[1:])
                self._best = None
            if score_here and (self._best is None or score_here > self._best[0]):
                self._best = score_here, frame, leg

    def _take_up(self, frame: int, leg: int) -> None:
        search = self._searches[leg]
        begin = frame - search.window + 1 + MARGIN_FRAMES
        found = search.measure(self._ones[leg], self._ones_first, begin, math.ceil(self._shapes[leg].flashes[0, 1]) + 1)
        if found is not None:
            _log.info("blanking pattern at frame %.2f, %.1f sigma", found.place, found.score)
            self._pilots.append((leg, found))

    def _begin_next(self, last: int) -> SweepPlace | None:
        """The next sweep that begins up to frame `last`; None if there is none."""
        if self._next is not None:
            return self._expected(last)
        for pilot in list(self._pilots):
            index, found = pilot
            scan = found.place - self._delay[index]
            if self._known_at(index + 1, scan + self._period) > last:
                continue
            self._pilots.remove(pilot)
            second = self._measure(index + 1, scan + self._period)
            if second is None:
                continue
            self._line.add(index, scan, found.sd)
            self._next = index + 1
            return self._expected(last, first=True)
        return None

    def _expected(self, last: int, first: bool = False) -> SweepPlace | None:
        index = self._next
        assert index is not None, "asked for by the caller"
        if self._end_sweep is not None and index - self._plan.pilots > self._end_sweep:
            return None
        if first:
            expected, sd = self._line.place[-1] + self._period, math.nan
        else:
            expected, sd, _ = self._line.fit(index)
        frame = self._known_at(index, expected)
        if frame > last:
            return None
        found = self._measure(index, expected)
        number = index - self._plan.pilots
        residual = math.nan
        if found is not None:
            scan = found.place - self._delay[index % len(self._delay)]
            residual = max(abs(scan - expected), math.hypot(sd, found.sd))
            self._line.add(index, scan, found.sd)
        scan, _, period = self._line.fit(index)
        self._next = index + 1
        place = SweepPlace(number, frame, scan, self._period / period, len(self._line.index), found, residual)
        if number >= 0:
            self._places[number] = place
        if found is None:
            _log.warning("sweep %d: no blanking pattern where it was expected", number)
        else:
            _log.info(
                "sweep %d: blanking pattern at frame %.3f +- %.3f, %.1f sigma (%.4g over %.4g ones), detection "
                "probability %.6f",
                number, found.place, found.sd, found.score, found.brightness, found.level, place.detection,
            )  # fmt: skip
        return place

    def _known_at(self, index: int, scan: float) -> int:
        """The frame by which the pattern of a sweep has surely passed."""
        leg = index % len(self._delay)
        return self._searches[leg].span(scan + self._delay[leg], self._tolerance)[1] - 1

    def _measure(self, index: int, scan: float) -> PatternFit | None:
        leg = index % len(self._delay)
        place = scan + self._delay[leg]
        return self._searches[leg].measure(self._ones[leg], self._ones_first, place, self._tolerance)

    def _write(self, records: NDArray[np.void], first: int) -> None:
        """Write sweep and marks of consecutive frames from number `first` on, all of the present sweep."""
        now = self._now
        if now is None or now.number < 0:
            records["sweep"], records["marks"] = 0, Mark.GATE_EDGE
            return
        leg = self._plan.leg(now.number)
        since = first + np.arange(len(records)) - now.scan_frame
        opened, closed = leg.gate_open_s * self._rate, leg.gate_close_s * self._rate
        # The gate follows the sync source's clock, unknown here: hence a margin of half a frame plus its largest error.
        early, late = (0.5 + MAX_CLOCK_ERROR * at for at in (opened, closed))
        upcoming = self._period / now.ratio + self._delay[(now.number + 1) % len(self._delay)] - self._tolerance
        marks = np.full(len(records), int(Mark.GATE_EDGE), np.uint32)
        marks[(since > closed + late) & (since + 1 < upcoming)] = 0
        marks[(since >= opened + early) & (since + 1 <= closed - late)] = Mark.GATE_HIGH
        records["marks"] = marks | np.uint32(Mark.BACKWARD if leg.direction < 0 else 0)
        records["sweep"] = (now.number + 1) & 0xFFFF

    def _give_up(self, header: BlockHeader, last: int) -> None:
        assert self._origin is not None, "frames were counted"
        limit_s = SEARCH_S + 3 * self._period / self._rate
        if not header.flags & BlockFlag.LAST and last - self._origin < limit_s * self._rate:
            return
        score, frame = self._most
        step = "the laser's gate cable, and that the line is in the picture before the first column; raise scan.power"
        if score >= CLEAR_SCORE:
            step = "the scanner's scan marker at the sync source, and the clocks"
        raise DeviceFault(
            f"the blanking pattern of {self._shapes[0].length:.0f} frames was not found twice, {self._period:.0f} "
            f"frames apart: among {last - self._origin + 1} frames it stood out by {score:.1f} sigma at most, at frame "
            f"{frame} ({LEAST_SCORE:g} are needed, twice); frames cannot be bound to columns: check {step}"
        )


def _words(plan: ScanPlan, columns_rise: bool) -> tuple[int, int]:
    """First word of a row in which the run-in of a leg is seen, and the word after the last."""
    x0 = int(plan.x0[0 if columns_rise else -1])
    row = -(-plan.width // WORD_PX)
    return max(0, (x0 - ASIDE_PX) // WORD_PX), min(row, -(-(x0 + plan.window + ASIDE_PX) // WORD_PX))
