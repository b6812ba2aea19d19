"""Runs a scan: starts the devices in order, takes maps from their frames, and makes everything safe.

The `Pipeline` works between SPAD and caller. When all frames have come, or anything fails, the rig is made safe on the
caller's thread. Frames that are left in the ring buffer at that time are still counted and estimated, unless the
caller's thread itself failed.
"""

import logging
import math
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from fractions import Fraction

from drivers.clock import VirtualClock, now_s
from drivers.errors import DeviceError, DeviceFault, DeviceTimeout
from drivers.guard import GuardLimits
from drivers.interfaces import SpadCounters, SpadTiming
from drivers.replay.spad import ReplaySpad
from drivers.transports.endpoints import EMULATED_PREFIX
from rig.count.followed_row import RowFollower
from rig.count.sweeps import FirstSweep, SweepAssembler
from rig.count.volume import SweepCounter, SweepLayout
from rig.depth.fog_meter import FogEstimate
from rig.depth.reconstruct import MakesMaps
from rig.devices.open import OpenRig
from rig.devices.prepare import lead_s, most_sweeps, require_memory, spare_lead_s
from rig.errors import DevicesError
from rig.plan.gate_pulses import sync_program
from rig.plan.scan_plan import ScanPlan
from rig.recording.replay import RecordedStart
from rig.recording.writer import WritesBlocks
from rig.run_folder.summary import PipelineStats
from rig.run_folder.time_of_day import TimeOfDay
from rig.scan.counting import AcquiredMap, CountingRequest
from rig.scan.monitor import NOBODY, Listeners, ScanProgress
from rig.scan.pipeline import JOIN_S, Overload, Pipeline, require_policy, ring_for

_log = logging.getLogger(__name__)

