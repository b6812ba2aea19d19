"""Reads JSON texts that may be damaged. Like any other damage, each of the following raises ValueError: nesting that is
too deep, an integer of more than 20 digits, a number that is not finite, a key that no terminal can show, and half a
character (a lone UTF-16 surrogate)."""

import json
import math
import re
from typing import Any, Final

MAX_DEPTH: Final = 64
"""Largest depth to which lists and mappings may be nested."""
_MOST_DIGITS: Final = 20
"""Most digits of an integer: those of the largest unsigned 64-bit number."""
_MOST_SHOWN: Final = 40


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. Raises ValueError, in one line, if it is no JSON or breaks a limit of this module."""
    try:
        content = json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=_refused)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _require_flat(content, MAX_DEPTH)
    return content


def _whole(digits: str) -> int:
    if len(digits.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"a whole number has {len(digits)} digits, at most {_MOST_DIGITS} are taken")
    return int(digits)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"{digits[:_MOST_DIGITS]} is too large for a number")
    return number


def _refused(word: str) -> None:
    raise ValueError(f"{word} is no number in JSON")


def _require_flat(content: Any, left: int) -> None:
    if isinstance(content, str) and not content.isascii() and _HALVES.search(content):
        raise ValueError("a text has half a character, which no file can hold")
    if not isinstance(content, dict | list):
        return
    if left == 0:
        raise ValueError(_TOO_DEEP)
    for key in content if isinstance(content, dict) else ():
        if not key.isprintable():  # it would stand in messages
            raise ValueError(f"the key {key[:_MOST_SHOWN]!r} has characters that cannot be shown")
    for part in content.values() if isinstance(content, dict) else content:
        _require_flat(part, left - 1)


_HALVES: Final = re.compile(r"[\ud800-\udfff]")
_TOO_DEEP: Final = f"nested more than {MAX_DEPTH} deep"
