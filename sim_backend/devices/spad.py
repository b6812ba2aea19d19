"""The simulated SPAD array: asks the world's bench what happened during its frames and draws them, block by block.

On a `VirtualClock` time passes as frames are made; on any other clock a block comes when the period of its last frame
is over.

If the config says so, some frames get lost on the way to the computer, which leaves a gap, and others are replaced by a
copy of the previous frame of their block: its pixels, markers, counters and ticks. A copy keeps the number of the frame
that it replaces, so only its ticks give it away. Chance depends on the seed and the frame number alone.

The tick counter runs on its own crystal (`clock_error`, `clock_wander`). At time t its rate has the relative error y, a
constant plus a random walk W:

    dt/dtick = 1 / (tick_hz (1 + y)),    y = error + W,    var W(t) = wander^2 t

(random walk of frequency, of which the Allan deviation is wander sqrt(t/3): D. Allan, IEEE Trans. UFFC 34, 647, 1987.)
In the simulation W changes in steps, one every millisecond of the counter. An ordinary crystal is off by up to 50 ppm,
and by 1 ppm more per K; a wander of 0.1 ppm per root second is much.
"""

from fractions import Fraction
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.clock import NS_PER_S, VirtualClock
from drivers.cores import cores
from drivers.errors import DeviceError, DeviceTimeout, LimitExceeded
from drivers.frames import FRAME_RECORD, SUBFRAME_SHIFT, BlockFlag, BlockHeader, Mark
from drivers.interfaces import SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming, StreamMode, WindowTable
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from drivers.units import BytesPerSecond, ExactHertz, Ppm
from sim_backend.bench import BenchState
from sim_backend.effects.setting import Array, FrameTimes
from sim_backend.frames.photon_kernels import dropped_frames
from sim_backend.frames.photons import PhotonSource
from sim_backend.world import SimulatedWorld, note_effect

_TWICE = np.uint64(0xE7037ED1A0B428DB)
"""Selects the random stream that decides which frames come twice. Another stream decides which get lost."""


SUBFRAME_STEPS = 256
STEP_S = 1e-3
"""Time between the steps of a wandering crystal's error."""


class MarkerInputs:
    """Counts marker edges since the run's start. The counters of a frame include the edges that fall into its period.

    A scan marker sets the line counter to 0; a line marker at the same time counts as the first of the new sweep.
    """

    def __init__(self) -> None:
        self.line = 0
        self.sweep = 0

    def record(self, state: BenchState, start_s: Array, period_s: float, records: NDArray[np.void]) -> int:
        """Fill marks, line and sweep in the records of consecutive frames that start at start_s (n,), about one period
        apart.

        Returns the number of scan markers since the run's start, up to and including the first frame. The records hold
        only the lowest 16 bits of the counters.
        """
        lit = np.where(state.edge, int(Mark.GATE_EDGE), np.where(state.share > 0, int(Mark.GATE_HIGH), 0))
        marks = lit | np.where(state.backward, int(Mark.BACKWARD), 0)
        lines, sweeps = np.full(len(start_s), self.line), np.full(len(start_s), self.sweep)
        # As plain numbers: Python keeps each combination of flags that it has once seen, for ever.
        scan, line = int(Mark.SCAN), int(Mark.LINE)
        events = [(float(t), 0, scan) for t in state.scan_s] + [(float(t), 1, line) for t in state.line_s]
        first = self.sweep
        for time_s, _, mark in sorted(events):
            frame = max(int(np.searchsorted(start_s, time_s, side="right")) - 1, 0)
            if frame == 0 and mark == scan:
                first += 1
            place = min(int((time_s - float(start_s[frame])) / period_s * SUBFRAME_STEPS), SUBFRAME_STEPS - 1)
            marks[frame] = (int(marks[frame]) & ~(0xFF << SUBFRAME_SHIFT)) | mark | (max(place, 0) << SUBFRAME_SHIFT)
            if mark == scan:
                self.sweep, self.line = self.sweep + 1, 0
            else:
                self.line += 1
            lines[frame:], sweeps[frame:] = self.line, self.sweep
        records["marks"], records["line"], records["sweep"] = marks, lines & 0xFFFF, sweeps & 0xFFFF
        return first


def windows_at(window: WindowTable | None, first_sweep: int, records: NDArray[np.void]) -> NDArray[np.int32]:
    """First pixel of each frame's window (n,); zeros without a table. first_sweep: from `MarkerInputs.record`."""
    if window is None:
        return np.zeros(len(records), np.int32)
    since = first_sweep + ((records["sweep"].astype(np.int64) - first_sweep) & 0xFFFF)
    return window.x0_of(records["marks"], records["line"], since - 1)


