"""Pi Imaging SPAD512S (SPAD512^2) through its vendor's program, which serves commands and pixels on a local TCP port.

Facts and their sources: docs/reference/devices/spad512s.md. `spad512s_line` talks to the program. In short:

- The vendor's program must run, on this computer or behind a bridge; it serves one client.
- `PU,0` (no pile-up correction) goes before every acquisition. `I,1,tInt,n,trigger,overlap,sparse,1` takes n frames of
  1 bit. tInt, the exposure, is in microseconds at 1 and 4 bits, in milliseconds from 6 bits on.
- The newest sample of the vendor adds the image width, older ones do not (`width_in_command`).
- The answer is 32 768 bytes a frame (131 072 for a 1M sensor), most significant bit first; then `DONE`. Text that ends
  with `ERROR` may come at any point. Pixels may look like such text, so only the exact length and
  the bytes after it show the end.
- Frames lie on their side: the vendor's samples turn them by 90 degrees counter-clockwise (`rotation`).
- Frames carry neither ticks nor markers; the ticks in the records are nominal. Frames have no number or checksum
  either. Pixels handed over twice would have the right length, so a frame identical to an earlier one of the run is an
  error, unless it can be by chance: dark frames are often identical (`OWN_ONES`).
- `STOP` is known only from other people's code. If a run does not end soon after it, the connection is closed.
"""

import math
import threading
import time
import zlib
from collections.abc import Callable
from fractions import Fraction
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import DeviceFault, DeviceNotFound, DeviceTimeout, LimitExceeded, ProtocolError
from drivers.frames import BlockFlag, BlockHeader, FrameBlock
from drivers.interfaces import BurstMode, SpadArray, SpadCounters, SpadHealth, SpadInfo, SpadRequest, SpadTiming
from drivers.registry import Kind, KindConfig, Surroundings, alone, config_of
from drivers.ring import BlockRing
from drivers.spads.orientation import QuarterTurn, turn_packed, turned_size
from drivers.spads.spad512s_line import DONE, ERROR, Deadlines, Spad512sLine
from drivers.spb1 import BlockLayout, block_views, seal_block
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.tap import Tap
from drivers.units import BytesPerSecond, ExactHertz

GUARD_BYTES = 512
"""Bytes that must follow a block before it is used, so that no part of an error text is taken for pixels. The
longest error text of the samples has 160 characters."""
SLICE_S = 0.05
"""Length of one wait: a `stop` from another thread is noticed at most this late."""
_ERROR_CHECK_S = 0.5
"""Silence within a run after which the last bytes are looked at: they may be an error text."""
_UNIFORM = (0x00, 0xFF)
OWN_ONES = 100
"""A frame is repeated by the device, and not by chance, if at least so many of its ones are missing in another frame of
the run. That frame lacks a one with probability 1 - p if its pixel fires with probability p, and less if more light
fell on it. So it lacks L = sum(1 - p) ones on average, and chance repeats all of them with probability prod(p), below
exp(-L). 100 missing ones mean L > 50; a run of 10 000 frames has 5e7 pairs of frames, so chance repeats one of them in
1e-14 of such runs. Pixels that always fire count for nothing."""


