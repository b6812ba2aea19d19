"""Checks of a map's counts and answers by its own light. A correctly taken map should pass them, whatever the scene.

The checks use up to 8192 points, or 512 if not all counts are kept. A point is a row and a column. Its partners are the
next row in the same column, and the same row in four other columns, to which the laser line has moved by 6 to 64 px
(less in a narrow sweep). A stripe appears at a point and all its partners, at places that the planes predict; noise
does not. A point and its partners each have a line of counts: the counts of that row in that column.

- Pixels of a row: neighbours receive similar light, so no other order of the pixels is smoother than the right one.
- Rows: a stripe is at the same place on the next row.
- Frames: those of one column show the stripe at one place, pixel by pixel, just as two rows do.
- Columns: the stripe moves from column to column as the planes predict; so does all other light of the sweep, mainly
  haze.
- Unusable pixels of the calibration, hot or dead, differ from those beside them. If the pixels where a turned picture
  would have them differ more, the frames are turned.
- Answers of estimators that learn the light. An answer is one of some 150 places, so a confidence of 0.9 needs evidence
  of seven nats. Hardly more than 7 x 7 lines of counts contribute to it. So each contributes some 1/7 nat on average,
  which is light half a standard deviation above the background. The light at the answers must exceed the light behind
  them by this much, on lines of counts that did not give the answers. In dense fog more lines contribute. There an
  excess of 0.4 of the light that the estimator says it has found is enough.

If the light does not suffice, the answers lose their confidence, and with them all answers at the same distances.

Standard deviations are estimated from the points themselves. With too few points, a check says nothing.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import CountVolume
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import WORD_PX, SweepGeometry, evenly_spread

Array = NDArray[np.float64]

POINTS: Final = 512
"""Most points if only their and their partners' lines of counts are kept."""
VOLUME_POINTS: Final = 8192
"""Most points if all counts of the sweep are kept."""
FEWEST_POINTS: Final = 128
"""Least number of points for a check."""
APART_PX: Final = (6.0, 16.0, 32.0, 64.0)
"""Motion of the stripe from a point's column to its partner columns: from more than its width to the width of haze."""
MOST_APART: Final = (1 / 16, 1 / 6, 1 / 6, 1 / 6)
"""Largest distance to each partner column, as a share of the sweep's columns: beyond it lies another surface."""
NEAREST: Final = 3
"""Lines of counts that are compared for narrow light: a point's own, the next row's and the nearest column's."""
FOLLOWED: Final = 256
"""Points at which light of all widths is first followed through the columns. Their number doubles until it suffices."""
LIMIT: Final = 4.0
"""Standard deviations beyond which a check raises a doubt: one false alarm in 30 000 checks."""
FEWEST_ROWS: Final = 24
"""Least number of rows for the check of pixel order: a sum over n rows reaches sqrt(n) standard deviations at most."""
LEAST_FOLLOWING: Final = 0.25
"""Least light in common with the nearest partner column, relative to that with the next row. Scenes have 0.8 and more,
clutter such as fences half of that. Columns that do not follow one another have none."""
MOST_AMISS: Final = -0.45
"""Limit of a sum over the four partner columns: light in common at the best wrong place, minus that at the best of the
places that the planes predict, relative to the light in common with the next row. Maps have -0.65 in dense fog to -3 in
clear air; shuffled or reversed columns have -0.4 to 2."""
LEAST_LIGHT: Final = 12.0
"""Least light in common with the next row, in standard deviations, to judge how light moves."""
MARGIN: Final = 3.5
"""Standard deviations by which a map's sum must exceed MOST_AMISS for a doubt."""
SATURATED: Final = 0.99
"""Share of ones among all pixels and frames above which a map is saturated."""
LEAST_WIDTH_PX: Final = 32
"""Least sensor width with room for the stripe's motion to its nearest partner, and for pixels beside it."""
DIMMEST: Final = 0.1
"""Least rate with which a pixel's noise is computed, relative to the mean rate of all pixels."""
SURE: Final = 0.9
"""Least confidence of answers that must have light, the sure ones."""
GROUPS: Final = 16
"""Most groups of sure answers, by distance. Wrong answers mostly form a false surface, so they are in one group."""
LEAST_CONTRAST: Final = 0.5
"""Least mean light at sure answers above that behind them, in standard deviations of one answer; see the module."""
LEAST_SHARE: Final = 0.4
"""Share of dim answers' signal that must be there. Right ones have 0.43 to 0.92 in dense fog at K = 3 exposures."""
INCLINED_PX: Final = 2
"""Pixels by which the line may move further than the planes say, to the nearest partner column."""
LINE_PX, BEHIND_PX = (-1, 1), (3, 9)
"""First and last pixel of an answer's light and of the light behind it, counted from the answer towards far depths."""

