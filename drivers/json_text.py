"""Reads JSON texts that may be damaged. A text that nests too deep, or holds an integer of more than 20 digits, raises
ValueError like any other damage.
"""

import json
from typing import Any, Final

MAX_DEPTH: Final = 64
"""Largest depth to which lists and mappings may be nested."""
_MOST_DIGITS: Final = 20
"""Most digits of an integer: those of the largest unsigned 64-bit number."""


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. Raises ValueError, in one line, if it is no JSON or breaks a limit of this module."""
    try:
        content = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _require_flat(content, MAX_DEPTH)
    return content


def _whole(digits: str) -> int:
    if len(digits.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"a whole number has {len(digits)} digits, at most {_MOST_DIGITS} are taken")
    return int(digits)


def _require_flat(content: Any, left: int) -> None:
    if not isinstance(content, dict | list):
        return
    if left == 0:
        raise ValueError(_TOO_DEEP)
    for part in content.values() if isinstance(content, dict) else content:
        _require_flat(part, left - 1)


_TOO_DEEP: Final = f"nested more than {MAX_DEPTH} deep"
