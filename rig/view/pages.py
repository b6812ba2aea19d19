"""The open pages: what each is told over its web socket, and what it asks for.

A page is told the newest value of each topic. A page that reads slowly misses older ones, so at most one message for
each topic waits for it, however long it hangs. A page that sends too much, or something that our page never sends, is
cut off.

A message to a page is binary: the length of a JSON text in bytes (uint32, little-endian), the text, and the bytes of a
picture, if any. The JSON has the key `topic`. A message from a page is JSON with the key `ask`, one of `WISHES`.
"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from drivers.json_text import parse_json
from rig.run_folder.plain_json import json_text

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

MOST_PAGES: Final = 32
"""Most pages that are open at a time."""
MOST_MESSAGE_BYTES: Final = 1 << 16
"""Largest message that a page may send; ours send hundreds of bytes."""
MESSAGES_PER_S: Final = 40.0
BURST: Final = 120.0
"""Messages that a page may send at once, before it is held to `MESSAGES_PER_S`."""
_MOST_WISHES: Final = 256
_LARGEST: Final = 1e9
_POLICY: Final = 1008
"""Close code of a web socket whose messages are not welcome (RFC 6455, 7.4.1)."""

WISHES: Final[Mapping[str, Mapping[str, type]]] = {
    "row": {"row": int, "x": int},
    "map": {"index": int},
    "colour": {"by": str},
    "confidence": {"least": float},
    "estimate": {"estimator": str},
    "recorded": {},
    "stop": {},
}
"""Wishes of pages with their values: the row under the cursor, a map of a run, colours of the points, the
least confidence shown, an estimate with another estimator, the map as it was recorded again, and the end of the run."""


@dataclass(frozen=True, slots=True)
class PageWish:
    """A wish of a page. page: its number. ask: a key of `WISHES`. values: those that belong to that key."""

    page: int
    ask: str
    values: Mapping[str, Any]

    @classmethod
    def parse(cls, page: int, text: str | bytes) -> "PageWish":
        """Read a message. Raises ValueError for one that our page never sends."""
        try:
            content = parse_json(text)
        except ValueError:
            raise ValueError("no JSON") from None
        ask = content.get("ask") if isinstance(content, dict) else None
        wanted = WISHES.get(ask) if isinstance(ask, str) else None
        if wanted is None or not isinstance(ask, str) or content.keys() != {"ask", *wanted}:
            raise ValueError("not a wish")
        values = {name: _value(content[name], kind) for name, kind in wanted.items()}
        return cls(page, ask, values)


def _value(value: Any, kind: type) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    too_large = isinstance(value, int | float) and not abs(value) < _LARGEST
    if not isinstance(value, kind) or isinstance(value, bool) or too_large:
        raise ValueError(f"{value!r} is no {kind.__name__}")
    return value


class Allowance:
    """Messages that a client may send: `per_s` a second, and up to `burst` at once after a rest."""

    def __init__(self, per_s: float = MESSAGES_PER_S, burst: float = BURST) -> None:
        self._per_s, self._burst = per_s, burst
        self._left, self._at_s = burst, time.monotonic()

    def take(self) -> bool:
        """Take one message; False if there were too many."""
        now_s = time.monotonic()
        self._left = min(self._burst, self._left + (now_s - self._at_s) * self._per_s) - 1
        self._at_s = now_s
        return self._left >= 0


@dataclass(slots=True)
class _Page:
    number: int
    waiting: dict[str, bytes] = field(default_factory=dict)
    """Newest message of each topic that has not been sent yet."""
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, topic: str, message: bytes) -> None:
        self.waiting.pop(topic, None)  # a newer value goes behind what waits already, or it could starve the others
        self.waiting[topic] = message
        self.news.set()


class Pages:
    """All open pages. `open`, `tell`, `forget`, `answer` and `wishes` are for any thread, the rest for the server's
    loop.

    wake: set whenever there is a wish, and when a page comes or goes.
    """

    def __init__(self, wake: threading.Event) -> None:
        self._wake = wake
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pages: dict[int, _Page] = {}
        self._newest: dict[str, bytes] = {}
        self._wishes: deque[PageWish] = deque(maxlen=_MOST_WISHES)
        self._following: dict[int, PageWish] = {}
        self._last_number = 0

    @property
    def open(self) -> int:
        """Number of pages open now."""
        return len(self._pages)

    def begin(self, loop: asyncio.AbstractEventLoop) -> None:
        """Set the loop in which the pages are served. What was told before is kept for the pages that come."""
        self._loop = loop

    def tell(self, topic: str, content: Mapping[str, Any], picture: bytes = b"") -> None:
        """Tell the newest value of a topic to all pages, and to those that are opened later."""
        self._soon(self._tell, topic, message_bytes(topic, content, picture))

    def forget(self) -> None:
        """Forget what was told so far, so that later pages are not told it."""
        self._soon(self._newest.clear)

    def answer(self, page: int, topic: str, content: Mapping[str, Any]) -> None:
        """Tell one page; nothing happens if it is gone."""
        self._soon(self._answer, page, topic, message_bytes(topic, content))

    def wishes(self) -> tuple[list[PageWish], list[PageWish]]:
        """Wishes since the last call in their order, and for each page that follows a row its newest wish for one."""
        taken = []
        while self._wishes:
            taken.append(self._wishes.popleft())
        return taken, list(self._following.values())

    async def serve(self, connection: "ServerConnection") -> None:
        """Serve one page until its connection is closed. A page is cut off if it sends too much, or what our page never
        sends."""
        self._last_number += 1
        page = _Page(self._last_number, dict(self._newest))
        page.news.set()
        self._pages[page.number] = page
        self._wake.set()
        sender = asyncio.create_task(self._send(connection, page))
        try:
            allowance = Allowance()
            async for text in connection:
                if not allowance.take():
                    await connection.close(_POLICY, "too many messages")
                    return
                try:
                    wish = PageWish.parse(page.number, text)
                except ValueError:
                    await connection.close(_POLICY, "no page of ours asks so")
                    return
                self._note(wish)
        finally:
            sender.cancel()
            del self._pages[page.number]
            self._following.pop(page.number, None)
            await asyncio.gather(sender, return_exceptions=True)
            self._wake.set()

    def _note(self, wish: PageWish) -> None:
        if wish.ask == "row":
            self._following.pop(wish.page, None)
            self._following[wish.page] = wish
        else:
            self._wishes.append(wish)
        self._wake.set()

    @staticmethod
    async def _send(connection: "ServerConnection", page: _Page) -> None:
        while True:
            await page.news.wait()
            page.news.clear()
            while page.waiting:
                topic = next(iter(page.waiting))
                await connection.send(page.waiting.pop(topic))

    def _soon(self, function: Any, *values: Any) -> None:
        if self._loop is None:
            function(*values)
            return
        try:
            self._loop.call_soon_threadsafe(function, *values)
        except RuntimeError:  # the server has ended
            return

    def _tell(self, topic: str, message: bytes) -> None:
        self._newest[topic] = message
        for page in self._pages.values():
            page.put(topic, message)

    def _answer(self, number: int, topic: str, message: bytes) -> None:
        page = self._pages.get(number)
        if page is not None:
            page.put(topic, message)


def message_bytes(topic: str, content: Mapping[str, Any], picture: bytes = b"") -> bytes:
    """A message to a page, in the form that the module describes."""
    text = json_text({"topic": topic, **content}).encode()
    return len(text).to_bytes(4, "little") + text + picture