class Spad512sRun:
    """Receives a run block by block. The memory that `receive` returns is valid until `go_on`."""

    def __init__(self, name: str, line: Spad512sLine, n_frames: int, block_frames: int, frame_bytes: int) -> None:
        """Allocate the memory. The caller sends the command that starts the run."""
        self.n_frames = n_frames
        self.next_frame = 0
        """First frame of the block that comes next."""
        self.block_seq = 0
        """Blocks published."""
        self.just_lost = False
        """Whether the block before was dropped."""
        self._name = name
        self._line = line
        self._block_frames, self._frame_bytes = block_frames, frame_bytes
        self._memory = np.zeros(block_frames * frame_bytes + GUARD_BYTES, np.uint8)
        self._cut = 0
        """Frames of the next block if it is cut short, since no more came in time; else 0."""
        self._got = 0
        """Bytes received so far of the present block and of the guard bytes behind it."""
        self._heard_at = time.monotonic()
        self._seen: dict[tuple[int, int], int] = {}
        """Numbers of the frames seen, by checksums of their halves; 32 bits alone are too few for 10 000 frames."""
        self._new: list[tuple[int, NDArray[np.uint8]]] = []
        """The two latest frames that repeated none, with their numbers."""

    @property
    def next_n(self) -> int:
        """Number of frames of the next block; 0 if the run is over."""
        return self._cut or min(self._block_frames, self.n_frames - self.next_frame)

    @property
    def ends(self) -> bool:
        """Whether the next block is the last one of the run."""
        return self.next_frame + self.next_n == self.n_frames

    def receive(self, ends_at: float, timeout_s: float, stopped: Callable[[], bool]) -> NDArray[np.uint8] | None:
        """Pixels of the next block, uint8 (n * frame bytes,), once `DONE` or `GUARD_BYTES` have followed; None if
        stopped.

        A call continues where the last one ended. stopped: returns True once the run is to be stopped. timeout_s: named
        in the error's message. At `ends_at` (of `time.monotonic`) the block is cut short after the frames that are
        here; raises `DeviceTimeout` if none are. Raises `DeviceFault` with the device's own words, or `ProtocolError`.
        """
        wanted = self.next_n * self._frame_bytes + (len(DONE) if self.ends else GUARD_BYTES)
        while self._got < wanted:
            if stopped():
                return None
            try:
                self._receive_some(self._memory[self._got : wanted], ends_at, timeout_s)
            except DeviceTimeout:
                self._cut = max(0, self._got - GUARD_BYTES) // self._frame_bytes
                if not self._cut:
                    raise
                break
        pixel_bytes = self.next_n * self._frame_bytes
        if self.ends:
            self._require_done(pixel_bytes)
        pixels = self._memory[:pixel_bytes]
        self._require_new(pixels.reshape(self.next_n, 2, -1))
        return pixels

    def go_on(self) -> None:
        """Drop the block that `receive` returned. The bytes that were read beyond its end begin the next one."""
        used = self.next_n * self._frame_bytes
        self._memory[: self._got - used] = self._memory[used : self._got]
        self._got -= used
        self.next_frame += self.next_n
        self._cut = 0

    def _receive_some(self, place: NDArray[np.uint8], ends_at: float, timeout_s: float) -> None:
        n = self._line.receive_into(place.data, min(SLICE_S, max(0.0, ends_at - time.monotonic())))
        now = time.monotonic()
        if n:
            self._heard_at = now
            self._got += n
            return
        if now - self._heard_at >= _ERROR_CHECK_S:
            self._refuse_error_text(b"")
            self._refuse_other_size()
        if now >= ends_at:
            raise DeviceTimeout(
                f"{self._name} sent nothing for {timeout_s:g} s, {self.next_frame} of {self.n_frames} frames are "
                "here; check trigger and the vendor's program"
            )

    def _refuse_other_size(self) -> None:
        """Raise ProtocolError if the run is over, with frames of another size."""
        pixel_bytes, odd = divmod(self.next_frame * self._frame_bytes + self._got - len(DONE), self.n_frames)
        if odd == 0 and pixel_bytes > 0 and self._memory[: self._got].tobytes().endswith(DONE):
            raise ProtocolError(
                f"{self._name} ended the run with {pixel_bytes} bytes a frame, not {self._frame_bytes}; its frames "
                "cannot be read: please report it"
            )

    def _require_done(self, pixel_bytes: int) -> None:
        """Raise DeviceFault or ProtocolError unless DONE stands directly behind the last pixel."""
        behind = self._memory[pixel_bytes : self._got].tobytes()
        if behind == DONE:
            return
        self._refuse_error_text(self._line.rest())
        raise ProtocolError(
            f"{self._name}: 0x{behind.hex()} stands behind the last pixel, not DONE; the run is not to be trusted"
        )

    def _require_new(self, frames: NDArray[np.uint8]) -> None:
        """Raise ProtocolError for a frame that came before, unless it is all dark or all bright or chance may have
        repeated it (`OWN_ONES`). frames: uint8 (n, 2, bytes of half a frame)."""
        for number, frame in enumerate(frames, self.next_frame):
            one, other = frame
            before = self._seen.setdefault((zlib.crc32(one), zlib.crc32(other)), number)
            new = [(its, seen) for its, seen in self._new if its != before]
            if before == number:
                self._new = [*new[-1:], (number, frame)]
            elif not (one[0] in _UNIFORM and (frame == one[0]).all()):
                own = frame & ~new[-1][1] if new else frame
                if np.unpackbits(own).sum() >= OWN_ONES:
                    raise ProtocolError(
                        f"{self._name}: frame {number} is the very same as frame {before}: pixels were handed over "
                        "twice, or the sensor is saturated; start again, with less light"
                    )
        self._new = [(number, frame.copy()) for number, frame in self._new]  # the block's memory is used again

    def _refuse_error_text(self, rest: bytes) -> None:
        """Raise DeviceFault with the device's own words if what came last is text that ends with ERROR."""
        tail = self._memory[max(0, self._got - 2 * GUARD_BYTES) : self._got].tobytes() + rest
        text = tail.rstrip(b"\r\n\0 ").removesuffix(DONE).rstrip()
        if not text.endswith(ERROR):
            return
        start = len(text)
        while start and (32 <= text[start - 1] < 127 or text[start - 1] in b"\r\n\t"):
            start -= 1
        words = " ".join(text[start:].decode("ascii").split())
        hint = "; if it dislikes the command, switch 'width_in_command'" if start == 0 and not self.next_frame else ""
        raise DeviceFault(
            f"{self._name} ended the run: {words!r}; see the vendor's program (auto-protect?) before retrying{hint}"
        )


