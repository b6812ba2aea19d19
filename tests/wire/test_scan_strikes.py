"""A blow of each sort to a real scan over emulated wires, in a process of its own: light is what is measured.

Hundreds of each: `python -m tests.campaigns.devices.guard_kill`.
"""

from collections.abc import Iterator

import pytest

from tests.wire.guard_strikes import NEVER_S
from tests.wire.scan_rig import Applications, applications, scan_bench
from tests.wire.scan_strikes import SCAN_STRIKES, strike_scan, trouble_of
from tests.wire.usb.umockdev import missing

WAIT_S = 0.6
SHARES = {name: 0.15 + 0.5 * i / len(SCAN_STRIKES) for i, name in enumerate(SCAN_STRIKES)}
SHARES["application killed"] = 0.8  # most of the way is the opening
SHARES["spad falls silent"] = 0.75  # soon before the end of the gate's program
SHARES["spad silent under labour"] = 0.3
SCANS_TRIED = 3
"""Where other tests keep all cores busy, the emulated SPAD's frames may stop for longer than the guard allows."""

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def scans() -> Iterator[Applications]:
    with applications() as made:
        yield made


def test_a_scan_that_nobody_strikes_ends_complete_with_its_light_on_a_moving_mirror(scans: Applications) -> None:
    for _ in range(SCANS_TRIED):
        with scan_bench(scans, "obis") as bench:
            bench.start(maps=4)
            bench.await_light()
            code = scans.exit_code(bench.number, 20.0)
            if "took no frame" in bench.said:
                continue
            assert code == 0, bench.said
            assert "verdict  complete" in bench.said
            assert len(bench.light(bench.started_s)) == 4
            assert bench.light_at_rest(bench.started_s) == []
            return
    pytest.fail("no scan had its frames in time")


@pytest.mark.parametrize("name", SCAN_STRIKES)
def test_a_struck_scan_leaves_no_light(name: str, scans: Applications) -> None:
    outcome = strike_scan(scans, name, "obis", SHARES[name], WAIT_S)
    assert not outcome.over
    assert outcome.light_s < max(NEVER_S, SCAN_STRIKES[name].light_s)
    # A scan whose frames stopped before the blow is dark all the same.
    assert [trouble for trouble in trouble_of(name, outcome) if "took no frame" not in trouble] == []


def test_the_guard_of_a_slow_laser_is_killed_and_it_is_off_within_a_second(scans: Applications) -> None:
    outcome = strike_scan(scans, "guard killed", "cobolt", 0.2, WAIT_S)
    assert outcome.was_lit
    assert trouble_of("guard killed", outcome) == []
