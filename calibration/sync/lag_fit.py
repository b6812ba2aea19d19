"""The mirror's lags and the row delay, from sweeps over one unmoved scene at several speeds, in both directions.

A pixel sees the line at one mirror position, whatever the speed. In a sweep with direction s = +1 or -1 and speed v
the line reaches that position, for a pixel in row y, at the command (`Passages` in calibration/views.py)

    command = position + s v (lag(s) - row_delay y)

Each pixel's position is eliminated as a weighted mean over the sweeps (`SharedPixels`); what remains is linear in the
two lags and the row delay. Passages close in time are treated as correlated, since they share the mirror's jitter. The
fit needs neither a board nor geometry, only pixels with a passage in several of the sweeps: 2000 pixels of 4 sweeps
take 10 ms.

The sweeps limit what can be determined (`calibration.model.parameters`). One speed in each direction gives only a mean
of the lags, and both are set to it. At least two speeds in one direction give the lag of each direction that was
scanned. Two speeds in both directions, or three speeds, show whether a lag is the same at all speeds. The row delay
needs rows, not speeds. A row delay that is known from elsewhere is combined with that from the sweeps, unless they
contradict each other significantly; if nothing is known it is 0.

A constant delay of the markers behind the mirror's command (the scanner's colour outputs trail its mirror outputs by
some microseconds, docs/reference/devices/helios.md) shortens both lags. They are then right where frames are bound to
commands by the same markers. A marker of the wrong polarity shows when frames are bound; the gate's delay shows in the
frames at its edges (`gate_fit`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.errors import Degenerate
from calibration.model.parameters import lag_groups, speed_range
from calibration.model.rig_model import Lag
from calibration.views import Passages, robust_sd

SWEEP_ERROR_S = 3e-7
"""Error common to all passages of a sweep, in addition to noise: a thirtieth of a frame of 10 us."""
LEAST_PIXELS = 50
CLUSTERS = 64
"""Parts of the command range within which the mirror's jitter is assumed to be common to all pixels."""
LEAST_SHARE = 1e-9
"""Least eigenvalue of the scaled equations; below it only rounding separates the unknowns."""
MOST_OFF = 4.7
"""Residuals, in robust standard deviations, from which on a passage does not count."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedPixels:
    """Pixels that several sweeps share. command, weight: (pixels, sweeps); a weight of 0 means that there is no
    passage. rows: (pixels,). direction, speed: (sweeps,)."""

    command: Array
    weight: Array
    rows: Array
    direction: NDArray[np.int64]
    speed: Array

    @property
    def velocity(self) -> Array:
        """Signed velocities of the command (sweeps,)."""
        return self.direction * self.speed

    @classmethod
    def of(cls, sweeps: Sequence[Passages]) -> "SharedPixels":
        """Collect the pixels that sweeps share. Raises Degenerate if they are too few."""
        places = [np.stack([sweep.y_px, sweep.x_px], axis=1) for sweep in sweeps]
        every = np.concatenate([*places, np.empty((0, 2))])
        pixels, index = np.unique(every, axis=0, return_inverse=True)
        command, weight = np.zeros((2, len(pixels), len(sweeps)))
        first = 0
        for j, sweep in enumerate(sweeps):
            here = index.reshape(-1)[first : first + len(sweep.command)]
            command[here, j], weight[here, j] = sweep.command, 1 / sweep.sd**2
            first += len(sweep.command)
        shared = (weight > 0).sum(axis=1) >= 2
        if int(shared.sum()) < LEAST_PIXELS:
            raise Degenerate(
                "too-few-pixels",
                f"{int(shared.sum())} pixels saw the line in two of the {len(sweeps)} sweeps or more, at least "
                f"{LEAST_PIXELS} must; show a bright surface that nothing moves, and raise scan.power",
            )
        return cls(
            command[shared], weight[shared], pixels[shared, 0],
            np.array([sweep.direction for sweep in sweeps]), np.array([sweep.speed_per_s for sweep in sweeps]),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """The result of a least squares fit. value, covariance: those of the unknowns, one for each design of `solve`.

    residual: (pixels, sweeps), in command units. weight: weight of each passage, 0 for an outlier. noise: robust sd of
    the residuals in units of the stated sd. design: (pixels, sweeps, designs), after elimination of each pixel's own
    position.
    """

    value: Array
    covariance: Array
    residual: Array
    weight: Array
    noise: float
    design: Array

    def with_last_near_0(self, sd: float) -> "Solved":
        """The solution if the coefficient of the last design is known to be 0 with this standard deviation."""
        gain = self.covariance[:, -1] / (self.covariance[-1, -1] + sd**2)
        moved = -gain * self.value[-1]
        return replace(
            self,
            value=self.value + moved,
            covariance=self.covariance - np.outer(gain, self.covariance[-1]),
            residual=np.where(self.weight > 0, self.residual - self.design @ moved, self.residual),
        )


def solve(seen: SharedPixels, designs: Sequence[Array]) -> Solved:
    """Weighted least squares without outliers, after elimination of each pixel's position. designs: derivative of the
    command by each unknown. Raises Degenerate if the unknowns cannot be separated.
    """
    basis = np.stack([np.broadcast_to(each, seen.command.shape) for each in designs], axis=2)
    weight, noise = seen.weight, 1.0
    for _ in range(6):
        x, y = _own(basis, weight), _own(seen.command[:, :, None], weight)[:, :, 0]
        normal = np.einsum("ij,ija,ijb->ab", weight, x, x)
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
        if not values[0] > LEAST_SHARE:
            raise Degenerate(
                "one-speed",
                f"the pixels that sweeps share do not tell the lags apart (a share of {max(values[0], 0):.1g} of the "
                f"equations is their own, limit {LEAST_SHARE:g}); show one unmoved scene to sweeps both ways, at two "
                "speeds or more",
            )
        inverse = scale[:, None] * ((vectors / values) @ vectors.T) * scale
        value = inverse @ np.einsum("ij,ija,ij->a", weight, x, y)
        residual = np.where(seen.weight > 0, y - x @ value, 0)
        # The pixel's own position has taken a part of each residual.
        share = seen.weight / np.maximum(seen.weight.sum(axis=1, keepdims=True), 1e-300)
        error = residual / np.sqrt(np.maximum(1 - share, 1e-3))
        scaled = np.abs(error) * np.sqrt(seen.weight)
        noise = max(robust_sd(scaled[seen.weight > 0]), 1e-12)
        weight = seen.weight * (scaled < MOST_OFF * max(noise, 1.0))
    # Errors within a part of a sweep are correlated (sandwich covariance by clusters); a whole sweep may be off too.
    pulls = clustered(weight[:, :, None] * x * error[:, :, None], clusters(seen))
    by_sweep = np.einsum("ij,ija->ja", weight, x) * (SWEEP_ERROR_S * seen.speed)[:, None]
    covariance = inverse @ (pulls.T @ pulls + by_sweep.T @ by_sweep) @ inverse
    return Solved(value, covariance, residual, weight, noise, x)


def _own(values: Array, weight: Array) -> Array:
    """Values (pixels, sweeps, n) less their weighted mean over a pixel's sweeps."""
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None, None]
    return np.asarray(values - (weight[:, :, None] * values).sum(axis=1, keepdims=True) / total)


