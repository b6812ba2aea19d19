"""A slice of the campaign with random inputs: every parser, for a moment each, and what the campaign itself sees."""

import logging
import sys
import time
from collections.abc import Iterator

import pytest

from rig.errors import UsageError
from tests.campaigns.inputs.changes import Changes
from tests.campaigns.inputs.fuzz import Target, fuzz
from tests.campaigns.inputs.targets import TARGETS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="it limits the time and memory of a parser as Unix does"),
]
SLICE_S = 0.25
"""Processor time for each parser."""


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)  # thousands of warnings about damage
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_ends_wrong(name: str) -> None:
    found = fuzz(TARGETS[name], 2000, seed=1, most_s=SLICE_S)
    assert {why for why, _ in found.wrong.values()} == set()
    assert len(found.ends) >= 1


def target(parse: object, seed: bytes = b"seed") -> Target:
    return Target("made", lambda: [seed], parse, changes=Changes())  # type: ignore[arg-type]


def _raises(error: Exception) -> object:
    def parse(data: bytes) -> None:
        if data != b"seed":
            raise error

    return parse


def _burns(data: bytes) -> None:
    ends_s = time.process_time() + 1.2
    while data != b"seed" and time.process_time() < ends_s:
        pass


def _hoards(data: bytes) -> None:
    if data != b"seed":
        bytearray(b"x" * (320 << 20))


@pytest.mark.parametrize(
    ("parse", "why"),
    [
        (_raises(KeyError("a")), "KeyError"),
        (_raises(UsageError("\x1b[2J")), "a message with the character"),
        (_raises(UsageError("")), "an error without a word"),
        (_burns, "took over 1 s of processor time"),
    ],
)
def test_what_is_wrong_is_seen(parse: object, why: str) -> None:
    found = fuzz(target(parse), 3, seed=1)
    assert any(why in said for said, _ in found.wrong.values())


def test_memory_is_seen_also_after_an_input_that_took_as_much() -> None:
    for _ in range(2):
        found = fuzz(target(_hoards), 3, seed=1)
        assert any("MiB for" in said for said, _ in found.wrong.values())


def test_a_seed_that_is_refused_is_wrong() -> None:
    found = fuzz(target(_raises(UsageError("no")), seed=b"other"), 1, seed=1)
    assert any("a seed is refused" in said for said, _ in found.wrong.values())


def test_an_ending_like_no_other_is_changed_again() -> None:
    kept: list[int] = []

    def parse(data: bytes) -> str:
        kept.append(data.count(b"s"))
        return "s" * min(kept[-1], 20)

    fuzz(target(parse), 3000, seed=1)
    assert max(kept) > 8
