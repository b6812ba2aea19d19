"""The fog meter: density of the medium, light that it scatters, and ambient light, from the counts of a single map.

Rows of a column whose stripe is beyond doubt (clear rows) show the light before and behind the stripe. Maximum
likelihood fits this light to the counts, binned by s (sums (blocks, 2, bins, 4) of `rig.depth.kernels`):

    flux = ambient + offset + haze G exp(-2 extinction s)           before the stripe
         = ambient + offset + rest haze G exp(-2 extinction s)      behind it

Here s is the mean of the path lengths from scanner and camera in metres, and G the geometry factor of the haze
(`rig.estimate.row.inputs`). The parameters are haze, extinction, the share `rest` of the haze that was scattered more
than once, and `offset`, the error of the learned ambient light.

Standard deviations come from the sandwich estimator, H^-1 (sum of g g^T) H^-1, which holds even if the model is a
little wrong: what it leaves out shows as scatter between blocks. H is the information of the counts, and g the
likelihood's slope from each block of rows and columns. They are at least those of H^-1. One error shows in no scatter:
light scattered more than once flattens the decay all over the picture. Therefore REST_SHARE times `rest` is added (in
quadrature) to the extinction's relative error.

Limits. A reading depends only on its map and on the model with which the map was estimated; no reading is carried over
to the next map. If the fog forms a halo around the stripes (`halo` of the model), its light falls off on both sides of
them as haze would, and neither extinction nor veil (the haze just before the stripe) is given. Nor are they given for
several lines at once: the other lines' haze ends at their own stripes, at unknown places, which changes the form of the
decay.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calibration.errors import digits
from rig.count.volume import CountVolume
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Bools, Float32, Float64, Int32

if TYPE_CHECKING:
    from rig.estimate.row.inputs import Lines


LEAST_EXPOSURES: Final = 50.0
STARTS_PER_M: Final = (0.0, 0.05, 0.15, 0.5, 1.5)
STEPS: Final = 40
REST_PRIOR: Final = 25.0
"""Inverse variance of `rest` before any count (sd 0.2), so that a map without pixels behind stripes is solvable too."""
RIDGE: Final = 1e-11
"""Added to the diagonal: keeps the inverse positive if two parameters act alike, as even haze and ambient light do."""
FLUX_MIN: Final = 1e-7
FLUX_MAX: Final = 50.0
"""Photons per exposure; between FLUX_MIN and FLUX_MAX all logarithms are finite."""


@dataclass(frozen=True, slots=True, eq=False)
class FogFit:
    """The fitted light of a map. value: haze, extinction in 1/m, offset and rest, (4,). covariance: (4, 4), of these.

    at_m: the mean path in metres; the haze is that at this path.
    """

    value: Float64
    covariance: Float64
    at_m: float


def fit_fog(sums: Float64, path_m: Float64) -> FogFit | None:
    """Fit block sums (blocks, 2, bins, 4); None if too little was seen before stripes. path_m: (bins,), the path of
    each.

    Newton's steps, damped as by Levenberg, start from the likeliest of several extinctions. The covariance is that of
    the counts; each parameter's error is widened to the sandwich's if that is larger.
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


def _inverse(information: Float64) -> Float64:
    """Inverse of an information matrix whose parameters may have any scale, and may be dependent."""
    size = np.sqrt(np.diag(information))
    relative = information / np.outer(size, size) + RIDGE * np.eye(len(size))
    return np.asarray(np.linalg.inv(relative) / np.outer(size, size))


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    """Data of the fit, (blocks, cells); a cell is a bin of path on one side of the stripe.

    ones, exposures: sums of detections and of exposures. gain, ambient: means of the geometry factor and of the flux
    that is no haze. path_m, behind: (cells,), path less the mean path, and whether the cell is behind the stripe.
    """

    ones: Float64
    exposures: Float64
    gain: Float64
    ambient: Float64
    path_m: Float64
    behind: Bools

    def started(self, extinction_per_m: float) -> Float64:
        """Parameters for this extinction, with the haze that explains the sum of ones before stripes."""
        shape = self.gain * np.exp(np.minimum(-2.0 * extinction_per_m * self.path_m, 50.0))
        shape, before = (each[:, ~self.behind] for each in (shape, self.exposures))
        rate = np.minimum(self.ones[:, ~self.behind].sum() / before.sum(), 0.999)
        level = -math.log1p(-rate) - float(np.average(self.ambient[:, ~self.behind], weights=before))
        return np.array([max(level, 0.0) / max(float(np.average(shape, weights=before)), 1e-9), extinction_per_m, 0, 0])

    def _light(self, value: Float64) -> tuple[Float64, Float64, Float64]:
        """Shape of the haze, the part of it that each cell sees, and the flux."""
        shape = self.gain * np.exp(np.minimum(-2.0 * value[1] * self.path_m, 50.0))
        part = np.where(self.behind, value[3], 1.0)
        return shape, part, np.clip(self.ambient + value[2] + value[0] * shape * part, FLUX_MIN, FLUX_MAX)

    def evidence(self, value: Float64) -> float:
        """Log-likelihood of the counts, with the weak prior."""
        flux = self._light(value)[2]
        likelihood = float(np.sum(self.ones * np.log(np.expm1(flux)) - self.exposures * flux))
        return likelihood - 0.5 * float(self.prior(value) @ value)

    def prior(self, value: Float64) -> Float64:
        """Negative slope of the weak prior's logarithm."""
        return np.array([0.0, 1e-3, 0.0, REST_PRIOR]) * value

    def slopes(self, value: Float64) -> tuple[Float64, Float64]:
        """Slope of each block's log-likelihood (blocks, 4), and the information (4, 4) with the prior's."""
        shape, part, flux = self._light(value)
        haze = value[0] * shape
        design = np.stack([shape * part, -2.0 * self.path_m * haze * part, np.ones_like(flux), haze * self.behind])
        odds = 1.0 / np.expm1(flux)
        score = np.einsum("igb,gb->gi", design, self.ones * (1.0 + odds) - self.exposures)
        information = np.einsum("igb,jgb,gb->ij", design, design, self.exposures * odds)
        return score, information + np.diag([1e-12, 1e-3, 0.0, REST_PRIOR])


