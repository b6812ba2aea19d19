"""Runs a scan: starts the devices in order, takes their frames sweep by sweep, and makes everything safe.

A source thread fills the ring; the caller's thread takes the blocks out and gets a `SweepData` at the end of each
sweep. While the caller works on one, the source goes on as far as the ring reaches: a simulated SPAD then waits, a real
one raises RingOverflow when it would have to drop frames.
"""

import logging
import math
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from drivers.clock import Clock
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.frames import FrameBlock, packed_row_bytes
from drivers.interfaces import SpadArray, SpadCounters, SpadTiming
from drivers.ring import BlockRing, RingReader
from rig.counting import SweepCounter
from rig.errors import DevicesError
from rig.scan_plan import ScanPlan
from rig.session import OpenRig
from rig.sweeps import SweepAssembler, SweepData

_log = logging.getLogger(__name__)

RING_SLOTS = 8
"""Blocks between source and counting; a simulated SPAD runs ahead by as many."""
SILENCE_S = 5.0
"""A SPAD that sends nothing for so long, with the ring empty, has failed."""
WARM_UP_S = 120.0
"""Longest wait for a laser to warm up."""
BURST_LEAD_S = 5e-3
"""Time between the SPAD's start and the first scan marker that a burst must have room for."""
HANG_S = 180.0
"""Longest wait for a SPAD whose `fill` neither returns nor says that it has nothing."""
JOIN_S = 30.0
"""Longest wait for the source thread after the SPAD was stopped."""


@dataclass(frozen=True, slots=True)
class ScanProgress:
    """How far a run is, told after every block."""

    frames: int
    frames_planned: int
    sweeps: int
    maps: int


class Acquisition:
    """A scan of `maps` maps with an open rig, a plan and the SPAD's timing from `rig.session.prepare`.

    Iterate once over `run()`. on_block is called after every block, on the caller's thread.
    """

    def __init__(
        self,
        rig: OpenRig,
        plan: ScanPlan,
        timing: SpadTiming,
        maps: int,
        *,
        threads: int = 2,
        on_block: Callable[[ScanProgress], None] | None = None,
        silence_s: float = SILENCE_S,
    ) -> None:
        if maps < 1:
            raise ValueError(f"{maps} maps; ask for at least 1")
        self._rig = rig
        self._plan = plan
        self._timing = timing
        self._maps = maps
        self._threads = threads
        self._on_block = on_block
        self._silence_s = silence_s
        self.high_water = 0
        """Most ring slots in use at one time; RING_SLOTS means that the source had to wait."""

    @property
    def frames_planned(self) -> int:
        """Frames of all maps, nominally."""
        return round(self._maps * self._plan.frames_per_sweep)

    @property
    def counters(self) -> SpadCounters:
        """The SPAD's own counts of the present or the last start."""
        return self._rig.spad.counters

    def run(self) -> Generator[SweepData, None, None]:
        """Scan; yields each sweep as it ends. However the iteration ends, gate, laser, scanner and SPAD are made safe.

        Raises DeviceError where a device fails, DevicesError where they could not all be made safe.
        """
        plan = self._plan
        counter = SweepCounter(plan.columns, plan.rows, plan.width, plan.x0, plan.window, self._threads)
        with closing(counter):
            # Compiles the counting kernel now: a second of waiting in the run would overflow a real ring.
            no_frames = np.zeros((0, plan.rows, packed_row_bytes(plan.width)), np.uint8)
            counter.add(no_frames, np.zeros(0, np.int32), np.zeros(0, np.float64))
            done = 0
            while done < self._maps:
                group = self._group(self._maps - done)
                assembler = SweepAssembler(plan, counter, group, done)
                counter.reset()
                yield from self._run_group(assembler, group, done)
                done += group

    def _group(self, left: int) -> int:
        """Sweeps of one start of the SPAD: all of them in a stream, as many as its memory holds in a burst."""
        if self._plan.burst_frames is None:
            return left
        spare = self._plan.burst_frames - BURST_LEAD_S * float(self._plan.frame_rate_hz)
        return max(1, min(left, int(spare / float(self._plan.frames_per_sweep))))

    def _burst_frames(self, sweeps: int) -> int | None:
        if self._plan.burst_frames is None:
            return None
        lead = Fraction(BURST_LEAD_S) * self._plan.frame_rate_hz
        return min(self._plan.burst_frames, math.ceil(sweeps * self._plan.frames_per_sweep + lead))

    def _run_group(self, assembler: SweepAssembler, sweeps: int, done: int) -> Generator[SweepData, None, None]:
        rig, plan = self._rig, self._plan
        clock = rig.scanner.load(plan.waveform, plan.scanner_repeats(sweeps))
        if clock != plan.point_rate_hz:
            raise DeviceFault(
                f"{rig.scanner.name} runs at {float(clock):g} points a second, planned were "
                f"{float(plan.point_rate_hz):g}; compile the plan anew"
            )
        rig.sync.program(*plan.sync_program(sweeps))
        ring = BlockRing(RING_SLOTS, self._timing.stride)
        reader = ring.reader("counting")
        source = _Source(rig.spad, ring, self._silence_s)
        try:
            self._arm()
            rig.spad.start(self._burst_frames(sweeps))
            rig.sync.run()
            rig.scanner.start()
            source.start()
            for block in _blocks(reader, source, self._silence_s):
                for sweep in assembler.add(block):
                    yield sweep
                    if assembler.complete:
                        break
                self.high_water = max(self.high_water, ring.high_water)
                self._tell(assembler, done)
                if assembler.complete:
                    break
            else:
                raise DeviceFault(
                    f"{rig.spad.name}: the stream ended after {assembler.sweeps_done} of {sweeps} sweeps, without the "
                    "scan marker that closes the last one; check the scanner and its marker line"
                )
        except BaseException as error:
            for line in self._make_safe(source, reader):
                error.add_note(line)
            raise
        trouble = self._make_safe(source, reader)
        if trouble:
            raise DevicesError("\n".join(trouble))

    def _tell(self, assembler: SweepAssembler, done: int) -> None:
        if self._on_block is not None:
            before = round(done * self._plan.frames_per_sweep)
            frames = before + assembler.frames_seen
            self._on_block(ScanProgress(frames, self.frames_planned, done + assembler.sweeps_done, self._maps))

    def _arm(self) -> None:
        """Arm the laser behind a gate that reads back low and wait for it; a started SPAD would overflow meanwhile."""
        self._rig.sync.gate_low()
        power_w = self._rig.config.scan.power
        self._rig.laser.arm(self._rig.laser.limits.max_power_w if power_w is None else power_w)
        _wait_until_warm(self._rig, self._rig.clock)

    def _make_safe(self, source: "_Source", reader: RingReader) -> list[str]:
        """Gate low, laser paused, mirror parked, SPAD stopped, in this order and each one whatever the others did."""
        rig = self._rig
        source.end()
        trouble: list[str] = []
        interrupted: BaseException | None = None
        steps: tuple[tuple[str, Callable[[], None]], ...] = (
            ("gate", rig.sync.abort),
            ("laser", rig.laser.pause),
            ("scanner", rig.scanner.park),
            ("spad", rig.spad.stop),
        )
        for name, step in steps:
            try:
                step()
            except BaseException as error:  # neither a step that fails nor a second Ctrl-C may keep the others away
                trouble.append(f"{name}: {error or type(error).__name__}")
                interrupted = interrupted or (None if isinstance(error, Exception) else error)
        reader.close()
        if not source.join():
            trouble.append(f"spad: {rig.spad.name} did not return within {JOIN_S:g} s of being stopped; unplug it")
        for line in trouble:
            _log.error("while making the rig safe: %s", line)
        if interrupted is not None:
            raise interrupted
        return trouble


