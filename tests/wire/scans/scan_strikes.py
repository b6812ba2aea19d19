"""One scan over emulated wires, one blow to it at some moment, and how long there was light after it, and on what."""

import math
import os
import resource
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from drivers.guard import GuardLimits
from tests.wire.emulated_lasers import eventually
from tests.wire.scans.scan_rig import (
    CARD_BUFFER_S,
    PATIENT,
    STEP_S,
    Applications,
    ScanBench,
    ScanFailedError,
    scan_bench,
)

GONE_S = 0.1
"""Light has to be gone after this, at the 99.9th percentile..."""
NEVER_S = 0.5
"""...and after this always."""
BY_HAND = "ttl"
"""The laser whose emission no program ends."""
EMISSION_S = 1.0
"""Emission is off after this where the laser's port still answers."""
MAPS = 40
"""Of a scan that is struck: about a second."""
LONG_MAPS = 2000
"""Of one that is struck in its midst however slow the machine is."""
DARK_S = 0.5
HUNG_S = NEVER_S + 0.1
"""Light is gone after this where the laser's firmware hangs and only the guard notices it: the 500 ms that were asked,
and 100 ms for processes of an emulated rig that wake up late."""
LONG_S = 1.1
"""From the first light to beyond the end of the scan."""
FIRST_FRAME_S = GuardLimits().first_frame_s + GONE_S
"""Light is gone after this where the SPAD fell silent before its first frame was taken."""
OPENING_S = {"obis": 1.2, "cobolt": 7.0, "ibeam": 4.5, "ttl": 1.0}
"""From the start to the first light, about."""
FULL_BYTES = 16_384
_END_S = 60.0


@dataclass(frozen=True)
class ScanStrike:
    """A blow. at_once: it may come before any light. record: frames are written. own_end: the application goes on
    living, says what happened and ends with code 3. silence: of the SPAD that the guard lets pass; long, since
    an emulated one may itself be late. scanner, sync: their kinds. labours: threads fight the scan's for the
    interpreter. darkens: it ends the light itself, and all else goes on. light_s, emission_s: until they are gone,
    at most. lasting: the scan goes on for minutes, so that it is not its end which is measured."""

    blow: Callable[[ScanBench], None]
    at_once: bool = False
    record: bool = False
    own_end: bool = False
    laser_answers: bool = True
    silence: str = "1.5 s"
    scanner: str = "helios"
    labours: bool = False
    light_s: float = GONE_S
    emission_s: float = EMISSION_S
    sync: str = "prawndo"
    darkens: bool = False
    lasting: bool = False


def _signal(number: int) -> Callable[[ScanBench], None]:
    return lambda bench: os.kill(bench.number, number)


def _open_interlock(bench: ScanBench) -> None:
    with bench.world.laser_wire.lock:
        bench.world.laser.open_interlock(time.monotonic())


def _fill_disk(bench: ScanBench) -> None:
    """No file takes more than what the terminal's needs, as on a disk that is full (EFBIG instead of ENOSPC)."""
    resource.prlimit(bench.number, resource.RLIMIT_FSIZE, (FULL_BYTES, resource.RLIM_INFINITY))


def _hang_gate(bench: ScanBench) -> None:
    """The gate hears nothing any more, and then the application dies: only the laser is left to be lowered."""
    bench.world.gate_wire.hang()
    os.kill(bench.number, signal.SIGKILL)


def _silence_spad(bench: ScanBench) -> None:
    """Its firmware hangs: no frame, no answer. The application lives and feeds its scanner: it is at work."""
    with bench.world.spad_plug.lock:
        bench.world.spad.deaf = True


def _unplug_gate(bench: ScanBench) -> None:
    """Its cable is its power: pull-downs hold the outputs low (docs/reference/hardware.md, Wiring and timing)."""
    bench.world.gate_wire.unplug()
    with bench.world.gate_wire.lock:
        bench.world.sync.power_cycle(time.monotonic())


def _starve_scanner(bench: ScanBench) -> None:
    """Nothing reaches it for longer than its buffer lasts."""
    with bench.world.scanner_plug.lock:
        time.sleep(0.4)


def _stop_scanner(bench: ScanBench) -> None:
    """Its network's cable comes loose, and is put in again: an emergency stop."""
    with bench.world.scanner_plug.lock:
        for up in (False, True):
            bench.world.scanner.link(up, time.monotonic())


