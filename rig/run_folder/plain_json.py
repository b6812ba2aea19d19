"""Writes values of any kind as strict JSON."""

import json
import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np


def json_text(content: Mapping[str, Any]) -> str:
    """Content as strict JSON. NaN and infinity become null; arrays and tuples become lists, fractions become numbers.
    Whatever else JSON does not have becomes text."""
    return json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False)


def json_line(content: Mapping[str, Any]) -> str:
    """Content as `json_text` writes it, but on one line, with a line break at its end. Keys are sorted, so equal
    content gives equal lines."""
    return json.dumps(plain(content), sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n"


def plain(value: Any) -> Any:
    """The value in types that JSON has: None, bool, int, float, text, list and dict. It is changed as in
    `json_text`."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Fraction):
        return plain(float(value))
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, int | bool):
        return value
    text = str(value)
    # The name of a file may hold bytes that are no text, which no file can hold as they are.
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()
