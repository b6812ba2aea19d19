"""The bench: the state that the simulated devices share, which is one clock, one mirror, one laser and one gate line.

light(t) = emission AND gate. The mirror is where its command was one lag earlier. Devices tell the bench what they do;
the SPAD asks the bench what happened during its frames. Methods act at the clock's present time and do not change
frames made before. Thread-safe.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import Lag
from drivers.clock import NS_PER_S, Clock
from drivers.interfaces import MARKER_LINE, MARKER_SCAN, Pulse, ScanWaveform, SyncStatus
from sim_backend.gate_program import GateProgram, gate_shares
from sim_backend.mirror_motion import Array, Jitter, Playing, resting


@dataclass(frozen=True, slots=True, eq=False)
class BenchState:
    """State of the bench during n frames.

    mirror: (n,) mirror position, as a command, in the middle of each exposure. velocity_per_s: (n,) change of the
    mirror position per second, NaN if unknown. share: (n,) part of the exposure with the gate high. edge: (n,) bool,
    whether the gate changed during the exposure. backward: (n,) bool, level of the direction signal at the frame's
    start. line_s, scan_s: times in s of the rising edges of the line and scan markers in these frames. power_w: laser
    power that an open gate lets out, 0 if the laser is off. jitter: (n,) or 0, deviation of the mirror from `mirror`.
    """

    mirror: Array
    velocity_per_s: Array
    share: Array
    edge: NDArray[np.bool_]
    backward: NDArray[np.bool_]
    line_s: Array
    scan_s: Array
    power_w: float
    jitter: Array | float = 0.0


class Bench:
    """State of scanner, laser and gate over the bench's time, which starts at 0 s when the bench is made."""

    def __init__(self, clock: Clock, lag: Lag) -> None:
        self.clock = clock
        self.lag = lag
        self._epoch_ns = clock.now_ns()
        self._lock = threading.RLock()
        self._motion = resting(0.0)
        self._program: GateProgram | None = None
        self._aborted = False
        self._power_w = 0.0
        self.jitter = Jitter(0.0, 0)
        """Shaking of the mirror."""
        self.spad_start_s = 0.0
        """Time of the SPAD's last start."""

    def now_s(self) -> float:
        """Present time of the bench."""
        return (self.clock.now_ns() - self._epoch_ns) / NS_PER_S

    def clock_ns(self, time_s: float) -> int:
        """The clock's reading at a given time of the bench."""
        return self._epoch_ns + round(time_s * NS_PER_S)

    def play(self, waveform: ScanWaveform, repeats: int, *, latency_s: float, rate_hz: float) -> None:
        """Play a waveform `repeats` times at `rate_hz` points per second, starting `latency_s` from now. Until then the
        command is that of the first point."""
        with self._lock:
            start_s = self.now_s() + latency_s
            self._motion = Playing(waveform, repeats, start_s, rate_hz, self.lag.forward, self.lag.backward)

    def rest(self, command: float) -> None:
        """Stop the mirror now, at the given command."""
        with self._lock:
            self._motion = resting(command)

    def moving(self) -> bool:
        """Whether a waveform is being played or is about to start."""
        with self._lock:
            return self._motion.moving(self.now_s())

    def mirror(self) -> float:
        """Present position of the mirror, as a command, without its jitter."""
        with self._lock:
            return float(self._motion.mirror(np.array([self.now_s()]))[0])

    def emit(self, power_w: float) -> None:
        """Set the laser power in W that an open gate lets out; 0 means no emission."""
        with self._lock:
            self._power_w = power_w

    def run_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        """Start a program of pulses now, in place of any other. It is played `repeats` times."""
        with self._lock:
            self._aborted = False
            self._program = GateProgram(pulses, repeats, self.now_s())

    def lower_gate(self) -> None:
        """Take the gate low from now on, until the next program."""
        with self._lock:
            if self._program is not None:
                self._catch_up()
                self._program.lower_gate(self.now_s())

    def abort_program(self) -> None:
        """Take all outputs low from now on, until the next program."""
        with self._lock:
            self._aborted = True
            if self._program is not None:
                self._catch_up()
                self._program.abort(self.now_s())

    def outputs(self) -> SyncStatus:
        """State of the program and present levels of its outputs."""
        with self._lock:
            if self._program is None or self._aborted:
                return SyncStatus("aborted" if self._aborted else "stopped", 0)
            self._catch_up()
            word = int(self._program.levels(self.now_s(), np.inf)[1][0])
            if self._program.ended and word == 0:
                return SyncStatus("stopped", word)
            return SyncStatus("waiting" if self._program.waiting else "running", word)

    def during(self, start_s: Array, exposure_s: float, period_s: float) -> BenchState:
        """State during frames that start at start_s (n,), in s of the bench, ascending, about period_s apart. The
        waveform and the laser power are the present ones. Ask for frames in ascending order: earlier levels of the gate
        are dropped."""
        until_s = float(start_s[-1]) + period_s
        with self._lock:
            motion = self._motion
            share, edge = self._gate(start_s, exposure_s, until_s)
            first, last = motion.mirror(start_s), motion.mirror(start_s + exposure_s)
            return BenchState(
                mirror=motion.mirror(start_s + 0.5 * exposure_s),
                velocity_per_s=(last - first) / exposure_s,
                share=share,
                edge=edge,
                backward=motion.backward(start_s),
                line_s=motion.edges(MARKER_LINE, float(start_s[0]), until_s),
                scan_s=motion.edges(MARKER_SCAN, float(start_s[0]), until_s),
                power_w=self._power_w,
                jitter=self.jitter.error(start_s + 0.5 * exposure_s) if self.jitter.rms else 0.0,
            )

    def _gate(self, start_s: Array, exposure_s: float, until_s: float) -> tuple[Array, NDArray[np.bool_]]:
        program = self._program
        if program is None:
            return np.zeros(len(start_s)), np.zeros(len(start_s), bool)
        program.advance(until_s, partial(self._motion.first_high, MARKER_SCAN))
        program.forget(float(start_s[0]) - exposure_s)
        times, words = program.levels(float(start_s[0]), until_s)
        return gate_shares(times, words, start_s, exposure_s)

    def _catch_up(self) -> None:
        assert self._program is not None
        # Up to and including now: an edge at this very moment has happened.
        self._program.advance(np.nextafter(self.now_s(), np.inf), partial(self._motion.first_high, MARKER_SCAN))
