"""The simulated SPAD array: asks the bench what happened during its frames and draws them, block by block.

On a `VirtualClock` time passes as frames are made; on any other clock a block comes when its last frame has been
exposed. Its tick counter runs on a crystal of its own (`clock_error`, `clock_wander`)."""

import os
from fractions import Fraction
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.clock import NS_PER_S, VirtualClock
from drivers.errors import DeviceTimeout, LimitExceeded
from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader
from drivers.interfaces import SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming, StreamMode, WindowTable
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from drivers.units import BytesPerSecond, ExactHertz, Ppm
from sim_backend.bench import Happening
from sim_backend.devices.frame_link import FrameLink
from sim_backend.devices.markers import MarkerInputs, windows_at
from sim_backend.devices.place import note_effect, world_of
from sim_backend.devices.tick_clock import TickClock
from sim_backend.effects.setting import FrameTimes
from sim_backend.photons import PhotonSource
from sim_backend.world import SimulatedWorld

TICK_HZ = 100_000_000
"""Tick rate where it divides the frame period; else a multiple of the frame rate near it, so that nothing is rounded.
"""
TICKS_PER_FRAME = 1024
LINK_BYTES_PER_S = 8e9
"""More than any frame rate needs: unless the config names a `link`, it is no bottleneck."""
MAX_THREADS = 4
START_BITS = 48
MOST_STARTS = 0x3FFF
"""Photons are drawn by the number of a frame: those of the second start are numbered from 2^48 on, and so on."""


