"""What comes over the network and through the slot of a live run: wishes, requests, first lines, and slots."""

import json
from collections.abc import Sequence

from rig.stream.messages import read_hello
from rig.view.access import Access, Asked
from rig.view.pages import PageWish
from tests.campaigns.inputs.changes import JSON, Changes
from tests.campaigns.inputs.fuzz import Target

TOKEN = "a-token-of-the-tests"


def _wishes() -> list[bytes]:
    wishes = (
        {"ask": "row", "row": 3, "x": 4}, {"ask": "map", "index": 1}, {"ask": "colour", "by": "depth"},
        {"ask": "confidence", "least": 0.5}, {"ask": "estimate", "estimator": "joint"}, {"ask": "stop"},
    )  # fmt: skip
    return [json.dumps(wish).encode() for wish in wishes]


def _wish(data: bytes) -> None:
    PageWish.parse(1, data)
    PageWish.parse(1, data.decode("utf-8", "replace"))


def _hellos() -> list[bytes]:
    content = {"token": TOKEN, "arrays": ["depth_m", "confidence", "depth_sd_m", "intensity"]}
    return [json.dumps(content).encode() + b"\n", b"\n"]


ACCESS = {
    "local": Access("127.0.0.1", 8080, None, frozenset({"localhost"})),
    "open": Access("192.0.2.1", 8080, TOKEN, frozenset({"localhost", "lab"})),
}


def _hello(data: bytes) -> None:
    hello = read_hello(data)
    ACCESS["open"].knows(hello.token)


def _requests() -> list[bytes]:
    lines = (
        "/?token=a\nlocalhost:8080\nhttp://localhost:8080\nspadrig-8080=x; a=b",
        f"/cloud/?token={TOKEN}\n192.0.2.1:8080\n\nspadrig-8080={TOKEN}",
        "/data\n[::1]:8080\nhttp://[::1]:8080\n",
    )
    return [line.encode() for line in lines]


def _request(data: bytes) -> str:
    """Path, Host, Origin and cookie in a line each, as the package websockets hands them on."""
    path, host, origin, cookie = (*data.decode("ascii", "surrogateescape").split("\n"), "", "", "", "")[:4]
    said = []
    for access in ACCESS.values():
        for socket in (False, True):
            asked = Asked(path, socket, [host], [origin] if origin else [], [cookie] if cookie else [])
            refusal = access.refusal(asked)
            said.append("0" if refusal is None else str(refusal.status))
            known = TOKEN in cookie or (TOKEN in path and not socket)
            assert refusal is not None or access.token is None or known, "somebody without the token is let in"
            assert refusal is not None or host, "a request for nobody is answered"
    return " ".join(said)


def _slots() -> Sequence[bytes]:
    return []


TARGETS = (
    Target("view-wish", _wishes, _wish, (ValueError,), changes=Changes(tree=JSON)),
    Target("stream-hello", _hellos, _hello, (ValueError,), changes=Changes(tree=JSON)),
    Target(
        "view-request",
        _requests,
        _request,
        (),
        changes=Changes(
            words=(
                b"[",
                b"]",
                b"//",
                b"%00",
                b"@",
                b"localhost",
                b"127.0.0.1",
                b"\xff",
                TOKEN.encode(),
                b"spadrig-8080=",
                b";",
            ),
            text=True,
        ),
    ),
)
