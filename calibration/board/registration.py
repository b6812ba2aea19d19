"""Locates corners to a few hundredths of a pixel: the board, drawn as it should look there, is matched to the picture.

A smooth map leads from the board to the picture: a homography and, if there are enough points, a polynomial for the
distortion of the lens. The map needs no camera model. It is fitted to points whose board positions are known, and tells
where corners should be and how the board looks around each. The polynomial is a function of the position in the
picture, not on the board. Lens distortion is a polynomial there, whatever the board's tilt; on a tilted board it is
not. Fitting it on the board moves corners by less than 0.002 px, but equally in all pictures, which makes focal lengths
wrong by 0.025 % at k1 = 0.2.

Around a corner the picture is offset + gain * drawn board, shifted by (dx, dy); the gain may change linearly along x
and y. The best shift gives the corner. All edges around it contribute, those of markers too. So with few photons the
error is a tenth of that of cv2.cornerSubPix (docs/how-to/calibration.md). The fit is weighted least squares by
Gauss-Newton, with a variance proportional to the light, as for photons. Outliers (such as an unlisted hot pixel) do not
count.

The drawing is bent as the map bends around each corner, and is up to SUBPIXELS times as fine as the picture. A
homography without the bend, or edges rounded to drawn pixels, would move all corners of a picture alike by some 0.002
px, which no number of corners averages out. The last fit of each corner uses only the pixels nearest to it, so corners
share hardly any.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array
from calibration.board.board import MARGIN_SQUARES, Board

_PX_PER_SQUARE = (32, 256)
"""Least and most pixels of the drawing per square."""
_MOST_PX = 1 << 25
"""Most pixels of a drawing, 128 MB. Boards of more than 21 x 21 squares can reach it; the largest ones allowed are
drawn with 57 pixels per square. Fewer pixels cost precision: 30 x 29 squares, each 17 to 24 pixels wide in the picture,
have corners off by 0.0018 px if drawn with 134 pixels per square, and by 0.0009 px with 256."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """The board as drawn for the comparison: white is 1, black 0. margin_px: width of the margin around the squares."""

    board: Board
    picture: NDArray[np.float32]
    px_per_square: int
    margin_px: int

    @classmethod
    def of(cls, board: Board, px_per_square: float) -> "Drawing":
        """Draw the board at this resolution, or as near to it as is possible. Each pixel is exactly the white share of
        its area.
        """
        modules = board.modules
        down, across, side, _ = modules.shape
        least, most = _PX_PER_SQUARE
        squares = (down + 2 * MARGIN_SQUARES) * (across + 2 * MARGIN_SQUARES)
        fine = int(np.clip(np.nan_to_num(px_per_square), least, min(most, (_MOST_PX / squares) ** 0.5)))
        pad = round(MARGIN_SQUARES * fine)
        white = np.zeros((down, across, side + 2, side + 2), np.float32)
        white[np.add.outer(np.arange(down), np.arange(across)) % 2 == 1] = 1  # quiet zone of the markers too
        white[:, :, 1:-1, 1:-1] -= modules
        share = 0.0 if board.marker_m is None else board.marker_m / board.square_m
        edges = np.concatenate([[0.0], 0.5 + share * (np.arange(side + 1) / max(side, 1) - 0.5), [1.0]])
        pixels = np.arange(fine + 1) / fine
        upper = np.minimum(pixels[1:, None], edges[1:])
        covered = np.maximum(upper - np.maximum(pixels[:-1, None], edges[:-1]), 0) * fine
        covered = covered.astype(np.float32)
        drawn = np.einsum("pi,rcij,qj->rpcq", covered, white, covered, optimize=True)
        size = (down * fine, across * fine)
        return cls(board, np.pad(drawn.reshape(size), pad, constant_values=1.0), fine, pad)


_BENDS = ((30, 3), (12, 2))
"""(least number of points, degree of the polynomial): at least two points per term."""
_FEWEST_POINTS = 4
_KEPT_SHARES = (0.8, 0.8, 1.0)
"""Shares of the points, the best fitting ones, that the polynomial is fitted to in turn: outliers must not bend it."""
_OUTLIER_MEDIANS = 5.0
_LEAST_OUTLIER_PX = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class BoardMap:
    """Maps board positions (metres) to raw pixels.

    homography: (3, 3) float64, for positions scaled to -1..1 over the board. bend_px: (terms, 2) float64, coefficients
    of x^i y^j, (x, y) being the homography's result, scaled by centre_px and half_px to -1..1 over the fitted points.
    """

    homography: Array
    bend_px: Array
    degree: int
    """Degree of the polynomial; 0: the homography alone."""
    half_m: Array
    """Half of the board's size (2,)."""
    centre_px: Array
    """Middle of the points that were fitted (2,)."""
    half_px: float
    """Largest distance of these points from the middle, along x or y."""

    def to_px(self, points_m: ArrayLike) -> Array:
        """Raw pixels (..., 2) of board positions (..., 2)."""
        flat = _projected(self.homography, (np.asarray(points_m, np.float64) - self.half_m) / self.half_m)
        return flat + _terms((flat - self.centre_px) / self.half_px, self.degree) @ self.bend_px


