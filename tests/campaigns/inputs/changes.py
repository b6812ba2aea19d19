"""Random changes of inputs: of bytes, of words in texts, of parts of nested values."""

import copy
import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import yaml

_WHOLE = (0, 1, 2, 7, 63, 64, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_VALUES = (*_WHOLE, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
_TEXTS = (
    "0", "-1", "1e999", "-1e400", "1e999999999", ".nan", ".inf", "NaN", "Infinity", "1/0", "9" * 400, "9" * 5000,
    "null", "true", "", "[]", "{}", "[[[[[[", "*a", "&a", "<<: *a", "!!binary aGk=", "!!set {a}",
    "!!python/object:os.system x",
    "2024-13-45", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "1:1:1:1:1:1", "0x", "0b1", "~", "\\ud800",
    '"\\u001b[31m"', "\x1b[2J", "\x07", "\x00", "\r", "\u2028", "\ufeff", "../../etc/passwd", "/dev/zero",
    "~nobody/x", "a" * 300,
)  # fmt: skip
_TOKEN = re.compile(rb"[A-Za-z_]+|[-+]?[0-9][0-9.eE+-]*|\"[^\"\n]*\"|[^\sA-Za-z0-9_]")


class Tree(NamedTuple):
    """Reads an input as nested values, and writes them; the innermost may be bytes."""

    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]


def _yaml_bytes(value: Any) -> bytes:
    text = str(yaml.dump(value, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False))
    return text.encode("utf-8", "surrogatepass")


def _members(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if len(members) % 2 else zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


JSON = Tree(json.loads, lambda value: json.dumps(value).encode())
YAML = Tree(partial(yaml.load, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)), _yaml_bytes)
NPZ = Tree(_members, _archive)


@dataclass(frozen=True, slots=True)
class Changes:
    """How inputs are changed. words: pieces that they may get. text: whether they are text. tree: for inputs that stand
    for nested values, how they are read and written. most_bytes: longer inputs are cut off.
    """

    words: tuple[bytes, ...] = ()
    text: bool = False
    tree: Tree | None = None
    most_bytes: int = 8192


def changed(how: Changes, data: bytes, others: Sequence[bytes], draw: random.Random) -> bytes:
    """The input with a few random changes. others: inputs of which it may get pieces."""
    found = bytearray(data)
    if how.tree is not None and draw.random() < 0.7:
        with suppress(Exception):  # it is none any more
            value = how.tree.read(data)
            for _ in range(draw.choice((1, 1, 1, 2, 3))):
                value = _change_tree(value, how.words, draw)
            return how.tree.write(value)[: how.most_bytes]
    text = how.text or how.tree in (JSON, YAML)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 5))):
        if text and draw.random() < 0.7:
            _change_word(found, how.words, draw)
        else:
            _change_bytes(found, how.words, others, draw)
    return bytes(found[: how.most_bytes])


def _change_tree(value: Any, words: Sequence[bytes], draw: random.Random) -> Any:
    """Nested values with one part changed: another value, one key more, fewer or twice, or a part moved elsewhere."""
    places = list(_places(value, ()))
    path = draw.choice(places)
    if not path:
        return _odd(value, words, draw)
    holder = value
    for step in path[:-1]:
        holder = holder[step]
    kind, key = draw.randrange(8), path[-1]
    if isinstance(holder[key], bytes) and kind > 1:
        holder[key] = _odd(holder[key], words, draw)
    elif kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[draw.choice((*_TEXTS, "a", "kind", "format"))] = holder[key]
    elif kind == 2 and isinstance(holder, list):
        holder.insert(key, copy.deepcopy(holder[key]))
    elif kind == 3:
        other = value
        for step in draw.choice(places):
            other = other[step]
        holder[key] = copy.deepcopy(other)
    else:
        holder[key] = _odd(holder[key], words, draw)
    return value


def _places(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from _places(part, (*path, key))


def _odd(value: Any, words: Sequence[bytes], draw: random.Random) -> Any:
    """A value to put into the place of another one."""
    if isinstance(value, bytes):
        found = bytearray(value)
        if draw.random() < 0.5:
            _change_word(found, words, draw)
        else:
            _change_bytes(found, words, [value], draw)
        return bytes(found)
    kind = draw.randrange(7)
    if kind == 0:
        return draw.choice((None, True, False, [], {}, "", 0.5, -0.0, float("nan"), float("inf"), 1e300, 1e-300))
    if kind == 1:
        return draw.choice(_VALUES) * draw.choice((1, -1))
    if kind == 2:
        return draw.choice(_TEXTS)
    if kind == 3:
        return [value]
    if kind == 4 and isinstance(value, int | float):
        return value * draw.choice((-1, 2, 0.5, 1e6, 1e-6)) + draw.choice((0, 1, -1))
    if kind == 5 and isinstance(value, str):
        at = draw.randrange(len(value) + 1)
        return value[:at] + draw.choice(_TEXTS) + value[at:]
    return {"a": value}


def _change_word(found: bytearray, words: Sequence[bytes], draw: random.Random) -> None:
    tokens = list(_TOKEN.finditer(found))
    if not tokens:
        found += b"a"
        return
    begin, end = draw.choice(tokens).span()
    kind = draw.randrange(4)
    if kind == 0:
        other = draw.choice(tokens)
        new = found[other.start() : other.end()]
    elif kind == 1 and words:
        new = bytearray(draw.choice(words))
    elif kind == 2:
        new = bytearray(str(draw.choice(_VALUES) * draw.choice((1, -1))).encode())
    else:
        new = bytearray(draw.choice(_TEXTS).encode())
    found[begin:end] = new


def _change_bytes(found: bytearray, words: Sequence[bytes], others: Sequence[bytes], draw: random.Random) -> None:
    at = draw.randrange(len(found) + 1)
    length = min(len(found) - at, draw.choice((1, 2, 4, 8, 16, 64, 300)))
    kind = draw.randrange(9)
    if kind == 0 and at < len(found):
        found[at] ^= 1 << draw.randrange(8)
    elif kind == 1 and at < len(found):
        found[at] = draw.randrange(256)
    elif kind in (2, 3):
        form = draw.choice(("<H", ">H", "<I", ">I", "<Q", "B"))
        size = struct.calcsize(form)
        value = draw.choice(_VALUES) if draw.random() < 0.5 else draw.randrange(1 << 8 * size)
        at -= at % size if draw.random() < 0.7 else 0
        found[at : at + size] = struct.pack(form, value & ((1 << 8 * size) - 1))
    elif kind == 4:
        del found[at : at + length]
    elif kind == 5:
        found[at:at] = found[at : at + length]
    elif kind == 6:
        found[at:at] = draw.choice(words) if words else draw.randbytes(length or 1)
    elif kind == 7:
        other = draw.choice(others)
        begin = draw.randrange(len(other) + 1)
        found[at : at + length] = other[begin : begin + length]
    else:
        found[at : at + length] = bytes(length) if draw.random() < 0.5 else draw.randbytes(length)
