"""A few sequences of the campaign against recordings, and that it sees what it looks for."""

import logging
from pathlib import Path

import pytest

from drivers.recorded import contents, reader
from tests.campaigns.outcomes import campaign
from tests.campaigns.recording.corruptions import make_sequence

SEEDS = range(3_000_000, 3_000_150)


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)


def test_damage_is_found_or_harmless(tmp_path: Path) -> None:
    assert campaign(make_sequence(tmp_path), SEEDS).wrong == []


def test_the_campaign_sees_frames_that_were_not_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unchecked = contents._block_at
    monkeypatch.setattr(reader, "read_entry", lambda segment, entry: unchecked(segment, entry, check_payload=False))
    assert campaign(make_sequence(tmp_path), SEEDS).wrong