class _Source:
    """The thread that fills the ring."""

    def __init__(self, spad: SpadArray, ring: BlockRing, silence_s: float) -> None:
        self._spad = spad
        self._ring = ring
        self._silence_s = silence_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="spad source", daemon=True)
        self.silences: list[DeviceTimeout] = []
        """What the SPAD said each time it had nothing, or no room, for half of `silence_s`."""

    def start(self) -> None:
        self._thread.start()

    def end(self) -> None:
        self._over.set()

    def join(self) -> bool:
        """Wait for the thread; False where it does not end."""
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                try:
                    if not self._spad.fill(self._ring, self._silence_s / 2):
                        break
                except DeviceTimeout as error:
                    # Either the SPAD is silent or the ring is full; only the reader knows, by having nothing to read.
                    self.silences.append(error)
            self._ring.finish()
        except BaseException as error:  # handed to the reader, which raises it on the caller's thread
            self._ring.finish(error)


def _blocks(reader: RingReader, source: _Source, silence_s: float) -> Iterator[FrameBlock]:
    """The blocks of the run. DeviceTimeout, in the SPAD's own words, where it is silent while the ring is empty."""
    while True:
        heard = len(source.silences)
        waited_s = 0.0
        while True:
            try:
                block = reader.next(silence_s)
                break
            except DeviceTimeout:
                waited_s += silence_s
                # The first time-out may be of a wait for room that ended just before the ring was empty. One that does
                # not come means that the SPAD is at work: a simulated one compiles its kernels before the first block.
                if len(source.silences) >= heard + 2:
                    raise source.silences[-1] from None
                if waited_s >= HANG_S:
                    raise
        if block is None:
            return
        yield block


def _wait_until_warm(rig: OpenRig, clock: Clock) -> None:
    """Wait while the laser says that it warms up: 'armed' does not mean 'light'."""
    waited_s = 0.0
    while rig.laser.status.warming_up:
        if waited_s >= WARM_UP_S:
            raise DeviceTimeout(f"{rig.laser.name} is still warming up after {WARM_UP_S:g} s; wait and start again")
        clock.sleep(0.2)
        waited_s += 0.2
