"""Pictures and point clouds of maps: depth and confidence in colour with a scale, counts in grey, and PLY files.

Pictures are for people; the numbers are in the .npy files. A picture is uint8, grey (rows, width) or RGB (rows, width,
3). The colours of a `Scale` get darker from one end to the other, so they can be read by the colour-blind and from a
grey print. Black is darker than all of them and always means that there is no value.

Point clouds are binary PLY, little endian: x y z in metres in the camera's frame, and the intensity of each pixel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import WORD_PX
from rig.run_folder.map_files import LARGEST

Picture = NDArray[np.uint8]
"""Grey (rows, width) or RGB (rows, width, 3)."""
SCALE_PX = 74
"""Width of the strip beside a picture that holds its scale."""
_BAR_PX = 14
_TEXT_HEIGHT_PX = 10
_LABELS = 6
_LEGEND_ROWS = 100
"""Pictures with fewer rows than this have no room for the sample of 'no value' below the scale."""
_PAPER, _INK = (255, 255, 255), (51, 64, 77)
NO_VALUE: Final = (0, 0, 0)
"""Colour of pixels without a value."""
Palette = Literal["viridis", "cividis", "inferno"]
"""Colour maps whose lightness rises from end to end: viridis (van der Walt and Smith 2015), cividis (Nunez and others
2018) and inferno. The first two look much alike to people with normal and with red-green deficient sight."""
_DARKEST: Final[dict[Palette, int]] = {"viridis": 48, "cividis": 48, "inferno": 90}
"""Level of each colour map, of 0 to 255, with which scales begin: their lightness L* is 28 or more, that of black 0."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Colours of values from `bright` to `dark`, the values at the upper and the lower end of the scale.

    unit: written behind the labels. palette: the colour map. absent: short name of pixels without a value. log: whether
    the scale is logarithmic; both ends are then above 0. labels: values and texts to write, instead of round values.
    steps: number of different colours; with fewer colours a PNG file is smaller. falling: whether the labels fall where
    the values rise, as confidence does over doubt.
    """

    bright: float
    dark: float
    unit: str = ""
    palette: Palette = "viridis"
    absent: str = "none"
    log: bool = False
    labels: Sequence[tuple[float, str]] = ()
    steps: int = 255
    falling: bool = False

    def colours(self, values: NDArray[np.floating]) -> Picture:
        """RGB, uint8 (..., 3), of values (...); `NO_VALUE` for NaN. Values beyond an end have that end's colour."""
        import cv2

        values = np.asarray(values, np.float32)
        share = self._share(values)
        if self.steps < 255:
            share = np.minimum(np.floor(share * self.steps), self.steps - 1) / np.float32(self.steps - 1)
        # NaN stays NaN in `clip`, and is nothing that a level can be made of.
        levels = np.nan_to_num(np.clip(share, 0, 1, out=share) * np.float32(254) + np.float32(1.5)).astype(np.uint8)
        table = _palette(self.palette)[:, None]
        flat = cv2.applyColorMap(np.ascontiguousarray(levels.reshape(-1, 1)), table)
        return np.asarray(flat, np.uint8).reshape(*values.shape, 3)

    def picture(self, values: NDArray[np.floating]) -> Picture:
        """The colours of values (rows, width), with the scale at the right: RGB (rows, width + SCALE_PX, 3)."""
        import cv2

        rows, width = values.shape
        picture = np.empty((rows, width + SCALE_PX, 3), np.uint8)
        picture[:, :width], picture[:, width:] = self.colours(values), _PAPER
        top, bottom = min(12, rows // 8), max(rows - 12, rows - rows // 8)
        left = width + 8

        def write(text: str, y: int) -> None:
            at = (left + _BAR_PX + 6, min(max(y + _TEXT_HEIGHT_PX // 2, _TEXT_HEIGHT_PX), rows - 2))
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)

        if rows >= _LEGEND_ROWS:
            picture[bottom - _BAR_PX : bottom, left : left + _BAR_PX] = NO_VALUE
            write(self.absent, bottom - _BAR_PX // 2)
            bottom -= 2 * _BAR_PX
        shares = np.linspace(1, 0, bottom - top)
        picture[top:bottom, left : left + _BAR_PX] = _palette(self.palette)[
            1 + np.round(254 * shares).astype(int), None
        ]
        for share, text in self.marks(min(_LABELS, max(1, rows // 40))):
            y = top + round((1 - share) * (bottom - top - 1))
            cv2.line(picture, (left + _BAR_PX, y), (left + _BAR_PX + 3, y), _INK, 1)
            write(text, y)
        return picture

    def bar(self) -> Picture:
        """All colours of the scale in one line, from the smallest label to the largest one: RGB (1, 255, 3)."""
        shares = np.linspace(0, 1, 255) if self.brighter else np.linspace(1, 0, 255)
        low, high = (math.log(end) if self.log else end for end in (self.dark, self.bright))
        values = low + shares * (high - low)
        return self.colours(np.exp(values) if self.log else values)[None]

    @property
    def brighter(self) -> bool:
        """Whether colours get brighter from the smallest label to the largest one."""
        return (self.bright > self.dark) != self.falling

    def marks(self, most: int = _LABELS) -> list[tuple[float, str]]:
        """Labels of the scale: the place of each, from 0 at `dark` to 1 at `bright`, and its text.

        most: greatest number of labels on a linear scale without labels of its own.
        """
        return [(float(self._share(np.array(value))), text) for value, text in self.labels or self._round_labels(most)]

    def _share(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Place of values on the scale, 0 at `dark` and 1 at `bright`."""
        if self.log:
            per_e = 1 / math.log(self.bright / self.dark)
            return np.asarray(np.log(np.maximum(values, np.float32(1e-30)) / self.dark) * per_e)
        return np.asarray((values - self.dark) / (self.bright - self.dark))

    def _round_labels(self, most: int) -> list[tuple[float, str]]:
        low, high = sorted((self.bright, self.dark))
        if self.log:
            powers = range(int(np.ceil(np.log10(low))), int(np.floor(np.log10(high))) + 1)
            return [(10.0**power, f"{10.0**power:g} {self.unit}".rstrip()) for power in powers]
        return [(value, f"{value:.4g} {self.unit}".rstrip()) for value in round_values(low, high, most)]


@cache
def _palette(name: Palette) -> Picture:
    """RGB (256, 3) from dark to bright; the first entry is `NO_VALUE`."""
    import cv2

    code = {"viridis": cv2.COLORMAP_VIRIDIS, "cividis": cv2.COLORMAP_CIVIDIS, "inferno": cv2.COLORMAP_INFERNO}[name]
    levels = np.linspace(_DARKEST[name], 255, 255).round().astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(levels[:, None], code)[:, 0, ::-1], np.uint8)
    return np.vstack([np.array([NO_VALUE], np.uint8), colours])


def depth_limits(depth_m: NDArray[np.float32]) -> tuple[float, float] | None:
    """Depths (m) at the ends of the colour scale, just beyond the 1st and 99th percentile; None without any depth."""
    known = depth_m[np.isfinite(depth_m)]
    if not known.size:
        return None
    low, high = (float(x) for x in np.percentile(known, [1, 99]))
    spare = max(0.02 * (high - low), 1e-3 * high)
    return low - spare, high + spare


def depth_scale(limits: tuple[float, float] | None) -> Scale:
    """The scale of depths between the limits of `depth_limits`: near is bright. From 0 to 1 m if limits is None."""
    near_m, far_m = limits or (0.0, 1.0)
    return Scale(near_m, far_m, "m", absent="no depth")


_TICKS: Final = ("0", "0.5", "0.9", "0.99", "0.999")
CONFIDENCE_SCALE: Final = Scale(
    1e-3, 1.0, palette="cividis", absent="no depth", log=True,
    labels=tuple((1 - float(text), text) for text in _TICKS), falling=True,
)  # fmt: skip
"""Scale of doubt, 1 - confidence, with labels of confidence: from 0.999 on all is bright."""


def depth_picture(depth_m: NDArray[np.float32], limits: tuple[float, float] | None) -> Picture:
    """Depth (rows, width) in colours from bright (near) to dark (far), black where there is none, with the scale at the
    right. All black, without a scale, if limits is None."""
    if limits is None:
        return np.zeros((len(depth_m), depth_m.shape[1] + SCALE_PX, 3), np.uint8)
    return depth_scale(limits).picture(depth_m)


def confidence_picture(confidence: NDArray[np.floating]) -> Picture:
    """Confidence (rows, width) of a map's depths in colours, bright where depth is certain, black where confidence is 0
    or NaN, with the scale at the right. The scale is logarithmic in 1 - confidence, which spreads what lies close to 1.
    """
    return CONFIDENCE_SCALE.picture(doubt(confidence))


def doubt(confidence: NDArray[np.floating]) -> NDArray[np.floating]:
    """The values of `CONFIDENCE_SCALE`: 1 - confidence, NaN where confidence is 0 (no depth) or NaN."""
    return np.where(confidence > 0, np.maximum(1 - confidence, np.float32(1e-6)), np.float32(np.nan))


_LOCAL_SHARE: Final = 0.65
"""Share of the contrast with the surroundings in a picture of counts; the rest is the contrast of the whole picture."""
_AROUND: Final = 10
"""A pixel's surroundings have a standard deviation of one in so many of the picture's longer side."""
_LEAST_SPREAD: Final = 0.7
"""Spread of levels below which a place counts as flat, in standard deviations of the shot noise of one pixel."""
_SHRINK: Final = 8


def intensity_picture(intensity: NDArray[np.uint32]) -> Picture:
    """Summed counts as grey (rows, width), stretched so that objects stand out from fog.

    The light of fog changes slowly over the picture. If the whole picture were stretched evenly, that light would hide
    what is behind it. So each pixel is mainly compared with its surroundings. The levels compared are square roots of
    the counts, since their shot noise is the same in dark and bright places; hot pixels are replaced by the median of
    their neighbours.
    """
    import cv2

    level = _without_window_steps(2 * np.sqrt(intensity.astype(np.float32) + 0.375))
    level = np.asarray(cv2.GaussianBlur(cv2.medianBlur(level, 3), (0, 0), 0.8), np.float32)
    rows, width = level.shape
    small = max(1, width // _SHRINK), max(1, rows // _SHRINK)
    sigma = max(small) / _AROUND

    def around(values: NDArray[np.float32]) -> NDArray[np.float32]:
        shrunk = cv2.GaussianBlur(cv2.resize(values, small, interpolation=cv2.INTER_AREA), (0, 0), sigma)
        return np.asarray(cv2.resize(shrunk, (width, rows), interpolation=cv2.INTER_LINEAR), np.float32)

    off = level - around(level)
    local = np.asarray(off / np.maximum(np.sqrt(around(off * off)), np.float32(_LEAST_SPREAD)), np.float32)
    both = _LOCAL_SHARE * _stretched(local) + (1 - _LOCAL_SHARE) * _stretched(level)
    return np.asarray(np.round(255 * both), np.uint8)


def _stretched(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels as 0 to 1 between their 1st and 99.5th percentile."""
    low, high = np.percentile(level[::2, ::2], [1, 99.5])  # a quarter of the pixels tells, in a quarter of the time
    return np.asarray(np.clip((level - low) / max(float(high - low), _LEAST_SPREAD), 0, 1), np.float32)


def beside(left: Picture, right: Picture) -> Picture:
    """Two RGB pictures of the same number of rows, side by side."""
    return np.hstack([left, right])


def png_bytes(picture: Picture, *, small: bool = False) -> bytes:
    """A picture, grey (rows, width) or RGB (rows, width, 3), as a PNG file. small: take more time for a smaller file.

    Raises ValueError if that fails.
    """
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 6] if small else []
    done, data = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1], options)
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be written as PNG")
    return bytes(data)


def _without_window_steps(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels without the steps at multiples of 64 px, where windows and the haze in them begin or end."""
    level = level.copy()
    reach = 3
    for edge in range(WORD_PX, level.shape[1] - reach, WORD_PX):
        before, after = level[:, edge - reach : edge].mean(axis=1), level[:, edge : edge + reach].mean(axis=1)
        level[:, edge:] -= np.median(after - before)
    return level


def round_values(low: float, high: float, most: int) -> list[float]:
    """At most `most` + 1 round numbers between low and high, 1, 2 or 5 times a power of ten apart. low must be below
    high."""
    rough = (high - low) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough)
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


MOST_READ_PX: Final = 1 << 24
"""Most pixels of a picture that is read, five times as many as the largest SPAD array has: a PNG of a megabyte can
stand for a billion."""
_PNG_CHUNKS, _PNG_AROUND = 8, 12
"""Bytes before the first chunk, and those of a chunk around its content: its length and kind, and its checksum."""
_PNG_HEAD: Final = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR"


def read_grey(file: Path) -> NDArray[np.uint8]:
    """The grey picture, uint8 (rows, width), in a PNG file that a run wrote. Raises OSError if it cannot be read,
    ValueError, with one line, if it is no such picture."""
    import cv2

    data = file.read_bytes()
    picture = None
    if 0 < _png_pixels(data) <= MOST_READ_PX:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise ValueError(f"{file.name} is no picture of at most {MOST_READ_PX >> 20} megapixels")
    return np.asarray(picture, np.uint8)


def _png_pixels(data: bytes) -> int:
    """Number of pixels of a PNG file all of whose chunks lie within it; 0 for another one. OpenCV takes the memory that
    a chunk asks for before it looks whether the file has so much."""
    if not data.startswith(_PNG_HEAD):
        return 0
    at = _PNG_CHUNKS
    while at < len(data):
        at += _PNG_AROUND + int.from_bytes(data[at : at + 4], "big")
    width, height = (int.from_bytes(data[len(_PNG_HEAD) + place :][:4], "big") for place in (0, 4))
    return width * height if at == len(data) else 0


POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def cloud(
    depth_m: NDArray[np.float32],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    intensity: NDArray[np.uint32],
) -> NDArray[np.void]:
    """One POINT for each pixel with depth and ray. All arguments are (rows, width); (u, v, 1) is each pixel's ray."""
    known = np.isfinite(depth_m) & np.isfinite(u) & np.isfinite(v)
    z = depth_m[known]
    points = np.empty(z.size, POINT)
    points["x"], points["y"], points["z"] = u[known] * z, v[known] * z, z
    points["intensity"] = intensity[known]
    return points


def ply_bytes(points: NDArray[np.void]) -> bytes:
    """Points of dtype POINT as a PLY file."""
    properties = "".join(f"property float {name}\n" for name in POINT.names or ())
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment camera frame: x right, y down, z forward; metres\n"
        f"element vertex {len(points)}\n{properties}end_header\n"
    )
    return header.encode("ascii") + points.tobytes()


def ply_points(ply: bytes) -> NDArray[np.void] | None:
    """The points, of dtype POINT, of a file that `ply_bytes` made. None for any other file, and if a value is NaN or
    not below `LARGEST`."""
    header, end, body = ply.partition(b"end_header\n")
    whole = bool(end) and b"binary_little_endian" in header and len(body) % POINT.itemsize == 0
    points = np.frombuffer(body, POINT) if whole else None
    return points if points is not None and (np.abs(points.view("<f4")) < LARGEST).all() else None
