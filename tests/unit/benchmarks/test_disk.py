"""The disk's bench: the same bytes in all four rows, and nothing left on the disk."""

from pathlib import Path

import pytest

from tests.benchmarks import disk


def test_rows_are_of_the_same_bytes_and_leave_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []

    def recorded(folder: Path) -> None:
        read.append(sum(file.stat().st_size for file in folder.glob("*.spb")))
        assert read[-1] == (folder.parent / "plain").stat().st_size

    monkeypatch.setattr(disk, "BLOCKS", 2)
    monkeypatch.setattr(disk, "GIGABYTES", 0.05)
    monkeypatch.setattr(disk, "ROUNDS", 1)
    monkeypatch.setattr(disk, "_read", recorded)
    rows = disk.measure_disk(tmp_path)
    assert [row.stage for row in rows] == ["record-plain", "record", "read-plain", "read"]
    assert [row.of_plain is None for row in rows] == [True, False, True, False]
    assert all(row.mb_per_s > 0 and row.cpu_s_per_gb >= 0 for row in rows)
    assert len(read) == 1
    assert list(tmp_path.iterdir()) == []
