"""The files by which another process switches the recording of a scan leave nothing behind."""

import threading
from pathlib import Path

import pytest

from rig.errors import UsageError
from rig.live import record_wish
from rig.live.record_wish import STATE, WISH, followed, record
from rig.scan.on_request import RecordingSwitch


def test_a_folder_whose_files_cannot_be_locked_keeps_no_file_and_no_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some network file systems have no locks. An open file would be a warning here, which is an error in tests."""

    def refused(fd: int) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(record_wish, "hold", refused)
    threads = threading.active_count()
    with pytest.raises(OSError, match="No locks available"), followed(tmp_path, RecordingSwitch()):
        pytest.fail("the scan must not begin")
    assert list(tmp_path.iterdir()) == []
    assert threading.active_count() == threads


def test_the_files_go_however_the_scan_ends(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    with followed(tmp_path, switch):
        (tmp_path / WISH).write_text("half a wi")
        assert not record(None, tmp_path).on
        assert (tmp_path / STATE).exists()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), followed(tmp_path, switch):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("before", [None, [1.0], "soon", -1.0, float("inf"), float("nan")])
def test_what_is_no_time_is_refused(before: object) -> None:
    with pytest.raises(UsageError, match="`before` is "):
        RecordingSwitch(before)  # type: ignore[arg-type]