class TickClock:
    """A tick counter that starts from 0 at time `start_s` of the bench. error: relative error of its rate, positive if
    it runs fast. wander: standard deviation of the change of the error in one second.
    """

    def __init__(self, tick_s: float, start_s: float, error: float, wander: float, seed: list[int]) -> None:
        """tick_s: the nominal time between ticks. seed: of the rate's random change."""
        self._tick_s = tick_s
        self._step_ticks = max(1, round(STEP_S / tick_s)) if wander else np.iinfo(np.int64).max
        self._sd = wander * np.sqrt(self._step_ticks * tick_s)
        self._random = np.random.default_rng(seed)
        self._step = 0
        """Number of the first step in the lists; steps that are no longer needed are dropped."""
        self._start_s = [start_s]
        self._error = [error]

    def times_s(self, first_tick: int, period_ticks: int, n: int) -> Array:
        """Times of n ticks, one period apart, float64 (n,). The first tick must not be before that of the last call."""
        ticks = first_tick + period_ticks * np.arange(n)
        step = ticks // self._step_ticks
        while self._step + len(self._error) <= step[-1]:
            self._start_s.append(self._start_s[-1] + self._step_ticks * self._tick_s / (1 + self._error[-1]))
            self._error.append(self._error[-1] + self._sd * self._random.standard_normal())
        gone = int(step[0]) - self._step
        del self._start_s[:gone], self._error[:gone]
        self._step += gone
        at = step - self._step
        since_s = (ticks - step * self._step_ticks) * self._tick_s
        times: Array = np.array(self._start_s)[at] + since_s / (1 + np.array(self._error)[at])
        return times


TICK_HZ = 100_000_000
"""Tick rate if the frame period is a whole number of such ticks. Otherwise the tick rate is `TICKS_PER_FRAME` times
the frame rate."""
TICKS_PER_FRAME = 1024
MAX_THREADS = 4
START_BITS = 48
MOST_STARTS = 0x3FFF
"""The random numbers of a frame depend on its number. So that starts differ, frames of start i = 0, 1, ... are numbered
from i 2^`START_BITS` on. i is masked with `MOST_STARTS`."""


