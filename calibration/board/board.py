"""The calibration board, a ChArUco board or a plain chessboard, and its file.

Board coordinates in metres: x right, y down, z into the board, origin at the top left corner of the top left square,
which is black. The inner corners are numbered row by row, as in cv2.aruco.CharucoBoard. The board's file holds what was
printed, with lengths as text with a unit.

A chessboard can look the same in more than one orientation. Its mirror image differs only if the numbers of squares
along both sides are even and not equal. Turned by 180 degrees it differs only if exactly one of the two numbers is
even.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field

from calibration.arrays import Array
from calibration.errors import CalibrationError
from calibration.files.problems import ValueSources, validated
from calibration.files.sections import FileSection, load_yaml
from calibration.views import BoardPose

_METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")


def _metres(text: object) -> float:
    """The length in metres of a text such as '60 mm'. Raises ValueError for anything else, such as '60'."""
    match = _LENGTH.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None or match[2] not in _METRES:
        raise ValueError(f"{text!r} is no length; write it with a unit ({', '.join(_METRES)}), like '60 mm'")
    # Divided rather than multiplied: 44 / 1000 is the float nearest to 44 mm.
    return float(match[1]) / round(1 / _METRES[match[2]])


Length = Annotated[float, BeforeValidator(_metres)]


class BoardFile(FileSection):
    """The keys of a board's file."""

    kind: Literal["charuco", "chessboard"] = Field(description="with markers in the white squares, or without")
    squares: tuple[int, int] = Field(description="squares along x and y, those at the border included")
    square: Length = Field(description="side of a square, measured on the print")
    marker: Length | None = Field(None, description="side of a marker, its black border included (charuco)")
    dictionary: str | None = Field(None, description="OpenCV's name of the set of markers, e.g. DICT_5X5_100 (charuco)")


BLACK, WHITE = 0.05, 0.85
"""Reflectance of a laser printer's black and of matt white paper, rounded."""
MARGIN_SQUARES = 0.5
PAPER_SQUARES = 0.8 * MARGIN_SQUARES
"""Width, in squares, of the margin around the squares, and of that part of it which is surely white paper."""
BUNDLED_BOARD = Path(__file__).parents[2] / "config" / "board.yaml"
"""File of the board that is used if none is named."""

_FEWEST_SQUARES = 3
"""Fewest squares along a side; fewer leave less than 2 x 2 inner corners."""
_MOST_SQUARES = 100
"""Most squares along a side; 100 x 100 need more markers than any dictionary has."""


