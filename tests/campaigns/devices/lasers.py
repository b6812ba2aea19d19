"""Random verbs on a laser behind a faulty wire: each does what it says, or ends in one of our errors, in time.

What a verb claims is held against the model, not against what the model said: a pause that returned leaves it dark, for
good; an arm that returned leaves it under its gate at the power asked for; no verb ever leaves it above the limit; and
no bypass is ever sent. A bit that flips in a reply may show for one reading of the status, since neither line has
checksums; it must not make a verb do wrong.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from drivers.clock import VirtualClock
from drivers.interfaces import DeviceState, LineLaser
from drivers.lasers import cobolt, ibeam, obis
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from sim_backend.wire.firmware.cobolt import CoboltModel, Family
from sim_backend.wire.firmware.ibeam import BIAS, NORMAL, IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from tests.campaigns.outcomes import Ending, Verbs, close_or_raise
from tests.wire.faults import Fault, FaultSchedule
from tests.wire.serial_wire import SerialWire

LIMIT_W = 0.08
DEADLINE_S = 10.0
"""Virtual time for one verb at the campaign's timing (30 ms for a reply)."""
LATE_S = 0.05
STALL_S = 0.06
GAP_S = 0.1
TIMES = {"reply_s": 0.03, "quiet_s": 0.01, "drain_s": 0.05}

Model = CoboltModel | IbeamModel | ObisModel


def told_power_w(model: Model) -> float:
    """The power it is set to, shining or not."""
    if isinstance(model, IbeamModel):
        return sum(model.powers_w.values())
    if isinstance(model, ObisModel):
        return model.set_power_w
    return model.modulation_power_w if model.mode == "modulation" else model.constant_power_w


@dataclass(frozen=True)
class Subject:
    """One driver under test: a model for a seed, and the driver on its wire."""

    make: Callable[[random.Random], Model]
    open: Callable[[Model, Surroundings], LineLaser]
    deadline_s: float = DEADLINE_S


class Sequence:
    """One sequence: open, a few verbs, close, with the cable pulled and the firmware hanging now and then."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self._clock = VirtualClock()
        self._verb = Verbs(subject.deadline_s, lambda: self._clock.now_ns() * 1e-9)
        self._subject = subject
        self._rng = random.Random(seed)
        self._model = subject.make(self._rng)
        kinds = self._rng.choice((tuple(Fault), tuple(Fault), (self._rng.choice(tuple(Fault)),)))
        probability = self._rng.choice((0.02, 0.1, 0.3))
        skip = self._rng.choice((0, 15, 40))
        self._faults = FaultSchedule(
            seed, probability, kinds, skip=skip, most=self._rng.randrange(1, 8), late_s=LATE_S, stall_s=STALL_S
        )
        self._server = SerialWire(self._model, clock=self._clock, baud=1_000_000, faults=self._faults)
        self._laser: LineLaser | None = None
        self._may_be_off = False
        """Whether it may have been switched off by a verb that failed since it was armed."""

    def run(self) -> Ending:
        with self._server:
            ended = self._verb.ending(self._some_verbs)
        return ended._replace(struck=[fault.value for fault in self._faults.struck])

    def _some_verbs(self) -> None:
        for _ in range(self._rng.randrange(2, 7)):
            self._one()
        self._close()

    def _one(self) -> None:
        if self._laser is None:
            self._verb("open", self._open)
            return
        laser = self._laser
        power_w = self._rng.uniform(0.002, LIMIT_W)
        verb = self._rng.choice(("status", "arm", "arm", "arm", "pause", "pause", "disarm", "interlock"))
        match verb:
            case "status":
                self._verb(verb, lambda: self._check_status(laser))
            case "arm":
                self._may_be_off = not self._verb(verb, lambda: laser.arm(power_w))
                if not self._may_be_off:
                    assert self._model.gated, "armed, and the gate does not govern the light"
                    assert abs(told_power_w(self._model) - power_w) <= 0.011 * power_w + 5e-5, "armed at another power"
                    assert not isinstance(self._model, IbeamModel) or not self._model.closed_gate_power_w, "leaks"
            case "pause":
                self._may_be_off = True
                if self._verb(verb, laser.pause):
                    self._stays_dark("paused")
            case "disarm":
                self._may_be_off = True
                if self._verb(verb, laser.disarm):
                    on = self._model.on if isinstance(self._model, CoboltModel) else self._model.state_on
                    assert not on, "disarmed, and on"
                    self._stays_dark("disarmed")
            case "interlock":
                with self._server.lock:
                    self._model.open_interlock(self._clock.now_ns() * 1e-9)
                self._verb("status", lambda: self._check_status(laser))
                with self._server.lock:
                    self._model.interlock_open = False
                    if not isinstance(self._model, IbeamModel):
                        self._model.fault = 0
        assert told_power_w(self._model) <= LIMIT_W * 1.001, "told a power above the limit"
        forbidden = None if isinstance(self._model, IbeamModel) else self._model.forbidden
        assert not forbidden, f"sent {forbidden}"
        if self._rng.random() < 0.3:
            self._mend()

    def _open(self) -> None:
        around = Surroundings(self._clock, None, 0, {"laser": self._server.endpoint})
        self._laser = self._subject.open(self._model, around)
        limits = self._laser.limits
        assert limits.max_power_w == LIMIT_W, f"limit {limits.max_power_w} W"

    def _check_status(self, laser: LineLaser) -> None:
        before, emitting = len(self._faults.struck), self._model.emitting  # a warm-up may end while it is asked
        status = laser.status
        if Fault.CORRUPTED in self._faults.struck[before:]:
            return
        if not isinstance(self._model, IbeamModel):  # it cannot be asked
            assert status.interlock_closed != self._model.interlock_open, "the interlock is not what the status says"
        elif status.armed and not status.emission and laser.state is DeviceState.RUNNING and not self._may_be_off:
            assert status.fault, "it was armed and went off, and the status says nothing"
        assert status.emission or not (emitting and self._model.emitting), (
            "it emits and the status says that it does not"
        )

    def _stays_dark(self, what: str) -> None:
        """Neither now nor after anything that was pending."""
        for _ in range(2):
            with self._server.lock:
                self._model.tick(self._clock.now_ns() * 1e-9)
                assert not self._model.emitting, f"{what}, and emits"
            self._clock.sleep(1000.0)

    def _mend(self) -> None:
        """Put the cable in and restart what hangs; the driver's port was lost with the cable."""
        self._server.resume()
        self._server.plug()
        self._close()

    def _close(self) -> None:
        laser = self._laser
        if laser is not None and self._verb("close", lambda: close_or_raise(laser)):
            self._stays_dark("closed")
        self._laser = None