def fit_map(
    points_m: Array, px: Array, outlier_px: float, size_m: tuple[float, float]
) -> tuple[BoardMap, NDArray[np.bool_]] | None:
    """The map through points (n, 2) seen at px (n, 2), and which of them it fits; None if no four agree.

    outlier_px: largest distance from the homography. With a polynomial, a point fits if it is off by at most five times
    the median distance, or by 0.3 px if that is more.
    """
    if len(points_m) < _FEWEST_POINTS:
        return None
    half = np.array(size_m) / 2
    at = (points_m - half) / half
    first, mask = cv2.findHomography(at, px, cv2.RANSAC, outlier_px, maxIters=2000, confidence=0.9999)
    if first is None or not np.isfinite(first).all():
        return None
    homography = np.asarray(first, np.float64)
    inside: NDArray[np.bool_] = mask.ravel() > 0
    if inside.sum() < _FEWEST_POINTS:
        return None
    degree = next((degree for fewest, degree in _BENDS if inside.sum() >= fewest), 0)
    flat = _projected(homography, at)
    centre = flat[inside].mean(axis=0)
    reach = max(float(np.abs(flat[inside] - centre).max()), 1e-9)
    terms, missed = _terms((flat - centre) / reach, degree), px - flat
    bend: Array = np.zeros((terms.shape[1], 2))
    for share in _KEPT_SHARES if degree else ():
        bend = np.asarray(np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)[0], np.float64)
        off = np.hypot(*(missed - terms @ bend).T)
        usual = float(np.median(off[inside]))
        close = max(_OUTLIER_MEDIANS * usual, _LEAST_OUTLIER_PX)
        inside = off <= (close if share == 1 else max(float(np.quantile(off[inside], share)), _LEAST_OUTLIER_PX))
    if degree:
        bend = np.asarray(np.linalg.lstsq(terms[inside], missed[inside], rcond=1e-6)[0], np.float64)
    return BoardMap(homography, bend, degree, half, centre, reach), inside


def _projected(homography: Array, at: Array) -> Array:
    seen = np.concatenate([at, np.ones((*at.shape[:-1], 1))], axis=-1) @ homography.T
    return seen[..., :2] / seen[..., 2:]


def _terms(at: Array, degree: int) -> Array:
    across = np.polynomial.polynomial.polyvander(at[..., 0], degree)
    down = np.polynomial.polynomial.polyvander(at[..., 1], degree)
    i, j = np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]).T
    return across[..., i] * down[..., j]


