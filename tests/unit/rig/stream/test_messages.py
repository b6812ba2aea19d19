"""Messages of the depth stream, read by hand; and first lines of clients that are none."""

import json
import struct

import numpy as np
import pytest

from rig.stream.messages import ARRAYS, MOST_HELLO, USUAL, Hello, MessageKind, message, read_hello


def test_a_message_has_the_bytes_that_the_page_says() -> None:
    depth_m = np.array([[1.5, np.nan, 2.0]], ">f4")
    counts = np.array([[1], [2]], np.uint32)
    sent = b"".join(message(MessageKind.MAP, {"index": 7}, {"depth_m": depth_m, "intensity": counts}))
    assert sent[:4] == b"SPDS"
    assert sent[4:8] == b"\x01\x00\x02\x00"
    json_bytes, array_bytes = struct.unpack("<II", sent[8:16])
    about = json.loads(sent[16 : 16 + json_bytes])
    assert about == {
        "index": 7,
        "arrays": [
            {"name": "depth_m", "dtype": "<f4", "shape": [1, 3], "offset": 0},
            {"name": "intensity", "dtype": "<u4", "shape": [2, 1], "offset": 16},
        ],
    }
    data = sent[16 + json_bytes :]
    assert len(data) == array_bytes == 24
    assert data[:4] == b"\x00\x00\xc0\x3f"  # 1.5 as IEEE 754, little-endian
    assert np.isnan(np.frombuffer(data, "<f4", 3)[1])
    assert data[12:16] == bytes(4)
    assert data[16:] == b"\x01\x00\x00\x00\x02\x00\x00\x00"


def test_arrays_that_are_views_come_in_order() -> None:
    whole = np.arange(12, dtype=np.float32).reshape(3, 4)
    sent = b"".join(message(MessageKind.SETUP, {}, {"u": whole[:, ::2]}))
    assert np.frombuffer(sent[-24:], "<f4").tolist() == [0, 2, 4, 6, 8, 10]


def test_a_message_without_arrays_is_head_and_json() -> None:
    (only,) = message(MessageKind.ERROR, {"error": "why"})
    assert bytes(only[12:16]) == bytes(4)
    assert json.loads(bytes(only[16:])) == {"error": "why", "arrays": []}


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        (b"\n", Hello("", USUAL)),
        (b"{}\n", Hello("", USUAL)),
        (
            b'{"token": "abc", "arrays": ["intensity", "depth_m", "intensity"]}\r\n',
            Hello("abc", ("intensity", "depth_m")),
        ),
        (b'{"arrays": []}\n', Hello("", ())),
        (json.dumps({"arrays": list(ARRAYS), "later": 1}).encode() + b"\n", Hello("", ARRAYS)),
    ],
)
def test_first_lines(line: bytes, wanted: Hello) -> None:
    assert read_hello(line) == wanted


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (b"GET / HTTP/1.1\r\n", "must be a JSON object"),
        (b"[1]\n", "must be a JSON object"),
        (b"\xff\xfe\n", "must be a JSON object"),
        (b"[" * 2000 + b"\n", "must be a JSON object"),
        (b"{}", "must end within"),
        (b" " * MOST_HELLO + b"{}\n", "must end within"),
        (b'{"token": 3}\n', "token must be text"),
        (b'{"arrays": "depth_m"}\n', "arrays a list"),
        (b'{"arrays": ["depth"]}\n', "no array 'depth'"),
        (b'{"arrays": [[]]}\n', "no array"),
    ],
)
def test_first_lines_that_ask_for_what_is_not_there(line: bytes, told: str) -> None:
    with pytest.raises(ValueError, match=told) as refused:
        read_hello(line)
    assert "\n" not in str(refused.value)
