"""The stream of `rig bench --soak`: each overload policy does what it says, and every frame is accounted for."""

import pytest

from rig.api import soak
from rig.bench import soak as soaking
from rig.errors import UsageError
from rig.scan import pipeline as overload

SLOW_MS = 400.0
"""Four times what the ring holds, so that it overflows on any machine."""


@pytest.fixture(autouse=True)
def _short_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soaking, "LOOP_S", 0.01)
    monkeypatch.setattr(overload, "RING_BYTES", 128 << 20)


def test_drop_goes_on_and_accounts_for_every_frame() -> None:
    found = soak(seconds=0.3, window=True, slow_consumer_ms=SLOW_MS, on_overload="drop")
    frames = found.frames
    assert found.ended_by is None
    assert found.maps == found.maps_planned
    assert frames.agree
    assert frames.exposed == frames.received + frames.lost
    assert frames.lost == found.stages.dropped_frames > 0
    assert frames.expected_in_sweeps == frames.received_in_sweeps + frames.lost_in_sweeps
    assert found.exit_code == 1


@pytest.mark.long
def test_abort_ends_at_the_first_block_without_a_slot() -> None:
    found = soak(seconds=0.3, window=True, slow_consumer_ms=SLOW_MS, on_overload="abort")
    assert found.ended_by is not None
    assert "--on-overload drop" in found.ended_by
    assert 1 <= found.stages.dropped_blocks <= 2  # of each start of the SPAD at most one
    assert 1 <= found.maps < found.maps_planned
    assert found.frames.lost_in_sweeps == 0
    assert found.frames.agree
    assert found.exit_code == 3


def test_block_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'block', but the looped SPAD cannot wait .*'abort' .* 'drop'"):
        soak(seconds=0.3, window=True, on_overload="block")
