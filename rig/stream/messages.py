"""Messages of the depth stream: a head of 16 bytes, a JSON object, and arrays; docs/reference/depth-stream.md has the
format. Everything is little-endian."""

import json
import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.json_text import parse_json

MAGIC: Final = b"SPDS"
VERSION: Final = 1
HEAD: Final = struct.Struct("<4sHHII")
"""MAGIC, VERSION, `MessageKind`, bytes of the JSON, bytes of the arrays."""
ALIGN: Final = 8
"""Arrays begin at multiples of this, counted from the first one."""
MOST_HELLO: Final = 4096
"""Most bytes of a client's first line."""
ARRAYS: Final = ("depth_m", "confidence", "depth_sd_m", "intensity")
"""Arrays of a map that a client can ask for, all (rows, width)."""
USUAL: Final = ("depth_m", "confidence")
"""Arrays for a client that names none."""


class MessageKind(IntEnum):
    """Kinds of messages."""

    SETUP = 1
    """A scan has begun, or goes on: its settings, and the camera's rays if it is calibrated."""
    MAP = 2
    STATUS = 3
    """Once a second: whether a scan goes on, and its figures."""
    ERROR = 4
    """The reason for which the connection ends."""


class Hello(NamedTuple):
    """A client's first line. token: empty if it sent none. arrays: those that it wants with each map."""

    token: str
    arrays: tuple[str, ...]


def read_hello(line: bytes) -> Hello:
    """The wishes of a client, from its first line: a JSON object, or an empty line for the arrays in `USUAL`. Raises
    ValueError, with a message for the client."""
    if len(line) > MOST_HELLO or not line.endswith(b"\n"):
        raise ValueError(f"the first line must end within {MOST_HELLO} bytes")
    try:
        content = parse_json(line) if line.strip() else {}
    except ValueError:
        raise ValueError('the first line must be a JSON object, such as {"arrays": ["depth_m"]}') from None
    if not isinstance(content, dict):
        raise ValueError('the first line must be a JSON object, such as {"arrays": ["depth_m"]}')
    token, arrays = content.get("token", ""), content.get("arrays", list(USUAL))
    if not isinstance(token, str) or not isinstance(arrays, list):
        raise ValueError("token must be text, and arrays a list of names")
    unknown = [name for name in arrays if name not in ARRAYS]
    if unknown:
        raise ValueError(f"there is no array {unknown[0]!r}; choose from {', '.join(ARRAYS)}")
    return Hello(token, tuple(dict.fromkeys(arrays)))


def message(
    kind: MessageKind, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
) -> list[memoryview]:
    """The pieces of a message. Its JSON has the key `arrays`, with name, dtype (as numpy writes it), shape and offset
    of each array. An array is copied only if it has another byte order or is not contiguous. Raises ValueError if
    `about` has a number that is not finite."""
    places, pieces, at = [], [], 0
    for name, array in (arrays or {}).items():
        plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        places.append({"name": name, "dtype": plain.dtype.str, "shape": list(plain.shape), "offset": at})
        padded = -(-plain.nbytes // ALIGN) * ALIGN
        pieces += [plain.reshape(-1).view(np.uint8).data, memoryview(bytes(padded - plain.nbytes))]
        at += padded
    text = json.dumps({**about, "arrays": places}, allow_nan=False).encode()
    return [
        memoryview(HEAD.pack(MAGIC, VERSION, kind, len(text), at) + text),
        *(piece for piece in pieces if len(piece)),
    ]
