"""Random faults on a scanner's USB cable or network: every sequence ends right, or with one of our errors, in time.

Runs on a virtual clock, so that seconds of silence cost nothing. 'Right' is judged by what the DAC put out, not by what
the driver says: where no error and no fault is told, the lit points are the waveform, all of it, without a gap.
"""

import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.interfaces import MARKER_LINE, MARKER_SCAN, BeamScanner, ScanWaveform
from sim_backend.wire.firmware import helios
from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.firmware.helios import DacHistory
from tests.campaigns.outcomes import Ending, ending
from tests.wire.emulated_scanners import finish, open_scanner, plug
from tests.wire.faults import Fault, FaultSchedule, FaultyUsb
from tests.wire.scanners import lasercube
from tests.wire.scanners.etherdream import open_etherdream, wired

POINTS, LINE_POINTS, RATE_HZ = 700, 50, 25_000.0
DEADLINE_S = 30.0
"""Virtual time for a whole sequence: some ten verbs, each of which may wait for two frames and two seconds."""


@dataclass(frozen=True)
class Subject:
    """A scanner kind under test.

    model: a firmware. scan, line, lit: lines of the record: the markers, and one that is high all through the waveform.
    drive: largest error of the drive. seam_s: how much longer than the others one point of each line may last.
    """

    kind: str
    model: Callable[[], Any]
    config: dict[str, object]
    scan: int
    line: int
    lit: int
    drive: float = 1.01 / 4095
    """A step of the converters."""
    seam_s: float = 0.0


def wave(device: BeamScanner) -> ScanWaveform:
    """A seamless cosine."""
    at = np.arange(POINTS)
    markers = np.where(at % LINE_POINTS == 0, MARKER_LINE, 0).astype(np.uint8)
    markers[0] |= MARKER_SCAN
    return ScanWaveform(-0.5 * np.cos(2 * np.pi * at / POINTS), markers, device.point_clock(RATE_HZ))


HELIOS = Subject(
    "helios", helios.HeliosModel, {"frame": "20 ms"}, helios.BLUE, helios.GREEN, helios.RED, seam_s=helios.SEAM_S
)
LASERCUBE = Subject(
    "lasercube",
    lasercube.LaserCubeModel,
    {"buffer": "20 ms", "colours": "markers"},
    lasercube.BLUE,
    lasercube.GREEN,
    lasercube.PLAYING,
)
ETHERDREAM = Subject("etherdream", EtherDreamModel, {}, helios.BLUE, helios.GREEN, helios.RED, drive=1.14 / 4095)

ETHERDREAM_FAULTS = tuple(kind for kind in Fault if kind is not Fault.CORRUPTED)
"""TCP has checksums of its own."""


def sequence(subject: Subject, seed: int) -> Ending:
    rng = random.Random(seed)
    probability = rng.choice((0.003, 0.01, 0.05, 0.3))
    schedule = FaultSchedule(
        seed, probability, tuple(Fault), skip=rng.randrange(60), most=rng.randrange(1, 5), late_s=0.05, stall_s=0.3
    )
    clock = VirtualClock()
    model = subject.model()
    plugged = plug(FaultyUsb(model, schedule, late_s=rng.choice((0.001, 0.02, 0.2))), clock)

    def act() -> str:
        with open_scanner(subject.kind, plugged.bus, plugged.clock, **subject.config) as device:
            return judged(subject, rng, device, wave(device), plugged.now_s, model.history)

    return ending_of(act, schedule, plugged.now_s)


def ending_of(
    act: Callable[[], str], schedule: FaultSchedule, now_s: Callable[[], float], deadline_s: float = DEADLINE_S
) -> Ending:
    """How an act ended; an error in any thread is a wrong end."""
    foreign: list[str] = []
    before = threading.excepthook
    threading.excepthook = lambda what: foreign.append(f"in a thread: {what.exc_type.__name__}: {what.exc_value}")
    try:
        ended = ending(act, now_s, deadline_s)
    finally:
        threading.excepthook = before
    struck = [fault.value for fault in schedule.struck]
    return ended._replace(wrong=foreign[0] if foreign else ended.wrong, struck=struck)