def clusters(seen: SharedPixels) -> NDArray[np.int64]:
    """Number (pixels, sweeps) of the part of a sweep in which each passage lies."""
    there = seen.weight > 0
    low, high = seen.command[there].min(), seen.command[there].max()
    part = np.clip((seen.command - low) / max(high - low, 1e-300) * CLUSTERS, 0, CLUSTERS - 1).astype(np.int64)
    return np.asarray(part + CLUSTERS * np.arange(len(seen.speed)))


def clustered(values: Array, cluster: NDArray[np.int64]) -> Array:
    """Sums (clusters, n) of values (pixels, sweeps, n) over each cluster. cluster: (pixels, sweeps), as from
    `clusters`."""
    at = cluster.reshape(-1)
    return np.stack([np.bincount(at, values[:, :, a].reshape(-1)) for a in range(values.shape[2])], axis=1)


SIGNIFICANT = 5.0
"""Standard deviations by which a row delay must differ from the known one to replace it, and by which a lag must lie
below 0 to be refused."""
MOST_CHI2_SDS = 4.0
"""Most standard deviations by which chi squared of the sweeps' lags may lie above its mean."""


@dataclass(frozen=True, slots=True)
class SweepTiming:
    """The lag of one sweep by itself: the fitted lag, changed by the sweep's mean residual. sd_s: sd of this change."""

    direction: int
    speed_per_s: float
    lag_s: float
    sd_s: float
    passages: int

    @property
    def velocity_per_s(self) -> float:
        """Velocity of the command, signed."""
        return self.direction * self.speed_per_s


