"""The genie: the row likelihood that is told haze, ambient, line width, geometry and the scene's albedo histogram.

Hypothesis j: haze before j, half of it at j, behind it the pedestal if there is one (`Light.pedestal`), and a Gaussian
stripe centred on j whose amplitude follows from the plane's depth at j, the extinction and an albedo drawn from the
histogram. With counts n of K exposures

    log L(j, albedo) = sum_x n_x log(expm1 flux_x) - K flux_x

summed over albedos, the most probable j wins and is refined by the posterior-weighted mean of its neighbours.
The genie may not know: the truth's sub-pixel place, the albedo of a pixel, which rows have no stripe.
About 2-4 s per map of 500 columns on two free cores.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from tests.reference import kernels
from tests.reference.geometry import DEPTH_RANGE_M
from tests.reference.working_point import WorkingPoint, over_columns

ALBEDO_BINS = 16  # 12 to 64 agree within 0.5 % on the prepared scenes
TABLE_SIZE = 1 << 16
TABLE_FLUX = 40.0  # photons; above it log(expm1 flux) = flux to 1e-17
EXACT_BELOW = 4e-4  # photons; below it the table's interpolation is no longer good to 1e-5
COARSE_STEP = 4  # every 4th albedo in the first pass
LEFT_OUT_NATS = 14.0  # a hypothesis this far below the best after the first pass is dropped (weight below 1e-5)


@dataclass(frozen=True, slots=True)
class Genie:
    """A genie of `labels` hypotheses per pixel (1: integer), refined over `mean_reach` labels on each side.

    profile_reach: px of the stripe on each side.
    """

    labels: int = 1
    mean_reach: int = 2
    profile_reach: int = 2

    def estimate(
        self, point: WorkingPoint, counts: NDArray[np.unsignedinteger], exposures: int, rows: slice = slice(None)
    ) -> NDArray[np.float32]:
        """Stripe position (H, columns) in px from counts (columns, H, W); NaN off `rows` or with an empty window."""
        g, light = point.geometry, point.light
        strengths, weights = albedo_histogram(point, ALBEDO_BINS)
        x_est = np.full((g.height, g.columns), np.nan, np.float32)
        wanted = np.arange(g.height)[rows]
        table = log_expm1_table()
        shares, lit = label_profiles(self.labels, self.profile_reach, light.sigma_px)

        def work(first: int, end: int) -> None:
            estimate_columns(
                counts, exposures, wanted, point.optics, light.ambient, point.stripe_scale * strengths, np.log(weights),
                shares, lit, light.pedestal, self.mean_reach, table, first, end, x_est,
            )  # fmt: skip

        over_columns(g.columns, work)
        return x_est


def albedo_histogram(point: WorkingPoint, bins: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and share of each non-empty logarithmic bin of the scene's albedo."""
    values = point.strength[point.strength > 1e-4]
    edges = np.geomspace(values.min() * (1 - 1e-9), values.max() * (1 + 1e-9), bins + 1)
    total, _ = np.histogram(values, edges, weights=values)
    number, _ = np.histogram(values, edges)
    kept = number > 0
    return total[kept] / number[kept], number[kept] / values.size


