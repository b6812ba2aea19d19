"""Pixels of a SPAD array in the dark and in light: rates, hot, dead and noisy pixels, and how they have changed.

Flux per exposure is -ln(1 - p), with p the share of frames in which a pixel fired. Its sd from N frames is
sqrt((e^flux - 1) / N); a pixel that never fired is given the sd of half a count.

Hot pixels are defined by the information they lose. A one-bit frame has the Fisher information 1 / (e^(s + b) - 1)
about a stripe's s photons (b: everything else that the pixel detects). The limit is the dark flux at which this falls
to half of that of the surrounding pixels: b = ln(2 e^(s + b0) - 1) - s, with b0 their flux. A hot pixel must lie above
the limit, and farther above its neighbours than counting and scatter explain. Fewer frames than `frames_for` cannot
classify pixels near the limit.

A noisy pixel is one whose counts n scatter over blocks of frames more than counting statistics allow, as when its rate
jumps (random telegraph noise). The index of dispersion is the sum of (n - e)^2 / e over the blocks. The expected counts
e are proportional to the counts of ordinary pixels, so that a lamp or a warming sensor makes no pixel noisy. Divided by
1 - p, since frames hold bits, the index is chi-square with blocks - 1 degrees of freedom. `FALSE_ALARM` is the
probability that a good pixel is called noisy.

A dead pixel is one that hardly fires in light although its neighbours do. It cannot be recognised without light.

Changes (`pixel_drift`) are found from frames of the same exposure in darkness. Dark rates double every 8 to 10 K,
so a warmer sensor shows as a common factor, and faulty pixels show one by one.

`pixels.npz` holds the arrays of a `PixelMap` by their names (`dead` is left out if unknown), and `about`, JSON text:
format, version, created, parent, sensor, exposure_s, frames, judged, lit_judged, ordinary_per_s.
"""

import hashlib
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.errors import CalibrationError
from calibration.files.npy_files import load_arrays
from calibration.views import robust_sd

LEAST_COUNTS = 10.0
"""Least mean number of 1s, and of 0s, in a block for a pixel's scatter to be judged; below, it is no chi-square."""
LEAST_BLOCKS, MOST_BLOCKS = 8, 64
_APART, _ROUNDS = 6.0, 8
"""An ordinary pixel counts at most this multiple of (sd + 1) above the expected counts; rounds of this selection."""
_MANY, _MOST_COMMON = 100, 1.5
"""If at least so many pixels are judged, the scatter common to them is removed, up to this factor in variance."""


