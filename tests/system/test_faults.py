"""A few trials of `tests.campaigns.faults`, and that its judge sees what is wrong."""

import sys

import pytest

from rig.run_folder.manifest import RunVerdict
from rig.scan import scan
from tests.campaigns.faults import together
from tests.campaigns.faults.injected import FAULTS
from tests.campaigns.faults.trial import trial


@pytest.mark.parametrize(
    ("seed", "only"),
    [
        (1, ["blocks lost", "disk full"]),
        (3, ["no memory", "monitor killed"]),
        (5, list(FAULTS)),
    ],
)
def test_nothing_is_lost_changed_or_left_in_silence(seed: int, only: list[str]) -> None:
    assert trial(seed, only)["wrong"] == []


def test_a_scan_that_is_always_complete_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan, "verdict_of", lambda *_, **__: RunVerdict.COMPLETE)
    assert any("nobody says so" in why for seed in range(5) for why in trial(seed, ["blocks lost"])["wrong"])


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="kills a process as POSIX does")
def test_two_applications_do_not_spoil_each_others_maps() -> None:
    assert together.trial(2)["wrong"] == []
