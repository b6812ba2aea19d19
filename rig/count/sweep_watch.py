"""Checks that the frames of a sweep are of one map, and each of its column. Their counts no longer show this.

- *Frames of one scene.* The line moves by a fraction of its width from frame to frame and from column to column, so a
  frame has more ones in common with the next one than with the next but one, and more with the next column than with
  the next but one. It is the other way round if frames of two maps alternate. A few hundred frames are compared, spread
  over the map.
- *Markers.* The plan says how long after the scan marker the gate opens and closes. If the gate's edges in the frames'
  records lie elsewhere, the markers are late, for example because the wrong edge of their pulses is taken.
- *Light.* It begins and ends with the gate. If the pixels lag behind the records of their frames, it begins late and
  ends late. A scene that begins behind the first column changes only its beginning, and puts no light where the gate is
  low.
- *The first frames* of the first column must have light in common with those after them; otherwise the mirror was
  elsewhere when they were taken.

With too little light, or too few frames, a check says nothing. Standard deviations are estimated from the frames.
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.frames import Mark
from rig.simd import Bools, Float64

COMPARED_BYTES: Final = 2 << 20
"""Most bytes of the frames that are compared with one another."""
STRETCHES: Final = 24, 512
"""Least and most numbers of stretches that are compared, of five frames each."""
LIMIT: Final = 5.0
"""Standard deviations by which frames must have more in common with the next but one than with the next."""
LEAST_MORE: Final = 0.05
"""Least share by which they must. Dead time, and read-outs that take turns, make a percent or two."""
TRIPLES: Final = 4
"""Triples of frames by which hot pixels are found."""
GOLDEN: Final = 0.6180339887498949
REFERENCE: Final = 16
"""Frames on each side of an edge from which the light there is known."""
FEWEST: Final = 8
"""Least number of such frames."""
MOST_LATE: Final = 32
"""Most frames that light or markers are late by and found; a column and EDGE frames if that is less."""
EDGE: Final = 4
STEP: Final = 0.25
"""Frames between the delays of the light that are tried."""
LATE_COLUMNS, LATE_FRAMES = 0.1, 0.25
"""Delay of gate or light against the plan that is no doubt, in columns and frames: it hardly changes the depth, and
lasers follow their gate by some microseconds."""
LEAST_LIGHT_LATE: Final = 0.6
"""Least delay of the light that is a doubt, in frames. Pixels are late by whole frames."""
LEAST_BETTER, LEAST_EACH = 8.0, 2.0
"""Least logarithm of the likelihood by which a delay must explain both edges better than none, and each edge."""
FEWEST_BEYOND: Final = 1.0
"""Frames beyond an edge of the gate from which on light is where none can be."""
LEAST_BRIGHT: Final = 0.3
"""Least such light, relative to that just before."""
MOST_OUT: Final = 4.0
"""Standard deviations to which a frame counts, so that no single frame decides."""

MOST_FIRST: Final = 48
"""Most frames of the first columns that are compared with one another."""
LEAST_SLOW: Final = 0.6
"""Least light that frames have in common with the next but one, relative to the next one: otherwise the line moves so
fast that it may jump at the edge of a surface."""
LEAST_COMMON: Final = 8.0
"""Least number of ones that frames on both sides of a seam should have in common: they might have none by chance."""
NEAR: Final = 5
"""Frames on each side of a seam that are compared."""
LAGS: Final = 4
"""Most frames by which those that are compared lie apart."""
MOST_TORN: Final = 0.3
"""Most light that frames on both sides of a seam have in common, relative to those on either side. At the edge of a
surface it is 0.45 and more."""
MIXED: Final = (
    "frames of two maps seem mixed: {} have more light in common with the next but one than with the next; check where "
    "the frames come from, and that no light flickers at half their rate"
)
MARKERS_LATE: Final = (
    "the gate opens and closes {:.1f} frames or more {} than the plan says after the markers ({:.2f} of a column); "
    "check that markers are taken by the right edge of their pulses (marker_rising of the calibration)"
)
TORN: Final = (
    "the first {} frames of the first column have hardly any light in common with those after them: frames seem to be "
    "late, or the laser is; check with which frame a map begins"
)
LIGHT_LATE: Final = (
    "the light begins and ends {:.1f} frames {} than the gate ({:.2f} of a column): pixels and records of the frames "
    "do not belong together, or the laser follows its gate late, which 'rig calibrate sync' measures"
)


class SweepWatch:
    """Watches the frames of one sweep after another.

    exposures: frames per column. frames: number of lit frames of a map. gate: for each leg, when the gate opens and
    closes, in frames since the mirror enters the first column; empty if frames have no marks. delay: of the light after
    the gate, in frames, as far as it is known. exposed: exposure as a share of a frame's period. whole: whether the
    frames are of the whole sensor; only then do their ones show when light begins and ends. every: of each `every`
    sweeps the first one is watched.
    """

    def __init__(
        self, exposures: int, frames: int, gate: Sequence[tuple[float, float]] = (), *, delay: float = 0.0,
        exposed: float = 1.0, whole: bool = True, every: int = 1,
    ) -> None:  # fmt: skip
        self._exposures, self._frames, self._gate = exposures, frames, gate
        self._delay, self._exposed, self._whole = delay, exposed, whole
        self._reach = min(exposures + EDGE, MOST_LATE)
        self._wanted: NDArray[np.int64] | None = None
        self._every, self._sweeps = every, 0
        self._reset()

    def _reset(self) -> None:
        self._first: int | None = None
        self._seen: list[tuple[Float64, NDArray[np.int64], Float64]] = []
        if self._wanted is not None:
            self._have[:] = False

    def add(
        self, bits: NDArray[np.uint8], numbers: NDArray[np.int64], lit: Bools, x0: NDArray[np.int32],
        since: Float64 | None = None, marks: NDArray[Any] | None = None, leg: int = 0,
    ) -> None:  # fmt: skip
        """Look at n frames of the sweep, which come in order.

        bits: packed, (n, rows, row bytes). The other arrays are (n,). numbers: of the frames. lit: whether they are
        counted for a column. x0: first used pixels. since: middles of exposures in frames since the mirror entered the
        first column. marks: of the records; None if there are none. leg: the sweep's, an index of `gate`.
        """
        if self._sweeps % self._every:
            return
        if self._first is None and lit.any():
            self._first = int(numbers[int(lit.argmax())])
        if self._first is not None:
            self._keep(bits, numbers - self._first, lit, x0)
        if since is not None and marks is not None and self._gate:
            far = self._reach + REFERENCE
            for edge in self._gate[leg]:
                near = np.flatnonzero(np.abs(since - edge) <= far)
                if near.size:
                    part = slice(int(near[0]), int(near[-1]) + 1)
                    ones = _ones(bits[part]) if self._whole else np.zeros(part.stop - part.start)
                    self._seen.append((since[part], marks[part].astype(np.int64), ones))

    def finish(self, leg: int = 0) -> tuple[str, ...]:
        """Doubts about the sweep: at most one sentence. The next sweep begins. leg: the sweep's, an index of `gate`."""
        skipped = self._sweeps % self._every
        self._sweeps += 1
        if skipped:
            return ()
        try:
            return self._mixed() or self._late(leg) or self._torn()
        finally:
            self._reset()

    def _keep(self, bits: NDArray[np.uint8], number: NDArray[np.int64], lit: Bools, x0: NDArray[np.int32]) -> None:
        """Copy those of the frames that are compared. number: counted from the map's first frame."""
        if self._wanted is None:
            self._choose(bits.shape[1:])
        assert self._wanted is not None, "chosen above"
        here = slice(*np.searchsorted(self._wanted, (number[0], number[-1] + 1)).tolist())
        at = np.searchsorted(number, self._wanted[here])
        found = (number[at] == self._wanted[here]) & lit[at]
        slots = np.arange(here.start, here.stop)[found]
        self._kept[slots], self._x0[slots], self._have[slots] = bits[at[found]], x0[at[found]], True

    def _choose(self, shape: tuple[int, ...]) -> None:
        """Choose the frames to be compared, in stretches: a frame, the next two, and those one and two columns on."""
        most = min(max(COMPARED_BYTES // (5 * int(np.prod(shape))), STRETCHES[0]), STRETCHES[1])
        last = max(self._frames - 2 * self._exposures, 0)
        # Spread evenly and without a period, so that as many begin with odd as with even frames and columns.
        starts = np.unique((np.arange(min(most, last)) * GOLDEN % 1.0 * last).astype(np.int64))
        of = starts[:, None] + np.array((0, 1, 2, self._exposures, 2 * self._exposures))
        first = np.arange(min(3 * self._exposures, MOST_FIRST, last))
        self._wanted, stretches = np.unique(np.concatenate([first, of.ravel()]), return_inverse=True)
        self._stretches = stretches[len(first) :].reshape(of.shape)
        self._begin = len(first)
        self._kept = np.zeros((len(self._wanted), *shape), np.uint8)
        self._x0, self._have = np.zeros(len(self._wanted), np.int32), np.zeros(len(self._wanted), np.bool_)

    def _mixed(self) -> tuple[str, ...]:
        if self._wanted is None:
            return ()
        usable = ~_often_on(self._kept, np.flatnonzero(self._have))
        for what, later in (("frames", (1, 2)), ("columns", (3, 4))):
            of = self._stretches[:, (0, *later)]
            of = of[self._have[of].all(axis=1) & (np.ptp(self._x0[of], axis=1) == 0)]
            if len(of) < FEWEST:
                continue
            first, second, third = (self._kept[each] for each in of.T)
            second &= usable
            near = _ones(first & second) + _ones(second & third)
            first &= usable
            far = 2.0 * _ones(first & third)
            more = (far - near) / np.sqrt(near + far + 1.0)
            if more.sum() > LIMIT * float(np.sqrt((more**2).sum())) and far.sum() > (1 + LEAST_MORE) * near.sum():
                return (MIXED.format(what),)
        return ()

    def _torn(self) -> tuple[str, ...]:
        """The doubt that the first column begins with frames of another place, between which and the others light jumps
        as no surface makes it."""
        n, have = self._begin if self._wanted is not None else 0, np.flatnonzero(self._have)
        if n <= self._exposures or self._exposures < 2 or not self._have[:n].all() or np.ptp(self._x0[:n]):
            return ()
        begin, usable = self._kept[:n], ~_often_on(self._kept, have[n:])
        common = [_ones(begin[:-lag] & begin[lag:] & usable) for lag in range(1, LAGS + 1)]
        # Of what stands still, and of chance. Something may shine on a part of the sweep.
        far = self._kept[have[[len(have) // 3, len(have) // 2, 2 * len(have) // 3]]] & usable
        usual = min(float(_ones(begin & each).mean()) for each in far)
        found = []
        for seam in range(2 + max(math.ceil(self._delay), 0), self._exposures):
            all_after = [float(of_lag[seam:].mean()) - usual for of_lag in common]
            if all_after[1] < LEAST_SLOW * all_after[0]:
                continue
            # A line that leaves one surface, or comes to another, is faint around the seam: compare with the nearest.
            before: list[float] = []
            after: list[float] = []
            across: list[float] = []
            for lag, (of_lag, level) in enumerate(zip(common, all_after, strict=True), 1):
                if level >= LEAST_SLOW * all_after[0]:
                    near = max(seam - NEAR, 0)
                    before += (of_lag[near : max(seam - lag, near)] - usual).tolist()
                    across += (of_lag[max(seam - lag, 0) : seam] - usual).tolist()
                    after += (of_lag[seam : seam + NEAR - lag] - usual).tolist()
            if not before or not after:
                continue
            least, fewest = min(float(np.mean(before)), float(np.mean(after))), min(len(before), len(after))
            lack, n = len(across) * least - sum(across), len(across)
            deviation = math.sqrt(max(n * (least + usual) * (1 + n / fewest), 1.0))
            if n * least >= LEAST_COMMON and sum(across) < MOST_TORN * n * least:
                found.append((lack / deviation, seam))
        deviations, seam = max(found, default=(0.0, 0))
        return (TORN.format(seam),) if deviations > LIMIT else ()

    def _late(self, leg: int) -> tuple[str, ...]:
        if not self._seen:
            return ()
        since, marks, ones = (np.concatenate(each) for each in zip(*self._seen, strict=True))
        known = np.flatnonzero(np.isfinite(since))
        since, which = np.unique(since[known], return_index=True)  # edges may be so near that they share frames
        marks, ones = marks[known][which], ones[known][which]
        gate = self._gate[leg]
        spans = [_edge(since, marks, edge, self._exposed, rises=i == 0) - edge for i, edge in enumerate(gate)]
        least = max(LATE_COLUMNS * self._exposures, LATE_FRAMES)
        low, high = float(max(spans[0][0], spans[1][0])), float(min(spans[0][1], spans[1][1]))
        by = low if low > 0 else high
        if low <= high and low * high > 0 and abs(by) > least:
            return (MARKERS_LATE.format(abs(by), _when(by), abs(by) / self._exposures),)
        delays = np.arange(-self._reach, self._reach + STEP, STEP)
        by = self._light_late([since - edge for edge in gate], ones, delays, np.abs(delays) <= least)
        if abs(by) < max(LEAST_LIGHT_LATE, least):
            return ()
        return (LIGHT_LATE.format(abs(by), _when(by), abs(by) / self._exposures),)

    def _light_late(self, at: Sequence[Float64], ones: Float64, delays: Float64, small: Bools) -> float:
        """Delay of the light after the gate, one of `delays`, in frames; 0 if it is small or cannot be told.

        at: for both edges of the gate, middles of exposures since they are planned. small: delays that are no doubt.
        """
        found = [self._likelihoods(*each, ones, delays) for each in zip(at, (True, False), strict=True)]
        both = found[0] + found[1]
        best = int(both.argmax())
        better = [float(each[best] - each[small].max()) for each in found]
        if float(both[best] - both[small].max()) >= LEAST_BETTER and min(better) >= LEAST_EACH:
            return float(delays[best])
        # Only a delay puts light where the gate is low: before it opens, or after it has closed.
        beyond, reach = max(float(np.abs(delays[small]).max()), FEWEST_BEYOND), self._reach
        before, after = (edge - self._delay for edge in at)
        for by, near, other in ((-1, -before, after), (1, after, before)):
            dark = ones[(near > reach) & (near <= reach + REFERENCE)]
            if len(dark) < FEWEST or not self._whole:
                continue
            order = np.argsort(near)
            there = order[(near[order] > beyond + self._exposed / 2) & (near[order] <= reach)]
            usual, spread = float(dark.mean()), max(float(dark.mean()), float(dark.var(ddof=1)), 1.0)
            numbers = np.arange(1, len(there) + 1)
            excess = np.cumsum(ones[there] - usual)
            light = excess / np.sqrt(spread * numbers)
            inside = ones[(near < -self._exposed / 2) & (near > -REFERENCE)]
            if not len(light) or not len(inside) or light.max() < LIMIT:
                continue
            last = int(light.argmax())
            if excess[last] < LEAST_BRIGHT * numbers[last] * float(inside.mean() - usual) or inside.mean() <= usual:
                continue  # a lamp that becomes dimmer
            late = by * float(near[there[last]])
            # What is late must be missing at the other edge; a laser that glows on is not.
            missing = ones[(by * other > self._exposed / 2) & (by * other < abs(late) - 0.5)]
            if float((missing - usual).sum()) < LIMIT * float(np.sqrt(spread * max(len(missing), 1))):
                return late
        return 0.0

    def _likelihoods(self, at: Float64, rises: bool, ones: Float64, delays: Float64) -> Float64:
        """Logarithms of the likelihoods of delays (n,) of the light after the gate's edge; 0 if they cannot be told.
        at, ones: (frames,), middles of exposures in frames since the planned edge, and numbers of ones."""
        near, around = np.abs(at) <= self._reach + 1, np.abs(at) <= self._reach + REFERENCE
        sides = ones[around & ~near & (at < 0)], ones[around & ~near & (at > 0)]
        dark, lit = (float(side.mean()) if len(side) else 0.0 for side in (sides if rises else sides[::-1]))
        if min(map(len, sides)) < FEWEST or lit <= dark or not self._whole:
            return np.zeros(len(delays))
        spread = max(1.0, *(float(side.var(ddof=1)) / max(float(side.mean()), 1.0) for side in sides))
        behind = (at[near] - self._delay - delays[:, None]) / self._exposed
        mean = np.maximum(dark + (lit - dark) * np.clip((behind if rises else -behind) + 0.5, 0.0, 1.0), 1.0)
        out = np.minimum((ones[near] - mean) ** 2 / (spread * mean), MOST_OUT**2)
        return np.asarray(-0.5 * (out + np.log(mean)).sum(axis=1))


def _when(by: float) -> str:
    return "later" if by > 0 else "earlier"


def _often_on(frames: NDArray[np.uint8], have: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Pixels, packed as in the frames (n, rows, row bytes), that fire in two of three frames far apart in time: hot
    ones, whose noise would hide the line. have: numbers of the frames that are there."""
    out = np.zeros(frames.shape[1:], np.uint8)
    third = len(have) // 3
    for i in range(0, third, max(third // TRIPLES, 1)):
        one, two, three = (frames[each] for each in have[[i, i + third, i + 2 * third]])
        out |= (one & two) | (two & three) | (one & three)
    return out


def _ones(frames: NDArray[np.uint8]) -> Float64:
    """Number of ones of each packed frame (n, rows, row bytes), whose row bytes are a multiple of 8."""
    words = np.ascontiguousarray(frames).view(np.uint64)
    return np.asarray(np.bitwise_count(words).sum(axis=(1, 2), dtype=np.int64), np.float64)


def _edge(since: Float64, marks: NDArray[np.int64], planned: float, exposed: float, *, rises: bool) -> Float64:
    """Earliest and latest time (2,) of the gate's edge nearest to where it is planned, in frames as `since`, by the
    records. An edge is in the exposure of the frame that has its mark, or else between two exposures."""
    high = (marks & Mark.GATE_HIGH) > 0
    turns = np.flatnonzero(high[1:] & ~high[:-1] if rises else ~high[1:] & high[:-1]) + 1
    if not turns.size:
        return np.array((-np.inf, np.inf))
    first = int(turns[np.abs(since[turns] - planned).argmin()])
    inside, half = first - rises, exposed / 2
    if marks[inside] & Mark.GATE_EDGE:
        return np.array((since[inside] - half, since[inside] + half))
    return np.array((since[first - 1] + half, since[first] - half))