def _restart_scanner(bench: ScanBench) -> None:
    bench.world.scanner_plug.unplug()
    with bench.world.scanner_plug.lock:
        bench.world.scanner.power_up(time.monotonic())
    bench.world.scanner_plug.plug()


ETHERDREAM_S = 0.5
"""It plays what is queued: light is gone after this."""


CARD_S = 0.6 * CARD_BUFFER_S + GONE_S
"""A card whose server does not answer is given up after this, and its scan marker stays as it was until then."""


def _reset_card(bench: ScanBench) -> None:
    with bench.world.scanner_plug.lock:
        bench.world.scanner.reset(time.monotonic())


def _delay_card(bench: ScanBench) -> None:
    """Its points run dry, and markers keep their last level."""
    with bench.world.scanner_plug.lock:
        time.sleep(2 * bench.card_buffer_s)


SCAN_STRIKES = {
    "application killed": ScanStrike(_signal(signal.SIGKILL), at_once=True),
    "application stopped": ScanStrike(_signal(signal.SIGSTOP)),
    "guard killed": ScanStrike(lambda bench: os.kill(bench.guard(), signal.SIGKILL), own_end=True),
    "guard stopped": ScanStrike(lambda bench: os.kill(bench.guard(), signal.SIGSTOP), own_end=True),
    "gate's firmware hangs": ScanStrike(_hang_gate, light_s=NEVER_S),
    "spad unplugged": ScanStrike(lambda bench: bench.world.spad_plug.unplug(), own_end=True),
    "spad falls silent": ScanStrike(_silence_spad, own_end=True, silence="40 ms"),
    "spad silent under labour": ScanStrike(
        _silence_spad, silence="40 ms", labours=True, light_s=FIRST_FRAME_S, emission_s=EMISSION_S + FIRST_FRAME_S
    ),
    "scanner unplugged": ScanStrike(lambda bench: bench.world.scanner_plug.unplug(), own_end=True),
    "etherdream unplugged": ScanStrike(
        lambda bench: bench.world.scanner_plug.unplug(), own_end=True, scanner="etherdream"
    ),
    "etherdream hangs": ScanStrike(
        lambda bench: bench.world.scanner_plug.hang(),
        own_end=True,
        scanner="etherdream",
        light_s=ETHERDREAM_S,
    ),
    "etherdream starved": ScanStrike(_starve_scanner, own_end=True, scanner="etherdream", light_s=ETHERDREAM_S),
    "etherdream stopped": ScanStrike(_stop_scanner, own_end=True, scanner="etherdream"),
    "etherdream restarted": ScanStrike(_restart_scanner, own_end=True, scanner="etherdream"),
    "gate unplugged": ScanStrike(_unplug_gate, own_end=True),
    "laser unplugged": ScanStrike(lambda bench: bench.world.laser_wire.unplug(), own_end=True, laser_answers=False),
    "laser's firmware hangs": ScanStrike(
        lambda bench: bench.world.laser_wire.hang(),
        own_end=True,
        laser_answers=False,
        light_s=HUNG_S,
        emission_s=3.0,
        lasting=True,
    ),
    "interlock opened": ScanStrike(_open_interlock, own_end=True, darkens=True),
    "disk full": ScanStrike(_fill_disk, record=True, own_end=True),
    "killed, teensy": ScanStrike(_signal(signal.SIGKILL), sync="teensy"),
    "teensy hangs": ScanStrike(_hang_gate, sync="teensy", light_s=NEVER_S),
    "teensy unplugged": ScanStrike(_unplug_gate, own_end=True, sync="teensy"),
    # The box goes on by itself: light ends with the laser's emission. Questions have no answer, or are refused.
    "pulse streamer's cable pulled": ScanStrike(
        lambda bench: bench.world.gate_wire.hang(), own_end=True, sync="pulsestreamer", light_s=NEVER_S, lasting=True
    ),
    "pulse streamer refuses": ScanStrike(
        lambda bench: bench.world.gate_wire.unplug(), own_end=True, sync="pulsestreamer", light_s=NEVER_S, lasting=True
    ),
    # An NI card's scan marker stays as it was.
    "killed, ni card": ScanStrike(_signal(signal.SIGKILL), scanner="nidaq"),
    "ni card's server gone": ScanStrike(lambda bench: bench.world.scanner_plug.unplug(), own_end=True, scanner="nidaq"),
    "ni card's server hangs": ScanStrike(
        lambda bench: bench.world.scanner_plug.hang(), own_end=True, scanner="nidaq", light_s=CARD_S
    ),
    "ni card reset": ScanStrike(_reset_card, own_end=True, scanner="nidaq"),
    # The emulated SPAD stands still with the card, so the guard may be the first to act, and kill the application.
    "ni card runs dry": ScanStrike(_delay_card, scanner="nidaq", light_s=CARD_S),
}