def etherdream_sequence(seed: int) -> Ending:
    """Besides the faults on the wire the board itself may be stopped, once. At the end it is dark, at the centre."""
    rng = random.Random(seed)
    schedule = FaultSchedule(
        seed,
        rng.choice((0.001, 0.003, 0.01, 0.05)),
        ETHERDREAM_FAULTS,
        skip=rng.randrange(200),
        most=rng.randrange(1, 5),
        late_s=rng.choice((0.01, 0.05, 0.3)),
        stall_s=0.3,
    )
    clock_error = rng.uniform(-5e-4, 5e-4)
    model = StruckEtherDream(
        rng.choice((None, None, *EVENTS)),
        rng.randrange(200),
        by_page=rng.random() < 0.5,
        clock_error=clock_error,
        capacity=rng.choice((1799, 3899)),
    )
    with wired(model, schedule) as wire:
        buffer = rng.choice(("20 ms", "60 ms"))

        def act() -> str:
            try:
                with open_etherdream(wire, max_point_rate="25 kHz", buffer=buffer) as device:
                    return judged(ETHERDREAM, rng, device, wave(device), lambda: wire.now_s, model.history, clock_error)
            finally:
                wire._clock.sleep(0.5)
                assert not model.moving(wire.now_s), "it plays for ever"
                at = np.array([wire.now_s])
                assert model.history.command(at)[0] == helios.CENTRE, "the mirror is not at the centre"

        return ending_of(act, schedule, lambda: wire.now_s)


EVENTS: dict[str, Callable[[EtherDreamModel, float], None]] = {
    "stop": lambda model, now_s: model._stop(0, now_s),
    "emergency stop": lambda model, now_s: model._emergency_stop(1, now_s),
    "power": EtherDreamModel.power_up,
    "point twice": lambda model, now_s: setattr(model, "_ring", np.concatenate([model._ring[:1], model._ring])),
    "point lost": lambda model, now_s: setattr(model, "_ring", model._ring[1:]),
}


class StruckEtherDream(EtherDreamModel):
    """A board to which something happens before a certain command."""

    def __init__(self, event: str | None, at: int, **options: Any) -> None:
        super().__init__(**options)
        self._event, self._left = event, at

    def receive(self, data: bytes, now_s: float) -> None:
        self._left -= 1
        if self._left == 0 and self._event is not None:
            self.advance(now_s)
            EVENTS[self._event](self, now_s)
        super().receive(data, now_s)


def judged(
    subject: Subject,
    rng: random.Random,
    device: BeamScanner,
    waveform: ScanWaveform,
    now_s: Callable[[], float],
    history: DacHistory,
    clock_error: float = 0.0,
) -> str:
    """Play the waveform once or twice, to the end or to a stop; how that ended. AssertionError if it ended wrong."""
    for _ in range(rng.randrange(1, 3)):
        repeats = rng.randrange(3, 8)
        clock = device.load(waveform, repeats)
        began_s = now_s()
        device.start()
        stopped = rng.random() < 0.3
        if stopped:
            time.sleep(rng.random() * 0.003)
            device.stop()
        else:
            finish(device)
        fault = device.status.fault
        if fault is not None:
            assert "\n" not in fault, "a fault of several lines"
            return "fault"
        put_out = Played(subject, history, float(clock) * (1 + clock_error), began_s, now_s())
        put_out.require(waveform, repeats, stopped=stopped)
        if rng.random() < 0.5:
            device.park()
    return "complete"


@dataclass(frozen=True)
class Played:
    """A DAC's record of one run."""

    subject: Subject
    history: DacHistory
    rate_hz: float
    began_s: float
    ended_s: float

    def require(self, waveform: ScanWaveform, repeats: int, *, stopped: bool) -> None:
        """AssertionError where the lit points are not the waveform, up to where it was stopped."""
        starts = self._rising(self.subject.scan)
        if stopped and not len(starts):
            return
        assert stopped or len(starts) == repeats, f"{len(starts)} of {repeats} scans came out"
        lines = self._rising(self.subject.line)
        assert stopped or len(lines) == repeats * POINTS // LINE_POINTS, f"{len(lines)} lines came out"
        late = (lines - starts[0]) * self.rate_hz - np.arange(len(lines)) * LINE_POINTS
        most = self.subject.seam_s * self.rate_hz * np.arange(len(lines))
        assert ((late >= -0.01) & (late <= most + 0.01)).all(), "line markers came at other points"
        # A brake may begin right behind the last marker.
        at = np.arange((len(lines) - 1) * LINE_POINTS + 1 if stopped else repeats * POINTS)
        times = lines[at // LINE_POINTS] + (at % LINE_POINTS + 0.5) / self.rate_hz
        lit = self.history.level(self.subject.lit, times) > 0
        assert stopped or lit.all(), f"only {int(lit.sum())} of {len(lit)} points came out"
        assert not (np.diff(lit.astype(np.int8)) > 0).any(), "the light went out and came again"
        out = self.history.command(times)[lit]
        error = np.abs(out - np.tile(waveform.command, repeats)[at][lit]).max(initial=0)
        assert error <= self.subject.drive, f"the mirror was off by {error:g}"

    def _rising(self, line: int) -> NDArray[np.float64]:
        return self.history.rising(line, self.began_s, self.ended_s + 1)
