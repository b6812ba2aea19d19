"""The feed of a run: what readers of its slot get, what it costs a run that nobody watches, and how it ends one."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.interfaces import BeamScanner, LineLaser, SyncSource
from rig import api
from rig.live import feed as feed_module
from rig.live.feed import Feed, finite, free_bytes
from rig.live.slot import SlotReader, SlotWriter, Value
from rig.recording.map_rows import MapRows
from tests.system.small_rig import HEIGHT, WIDTH, emulated, write_rig

PATIENCE_S = 60.0
"""A test that waits so long for something has failed."""


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "spadrig"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C interrupts, also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    return write_rig(tmp_path / "small")


class Watcher:
    """A reader on a thread of its own. values: what came of each section; `wait` until it has seen something."""

    def __init__(self, row: int | None = None) -> None:
        self.values: dict[str, list[Value]] = {}
        self.reader: SlotReader | None = None
        self._row = row
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (found := SlotReader.newest()) is None and not self._ended.is_set():
            time.sleep(0.005)
        if found is None:
            return
        with SlotReader.open(found.path) as self.reader:
            alive = True
            while alive and not self._ended.is_set():
                alive = self.reader.alive
                self.reader.touch(self._row)
                for section in ("setup", "status", "frame", "map", "row"):
                    seen = self.values.setdefault(section, [])
                    value = self.reader.read(section, seen[-1].number if seen else 0)
                    if value is not None:
                        seen.append(value)
                time.sleep(0.01)
            self.reader = None

    def wait(self, seen: Callable[[], object]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not seen():
            assert time.monotonic() < until, {name: len(values) for name, values in self.values.items()}
            time.sleep(0.01)

    def end(self) -> None:
        self._ended.set()
        self._thread.join(PATIENCE_S)


@pytest.fixture
def watched() -> Iterator[Callable[..., Watcher]]:
    made: list[Watcher] = []

    def watch(row: int | None = None) -> Watcher:
        made.append(Watcher(row))
        return made[-1]

    yield watch
    for each in made:
        each.end()


def test_readers_get_the_run_its_frames_its_map_and_the_row_they_follow(
    small: Path, tmp_path: Path, watched: Callable[..., Watcher]
) -> None:
    watcher = watched(row=20)
    monitor = watcher.values

    def wait_for_reader(now: object) -> None:
        watcher.wait(lambda: monitor.get("frame"))

    # A simulated rig is so quick that the whole scan may be over before a reader has found it.
    result = api.scan(small, maps=40, out=tmp_path / "run", live=wait_for_reader)
    watcher.wait(lambda: watcher.reader is None)
    setup, status, found, row = (monitor[name][-1] for name in ("setup", "status", "map", "row"))
    assert result.last is not None
    assert setup.header["config"]["name"] == "small"
    assert (setup.header["kind"], setup.header["rows"], setup.header["width"]) == ("scan", HEIGHT, WIDTH)
    assert (setup.header["columns"], setup.header["exposures"], setup.header["maps"]) == (200, 4, 40)
    assert setup.header["folder"] == str(tmp_path / "run")
    assert setup.arrays["u"].shape == (HEIGHT, WIDTH)
    assert found.header["index"] == 39
    for name in ("depth_m", "confidence", "depth_sd_m", "intensity"):
        np.testing.assert_array_equal(found.arrays[name], getattr(result.last, name))
    for name, array in result.last.stripe.arrays().items():
        np.testing.assert_array_equal(found.arrays[f"stripe/{name}"], array)
    kept = np.load(tmp_path / "run/depth/000039.npy")
    np.testing.assert_array_equal(found.arrays["depth_m"], kept)
    assert status.header["sweeps"] == 40
    assert status.header["frames"] == status.header["frames_planned"] > 0
    assert status.header["laser"]["emission"] is False, "the last status is that of the rig made safe"
    assert status.header["disk"]["free_bytes"] > 0
    assert status.header["verdict_reasons"] == [reason.reason for reason in result.summary.verdict_reasons]
    assert status.header["map_rate_hz"] > 0
    assert row.header == {"map": row.header["map"], "row": 20, "exposures": 4}
    assert row.arrays["counts"].shape == (200, WIDTH)
    assert row.arrays["counts"].max() <= 4
    begin, end = row.arrays["begin_px"], row.arrays["end_px"]
    assert ((begin >= 0) & (end <= WIDTH)).all()
    frame = monitor["frame"][-1]
    assert frame.arrays["counts"].shape == (HEIGHT, WIDTH)
    assert frame.arrays["counts"].max() <= frame.header["frames"] <= 16


def test_a_row_is_followed_also_where_columns_are_judged_as_they_come(
    small: Path, tmp_path: Path, watched: Callable[..., Watcher]
) -> None:
    watcher = watched(row=20)

    def slowly(now: object) -> None:
        watcher.wait(lambda: watcher.values.get("status"))
        time.sleep(0.05)

    api.scan(small, maps=40, estimator="likelihood", out=tmp_path / "run", record=True, live=slowly)
    watcher.wait(lambda: watcher.reader is None)
    streamed = [row for row in watcher.values["row"] if row.header["map"] > 0]
    assert streamed, [row.header for row in watcher.values["row"]]
    recorded = MapRows(tmp_path / "run")
    for row in streamed:
        assert row.header["row"] == 20
        np.testing.assert_array_equal(row.arrays["counts"], recorded.row(row.header["map"], 20).counts)
    assert any(row.arrays["counts"].any() for row in streamed)


def test_while_nobody_watches_nothing_is_copied_and_no_frame_is_summed(
    small: Path, own_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks: list[int] = []
    written = monkeypatch_calls(monkeypatch, SlotWriter, "write")

    def live(now: object) -> None:
        blocks.extend(path.stat().st_blocks for path in own_folder.iterdir())

    result = api.scan(small, maps=3, live=live)
    assert written == []
    assert blocks
    assert max(blocks) * 512 <= 128 * 1024
    assert result.summary.stages is not None
    assert result.summary.stages.monitor_updates is None
    assert list(own_folder.iterdir()) == []


def monkeypatch_calls(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> list[object]:
    """The calls of a method from now on, each as its first argument behind the object."""
    calls: list[object] = []
    original = getattr(owner, name)

    def noted(self: object, *arguments: object) -> object:
        calls.append(arguments[0] if arguments else self)
        return original(self, *arguments)

    monkeypatch.setattr(owner, name, noted)
    return calls


def test_an_error_in_the_feed_is_told_once_and_ends_no_scan(
    small: Path, watched: Callable[..., Watcher], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise MemoryError("no page is left")

    monkeypatch.setattr(SlotWriter, "write", broken)
    watcher = watched()
    result = api.scan(small, maps=20, live=lambda now: watcher.wait(lambda: caplog.records))
    assert (result.summary.maps, result.summary.verdict.value) == (20, "complete")
    assert [(record.levelno, record.getMessage()) for record in caplog.records] == [
        (logging.WARNING, "the live view of this run ends: MemoryError: no page is left")
    ]
    watcher.wait(lambda: watcher.reader is None)


def test_a_run_whose_slot_cannot_be_made_goes_on_without(
    small: Path, own_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    own_folder.mkdir(mode=0o755)
    assert api.scan(small).summary.verdict.value == "complete"
    assert [record.getMessage() for record in caplog.records] == [
        f"nobody can watch this run: {own_folder} is open to others (mode 755), so live views do not use it: remove it,"
        " or name another XDG_RUNTIME_DIR"
    ]


def test_a_feed_that_hangs_is_left_behind(
    small: Path, watched: Callable[..., Watcher], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hangs, released = threading.Event(), threading.Event()

    def hang(folder: Path) -> None:
        hangs.set()
        released.wait(PATIENCE_S)

    monkeypatch.setattr(feed_module, "free_bytes", hang)
    monkeypatch.setattr(feed_module, "_END_S", 0.01)
    watched()
    result = api.scan(small, maps=5, out=small.parent / "run", live=lambda now: hangs.wait(PATIENCE_S))
    released.set()
    assert result.summary.maps == 5
    assert "the live view hangs and is left behind" in caplog.text


def test_a_stop_that_a_reader_asks_for_makes_the_rig_safe_gate_first(
    small: Path, watched: Callable[..., Watcher], monkeypatch: pytest.MonkeyPatch, interruptible: None
) -> None:
    watcher, names, asked_s = watched(), list[str](), list[float]()

    def live(now: object) -> None:
        watcher.wait(lambda: watcher.reader is not None)
        assert watcher.reader is not None
        names.clear()
        asked_s.append(time.monotonic())
        watcher.reader.request_stop()
        time.sleep(PATIENCE_S)  # until the signal interrupts it

    for owner, name in ((SyncSource, "abort"), (LineLaser, "pause"), (BeamScanner, "park")):
        note_calls(monkeypatch, owner, name, names)
    result = api.scan(small, maps=10_000, live=live)
    assert time.monotonic() - asked_s[-1] < PATIENCE_S
    assert result.summary.verdict.value == "aborted"
    assert names[:3] == ["abort", "pause", "park"]


def note_calls(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, names: list[str]) -> None:
    original = getattr(owner, name)

    def noted(self: object) -> None:
        names.append(name)
        original(self)

    monkeypatch.setattr(owner, name, noted)


def test_a_stop_ends_a_scan_on_a_thread_too_and_leaves_the_main_thread_alone(
    small: Path, watched: Callable[..., Watcher]
) -> None:
    watcher, verdicts = watched(), []

    def live(now: object) -> None:
        watcher.wait(lambda: watcher.reader is not None)
        if watcher.reader is not None:
            watcher.reader.request_stop()

    thread = threading.Thread(
        target=lambda: verdicts.append(api.scan(small, maps=10_000, live=live).summary.verdict.value)
    )
    thread.start()
    thread.join(PATIENCE_S)
    assert verdicts == ["aborted"]


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("ignored", [False, True], ids=["at a terminal", "in the background"])
def test_a_scan_that_a_reader_stops_exits_4_and_keeps_its_maps(small: Path, tmp_path: Path, ignored: bool) -> None:
    handler = "signal.SIG_IGN" if ignored else "signal.default_int_handler"
    program = f"import signal; signal.signal(signal.SIGINT, {handler}); from rig.cli.main import main; main()"
    command = [sys.executable, "-c", program, "scan", str(small), "--maps", "100000", "--save", "last"]
    out = tmp_path / "run"
    with subprocess.Popen([*command, "--json", "--out", str(out)], stdout=-1, stderr=-1, text=True) as process:
        watcher = Watcher()
        try:
            watcher.wait(lambda: watcher.values.get("map") or process.poll() is not None)
            assert watcher.reader is not None
            watcher.reader.request_stop()
            printed, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            watcher.end()
    assert process.returncode == 4, said
    assert json.loads(printed)["verdict"] == "aborted"
    assert "Traceback" not in said
    assert (out / "summary.json").exists()


def test_a_process_that_handles_no_signal_is_told_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: signal.SIG_IGN)
    feed_module.interrupt()
    assert "handles neither SIGINT nor SIGTERM" in caplog.text


def test_a_replay_has_a_slot_of_its_kind(small: Path, tmp_path: Path, watched: Callable[..., Watcher]) -> None:
    api.scan(small, out=tmp_path / "take", record=True)
    watcher = watched()
    api.replay(tmp_path / "take", live=lambda now: watcher.wait(lambda: watcher.values.get("setup")))
    header = watcher.values["setup"][0].header
    assert (header["kind"], header["name"]) == ("replay", "take")


@pytest.mark.long
def test_the_lasers_word_comes_from_the_guard_which_asks_it_anyway(
    tmp_path: Path, watched: Callable[..., Watcher]
) -> None:
    watcher = watched()
    seen = watcher.values

    def live(now: object) -> None:
        if not any(value.header["laser"].get("emission") for value in seen.get("status", ())):
            watcher.wait(lambda: len(seen.get("status", ())) > 1)

    content = emulated()
    content["scan"]["exposures"] = 10
    api.scan(write_rig(tmp_path / "emulated", content), maps=60, live=live)
    lasers = [value.header["laser"] for value in seen["status"]]
    assert any(laser.get("emission") and laser["interlock_closed"] for laser in lasers)
    warm = [value.header["temperatures"] for value in seen["status"] if value.header["laser"].get("emission")]
    assert all(set(each) == {"laser"} for each in warm)


def test_numbers_that_are_not_finite_become_null() -> None:
    content = {"a": np.float32(np.nan), "b": [1.0, float("inf")], "c": {"d": np.int64(3)}, "e": (None, "x", True)}
    assert finite(content) == {"a": None, "b": [1.0, None], "c": {"d": 3}, "e": [None, "x", True]}


def test_the_disk_of_a_folder_that_is_still_to_be_made_is_that_above_it(tmp_path: Path) -> None:
    free = free_bytes(tmp_path / "not" / "yet")
    assert free is not None
    assert free > 0


def test_a_feed_without_a_run_has_no_slot(own_folder: Path) -> None:
    with Feed("scan", "lab"):
        assert SlotReader.running() == []