VISIBILITY_CONTRAST: Final = 3.912
"""-ln(0.02): visibility is the distance at which contrast falls to 2 %, 3.912 / extinction (Koschmieder)."""
RESOLVED_SIGMAS: Final = 3.0
"""A quantity is stated if it is more than this many standard deviations above zero."""
CLEAR: Final = 0.85
CLEAR_PX: Final = 6.0
"""Least confidence of a clear row, and least distance in pixels between its stripe and the pixels that are read. A
higher confidence would bias the haze low, since with few exposures it is reached by chance; with a lower one stripes
count as haze."""
LEAST_LINES: Final = 30
"""Fewest clear rows, over all columns, for a reading."""
BLOCKS: Final = 4
"""Blocks along the rows, and along the columns."""
MODEL_SHARE: Final = 0.02
"""Relative error due to the model's form: bins, gains of rows and columns, one mean for two path lengths."""
REST_SHARE: Final = 1.0
"""Relative error of the extinction, divided by the share of light scattered more than once. In ray-traced isotropic fog
the decay is flatter by 25 to 40 % if `rest` is 0.35 to 0.45 (Mitsuba rows, docs/explanation/fog-meter.md)."""


@dataclass(frozen=True, slots=True)
class FogEstimate:
    """Fog and light of a map. A quantity that is not resolved is None.

    Names with `sd` are standard deviations; veil_to_signal has none.
    visibility_m: 3.912 / extinction. visibility_sd_m: half of the amount by which visibility grows if the extinction
    is smaller by two of its standard deviations.
    ambient_per_exposure: photons per pixel and exposure that are not the laser's (ambient light from surfaces and fog,
    dark counts), mean over the pixels read. veil_per_exposure: the laser's light that the medium sends back, per pixel
    just before the stripe, mean over the rows read. veil_to_signal: the veil divided by the light of those stripes.
    """

    extinction_per_m: float | None = None
    extinction_sd_per_m: float | None = None
    visibility_m: float | None = None
    visibility_sd_m: float | None = None
    ambient_per_exposure: float | None = None
    ambient_sd_per_exposure: float | None = None
    veil_per_exposure: float | None = None
    veil_sd_per_exposure: float | None = None
    veil_to_signal: float | None = None

    def brief(self) -> str:
        """The visibility with its error as a short text, empty if it is not resolved."""
        if self.visibility_m is None or self.visibility_sd_m is None:
            return ""
        return f"visibility {digits(self.visibility_m)} +- {digits(self.visibility_sd_m, 2)} m"


