"""The slot between a run and its viewers: whole values only, and nobody who watches can harm the run."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rig.errors import UsageError
from rig.live import slot as slot_module
from rig.live.slot import WATCHED_S, SlotReader, SlotWriter
from rig.live.slot_files import slot_folder

CAPACITIES = {"status": 1000, "map": 600_000}
MAP = np.arange(140_000, dtype=np.float32).reshape(350, 400)

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="locks and signals of POSIX")


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "spadrig"


@pytest.fixture
def writer() -> Iterator[SlotWriter]:
    with SlotWriter.create("scan", "lab", CAPACITIES) as made:
        yield made


@pytest.fixture
def reader(writer: SlotWriter) -> Iterator[SlotReader]:
    with SlotReader.open(writer.path) as made:
        yield made


def child(code: str, *arguments: object) -> "subprocess.Popen[str]":
    """A process that runs `code`, with the slot's module imported, and prints a line for `ready`."""
    head = "import os, signal, sys, time\nimport numpy as np\nfrom pathlib import Path\nfrom rig.live import slot\n"
    command = [sys.executable, "-c", head + code, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def ready(*processes: "subprocess.Popen[str]") -> None:
    for each in processes:
        assert each.stdout is not None
        assert each.stdout.readline() == "ready\n"


def end(*processes: "subprocess.Popen[str]") -> None:
    for each in processes:
        each.kill()
        each.wait()
        assert each.stdout is not None
        each.stdout.close()


HAMMER = """
with slot.SlotWriter.create("scan", "hammer", {"map": 600_000}) as writer:
    print("ready", flush=True)
    for number in range(1, 10**9):
        writer.write("map", {"number": number}, {"a": np.full(70_000, number, np.uint32), "b": np.full(9, number)})
"""


def test_values_come_back_with_their_headers_dtypes_and_shapes(writer: SlotWriter, reader: SlotReader) -> None:
    assert reader.read("map") is None
    arrays = {
        "depth_m": MAP,
        "flags": np.array([True, False]),
        "none": np.zeros((0, 3), np.int16),
        "one": np.float64(2),
    }
    writer.write("map", {"index": 3, "fog": None, "name": "Straße"}, arrays)
    value = reader.read("map")
    assert value is not None
    assert (value.number, value.header) == (1, {"index": 3, "fog": None, "name": "Straße"})
    for name in ("depth_m", "flags", "none"):
        np.testing.assert_array_equal(value.arrays[name], arrays[name])
        assert value.arrays[name].dtype == arrays[name].dtype
    assert value.arrays["one"].tolist() == [2.0]


def test_a_reader_gets_the_newest_value_and_only_newer_ones(writer: SlotWriter, reader: SlotReader) -> None:
    for index in range(5):
        writer.write("status", {"index": index})
    value = reader.read("status")
    assert value is not None
    assert (value.number, value.header["index"]) == (5, 4)
    assert reader.read("status", newer_than=5) is None
    writer.write("status", {"index": 5})
    newer = reader.read("status", newer_than=5)
    assert newer is not None
    assert newer.number == 6


def test_a_value_stays_as_it_was_when_the_next_ones_are_written(writer: SlotWriter, reader: SlotReader) -> None:
    writer.write("map", {}, {"depth_m": MAP})
    value = reader.read("map")
    assert value is not None
    for _ in range(3):
        writer.write("map", {}, {"depth_m": -MAP})
    np.testing.assert_array_equal(value.arrays["depth_m"], MAP)
    with pytest.raises(ValueError, match="read-only"):
        value.arrays["depth_m"][0, 0] = 1


def test_a_value_above_the_capacity_is_refused_and_the_older_one_stays(writer: SlotWriter, reader: SlotReader) -> None:
    writer.write("map", {"index": 1}, {"depth_m": MAP})
    with pytest.raises(ValueError, match="of section map takes 1120064 bytes"):
        writer.write("map", {}, {"depth_m": MAP.astype(np.float64)})
    value = reader.read("map")
    assert value is not None
    assert value.header == {"index": 1}


def test_no_read_is_torn_while_another_process_hammers() -> None:
    hammer = child(HAMMER)
    try:
        ready(hammer)
        found = SlotReader.newest()
        assert found is not None
        with SlotReader.open(found.path) as reader:
            last, reads, until = 0, 0, time.monotonic() + 1.5
            while time.monotonic() < until:
                value = reader.read("map", last)
                if value is None:
                    continue
                assert value.number > last
                last, reads = value.number, reads + 1
                assert value.header == {"number": last}
                assert value.arrays["a"].min() == value.arrays["a"].max() == last
                assert set(value.arrays["b"].tolist()) == {last}
            assert reads > 20
    finally:
        end(hammer)


def test_a_copy_that_was_overwritten_meanwhile_is_made_again(
    writer: SlotWriter, reader: SlotReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer.write("map", {"index": 1}, {"depth_m": MAP})
    copy, copies = reader._copy, []

    def overtaken(*where: int) -> object:
        value = copy(*where)
        if not copies:
            writer.write("map", {"index": 2}, {"depth_m": MAP})
            writer.write("map", {"index": 3}, {"depth_m": MAP})
        copies.append(value)
        return value

    monkeypatch.setattr(reader, "_copy", overtaken)
    value = reader.read("map")
    assert value is not None
    assert (value.header["index"], len(copies)) == (3, 2)


def test_a_writer_that_dies_in_the_middle_leaves_the_last_whole_value(own_folder: Path) -> None:
    dying = child(
        """
writer = slot.SlotWriter.create("scan", "dies", {"map": 600_000})
writer.write("map", {"index": 1}, {"a": np.full(70_000, 1)})
writer.write("map", {"index": 2}, {"a": np.full(70_000, 2)})
print("ready", flush=True)
time.sleep(0.3)
slot.crc32 = lambda data: os.kill(os.getpid(), signal.SIGKILL)
writer.write("map", {"index": 3}, {"a": np.full(70_000, 3)})
"""
    )
    ready(dying)
    found = SlotReader.newest()
    assert found is not None
    with SlotReader.open(found.path) as reader:
        assert reader.alive
        assert dying.wait(20) == -signal.SIGKILL
        assert not reader.alive
        value = reader.read("map")
        assert value is not None
        assert (value.header, set(value.arrays["a"].tolist())) == ({"index": 2}, {2})
    assert SlotReader.running() == []
    assert found.path.exists()
    with SlotWriter.create("scan", "next", CAPACITIES) as following:
        assert [path.name for path in own_folder.iterdir()] == [following.path.name]
    end(dying)


def test_readers_that_are_killed_hung_or_flooding_delay_no_write(writer: SlotWriter) -> None:
    reads = """
reader = slot.SlotReader.open(Path(sys.argv[1]))
print("ready", flush=True)
while True:
    reader.touch(7)
    reader.read("map")
"""
    writer.write("map", {"index": 0}, {"depth_m": MAP})
    flooding, hung, killed = (child(reads, writer.path) for _ in range(3))
    try:
        ready(flooding, hung, killed)
        hung.send_signal(signal.SIGSTOP)
        killed.kill()
        assert writer.watched
        assert writer.wanted_row == 7
        for index in range(1, 200):
            writer.write("map", {"index": index}, {"depth_m": MAP})
        with SlotReader.open(writer.path) as fresh:
            value = fresh.read("map")
            assert value is not None
            assert value.header["index"] == 199
    finally:
        end(flooding, hung, killed)


def test_a_run_is_watched_for_two_seconds_after_a_heartbeat(
    writer: SlotWriter, reader: SlotReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [time.monotonic_ns()]
    monkeypatch.setattr(slot_module.time, "monotonic_ns", lambda: now[0])
    assert not writer.watched
    reader.touch(30)
    reader.touch(31)
    now[0] += int(0.6 * WATCHED_S * 1e9)
    reader.touch()
    assert writer.wanted_row == 31
    now[0] += int(0.6 * WATCHED_S * 1e9)
    assert writer.watched
    assert writer.wanted_row is None, "nobody has asked for a row since"
    now[0] += int(0.6 * WATCHED_S * 1e9)
    assert not writer.watched


def test_a_stop_is_asked_for_through_the_slot(writer: SlotWriter, reader: SlotReader) -> None:
    assert not writer.stop_requested
    reader.request_stop()
    assert writer.stop_requested


def test_a_run_that_ended_can_still_be_read_and_is_no_longer_listed(own_folder: Path) -> None:
    with SlotWriter.create("replay", "take", CAPACITIES) as writer:
        writer.write("status", {"maps": 2})
        reader = SlotReader.open(writer.path)
        assert reader.alive
    assert not reader.alive
    value = reader.read("status")
    assert value is not None
    assert value.header == {"maps": 2}
    assert list(own_folder.iterdir()) == []
    writer.write("status", {"maps": 3})
    assert reader.read("status", value.number) is None
    reader.close()
    reader.close()
    writer.close()


def test_two_runs_at_once_have_slots_of_their_own() -> None:
    with SlotWriter.create("scan", "one", CAPACITIES) as one:
        time.sleep(0.002)
        with SlotWriter.create("replay", "two", CAPACITIES) as two:
            one.write("status", {"run": 1})
            two.write("status", {"run": 2})
            assert [(each.kind, each.name, each.pid) for each in SlotReader.running()] == [
                ("replay", "two", os.getpid()),
                ("scan", "one", os.getpid()),
            ]
            with SlotReader.open(one.path) as first, SlotReader.open(two.path) as second:
                first.request_stop()
                assert (one.stop_requested, two.stop_requested) == (True, False)
                values = [reader.read("status") for reader in (first, second)]
                assert [value and value.header["run"] for value in values] == [1, 2]
        assert [each.name for each in SlotReader.running()] == ["one"]


def test_files_are_the_users_alone_and_take_no_room_until_somebody_reads(writer: SlotWriter, own_folder: Path) -> None:
    assert own_folder.stat().st_mode & 0o777 == 0o700
    assert writer.path.stat().st_mode & 0o777 == 0o600
    assert writer.path.stat().st_size > 1_200_000
    assert writer.path.stat().st_blocks * 512 <= 128 * 1024


def test_a_folder_that_others_can_enter_is_refused(own_folder: Path) -> None:
    own_folder.mkdir(mode=0o755)
    with pytest.raises(UsageError, match=r"spadrig is open to others \(mode 755\), .* remove it"):
        SlotWriter.create("scan", "lab", CAPACITIES)
    with pytest.raises(UsageError, match="open to others"):
        SlotReader.running()


def test_a_link_in_the_place_of_the_folder_is_refused(own_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    own_folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="neither a folder nor a file"):
        SlotWriter.create("scan", "lab", CAPACITIES)


def test_another_users_folder_and_slot_are_refused(writer: SlotWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    me = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: me + 1)
    with pytest.raises(UsageError, match=f"belongs to user {me}, not to you"):
        SlotReader.open(writer.path)
    other = writer.path.parent.parent
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(other))
    (other / f"spadrig-{me + 1}").mkdir(mode=0o700)
    with pytest.raises(UsageError, match=f"belongs to user {me}"):
        slot_folder()


def test_a_slot_that_others_can_read_is_neither_listed_nor_opened(writer: SlotWriter) -> None:
    writer.path.chmod(0o644)
    assert SlotReader.running() == []
    with pytest.raises(UsageError, match=r"open to others \(mode 644\)"):
        SlotReader.open(writer.path)


def test_a_runtime_folder_that_is_gone_is_replaced_by_the_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    assert slot_folder() == tmp_path / f"spadrig-{os.getuid()}"


@pytest.mark.parametrize("content", [b"", b"nothing of ours" * 9999, b"\0" * 8192 + b"SPADLIV1" + b"\xff" * 99])
def test_what_is_no_slot_is_refused_and_an_old_one_removed(own_folder: Path, content: bytes) -> None:
    slot_folder()
    path = own_folder / "live-99-0.slot"
    path.write_bytes(content)
    path.chmod(0o600)
    assert SlotReader.running() == []
    with pytest.raises(UsageError, match=r"live-99-0.slot is no slot of a live view"):
        SlotReader.open(path)
    SlotWriter.create("scan", "lab", CAPACITIES).close()
    assert path.exists() == (content == b""), "an empty file may be in the making"
    if path.exists():
        os.utime(path, (1, 1))
        SlotWriter.create("scan", "lab", CAPACITIES).close()
        assert not path.exists()
