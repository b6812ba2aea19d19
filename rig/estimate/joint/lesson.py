"""Reads a map's answers and what can be learned from them, compiled: positions, trust in each, and the counts of quiet
pixels, which lie behind a stripe and show the ambient light.

When the model is learned from the first map, each answer counts with a trust (`fill_trust`, float32 (rows, columns)):

    trust = erf(3 px / (sqrt 2 sd)) / (1 + exp(A - B margin)) / (1 + C z^-D)

with the margin in cost divided by UNITS. This is a simpler form of the confidence of `rig.estimate.joint.confidence`,
with other constants. z takes the place of contrast': the light of the stripe above the mean of the haze before and
behind it, divided by its noise, both pooled over neighbours. Other terms are left out. The answer need only be on the
right surface, within 3 px. Lessons from later maps use the confidence of the stripe table: the model is known by then.

B, C and D are fitted by maximum likelihood to lessons on random scenes of a second simulator, in clear air, thin and
dense fog, under a halo and with hot pixels at 1 to 10 exposures; answers where there is no stripe counted as wrong. A
is half of its fitted value, because too little trust makes a worse model: an answer without trust is judged by its own
row alone, and it is the answers with too little trust that show what the model does not know yet.
"""

import math
from typing import Final

import numba
import numpy as np

from rig.count.volume import Counts
from rig.estimate.joint.labels.grid import PER_PX
from rig.estimate.joint.place.places import LIGHT_PX, Places, most_shown
from rig.estimate.joint.winner import UNITS, LabelAnswers
from rig.estimate.row.inputs import RowState, Sweep, fluxes_at, fluxes_of, line_light, others_at
from rig.estimate.row.likelihood import FLUX_MAX
from rig.geometry.kernels import with_rays
from rig.simd import Float32, Float64, Int32, Uint8

