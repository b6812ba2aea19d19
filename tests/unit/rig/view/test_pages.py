"""What pages are told and what they may ask: only the newest of each topic waits, and a flood is cut off."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.view import pages as pages_module
from rig.view.pages import BURST, Allowance, Pages, PageWish, message_bytes


class Page:
    """The end of a web socket that a page has: sends `asked`, then stays open; takes messages while `reading`."""

    def __init__(self, *asked: str) -> None:
        self._asked = asked
        self.reading = asyncio.Event()
        self.reading.set()
        self.gone = asyncio.Event()
        self.got: list[bytes] = []
        self.closed: tuple[int, str] | None = None

    async def __aiter__(self) -> AsyncIterator[str]:
        for text in self._asked:
            if self.closed is not None:
                return
            yield text
        await self.gone.wait()

    async def send(self, message: bytes) -> None:
        await self.reading.wait()
        self.got.append(message)

    async def close(self, code: int, reason: str) -> None:
        self.closed = code, reason

    def topics(self) -> list[tuple[str, Any]]:
        told = [json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")]) for message in self.got]
        return [(one["topic"], one.get("value")) for one in told]


async def settle() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


def test_a_message_has_its_text_and_the_picture_behind_it() -> None:
    message = message_bytes("map", {"value": float("nan")}, b"PNG")
    length = int.from_bytes(message[:4], "little")
    assert json.loads(message[4 : 4 + length]) == {"topic": "map", "value": None}
    assert message[4 + length :] == b"PNG"


def test_a_page_that_comes_later_is_told_the_newest_of_each_topic() -> None:
    async def run() -> None:
        pages, page = Pages(threading.Event()), Page()
        pages.tell("early", {"value": 1})
        pages.begin(asyncio.get_running_loop())
        pages.tell("map", {"value": 1})
        pages.tell("map", {"value": 2})
        await settle()
        task = asyncio.create_task(pages.serve(page))  # type: ignore[arg-type]
        await settle()
        assert page.topics() == [("early", 1), ("map", 2)]
        assert pages.open == 1
        page.gone.set()
        await task
        assert pages.open == 0

    asyncio.run(run())


def test_for_a_page_that_hangs_one_message_of_each_topic_waits_and_others_get_all() -> None:
    async def run() -> None:
        pages, hanging, reading = Pages(threading.Event()), Page(), Page()
        pages.begin(asyncio.get_running_loop())
        hanging.reading.clear()
        tasks = [asyncio.create_task(pages.serve(page)) for page in (hanging, reading)]  # type: ignore[arg-type]
        await settle()
        for value in range(500):
            pages.tell("map", {"value": value}, bytes(1000))
            pages.tell("health", {"value": value})
            await settle()
        assert len(reading.got) == 1000
        waiting = [len(page.waiting) for page in pages._pages.values()]
        assert waiting == [2, 0]
        hanging.reading.set()
        await settle()
        assert hanging.topics()[-2:] == [("map", 499), ("health", 499)]
        assert len(hanging.got) <= 3
        for page in (hanging, reading):
            page.gone.set()
        await asyncio.gather(*tasks)

    asyncio.run(run())


def test_a_page_that_floods_is_cut_off_and_others_stay() -> None:
    async def run() -> None:
        pages = Pages(threading.Event())
        pages.begin(asyncio.get_running_loop())
        calm, flood = Page(), Page(*['{"ask": "row", "row": 1, "x": 2}'] * 1000)
        tasks = [asyncio.create_task(pages.serve(page)) for page in (calm, flood)]  # type: ignore[arg-type]
        await asyncio.wait_for(tasks[1], 10)
        assert flood.closed == (1008, "too many messages")
        assert calm.closed is None
        assert pages.open == 1
        assert pages.wishes() == ([], [])
        calm.gone.set()
        await tasks[0]

    asyncio.run(run())


@pytest.mark.parametrize("text", ["", "[", "[" * 10000, '"row"', '{"ask": "arm"}', '{"ask": ["row"]}'])
def test_a_page_that_asks_what_no_page_asks_is_cut_off(text: str) -> None:
    async def run() -> None:
        pages, page = Pages(threading.Event()), Page(text)
        pages.begin(asyncio.get_running_loop())
        await asyncio.wait_for(pages.serve(page), 10)  # type: ignore[arg-type]
        assert page.closed == (1008, "no page of ours asks so")

    asyncio.run(run())


def test_wishes_come_in_order_and_the_row_that_each_page_follows_is_its_newest() -> None:
    async def run() -> None:
        wake = threading.Event()
        pages = Pages(wake)
        pages.begin(asyncio.get_running_loop())
        page = Page(
            '{"ask": "row", "row": 1, "x": 2}', '{"ask": "colour", "by": "signal"}', '{"ask": "row", "row": 3, "x": 4}',
            '{"ask": "confidence", "least": 1}', '{"ask": "stop"}',
        )  # fmt: skip
        task = asyncio.create_task(pages.serve(page))  # type: ignore[arg-type]
        await settle()
        assert wake.is_set()
        wishes, following = pages.wishes()
        assert [(wish.ask, dict(wish.values)) for wish in wishes] == [
            ("colour", {"by": "signal"}), ("confidence", {"least": 1.0}), ("stop", {}),
        ]  # fmt: skip
        assert [dict(wish.values) for wish in following] == [{"row": 3, "x": 4}]
        assert pages.wishes() == ([], following)
        pages.answer(following[0].page, "row", {"value": 7})
        pages.answer(99, "row", {"value": 8})
        await settle()
        assert page.topics() == [("row", 7)]
        page.gone.set()
        await task
        assert pages.wishes() == ([], [])

    asyncio.run(run())


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@given(_JSON, _JSON)
def test_no_text_makes_a_wish_with_values_of_other_types(row: Any, x: Any) -> None:
    text = json.dumps({"ask": "row", "row": row, "x": x})
    try:
        wish = PageWish.parse(1, text)
    except ValueError:
        return
    assert type(wish.values["row"]) is type(wish.values["x"]) is int
    assert max(abs(wish.values["row"]), abs(wish.values["x"])) < 1e9


@pytest.mark.parametrize(
    "text",
    [
        '{"ask": "confidence", "least": NaN}',
        '{"ask": "confidence", "least": Infinity}',
        '{"ask": "confidence", "least": true}',
        '{"ask": "stop", "more": 1}',
        '{"ask": "row"}',
    ],
)
def test_values_that_mean_nothing_are_refused(text: str) -> None:
    with pytest.raises(ValueError):
        PageWish.parse(1, text)


def test_an_allowance_lets_a_burst_pass_and_then_so_many_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(pages_module.time, "monotonic", lambda: now_s)
    allowance = Allowance(per_s=10.0, burst=BURST)
    assert sum(allowance.take() for _ in range(500)) == BURST
    now_s += 1000.0
    assert sum(allowance.take() for _ in range(500)) == BURST
