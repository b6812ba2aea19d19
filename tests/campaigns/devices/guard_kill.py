"""Blows to real scans at random moments: how long there was light after them, and whether any fell on a mirror at rest.

python -m tests.campaigns.devices.guard_kill --kills 1000 --others 100 --seed 1

Each blow has a scan of its own, `rig scan` with real drivers over pseudo terminals and libusb, and emulated devices
that outlive it (tests/wire/scans). Light is emission AND gate. Passes where light is gone after 100 ms at the
99.9th percentile and never there after 500 ms, for each sort of blow (500 ms where the gate hears nothing any more),
where emission is off after 1 s wherever the laser's port still answers, no light ever fell on a mirror at rest, and
applications that lived ended with code 3 and a line that says why.

    python -m tests.campaigns.devices.guard_kill --kills 0 --others 0 --pairs 60

Pairs are two different blows, the second up to 50 ms after the first. They pass where light is gone after 500 ms, or
after the longer time that one of the two may take, and none fell on a mirror at rest. Where guard or application is
left, emission ends too, and the application does not go on for ever.
"""

import argparse
import functools
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.wire.scans.scan_rig import Applications, ScanFailedError
from tests.wire.scans.scan_strikes import (
    BY_HAND,
    NEVER_S,
    OPENING_S,
    SCAN_STRIKES,
    ScanOutcome,
    lateness_of,
    strike_scan,
    trouble_of,
)

KILL = "application killed"


@functools.cache
def applications() -> Applications:
    """Applications of this process; they end with it."""
    return Applications()


def blow(name: str, laser: str, share: float) -> dict[str, Any]:
    """One blow as a case: its outcome, or what was said where the scan did not come to light."""
    try:
        outcome = asdict(strike_scan(applications(), name, laser, share))
    except ScanFailedError as error:
        return {"failed": str(error)}
    endless = [key for key, value in outcome.items() if value == math.inf]  # which JSON does not have
    return {**outcome, "endless": endless}


def pair(name: str, then: str, apart_s: float, laser: str, share: float) -> dict[str, Any]:
    """Two blows as a case, as `blow` gives one."""
    try:
        outcome = asdict(strike_scan(applications(), name, laser, share, then=(then, apart_s)))
    except ScanFailedError as error:
        return {"failed": str(error)}
    endless = [key for key, value in outcome.items() if value == math.inf]
    return {**outcome, "endless": endless}


PAIRED = [
    name
    for name, made in SCAN_STRIKES.items()
    if (made.scanner, made.sync) == ("helios", "prawndo") and not made.labours and not made.lasting
]
"""Blows to one and the same rig."""
_GUARD = {"guard killed", "guard stopped"}
_APPLICATION = {"application killed", "application stopped", "gate's firmware hangs"}
"""Blows after which no application is left to end emission; without a guard either, the gate's own time ends light."""


def outcome_of(result: dict[str, Any] | None) -> ScanOutcome | str:
    """The outcome in the result of `blow`; what went wrong if there is none."""
    if result is None or "failed" in result:
        return "the case failed" if result is None else str(result["failed"])
    endless = result.pop("endless")
    del result["measured"]
    return ScanOutcome(**{**result, **dict.fromkeys(endless, math.inf)})


