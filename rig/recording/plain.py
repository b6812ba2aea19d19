"""Dataclasses as plain values for YAML and JSON, and back, exactly: what a recording keeps of its plan and devices.

Fractions become text ("100000/3"), arrays their dtype and values; floats are written so that they read back as the same
number. Fields that a dataclass computes for itself (init=False) are left out, and so are those marked `SINCE` while
they have no value: files written before there were any are read as they are.
"""

import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from fractions import Fraction
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")

_FRACTION = re.compile(r"-?\d+(/\d+)?", re.ASCII)

SINCE = "since"
"""Key of a field's metadata: came later than the first recordings, None by default."""


def to_plain(value: Any) -> Any:
    """Numbers, text, lists and mappings that `from_plain` reads. TypeError for what has no such form."""
    if is_dataclass(value):
        kept = [(field, getattr(value, field.name)) for field in fields(value) if field.init]
        return {field.name: to_plain(one) for field, one in kept if one is not None or SINCE not in field.metadata}
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.name, "values": value.tolist()}
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"a {type(value).__name__} has no plain form")


def from_plain(kind: type[T], content: Any) -> T:
    """The value of type `kind` that `to_plain` wrote. ValueError where `content` is none."""
    value: T = _read(kind, content, kind.__name__)
    return value


def _read(kind: Any, content: Any, where: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return None if content is None else _read(next(one for one in inner if one is not type(None)), content, where)
    if is_dataclass(kind):
        return _read_dataclass(kind, content, where)
    if origin is np.ndarray:
        dtype = np.dtype(_need(content, Mapping, where)["dtype"])
        if dtype.kind not in "biuf":
            raise ValueError(f"{where} holds {dtype}, which are no numbers")
        return np.array(content["values"], dtype)
    if origin is tuple:
        items = _need(content, Sequence, where)
        kinds = [inner[0]] * len(items) if inner[1:] == (...,) else inner
        return tuple(_read(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(kinds, items, strict=True)))
    if kind is Fraction:
        if _FRACTION.fullmatch(_need(content, str, where)) is None:  # 1e999999999 is one too, of a gigabyte
            raise ValueError(f"{where} is {content!r}, which is no fraction of whole numbers")
        return Fraction(content)
    if kind is float:
        return float(_need(content, int | float, where))
    if origin is Literal:
        if content in inner:
            return content
        raise ValueError(f"{where} is {content!r}; it must be one of {', '.join(map(str, inner))}")
    return _need(content, kind, where)


def _read_dataclass(kind: Any, content: Any, where: str) -> Any:
    given = _need(content, Mapping, where)
    hints = get_type_hints(kind)
    names = [
        field.name for field in fields(kind) if field.init and (SINCE not in field.metadata or field.name in given)
    ]
    if set(names) != set(given):
        odd = ", ".join(sorted(set(names) ^ set(given)))
        raise ValueError(f"{where}: {odd} is unknown or missing; it was written by another version of the program")
    return kind(**{name: _read(hints[name], given[name], f"{where}.{name}") for name in names})


def _need(content: Any, kind: Any, where: str) -> Any:
    if not isinstance(content, kind) or (isinstance(content, bool) and kind is not bool):
        raise ValueError(f"{where} is {content!r}, which is not what belongs there")
    return content