@dataclass(frozen=True, slots=True, eq=False)
class SyncFit:
    """Fitted lags. lag_s, row_delay_s: as in `RigModel`. covariance: (3, 3), s^2, of the three; NaN where unknown.

    speed_range_per_s: the range in which they hold. common: whether the two lags could not be separated. told: the
    directions that were scanned, +1 and -1. row_told: whether the row delay was determined; if not, it is the one known
    before, with the variance that the sweeps alone would have given. sweeps: lag of each sweep by itself, at the fitted
    row delay. chi2, dof: chi squared of these lags against the fitted ones, and its degrees of freedom; `steady`:
    whether they agree. noise: robust standard deviation of the residuals in units of the stated sd.
    """

    lag_s: Lag
    row_delay_s: float
    covariance: Array
    speed_range_per_s: tuple[float, float]
    common: bool
    told: tuple[int, ...]
    row_told: bool
    sweeps: tuple[SweepTiming, ...]
    chi2: float
    dof: int
    noise: float

    @property
    def sd_s(self) -> Array:
        """Standard deviations (3,) of both lags and the row delay; NaN for a direction that was not scanned, and of the
        row delay if all pixels lie in one row."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def velocities_per_s(self) -> tuple[float, ...]:
        """Signed velocities of the sweeps."""
        return tuple(sweep.velocity_per_s for sweep in self.sweeps)

    @property
    def steady(self) -> bool:
        """Whether the lag is the same at all speeds, as far as these sweeps can show."""
        return self.dof == 0 or bool(self.chi2 <= self.dof + MOST_CHI2_SDS * np.sqrt(2 * self.dof))


def fit_sync(sweeps: Sequence[Passages], row_delay_s: float = 0.0, row_delay_sd_s: float = 0.0) -> SyncFit:
    """Lags and row delay from the passages of one unmoved scene. row_delay_s, row_delay_sd_s: the row delay as known
    before, and its sd, 0 if that is not known.

    Raises Degenerate if they cannot be determined: one-speed, too-few-pixels, marker-polarity, negative-lag.
    """
    _require_speeds(sweeps)
    seen = SharedPixels.of(sweeps)
    heard = (seen.weight > 0).sum(axis=0).tolist()
    if not all(heard):  # a sweep that shares no pixel says nothing, and its speed must not count
        return fit_sync(
            [sweep for sweep, tells in zip(sweeps, heard, strict=True) if tells], row_delay_s, row_delay_sd_s
        )
    _require_one_way_round(seen)
    told = tuple(way for way in (1, -1) if way in seen.direction)
    common = len(told) == 2 and len(lag_groups(seen.velocity)) == 1
    lags = [np.where(np.isin(seen.direction, ways), seen.velocity, 0.0) for ways in ([told] if common else told)]
    by_row = -seen.velocity * seen.rows[:, None]
    seen = replace(seen, command=seen.command - row_delay_s * by_row)
    row_variance, row_told = np.nan, False
    if np.ptp(seen.rows) > 0:
        solved = solve(seen, [*lags, by_row])
        change_s, row_variance = float(solved.value[-1]), float(solved.covariance[-1, -1])
        believed = abs(change_s) > SIGNIFICANT * np.hypot(np.sqrt(row_variance), row_delay_sd_s)
        row_told = bool(believed) or row_delay_sd_s > 0
        solved = solved if believed else solved.with_last_near_0(row_delay_sd_s)
        row_delay_s += float(solved.value[-1])
    else:
        solved = solve(seen, lags)

    # From the solution to both lags and the row delay. A common lag stands for both. Covariances of an unscanned
    # direction are NaN.
    which = {way: 0 if common else told.index(way) for way in told}
    kept = [which.get(way) for way in (1, -1)]
    covariance = np.full((3, 3), np.nan)
    places = {at: i for at, i in enumerate([*kept, len(lags) if row_told else None]) if i is not None}
    covariance[np.ix_(list(places), list(places))] = solved.covariance[np.ix_(*2 * [list(places.values())])]
    if not row_told:
        covariance[2, 2] = row_variance
    lag_s = {way: float(solved.value[i]) for way, i in which.items()}
    for way, lag in lag_s.items():
        _require_no_lead(way, lag, float(np.sqrt(solved.covariance[which[way], which[way]])))
    timings, chi2 = _by_sweep(seen, solved, lag_s)
    return SyncFit(
        lag_s=Lag(*(max(lag_s.get(way, lag_s[told[0]]), 0.0) for way in (1, -1))),
        row_delay_s=row_delay_s, covariance=covariance,
        speed_range_per_s=speed_range(seen.speed),
        common=common, told=told, row_told=row_told, sweeps=timings, chi2=chi2, dof=max(0, len(sweeps) - 1 - len(lags)),
        noise=solved.noise,
    )  # fmt: skip


def _by_sweep(seen: SharedPixels, solved: Solved, lag_s: dict[int, float]) -> tuple[tuple[SweepTiming, ...], float]:
    """Each sweep's own lag, and chi squared of their residuals."""
    total = np.maximum(solved.weight.sum(axis=0), 1e-300)
    mean = (solved.weight * solved.residual).sum(axis=0) / total
    around = solved.weight * (solved.residual - mean)
    pulls = clustered(around[:, :, None], clusters(seen))[:, 0]
    sweep = np.arange(len(pulls)) // CLUSTERS
    sd = np.sqrt(np.bincount(sweep, pulls**2, len(seen.speed)) / total**2 + (SWEEP_ERROR_S * seen.speed) ** 2)
    timings = tuple(
        SweepTiming(int(way), float(speed), lag_s[int(way)] + float(off / (way * speed)), float(s / speed), int(n))
        for way, speed, off, s, n in zip(
            seen.direction, seen.speed, mean, sd, (seen.weight > 0).sum(axis=0), strict=True
        )
    )
    return timings, float(np.sum((mean / sd) ** 2))