def sequence(subject: Subject, seed: int) -> Ending:
    return Sequence(subject, seed).run()


def _make_cobolt(rng: random.Random) -> Model:
    family = cast(Family, rng.choice(("06-MLD", "06-01")))
    model = CoboltModel(
        family,
        autostart=rng.random() < 0.5,
        warm_up_s=rng.choice((0.0, 5.0)),
        junk=rng.choice((b"", b"", b"\xff>")),
        refuses=frozenset(rng.choice(((), ("l0r", "l1r"), ("@cobas?", "@cobasks?")))),
        current_ma=rng.choice((0.0, 40.0)),
    )
    if rng.random() < 0.3:
        model.shine(0.05, gated=rng.random() < 0.5)
    if rng.random() < 0.2:
        model.mode = "modulation"  # with an input or without one
    return model


def _open_cobolt(model: Model, surroundings: Surroundings) -> LineLaser:
    config = cobolt.CoboltConfig(port="emulated:laser", max_power=f"{LIMIT_W} W")  # type: ignore[arg-type]
    return cobolt.create(config, surroundings, LineTiming(gap_s=GAP_S, **TIMES))


def _make_obis(rng: random.Random) -> Model:
    model = ObisModel(
        handshake=rng.random() < 0.5,
        channel=rng.choice((None, None, 2)),
        warm_up_s=rng.choice((0.0, 0.0, 3.0)),
        cdrh_delay_s=rng.choice((0.0, 5.0)),
    )
    if rng.random() < 0.3:
        model.shine(0.05, gated=rng.random() < 0.5)
    return model


def _open_obis(model: Model, surroundings: Surroundings) -> LineLaser:
    channel = cast(ObisModel, model).channel
    config = obis.ObisConfig(port="emulated:laser", max_power=f"{LIMIT_W} W", channel=channel)  # type: ignore[arg-type]
    return obis.create(config, surroundings, LineTiming(**TIMES))


def _make_ibeam(rng: random.Random) -> Model:
    model = IbeamModel(
        echo=rng.random() < 0.5,
        prompt=rng.random() < 0.5,
        talk=rng.choice(("usual", "gabby", "quiet")),
        default_channel=rng.choice((None, BIAS, NORMAL)),
        disabled_shine=rng.random() < 0.3,
        powers_w=dict.fromkeys(range(1, rng.choice((3, 4, 6))), 0.01),
        ext=rng.random() < 0.3,
        fine=rng.random() < 0.3,
        scaled=rng.random() < 0.5,
        lag_gap_s=rng.choice((0.0, 0.049)),
        on_delay_s=rng.choice((0.0, 0.0, 3.0)),
    )
    if rng.random() < 0.3:
        model.shine(0.05, gated=rng.random() < 0.5)
    return model


def _open_ibeam(model: Model, surroundings: Surroundings) -> LineLaser:
    config = ibeam.IbeamConfig(port="emulated:laser", max_power=f"{LIMIT_W} W")  # type: ignore[arg-type]
    return ibeam.create(config, surroundings, LineTiming(gap_s=0.05, **TIMES))


COBOLT = Subject(_make_cobolt, _open_cobolt)
OBIS = Subject(_make_obis, _open_obis)
IBEAM = Subject(_make_ibeam, _open_ibeam, deadline_s=15.0)  # arm may wait 10 s until it is on
