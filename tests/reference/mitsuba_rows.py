"""Rows of the scene of `tests.reference.photon_tracer` by Mitsuba 3 (mitsuba-renderer.org), all orders of scattering.

`volpath` follows light from the camera and connects every vertex to the projector. In fog that scatters forward most of
a row's light is in rare bright paths, so its mean comes slowly from below: means of many pixels only. To meet the lit
column more often, it is `COLUMN_PX` wide. Mitsuba's x axis points left, so the scene is mirrored.
"""

from collections.abc import Sequence
from typing import Any

import mitsuba
import numpy as np
from numpy.typing import NDArray

from tests.reference.photon_tracer import BEHIND, FOCAL, WIDTH

mitsuba.set_variant("scalar_rgb")

Array = NDArray[np.float64]
COLUMN_PX, BIN_PX, BAND_BINS = 4, 5, 16
"""Rows come in bins of so many pixels, as means of so many rows of bins around the middle: +-0.144 in tangents."""
FIELD = {"fov": 60.0, "medium": {"type": "ref", "id": "fog"}}
MOST_VERTICES = 65


def mitsuba_rows(
    lobes: Sequence[tuple[float, float]],
    tau: float,
    tangent: float,
    baseline: float,
    albedo: float,
    samples: int,
    seeds: Sequence[int],
) -> Array:
    """Radiance (seeds, bins) for 1 W/m^2 on the plane z = 1 and a column 1 px wide, direct stripe included."""
    scene = _scene(lobes, tau, tangent, baseline, albedo)
    # In clear air a stripe's light is known; it gives Mitsuba's unit.
    clear = _render(_scene(lobes, 1e-6, tangent, baseline, albedo), 64, 0).sum()
    unit = albedo / np.pi / BIN_PX / clear
    return np.array([unit * _render(scene, samples, seed) for seed in seeds])


def _render(scene: Any, samples: int, seed: int) -> Array:
    picture = np.array(mitsuba.render(scene, spp=samples, seed=seed), np.float64)
    row: Array = picture[..., 0].mean(axis=0)
    return row


def _scene(lobes: Sequence[tuple[float, float]], tau: float, tangent: float, baseline: float, albedo: float) -> Any:
    at, column = mitsuba.ScalarTransform4f(), np.zeros((WIDTH, WIDTH, 3), np.float32)
    first = round(tangent * FOCAL + WIDTH / 2 - COLUMN_PX / 2)
    column[:, first : first + COLUMN_PX] = 1.0
    phases = [{"type": "hg", "g": g} if g else {"type": "isotropic"} for _, g in lobes]
    blend = {"type": "blendphase", "weight": lobes[-1][0], "of_0": phases[0], "of_1": phases[-1]}
    bins = WIDTH // BIN_PX
    return mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": MOST_VERTICES, "rr_depth": 30},
            "fog": {
                "type": "homogeneous",
                "albedo": {"type": "rgb", "value": [1.0] * 3},
                "sigma_t": {"type": "rgb", "value": [tau] * 3},
                "phase": phases[0] if len(lobes) == 1 else blend,
            },
            "box": {
                "type": "cube",
                "to_world": at.translate([0, 0, 0.55 - BEHIND / 2]) @ at.scale([10, 10, 0.55 + BEHIND / 2]),
                "bsdf": {"type": "null"},
                "interior": {"type": "ref", "id": "fog"},
            },
            "wall": {
                "type": "rectangle",
                "to_world": at.translate([0, 0, 1]) @ at.rotate([0, 1, 0], 180) @ at.scale([9, 9, 1]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}},
            },
            "projector": {
                "type": "projector",
                "irradiance": {
                    "type": "bitmap",
                    "bitmap": mitsuba.Bitmap(column),
                    "raw": True,
                    "filter_type": "nearest",
                    "wrap_mode": "clamp",
                },
                "to_world": at.look_at(origin=[baseline, 0, 0], target=[baseline, 0, 1], up=[0, 1, 0]),
                **FIELD,
            },
            "camera": {
                "type": "perspective",
                "to_world": at.look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": bins,
                    "height": bins,
                    "crop_offset_x": 0,
                    "crop_offset_y": (bins - BAND_BINS) // 2,
                    "crop_width": bins,
                    "crop_height": BAND_BINS,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
                "sampler": {"type": "independent"},
                **FIELD,
            },
        }
    )