SUBPIXELS = 12
"""Samples per pixel and axis that are averaged over the pixel's area; an even number. The drawing is as fine as these,
within _PX_PER_SQUARE: for squares wider than 21 pixels it is coarser, and interpolated.

With 6 samples and no noise, corners are off by 0.0020 px, alike enough in all pictures to change focal lengths by 60
ppm. With 12 they are off by 0.0012 px, most of it from the drawing of the test pictures, and focal lengths by 30 ppm.
"""
WIDE, OWN = 0.9, 0.5
"""Reach of the patch around a corner, in squares. WIDE, to find the corner: short of the next corners. OWN: halfway to
the next ones, so that corners hardly share pixels and their errors are independent, as a fit assumes."""
_MOST_REACH_PX = 16
_LEAST_REACH_PX = 4
_SEARCH_SQUARES = 0.25
"""Farthest search for a corner: beyond, a shift could mistake one module of a marker for the next."""
_POWERS = [(i, j) for i in range(4) for j in range(4 - i)]
"""Powers of x and y that place the drawing around a corner: enough for tilt and lens distortion over two squares."""
_AROUND = np.stack(np.meshgrid(*2 * [np.linspace(-1.25, 1.25, 7)]), axis=-1).reshape(-1, 2)
"""Points, in units of the reach, that the polynomial is fitted to: over the patch and a pixel more on every side."""
_STEPS = 4
_SETTLED_SDS = 0.1
"""A step shorter than this, in sds of the corner, ends the iteration: the remaining error is a tenth of the step."""
_OUTLIER_SDS = 5.0
_DARK_SHARE = 0.05
"""Least variance of a pixel, as a share of the difference of light between white and black."""
_LEAST_MATCH = 0.4
"""Least correlation of picture and drawing. A board under few photons gives 0.5, anything else 0.2."""
_MOST_SD_PX = 0.5
_DRAWING_SD_PX = 0.003
"""Error of the drawing itself. Measured are 0.0012 px without noise; more is assumed, since part of the error is alike
in many pictures."""


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A corner's surroundings: its expected pixel, the side of a square and the half width of its patch in pixels, and
    (4, 4, 2) coefficients of the polynomial from picture to drawing, None if the map there is wrong.
    """

    expected_px: Array
    side_px: float
    reach: int
    to_drawing: Array | None


def register(
    picture: NDArray[np.float32],
    drawing: Drawing,
    board_map: BoardMap,
    ids: NDArray[np.int32],
    reach: float,
    search: bool,
) -> tuple[NDArray[np.int32], Array, Array]:
    """Fit the corners `ids` near where the map puts them; return ids, px (n, 2) and sd_px (n,) of those found.

    reach: half width of the patches, in squares, but at least 4 and at most 16 pixels. search: whether to search in
    whole pixels first."""
    places = _places(drawing, board_map, ids, reach)
    found = [_register_one(picture, drawing, place, search) for place in places]
    good = np.array([one is not None for one in found], np.bool_)
    rows = np.array([one for one in found if one is not None], np.float64).reshape(-1, 3)
    return ids[good], rows[:, :2], rows[:, 2]


def sides_px(board: Board, board_map: BoardMap, corners_m: Array) -> Array:
    """(n,) side of a square around positions (n, 2), in pixels; the shorter one if they differ."""
    step = board.square_m / 2
    ends = board_map.to_px(corners_m[:, None] + np.array([[-step, 0], [step, 0], [0, -step], [0, step]]))
    return np.asarray(np.linalg.norm(ends[:, 1::2] - ends[:, ::2], axis=-1).min(axis=1))


def _places(drawing: Drawing, board_map: BoardMap, ids: NDArray[np.int32], reach_squares: float) -> list[_Place]:
    """The places where the map puts the corners, each with its polynomial from picture to drawing."""
    board = drawing.board
    corners_m = board.corners_m[ids, :2]
    sides = sides_px(board, board_map, corners_m)
    expected = board_map.to_px(corners_m)
    reach = np.clip(np.nan_to_num(reach_squares * sides), _LEAST_REACH_PX, _MOST_REACH_PX).astype(int)
    spread_m = np.minimum(reach_squares, reach / sides)[:, None, None] * board.square_m
    around_m = corners_m[:, None] + spread_m * _AROUND
    around = (board_map.to_px(around_m) - expected[:, None]) / reach[:, None, None]
    drawn = around_m / board.square_m * drawing.px_per_square + (drawing.margin_px - 0.5)
    to_drawing = [_bent(*of) for of in zip(around, drawn, strict=True)]
    return [_Place(*of) for of in zip(expected, sides.tolist(), reach.tolist(), to_drawing, strict=True)]


def _bent(at: Array, drawn: Array) -> Array | None:
    """The polynomial from picture to drawing; None if a wrong map squeezes the board into a line or is not finite."""
    if not np.isfinite(at).all():
        return None
    i, j = np.array(_POWERS).T
    terms, _, rank, _ = np.linalg.lstsq(at[:, :1] ** i * at[:, 1:] ** j, drawn, rcond=1e-9)
    if rank < len(_POWERS):
        return None
    powers = np.zeros((4, 4, 2))
    powers[i, j] = terms
    return powers


def _register_one(
    picture: NDArray[np.float32], drawing: Drawing, place: _Place, search: bool
) -> tuple[float, float, float] | None:
    """(x, y, sd) of one corner in pixels; None if the picture does not show it."""
    expected, side, reach, to_drawing = place.expected_px, place.side_px, place.reach, place.to_drawing
    farthest = _SEARCH_SQUARES * side + 1
    at = expected
    height, width = picture.shape
    if to_drawing is None or not (0 <= at[0] <= width - 1 and 0 <= at[1] <= height - 1):
        return None
    if search:
        shift = _best_whole_shift(picture, drawing, place, to_drawing, max(1, round(_SEARCH_SQUARES * side)))
        if shift is None:
            return None
        at = at + shift
    start, sd = at, np.inf
    for _ in range(_STEPS):
        x0, y0 = max(round(float(at[0])) - reach, 0), max(round(float(at[1])) - reach, 0)
        x1, y1 = min(round(float(at[0])) + reach + 1, width), min(round(float(at[1])) + reach + 1, height)
        if min(x1 - x0, y1 - y0) < _LEAST_REACH_PX:
            return None
        patch = _draw(drawing, place, to_drawing, at - expected, (x0, y0, x1, y1))
        solved = _shift(picture[y0:y1, x0:x1].astype(np.float64), *patch)
        if solved is None:
            return None
        at, sd = at + solved[:2], solved[2]
        if np.hypot(*(at - start)) > farthest:
            return None
        if max(abs(solved[0]), abs(solved[1])) < _SETTLED_SDS * sd:
            break
    return None if sd > _MOST_SD_PX else (float(at[0]), float(at[1]), float(np.hypot(sd, _DRAWING_SD_PX)))


def _draw(
    drawing: Drawing, place: _Place, to_drawing: Array, shift: Array, box: tuple[int, int, int, int]
) -> tuple[Array, Array, Array]:
    """The drawing on pixels x0:x1, y0:y1 with everything moved by `shift`, averaged over each pixel's area; and its
    slopes per pixel along x and y.
    """
    x0, y0, x1, y1 = box
    n = SUBPIXELS
    half = n // 2
    # Half a pixel more on every side, for the slopes.
    x, y = (
        np.vander((start - 1 + (np.arange(n * (end - start + 1)) + 0.5) / n - at) / place.reach, 4, increasing=True)
        for start, end, at in zip((x0, y0), (x1, y1), place.expected_px + shift, strict=True)
    )
    at_x, at_y = ((y @ to_drawing[..., axis].T @ x.T).astype(np.float32) for axis in range(2))
    fine = cv2.remap(drawing.picture, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def averaged(right: int, down: int) -> Array:
        cut = fine[down : down + (y1 - y0) * n, right : right + (x1 - x0) * n]
        return np.asarray(cv2.resize(cut, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA), np.float64)

    along_x, along_y = averaged(2 * half, half) - averaged(0, half), averaged(half, 2 * half) - averaged(half, 0)
    return averaged(half, half), along_x, along_y


def _best_whole_shift(
    picture: NDArray[np.float32], drawing: Drawing, place: _Place, to_drawing: Array, search: int
) -> Array | None:
    """The shift in whole pixels at which picture and drawing correlate best; None if they do not, or at the border."""
    x, y = (round(float(value)) for value in place.expected_px)
    height, width = picture.shape
    reach = min(place.reach, x, y, width - 1 - x, height - 1 - y)
    if reach < _LEAST_REACH_PX:
        return None
    drawn, _, _ = _draw(drawing, place, to_drawing, np.zeros(2), (x - reach, y - reach, x + reach + 1, y + reach + 1))
    left, top = max(x - reach - search, 0), max(y - reach - search, 0)
    region = picture[top : y + reach + search + 1, left : x + reach + search + 1]
    match = cv2.matchTemplate(region, drawn.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    _, best, _, found = cv2.minMaxLoc(match)
    if best < _LEAST_MATCH:
        return None
    return np.array([left + found[0] - (x - reach), top + found[1] - (y - reach)], np.float64)


def _shift(seen: Array, drawn: Array, along_x: Array, along_y: Array) -> tuple[float, float, float] | None:
    """(dx, dy, sd) of the shift that brings the drawing onto the picture; None if the picture does not show it."""
    rows, columns = seen.shape
    x, y = np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)[:, None]
    light = np.stack([np.ones_like(drawn), drawn, drawn * x, drawn * y], axis=-1).reshape(-1, 4)
    values = seen.ravel()
    try:
        level = np.linalg.solve(light.T @ light, light.T @ values)
    except np.linalg.LinAlgError:
        return None
    gain = level[1]
    if not gain > 0:
        return None
    terms = np.concatenate([light, -gain * along_x.reshape(-1, 1), -gain * along_y.reshape(-1, 1)], axis=1)
    weights = 1 / np.maximum(light @ level, _DARK_SHARE * gain)
    for _ in range(2):
        weighted = terms * weights[:, None]
        normal = terms.T @ weighted
        try:
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        solved = inverse @ (weighted.T @ values)
        missed = (values - terms @ solved) * np.sqrt(weights)
        counting = weights > 0
        variance = float(missed @ missed / max(counting.sum() - len(solved), 1))
        outliers = np.abs(missed) > _OUTLIER_SDS * np.sqrt(variance)
        if not outliers.any():
            break
        weights = np.where(outliers, 0.0, weights)
    sd = float(np.sqrt(variance * (inverse[4, 4] + inverse[5, 5]) / 2))
    return (float(solved[4]), float(solved[5]), sd) if np.isfinite(sd) else None