class SimulatedSpadConfig(KindConfig):
    """Config of the simulated SPAD array. Its size is that of the world's camera."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"
    max_frame_rate: Annotated[ExactHertz, Field(gt=0)] = Fraction(100_000)
    """Highest frame rate."""
    link: Annotated[BytesPerSecond, Field(gt=0)] = 8e9
    """Bytes per second that the link to the computer carries. If full frames need more, scans use moving windows.
    The default is more than 512 x 512 pixels at 100 kHz need."""
    lost_frames: tuple[int, ...] = ()
    """Numbers of frames that get lost on the way, for testing gaps."""
    loss_probability: float = Field(default=0.0, ge=0, le=1)
    """Probability that a frame gets lost on the way."""
    duplicate_probability: float = Field(default=0.0, ge=0, le=1)
    """Probability that a frame, other than the first of a block, is replaced by a copy of the one before it."""
    clock_error: Annotated[Ppm, Field(ge=-1e-3, le=1e-3)] = 0.0
    """Relative error of the crystal, positive if it runs fast."""
    clock_wander: Annotated[Ppm, Field(ge=0, le=1e-3)] = 0.0
    """Standard deviation of the change of that error in one second; it grows with the square root of time."""
    serial: str = Field(default="SIM-0001", min_length=1)
    """Serial number. A sensor with another one needs a calibration of its own."""


class SimulatedSpad(SpadArray):
    """A SPAD array that draws frames of the simulated world."""

    def __init__(self, config: SimulatedSpadConfig, world: SimulatedWorld, seed: int) -> None:
        super().__init__("simulated SPAD")
        self._config = config
        self._world = world
        self._seed = seed
        self._random_seed = seed & 0xFFFFFFFFFFFFFFFF
        self._photons: PhotonSource | None = None
        self._window: WindowTable | None = None
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._run_id = self._starts = 0
        self._n_frames: int | None = None
        self._next_frame = 0
        self._block_seq = 0
        self._just_lost = False
        self._markers = MarkerInputs()
        rows, width = world.size
        self._info = SpadInfo(
            model="simulated",
            serial=config.serial,
            width=width,
            height=rows,
            rotation_deg=0,
            max_frame_rate_hz=config.max_frame_rate,
            burst=None,
            stream=StreamMode(config.link),
            roi_step_px=64,
            markers=True,
            trigger_modes=("free",),
            can_wait=isinstance(world.bench.clock, VirtualClock),
        )

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        ticks = TICK_HZ / request.frame_rate_hz
        tick_hz = Fraction(TICK_HZ) if ticks.denominator == 1 else request.frame_rate_hz * TICKS_PER_FRAME
        period = int(tick_hz / request.frame_rate_hz)
        exposure = min(round(request.exposure_s * tick_hz), period)
        if exposure < 1:
            raise LimitExceeded(
                f"{self.name}: exposure {request.exposure_s:g} s is under one tick of {float(1 / tick_hz):g} s"
            )
        self._block_frames = request.block_frames
        self._window = request.window
        self._timing = SpadTiming(tick_hz, period, exposure, self._layout(request.block_frames).min_stride)
        if self._photons is not None:
            self._photons.close()
        world = self._world
        self._exposure_s, self._period_s = float(exposure / tick_hz), float(period / tick_hz)
        times = FrameTimes(self._exposure_s, self._period_s)
        self._photons = world.photons(times, self._seed, min(MAX_THREADS, cores()))
        return self._timing

    def _do_start(self, n_frames: int | None) -> None:
        clock = self._world.bench.clock
        tick_hz = self._timing.tick_hz
        # Ticks are counted from the clock's 0; a run starts at the next one.
        self._t0_ticks = -(-clock.now_ns() * tick_hz.numerator // (NS_PER_S * tick_hz.denominator))
        start_s = float(self._t0_ticks / tick_hz - Fraction(self._world.bench.clock_ns(0.0), NS_PER_S))
        self._world.bench.spad_start_s = start_s
        self._n_frames = n_frames
        self._next_frame = self._block_seq = 0
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._markers = MarkerInputs()
        self._just_lost = False
        self._first_draw = (self._starts & MOST_STARTS) << START_BITS
        self._starts += 1
        self._run_id = (self._run_id + 1) & 0xFFFF
        crystal = self._config.clock_error, self._config.clock_wander
        self._ticks = TickClock(float(1 / tick_hz), start_s, *crystal, [self._random_seed, self._run_id])

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        silent_s = 0.0
        while True:
            n, lost = self._frames_ahead()
            if not lost:
                self._expose_block(ring, n, timeout_s)
                return self._next_frame != self._n_frames
            silent_s += self._pass_over(n)
            if self._next_frame == self._n_frames:
                return False
            if silent_s > timeout_s:
                raise DeviceTimeout(f"{self.name}: every frame of {silent_s:g} s got lost on the way")

    def _do_stop(self) -> None:
        pass  # a frame is made and published in one go: nothing is on its way

    def _do_close(self) -> None:
        if self._photons is not None:
            self._photons.close()

    def _layout(self, n_frames: int) -> BlockLayout:
        return BlockLayout(n_frames, self._width_px, self._info.height)

    @property
    def _width_px(self) -> int:
        """Pixels of a row as they are sent."""
        return self._info.width if self._window is None else self._window.width_px

    def _frames_ahead(self) -> tuple[int, bool]:
        """Number of the next frames that go into one block, and False. If the next frame gets lost: the number in a row
        that get lost, and True."""
        first = self._next_frame
        n = self._block_frames if self._n_frames is None else min(self._block_frames, self._n_frames - first)
        lost = dropped_frames(np.uint64(self._random_seed), first, n, self._config.loss_probability)
        lost |= np.isin(np.arange(first, first + n), self._config.lost_frames)
        change = np.flatnonzero(lost != lost[0])
        return (int(change[0]) if len(change) else n), bool(lost[0])

    def _pass_over(self, n: int) -> float:
        """Expose n frames that get lost: time passes and markers count. Returns the seconds they took."""
        start_s, state = self._frames(n)
        self._markers.record(state, start_s, self._period_s, np.zeros(n, FRAME_RECORD))
        if any(effect.reads_before for effect in self._world.flux_model.bits.values()):
            # The next frame depends on the last of these, even though nobody receives it.
            unseen = np.empty((1, self._info.height, self._layout(1).row_bytes), np.uint8)
            self._draw(state, start_s, np.zeros(n, np.int32), unseen, first=n - 1)
        self._advance(n, lost=n)
        self._just_lost = True
        return n * self._period_s

    def _expose_block(self, ring: BlockRing, n: int, timeout_s: float) -> None:
        waits = self._info.can_wait and ring.waits
        buffer = ring.claim(timeout_s if waits else 0.0)
        if buffer is None:
            if waits:
                raise DeviceTimeout(
                    f"{self.name}: no free slot in the ring within {timeout_s:g} s; readers are too slow"
                )
            self._pass_over(n)
            ring.mark_overflow(n)
            return
        layout = self._layout(n)
        records, bits = block_views(buffer, layout)
        start_s, state = self._frames(n)
        sweep = self._markers.record(state, start_s, self._period_s, records)
        x0 = windows_at(self._window, sweep, records)
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        records["x0"], records["y0"] = x0, 0
        self._draw(state, start_s, x0, bits)
        if self._config.duplicate_probability:
            self._repeat(records, bits)
        block = seal_block(buffer, self._header(sweep, n), layout, payload_crc=True)
        self._advance(n, lost=0)
        ring.publish(block)
        self._block_seq += 1
        self._just_lost = False

    def _repeat(self, records: NDArray[np.void], bits: NDArray[np.uint8]) -> None:
        """Replace each frame of a block, with probability `duplicate_probability`, by the one before it. The first is
        never replaced, since the frame before it is not in this buffer."""
        chance = self._config.duplicate_probability
        twice = dropped_frames(np.uint64(self._random_seed) ^ _TWICE, self._next_frame, len(records), chance)
        for i in np.flatnonzero(twice[1:]) + 1:
            records[i], bits[i] = records[i - 1], bits[i - 1]

    def _draw(
        self, state: BenchState, start_s: Array, x0: NDArray[np.int32], bits: NDArray[np.uint8], first: int = 0
    ) -> None:
        """Draw the frames that `state` describes into `bits`, but leave out the first `first` of these frames."""
        assert self._photons is not None, "configured before started"
        held, power_w = self._world.mirror_positions(state, self._period_s), state.power_w * state.share
        number = self._first_draw + self._next_frame + first
        self._photons.expose(number, held[first:], power_w[first:], x0[first:], bits, start_s[first:])

    def _advance(self, n: int, *, lost: int) -> None:
        """Count n frames as exposed, `lost` of them as lost, and let their time pass."""
        self._next_frame += n
        old = self._counters
        exposed, all_lost = self._next_frame, (old.lost or 0) + lost
        self._counters = SpadCounters(exposed, exposed - all_lost, all_lost, 0, 0)
        clock, end_ns = self._world.bench.clock, self._world.bench.clock_ns(self._end_s)
        if isinstance(clock, VirtualClock):
            clock.advance_to_ns(end_ns)
        else:
            clock.sleep((end_ns - clock.now_ns()) / NS_PER_S)

    def _header(self, sweep: int, n: int) -> BlockHeader:
        timing, last = self._timing, self._next_frame + n == self._n_frames
        flags = BlockFlag(0) if self._block_seq else BlockFlag.FIRST
        flags |= (BlockFlag.LAST if last else 0) | (BlockFlag.LOST_BEFORE if self._just_lost else 0)
        return BlockHeader(
            flags=flags,
            run_id=self._run_id,
            block_seq=self._block_seq,
            first_frame=self._next_frame,
            t0_ticks=self._t0_ticks + self._next_frame * timing.frame_period_ticks,
            lost_before=self._counters.lost or 0,
            tick_hz=timing.tick_hz,
            frame_period_ticks=timing.frame_period_ticks,
            exposure_ticks=timing.exposure_ticks,
            sweep=sweep,
            frame_step=1,
            width=self._width_px,
            height=self._info.height,
            sensor_width=self._info.width,
            sensor_height=self._info.height,
        )

    def _frames(self, n: int) -> tuple[Array, BenchState]:
        """Start of each of the next n frames in seconds of the bench, and the bench's state during them."""
        period_ticks = self._timing.frame_period_ticks
        start_s = self._ticks.times_s(self._next_frame * period_ticks, period_ticks, n + 1)
        self._end_s = float(start_s[n])
        state = self._world.bench.during(start_s[:n], self._exposure_s, self._end_s - float(start_s[n - 1]))
        return start_s[:n], state


def create(config: SimulatedSpadConfig, surroundings: Surroundings) -> SimulatedSpad:
    """The SPAD in the simulated world. Raises DeviceError if the rig has no simulated world."""
    if not isinstance(surroundings.world, SimulatedWorld):
        raise DeviceError(
            "simulated SPAD has nothing to look at: the rig has no simulated world; add world: {kind: simulated}"
        )
    error, wander = 1e6 * config.clock_error, 1e6 * config.clock_wander
    named, chance, twice = len(config.lost_frames), config.loss_probability, config.duplicate_probability
    for effect, there, does in (
        ("lost frames", named or chance, f"loses {named} named frames and {chance:g} of all others"),
        ("duplicated frames", twice, f"sends {twice:g} of its frames in place of the next one, too"),
        ("clock drift", error or wander, f"has a crystal {error:g} ppm off, wandering by {wander:g} ppm/sqrt(s)"),
    ):
        if there:
            note_effect(surroundings, effect, f"the SPAD {does}")
    return SimulatedSpad(config, surroundings.world, surroundings.seed)


KIND = Kind(config=SimulatedSpadConfig, create=create)