class DarkTally:
    """Adds up dark frames block by block. Blocks must follow one another in time, and preferably have equal length.

    If there are many blocks, neighbours are joined so that no more than `MOST_BLOCKS` are kept.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.ones = np.zeros(shape, np.int64)
        self.frames = np.zeros(shape, np.int64)
        self._blocks: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []

    def add(self, ones: NDArray[np.integer], frames: NDArray[np.integer] | int) -> None:
        """Add a block. ones (rows, width): counts of each pixel. frames: number of frames in which each pixel
        was read."""
        if len(self._blocks) == MOST_BLOCKS:
            pairs = zip(self._blocks[::2], self._blocks[1::2], strict=True)
            self._blocks = [(one[0] + other[0], one[1] + other[1]) for one, other in pairs]
        block = np.array(ones, np.int32), np.array(frames, np.int32)
        self._blocks.append(block)
        self.ones += block[0]
        self.frames += block[1]

    def ordinary(self) -> Mask:
        """Pixels whose counts are not far above those of the others."""
        seen = self.frames > 0
        kept = seen
        for _ in range(_ROUNDS):
            expected = self.frames * (self.ones[kept].sum() / max(self.frames[kept].sum(), 1))
            kept = seen & (self.ones <= expected + _APART * (np.sqrt(expected) + 1))
        return kept

    def scatter(self) -> tuple[Array, NDArray[np.int64], Mask]:
        """Index of dispersion (rows, width), 0 if unknown; its degrees of freedom; a mask of where it is known."""
        ordinary = self.ordinary()
        blocks = np.zeros(self.ones.shape, np.int64)
        counts, expected, squares = (np.zeros(self.ones.shape) for _ in range(3))
        compared = 0.0
        for ones, given in self._blocks:
            frames = np.broadcast_to(given, ones.shape)
            usual = float(ones[ordinary].sum())
            if usual == 0:
                continue  # nothing to compare by
            compared += usual
            here = frames * (usual / frames[ordinary].sum())
            blocks += frames > 0
            counts += ones
            expected += here
            squares += np.square(ones, dtype=np.float64) / np.where(here > 0, here, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.minimum(counts / self.frames, 1.0)
            few = LEAST_COUNTS * blocks
            judged = (blocks >= LEAST_BLOCKS) & (counts >= few) & (self.frames - counts >= few)
            # The expected counts were counted too, and scatter with the root of their sum.
            index = (squares * expected / counts - counts) / (1.0 - share + counts / max(compared, 1.0))
        index = np.where(judged, index, 0.0)
        dof = np.maximum(blocks - 1, 1)
        if judged.sum() >= _MANY:  # afterpulses make the counts of all pixels scatter a little
            middle = np.median(index[judged] / (dof[judged] * (1 - 2 / (9 * dof[judged])) ** 3))
            index /= np.clip(middle, 1.0, _MOST_COMMON)
        return index, dof, judged


SIGNAL = 0.1
"""Photons per pixel and exposure of the weakest stripes that are looked for: ten frames see one."""
PRECISION = 0.02
"""Relative sd of a rate at the limit. 0.6 % of the hot pixels are misclassified if the number above a rate r goes with
r^-0.7."""
FALSE_ALARM = 1e-6
"""Probability that a good pixel is called noisy, or dead: a quarter of a pixel in 512 x 512."""
DEAD_SHARE = 0.1
"""Share of its neighbours' light below which a pixel is dead."""
_HOT_SIGMA = 6.0
_JUMP_SIGMA = 3.0
"""A noisy pixel is a defect if its rate plus so many sd of its jumps exceeds the limit."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelMap:
    """The result for each pixel; arrays are (rows, width).

    rate_per_s, rate_sd_per_s: float32, dark counts per second; NaN where no frame contained the pixel. jump_per_s:
    float32, sd of a noisy pixel's rate between blocks beyond that of counting, 0 for all other pixels. hot, noisy:
    bool. dead: None if there was no light. judged: share of the pixels whose data tell whether they are noisy.
    lit_judged: share lit well enough to tell whether they are dead, 0 without light. defects: pixels that are hot,
    dead, or noisy with jumps that reach the limit. limit_per_s: float32, the rate that a hot pixel exceeds; hot pixels
    also stand out from their neighbours. frames: largest number of frames of a pixel. ordinary_per_s: mean dark rate of
    the ordinary pixels.
    """

    rate_per_s: NDArray[np.float32]
    rate_sd_per_s: NDArray[np.float32]
    jump_per_s: NDArray[np.float32]
    limit_per_s: NDArray[np.float32]
    hot: Mask
    noisy: Mask
    dead: Mask | None
    defects: Mask
    judged: float
    lit_judged: float
    frames: int
    exposure_s: float
    ordinary_per_s: float


def judge_pixels(
    tally: DarkTally,
    exposure_s: float,
    *,
    lit: tuple[NDArray[np.integer], NDArray[np.integer] | int] | None = None,
    signal: float = SIGNAL,
    false_alarm: float = FALSE_ALARM,
) -> PixelMap:
    """Judge each pixel by the dark frames. lit: (ones, frames) with light on the sensor; without it no pixel is called
    dead.

    signal: photons per pixel and exposure of the weakest stripe. false_alarm: see `FALSE_ALARM`.
    """
    ones, frames = tally.ones, tally.frames
    flux, sd = flux_of(ones, frames)
    level = _around(flux)
    limit = hot_flux(signal, level)
    hot = _is_hot(flux, frames, level, limit)
    index, dof, judged = tally.scatter()
    noisy = judged & (index > _chi_square_limit(dof, false_alarm))
    # Counts of a block scatter by their mean times what the index has above its expectation.
    per_block = ones / np.maximum(dof + 1, 1)
    jump = np.sqrt(np.maximum(index / dof - 1, 0.0) * per_block * (1 - ones / np.maximum(frames, 1)))
    jump_flux = np.where(noisy, jump * (dof + 1) / np.maximum(frames, 1), 0.0)
    dead, lit_judged = (None, np.zeros(1)) if lit is None else dead_pixels(*lit, false_alarm=false_alarm)
    defects = hot | (noisy & (flux + _JUMP_SIGMA * jump_flux > limit))
    if dead is not None:
        defects |= dead
    per_s = 1.0 / exposure_s
    ordinary = tally.ordinary()
    usual = ones[ordinary].sum() / max(int(frames[ordinary].sum()), 1)
    return PixelMap(
        rate_per_s=(flux * per_s).astype(np.float32),
        rate_sd_per_s=(sd * per_s).astype(np.float32),
        jump_per_s=(jump_flux * per_s).astype(np.float32),
        limit_per_s=(limit * per_s).astype(np.float32),
        hot=hot,
        noisy=noisy,
        dead=dead,
        defects=defects,
        judged=float(judged.mean()),
        lit_judged=float(lit_judged.mean()),
        frames=int(frames.max(initial=0)),
        exposure_s=exposure_s,
        ordinary_per_s=-math.log1p(-min(float(usual), 1 - 1e-9)) * per_s,
    )


def flux_of(ones: NDArray[np.integer], frames: NDArray[np.integer] | int) -> tuple[Array, Array]:
    """Flux per exposure and its sd, NaN without frames. A pixel that fired in all frames is given half a count less."""
    n = np.broadcast_to(np.asarray(frames, np.float64), ones.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        flux = -np.log1p(-np.minimum(ones, n - 0.5) / n)
        few = np.clip(ones, 0.5, n - 0.5) / n
        sd = np.sqrt(few / (1 - few) / n)
    return np.where(n > 0, flux, np.nan), np.where(n > 0, sd, np.nan)


def hot_flux(signal: float, level: Array | float) -> Array:
    """Flux per exposure at which a pixel has half as much information on `signal` photons as a pixel at `level`."""
    return np.asarray(np.log(2 * np.exp(signal + np.asarray(level, np.float64)) - 1) - signal)


def frames_for(limit_flux: float, precision: float = PRECISION) -> int:
    """Number of frames that measure a rate at the limit with the relative sd `precision`."""
    return math.ceil(math.expm1(limit_flux) / (limit_flux * precision) ** 2)


def dead_pixels(
    ones: NDArray[np.integer], frames: NDArray[np.integer] | int, *, false_alarm: float = FALSE_ALARM
) -> tuple[Mask, Mask]:
    """Pixels (rows, width) with less than `DEAD_SHARE` of their neighbours' light, and the pixels for which this can be
    judged.

    Dead pixels count so little that one with half of its neighbours' light would do so with a probability below
    `false_alarm` (Chernoff's bound). So in too dim a light no pixel is called dead.
    """
    around = _around(flux_of(ones, frames)[0])
    n = np.broadcast_to(np.asarray(frames, np.float64), ones.shape)
    half = -n * np.expm1(-around / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        exponent = half - ones - np.where(ones > 0, ones * np.log(half / np.maximum(ones, 1)), 0.0)
    surely = (ones < half) & (exponent > -math.log(false_alarm))
    dead: Mask = surely & (ones < -DEAD_SHARE * n * np.expm1(-around))
    return dead, np.asarray(half > -math.log(false_alarm))


def light_leak(pixels: PixelMap) -> float:
    """Correlation of ordinary neighbours' rates along the rows, a sign of stray light; 0 if it may be chance."""
    rate = np.where(pixels.defects, np.nan, pixels.rate_per_s.astype(np.float64))
    low, high = np.nanpercentile(rate, [1.0, 95.0])
    rate[(rate < low) | (rate > high)] = np.nan
    left, right = rate[:, :-1], rate[:, 1:]
    both = np.isfinite(left) & np.isfinite(right)
    if both.sum() < LEAST_COUNTS or low == high:
        return 0.0
    found = float(np.corrcoef(left[both], right[both])[0, 1])
    return found if found * math.sqrt(both.sum()) > _HOT_SIGMA else 0.0


def _is_hot(flux: Array, frames: NDArray[np.int64], level: Array, limit: Array) -> Mask:
    seen = np.isfinite(flux)
    n = np.maximum(frames, 1)
    chance = np.sqrt(np.maximum(np.expm1(level), 1 / n) / n)
    excess = flux - level
    scatter = robust_sd(excess[seen]) if seen.any() else 0.0
    return seen & (flux > limit) & (excess > _HOT_SIGMA * np.maximum(chance, scatter))


def _around(flux: Array) -> Array:
    """Median of the 5 x 5 pixels around each; those without data count as the median of all."""
    seen = np.isfinite(flux)
    overall = float(np.median(flux[seen])) if seen.any() else 0.0
    return np.asarray(cv2.medianBlur(np.where(seen, flux, overall).astype(np.float32), 5), np.float64)


def _chi_square_limit(dof: NDArray[np.int64], probability: float) -> Array:
    """The value that chi-square exceeds with that probability (Wilson and Hilferty, 1931)."""
    spread = 2 / (9 * dof)
    return dof * (1 - spread + NormalDist().inv_cdf(1 - probability) * np.sqrt(spread)) ** 3


SIGNIFICANT = 5.0
"""Counting sds by which a rate must differ to count as changed."""
MOST_RATIO = 2.0
"""Common factor between two maps, as after 8 to 10 K either way, from which on the old limits and rates are useless."""
MOST_NEW_DEFECTS = 0.005
"""Largest share of all pixels that may have become defects."""
LEAST_ALIKE = 0.5
"""Least share of the old map's hot pixels that are hot again if the sensor is the same."""
_LEAST_HOT = 10
"""Fewest hot pixels by which two sensors can be distinguished."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelDrift:
    """The change from an older map to a newer one.

    became_hot, became_dead, recovered: (n, 2) row and column; recovered ones were hot. Hot and recovered ones count
    only if the change is more than chance, dead ones only if both maps were made with light. ratio: ratio of the
    ordinary pixels' rates, newer to older; ratio_sigma: its distance from 1 in sd. They are 1 and 0 without such rates.
    changed: share of the pixels whose rates differ by more than chance after this factor is removed. correlation:
    correlation of the logarithms of rates above 0; NaN for fewer than two pixels, or if all of one map are equal.
    alike: share of the old hot pixels that are still hot, None if too few. new_defects: share of all pixels that became
    hot or dead.
    """

    became_hot: NDArray[np.int64]
    became_dead: NDArray[np.int64]
    recovered: NDArray[np.int64]
    ratio: float
    ratio_sigma: float
    changed: float
    correlation: float
    alike: float | None
    new_defects: float

    @property
    def reasons(self) -> tuple[str, ...]:
        """Codes of the changes that make the older map useless: other-sensor, dark-rate-drift, new-defects."""
        found = {
            "other-sensor": self.alike is not None and self.alike < LEAST_ALIKE,
            "dark-rate-drift": self.ratio_sigma > SIGNIFICANT and not 1 / MOST_RATIO < self.ratio < MOST_RATIO,
            "new-defects": self.new_defects > MOST_NEW_DEFECTS,
        }
        return tuple(code for code, here in found.items() if here)


def pixel_drift(old: PixelMap, new: PixelMap) -> PixelDrift:
    """Compare two maps of one sensor. Raises CalibrationError if they differ in size."""
    if old.rate_per_s.shape != new.rate_per_s.shape:
        (rows, width), (old_rows, old_width) = new.rate_per_s.shape, old.rate_per_s.shape
        raise CalibrationError(
            f"the older map is of {old_width} x {old_rows} pixels, this one of {width} x {rows}; compare maps of one "
            "sensor"
        )
    before, after = old.rate_per_s.astype(np.float64), new.rate_per_s.astype(np.float64)
    sd_before, sd_after = old.rate_sd_per_s.astype(np.float64), new.rate_sd_per_s.astype(np.float64)
    ordinary = ~(old.defects | new.defects | old.noisy | new.noisy) & np.isfinite(before) & np.isfinite(after)
    ratio, ratio_sigma = _ratio(before[ordinary], after[ordinary], sd_before[ordinary], sd_after[ordinary])
    difference = after - ratio * before
    noise = np.hypot(sd_after, ratio * sd_before)
    with np.errstate(invalid="ignore"):
        surely = np.abs(difference) > SIGNIFICANT * np.maximum(noise, 1e-300)
    known = np.isfinite(difference)
    were_hot = int(old.hot.sum())
    became_hot = np.argwhere(new.hot & ~old.hot & surely)
    became_dead = np.empty((0, 2), np.int64)
    if old.dead is not None and new.dead is not None:
        became_dead = np.argwhere(new.dead & ~old.dead)
    return PixelDrift(
        became_hot=became_hot,
        became_dead=became_dead,
        recovered=np.argwhere(old.hot & ~new.hot & surely),
        ratio=ratio,
        ratio_sigma=ratio_sigma,
        changed=float(surely[known].mean()) if known.any() else 0.0,
        correlation=_correlation(before, after),
        alike=None if were_hot < _LEAST_HOT else float((old.hot & new.hot).sum() / were_hot),
        new_defects=(len(became_hot) + len(became_dead)) / known.size,
    )


def _ratio(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    sd_before: NDArray[np.float64],
    sd_after: NDArray[np.float64],
) -> tuple[float, float]:
    """Ratio of the sums of two sets of rates, newer to older, and its distance from 1 in sd; (1, 0) if a sum is 0."""
    old, new = float(before.sum()), float(after.sum())
    if old <= 0 or new <= 0:
        return 1.0, 0.0
    relative = math.hypot(math.sqrt(float((sd_before**2).sum())) / old, math.sqrt(float((sd_after**2).sum())) / new)
    return new / old, abs(math.log(new / old)) / relative


def _correlation(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    seen = (before > 0) & (after > 0)
    if seen.sum() < 2:
        return math.nan
    a, b = np.log(before[seen]), np.log(after[seen])
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else math.nan


FORMAT: Final = "spadrig-pixels"
_ARRAYS: Final = ("rate_per_s", "rate_sd_per_s", "jump_per_s", "limit_per_s", "hot", "noisy", "defects")
_NUMBERS: Final = ("judged", "lit_judged", "exposure_s", "ordinary_per_s")
_NEXT: Final = "name a pixels.npz that 'rig calibrate pixels' wrote"


@dataclass(frozen=True, slots=True, eq=False)
class PixelVersion:
    """A pixel map as one version in the series of its sensor.

    version: 1 for the first. created: ISO 8601 date and time. parent: id of the version that it was compared with.
    sensor: model and serial number, as far as known.
    """

    pixels: PixelMap
    version: int
    created: str
    parent: str | None = None
    sensor: str = ""

    @property
    def id(self) -> str:
        """Sixteen hexadecimal digits that change with date, version, parent, sensor and any array but `dead`."""
        digest = hashlib.sha256(f"{self.created} {self.version} {self.parent} {self.sensor}".encode())
        for name in _ARRAYS:
            digest.update(np.ascontiguousarray(getattr(self.pixels, name)).tobytes())
        return digest.hexdigest()[:16]


def save_pixels(version: PixelVersion, path: str | os.PathLike[str]) -> None:
    """Write a version to a file, completely or not at all. Raises OSError if that fails."""
    file, pixels = Path(path), version.pixels
    about = {"format": FORMAT, **{name: getattr(version, name) for name in ("version", "created", "parent", "sensor")}}
    about |= {name: getattr(pixels, name) for name in ("frames", *_NUMBERS)}
    arrays = {name: getattr(pixels, name) for name in _ARRAYS}
    if pixels.dead is not None:
        arrays["dead"] = pixels.dead
    scratch = file.with_name(f".{file.name}.part")
    with scratch.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)
    scratch.replace(file)


_DAMAGE = (ArithmeticError, AttributeError, KeyError, RecursionError, TypeError, ValueError)
"""Errors that reading raises for a damaged file."""


def load_pixels(path: str | os.PathLike[str]) -> PixelVersion:
    """Read a version from a file. Raises CalibrationError if the file cannot be read or holds none."""
    file = Path(path)
    try:
        archive = load_arrays(file)
        about: dict[str, Any] = json.loads(str(archive["about"]))
        arrays: dict[str, Any] = {name: archive[name] for name in _ARRAYS}
        dead = archive.get("dead")
        shapes = {array.shape for array in (*arrays.values(), *([] if dead is None else [dead]))}
        if about["format"] != FORMAT or len(shapes) != 1:
            raise ValueError(f"'format' is {about['format']!r}, arrays have shapes {sorted(shapes)}")
        numbers: dict[str, Any] = {name: float(about[name]) for name in _NUMBERS}
        pixels = PixelMap(**arrays, dead=dead, frames=int(about["frames"]), **numbers)
        return PixelVersion(pixels, int(about["version"]), str(about["created"]), about["parent"], str(about["sensor"]))
    except OSError as error:
        raise CalibrationError(f"cannot read {file}: {error.strerror or error}; {_NEXT}") from error
    except _DAMAGE as error:
        raise CalibrationError(f"{file} holds no map of pixels ({error}); {_NEXT}") from error
