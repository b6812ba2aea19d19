"""The schema of a board's file: what was printed, lengths as text with a unit."""

import re
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from calibration.files.sections import Section

_METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")


def _metres(text: object) -> float:
    """The length that a text such as '60 mm' means; a bare number is refused, as everywhere in the project."""
    match = _LENGTH.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None or match[2] not in _METRES:
        raise ValueError(f"{text!r} is no length; write it with a unit ({', '.join(_METRES)}), like '60 mm'")
    # Divided rather than multiplied: 44 / 1000 is the float nearest to 44 mm.
    return float(match[1]) / round(1 / _METRES[match[2]])


Length = Annotated[float, BeforeValidator(_metres)]


class BoardFile(Section):
    """One board."""

    kind: Literal["charuco", "chessboard"] = Field(description="with markers in the white squares, or without")
    squares: tuple[int, int] = Field(description="squares along x and y, those at the border included")
    square: Length = Field(description="side of a square, measured on the print")
    marker: Length | None = Field(None, description="side of a marker, its black border included (charuco)")
    dictionary: str | None = Field(None, description="OpenCV's name of the set of markers, e.g. DICT_5X5_100 (charuco)")