def _require_speeds(sweeps: Sequence[Passages]) -> None:
    if not lag_groups([sweep.velocity_per_s for sweep in sweeps]):
        at = f" at {sweeps[0].speed_per_s:.4g} /s" if sweeps else ""
        raise Degenerate(
            "one-speed",
            f"{len(sweeps)} sweeps ran one way{at}: a lag cannot be told from where things are; scan both ways "
            "(scan.bidirectional), and at two speeds (--exposures)",
        )


def _require_one_way_round(seen: SharedPixels) -> None:
    """Raise Degenerate if the commands of one direction run against those of the other: then the direction marker has
    the wrong polarity."""
    ahead, back = (seen.direction == way for way in (1, -1))
    if not (ahead.any() and back.any()):
        return
    first, second = (
        (seen.weight[:, way] * seen.command[:, way]).sum(axis=1) / np.maximum(seen.weight[:, way].sum(axis=1), 1e-300)
        for way in (ahead, back)
    )
    both = (seen.weight[:, ahead] > 0).any(axis=1) & (seen.weight[:, back] > 0).any(axis=1)
    if both.sum() >= LEAST_PIXELS and np.corrcoef(first[both], second[both])[0, 1] < 0:
        raise Degenerate(
            "marker-polarity",
            "the line passes the pixels of the sweeps back in the order of those out, while their commands run the "
            "other way: the direction marker has the wrong polarity; invert its line, or the scanner's axis",
        )


def _require_no_lead(way: int, lag_s: float, sd_s: float) -> None:
    if lag_s < -SIGNIFICANT * sd_s:
        raise Degenerate(
            "negative-lag",
            f"the lag {'up' if way > 0 else 'down'} is {lag_s * 1e6:.1f} us with a standard deviation of "
            f"{sd_s * 1e6:.1f}, the limit is 0: no mirror runs ahead of its command; check delay and polarity of the "
            "line markers, and the scanner's clock",
        )