@dataclass(frozen=True, slots=True)
class Board:
    """A printed board: number of squares along (x, y), their side in metres and, on a ChArUco board, the side of its
    markers.

    dictionary: the name of an OpenCV dictionary, such as DICT_5X5_100. modules: the cells of all markers, (squares
    down, across, side, side), True where black, the marker's border included; squares without a marker are False. side:
    modules along a marker, 0 for a chessboard. Raises CalibrationError for values that describe no usable board.
    """

    kind: Literal["charuco", "chessboard"]
    squares: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None
    modules: NDArray[np.bool_] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the values and draw the markers."""
        if not all(_FEWEST_SQUARES <= count <= _MOST_SQUARES for count in self.squares):
            raise CalibrationError(
                f"board has {self.squares[0]} x {self.squares[1]} squares; each side takes {_FEWEST_SQUARES} to "
                f"{_MOST_SQUARES}"
            )
        if not 0 < self.square_m < np.inf:
            raise CalibrationError(f"board's square is {self.square_m:g} m; measure the print and give its side")
        if self.kind == "chessboard":
            if self.marker_m is not None or self.dictionary is not None:
                raise CalibrationError(
                    "a chessboard has no markers; remove marker and dictionary, or set kind: charuco"
                )
        elif self.marker_m is None or self.dictionary is None:
            raise CalibrationError("a ChArUco board needs marker and dictionary; without markers set kind: chessboard")
        elif not 0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"board's marker is {self.marker_m:g} m in a square of {self.square_m:g} m; it must be smaller"
            )
        object.__setattr__(self, "modules", self._drawn_modules())

    @property
    def corners_m(self) -> Array:
        """The inner corners in the order of their ids, float64 (n, 3); z = 0."""
        across, down = self.grid
        y, x = np.mgrid[1 : down + 1, 1 : across + 1] * self.square_m
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)

    @property
    def grid(self) -> tuple[int, int]:
        """Number of inner corners along (x, y)."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def size_m(self) -> tuple[float, float]:
        """(width, height) in metres of all squares together, without the paper around them."""
        return self.squares[0] * self.square_m, self.squares[1] * self.square_m

    def albedo_at(self, x_m: ArrayLike, y_m: ArrayLike) -> Array:
        """Reflectance at board positions (broadcast together): white on the paper around the squares, NaN off the
        paper.
        """
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        x, y = x / self.square_m, y / self.square_m
        across, down = self.squares
        margin = MARGIN_SQUARES
        paper = (x >= -margin) & (x <= across + margin) & (y >= -margin) & (y <= down + margin)
        inside = (x >= 0) & (x < across) & (y >= 0) & (y < down)
        x, y = np.where(inside, x, 0), np.where(inside, y, 0)
        column, row = x.astype(np.int64), y.astype(np.int64)
        black = self._module_at(column, row, x - column, y - row)
        return np.where(paper, np.where(inside & black, BLACK, WHITE), np.nan)

    def picture(self, px_per_square: int) -> NDArray[np.uint8]:
        """The board with its white margin as a picture (height, width) for printing, 0 for black and 255 for white."""
        side = 1 + 2 * MARGIN_SQUARES / np.array(self.squares)
        width, height = (np.round(side * self.squares * px_per_square)).astype(int)
        x, y = (((np.arange(n) + 0.5) / px_per_square - MARGIN_SQUARES) * self.square_m for n in (width, height))
        return np.where(self.albedo_at(x, y[:, None]) > BLACK, np.uint8(255), np.uint8(0))

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's object for this board. Raises CalibrationError for a chessboard."""
        if self.dictionary is None or self.marker_m is None:
            raise CalibrationError("a chessboard has no markers to look for; set kind: charuco")
        return cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m, _dictionary(self.dictionary))

    def _module_at(
        self, column: NDArray[np.int64], row: NDArray[np.int64], along: Array, below: Array
    ) -> NDArray[np.bool_]:
        """True where the print is black; along, below: position in the square, 0 to 1."""
        black: NDArray[np.bool_] = (column + row) % 2 == 0
        if self.marker_m is None:
            return black
        side = self.modules.shape[-1]
        share = self.marker_m / self.square_m
        i, j = (np.floor(((at - 0.5) / share + 0.5) * side).astype(np.int64) for at in (along, below))
        in_marker = ~black & (i >= 0) & (i < side) & (j >= 0) & (j < side)
        i, j = np.clip(i, 0, side - 1), np.clip(j, 0, side - 1)
        return np.asarray(black | (in_marker & self.modules[row, column, j, i]))

    def _drawn_modules(self) -> NDArray[np.bool_]:
        """`modules`: a marker in every white square, row by row. Raises CalibrationError for too small a dictionary."""
        across, down = self.squares
        if self.dictionary is None:
            return np.zeros((down, across, 0, 0), np.bool_)
        dictionary = _dictionary(self.dictionary)
        has = len(dictionary.bytesList)
        needed = across * down // 2
        if needed > has:
            raise CalibrationError(
                f"board of {across} x {down} squares needs {needed} markers; {self.dictionary} has {has}: choose a "
                "larger dictionary"
            )
        side = dictionary.markerSize + 2
        modules = np.zeros((down, across, side, side), np.bool_)
        white = [(row, column) for row in range(down) for column in range(across) if (row + column) % 2]
        for marker, (row, column) in enumerate(white):
            modules[row, column] = cv2.aruco.generateImageMarker(dictionary, marker, side) == 0
        return modules


def load_board(path: str | os.PathLike[str] | None = None) -> Board:
    """Read a board from a YAML file (None: the bundled one). Raises CalibrationError if it is unreadable or invalid."""
    file = BUNDLED_BOARD if path is None else Path(path)
    read = load_yaml(file, "a board", "kind: charuco")
    parsed = validated(BoardFile, read.content, ValueSources(str(file), read.lines))
    try:
        return Board(parsed.kind, parsed.squares, parsed.square, parsed.marker, parsed.dictionary)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    known = sorted(entry for entry in dir(cv2.aruco) if entry.startswith("DICT_"))
    if name not in known:
        raise CalibrationError(f"there is no dictionary '{name}'; OpenCV has {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def spread_rad(poses: Sequence[BoardPose]) -> float:
    """The largest angle (rad) between the normals of any two of the boards. poses: at least one."""
    normals = np.stack([pose.matrix[:, 2] for pose in poses])
    return float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())
