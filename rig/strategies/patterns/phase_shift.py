"""Sinusoidal phase shift: the column from the phase of a sine pattern that is shown with 3 to 8 shifts.

With M shifts theta_k = 2 pi k / M a pixel sees L_k = o + a cos(phi - theta_k), so phi is the argument of
sum L_k exp(i theta_k) and a its modulus times 2 / M. To first order

    var(phi) = (2 / (M a))^2 sum sin^2(phi - theta_k) var(L_k)

For N photons at full contrast this is 2 / N, whatever the number of shifts. The standard deviation of the column is
then P / (2 pi) sqrt(2 / N) for a period of P columns. There are three ways to know the period:

- a Gray code of half periods (G. Sansoni, M. Carocci, R. Rodella, Applied Optics 38, 1999). Its cells begin a quarter
  of a period away from where the phase jumps, so the next cell does no harm at a border;
- a single period that covers all columns which a pixel can see within the depth range;
- micro phase shifting (M. Gupta, S. K. Nayar, CVPR 2012). Several short periods of nearly the same length are shown,
  one with three shifts and the others once. Haze is wide, so it has no contrast at short periods, and is the same for
  all of them.

OpenCV's `SinusoidalPattern` has only three shifts of 8-bit images, and counts periods along paths over the picture.
Such a path ends at a depth edge. Tests compare with it for three shifts.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from rig.errors import UsageError
from rig.simd import Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.patterns.binary_codes import bits_for, gray_code, gross_errors
from rig.strategies.patterns.levels import (
    Camera,
    Levels,
    answer_of,
    columns_at_infinity,
    measured,
    unwrapped,
    window_columns,
    with_noise,
)
from rig.strategies.patterns.posterior import Window
from rig.strategies.strategy import Answer, ColumnGeometry, Light

PERIOD: Final = 8.0
"""Columns of a period. A short period is precise. This one still keeps most of its contrast if a column spreads over
its neighbours: 73 % with a Gaussian of a standard deviation of one column."""
FEWEST_SHIFTS, MOST_SHIFTS = 3, 8
LEAST_AMPLITUDE: Final = 1e-9
"""Least amplitude, in photons per frame or grey levels. Below it there is no sine, and the phase means nothing."""
MICRO_PERIODS: Final = 7
"""Number of different periods of micro phase shifting. With two more shifts of the first that makes nine pictures."""
MICRO_BAND: Final = (8.0, 12.0)
"""Shortest and longest period in columns: a narrow band, so that haze and blur change all periods alike."""
MICRO_TRIALS: Final = 100
"""Number of random sets of periods, of which the best one is taken."""
_GOLDEN: Final = 0.6180339887
"""Fractional part of the golden ratio; no two of its multiples are alike."""
MICRO_STEP: Final = 0.25
"""Columns between the places around its peak at which the correlation is computed."""


def whole_period(least: float, columns: int) -> float:
    """Shortest period of at least `least` columns of which a whole number fits the field; at most the whole field.

    With another period some shifts would light more columns than others. A source whose columns share its power would
    then show these shifts less brightly.
    """
    return columns / max(int(columns / least), 1)


def shifted_sines(period: float, shifts: int, columns: int) -> Float32:
    """Patterns (shifts, columns) from 0 to 1, (1 + cos(2 pi (column / period - k / shifts))) / 2 for shift k."""
    phase = np.arange(columns) / period - np.arange(shifts)[:, None] / shifts
    return (0.5 + 0.5 * np.cos(2 * np.pi * phase)).astype(np.float32)


def phase_of(levels: Levels) -> tuple[Float64, Float64, Float64]:
    """Phase in turns, 0 to 1, its standard deviation in turns, and the amplitude: (rows, width) each.

    Without any contrast the phase is 0, and its standard deviation is that of a random phase, sqrt(1/12).
    """
    shifts = len(levels.light)
    theta = 2 * np.pi * np.arange(shifts)[:, None, None] / shifts
    phasor = (levels.light * np.exp(1j * theta)).sum(axis=0)
    phi, amplitude = np.angle(phasor), np.abs(phasor) * 2.0 / shifts
    some = amplitude > LEAST_AMPLITUDE
    variance = (np.sin(phi - theta) ** 2 * levels.variance).sum(axis=0)
    sd = np.sqrt(variance) / (np.pi * shifts * np.where(some, amplitude, 1.0))
    turns = np.mod(np.where(some, phi, 0.0) / (2 * np.pi), 1.0)
    return turns, np.where(some, np.minimum(sd, 12.0**-0.5), 12.0**-0.5), amplitude


def fitted_sines(levels: Levels) -> Float64:
    """The sine through the levels of each pixel at all shifts, (shifts, rows, width)."""
    shifts = len(levels.light)
    turns, _, amplitude = phase_of(levels)
    at = 2 * np.pi * (turns - np.arange(shifts)[:, None, None] / shifts)
    return np.asarray(levels.light.mean(axis=0) + amplitude * np.cos(at))


@dataclass(frozen=True, slots=True)
class PhaseShift:
    """Phase shift with a SPAD or a conventional camera. Raises UsageError for fewer than 3 or more than 8 shifts.

    unwrap: how the period is known. 'gray': by a Gray code of half periods; 'none': there is only one.
    """

    name: str
    sentence: str
    camera: Camera
    unwrap: Literal["gray", "none"]
    shifts: int = 4
    source: str = (
        "V. Srinivasan, H. C. Liu, M. Halioua, Automated phase-measuring profilometry, Applied Optics 23 (1984); with "
        "Gray code: G. Sansoni, M. Carocci, R. Rodella, Applied Optics 38 (1999)"
    )
    light: Light = "pattern"
    clear_px: float = 0.5

    def __post_init__(self) -> None:
        """Check the number of shifts."""
        if not FEWEST_SHIFTS <= self.shifts <= MOST_SHIFTS:
            raise UsageError(f"phase shift with {self.shifts} shifts; give {FEWEST_SHIFTS} to {MOST_SHIFTS}")

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once. Nothing is random here."""
        if self.unwrap == "none":
            return self._one_period(apparatus, geometry, budget)
        shifts, period = self.shifts, whole_period(PERIOD, geometry.columns)
        half = 0.5 * period
        bits = bits_for(window_columns(geometry) / half)
        sines = shifted_sines(period, shifts, geometry.columns)
        cells = ((np.arange(geometry.columns) + 0.5 * half) // half).astype(np.int64)
        coarse = gray_code(bits, int(cells[-1]) + 1)[:, cells]
        patterns = np.concatenate([sines, coarse.astype(np.float32)])
        levels = measured(apparatus, self.camera, patterns, [1.0] * shifts + [shifts / bits] * bits, budget)
        middle = levels.light[:shifts].mean(axis=0)
        contrast = levels.light[shifts:] - middle
        size = np.abs(contrast)
        # At the border of a cell one bit lies between lit and dark, as it should.
        border = size == size.min(axis=0)
        usual = np.where(border, 0.0, size).sum(axis=0) / max(bits - 1, 1)
        expected = middle + np.where(border, contrast, np.sign(contrast) * usual)
        expected = np.concatenate([fitted_sines(levels.take(slice(shifts))), expected])
        levels, excess = with_noise(levels, self.camera, expected, 5 if bits > 2 else 3)
        turns, sd, _ = phase_of(levels.take(slice(shifts)))
        of_middle = levels.variance[:shifts].sum(axis=0) / shifts**2
        spread = np.sqrt((levels.variance[shifts:] + of_middle) * excess)
        cell, right = gross_errors(contrast, spread, gray=True)
        centre = cell * half
        number = period * (turns + np.rint(centre / period - turns))
        column = unwrapped(geometry, number, half * 2**bits)
        right = np.where(levels.clipped, 0.0, right)
        return answer_of(geometry, column, period * sd * np.sqrt(excess), right)

    def _one_period(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget) -> Answer:
        period = whole_period(window_columns(geometry), geometry.columns)
        patterns = shifted_sines(period, self.shifts, geometry.columns)
        # Three shifts leave nothing that would tell a camera's noise: twice each.
        again = 2 if self.camera == "camera" and self.shifts == FEWEST_SHIFTS else 1
        levels = measured(apparatus, self.camera, np.tile(patterns, (again, 1)), [1.0] * self.shifts * again, budget)
        if len(levels.light) > FEWEST_SHIFTS:
            expected = np.tile(fitted_sines(_mean_of(levels, again)), (again, 1, 1))
            levels, excess = with_noise(levels, self.camera, expected, 3)
        else:
            excess = np.ones(levels.light.shape[1:])
        turns, sd, _ = phase_of(_mean_of(levels, again))
        right = np.where(levels.clipped, 0.0, 1.0)
        return answer_of(geometry, unwrapped(geometry, period * turns, period), period * sd * np.sqrt(excess), right)


def _mean_of(levels: Levels, times: int) -> Levels:
    """Levels of patterns that were shown so many times in a row, averaged."""
    split = (times, -1, *levels.light.shape[1:])
    light, variance = (values.reshape(split).mean(axis=0) for values in (levels.light, levels.variance))
    return Levels(light, variance / times, levels.clipped)


def micro_periods(columns: int, window: int) -> Float64:
    """Periods (MICRO_PERIODS,) of micro phase shifting in columns. A whole number of each fits the field.

    Of `MICRO_TRIALS` random sets it is the one in which codes of columns 2 to `window` apart are the least alike.
    """
    return np.array(_micro_periods(columns, window))


@lru_cache(maxsize=8)
def _micro_periods(columns: int, window: int) -> tuple[float, ...]:
    rng = np.random.default_rng(columns)
    shortest, longest = MICRO_BAND
    fewest = int(np.ceil(columns / longest))
    counts = np.arange(fewest, max(int(columns / shortest), fewest + MICRO_PERIODS - 1) + 1)
    apart = np.abs(np.subtract.outer(np.arange(columns), np.arange(columns)))
    rivals = (apart >= 0.25 * PERIOD) & (apart <= window)
    sets = [columns / rng.choice(counts, MICRO_PERIODS, replace=False) for _ in range(MICRO_TRIALS)]
    codes = [unit_codes(micro_sines(periods, np.arange(columns))) for periods in sets]
    alike = [float(np.max(np.where(rivals, code.T @ code, -1.0))) for code in codes]
    return tuple(map(float, sets[int(np.argmin(alike))]))


def micro_sines(periods: Float64, column: ArrayLike) -> Float32:
    """Brightness (MICRO_PERIODS + 2, n) of columns (n,), which may be fractional.

    The first period has three shifts, the others one each. These shifts are all different: sines with a common peak
    would look the same on both sides of it.
    """
    shift = np.concatenate([[0, 1 / 3, 2 / 3], _GOLDEN * np.arange(1, len(periods))])
    phase = np.asarray(column) / np.concatenate([periods[[0, 0]], periods])[:, None] - shift[:, None]
    return np.asarray(0.5 + 0.5 * np.cos(2 * np.pi * phase), np.float32)


def unit_codes(patterns: Float32) -> Float32:
    """Codes (patterns, columns) of columns: the brightness minus its mean, scaled to length 1; 0 if it is constant."""
    centred = patterns - patterns.mean(axis=0)
    length = np.sqrt((centred**2).sum(axis=0))
    return np.asarray(centred / np.where(length > 0, length, 1.0), np.float32)


@dataclass(frozen=True, slots=True)
class MicroPhaseShift:
    """Micro phase shifting with a SPAD or a conventional camera.

    As in the paper, each pixel has an unknown offset and amplitude. Here they are fitted together with the column, by
    least squares: the answer is the column whose code correlates best with the levels.
    """

    name: str
    sentence: str
    camera: Camera
    source: str = "M. Gupta, S. K. Nayar, Micro phase shifting, CVPR 2012"
    light: Light = "pattern"
    clear_px: float = 0.5

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once. The periods are always the same for the same field."""
        periods = micro_periods(geometry.columns, window_columns(geometry))
        whole = np.arange(geometry.columns)
        patterns = micro_sines(periods, whole)
        levels = measured(apparatus, self.camera, patterns, [1.0] * len(patterns), budget)
        codes = unit_codes(patterns), unit_codes(micro_sines(periods, whole + 0.5))
        infinite = columns_at_infinity(geometry)
        centred = levels.light - levels.light.mean(axis=0)
        expected = levels.light - centred
        column, sharpness, right = (np.full(geometry.shape, np.nan) for _ in range(3))
        for row in range(len(geometry.rows)):
            window = Window(geometry, row, infinite)
            at, half = (window.of(centred[:, row].T @ code) for code in codes)
            place = window.best(np.maximum(at, half))
            pixel = np.arange(len(place))
            start = window.column(place) + 0.5 * (half > at)[pixel, place]
            column[row], strength, sharpness[row] = _sharpened(centred[:, row], periods, start)
            expected[:, row] += strength * unit_codes(micro_sines(periods, np.nan_to_num(column[row])))
        levels, excess = with_noise(levels, self.camera, expected, 3)
        noise = levels.variance.mean(axis=0) * excess
        for row in range(len(geometry.rows)):
            window = Window(geometry, row, infinite)
            match = np.maximum(*(window.of(centred[:, row].T @ code) for code in codes))
            fit = 0.5 * np.maximum(match, 0.0) ** 2 / noise[row, :, None]
            right[row], _ = window.right(fit, window.best(match))
        sd = np.sqrt(noise / np.maximum(sharpness, 1e-12 * noise))
        return answer_of(geometry, column, sd, np.where(levels.clipped, 0.0, right))


def _sharpened(centred: Float64, periods: Float64, start: Float64) -> tuple[Float64, Float64, Float64]:
    """Column (width,) near a start at which the correlation is largest, the correlation there, not below 0, and minus
    the second derivative of half its square."""
    steps = MICRO_STEP * np.arange(-2, 3)
    match = np.array([
        (centred * unit_codes(micro_sines(periods, np.nan_to_num(start) + step))).sum(axis=0) for step in steps
    ])  # fmt: skip
    middle = np.clip(match.argmax(axis=0), 1, len(steps) - 2)
    before, at, after = (np.take_along_axis(match, middle[None] + by, axis=0)[0] for by in (-1, 0, 1))
    # Near its peak the correlation falls as a parabola does.
    bend = 2 * at - before - after
    some = bend > 0
    offset = np.clip(np.where(some, 0.5 * (after - before) / np.where(some, bend, 1.0), 0.0), -1, 1)
    strength = np.maximum(at, 0.0)
    return start + steps[middle] + MICRO_STEP * offset, strength, strength * np.maximum(bend, 0.0) / MICRO_STEP**2


_SEEN = {"spad": "a SPAD", "camera": "a conventional camera"}


def _phase_shift(camera: Camera, unwrap: Literal["gray", "none"]) -> PhaseShift:
    periods = "with Gray code for its periods" if unwrap == "gray" else "of one period"
    name = f"phase-{'gray-' if unwrap == 'gray' else ''}{camera}"
    return PhaseShift(name, f"Sinusoidal phase shift {periods}, seen by {_SEEN[camera]}.", camera, unwrap)


def _micro(camera: Camera) -> MicroPhaseShift:
    return MicroPhaseShift(
        f"phase-micro-{camera}",
        f"Micro phase shifting: sines of similar short periods, seen by {_SEEN[camera]}.",
        camera,
    )


PHASE_SPAD = _phase_shift("spad", "none")
PHASE_GRAY_SPAD = _phase_shift("spad", "gray")
PHASE_MICRO_SPAD = _micro("spad")
PHASE_CAMERA = _phase_shift("camera", "none")
PHASE_GRAY_CAMERA = _phase_shift("camera", "gray")
PHASE_MICRO_CAMERA = _micro("camera")