@dataclass(frozen=True)
class ScanOutcome:
    """What came of it.

    light_s: to the last light. emission_s: to the end of emission; inf: none within the time. rest_s: light on a mirror
    at rest, of the whole scan. over: the scan had ended before. code: the application's; None: it ran on for ever.
    """

    was_lit: bool
    over: bool
    light_s: float
    emission_s: float
    rest_s: float
    code: int | None
    said: str


def strike_scan(
    applications: Applications,
    name: str,
    laser: str,
    share: float,
    *,
    measured: bool = True,
    then: tuple[str, float] | None = None,
) -> ScanOutcome:
    """Start a scan and strike: share (0 to 1) of the way from its first light, or its start, to beyond its end.

    then: a second blow, of the same devices, and by how many seconds it comes later.

    Measured, light and emission are looked at until they have to be gone; else the scan is a long one, and they are
    waited for.
    """
    made = SCAN_STRIKES[name]
    patience = None if measured else PATIENT
    with scan_bench(applications, laser, made.silence, made.scanner, made.sync, patience) as bench:
        maps = MAPS if measured and not made.lasting else LONG_MAPS
        bench.start(maps=maps, record=made.record, labours=made.labours)
        opening_s = OPENING_S[laser] if made.at_once else 0.0
        into_s = share * (opening_s + LONG_S)
        if into_s < opening_s:
            time.sleep(into_s)
        else:
            bench.await_light()
            time.sleep(into_s - opening_s)
        over = applications.exit_code(bench.number, 0.0) is not None
        at_s = time.monotonic()
        was_lit = bool(bench.light(at_s - 0.05))
        if not over:
            made.blow(bench)
            if then is not None:
                time.sleep(then[1])
                with suppress(ProcessLookupError, FileNotFoundError, ScanFailedError):  # the first one was its end
                    SCAN_STRIKES[then[0]].blow(bench)
        if measured:
            time.sleep(made.emission_s + 0.05)
        elif made.laser_answers and laser != BY_HAND:
            eventually(lambda: bench.dark_s(at_s) < math.inf)
        else:
            eventually(lambda: not bench.light(time.monotonic() - DARK_S))
        light, resting = bench.light(at_s), bench.light_at_rest(bench.started_s)
        code = applications.exit_code(bench.number, _END_S)
        return ScanOutcome(
            was_lit,
            over,
            light[-1][1] - at_s if light else 0.0,
            bench.dark_s(at_s),
            len(resting) * STEP_S,
            code,
            bench.said + (f"light at rest {resting[0] - at_s:.3f} to {resting[-1] - at_s:.3f} s\n" if resting else ""),
        )


def lateness_of(name: str, laser: str, outcome: ScanOutcome) -> list[str]:
    """What came too late after one blow, but for the 100 ms, which are a percentile's."""
    made = SCAN_STRIKES[name]
    found = []
    if outcome.light_s > max(NEVER_S, made.light_s):
        found.append(f"light after {1e3 * outcome.light_s:.0f} ms")
    if made.laser_answers and laser != BY_HAND and outcome.emission_s > made.emission_s:
        found.append(f"emission after {outcome.emission_s:.2f} s")
    return found


def trouble_of(name: str, outcome: ScanOutcome) -> list[str]:
    """What one blow left undone, whenever."""
    made = SCAN_STRIKES[name]
    found = []
    if outcome.rest_s:
        found.append(f"{1e3 * outcome.rest_s:.2f} ms of light at rest")
    if "Traceback" in outcome.said:
        found.append("a traceback")
    ended_well = "verdict  complete" in outcome.said  # it had its frames already
    told = outcome.code == 3 and "error: " in outcome.said
    if made.darkens:  # its missing line may be found before the laser is asked
        told |= outcome.code == 1 and "no line: " in outcome.said
    if made.own_end and not ended_well and not told:
        found.append(f"code {outcome.code}")
    return [f"{one} ({outcome.said.strip()[-300:]})" for one in found]
