"""Pixels that several sweeps over one unmoved scene share, and what follows where each keeps a position of its own.

Least squares for whatever moves passages from sweep to sweep; a pixel's own position drops out as its weighted mean.
Passages that tremble together count together, since a mirror's jitter is common to all pixels that it passes then.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.errors import Degenerate
from calibration.views import Passages, robust_sd

SWEEP_ERROR_S = 3e-7
"""Error of every sweep as a whole besides noise: a thirtieth of a frame of 10 us."""
LEAST_PIXELS = 50
CLUSTERS = 64
"""Parts of the command range in which the mirror's own trembling is taken to be common to all pixels."""
LEAST_SHARE = 1e-9
"""Smallest eigenvalue of the scaled equations; below it nothing but rounding tells designs apart."""
MOST_OFF = 4.7
"""Residuals, in robust standard deviations, from which on a passage does not count."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedPixels:
    """Passages of the pixels that several sweeps share. command, weight: (pixels, sweeps), weight 0 where a sweep has
    none. rows: (pixels,). direction, speed: (sweeps,)."""

    command: Array
    weight: Array
    rows: Array
    direction: NDArray[np.int64]
    speed: Array

    @property
    def velocity(self) -> Array:
        """Velocities of the command, signed (sweeps,)."""
        return self.direction * self.speed

    @classmethod
    def of(cls, sweeps: Sequence[Passages]) -> "SharedPixels":
        """Collect the pixels that sweeps share. Degenerate where they are too few."""
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
    """value, covariance: of the designs. residual: (pixels, sweeps), in command units. weight: what each counted.
    design: (pixels, sweeps, designs), without what a pixel's own position takes.
    """

    value: Array
    covariance: Array
    residual: Array
    weight: Array
    noise: float
    design: Array

    def with_last_near_0(self, sd: float) -> "Solved":
        """The same, where the last design's value was known to be 0 with this standard deviation."""
        gain = self.covariance[:, -1] / (self.covariance[-1, -1] + sd**2)
        moved = -gain * self.value[-1]
        return replace(
            self,
            value=self.value + moved,
            covariance=self.covariance - np.outer(gain, self.covariance[-1]),
            residual=np.where(self.weight > 0, self.residual - self.design @ moved, self.residual),
        )


def solve(seen: SharedPixels, designs: Sequence[Array]) -> Solved:
    """Weighted least squares, each pixel's own position taken out, and outliers.

    Raises Degenerate where what the sweeps share does not tell every design from the others.
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
    # What trembles together counts together (a sandwich over parts of a sweep), and every sweep may be off as a whole.
    pulls = clustered(weight[:, :, None] * x * error[:, :, None], clusters(seen))
    by_sweep = np.einsum("ij,ija->ja", weight, x) * (SWEEP_ERROR_S * seen.speed)[:, None]
    covariance = inverse @ (pulls.T @ pulls + by_sweep.T @ by_sweep) @ inverse
    return Solved(value, covariance, residual, weight, noise, x)


def _own(values: Array, weight: Array) -> Array:
    """Values (pixels, sweeps, n) less their weighted mean over a pixel's sweeps."""
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None, None]
    result: Array = values - (weight[:, :, None] * values).sum(axis=1, keepdims=True) / total
    return result


def clusters(seen: SharedPixels) -> NDArray[np.int64]:
    """Number (pixels, sweeps) of the part of a sweep that each passage lies in."""
    there = seen.weight > 0
    low, high = seen.command[there].min(), seen.command[there].max()
    part = np.clip((seen.command - low) / max(high - low, 1e-300) * CLUSTERS, 0, CLUSTERS - 1).astype(np.int64)
    cluster: NDArray[np.int64] = part + CLUSTERS * np.arange(len(seen.speed))
    return cluster


def clustered(values: Array, cluster: NDArray[np.int64]) -> Array:
    """Sums (clusters, n) of values (pixels, sweeps, n)."""
    at = cluster.reshape(-1)
    return np.stack([np.bincount(at, values[:, :, a].reshape(-1)) for a in range(values.shape[2])], axis=1)
