"""One map as the page shows it: points with colours, pictures, and the figures of the pixel under the cursor."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import evenly_spread
from rig.run_folder.pictures import (
    CONFIDENCE_SCALE,
    Scale,
    cloud,
    depth_limits,
    depth_scale,
    doubt,
    intensity_picture,
    ply_bytes,
    png_bytes,
)
from rig.simd import Bools, Float32

COLOURS: Final = ("depth", "confidence", "signal", "counts")
"""Values by which points are coloured."""
NEAR_PX: Final = 3.0
"""A stripe this close to the cursor is the one that is meant, if it is one of those that make the depth."""
LEGEND: Final = 16
"""Colours of the legend."""
Limits = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ShownMap:
    """A map. Arrays of pixels are (rows, width); each may be None if the run does not have it.

    number: that of the map in its run. depth_m, confidence, depth_sd_m: float32, as in `rig.depth.depth.DepthMap`.
    counts: summed over the sweep, float32, NaN where unknown. picture_of_counts: a PNG file of the counts, if there is
    one. rays: (u, v), NaN where unknown. stripe: arrays (rows, columns) of the stripe table by name. about: more about
    the map, such as `min_confidence`, `doubts` and `fog`.
    """

    number: int
    stripe: Mapping[str, Float32]
    depth_m: Float32 | None = None
    confidence: Float32 | None = None
    depth_sd_m: Float32 | None = None
    counts: Float32 | None = None
    picture_of_counts: bytes | None = None
    rays: tuple[Float32, Float32] | None = None
    about: Mapping[str, Any] = field(default_factory=dict)

    def kept(self, least_confidence: float) -> Bools | None:
        """Pixels with a depth of at least this confidence, bool (rows, width); all with a depth if confidence is not
        known. None without depth."""
        if self.depth_m is None:
            return None
        known = np.isfinite(self.depth_m)
        return known if self.confidence is None else known & (self.confidence >= np.float32(least_confidence))

    def column_at(self, row: int, x: int) -> int | None:
        """The column whose stripe is nearest to a pixel; None if the row has no stripe. Stripes whose confidence is
        high enough to have made the depth are preferred, if one is within NEAR_PX."""
        x_px = self.stripe.get("x_px")
        if x_px is None or not 0 <= row < len(x_px):
            return None
        away = np.abs(x_px[row] - np.float32(x))
        if not np.isfinite(away).any():
            return None
        sure = self.stripe["confidence"][row] >= np.float32(self.about.get("min_confidence") or 0.5)
        trusted = np.where(sure, away, np.inf)
        best = int(np.nanargmin(trusted)) if np.isfinite(trusted).any() else -1
        return best if best >= 0 and trusted[best] <= NEAR_PX else int(np.nanargmin(away))

    def pixel(self, row: int, x: int) -> dict[str, float | None]:
        """Depth, its error and confidence, and counts of a pixel; None for what is not known."""
        found: dict[str, float | None] = {}
        for name in ("depth_m", "depth_sd_m", "confidence", "counts"):
            array = getattr(self, name)
            inside = array is not None and 0 <= row < array.shape[0] and 0 <= x < array.shape[1]
            value = float(array[row, x]) if inside else np.nan
            found[name] = value if np.isfinite(value) else None
        if found["depth_m"] is None:
            found["confidence"] = None
        return found

    def stripe_at(self, row: int, column: int) -> dict[str, float | None]:
        """The stripe table's values of one column on one row; None for each that is not finite."""
        values = {name: float(array[row, column]) for name, array in self.stripe.items()}
        return {name: value if np.isfinite(value) else None for name, value in values.items()}

    def signal(self) -> Float32 | None:
        """Photons per exposure of the stripe nearest to each pixel with a depth, float32 (rows, width), else NaN."""
        if self.depth_m is None or "signal" not in self.stripe:
            return None
        return at_pixels(self.stripe, "signal", self.depth_m, self.about.get("min_confidence"))


def at_pixels(stripe: Mapping[str, Float32], name: str, depth_m: Float32, min_confidence: float | None) -> Float32:
    """A value of the stripe table at each pixel with a depth, float32 (rows, width), else NaN: that of the nearest
    stripe on its row with at least `min_confidence` (None: 0.5)."""
    x_px, values = stripe["x_px"], stripe[name]
    sure = np.isfinite(x_px) & (stripe["confidence"] >= np.float32(min_confidence or 0.5))
    known = np.isfinite(depth_m)
    out = np.full(depth_m.shape, np.nan, np.float32)
    for row in np.flatnonzero(known.any(axis=1) & sure.any(axis=1)):
        order = np.argsort(x_px[row, sure[row]])
        places, pixels = x_px[row, sure[row]][order], np.flatnonzero(known[row])
        nearest = np.searchsorted((places[1:] + places[:-1]) / 2, pixels)
        out[row, pixels] = values[row, sure[row]][order][nearest]
    return out


