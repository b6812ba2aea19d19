"""Locks of files that another thread or process may remove at any moment."""

import threading
from pathlib import Path

from rig.run_folder.disk import is_held


def test_a_file_that_is_not_there_is_not_held(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    assert not is_held(tmp_path / "other")
    assert not is_held(file / "below")
    assert not is_held(file)


def test_a_file_that_goes_while_it_is_looked_at_is_not_held(tmp_path: Path) -> None:
    file, over = tmp_path / "file", threading.Event()

    def comes_and_goes() -> None:
        while not over.is_set():
            file.touch()
            file.unlink(missing_ok=True)

    thread = threading.Thread(target=comes_and_goes)
    thread.start()
    try:
        assert not any(is_held(file) for _ in range(2000))
    finally:
        over.set()
        thread.join()
