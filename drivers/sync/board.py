"""The base of boards that play patterns: pins of the user's choice, and outputs that go low if a start fails or if
nobody closes the board."""

import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Self

from pydantic import model_validator

from drivers.errors import DeviceError, DeviceFault, WrongState
from drivers.interfaces import OUT_FRAME, OUT_GATE, OUT_MARKER, SyncSource
from drivers.interfaces.forgotten import watch_for_end
from drivers.registry import KindConfig

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OutputPins:
    """The pins, counted from 0, that carry the outputs `OUT_*`."""

    frame: int = 0
    gate: int = 1
    marker: int = 2

    def levels(self, outputs: int) -> int:
        """Levels of the pins, one bit for each pin, for an OR of `OUT_*`."""
        return sum(1 << pin for output, pin in self._pairs if outputs & output)

    def outputs(self, levels: int) -> int:
        """The OR of those `OUT_*` whose pins are high. levels: one bit for each pin."""
        return sum(output for output, pin in self._pairs if levels >> pin & 1)

    @property
    def _pairs(self) -> tuple[tuple[int, int], ...]:
        return (OUT_FRAME, self.frame), (OUT_GATE, self.gate), (OUT_MARKER, self.marker)


class BoardConfig(KindConfig):
    """Config of a board whose outputs may be on any of its pins."""

    frame_output: int
    gate_output: int
    marker_output: int

    @model_validator(mode="after")
    def _check_outputs(self) -> Self:
        used = (self.frame_output, self.gate_output, self.marker_output)
        for output in used:
            if used.count(output) > 1:
                raise ValueError(
                    f"output {output} has two uses; give frame_output, gate_output and marker_output one each"
                )
        return self

    @property
    def pins(self) -> OutputPins:
        """The pins that carry the outputs."""
        return OutputPins(self.frame_output, self.gate_output, self.marker_output)


class SyncBoard(SyncSource):
    """A sync source that is a board at a port. It may be playing a program although its answer to `run` did not
    arrive."""

    _lowered = 0
    """Number of calls of `gate_low` and `abort`."""
    _questions: frozenset[str]
    """Raw commands that change nothing."""
    _may_play: threading.Event
    """Set from the first call of a run, or a raw command, until all outputs are low again."""

    def _watch_for_end(self, lower: Callable[[], object], release: Callable[[], object]) -> None:
        """From now on take the outputs low if a program may still play when the device is deleted, or Python ends,
        without `close`. lower takes all outputs low, release gives up the port; neither may refer to the device."""
        self._may_play = threading.Event()
        self._end = partial(_end, self.name, lower, release, self._may_play, os.getpid())
        self._forgotten = watch_for_end(self, self._end)

    def _note_raw(self, command: str) -> None:
        """Note that a raw command may raise the gate, unless it is one of `_questions`."""
        if command.split(" ", 1)[0] not in self._questions or "\n" in command:
            self._may_play.set()

    def gate_low(self) -> None:
        """See `SyncSource`. The call also ends a `run` that is under way on another thread."""
        self._lowered += 1
        super().gate_low()
        self._may_play.clear()

    def abort(self) -> None:
        """See `SyncSource`. The call also ends a `run` that is under way on another thread."""
        self._lowered += 1
        super().abort()
        self._may_play.clear()

    def run(self) -> None:
        """Begin to play the program from its first word. If that fails after it has begun, or another thread calls
        `gate_low` or `abort` meanwhile, takes all outputs low and raises the error. If the outputs cannot be taken low,
        that is only logged."""
        lowered = self._lowered
        try:
            super().run()
            self._may_play.set()  # another thread may have lowered the outputs before the run was sent
            if self._lowered != lowered:
                raise DeviceFault(f"{self.name}: run was ended by gate_low or abort; run again")
        except WrongState:
            raise  # nothing was sent, or `_do_run` has taken the outputs low
        except BaseException:
            try:
                self._do_abort()
            except DeviceError as error:
                _log.error("%s: outputs may be high, turn the laser off by its key: %s", self.name, error)
            raise


def _end(
    name: str, lower: Callable[[], object], release: Callable[[], object], may_play: threading.Event, process: int
) -> None:
    """Take the outputs of a board low that may play a program, and release its port. Errors are only logged.

    process: number of the process that opened it; in another one, forked from it, nothing is done.
    """
    if os.getpid() != process:
        return
    if may_play.is_set():
        may_play.clear()  # a thread that watches the program must not take its end for a fault
        try:
            lower()
            _log.warning("%s: may have been left playing; its outputs were taken low", name)
        except BaseException as error:
            may_play.set()
            if not isinstance(error, Exception):  # an interrupt; called again, it goes on from here
                raise
            key = "turn the laser off by its key"
            _log.error("%s: was left playing and may open the gate, %s (%s)", name, key, error)
    release()
