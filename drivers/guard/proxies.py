"""Laser and sync source as the application sees them: the usual interfaces, done by the guard."""

from collections.abc import Sequence
from typing import Any, Protocol

from drivers.interfaces import LaserLimits, LaserStatus, LineLaser, Pulse, SyncSource, SyncStatus


class Asks(Protocol):
    """What a proxy needs of the guard."""

    def ask(self, slot: str, verb: str, *arguments: Any) -> Any:
        """Have the guard do a verb; returns its result, raises its error, or `GuardLost`."""
        ...

    @property
    def lost(self) -> bool:
        """Whether there is no guard any more."""
        ...


class GuardedLaser(LineLaser):
    """A laser whose port the guard owns."""

    def __init__(self, guard: Asks, about: dict[str, Any]) -> None:
        super().__init__(about["name"])
        self._guard = guard
        self._identity = str(about["identity"])
        self._limits = LaserLimits(*about["limits"])

    @property
    def identity(self) -> str:
        """As the guard found it."""
        return self._identity

    @property
    def limits(self) -> LaserLimits:
        """As the guard found them when it opened the laser."""
        return self._limits

    def _do_status(self) -> LaserStatus:
        return LaserStatus(**self._guard.ask("laser", "status"))

    def _check_health(self) -> None:
        """The guard's own `arm` does it: a slow laser is not asked twice."""

    def _do_arm(self, power_w: float) -> None:
        self._guard.ask("laser", "arm", power_w)

    def _do_pause(self) -> None:
        self._guard.ask("laser", "pause")

    def _do_disarm(self) -> None:
        self._guard.ask("laser", "disarm")

    def _do_close(self) -> None:
        if not self._guard.lost:
            self._guard.ask("laser", "close")


class GuardedSync(SyncSource):
    """A sync source whose port the guard owns."""

    def __init__(self, guard: Asks, about: dict[str, Any]) -> None:
        super().__init__(about["name"])
        self._guard = guard
        self._identity = str(about["identity"])
        self._resolution_s = float(about["resolution_s"])

    @property
    def identity(self) -> str:
        """As the guard found it."""
        return self._identity

    @property
    def resolution_s(self) -> float:
        """As the guard found it when it opened the device."""
        return self._resolution_s

    def most_repeats(self, pulses: Sequence[Pulse]) -> int | None:
        """As the device behind it."""
        most: int | None = self._guard.ask("sync", "most_repeats", _plain(pulses))
        return most

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        self._guard.ask("sync", "program", _plain(pulses), repeats)

    def _do_run(self) -> None:
        self._guard.ask("sync", "run")

    def _do_gate_low(self) -> None:
        self._guard.ask("sync", "gate_low")

    def _do_abort(self) -> None:
        self._guard.ask("sync", "abort")

    def _do_status(self) -> SyncStatus:
        return SyncStatus(**self._guard.ask("sync", "status"))

    def _do_close(self) -> None:
        if not self._guard.lost:
            self._guard.ask("sync", "close")


def _plain(pulses: Sequence[Pulse]) -> list[list[Any]]:
    return [[pulse.outputs, pulse.duration_s, pulse.held] for pulse in pulses]