TICK_HZ = 100_000_000
"""Nominal ticks per second: the stream carries no time. If the frame period is no whole number of such
ticks, it is divided into `TICKS_PER_FRAME` ticks instead."""
TICKS_PER_FRAME = 1024
_TEMPERATURES = ("master FPGA", "slave FPGA", "board", "chip")
"""Names of the temperatures that `R` reports first, in its order."""
_US_SLACK = 1e-6
"""Rounding error, in microseconds, of a whole number of microseconds that is given as a float in seconds."""


class Spad512sConfig(KindConfig):
    """Config of a SPAD512S behind its vendor's program."""

    kind: Literal["spad512s"] = "spad512s"
    port: str = "127.0.0.1:9999"
    """host:port of the vendor's program; its settings show the number (9999, in some set-ups 9998)."""
    rotation: QuarterTurn = 90
    """Degrees counter-clockwise by which frames are turned on their way in; 90 as in the vendor's samples."""
    trigger: Literal["free", "external"] = "free"
    """free: exposures follow one another; external: each starts at a pulse on the frame trigger input."""
    max_frame_rate: Annotated[ExactHertz, Field(gt=0)] = Fraction(100_000_000, 1024)
    """Highest frame rate. 97.7 kHz: the read-out of a frame takes 10.24 us, during the next exposure. For a 1M sensor
    it must be given."""
    width_in_command: bool = False
    """Whether `I` names the image width, as in the vendor's newest sample. The program says ERROR if it dislikes that.
    """
    burst_frames: int = Field(default=10_000, ge=1)
    """Frames that one run may have: what the memory of this unit holds, see its data sheet."""
    readout: Annotated[BytesPerSecond, Field(gt=0)] = 100e6
    """Rate at which the vendor's program hands a run over; `rig doctor` measures it."""


