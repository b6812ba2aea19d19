"""Devices that answer what they answered when a scan was recorded: their real drivers are played against them.

A serial device gives, for each piece of bytes that its driver sends, what came back for the same piece then. Commands
must come in the order of the recording; how often the driver asks in between is its own affair, and it gets what the
device would have said at that time after the last command. At the first byte that was not recorded the line is
lost. A scanner's buffers depend on when it is stopped; it is emulated.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.interfaces import SweepTruth
from drivers.recorded.control_words import is_question
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import CONTROL_FILE, OUT, Passed, read_taps
from sim_backend.wire.firmware.helios import HeliosModel
from sim_backend.wire.firmware.lasercube import LaserCubeModel
from sim_backend.wire.serve.serial import SerialServer
from sim_backend.wire.serve.usb import EmulatedUsb

_TOKEN = re.compile(rb"#[0-9a-f]{8}")
"""A PrawnDO driver numbers its questions so that their answers are known."""
_BAUD = 10_000_000
_SAID_AGAIN = 3
"""Number of the last commands that may come again."""
_SCANNERS = {"helios": HeliosModel, "lasercube": LaserCubeModel}


@dataclass(slots=True)
class Exchange:
    """A piece of bytes that a driver sent, when, and all that came back before it sent the next."""

    t_s: float
    sent: bytes
    answer: bytes = b""

    @property
    def form(self) -> bytes:
        """The bytes sent without the tokens' numbers."""
        return _TOKEN.sub(b"#00000000", self.sent)

    def reply_to(self, sent: bytes) -> bytes:
        """The answer, with the tokens of what was sent now."""
        answer = self.answer
        for old, new in zip(_TOKEN.findall(self.sent), _TOKEN.findall(sent), strict=True):
            answer = answer.replace(old, b"\0" + new[1:])
        return answer.replace(b"\0", b"#")


@dataclass(slots=True)
class _Command:
    """A command and the questions that followed it."""

    exchange: Exchange
    questions: list[Exchange] = field(default_factory=list)


class RecordedModel:
    """A `SerialModel` that answers from a recording. passed: of its port, in order of time."""

    def __init__(self, passed: Sequence[Passed]) -> None:
        start = _Command(Exchange(0.0, b""))
        self._commands = [start]
        self._questions: dict[bytes, Exchange] = {}
        for exchange in _exchanges(passed):
            if is_question(exchange.sent):
                self._commands[-1].questions.append(exchange)
                self._questions.setdefault(exchange.form, exchange)
            else:
                self._commands.append(_Command(exchange))
        self._at = 0
        self._since_s = 0.0
        self._heard = b""
        self.diverged = False
        """Whether bytes came that were not recorded."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes; nothing more is answered once they diverge."""
        self._heard += data
        answers = []
        while self._heard and not self.diverged:
            found = self._match(now_s)
            if found is None:
                break
            answers.append(found)
        return b"".join(answers)

    def tick(self, now_s: float) -> bytes:
        """Do nothing: the device says nothing unasked."""
        return b""

    def _match(self, now_s: float) -> bytes | None:
        """The answer to the piece that begins what was heard; None where it is not whole."""
        form = _TOKEN.sub(b"#00000000", self._heard)
        ahead = self._ahead()
        candidates = [(self._commands[i].exchange, i) for i in ahead] + [(q, -1) for q in self._questions.values()]
        whole = [one for one in candidates if form.startswith(one[0].form)]
        if not whole:
            # A token may be cut in the middle: no more than its length at the end is given the benefit of the doubt.
            self.diverged = not any(one.form.startswith(_uncut(form)) for one, _ in candidates)
            return None
        exchange, index = max(whole, key=lambda one: len(one[0].form))
        sent, self._heard = self._heard[: len(exchange.form)], self._heard[len(exchange.form) :]
        if index < 0:
            return self._answered(exchange.form, now_s).reply_to(sent)
        self._at, self._since_s = index, now_s
        return exchange.reply_to(sent)

    def _ahead(self) -> list[int]:
        """Commands that may come: the next one, or, since drivers make sure, the last ones again or skipped."""
        recent = [self._commands[i].exchange.form for i in range(max(1, self._at - _SAID_AGAIN + 1), self._at + 1)]
        found = []
        for i in range(self._at + 1, len(self._commands)):
            found.append(i)
            if self._commands[i].exchange.form not in recent:
                break
        return found + [i for i in range(self._at, max(0, self._at - _SAID_AGAIN), -1)]

    def _answered(self, form: bytes, now_s: float) -> Exchange:
        """The recorded answer to a question: the one at this time after the last command, else the next or last one
        before.
        """
        command = self._commands[self._at]
        elapsed_s = now_s - self._since_s
        mine = [one for one in command.questions if one.form == form]
        past = [one for one in mine if one.t_s - command.exchange.t_s <= elapsed_s]
        if past or mine:
            return past[-1] if past else mine[0]
        later = (one for c in self._commands[self._at + 1 :] for one in c.questions if one.form == form)
        before = (one for c in self._commands[self._at :: -1] for one in c.questions[::-1] if one.form == form)
        return next(before, None) or next(later, self._questions[form])