def label_profiles(labels: int, reach: int, sigma_px: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Per label: share of the stripe (labels, 2 reach + 1) and lit share of the haze (in order from the near side)."""
    offset = (np.arange(labels) + 0.5) / labels - 0.5
    k = np.arange(-reach, reach + 1)
    scale = 1 / (sigma_px * math.sqrt(2))
    erf = np.vectorize(math.erf)
    gap = k[None, :] - offset[:, None]
    return 0.5 * (erf((gap + 0.5) * scale) - erf((gap - 0.5) * scale)), np.clip(0.5 - gap, 0, 1)


def log_expm1_table() -> NDArray[np.float64]:
    """log(expm1 t^2) for t = sqrt(flux) on an even grid; entry 0 repeats entry 1."""
    flux = np.linspace(0, math.sqrt(TABLE_FLUX), TABLE_SIZE + 1) ** 2
    flux[0] = flux[1]
    return np.log(np.expm1(flux))


@numba.njit(cache=True, nogil=True)
def log_expm1(flux, table):  # type: ignore[no-untyped-def]
    """log(expm1 flux) by interpolation in sqrt(flux); exact below EXACT_BELOW."""
    if flux >= TABLE_FLUX:
        return flux
    if flux < EXACT_BELOW:
        return math.log(math.expm1(flux))
    t = math.sqrt(flux) * (TABLE_SIZE / math.sqrt(TABLE_FLUX))
    i = int(t)
    return table[i] + (t - i) * (table[i + 1] - table[i])


@numba.njit(cache=True, nogil=True)
def estimate_columns(  # type: ignore[no-untyped-def]
    counts,
    exposures,
    rows,
    optics,
    ambient,
    strengths,
    log_weights,
    shares,
    lit,
    pedestal,
    mean_reach,
    table,
    first,
    end,
    x_est,
):
    """Fill x_est (H, columns) for columns first..end on the given rows. pedestal: share of the haze."""
    u, v, planes, scanner = optics.u, optics.v, optics.planes, optics.scanner
    extinction, haze_scale = optics.extinction, optics.haze
    inv_near, inv_far = 1 / DEPTH_RANGE_M[0], 1 / DEPTH_RANGE_M[1]
    width = u.shape[1]
    labels, taps = shares.shape
    reach = taps // 2
    number = strengths.size
    dark = log_expm1(ambient, table)
    inverse, haze, near_sum, amplitude = np.empty(width), np.empty(width), np.empty(width + 1), np.empty(width)
    behind, decay_px = np.empty(width), optics.halo_px[1]
    coarse, posterior, values = np.empty(width * labels), np.empty(width * labels), np.empty(number)
    for c in range(first, end):
        n0, n1, n2, d = planes[c]
        forward = n0 / d < 0
        for y in rows:
            # positions run from the near side: place i is pixel i or width - 1 - i
            start, stop = width, 0
            for i in range(width):
                x = i if forward else width - 1 - i
                inverse[i] = (n0 * u[y, x] + n1 * v[y, x] + n2) / d
                if inv_far <= inverse[i] <= inv_near:
                    start = min(start, i)
                    stop = max(stop, i + 1)
            if start >= stop:
                continue
            low, high = max(0, start - reach), min(width, stop + reach)
            near_sum[low] = 0.0
            for i in range(low, high):
                x = i if forward else width - 1 - i
                haze[i] = haze_scale * kernels.haze_at(u[y, x], v[y, x], inverse[i], scanner, extinction)
                gain = -exposures * haze[i]
                if counts[c, y, x] > 0:
                    gain += counts[c, y, x] * (log_expm1(ambient + haze[i], table) - dark)
                near_sum[i + 1] = near_sum[i] + gain
            best = -np.inf
            for j in range(start, stop):
                x = j if forward else width - 1 - j
                z = 1.0 / inverse[j]
                path = kernels.path_length(u[y, x], v[y, x], z, scanner)
                amplitude[j] = math.exp(-extinction * path) / (z * z)
                behind[j] = 0.0
                for i in range(j + reach + 1, high if pedestal > 0.0 else 0):
                    x = i if forward else width - 1 - i
                    flux = pedestal * haze[j] * math.exp(-(i - j) / decay_px)
                    behind[j] -= exposures * flux
                    if counts[c, y, x] > 0:
                        behind[j] += counts[c, y, x] * (log_expm1(ambient + flux, table) - dark)
            for sweep in range(2):
                for j in range(start, stop):
                    for m in range(labels):
                        slot = j * labels + m
                        if sweep == 1 and coarse[slot] < best - LEFT_OUT_NATS:
                            posterior[slot] = -np.inf
                            continue
                        stride = COARSE_STEP if sweep == 0 else 1
                        top = -np.inf
                        base = near_sum[max(low, j - reach)] + behind[j]
                        for r in range(stride // 2, number, stride):
                            s = strengths[r] * amplitude[j]
                            total = base
                            for k in range(taps):
                                i = j - reach + k
                                if i < low or i >= high:
                                    continue
                                x = i if forward else width - 1 - i
                                flux = haze[i] * lit[m, k] + s * shares[m, k]
                                flux += (1 - lit[m, k]) * pedestal * haze[j] * math.exp(-max(i - j, 0) / decay_px)
                                total -= exposures * flux
                                if counts[c, y, x] > 0:
                                    total += counts[c, y, x] * (log_expm1(ambient + flux, table) - dark)
                            values[r] = total + log_weights[r]
                            top = max(top, values[r])
                        if sweep == 0:
                            coarse[slot] = top
                            best = max(best, top)
                            continue
                        mass = 0.0
                        for r in range(number):
                            if values[r] > top - 20.0:
                                mass += math.exp(values[r] - top)
                        posterior[slot] = top + math.log(mass)
            chosen = start * labels
            for slot in range(start * labels, stop * labels):
                if posterior[slot] > posterior[chosen]:
                    chosen = slot
            mass, moment = 0.0, 0.0
            for slot in range(max(start * labels, chosen - mean_reach), min(stop * labels, chosen + mean_reach + 1)):
                weight = math.exp(posterior[slot] - posterior[chosen])
                mass += weight
                moment += weight * (slot - chosen)
            place = (chosen + moment / mass + 0.5) / labels - 0.5
            x_est[y, c] = place if forward else width - 1 - place