def read_fog(
    sweep: Any, stripe: StripeTable, geometry: SweepGeometry, state: Any, where: tuple[Int32, Int32] | None = None
) -> FogEstimate:
    """The fog of one map; all None if fewer than LEAST_LINES rows are clear, or if they show too little.

    With a halo or several lines, only ambient light is given, and only if there are dark frames.
    sweep: a `CountVolume`, or a sweep with `lines` of counts. stripe: its stripe table, made with the `RowModel`
    `state`. where: rows and columns of the lines of counts that are read from a `CountVolume`; None for
    `next_lattice`'s.
    """
    from rig.depth.kernels import SUMS, add_clear_rows
    from rig.estimate.row.em import lines_of, next_lattice
    from rig.estimate.row.inputs import state_of, sweep_of
    from rig.estimate.row.model import BINS

    whole = isinstance(sweep, CountVolume)
    lines: Lines = lines_of(sweep, where or next_lattice(geometry)) if whole else sweep.lines
    row, column = lines.row, lines.column
    clear = (stripe.confidence[row, column] > CLEAR) & (lines.exposures > 0)
    if np.count_nonzero(clear) < LEAST_LINES:
        return FogEstimate()
    block = row * BLOCKS // geometry.rows * BLOCKS + column * BLOCKS // geometry.columns
    sums, at_stripe = np.zeros((BLOCKS**2, 2, BINS, SUMS)), np.zeros((len(row), 2))
    hot_flux = state.hot_flux()
    add_clear_rows(
        sweep_of(replace(geometry, others=None)), state_of(state), lines, stripe.x_px[row, column], clear,
        block.astype(np.int32), CLEAR_PX, hot_flux, sums, at_stripe,
    )  # fmt: skip
    fit = fit_fog(sums, state.path_m())
    if fit is None:
        return FogEstimate()
    dark = _dark_offset(sweep, state.ambient, hot_flux)
    if state.halo.any() or geometry.others is not None:
        return _dark_alone(sums, dark)
    read = clear & (at_stripe[:, 1] > 0)
    signal = float(np.mean(stripe.signal[row, column][read])) if read.any() else math.nan
    return _stated(fit, sums, state.path_m(), dark, at_stripe[read], signal)


def _dark_offset(sweep: Any, ambient: Float32, hot_flux: float) -> tuple[float, float] | None:
    """Excess of dark frames over the learned ambient light, and its standard deviation; None without dark frames, or if
    none or all of their pixels fired."""
    if sweep.dark_counts is None:
        return None
    from rig.depth.kernels import sum_dark

    frames = sweep.dark_frames
    if frames is None:
        frames = np.full(ambient.shape[1], sweep.n_dark, np.int32)
    ones, exposures, light = sum_dark(sweep.dark_counts, frames, ambient, hot_flux)
    if ones < 1.0 or ones >= exposures:
        return None
    level = -math.log1p(-ones / exposures)
    return level - light / exposures, level / math.sqrt(ones)


def _dark_alone(sums: Float64, dark: tuple[float, float] | None) -> FogEstimate:
    """The ambient light alone, from dark frames: a halo or the haze of other lines disturbs everything else."""
    if dark is None:
        return FogEstimate()
    level = float(sums[..., 3].sum() / sums[..., 1].sum()) + dark[0]
    return FogEstimate(**_ambient(level, math.hypot(dark[1], MODEL_SHARE * level)))


def _ambient(level: float, sd: float) -> dict[str, float]:
    return {"ambient_per_exposure": level, "ambient_sd_per_exposure": sd} if level > RESOLVED_SIGMAS * sd else {}


def _stated(
    fit: FogFit, sums: Float64, path_m: Float64, dark: tuple[float, float] | None, at_stripe: Float64, signal: float
) -> FogEstimate:
    haze, extinction, offset, rest = fit.value
    sd = np.sqrt(np.diag(fit.covariance))
    exposures = sums[..., 1].sum()
    ambient, ambient_sd = float(sums[..., 3].sum() / exposures), float(sd[2])
    if dark is not None:
        # Laser light that is equally present on both sides of the stripe has been scattered more than once as well.
        level = np.average(haze * np.exp(-2.0 * extinction * (path_m - fit.at_m)), weights=sums[:, 0, :, 2].sum(0))
        rest = max(rest, 0.0) + max(float(offset) - dark[0], 0.0) / max(float(level), FLUX_MIN)
        offset, ambient_sd = dark[0], math.hypot(dark[1], MODEL_SHARE * (ambient + dark[0]))
    ambient += float(offset)
    extinction_sd = math.hypot(sd[1], MODEL_SHARE * extinction, REST_SHARE * max(rest, 0.0) * extinction)
    found: dict[str, float] = {}
    if extinction > RESOLVED_SIGMAS * extinction_sd:
        visibility_m, farther_m = (VISIBILITY_CONTRAST / float(extinction - n * extinction_sd) for n in (0.0, 2.0))
        found |= {"extinction_per_m": float(extinction), "extinction_sd_per_m": extinction_sd}
        # On the side of clear air, where the change is larger.
        found |= {"visibility_m": visibility_m, "visibility_sd_m": (farther_m - visibility_m) / 2.0}
    found |= _ambient(ambient, ambient_sd)
    if len(at_stripe):
        off_m, gain = at_stripe[:, 0] - fit.at_m, at_stripe[:, 1]
        shape = gain * np.exp(-2.0 * extinction * off_m)
        slope = np.array([shape.mean(), -2.0 * haze * np.mean(off_m * shape), 0.0, 0.0])
        veil = float(haze * shape.mean())
        veil_sd = math.hypot(float(np.sqrt(slope @ fit.covariance @ slope)), MODEL_SHARE * veil)
        if veil > RESOLVED_SIGMAS * veil_sd:
            found |= {"veil_per_exposure": veil, "veil_sd_per_exposure": veil_sd}
            found |= {"veil_to_signal": veil / signal} if signal > 0 else {}
    return FogEstimate(**found)
