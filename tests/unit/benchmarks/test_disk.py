"""The disk's bench: the same bytes in all four rows, and nothing left on the disk."""

import errno
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from rig.errors import RecordingError, UsageError
from tests.benchmarks import disk


def test_rows_are_of_the_same_bytes_and_leave_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = []
    monkeypatch.setattr(disk, "BLOCKS", 2)
    monkeypatch.setattr(disk, "GIGABYTES", 0.05)
    monkeypatch.setattr(disk, "ROUNDS", 1)
    monkeypatch.setattr(disk, "_read", lambda folder: read.append(sum(f.stat().st_size for f in folder.glob("*.spb"))))
    report = disk.measure_disk(tmp_path)
    assert [row.stage for row in report.rows] == ["record-plain", "record", "read-plain", "read"]
    assert [row.of_plain is None for row in report.rows] == [True, False, True, False]
    assert all(row.mb_per_s > 0 and row.cpu_s_per_gb >= 0 for row in report.rows)
    assert read == [round(report.gigabytes * 1e9)]
    disk.disk_table(report)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[-4:]] == [row.stage for row in report.rows]
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_on_the_way_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(disk, "GIGABYTES", 0.05)
    monkeypatch.setattr(disk.os, "pwritev", full)
    with pytest.raises(RecordingError, match=r"cannot measure the disk of .*No space left"):
        disk.measure_disk(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_or_has_no_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="is no folder"):
        disk.measure_disk(tmp_path / "absent")
    monkeypatch.setattr(disk, "GIGABYTES", 1e9)
    with pytest.raises(UsageError, match="free some"):
        disk.measure_disk(tmp_path)


def test_plain_bytes_come_back_as_they_were_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, source = _plain(tmp_path, monkeypatch)
    _write_and_read(plain)
    written = plain.path.read_bytes()
    assert written == (bytes(source.memory) * 2)[: len(written)]
    assert len(written) == source.bytes


def _no_space(fd: int, pieces: Sequence[memoryview], offset: int) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _half(fd: int, pieces: Sequence[memoryview], offset: int) -> int:
    return len(pieces[0]) // 2


def _out_of_order(fd: int) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


@pytest.mark.parametrize(
    ("call", "fault", "message"),
    [
        ("pwritev", _no_space, "No space"),
        ("pwritev", _half, "of 4194304 bytes done at"),
        ("preadv", _half, "of 4194304 bytes done at"),
        ("fsync", _out_of_order, "Input/output"),
    ],
)
def test_what_a_thread_or_the_disk_fails_at_ends_the_bench_and_leaves_no_file_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, fault: Callable[..., object], message: str
) -> None:
    plain, _ = _plain(tmp_path, monkeypatch)
    opened, closed = _watched(monkeypatch)
    threads = threading.active_count()
    monkeypatch.setattr(disk.os, call, fault)
    with pytest.raises(OSError, match=message):
        _write_and_read(plain)
    assert opened == closed
    assert threading.active_count() == threads


def _plain(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[disk._Plain, disk._Source]:
    """A plain file of three blocks of a source that holds two."""
    monkeypatch.setattr(disk, "BLOCKS", 2)
    monkeypatch.setattr(disk, "FRAMES", 128)
    source = disk._Source(13_000_000)
    assert source.count == 3
    return disk._Plain(folder / "plain", source), source


def _write_and_read(plain: disk._Plain) -> None:
    plain.write()
    plain.read()


def _watched(monkeypatch: pytest.MonkeyPatch) -> tuple[list[int], list[int]]:
    """File descriptors opened and closed from now on."""
    opened, closed = [], []
    really_open, really_close = os.open, os.close

    def open_(path: Path, flags: int) -> int:
        opened.append(really_open(path, flags))
        return opened[-1]

    def close(fd: int) -> None:
        closed.append(fd)
        really_close(fd)

    monkeypatch.setattr(disk.os, "open", open_)
    monkeypatch.setattr(disk.os, "close", close)
    return opened, closed
