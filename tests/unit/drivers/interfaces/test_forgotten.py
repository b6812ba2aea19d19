"""Devices that nobody closed: their end is done, on whatever thread they are deleted, and in spite of an interrupt."""

import threading
from collections.abc import Callable

import pytest

from drivers.interfaces.forgotten import watch_for_end


class Thing:
    """Something that can be deleted."""


def watched(end: Callable[[], object]) -> list[Thing]:
    """A list with a thing that is watched."""
    thing = Thing()
    watch_for_end(thing, end)
    return [thing]


def test_the_end_is_done_at_once_on_the_main_thread() -> None:
    done: list[threading.Thread] = []
    kept = watched(lambda: done.append(threading.current_thread()))
    assert not done
    kept.clear()
    assert done == [threading.main_thread()]


def test_on_another_thread_it_gets_one_that_python_waits_for() -> None:
    done: list[threading.Thread] = []
    ended = threading.Event()

    def end() -> None:
        done.append(threading.current_thread())
        ended.set()

    kept = watched(end)
    dropping = threading.Thread(target=kept.clear, daemon=True)
    dropping.start()
    dropping.join()
    assert ended.wait(10)
    assert done[0] is not dropping
    assert not done[0].daemon


def test_at_the_end_of_python_where_no_thread_begins_it_is_done_there(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[threading.Thread] = []
    kept = watched(lambda: done.append(threading.current_thread()))
    dropping = threading.Thread(target=kept.clear)
    start = threading.Thread.start

    def refuse(self: threading.Thread) -> None:
        if self is dropping:
            return start(self)
        raise RuntimeError("can't create new thread at interpreter shutdown")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    dropping.start()
    dropping.join()
    assert done == [dropping]


def test_an_interrupt_does_not_keep_a_device_from_being_made_safe() -> None:
    tried: list[int] = []

    def end() -> None:
        tried.append(1)
        if len(tried) == 1:
            raise KeyboardInterrupt

    finalizer = watch_for_end(kept := Thing(), end)
    with pytest.raises(KeyboardInterrupt):
        finalizer()
    assert len(tried) == 2
    del kept
    assert len(tried) == 2