class Legend(NamedTuple):
    """A colour scale. rgb: uint8 (LEGEND, 3), colours from one end to the other. ends: texts at both."""

    rgb: NDArray[np.uint8]
    ends: tuple[str, str]

    @classmethod
    def of(cls, scale: Scale) -> "Legend":
        """The legend of a scale."""
        if scale.labels:  # from the first label to the last
            (first, first_text), (last, last_text) = scale.labels[0], scale.labels[-1]
            return cls(scale.colours(np.geomspace(first, last, LEGEND)), (first_text, last_text))
        low, high = sorted((scale.bright, scale.dark))
        return cls(scale.colours(np.linspace(low, high, LEGEND)), (f"{low:.3g}", f"{high:.3g} {scale.unit}".rstrip()))


class ColouredPoints(NamedTuple):
    """Points of a map. xyz_m: float32 (n, 3), in the camera's frame. rgb: uint8 (n, 3). of: their number before they
    were thinned. legend: None if the map has no values for colours; points are grey then."""

    xyz_m: Float32
    rgb: NDArray[np.uint8]
    of: int
    legend: Legend | None


def points(
    shown: ShownMap, by: str, least_confidence: float, most: int, limits: Limits | None
) -> ColouredPoints | None:
    """At most `most` points of a map, spread evenly over its pixels, in colours. None if there are none.

    by: one of COLOURS. limits: depths in m at the ends of the colours, if points are coloured by depth.
    """
    kept = shown.kept(least_confidence)
    if kept is None or shown.depth_m is None or shown.rays is None:
        return None
    u, v = shown.rays
    pixels = np.flatnonzero(kept & np.isfinite(u) & np.isfinite(v))
    if not len(pixels):
        return None
    chosen = pixels[evenly_spread(len(pixels), most)]
    z = shown.depth_m.reshape(-1)[chosen]
    xyz = np.stack([u.reshape(-1)[chosen] * z, v.reshape(-1)[chosen] * z, z], axis=1).astype(np.float32)
    values, scale = _scaled(shown, by, limits)
    if values is None:
        return ColouredPoints(xyz, np.full((len(chosen), 3), 128, np.uint8), len(pixels), None)
    return ColouredPoints(xyz, scale.colours(values.reshape(-1)[chosen]), len(pixels), Legend.of(scale))


def _scaled(shown: ShownMap, by: str, limits: Limits | None) -> tuple[NDArray[np.floating] | None, Scale]:
    """Values by which points are coloured, (rows, width), and their scale: that of the picture, if there is one. None
    if the map has no such values."""
    if by == "depth":
        return shown.depth_m, depth_scale(limits)
    if by == "confidence":
        return None if shown.confidence is None else doubt(shown.confidence), CONFIDENCE_SCALE
    values = shown.signal() if by == "signal" else shown.counts
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    low, high = (float(value) for value in np.percentile(known, [1, 99])) if known.size else (0.0, 0.0)
    unit = "photons per exposure" if by == "signal" else "counts"
    return values if known.size else None, Scale(max(high, low + 1e-6), low, unit, "inferno")


class Drawn(NamedTuple):
    """A picture. png: the file; each of its pixels is one of the map. legend: None for grey pictures."""

    png: bytes
    legend: Legend | None


def picture_of(shown: ShownMap, what: str, least_confidence: float, limits: Limits | None) -> Drawn | None:
    """A picture of 'depth', 'counts' or 'confidence'; None if the map has no such values. Depth and confidence are
    shown where confidence is at least `least_confidence`. limits: as in `points`."""
    if what == "counts":
        png = shown.picture_of_counts
        if png is None and shown.counts is not None:
            png = png_bytes(intensity_picture(shown.counts.astype(np.uint32)))
        return None if png is None else Drawn(png, None)
    kept = shown.kept(least_confidence)
    values, scale = _scaled(shown, what, limits)
    if kept is None or values is None or not kept.any():
        return None
    return Drawn(png_bytes(scale.colours(np.where(kept, values, np.nan))), Legend.of(scale))


def ply_of(shown: ShownMap, least_confidence: float) -> bytes | None:
    """All points of a map of at least this confidence as a PLY file, with 0 for unknown counts; None without depth or
    rays."""
    kept = shown.kept(least_confidence)
    if kept is None or shown.depth_m is None or shown.rays is None:
        return None
    depth_m = np.where(kept, shown.depth_m, np.float32(np.nan))
    counts = np.nan_to_num(shown.counts if shown.counts is not None else np.zeros(depth_m.shape)).astype(np.uint32)
    return ply_bytes(cloud(depth_m, *shown.rays, counts))


def steady_limits(before: Limits | None, depth_m: Float32 | None) -> Limits | None:
    """Limits of the colours of depth: those before, while they still suit the map, so that colours do not flicker."""
    now = None if depth_m is None else depth_limits(depth_m)
    if before is None or now is None:
        return now if before is None else before
    allowed = 0.2 * (before[1] - before[0])
    return before if abs(now[0] - before[0]) < allowed and abs(now[1] - before[1]) < allowed else now
