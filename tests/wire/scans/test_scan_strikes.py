"""A blow of each sort to a real scan over emulated wires, in a process of its own: light is what is looked at.

Hundreds of each, and how soon it is dark: `python -m tests.campaigns.devices.guard_kill`.
"""

from collections.abc import Iterator
from contextlib import closing

import pytest

from tests.wire.emulated_lasers import PATIENCE_S
from tests.wire.scans.scan_rig import Applications, ScanFailedError, scan_bench
from tests.wire.scans.scan_strikes import BY_HAND, SCAN_STRIKES, strike_scan, trouble_of
from tests.wire.usb.umockdev import missing

SHARES = {name: 0.05 + 0.3 * i / len(SCAN_STRIKES) for i, name in enumerate(SCAN_STRIKES)}
SHARES["application killed"] = 0.8  # most of the way is the opening
SCANS_TRIED = 5
"""On a busy machine an emulated device may answer too late, and the scan ends before it has begun."""

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def scans() -> Iterator[Applications]:
    with closing(Applications()) as made:
        yield made


def test_a_scan_that_nobody_strikes_shines_on_a_moving_mirror_only(scans: Applications) -> None:
    with scan_bench(scans, "obis") as bench:
        bench.start(maps=4)
        bench.await_light()
        code = scans.exit_code(bench.number, PATIENCE_S)
        if "took no frame" not in bench.said:  # the emulated SPAD shares a busy machine, and may be late for the guard
            assert code == 0, bench.said
            assert "verdict  complete" in bench.said
            assert len(bench.light(bench.started_s)) == 4
        assert bench.light_at_rest(bench.started_s) == []


OTHERS = {
    "cobolt": ("guard killed",),
    "ibeam": ("guard killed", "laser unplugged", "laser's firmware hangs", "interlock opened"),
    BY_HAND: ("application killed", "guard killed", "gate's firmware hangs", "gate unplugged"),
}
STRIKES = [*((name, "obis") for name in SCAN_STRIKES), *((name, laser) for laser in OTHERS for name in OTHERS[laser])]
ALWAYS = {
    ("application killed", "obis"),
    ("guard killed", "obis"),
    ("gate's firmware hangs", "obis"),
    ("spad unplugged", "obis"),
    ("laser unplugged", "obis"),
    ("interlock opened", "obis"),
    ("disk full", "obis"),
    ("etherdream starved", "obis"),
    ("teensy hangs", "obis"),
    ("ni card's server gone", "obis"),
    ("gate unplugged", BY_HAND),
}
"""Tried in each run of the tests; the others are `long`."""


@pytest.mark.parametrize(
    ("name", "laser"),
    [pytest.param(*strike, marks=[] if strike in ALWAYS else [pytest.mark.long]) for strike in STRIKES],
)
def test_a_struck_scan_goes_dark_and_says_so(name: str, laser: str, scans: Applications) -> None:
    for attempt in range(SCANS_TRIED):
        try:
            outcome = strike_scan(scans, name, laser, SHARES[name], measured=False)
            break
        except ScanFailedError:
            if attempt == SCANS_TRIED - 1:
                raise
    # A scan whose frames stopped before the blow is dark all the same.
    assert [trouble for trouble in trouble_of(name, outcome) if "took no frame" not in trouble] == []