def _uncut(form: bytes) -> bytes:
    """The bytes without a token that has not come whole."""
    cut = form.rfind(b"#", max(0, len(form) - 8))
    return form if cut < 0 or _TOKEN.match(form[cut:]) else form[:cut]


def _exchanges(passed: Sequence[Passed]) -> list[Exchange]:
    found: list[Exchange] = []
    for one in passed:
        if one.direction == OUT:
            found.append(Exchange(one.t_ns / 1e9, one.data))
        elif found:
            found[-1].answer += one.data
    return found


class _RecordedServer(SerialServer):
    """Serves a recorded device; the line is lost where its driver says what was not recorded."""

    def __init__(self, model: RecordedModel, clock: Clock) -> None:
        super().__init__(model, clock=clock, baud=_BAUD)
        self._recorded = model

    def _turn(self) -> None:
        super()._turn()
        if self._recorded.diverged:
            self.unplug()


class RecordedWorldConfig(KindConfig):
    """Config of the world whose devices are those of a recording."""

    real_time: ClassVar[bool] = True

    kind: Literal["recorded"] = "recorded"
    recording: Path
    """Folder of a run that was taken with --record, with control.jsonl in it."""
    scanner: Literal["helios", "lasercube"] = "helios"
    """The scanner that is emulated at emulated:scanner."""


class RecordedWorld:
    """Laser and sync source as recorded, an emulated scanner; plugged in until `close`. It knows no truth."""

    def __init__(self, config: RecordedWorldConfig, surroundings: Surroundings) -> None:
        """DeviceError where no control traffic was recorded."""
        file = config.recording / CONTROL_FILE
        if not file.exists():
            raise DeviceError(f"{config.recording} has no {CONTROL_FILE}: no control traffic was recorded with it")
        passed = read_taps(file)
        bus = EmulatedUsb(surroundings.clock)
        bus.plug(_SCANNERS[config.scanner]())
        self.ports: dict[str, Endpoint] = {"scanner": Endpoint("usb", usb_backend=bus)}
        self.models: dict[str, RecordedModel] = {}
        self._servers: list[SerialServer] = []
        for device in ("laser", "sync"):
            mine = [one for one in passed if (one.device, one.port) == (device, "serial")]
            if mine:
                self.models[device] = RecordedModel(mine)
                server = _RecordedServer(self.models[device], surroundings.clock).start()
                self._servers.append(server)
                self.ports[device] = server.endpoint

    def truth(self, commands: NDArray[np.float64], velocity_per_s: float = 0.0) -> SweepTruth:
        """Raise DeviceError: this world knows no truth."""
        raise DeviceError("a world of recorded devices knows no truth")

    def close(self) -> None:
        """Unplug them."""
        for server in self._servers:
            server.close()


def create(config: RecordedWorldConfig, surroundings: Surroundings) -> RecordedWorld:
    """The devices of the recording."""
    return RecordedWorld(config, surroundings)


KIND = Kind(config=RecordedWorldConfig, create=create)