SILENCE_S = 5.0
"""A SPAD that sends nothing for this long, while the ring is empty, has failed."""
WARM_UP_S = 120.0
"""Longest wait for a laser to warm up."""
WARM_LOOK_S = 0.2
TELL_S = 0.1
"""Time from one report of progress to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcquisitionRequest:
    """An acquisition of `maps` maps.

    policy: what to do with frames that come too fast.
    first_alone: take the first map with a separate start, so that a SPAD that cannot wait stands still while the
    estimator learns from that map.
    learns: whether the estimator learns from the first map; the progress then says so.
    starts: for a replay, the recorded starts with the number of sweeps of each; None lets the scan choose.
    silence_s: a SPAD that sends nothing for this long, in seconds, with the ring empty, has failed.
    recording: takes every block; None records nothing.
    times: notes the time of day of frames; None for a replay.
    listeners: callbacks that are informed of the progress.
    """

    maps: int
    policy: Overload = Overload.ABORT
    first_alone: bool = False
    learns: bool = False
    starts: Iterator[RecordedStart] | None = None
    silence_s: float = SILENCE_S
    recording: WritesBlocks | None = None
    times: TimeOfDay | None = None
    listeners: Listeners = NOBODY


class Acquisition:
    """A scan with an open rig. Iterate once over `run()`.

    plan, timing: from `rig.devices.prepare`. maker: makes the maps, on the counting thread, such as a
    `rig.depth.reconstruct.Reconstructor`.

    Raises UsageError if the SPAD cannot do what the policy asks, ValueError for less than one map, and PlanError if the
    SPAD's memory is too small for a map (not checked in a replay).
    """

    def __init__(
        self, rig: OpenRig, plan: ScanPlan, timing: SpadTiming, maker: MakesMaps, request: AcquisitionRequest
    ) -> None:
        if request.maps < 1:
            raise ValueError(f"{request.maps} maps; ask for at least 1")
        require_policy(request.policy, rig.spad.info)
        if request.starts is None:
            require_memory(rig, plan)
        self._rig = rig
        self._plan = plan
        self._timing = timing
        self._maker = maker
        self._asked = request
        self._listeners = request.listeners
        self._pipeline: Pipeline | None = None
        self._stats_before = PipelineStats()
        self._counters_before = SpadCounters(0, 0, 0, 0, 0)
        self._frames_before = 0
        self._fog: FogEstimate | None = None
        self.trouble: list[str] = []
        """Lines on devices that could not be made safe. A caller that takes no more maps, or for whom an interrupt is
        the usual end, gets no error that says so, and has to look here."""

    @property
    def counters(self) -> SpadCounters:
        """The SPAD's own counts over all its starts so far. May be called from any thread."""
        if self._pipeline is None:
            return self._counters_before
        return added_counters(self._counters_before, self._rig.spad.counters)

    @property
    def stages(self) -> PipelineStats:
        """Figures of each stage so far. May be called from any thread."""
        return self._stats_before if self._pipeline is None else self._stats_before.and_then(self._pipeline.stats())

    def run(self) -> Generator[AcquiredMap, None, None]:
        """Scan; yields the maps in order. However the iteration ends, gate, laser, scanner and SPAD are made safe.

        Raises DeviceError if a device fails, RingOverflow if frames came too fast, RecordingError if a block cannot be
        written. Maps that are complete by then are yielded before the error is raised. Raises DevicesError if not all
        devices could be made safe; if there is another error already, notes on that one say so instead.
        """
        plan = self._plan
        counter = self._maker.counter(
            SweepLayout(plan.columns, plan.rows, plan.width, plan.x0, plan.window, plan.exposures, plan.used_px)
        )
        if self._listeners.row is not None and not isinstance(counter, SweepCounter):  # which keeps all rows
            bins = plan.columns if plan.lines is None else plan.lines.places
            counter = RowFollower(counter, self._listeners.row, bins, plan.width)
        done = 0
        while done < self._asked.maps:
            sweeps, begin = self._next_start(self._asked.maps - done)
            delay_s = 0.0 if self._rig.model is None else self._rig.model.gate_delay_s
            assembler = SweepAssembler(plan, counter, sweeps, done, begin, delay_s)
            counter.reset()
            yield from self._run_start(assembler, sweeps, done)
            done += sweeps

    def _next_start(self, left: int) -> tuple[int, FirstSweep]:
        """Number of sweeps of the next start, at most `left`, and the sweep with which the start begins.

        The number is the recorded one, 1 for a first map alone, or else as many as burst memory and sync program hold.
        """
        if self._asked.starts is not None:
            start = next(self._asked.starts)
            return min(left, start.sweeps), start.begin
        if self._asked.first_alone and left == self._asked.maps:
            return 1, FirstSweep()
        return min(left, most_sweeps(self._rig, self._plan) or left), FirstSweep()

    def _burst_frames(self, sweeps: int) -> int | None:
        if self._plan.burst_frames is None:
            return None
        lead = Fraction(lead_s(self._rig) + spare_lead_s(self._rig)) * self._plan.frame_rate_hz
        return min(self._plan.burst_frames, math.ceil(self._plan.frames_for(sweeps) + lead))

    def _run_start(self, assembler: SweepAssembler, sweeps: int, done: int) -> Generator[AcquiredMap, None, None]:
        rig, plan = self._rig, self._plan
        clock = rig.scanner.load(plan.waveform, plan.scanner_repeats(sweeps))
        if clock != plan.point_rate_hz:
            raise DeviceFault(
                f"{rig.scanner.name} runs at {float(clock):g} points a second, planned were "
                f"{float(plan.point_rate_hz):g}; compile the plan anew"
            )
        rig.sync.program(*sync_program(plan, sweeps))
        asked = self._asked
        keeps_time = isinstance(rig.spad, ReplaySpad) and rig.spad.pace.speed is not None
        held = 0 if asked.recording is None else asked.recording.keep_blocks
        ring = ring_for(asked.policy, rig.spad.info, plan, self._timing, keeps_time=keeps_time, held=held)
        work = CountingRequest(assembler, sweeps, self._maker, asked.silence_s, self._listeners.sweeps)
        on_frame = None if rig.guard is None else rig.guard.beat
        told = self._listeners
        times = None if asked.times is None else asked.times.begin(done)
        pipeline = Pipeline(rig.spad, ring, work, asked.recording, told.monitor, on_frame, told.watched, times)
        if rig.guard is not None:
            rig.guard.expect(self._guard_limits(sweeps))
            rig.spad.on_wait = rig.guard.wait
        rig.scanner.on_fault = self._darken
        if asked.recording is not None:
            asked.recording.begin(sweeps)
        trouble: list[str] = []
        started_s = 0.0
        try:
            try:
                self._arm_laser()
                if times is not None:
                    times.ask()
                rig.spad.start(self._burst_frames(sweeps))
                begun_s = now_s(rig.clock)
                self._pipeline = pipeline
                rig.sync.run()
                rig.scanner.start()
                started_s = now_s(rig.clock) - begun_s
                pipeline.start()
                while pipeline.maps.streaming:
                    if (found := pipeline.maps.take_streaming(TELL_S)) is not None:
                        self._fog = found.result.fog
                        yield found
                    try:
                        if rig.guard is not None and rig.guard.failure is not None:
                            raise rig.guard.failure
                        if (fault := rig.scanner.status.fault) is not None:  # frames would go on without markers
                            raise DeviceFault(fault)
                    except DeviceError as error:
                        pipeline.end_source(error)  # no wait: the SPAD itself may be silent
                        break
                    self._tell(assembler, done)
            finally:
                trouble = self._make_safe(pipeline)
            # Nothing moves or shines any more: what was received is still counted and estimated.
            while not pipeline.maps.drained:
                if (found := pipeline.maps.take_rest(TELL_S)) is not None:
                    self._fog = found.result.fog
                    yield found
                self._tell(assembler, done)
            if (failure := pipeline.error()) is not None:
                self._note_late_scanner(failure, sweeps, started_s)
                raise failure
            if trouble:
                raise DevicesError("\n".join(trouble))
        except BaseException as error:
            if not isinstance(error, DevicesError):
                for line in trouble:
                    error.add_note(line)
            raise
        finally:
            self._end_start(pipeline, assembler)

    def _note_late_scanner(self, failure: BaseException, sweeps: int, started_s: float) -> None:
        """Add a line to an error if it is the computer's fault that a burst was over before its sweeps were.

        started_s: time from the SPAD's start until the scanner had started, in seconds.
        """
        frames = self._burst_frames(sweeps)
        if frames is None:
            return
        room_s = (frames - self._plan.frames_for(sweeps)) / float(self._plan.frame_rate_hz)
        if started_s > room_s:
            failure.add_note(
                f"{self._rig.scanner.name} started {started_s:.2g} s after the SPAD, whose burst leaves {room_s:.2g} s "
                "for that; free the computer, or its network to the scanner"
            )

    def _darken(self) -> None:
        """Take the gate low and pause the laser on the thread of a scanner that has failed: the caller's may be at work
        on a map when its turn comes to end the run. The caller's thread does both again, and reports what fails."""
        for darken in (self._rig.sync.gate_low, self._rig.laser.pause):
            with suppress(DeviceError):
                darken()

    def _guard_limits(self, sweeps: int) -> GuardLimits:
        """The laser guard's time limits for this start. In a burst they allow for silence until it is read out."""
        usual, plan = GuardLimits(), self._plan
        block_s = 3 * self._timing.stride / plan.link_bytes_per_s if plan.link_bytes_per_s else 0.0
        exposed_s = (self._burst_frames(sweeps) or 0) / float(plan.frame_rate_hz)
        return GuardLimits(
            frames_within_s=max(usual.frames_within_s, block_s),
            busy_within_s=max(usual.busy_within_s, block_s),
            waits_within_s=max(self._silence_of_spad_s(), block_s),
            first_wait_s=max(self._silence_of_spad_s(), block_s, usual.first_wait_s) + exposed_s,
            first_frame_s=usual.first_frame_s + exposed_s,
        )

    def _silence_of_spad_s(self) -> float:
        """Longest time without an answer from the SPAD, in seconds, while the laser may shine."""
        spad, usual = self._rig.config.spad, GuardLimits()
        if str(getattr(spad, "port", "")).startswith(EMULATED_PREFIX):  # emulated on the same processors
            return usual.busy_within_s
        return float(getattr(spad, "silence", usual.waits_within_s))

    def _end_start(self, pipeline: Pipeline, assembler: SweepAssembler) -> None:
        pipeline.close()
        if pipeline.monitor_lost:
            self._listeners = replace(self._listeners, monitor=None)
        if self._pipeline is not None:
            self._counters_before, self._stats_before = self.counters, self.stages
            self._pipeline = None
        self._frames_before += assembler.frames_seen

    def _tell(self, assembler: SweepAssembler, done: int) -> None:
        planned = self._frames_before + math.ceil(self._plan.frames_for(self._asked.maps - done))
        frames, sweeps = min(self._frames_before + assembler.frames_seen, planned), done + assembler.sweeps_done
        stages = self.stages
        lost = self.counters.lost
        lost = stages.dropped_frames if lost is None else lost
        stage, used = self._stage(sweeps), 0 if self._pipeline is None else self._pipeline.ring_used
        self._listeners.tell(
            ScanProgress(frames, planned, lost, sweeps, self._asked.maps, stages, self._fog, stage, used)
        )

    def _stage(self, sweeps: int) -> str:
        if self._pipeline is not None and self._pipeline.estimating:
            return "learning" if self._asked.learns and sweeps == 1 else "estimating"
        if isinstance(self._rig.spad, ReplaySpad):
            return "replaying"
        return "rendering" if isinstance(self._rig.clock, VirtualClock) else "scanning"

    def _arm_laser(self) -> None:
        """Set the gate low, arm the laser and wait until it is warm. Raises DeviceTimeout after WARM_UP_S. The SPAD
        starts later, since its frames would overflow the ring meanwhile."""
        self._rig.sync.gate_low()
        laser, power_w = self._rig.laser, self._rig.config.scan.power
        laser.arm(laser.limits.max_power_w if power_w is None else power_w)
        waited_s = 0.0
        while laser.status.warming_up:  # an armed laser may give no light yet
            if waited_s >= WARM_UP_S:
                raise DeviceTimeout(f"{laser.name} is still warming up after {WARM_UP_S:g} s; wait and start again")
            self._rig.clock.sleep(WARM_LOOK_S)
            waited_s += WARM_LOOK_S

    def _make_safe(self, pipeline: Pipeline) -> list[str]:
        """Set the gate low, take no more frames, pause the laser, park the mirror and stop the SPAD, in this order,
        whatever fails; returns a line for each failure. An interrupt meanwhile is raised at the end."""
        rig = self._rig
        self.trouble = trouble = []
        interrupted: BaseException | None = None
        steps: tuple[tuple[str, Callable[[], None]], ...] = (
            ("gate", rig.sync.abort),
            ("frames", pipeline.end_source),
            ("laser", rig.laser.pause),
            ("scanner", rig.scanner.park),
            ("spad", rig.spad.stop),
        )
        for name, step in steps:
            try:
                step()
            except BaseException as error:  # neither a failed step nor a second Ctrl-C may prevent the others
                trouble.append(f"{name}: {str(error) or type(error).__name__}")
                interrupted = interrupted or (None if isinstance(error, Exception) else error)
                if name == "gate" and rig.laser.gate_only:
                    trouble.append(f"laser: only that gate ends the light of {rig.laser.name}: switch it off by hand")
        if not pipeline.join_source():
            trouble.append(f"spad: {rig.spad.name} did not return within {JOIN_S:g} s of being stopped; unplug it")
        for line in trouble:
            _log.error("while making the rig safe: %s", line)
        if interrupted is not None:
            raise interrupted
        return trouble


def added_counters(before: SpadCounters, now: SpadCounters) -> SpadCounters:
    """Sum of the counts of two starts; None for each count that is None in either."""
    counts = (
        None if (a := getattr(before, field.name)) is None or (b := getattr(now, field.name)) is None else a + b
        for field in fields(SpadCounters)
    )
    return SpadCounters(*counts)  # type: ignore[arg-type]
