"""The SPAD array: takes binary frames and fills the ring with blocks of them.

It may send only a part of each row: a window that moves with the laser line. The windows are listed in a table on the
device. The device steps through the table by the scanner's markers and never by counting frames: a scan marker selects
entry 0 of the next sweep's windows, the j-th line marker after it entry j (j = 1, 2, ...). A frame has one window,
fixed at its start; a marker that arrives during a frame moves the window of the next frame.

A run in this module is one start of the SPAD, from `start` to the last frame or to `stop`.
"""

import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.frames import ROW_ALIGN_BYTES, Mark, frame_bytes
from drivers.interfaces.device import OPEN_STATES, Device, DeviceState
from drivers.interfaces.grab import Grabbed, take
from drivers.ring import BlockRing

_WORD_PX = 8 * ROW_ALIGN_BYTES
"""Windows lie on whole 64-bit words, on which the counting runs."""
_SCAN, _LINE = int(Mark.SCAN), int(Mark.LINE)
"""Plain integers: numpy takes microseconds to convert an `IntFlag`."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowTable:
    """The window of a frame as a function of the markers seen before it.

    width_px: pixels of every window. x0: the first pixel of each window, as one int32 array (entries,) for each sweep
    of the scan's period (one or two, for one or both directions). Entry 0 holds from the scan marker to the first line
    marker, entry j from line marker j on, the last entry until the next scan marker. Before the first scan marker of a
    run, entry 0 of the first sweep holds.
    """

    width_px: int
    x0: tuple[NDArray[np.int32], ...]
    _joined: NDArray[np.int32] = field(init=False, repr=False)
    _entries: NDArray[np.int64] = field(init=False, repr=False)
    _begins: NDArray[np.int64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Join the tables, so that one look-up serves a whole block."""
        object.__setattr__(self, "_joined", np.concatenate([np.zeros(0, np.int32), *self.x0]))
        object.__setattr__(self, "_entries", np.array([len(x0) for x0 in self.x0], np.int64))
        object.__setattr__(self, "_begins", np.cumsum(self._entries) - self._entries)

    def x0_of(
        self, marks: NDArray[np.integer], line: NDArray[np.integer], sweep: NDArray[np.integer]
    ) -> NDArray[np.int32]:
        """First pixel of each frame's window, int32 (n,).

        marks, line: these fields of the frames' records; `line` counts the line markers up to and including the frame's
        own. sweep: number of the sweep that each frame belongs to, from 0 on, -1 before the first scan marker.
        """
        scan = (marks & _SCAN) != 0
        own = (marks & _LINE) != 0
        begun = sweep.astype(np.int64) - scan  # the sweep that ran when the frame began
        which = np.maximum(begun, 0) % len(self.x0)
        last = self._entries[which] - 1
        entry = np.where(scan, last, np.minimum(line.astype(np.int64) - own, last))
        entry = np.where(begun < 0, 0, np.maximum(entry, 0))
        x0: NDArray[np.int32] = self._joined[self._begins[which] + entry]
        return x0

    def check(self, sensor_width: int, step_px: int) -> None:
        """Raise `LimitExceeded` for an empty table and for a window that the sensor cannot send: its start or width is
        no multiple of `step_px` and of 64 pixels, or it reaches beyond the row.

        A row is padded with 0 bits to whole 64-bit words, so its last window may reach beyond the sensor's last pixel.
        """
        grid = math.lcm(step_px, _WORD_PX)
        row = -(-sensor_width // _WORD_PX) * _WORD_PX
        if self.width_px < 1 or self.width_px % grid:
            raise LimitExceeded(f"windows of {self.width_px} pixels; widths must be multiples of {grid} pixels")
        if not self.x0 or any(len(x0) == 0 for x0 in self.x0):
            raise LimitExceeded("a table without windows; give every sweep of the period at least one entry")
        starts = np.concatenate(self.x0)
        off = starts[starts % grid != 0]
        if off.size:
            raise LimitExceeded(f"a window from pixel {off[0]} on; windows must start at multiples of {grid} pixels")
        beyond = starts[(starts < 0) | (starts + self.width_px > row)]
        if beyond.size:
            raise LimitExceeded(
                f"a window of {self.width_px} pixels from pixel {beyond[0]} on reaches beyond the sensor's rows of "
                f"{sensor_width} pixels"
            )


_log = logging.getLogger(__name__)

SpadMode = Literal["stream", "burst"]

_GRAB_BLOCK_BYTES = 4 * 2**20
"""Size of the blocks that `grab` asks for."""
_EXPOSURE_SLACK = 1e-9
"""Share by which an exposure may exceed the period: 1e-05 s as a float is a little more than 1/100000 s."""


@dataclass(frozen=True, slots=True)
class BurstMode:
    """The device stores a run in its own memory and is read out afterwards."""

    capacity_frames: int
    """Most frames of a run: what the memory holds."""
    readout_bytes_per_s: float
    """Rate at which a run is read out."""


@dataclass(frozen=True, slots=True)
class StreamMode:
    """The device sends frames while it takes them, as fast as its link carries them."""

    bytes_per_s: float


@dataclass(frozen=True, slots=True)
class SpadInfo:
    """Properties and abilities of a SPAD array. They do not change while it is open."""

    model: str
    serial: str
    """Serial number; empty if the sensor has none."""
    width: int
    """Pixels per row of the frames delivered, which are turned upright."""
    height: int
    rotation_deg: int
    """Degrees counter-clockwise by which the driver has turned the sensor's frames before it delivers them."""
    max_frame_rate_hz: Fraction
    burst: BurstMode | None
    """None: the sensor cannot store a run."""
    stream: StreamMode | None
    """None: the sensor cannot stream."""
    roi_step_px: int
    """Windows start and end at multiples of this."""
    markers: bool
    """Whether frame records carry the markers of scanner and gate."""
    trigger_modes: tuple[str, ...]
    """Ways to start an exposure: "free" (at the device's own rate), "external" (a pulse on the trigger input)."""
    can_wait: bool = False
    """Whether the SPAD can pause while the ring is full, as a simulation or a stored burst can. A sensor that streams
    cannot."""


@dataclass(frozen=True, slots=True)
class SpadRequest:
    """The frames that a SPAD array is asked for."""

    frame_rate_hz: Fraction
    exposure_s: float
    """At most one frame period."""
    mode: SpadMode
    block_frames: int
    """Frames wanted per block; a device may send shorter blocks, never longer ones."""
    window: WindowTable | None = None
    """Windows that move with the line; None: full frames. In a stream only."""


@dataclass(frozen=True, slots=True)
class SpadTiming:
    """The exact timing that a SPAD array was configured to."""

    tick_hz: Fraction
    """Rate of the tick counter that time-stamps the frames."""
    frame_period_ticks: int
    """From the start of an exposure to that of the next."""
    exposure_ticks: int
    stride: int
    """Bytes of a ring slot that holds one block."""


@dataclass(frozen=True, slots=True)
class SpadCounters:
    """Counts since `start`. None means that the device does not report the value."""

    exposed: int | None
    delivered: int
    """Frames published in the ring."""
    lost: int | None
    """Once the run has ended, exposed = delivered + lost. While it runs, frames on their way count only as exposed."""
    crc_errors: int | None
    """Blocks refused: damaged, out of order or of another geometry."""
    resyncs: int | None
    """Number of times that the beginning of blocks had to be found anew after damage."""


@dataclass(frozen=True, slots=True)
class SpadHealth:
    """The sensor's own measurements of itself. A value that it does not measure is None or missing."""

    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    """Temperatures by the place where each is measured."""
    excess_bias_v: float | None = None
    """Excess bias of the diodes. Bright light ages the chip if the excess bias is high."""
    frame_clock_hz: float | None = None
    """Measured rate of the clock that starts the frames."""
    memory_high_water_bytes: int | None = None
    """Largest amount of data that waited in the sensor's memory in the last run."""


class SpadArray(Device):
    """A binary SPAD sensor. Use: `configure`, `start`, then `fill` until it returns False, or `stop`; then `start`
    again.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._mode: SpadMode | None = None
        self._run_opened = False
        self.on_wait: Callable[[float], None] | None = None
        """Function that `fill` calls, unless None, while no frames come. Its argument is the number of seconds for
        which the device has been asked for frames since it last gave some. A driver that cannot tell never calls it."""

    @property
    @abstractmethod
    def info(self) -> SpadInfo:
        """Geometry and abilities of the sensor."""

    @property
    def identity(self) -> str:
        """The device's name, model and serial number."""
        return " ".join(part for part in (f"{self._name}:", self.info.model, self.info.serial) if part)

    @property
    def serial(self) -> str | None:
        """The serial number that `info` gives; None if it is empty."""
        return self.info.serial or None

    @property
    def counters(self) -> SpadCounters:
        """Counts of the present run or of the last one. May be called from any thread, and after `close`."""
        return self._do_counters()

    @property
    def health(self) -> SpadHealth:
        """The sensor's measurements of itself, asked anew each time. Raises `WrongState` after `close`, and during a
        run, when its connection may be busy."""
        self._require("health", DeviceState.READY, DeviceState.CONFIGURED, first="stop")
        return self._do_health()

    def configure(self, request: SpadRequest) -> SpadTiming:
        """Set timing, mode and windows; returns the exact timing. Raises `LimitExceeded` if the device cannot do it."""
        self._require("configure", DeviceState.READY, DeviceState.CONFIGURED, first="stop")
        self._check(request)
        timing = self._do_configure(request)
        self._mode = request.mode
        self._run_opened = False
        self._state = DeviceState.CONFIGURED
        _log.info("%s: configured for %g Hz, %s", self._name, float(request.frame_rate_hz), request.mode)
        return timing

    def start(self, n_frames: int | None) -> None:
        """Expose `n_frames` frames, or, if that is None, until `stop`; frame numbers and counters start at 0. Raises
        `LimitExceeded` below 1 frame, or for a burst that the device cannot store.
        """
        first = "configure" if self._state is DeviceState.READY else "stop"
        self._require("start", DeviceState.CONFIGURED, first=first)
        if n_frames is not None and n_frames < 1:
            raise LimitExceeded(f"{self._name}: start of {n_frames} frames; ask for at least 1, or None for no end")
        burst = self.info.burst if self._mode == "burst" else None
        if burst is not None and (n_frames is None or n_frames > burst.capacity_frames):
            raise LimitExceeded(
                f"{self._name}: a burst of {'endless' if n_frames is None else n_frames} frames exceeds the memory of "
                f"{burst.capacity_frames} frames; split the run or lower exposures"
            )
        _log.info("%s: start, %s frames", self._name, "endless" if n_frames is None else n_frames)
        self._do_start(n_frames)
        self._run_opened = True
        self._state = DeviceState.RUNNING

    def fill(self, ring: BlockRing, timeout_s: float) -> bool:
        """Claim, fill and publish a block or more. Returns True while more may come, False once the run has ended.

        Called on the application's source thread; waits at most `timeout_s` for frames, then raises `DeviceTimeout`. If
        the ring is full and `ring.waits` is true, a source that can wait waits for room, with the same time limit. Any
        other source drops the block at once, counts its frames as lost and calls `ring.mark_overflow` with their
        number. That call may raise an error, which ends the run. Calls after the end return False. If another thread
        calls `stop` meanwhile, the call returns False early.
        """
        ended = (DeviceState.CONFIGURED,) if self._run_opened else ()
        self._require("fill", DeviceState.RUNNING, *ended, first="start")
        if self._state is not DeviceState.RUNNING:
            return False
        more = self._do_fill(ring, timeout_s)
        if not more and self._state is DeviceState.RUNNING:
            self._state = DeviceState.CONFIGURED
        return more and self._state is DeviceState.RUNNING

    def stop(self) -> None:
        """End the run. Frames exposed but not published are dropped and count as lost. Does nothing without a run.
        Allowed until `close` and from any thread."""
        self._require("stop", *OPEN_STATES)
        if self._state is DeviceState.RUNNING:
            _log.info("%s: stop", self._name)
            self._state = DeviceState.CONFIGURED
            self._do_stop()

    def grab(
        self,
        n_frames: int,
        *,
        frame_rate_hz: float | Fraction | None = None,
        exposure_s: float | None = None,
        mode: SpadMode | None = None,
        timeout_s: float = 5.0,
    ) -> Grabbed:
        """Take `n_frames` whole frames and return them in memory, with the numbers of those that were lost.

        frame_rate_hz: None means the highest that sensor and exposure allow, and in a stream also the link. exposure_s:
        None means the longest that fits into a frame period. mode: None means a stream if the link carries that rate or
        the sensor knows no burst, else a burst. For a recording, None means as it was taken. timeout_s: longest wait
        for frames. Raises `LimitExceeded` for what the device cannot do. If the run fails, frames that have come are
        returned, with the error in `Grabbed.ended_by`; if none have, the error is raised, `DeviceTimeout` for example.
        """
        request = self._grab_request(n_frames, frame_rate_hz, exposure_s, mode)
        return take(self, self.configure(request), n_frames, timeout_s)

    def _grab_request(
        self, n_frames: int, frame_rate_hz: float | Fraction | None, exposure_s: float | None, mode: SpadMode | None
    ) -> SpadRequest:
        """The request for a `grab` with these arguments."""
        info = self.info
        rate = info.max_frame_rate_hz if frame_rate_hz is None else Fraction(frame_rate_hz)
        if frame_rate_hz is None and exposure_s is not None and exposure_s > 0:
            rate = min(rate, 1 / Fraction(exposure_s).limit_denominator(10**9))
        size = frame_bytes(info.width, info.height)
        carried_hz = 0.0 if info.stream is None else info.stream.bytes_per_s / size
        if mode is None:
            mode = "stream" if float(rate) <= carried_hz or info.burst is None else "burst"
        if mode == "stream" and frame_rate_hz is None and carried_hz >= 1:
            rate = min(rate, Fraction(int(carried_hz)))
        block_frames = max(1, min(n_frames, _GRAB_BLOCK_BYTES // size))
        longest_s = self._longest_exposure_s(1 / rate) if rate > 0 else 0.0
        return SpadRequest(rate, longest_s if exposure_s is None else exposure_s, mode, block_frames)

    def _longest_exposure_s(self, period_s: Fraction) -> float:
        """Longest exposure of a frame of this period."""
        return float(period_s)

    def _check(self, request: SpadRequest) -> None:
        info = self.info
        if not 0 < request.frame_rate_hz <= info.max_frame_rate_hz:
            raise LimitExceeded(
                f"{self._name}: frame rate {float(request.frame_rate_hz):g} Hz is outside 0 to "
                f"{float(info.max_frame_rate_hz):g} Hz; choose another frame_rate"
            )
        period_s = float(1 / request.frame_rate_hz)
        if not 0 < request.exposure_s <= period_s * (1 + _EXPOSURE_SLACK):
            raise LimitExceeded(
                f"{self._name}: exposure {request.exposure_s:g} s is outside 0 to the frame period {period_s:g} s; "
                "shorten the exposure or lower frame_rate"
            )
        modes = [mode for mode, able in (("stream", info.stream), ("burst", info.burst)) if able is not None]
        if request.mode not in modes:
            raise LimitExceeded(f"{self._name}: mode {request.mode!r} is not available; it can {' and '.join(modes)}")
        if request.block_frames < 1:
            raise LimitExceeded(f"{self._name}: blocks of {request.block_frames} frames; ask for at least 1")
        width = info.width
        if request.window is not None:
            if request.mode != "stream":
                raise LimitExceeded(
                    f"{self._name}: windows in mode {request.mode!r}; they move in a stream only, ask for full frames"
                )
            try:
                request.window.check(info.width, info.roi_step_px)
            except LimitExceeded as error:
                raise LimitExceeded(f"{self._name}: {error}") from None
            width = request.window.width_px
        need = float(request.frame_rate_hz) * frame_bytes(width, info.height)
        if request.mode == "stream" and info.stream is not None and need > info.stream.bytes_per_s:
            raise LimitExceeded(
                f"{self._name}: {float(request.frame_rate_hz):g} frames of {width} x {info.height} pixels a second are "
                f"{need / 1e6:.1f} MB/s, the link carries {info.stream.bytes_per_s / 1e6:.1f} MB/s; lower frame_rate "
                "or ask for narrower windows"
            )

    def _make_safe(self) -> None:
        self.stop()

    def _do_health(self) -> SpadHealth:
        return SpadHealth()

    @abstractmethod
    def _do_configure(self, request: SpadRequest) -> SpadTiming: ...

    @abstractmethod
    def _do_start(self, n_frames: int | None) -> None: ...

    @abstractmethod
    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool: ...

    @abstractmethod
    def _do_stop(self) -> None: ...

    @abstractmethod
    def _do_counters(self) -> SpadCounters: ...