FEWEST_DEFECTS, MOST_DEFECTS = 8, 2048
"""Numbers of unusable pixels that show how the picture is turned: least, and most that are looked at."""
BESIDE: Final = (-3, -2, -1, 1, 2, 3)
"""Pixels of the same row with which an unusable one is compared."""
MOST_OUT: Final = 10.0
"""Standard deviations to which a pixel's difference from those beside it counts, so that no few pixels decide."""
TURNED_LIMIT, LEAST_OUT = 6.0, 2.0
"""Least mean difference by which unusable pixels stand out more where a turned picture has them: in its standard
deviations, and in those of a count. On right maps it is negative."""

NOT_FOLLOWING: Final = (
    "columns do not follow one another: from column to column the line does not move as the calibration's planes do; "
    "check the order of the frames (all exposures of a column, then the next column), columns and exposures of the "
    "plan, the direction of the sweep, and that the planes are of this scan"
)
ORDERS: Final = ("the bits of each byte", *(f"the bytes of {bits}-bit words" for bits in (16, 32, 64)))
"""Wrong orders of pixels that are tried: what seems reversed in each."""


class Points(NamedTuple):
    """Rows and columns of points (index 0) and of their partners: the next row (1), and columns APART_PX away (2, ...).

    row, column: int32 (2 + partner columns, points). shift: int32 (1 + partner columns, points), pixels from the stripe
    at a point to the stripe of the same surface at each partner. moved_px: median distance to each partner column.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    shift: NDArray[np.int32]
    moved_px: Array


class Unlit(NamedTuple):
    """Sure answers at equal distances, of which not even LEAST_SHARE of the claimed light was found.

    near_px, far_px: smallest and largest distance from the row's `x_lo`, counted towards far depths: negative if near
    depths lie on the right. share: ratio of the light found to the light claimed. row, column, x: the answer in the
    middle of the group.
    """

    near_px: int
    far_px: int
    share: float
    row: int
    column: int
    x: int


def check_points(geometry: SweepGeometry, points: int = POINTS) -> Points:
    """Up to `points` points spread evenly over the map; none if no row and column has all its partners."""
    reference = geometry.reference_px()
    steps = np.abs(np.diff(reference, axis=1))
    step_px = float(np.median(steps)) if steps.size else 0.0
    columns = geometry.columns
    most = [int(share * columns) for share in MOST_APART]
    wanted = [round(px / step_px) if step_px > 0 else 1 for px in APART_PX]
    apart = [max(min(each), 1) for each in zip(wanted, most, strict=True)]
    searched = geometry.x_lo <= geometry.x_hi
    inner = columns - apart[-1]
    both = searched[:-1, :inner] & searched[1:, :inner]
    y, c = np.nonzero(both & np.logical_and.reduce([searched[:-1, n : n + inner] for n in apart]))
    pick = evenly_spread(len(y), points)
    y, c = y[pick], c[pick]
    row, column = np.stack([y, y + 1, *[y] * len(apart)]), np.stack([c, c, *(c + n for n in apart)])
    shift = np.rint(reference[row[1:], column[1:]] - reference[y, c])
    moved_px = np.abs(np.median(shift[1:], axis=1)) if len(y) else np.zeros(len(apart))
    return Points(row.astype(np.int32), column.astype(np.int32), shift.astype(np.int32), moved_px)


class MapChecks:
    """The checks of maps of one geometry.

    calibrated: whether its planes are known. knows: whether the estimator learns the light, so that its confidence is a
    probability under what it has learned.
    """

    def __init__(self, geometry: SweepGeometry, *, calibrated: bool, knows: bool) -> None:
        self._geometry = geometry
        self._calibrated = calibrated
        # On a sensor hardly wider than the line, light cannot be seen to move.
        self._follows = calibrated and geometry.width >= LEAST_WIDTH_PX
        # With several laser lines, another one stands where this one moves to.
        self._alone = geometry.others is None
        self._knows = knows
        self._points: dict[int, Points] = {}
        self._orders = _orders()

    def check(
        self, sweep: Any, intensity: NDArray[np.uint32], stripe: StripeTable
    ) -> tuple[tuple[str, ...], StripeTable]:
        """Doubts about a map, and its stripe table.

        There is at most one doubt, a sentence that says what to look at; none if nothing speaks against the map. In the
        table, confidence is limited where answers lack light: to the share of the claimed light that was found.

        sweep: a `CountVolume`, or a sweep with `checked`: the lines of counts of POINTS points and of their partners,
        (lines, points, window). intensity: (rows, width), counts summed over the columns. stripe: the estimator's
        answers, unfiltered.
        """
        most = VOLUME_POINTS if isinstance(sweep, CountVolume) else POINTS
        if most not in self._points:
            self._points[most] = check_points(self._geometry, most)
        counts = _Counts(sweep, self._geometry, self._points[most])
        seen = counts.exposures_seen()
        if not seen.any():
            return (), stripe  # all of its frames were lost, which the gaps show
        fired = float(intensity.sum()) / (float(seen.sum()) * self._geometry.rows)
        if fired == 0.0:
            dark = "no light: not one pixel fired in any frame; check lens cap, laser, gate and the sensor's power"
            return (dark,), stripe
        if fired > SATURATED:
            saturated = (
                f"saturated: {fired:.1%} of the pixels fired in every frame; shorten the exposure, darken the room, or "
                "check that ones are photons"
            )
            return (saturated,), stripe
        if (turned := _turned(intensity, seen, self._geometry.defects)) is not None:
            return (turned,), stripe
        usual = np.asarray(intensity / np.maximum(seen, 1), np.float32)
        usual[self._geometry.defects] = np.nan
        wrong = self._of_counts(counts, usual, DIMMEST * fired, stripe)
        if wrong is None and self._knows and self._follows and self._strays(counts, stripe):
            wrong = NOT_FOLLOWING
        if wrong is None and self._knows and (unlit := self._unlit(counts, stripe)):
            wrong, stripe = self._without_light(unlit), self._less_sure(stripe, unlit)
        return (() if wrong is None else (wrong,)), stripe

    def _of_counts(
        self, counts: "_Counts", usual: NDArray[np.float32], least: float, stripe: StripeTable
    ) -> str | None:
        lit = counts.lit()
        if len(lit) < FEWEST_POINTS:
            return None
        few = lit[:: max(len(lit) // POINTS, 1)]
        out = self._compared(counts, few, usual, least)
        clear = out[:, 1] / LEAST_FOLLOWING - out[:, 0], -out[:, 2]
        if len(few) < len(lit) and any(each.any() and _deviations(each) < LIMIT for each in clear):
            out, few = self._compared(counts, lit, usual, least), lit  # few points left it open
        points = counts.points
        _, of_row = np.unique(points.row[0, few], return_inverse=True)
        if of_row.max() + 1 >= FEWEST_ROWS:
            # Pixels that are always on are in every line of counts of their row, so only rows are independent.
            likeliest = int(out[:, 3:].sum(axis=0).argmax())
            if _deviations(np.bincount(of_row, out[:, 3 + likeliest]).astype(np.float64)) > LIMIT:
                expected = "bytes as they lie along the row" if likeliest else "most significant bit first"
                return (
                    f"{ORDERS[likeliest]} seem reversed: in that order neighbouring pixels agree better than as they "
                    f"come; frames are expected as numpy.packbits makes them along the width, {expected}"
                )
        rows, columns = out[:, 0], out[:, 1]
        if _deviations(rows) < LIMIT:
            if self._knows and self._sure(counts, stripe)[0] and not self._unlit(counts, stripe):
                return None  # too faint for the points alone, but the answers have found it
            return (
                "no line: no light that one row shares with the next stands out of the noise; check laser, gate, power "
                "and depth range, and that frames are height x width with the line across the rows"
            )
        if _deviations(out[:, 2]) > LIMIT:
            return (
                "frames of one column show light in different places; check the order of the frames (all exposures of "
                "a column, then the next column), and columns and exposures of the plan"
            )
        if self._follows and (
            _deviations(LEAST_FOLLOWING * rows - columns) > LIMIT
            or (self._alone and self._amiss(counts, lit, usual, least))
        ):
            return NOT_FOLLOWING
        return None

    def _compared(
        self, counts: "_Counts", chosen: NDArray[np.int64], usual: NDArray[np.float32], least: float
    ) -> Array:
        """Results of `compare_lines` at chosen points."""
        from rig.count.map_check_kernels import compare_lines

        geometry, points = self._geometry, counts.points
        out = np.zeros((len(chosen), 3 + len(self._orders)))
        compare_lines(
            counts.lines(chosen, NEAREST), counts.exposures[:, chosen], points.row[:, chosen], points.column[:, chosen],
            points.shift[:, chosen], geometry.x0, geometry.x_lo, geometry.x_hi, usual, least, self._orders, out,
        )  # fmt: skip
        return out

    def _amiss(self, counts: "_Counts", chosen: NDArray[np.int64], usual: NDArray[np.float32], least: float) -> bool:
        """Whether light of all widths moves from column to column otherwise than planes predict; False if undecided."""
        from rig.count.map_check_kernels import BIN_PX, SPAN, follow_lines

        geometry, points = self._geometry, counts.points
        partners = len(APART_PX)
        rows, shared, noise = np.zeros((partners, 5)), np.zeros((partners, 2 * SPAN + 1)), np.zeros(partners)
        moved_px = points.moved_px
        if moved_px[-1] < 0.75 * APART_PX[-1]:
            return False  # too narrow a sweep to distinguish haze from light that stands still
        expected = np.abs(np.arange(-SPAN, SPAN + 1)) <= np.maximum(0.5 * moved_px / BIN_PX, 1.0)[:, None]
        used = np.isfinite(usual)
        weight = np.where(used, 1.0 / np.sqrt(np.maximum(usual, np.float32(least))), np.float32(0.0))
        usual = np.where(used, usual, np.float32(0.0))
        for part in _ever_more(chosen, FOLLOWED):
            follow_lines(
                counts.lines(part, len(points.row)), counts.exposures[:, part], points.row[:, part],
                points.column[:, part], points.shift[:, part], geometry.x0, geometry.x_lo, geometry.x_hi,
                usual, weight, rows, shared, noise,
            )  # fmt: skip
            with_row, deviation = rows.max(axis=1), np.sqrt(noise)
            if (with_row < LEAST_LIGHT * deviation).any():
                continue
            wrong, right = (np.where(where, shared, -np.inf).max(axis=1) for where in (~expected, expected))
            amiss = float(((wrong - right) / with_row).sum())
            if amiss <= MOST_AMISS:
                return False
            if amiss - MARGIN * float(np.sqrt(2.0 * np.sum((deviation / with_row) ** 2))) > MOST_AMISS:
                return True
        return False

    def _sure(self, counts: "_Counts", stripe: StripeTable) -> tuple[int, NDArray[np.int64]]:
        """Number of groups of sure answers, and the numbers of the points that have such answers."""
        y, c = counts.points.row[0], counts.points.column[0]
        lit = counts.lit()
        sure = lit[stripe.confidence[y[lit], c[lit]] >= SURE]
        return min(len(sure) // FEWEST_POINTS, GROUPS), sure

    def _contrast(
        self,
        counts: "_Counts",
        sure: NDArray[np.int64],
        x: NDArray[np.int64],
        partners: tuple[int, ...],
        further: int = 0,
    ) -> tuple[Array, NDArray[np.int64]]:
        """Mean light on these partners of points where their answers x are, less that behind it, and number of partners
        asked, both (sure,). further: pixels to either side of a line that count for it too."""
        from rig.count.map_check_kernels import add_contrast

        geometry, points = self._geometry, counts.points
        contrast, asked = np.zeros(len(sure)), np.zeros(len(sure), np.int64)
        line_px = LINE_PX[0] - further, LINE_PX[1] + further
        behind_px = BEHIND_PX[0] + further, BEHIND_PX[1] + further
        for partner in partners:
            add_contrast(
                *counts.of_lines(partner, sure), points.row[partner, sure], points.column[partner, sure],
                counts.exposures[partner, sure], x + points.shift[partner - 1, sure],
                1 if geometry.near_is_left else -1, line_px, behind_px,
                geometry.x0, geometry.x_lo, geometry.x_hi, geometry.width, contrast, asked,
            )  # fmt: skip
        return contrast, asked

    def _strays(self, counts: "_Counts", stripe: StripeTable) -> bool:
        """Whether sure answers have their light on the next row, but not in the nearest column to which the line has
        moved by the planes. A line that stands still is the usual light of its pixels, so only its answers show it."""
        groups, sure = self._sure(counts, stripe)
        if not groups:
            return False
        x = np.rint(stripe.x_px[counts.points.row[0, sure], counts.points.column[0, sure]]).astype(np.int64)
        row, of_row = self._contrast(counts, sure, x, (1,))
        column, of_column = self._contrast(counts, sure, x, (2,), INCLINED_PX)
        both = (of_row > 0) & (of_column > 0)
        px = LINE_PX[1] - LINE_PX[0] + 1
        lacking = LEAST_FOLLOWING * px * row - (px + 2 * INCLINED_PX) * column
        return _deviations(lacking[both]) > LIMIT

    def _unlit(self, counts: "_Counts", stripe: StripeTable) -> list[Unlit]:
        """The groups of sure answers that do not have the light that their confidence claims, near ones first."""
        geometry, points = self._geometry, counts.points
        groups, sure = self._sure(counts, stripe)
        if not groups:
            return []
        y, c = points.row[0, sure], points.column[0, sure]
        x = np.rint(stripe.x_px[y, c]).astype(np.int64)
        away = 1 if geometry.near_is_left else -1
        contrast, asked = self._contrast(counts, sure, x, (1, 2))
        distance = away * (x - geometry.x_lo[y, c])
        order, unlit = np.argsort(distance, kind="stable"), []
        for group in np.array_split(order[asked[order] > 0], groups):
            if len(group) >= FEWEST_POINTS // 2:
                found = _deviations(contrast[group]) / np.sqrt(len(group))
                light = (LINE_PX[1] - LINE_PX[0] + 1) * contrast[group].sum()
                claimed = float((asked[group] * stripe.signal[y[group], c[group]]).sum())
                if found + 1.0 / np.sqrt(len(group)) < LEAST_CONTRAST and light < LEAST_SHARE * claimed:
                    middle, ends = group[len(group) // 2], distance[group[[0, -1]]]
                    share = min(max(light / claimed, 0.0), LEAST_SHARE)
                    unlit.append(
                        Unlit(int(ends[0]), int(ends[1]), share, int(y[middle]), int(c[middle]), int(x[middle]))
                    )
        return unlit

    def _without_light(self, unlit: list[Unlit]) -> str:
        """The doubt about answers without light, at the first of these groups."""
        _, _, _, row, column, x = unlit[0]
        geometry = self._geometry
        px = min(max(x, 0), geometry.width - 1)
        depth_m = float(1.0 / (geometry.plane[column] @ (geometry.u[row, px], geometry.v[row, px], 1.0)))
        where = f" at about {depth_m:.1f} m" if self._calibrated else ""
        return (
            f"answers without light: those of confidence {SURE:g} and more{where} "
            "hardly have more light than what is behind them; haze or halo may be learned wrong: compare "
            "with the other of likelihood and joint, other exposures, or a shorter depth range"
        )

    def _less_sure(self, stripe: StripeTable, unlit: list[Unlit]) -> StripeTable:
        """The table with the confidence of all answers at the distances of these groups lowered to their shares."""
        geometry, confidence = self._geometry, stripe.confidence.copy()
        distance = (1 if geometry.near_is_left else -1) * (np.rint(stripe.x_px) - geometry.x_lo)
        for group in unlit:
            there = (distance >= group.near_px) & (distance <= group.far_px)
            confidence[there] = np.minimum(confidence[there], np.float32(group.share))
        return replace(stripe, confidence=confidence)


class _Counts:
    """Counts of a sweep at points, wherever they are stored."""

    def __init__(self, sweep: Any, geometry: SweepGeometry, points: Points) -> None:
        self._sweep = sweep
        self._geometry = geometry
        self.points = points
        self.of_volume = isinstance(sweep, CountVolume)
        self.exposures: NDArray[np.int32] = sweep.n_frames[points.column]

    def exposures_seen(self) -> Array:
        """Number of frames in whose window each pixel of a row was, (width,)."""
        geometry, n_frames = self._geometry, self._sweep.n_frames
        steps = np.zeros(geometry.width + geometry.window + 1)
        np.add.at(steps, np.minimum(geometry.x0, geometry.width), n_frames)
        np.add.at(steps, np.minimum(geometry.x0 + geometry.window, len(steps) - 1), -n_frames)
        return np.asarray(np.cumsum(steps)[: geometry.width])

    def lit(self) -> NDArray[np.int64]:
        """Numbers of the points whose first NEAREST lines of counts, their own among them, all have frames."""
        return np.flatnonzero((self.exposures[:NEAREST] > 0).all(axis=0))

    def lines(self, chosen: NDArray[np.int64], most: int) -> NDArray[np.int32]:
        """Lines of counts of chosen points and their first partners, (most, chosen, window)."""
        if self.of_volume:
            found = self._sweep.counts[self.points.column[:most, chosen], self.points.row[:most, chosen]]
        else:
            found = self._sweep.checked[:most, chosen]
        return np.ascontiguousarray(found, np.int32)

    def of_lines(
        self, partner: int, chosen: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[np.int32]]:
        """The stored counts (a, b, window), and the indices a, b (chosen,) of line `partner` of chosen points."""
        if self.of_volume:
            return self._sweep.counts, self.points.column[partner, chosen], self.points.row[partner, chosen]
        return self._sweep.checked, np.full(len(chosen), partner, np.int32), chosen.astype(np.int32)


def _ever_more(chosen: NDArray[np.int64], first: int) -> Iterator[NDArray[np.int64]]:
    """Parts of the chosen points, each evenly spread and as large as all before it; the first has `first` or more."""
    step = 1 << max((len(chosen) // first).bit_length() - 1, 0)
    yield chosen[::step]
    while step > 1:
        step //= 2
        yield chosen[step :: 2 * step]


def _deviations(values: Array) -> float:
    """Standard deviations by which a sum of independent values is above 0, estimated from the values."""
    squares = float((values**2).sum())
    return float(values.sum()) / np.sqrt(squares) if squares > 0 else 0.0


def _orders() -> NDArray[np.int64]:
    """Pixels of a word in the orders of ORDERS, (orders, WORD_PX)."""
    x = np.arange(WORD_PX)
    byte, bit = x // 8, x % 8
    bits = 8 * byte + 7 - bit
    swapped = [8 * (byte // n * n + n - 1 - byte % n) + bit for n in (2, 4, 8)]
    return np.stack([bits, *swapped])


def _turned(intensity: NDArray[np.uint32], seen: Array, defects: NDArray[np.bool_]) -> str | None:
    """The doubt that the picture is turned against the calibration, whose unusable pixels stand out elsewhere; None if
    they are few. seen: (width,), frames in whose window the pixels of a row were."""
    inside = np.zeros(defects.shape, np.bool_)
    inside[:, -min(BESIDE) : defects.shape[1] - max(BESIDE)] = True
    y, x = np.nonzero(defects & inside & (seen > 0))
    pick = evenly_spread(len(y), MOST_DEFECTS)
    y, x = y[pick, None], x[pick, None] + np.array((0, *BESIDE))
    usable = ~defects[y, x[:, 1:]] & (seen[x[:, 1:]] > 0)
    y, x, usable = (each[usable.any(axis=1)] for each in (y, x, usable))
    if len(y) < FEWEST_DEFECTS:
        return None
    pictures = {
        "": intensity,
        "upside down": intensity[::-1],
        "mirrored": intensity[:, ::-1],
        "turned by 180 degrees": intensity[::-1, ::-1],
    }
    if intensity.shape[1] % 8 == 0:
        bits = intensity.reshape(len(intensity), -1, 8)[:, :, ::-1]
        pictures["packed with the bits of each byte reversed"] = bits.reshape(intensity.shape)
    out = {}
    for name, picture in pictures.items():
        around = (picture[y, x[:, 1:]] * usable).sum(axis=1) / usable.sum(axis=1)
        out[name] = np.minimum(np.abs(picture[y[:, 0], x[:, 0]] - around) / np.sqrt(around + 1.0), MOST_OUT)
    more = {name: each - out[""] for name, each in out.items() if name}
    likeliest = max(more, key=lambda name: float(more[name].mean()))
    mean, deviation = float(more[likeliest].mean()), float(more[likeliest].std(ddof=1)) / np.sqrt(len(y))
    if mean < max(LEAST_OUT, TURNED_LIMIT * deviation):
        return None
    return (
        f"the picture seems {likeliest}: pixels that the calibration calls unusable (hot or dead) stand out there, not "
        "where it has them; check how frames are turned and packed, and that the calibration is of this sensor"
    )