class Spad512s(SpadArray):
    """A connected SPAD512S. Raises what `Spad512sLine.connect` raises, and `DeviceFault` for a 1M sensor without
    `max_frame_rate`."""

    def __init__(
        self, config: Spad512sConfig, endpoint: Endpoint, deadlines: Deadlines | None = None, tap: Tap | None = None
    ) -> None:
        super().__init__("SPAD512S")
        self._config = config
        self._deadlines = deadlines or Deadlines()
        self._line = Spad512sLine(self.name, endpoint.address, self._deadlines, tap)
        self._busy = threading.Lock()
        """Held while the line is in use, so that `stop` waits for `fill`."""
        self._halt = threading.Event()
        self._exposed = self._delivered = self._lost = 0
        self._run_id = 0
        self._run: Spad512sRun | None = None
        self._identity = self._line.connect()
        side = self._identity.side
        if side != 512 and "max_frame_rate" not in config.model_fields_set:
            self._line.hang_up()
            raise DeviceFault(
                f"{self.name}: {float(config.max_frame_rate) / 1e3:.1f} kHz is the frame rate of the 512 x 512 sensor, "
                f"and frames of this one ({self._identity.flavour}) carry no time; set 'max_frame_rate' from its data "
                "sheet"
            )
        width, height = turned_size(side, side, config.rotation)
        self._info = SpadInfo(
            model=f"{self._identity.detector} {self._identity.flavour}".strip(),
            serial=self._identity.master_serial,
            width=width,
            height=height,
            rotation_deg=config.rotation,
            max_frame_rate_hz=config.max_frame_rate,
            burst=BurstMode(config.burst_frames, config.readout),
            stream=None,
            roi_step_px=64,
            markers=False,
            trigger_modes=(config.trigger,),
            can_wait=True,  # a run lies in the device's memory and is handed over as fast as it is taken
        )

    def _longest_exposure_s(self, period_s: Fraction) -> float:
        return math.floor(period_s * 1_000_000) / 1e6

    @classmethod
    def open(
        cls, port: str = "127.0.0.1:9999", *, max_frame_rate_hz: float | Fraction | None = None,
        surroundings: Surroundings | None = None, **settings: Any,
    ) -> "Spad512s":  # fmt: skip
        """Connect to a SPAD512S by itself, without a config file.

        port, settings (rotation, trigger, burst_frames, width_in_command): as in `Spad512sConfig`. max_frame_rate_hz:
        None means that of the 512 x 512 sensor. surroundings: clock, tap and emulated ports; None: the system's clock
        and real ports only. Raises `LimitExceeded` for a setting that is not possible, and another `DeviceError` if the
        device cannot be reached.
        """
        config = config_of(Spad512sConfig, port=port, max_frame_rate_hz=max_frame_rate_hz, **settings)
        return create(config, surroundings or alone())

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    @property
    def identity(self) -> str:
        """The device's name, flavour, serial numbers and versions."""
        return f"{self.name}: {self._identity}"

    def _do_health(self) -> SpadHealth:
        """Temperatures and clocks by `R` (four temperatures, the laser's clock and the frames'), biases by `V`."""
        with self._busy:
            self._connect_where_lost()
            *celsius, _, frame_clock_hz = self._line.ask_numbers("R", 6)
            _, excess_v = self._line.ask_numbers("V", 2)
        temperatures = dict(zip(_TEMPERATURES, celsius, strict=True))
        return SpadHealth(temperatures, excess_bias_v=excess_v, frame_clock_hz=frame_clock_hz)

    def _do_counters(self) -> SpadCounters:
        return SpadCounters(self._exposed, self._delivered, self._lost, None, None)

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        exposure_us = round(request.exposure_s * 1e6)
        if exposure_us < 1 or abs(request.exposure_s * 1e6 - exposure_us) > _US_SLACK:
            raise LimitExceeded(
                f"{self.name}: exposure {request.exposure_s * 1e6:g} us; it takes whole microseconds from 1 us on"
            )
        self._check_period(request, exposure_us)
        ticks = TICK_HZ / request.frame_rate_hz
        tick_hz = Fraction(TICK_HZ) if ticks.denominator == 1 else request.frame_rate_hz * TICKS_PER_FRAME
        period = int(tick_hz / request.frame_rate_hz)
        exposure = min(round(exposure_us * tick_hz / 1_000_000), period)
        self._exposure_us = exposure_us
        self._block_frames = request.block_frames
        stride = BlockLayout(request.block_frames, self._info.width, self._info.height).min_stride
        self._timing = SpadTiming(tick_hz, period, exposure, stride)
        return self._timing

    def _check_period(self, request: SpadRequest, exposure_us: int) -> None:
        """Raise `LimitExceeded` for a frame rate that the device does not run at by itself. Running free, its period is
        the longer of exposure and read-out. With an external trigger nothing is checked."""
        if self._config.trigger == "external":
            return
        period_s = max(Fraction(exposure_us, 1_000_000), 1 / self._info.max_frame_rate_hz)
        if request.frame_rate_hz * period_s != 1:
            raise LimitExceeded(
                f"{self.name}: {float(request.frame_rate_hz):g} Hz with exposures of {exposure_us} us; running free "
                f"that is {float(1 / period_s):g} Hz: set frame_rate or exposure to match, or use trigger: external"
            )

    def _do_start(self, n_frames: int | None) -> None:
        assert n_frames is not None, "a burst has an end"
        with self._busy:
            self._connect_where_lost()
            self._line.ask("PU,0")
            self._halt.clear()
            self._run_id = (self._run_id + 1) & 0xFFFF
            self._exposed, self._delivered, self._lost = n_frames, 0, 0
            side = self._identity.side
            frame_bytes = side * side // 8
            self._run = Spad512sRun(self.name, self._line, n_frames, self._block_frames, frame_bytes)
            external = int(self._config.trigger == "external")
            # overlap 1: the next exposure runs while a frame is read out; sparse 0; stream 1 = pixels over TCP
            width = f",{side}" if self._config.width_in_command else ""
            self._line.tell(f"I,1,{self._exposure_us},{n_frames},{external},1,0,1{width}\n")

    def _connect_where_lost(self) -> None:
        """Connect again if the connection is gone. The program may need a moment before it listens again.

        Raises DeviceFault if another device answers now, and what `Spad512sLine.connect` raises.
        """
        ends_at = time.monotonic() + self._deadlines.listens_s
        while not self._line.is_open:
            try:
                again, before = self._line.connect().master_serial, self._identity.master_serial
            except DeviceNotFound:
                if time.monotonic() >= ends_at:
                    raise
                time.sleep(0.02)
                continue
            if again != before:
                self._line.hang_up()
                raise DeviceFault(
                    f"{self.name}: another device ({again}) answers at {self._line.address} now, it was {before}; "
                    "open it again"
                )

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        with self._busy:
            run = self._run
            if run is None or self._halt.is_set():
                return False
            try:
                self._fill(run, ring, timeout_s)
            except DeviceTimeout:
                if not self._halt.is_set():  # else it gave up for that reason
                    raise
            except BaseException:
                # What still arrives cannot be distinguished from an answer, so the connection is closed as well.
                self._run = None
                self._lost = self._exposed - self._delivered
                self._line.hang_up()
                raise
            return run.next_n > 0

    def _fill(self, run: Spad512sRun, ring: BlockRing, timeout_s: float) -> None:
        """Receive one block, unless stopped, and publish it, or drop it if the ring is full and does not wait."""
        ends_at = time.monotonic() + timeout_s
        pixels = run.receive(ends_at, timeout_s, self._halt.is_set)
        if pixels is None:
            return
        memory = self._claim(ring, ends_at, timeout_s)
        if memory is None:
            self._lost += run.next_n
            ring.mark_overflow(run.next_n)
        else:
            block = self._written(run, memory, pixels)
            self._delivered += run.next_n
            ring.publish(block)
            run.block_seq += 1
        run.just_lost = memory is None
        run.go_on()

    def _written(self, run: Spad512sRun, memory: NDArray[np.uint8], pixels: NDArray[np.uint8]) -> FrameBlock:
        n = run.next_n
        layout = BlockLayout(n, self._info.width, self._info.height)
        records, bits = block_views(memory, layout)
        turn_packed(pixels.reshape(n, self._identity.side, -1), self._config.rotation, bits)
        records[:] = np.zeros((), records.dtype)
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        return seal_block(memory, self._header(run), layout, payload_crc=False)

    def _claim(self, ring: BlockRing, ends_at: float, timeout_s: float) -> NDArray[np.uint8] | None:
        """A free slot; None if the ring has none and does not wait. Raises `DeviceTimeout` after `timeout_s` or a
        stop."""
        while True:
            memory = ring.claim(min(SLICE_S, max(0.0, ends_at - time.monotonic())))
            if memory is not None or not ring.waits:
                return memory
            if time.monotonic() >= ends_at or self._halt.is_set():
                raise DeviceTimeout(
                    f"{self.name}: no free slot in the ring within {timeout_s:g} s; readers are too slow"
                )

    def _header(self, run: Spad512sRun) -> BlockHeader:
        flags = BlockFlag.BURST
        if run.block_seq == 0:
            flags |= BlockFlag.FIRST
        if run.ends:
            flags |= BlockFlag.LAST
        if run.just_lost:
            flags |= BlockFlag.LOST_BEFORE
        timing = self._timing
        return BlockHeader(
            flags=flags,
            run_id=self._run_id,
            block_seq=run.block_seq,
            first_frame=run.next_frame,
            t0_ticks=run.next_frame * timing.frame_period_ticks,
            lost_before=self._lost,
            tick_hz=timing.tick_hz,
            frame_period_ticks=timing.frame_period_ticks,
            exposure_ticks=timing.exposure_ticks,
            sweep=0,
            frame_step=1,
            width=self._info.width,
            height=self._info.height,
            sensor_width=self._info.width,
            sensor_height=self._info.height,
        )

    def _do_stop(self) -> None:
        self._halt.set()
        with self._busy:
            run, self._run = self._run, None
            if run is not None:
                self._lost = self._exposed - self._delivered
                self._line.leave_run()

    def _do_close(self) -> None:
        self._line.hang_up()


def create(config: Spad512sConfig, surroundings: Surroundings) -> Spad512s:
    """Open the SPAD512S at the config's port."""
    return Spad512s(config, resolve(config.port, surroundings.ports), tap=surroundings.tap)


KIND = Kind(config=Spad512sConfig, create=create)