def main() -> int:
    """Run the campaign; 1 where a limit was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--others", type=int, default=100, help="blows of each other sort")
    parser.add_argument("--only", nargs="*", choices=[*SCAN_STRIKES], default=[*SCAN_STRIKES])
    parser.add_argument("--lasers", nargs="*", choices=[*OPENING_S], default=["obis", "cobolt"])
    parser.add_argument("--pairs", type=int, default=0, help="of two blows at once")
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    counts = {name: options.kills if name == KILL else options.others for name in options.only}
    blows = [
        {"name": name, "laser": options.lasers[i % len(options.lasers)], "share": float(random.random())}
        for name, count in counts.items()
        for i in range(count)
    ]
    pairs = [
        {
            **dict(zip(("name", "then"), map(str, random.choice(PAIRED, 2, replace=False)), strict=True)),
            "apart_s": float(random.uniform(0.0, 0.05)),
            "laser": options.lasers[i % len(options.lasers)],
            "share": float(random.random()),
        }
        for i in range(options.pairs)
    ]
    cases = [Case("tests.campaigns.devices.guard_kill:blow", each, each) for each in blows]
    cases += [Case("tests.campaigns.devices.guard_kill:pair", each, each) for each in pairs]
    outcomes = [outcome_of(result) for result in results_of(cases, options.workers, options.out)]
    passed = not pairs or _report_pairs(pairs, outcomes[len(blows) :])
    for name in counts:
        mine = [i for i, each in enumerate(blows) if each["name"] == name]
        passed &= _report(name, [blows[i]["laser"] for i in mine], [outcomes[i] for i in mine])
    return 0 if passed else 1


def _report_pairs(pairs: Sequence[dict[str, Any]], outcomes: Sequence[ScanOutcome | str]) -> bool:
    """Print what came of pairs of blows; return whether all of them passed."""
    light_s, wrong, lit = [0.0], 0, 0
    for drawn, outcome in zip(pairs, outcomes, strict=True):
        if isinstance(outcome, str):
            print(f"{drawn['name']}, {drawn['then']}: no blow, {outcome}", flush=True)
        elif not outcome.over:
            made = [SCAN_STRIKES[drawn[key]] for key in ("name", "then")]
            lit += outcome.was_lit
            light_s.append(outcome.light_s)
            troubles = [f"{1e3 * outcome.rest_s:.2f} ms of light at rest"] if outcome.rest_s else []
            longest_s = max(NEVER_S, *(each.light_s for each in made))
            if outcome.light_s > longest_s:
                troubles.append(f"light after {1e3 * outcome.light_s:.0f} ms")
            both = {drawn["name"], drawn["then"]}
            left = not (both & _GUARD and both & _APPLICATION)
            if left and all(each.laser_answers for each in made) and outcome.emission_s == math.inf:
                troubles.append("emission goes on")
            if left and outcome.code is None:
                troubles.append("the application goes on for ever")
            if "Traceback" in outcome.said:
                troubles.append("a traceback")
            if troubles:
                wrong += 1
                print(f"{drawn}: {'; '.join(troubles)} ({outcome.said.strip()[-300:]})", flush=True)
    median_s, most_s = float(np.median(light_s[1:] or 0.0)), max(light_s)
    print(
        f"pairs: {len(light_s) - 1} of {len(pairs)} dealt, {lit} while lit; light {1e3 * median_s:.0f} ms (median), "
        f"{1e3 * most_s:.0f} ms (most); {wrong} wrong",
        flush=True,
    )
    return not wrong


def _report(name: str, lasers: list[str], outcomes: list[ScanOutcome | str]) -> bool:
    for outcome in outcomes:
        if isinstance(outcome, str):
            print(f"{name}: no blow, {outcome}", flush=True)
    blows = zip(lasers, outcomes, strict=True)
    dealt = [(laser, outcome) for laser, outcome in blows if not isinstance(outcome, str) and not outcome.over]
    struck = [outcome for _, outcome in dealt]
    if not struck:
        return True
    made = SCAN_STRIKES[name]
    light_s = np.array([outcome.light_s for outcome in struck])
    emission_s = np.array([outcome.emission_s for outcome in struck])
    worst_s = float(np.percentile(light_s, 99.9))
    troubles = [late for laser, outcome in dealt for late in lateness_of(name, laser, outcome)]
    troubles += [trouble for outcome in struck for trouble in trouble_of(name, outcome)]
    if worst_s > made.light_s:
        troubles.append(f"light after {1e3 * worst_s:.0f} ms")
    if not made.laser_answers:
        dark = "emission of a lost port"
    elif BY_HAND in lasers:
        dark = "emission that no program ends"
    else:
        dark = f"emission {1e3 * emission_s.max():.0f} ms (most)"
    print(
        f"{name}: {len(struck)} blows, {sum(outcome.was_lit for outcome in struck)} while lit; light "
        f"{1e3 * np.median(light_s):.0f} ms (median), {1e3 * worst_s:.0f} ms (99.9 %), {1e3 * light_s.max():.0f} ms "
        f"(most); {dark}; at rest {1e3 * max(outcome.rest_s for outcome in struck):.1f} ms: "
        + ("; ".join(["WRONG", *troubles]) if troubles else "right"),
        flush=True,
    )
    return not troubles


if __name__ == "__main__":
    sys.exit(main())