class SimulatedSpadConfig(KindConfig):
    """Config of the simulated SPAD array. Its size is that of the world's camera."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"
    max_frame_rate: Annotated[ExactHertz, Field(gt=0)] = Fraction(100_000)
    link: Annotated[BytesPerSecond, Field(gt=0)] = LINK_BYTES_PER_S
    """What the link to the computer carries; where full frames are too much for it, windows are sent."""
    lost_frames: tuple[int, ...] = ()
    """Numbers of frames that get lost on the way, to try gaps with."""
    loss_probability: float = Field(default=0.0, ge=0, le=1)
    """Chance of every frame to get lost on the way."""
    duplicate_probability: float = Field(default=0.0, ge=0, le=1)
    """Chance of every frame to be replaced by the one before it in its block, which so comes twice."""
    clock_error: Annotated[Ppm, Field(ge=-1e-3, le=1e-3)] = 0.0
    """Relative error of the crystal."""
    clock_wander: Annotated[Ppm, Field(ge=0, le=1e-3)] = 0.0
    """What a second adds to that error at random, as a standard deviation; it grows with the root of time."""
    serial: str = Field(default="SIM-0001", min_length=1)
    """What it says of itself; another one is another sensor, which needs a calibration of its own."""


class SimulatedSpad(SpadArray):
    """Makes frames of the world."""

    def __init__(
        self, config: SimulatedSpadConfig, world: SimulatedWorld, seed: int, threads: int | None = None
    ) -> None:
        super().__init__("simulated SPAD")
        self._config = config
        self._world = world
        self._seed = seed
        self._threads = threads or min(MAX_THREADS, os.cpu_count() or 1)
        self._photons: PhotonSource | None = None
        self._window: WindowTable | None = None
        faults = config.lost_frames, config.loss_probability, config.duplicate_probability
        self._link = FrameLink(*faults, seed)
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
        self._photons = world.photons(times, self._seed, self._threads)
        return self._timing

    def _do_start(self, n_frames: int | None) -> None:
        clock = self._world.bench.clock
        tick_hz = self._timing.tick_hz
        # The counter runs since the bench was set up; a run starts at its next tick.
        self._t0_ticks = -(-clock.now_ns() * tick_hz.numerator // (NS_PER_S * tick_hz.denominator))
        start_s = float(self._t0_ticks / tick_hz - Fraction(self._world.bench.clock_ns(0.0), NS_PER_S))
        self._n_frames = n_frames
        self._next_frame = self._block_seq = 0
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._markers = MarkerInputs()
        self._just_lost = False
        self._first_draw = (self._starts & MOST_STARTS) << START_BITS
        self._starts += 1
        self._run_id = (self._run_id + 1) & 0xFFFF
        crystal = self._config.clock_error, self._config.clock_wander
        self._ticks = TickClock(float(1 / tick_hz), start_s, *crystal, [self._seed & 0xFFFFFFFFFFFFFFFF, self._run_id])

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
        """How many frames the next block holds, or (n, True): how many of the next frames get lost."""
        first = self._next_frame
        n = self._block_frames if self._n_frames is None else min(self._block_frames, self._n_frames - first)
        lost = self._link.loses(first, n)
        change = np.flatnonzero(lost != lost[0])
        return (int(change[0]) if len(change) else n), bool(lost[0])

    def _pass_over(self, n: int) -> float:
        """Expose n frames that get lost: time passes and markers count. Returns the seconds they took."""
        start_s, happening = self._frames(n)
        self._markers.record(happening, start_s, self._period_s, np.zeros(n, FRAME_RECORD))
        if any(effect.reads_before for effect in self._world.flux_model.bit_effects):
            # The next frame depends on the last of these, whether anybody gets to see it or not.
            unseen = np.empty((1, self._info.height, self._layout(1).row_bytes), np.uint8)
            self._draw(happening, start_s, np.zeros(n, np.int32), unseen, first=n - 1)
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
        start_s, happening = self._frames(n)
        sweep = self._markers.record(happening, start_s, self._period_s, records)
        x0 = windows_at(self._window, sweep, records)
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        records["x0"], records["y0"] = x0, 0
        self._draw(happening, start_s, x0, bits)
        self._link.repeat(self._next_frame, records, bits)
        header = self._header(sweep, n)
        block = seal_block(buffer, header, layout, frames_lost=header.lost_before, payload_crc=True)
        self._advance(n, lost=0)
        ring.publish(block)
        self._block_seq += 1
        self._just_lost = False

    def _draw(
        self,
        happening: Happening,
        start_s: NDArray[np.float64],
        x0: NDArray[np.int32],
        bits: NDArray[np.uint8],
        first: int = 0,
    ) -> None:
        """Draw the next frames, without the first few, into `bits`."""
        assert self._photons is not None, "configured before started"
        held, power_w = self._world.held(happening, self._period_s), happening.power_w * happening.share
        number = self._first_draw + self._next_frame + first
        self._photons.expose(number, held[first:], power_w[first:], x0[first:], bits, start_s[first:])

    def _advance(self, n: int, *, lost: int) -> None:
        """Let the time of n frames pass."""
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
        flags = BlockFlag(0)
        if self._block_seq == 0:
            flags |= BlockFlag.FIRST
        if self._next_frame + n == self._n_frames:
            flags |= BlockFlag.LAST
        if self._just_lost:
            flags |= BlockFlag.LOST_BEFORE
        timing = self._timing
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

    def _frames(self, n: int) -> tuple[NDArray[np.float64], Happening]:
        """Start of each of the next n frames in seconds of the bench, and what happens during them."""
        period_ticks = self._timing.frame_period_ticks
        start_s = self._ticks.times_s(self._next_frame * period_ticks, period_ticks, n + 1)
        self._end_s = float(start_s[n])
        happening = self._world.bench.during(start_s[:n], self._exposure_s, self._end_s - float(start_s[n - 1]))
        return start_s[:n], happening


def create(config: SimulatedSpadConfig, surroundings: Surroundings) -> SimulatedSpad:
    """The SPAD that looks at the world."""
    if config.lost_frames or config.loss_probability:
        why = f"the SPAD loses {len(config.lost_frames)} named frames and {config.loss_probability:g} of all others"
        note_effect(surroundings, "lost frames", why)
    if config.duplicate_probability:
        why = f"the SPAD sends {config.duplicate_probability:g} of its frames in place of the next one, too"
        note_effect(surroundings, "duplicated frames", why)
    if config.clock_error or config.clock_wander:
        error, wander = 1e6 * config.clock_error, 1e6 * config.clock_wander
        why = f"the SPAD's crystal is off by {error:g} ppm and wanders by {wander:g} ppm per root second"
        note_effect(surroundings, "clock drift", why)
    return SimulatedSpad(config, world_of(surroundings, "simulated SPAD"), surroundings.seed)


KIND = Kind(config=SimulatedSpadConfig, create=create)
