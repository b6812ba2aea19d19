"""The disk's bench: the same bytes in all four rows, and nothing left on the disk."""

import json
from pathlib import Path

import pytest

from rig import api, cli
from rig.bench import disk
from rig.errors import UsageError


def test_rows_are_of_the_same_bytes_and_leave_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = []
    monkeypatch.setattr(disk, "BLOCKS", 2)
    monkeypatch.setattr(disk, "GIGABYTES", 0.05)
    monkeypatch.setattr(disk, "ROUNDS", 1)
    monkeypatch.setattr(disk, "_read", lambda folder: read.append(sum(f.stat().st_size for f in folder.glob("*.spb"))))
    with pytest.raises(SystemExit) as ended:
        cli.main(["bench", "--disk", str(tmp_path), "--json"])
    assert ended.value.code == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["stage"] for row in report["rows"]] == ["record-plain", "record", "read-plain", "read"]
    assert [row["of_plain"] is None for row in report["rows"]] == [True, False, True, False]
    assert all(row["mb_per_s"] > 0 and row["cpu_s_per_gb"] >= 0 for row in report["rows"])
    assert read == [round(report["gigabytes"] * 1e9)]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_or_has_no_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="is no folder"):
        api.bench_disk(tmp_path / "absent")
    monkeypatch.setattr(disk, "GIGABYTES", 1e9)
    with pytest.raises(UsageError, match="free some"):
        api.bench_disk(tmp_path)
