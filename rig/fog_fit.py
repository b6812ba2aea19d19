"""The fog meter's fit: the decay of the haze before stripes and behind them, over the path of the light.

With s the mean of the path lengths from scanner and camera, and G the geometry factor of `RowModel`,

    flux = ambient + offset + haze G exp(-2 extinction s)           before the stripe
         = ambient + offset + rest haze G exp(-2 extinction s)      behind it

is fitted by maximum likelihood of the counts, binned by s: haze, extinction, the share `rest` that was scattered more
than once, and by what the learned ambient light is off.

Error bars are those of the sandwich, H^-1 (sum of g g^T) H^-1, g the likelihood's slope from each block of rows and
columns: what the model leaves out shows as scatter between them, as in a jackknife, of which this is the first order.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_EXPOSURES: Final = 50.0
"""Of a bin that takes part."""
STARTS_PER_M: Final = (0.0, 0.05, 0.15, 0.5, 1.5)
STEPS: Final = 40
REST_PRIOR: Final = 25.0
"""Inverse variance of `rest` before any count: 0.2, so that a map without pixels behind its stripes is solvable too."""
RIDGE: Final = 1e-11
"""Keeps the inverse of what says the same twice, as haze that is even and ambient light do, positive."""
FLUX_MIN: Final = 1e-7
FLUX_MAX: Final = 50.0
"""Photons per exposure; between these all logarithms are finite."""


@dataclass(frozen=True, slots=True, eq=False)
class FogFit:
    """haze, extinction, offset and rest, (4,), and their covariance (4, 4); haze is that at the path `at_m`."""

    value: Array
    covariance: Array
    at_m: float


def fit_fog(sums: Array, path_m: Array) -> FogFit | None:
    """Fit of block sums (blocks, 2, bins, 4) over bins of mean path; None where too little was seen before stripes.

    Levenberg's steps from the likeliest of several extinctions. The covariance is that of the counts, widened number
    by number to the sandwich's.
    """
    blocks, _, bins, _ = sums.shape
    used = sums[..., 1].sum(0).ravel() > LEAST_EXPOSURES
    if used[:bins].sum() < 4:
        return None
    ones, exposures, gain, ambient = np.moveaxis(sums.reshape(blocks, 2 * bins, 4)[:, used], 2, 0)
    weight = np.maximum(exposures, 1.0)
    data = _Data(ones, exposures, gain / weight, ambient / weight, np.zeros(0), np.repeat([False, True], bins)[used])
    path = np.tile(path_m, 2)[used]
    at_m = float(np.average(path, weights=exposures.sum(0)))
    data = _Data(data.ones, data.exposures, data.gain, data.ambient, path - at_m, data.behind)
    value = max((data.started(extinction) for extinction in STARTS_PER_M), key=data.evidence)
    evidence, damping = data.evidence(value), 1e-3
    for _ in range(STEPS):
        score, information = data.slopes(value)
        damped = information + damping * np.diag(np.diag(information))
        step = np.linalg.solve(damped, score.sum(0) - data.prior(value))
        tried = value + np.clip(step, -1.0, 1.0)
        reached = data.evidence(tried)
        if reached < evidence:
            damping = 10.0 * damping + 1e-4
            continue
        settled, value, evidence, damping = reached - evidence < 1e-6, tried, reached, 0.1 * damping
        if settled:
            break
    score, information = data.slopes(value)
    inverse = _inverse(information)
    seen = int(np.count_nonzero(exposures.sum(1)))
    scatter = score.T @ score * (seen / max(seen - 1, 1))
    wider = np.sqrt(np.maximum(np.diag(inverse @ scatter @ inverse) / np.diag(inverse), 1.0))
    return FogFit(value, inverse * np.outer(wider, wider), at_m)


def _inverse(information: Array) -> Array:
    """Inverse of an information whose numbers may be of any size, and may depend on each other."""
    size = np.sqrt(np.diag(information))
    relative = information / np.outer(size, size) + RIDGE * np.eye(len(size))
    return np.asarray(np.linalg.inv(relative) / np.outer(size, size))


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    """Sums of the fit, (blocks, cells) each; path_m, behind: (cells,), off the middle path, and side of the stripe."""

    ones: Array
    exposures: Array
    gain: Array
    ambient: Array
    path_m: Array
    behind: NDArray[np.bool_]

    def started(self, extinction_per_m: float) -> Array:
        """Parameters of this extinction with the haze that gives the ones before stripes."""
        shape = self.gain * np.exp(np.minimum(-2.0 * extinction_per_m * self.path_m, 50.0))
        shape, before = (each[:, ~self.behind] for each in (shape, self.exposures))
        rate = np.minimum(self.ones[:, ~self.behind].sum() / before.sum(), 0.999)
        level = -math.log1p(-rate) - float(np.average(self.ambient[:, ~self.behind], weights=before))
        return np.array([max(level, 0.0) / max(float(np.average(shape, weights=before)), 1e-9), extinction_per_m, 0, 0])

    def _light(self, value: Array) -> tuple[Array, Array, Array]:
        """Shape of the haze, what of it each cell sees, and the flux."""
        shape = self.gain * np.exp(np.minimum(-2.0 * value[1] * self.path_m, 50.0))
        part = np.where(self.behind, value[3], 1.0)
        return shape, part, np.clip(self.ambient + value[2] + value[0] * shape * part, FLUX_MIN, FLUX_MAX)

    def evidence(self, value: Array) -> float:
        """Log-likelihood of the counts, and of the weak prior."""
        flux = self._light(value)[2]
        return float(np.sum(self.ones * np.log(np.expm1(flux)) - self.exposures * flux)) - 0.5 * float(
            self.prior(value) @ value
        )

    def prior(self, value: Array) -> Array:
        """Its slope, downwards."""
        return np.array([0.0, 1e-3, 0.0, REST_PRIOR]) * value

    def slopes(self, value: Array) -> tuple[Array, Array]:
        """Slope of each block's log-likelihood (blocks, 4), and the information (4, 4) with the prior's."""
        shape, part, flux = self._light(value)
        haze = value[0] * shape
        design = np.stack([shape * part, -2.0 * self.path_m * haze * part, np.ones_like(flux), haze * self.behind])
        odds = 1.0 / np.expm1(flux)
        score = np.einsum("igb,gb->gi", design, self.ones * (1.0 + odds) - self.exposures)
        information = np.einsum("igb,jgb,gb->ij", design, design, self.exposures * odds)
        return score, information + np.diag([1e-12, 1e-3, 0.0, REST_PRIOR])
