"""The simulated pattern generator. Its gate output lets laser light out; its trigger input reads the scan marker."""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Literal

from drivers.interfaces import Pulse, SyncSource, SyncStatus
from drivers.registry import Kind, KindConfig, Surroundings
from sim_backend.bench import Bench
from sim_backend.world import bench_of

RESOLUTION_S = 1e-8
"""Resolution: one cycle of a 100 MHz pattern generator."""


class SimulatedSyncConfig(KindConfig):
    """Config of the simulated sync source."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"


class SimulatedSync(SyncSource):
    """The simulated sync source. It tells the bench, the state that all simulated devices share, what the gate does."""

    def __init__(self, bench: Bench) -> None:
        super().__init__("simulated sync")
        self._bench = bench
        self._program: tuple[tuple[Pulse, ...], int] = ((), 0)

    @property
    def resolution_s(self) -> float:
        """Step to which durations of pulses are rounded, 10 ns."""
        return RESOLUTION_S

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        rounded = tuple(
            p if p.duration_s is None else replace(p, duration_s=round(p.duration_s / RESOLUTION_S) * RESOLUTION_S)
            for p in pulses
        )
        self._program = (rounded, repeats)

    def _do_run(self) -> None:
        self._bench.run_program(*self._program)

    def _do_gate_low(self) -> None:
        self._bench.lower_gate()

    def _do_abort(self) -> None:
        self._bench.abort_program()

    def _do_status(self) -> SyncStatus:
        return self._bench.outputs()

    def _do_close(self) -> None:
        self._bench.abort_program()


def create(config: SimulatedSyncConfig, surroundings: Surroundings) -> SimulatedSync:
    """The sync source. It acts on the simulated world's bench, or on a new bench if the rig has no simulated world."""
    return SimulatedSync(bench_of(surroundings))


KIND = Kind(config=SimulatedSyncConfig, create=create)