SURFACE_PX: Final = 3.0
A: Final = 1.25
B: Final = 0.608
LOG_C: Final = -2.43
D: Final = 1.427
POOLED: Final = 25.0
"""Number of answers over which light is assumed to be pooled: about half of the neighbours lie on the same surface."""
LEAST_Z: Final = 0.05
"""Least z, for a stripe that shows no light."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_trust(
    x_px: Float32, sd_px: Float32, n_frames: Int32, margin: Uint8, places: Places, ambient: float, first_row: int,
    last_row: int, trust: Float32,
) -> None:  # fmt: skip
    """Fill trust (rows, columns), 0 to 1, of rows first_row..last_row-1; 0 where x_px is NaN.

    margin: of `LabelAnswers`. ambient: usual ambient light, photons per exposure and pixel.
    """
    amplitudes, scales, hazes = places.amplitude, places.scale, places.haze
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            trust[y, c] = 0.0
            if np.isnan(x_px[y, c]):
                continue
            exposures = max(n_frames[c], 1) * POOLED
            light = max(amplitudes[y, c] * scales[y, c], 0.0)
            noise = light + (hazes[y, c] + 2.0 * ambient) * (LIGHT_PX + 0.5) + 1.0 / exposures
            square = max(light * light * exposures / noise, LEAST_Z**2)
            dark = math.exp(LOG_C - 0.5 * D * math.log(square))
            rival = math.exp(A - B / UNITS * margin[y, c])
            within = math.erf(SURFACE_PX / (max(sd_px[y, c], 1e-3) * math.sqrt(2.0)))
            trust[y, c] = within / ((rival + 1.0) * (dark + 1.0))


QUIET_REACH_PX: Final = 8
"""Pixels more than this behind a clear stripe show nothing of it."""
QUIET: Final = 0.9
"""Confidence from which a stripe is clear."""


@numba.njit(cache=True, nogil=True)
def read_positions(
    x_far: Float64, n_frames: Int32, side: int, width: int, answer: LabelAnswers, first_row: int, last_row: int,
    x_px: Float32, distance: Float32,
) -> None:  # fmt: skip
    """Fill x_px (rows, columns) from the answers' labels, and distance = x_px - x_far; NaN where nothing is searched or
    a column has no frames.

    An answer beyond the middle of the first or last of `width` pixels gets margin 0 in `answer`. A stripe outside the
    picture has no label and leaves the row dark. In a dark row the outermost label seems far better than all others.
    """
    label, margin, nothing = answer.label, answer.margin, np.float32(np.nan)
    for y in range(first_row, last_row):
        for c in range(x_far.shape[1]):
            off = -side * label[y, c] / PER_PX if n_frames[c] > 0 else nothing
            x = x_far[y, c] + off
            x_px[y, c], distance[y, c] = x, off if np.isfinite(x_far[y, c]) else nothing
            if x < 0.0 or x > width - 1.0:
                margin[y, c] = 0


@numba.njit(cache=True, nogil=True)
def add_quiet(
    counts: Counts, n_frames: Int32, sweep: Sweep, state: RowState, halo: Float32, x_px: Float32, signal: Float32,
    confidence: Float32, column_step: int, most_light: float, first_row: int, last_row: int, quiet: Float64,
) -> None:  # fmt: skip
    """Add to quiet (2, rows, width) the ones and exposures of pixels behind clear stripes, every column_step columns.

    Pixels without a ray are left out. halo: (BINS, pixels) of `halo_shares`, without pixels if there is no halo. Under
    a halo, the expected light of halo and haze behind a stripe of `signal` photons is subtracted from the ones. Pixels
    where it exceeds `most_light`, photons per exposure, are left out. So are stripes that saturate their pixels: their
    halo is brighter than expected, and the excess would be taken for ambient light.
    """
    width, several = sweep.u.shape[1], sweep.others.shape[1] > 0
    # Local names: each use of a tuple in the loop would count references to all of its arrays.
    u, v, ambient, profile, w_lo, per_w = sweep.u, sweep.v, state.ambient, state.profile, state.w_lo, state.per_w
    for y in range(first_row, last_row):
        for c in range(0, x_px.shape[1], column_step):
            if not confidence[y, c] > QUIET or sweep.x_lo[y, c] > sweep.x_hi[y, c]:
                continue
            if halo.shape[1] > 0 and signal[y, c] * state.psi[0] > most_shown(n_frames[c]):
                continue
            x, x0 = int(np.rint(x_px[y, c])), sweep.x0[c]
            begin, end = x0, min(x0 + sweep.window, width)
            if sweep.near_is_left:
                begin = max(begin, x + QUIET_REACH_PX + 1)
            else:
                end = min(end, x - QUIET_REACH_PX)
            if begin >= end:
                continue
            begin, last = with_rays(sweep.u, y, begin, end - 1)
            end = last + 1 if not np.isnan(sweep.u[y, last]) else begin
            if halo.shape[1] == 0 or begin == end:
                for t in range(begin, end):
                    quiet[0, y, t] += counts[c, y, t - x0]
                    quiet[1, y, t] += n_frames[c]
                continue
            at = min(max(x, sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, at)
            _, _, _, _, _, cell, _ = fluxes_at(sweep, state, y, at, c, path_p, strength)
            plane = sweep.plane[c, 0], sweep.plane[c, 1], sweep.plane[c, 2]
            for t in range(begin, end):
                own = ambient[y, t]
                _, behind, _, _, _, _ = fluxes_of(plane, u[y, t], v[y, t], own, profile, w_lo, per_w, path_p, strength)
                if several:
                    behind = min(behind + others_at(sweep, state, y, c, t), FLUX_MAX)
                total = behind + signal[y, c] * halo[cell, min(abs(t - x), halo.shape[1] - 1)]
                if total - own > most_light:
                    continue
                quiet[0, y, t] += counts[c, y, t - x0] - n_frames[c] * (np.exp(-own) - np.exp(-total))
                quiet[1, y, t] += n_frames[c]
