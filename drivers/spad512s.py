"""Pi Imaging SPAD512S (SPAD512^2) through its vendor's program, which serves commands and pixels on a local TCP port.

Facts: hardware.md section 2.1 (`nirrafa/SPAD512S-remote-gui` theoretical_info/piimaging_examples and docs/,
`cwseitz/SPAD512` SPAD512/instruments/SPAD512S.py). In short:

- The vendor's program must run; one client, no framing, one command at a time, answers of no stated length.
- A connection greets with a banner whose first word is the sort of detector. The first `D` may say that a calibration
  of the breakdown voltage starts: then nothing may be sent before "The breakdown is around", and `D` is asked again.
- `PU,0` goes before every acquisition. `I,1,tInt,n,trigger,overlap,sparse,1` takes n frames of 1 bit: tInt is in
  microseconds at 1 and 4 bits, in milliseconds from 6 bits on, so this driver sends microseconds and 1 bit only.
- The answer to `I` is 32 768 bytes a frame (65 536 of a 1M sensor), most significant bit first, then `DONE`; or text
  that ends with `ERROR`. Pixels may well read `DONE` or `ERROR`: what counts is the exact length and what stands behind
  it. A block is published once so much has come behind it that no error text can be part of it.
- Frames lie on their side: the vendor's samples turn them by 90 degrees counter-clockwise (`rotation`).

The sensor takes a run into its own memory (BURST). Its frames carry neither ticks nor markers: they say nothing of the
scanner, the records' ticks are nominal. `STOP` is known from other people's code only; a run that does not end soon
after it is left by closing the connection.
"""

import logging
import threading
import time
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceFault,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.frames import BlockFlag, BlockHeader
from drivers.interfaces import BurstMode, SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming
from drivers.orientation import QuarterTurn, turn_packed, turned_size
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.tcp_stream import TcpStream
from drivers.units import BytesPerSecond, ExactHertz

_log = logging.getLogger(__name__)

COLUMNS = 512
ROW_BYTES = COLUMNS // 8
TICK_HZ = 100_000_000
"""Nominal: the vendor's stream carries no time. Where it does not divide the period, a multiple of the frame rate."""
TICKS_PER_FRAME = 1024

_DONE = b"DONE"
_ERROR = b"ERROR"
_GUARD_BYTES = 512
"""So much must come behind a block before it counts. The longest error text of the samples has 160 characters."""
_QUIET_S = 0.05
"""A text answer has no stated end: it is whole when the line was quiet for so long, or when it ends with DONE."""
_ANSWER_S = 5.0
_SLICE_S = 0.05
"""One wait inside `fill`: how late a `stop` from another thread comes at most."""
_ERROR_CHECK_S = 0.5
"""After a silence of so long within a run the last bytes are looked at: they may be an error text."""
_STOP_S = 1.0
"""A run that still sends so long after STOP is left by closing the connection."""
_US_SLACK = 1e-6
"""Microseconds by which a whole number of them may miss as a float in seconds."""
_CALIBRATION_STARTS = ("will start soon", "has started")
_CALIBRATION_ENDS = "The breakdown is around"


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
    """97.7 kHz: the read-out of a frame takes 10.24 us, under the next exposure where that is as long."""
    burst_frames: int = Field(default=10_000, ge=1)
    """Frames that one run may have: what the memory of this unit holds, see its data sheet."""
    readout: Annotated[BytesPerSecond, Field(gt=0)] = 100e6
    """Rate at which the vendor's program hands a run over; `rig doctor` measures it."""


@dataclass(frozen=True, slots=True)
class Spad512sIdentity:
    """What the device says about itself (`D`)."""

    detector: str
    master_serial: str
    slave_serial: str
    software: str
    firmware: str
    hardware: str
    flavour: str
    intensity: bool

    @property
    def rows(self) -> int:
        """1024 for the 1M flavour, else 512."""
        return 1024 if "1M" in self.flavour else 512


@dataclass(frozen=True, slots=True)
class Spad512sHealth:
    """What the device measures (`R`): temperatures of the FPGAs, the board and the chip, and the clocks it sees."""

    master_c: float
    slave_c: float
    board_c: float
    chip_c: float
    laser_clock_hz: float
    frame_clock_hz: float


class Spad512s(SpadArray):
    """A SPAD512S, connected. open_s, calibration_s: longest waits for the banner and for the calibration."""

    def __init__(
        self, config: Spad512sConfig, endpoint: Endpoint, *, open_s: float = 30.0, calibration_s: float = 90.0
    ) -> None:
        super().__init__("SPAD512S")
        self._config = config
        self._address = endpoint.address
        self._open_s = open_s
        self._calibration_s = calibration_s
        self._line: TcpStream | None = None
        self._busy = threading.Lock()
        """Held while the line is in use, so that `stop` waits for `fill`."""
        self._halt = threading.Event()
        self._counters = SpadCounters(0, 0, 0, None, None)
        self._run_id = 0
        self._run: _Run | None = None
        self._identity = self._connect()
        width, height = turned_size(COLUMNS, self._identity.rows, config.rotation)
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

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    @property
    def identity(self) -> Spad512sIdentity:
        """Serial numbers and versions."""
        return self._identity

    def health(self) -> Spad512sHealth:
        """Temperatures and clocks. `WrongState` during a run: the one line is busy."""
        with self._busy:
            if self._run is not None:
                raise WrongState(f"{self.name}: its line carries a run; ask for temperatures before or after it")
            fields = self._ask("R").removesuffix(_DONE.decode()).replace("\n", ",").split(",")
        try:
            # Six fields; newer programs and emulations send more behind them.
            return Spad512sHealth(*(float(field) for field in fields[:6]))
        except (TypeError, ValueError):
            raise ProtocolError(f"{self.name} answers R with {fields!r}, not with six numbers") from None

    def _do_counters(self) -> SpadCounters:
        return self._counters

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
        layout = BlockLayout(request.block_frames, self._info.width, self._info.height)
        self._block_frames = request.block_frames
        self._staging = np.zeros((request.block_frames, self._identity.rows, ROW_BYTES), np.uint8)
        self._timing = SpadTiming(tick_hz, period, exposure, layout.min_stride)
        return self._timing

    def _check_period(self, request: SpadRequest, exposure_us: int) -> None:
        """Running free, a frame follows the other as soon as it is exposed and the one before is read out."""
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
            if self._line is None:
                again = self._connect()
                if again.master_serial != self._identity.master_serial:
                    raise DeviceFault(
                        f"{self.name}: another device ({again.master_serial}) answers at {self._address} now, it was "
                        f"{self._identity.master_serial}; open it again"
                    )
            self._ask("PU,0")
            self._halt.clear()
            self._run_id = (self._run_id + 1) & 0xFFFF
            self._counters = SpadCounters(n_frames, 0, 0, None, None)
            self._run = _Run(n_frames)
            external = int(self._config.trigger == "external")
            # overlap 1: the next exposure runs while a frame is read out; sparse 0; stream 1 = pixels over TCP
            self._tell(f"I,1,{self._exposure_us},{n_frames},{external},1,0,1\n")

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        with self._busy:
            run = self._run
            if run is None or self._halt.is_set():
                return False
            try:
                more = self._fill(run, ring, timeout_s)
            except DeviceTimeout:
                raise
            except BaseException:
                self._drop_run()
                raise
            if not more:
                self._run = None
            return more

    def _fill(self, run: "_Run", ring: BlockRing, timeout_s: float) -> bool:
        """Receive one block and what guards it, then publish it."""
        ends_at = time.monotonic() + timeout_s
        n = min(self._block_frames, run.n_frames - run.next_frame)
        pixels = self._staging[:n].reshape(-1)
        if not self._receive(run, pixels, ends_at, timeout_s):
            return False
        last = run.next_frame + n == run.n_frames
        guard = run.guard[: len(_DONE)] if last else run.guard[: min(_GUARD_BYTES, self._bytes_left(run, n))]
        run.guard_bytes = len(guard)
        if not self._receive_guard(run, pixels, guard, ends_at, timeout_s):
            return False
        if last:
            self._check_done(pixels, guard)
        self._publish(run, ring, n, last, ends_at, timeout_s)
        run.taken_over(pixels if last else self._staging.reshape(-1), guard, last)
        return not last

    def _bytes_left(self, run: "_Run", n: int) -> int:
        """Pixel bytes behind the next n frames."""
        return (run.n_frames - run.next_frame - n) * self._identity.rows * ROW_BYTES

    def _receive(self, run: "_Run", pixels: NDArray[np.uint8], ends_at: float, timeout_s: float) -> bool:
        """Fill `pixels` from where the last call got to. False: stopped meanwhile."""
        while run.got < len(pixels):
            n = self._receive_some(run, pixels[run.got :], pixels[: run.got], ends_at, timeout_s)
            if n < 0:
                return False
            run.got += n
        return True

    def _receive_guard(
        self, run: "_Run", pixels: NDArray[np.uint8], guard: NDArray[np.uint8], ends_at: float, timeout_s: float
    ) -> bool:
        """As `_receive`, for the bytes behind the block."""
        while run.guard_got < len(guard):
            n = self._receive_some(run, guard[run.guard_got :], pixels, ends_at, timeout_s, guard[: run.guard_got])
            if n < 0:
                return False
            run.guard_got += n
        return True

    def _receive_some(
        self,
        run: "_Run",
        place: NDArray[np.uint8],
        before: NDArray[np.uint8],
        ends_at: float,
        timeout_s: float,
        behind: NDArray[np.uint8] | None = None,
    ) -> int:
        """Bytes received into `place`, -1 when stopped. before, behind: what came last, to find an error text in."""
        line = self._open_line()
        while not self._halt.is_set():
            n = line.receive_into(place.data, min(_SLICE_S, max(0.0, ends_at - time.monotonic())))
            now = time.monotonic()
            if n:
                run.heard_at = now
                return n
            if now - run.heard_at >= _ERROR_CHECK_S:
                tail = before[-_GUARD_BYTES:].tobytes() + (b"" if behind is None else behind.tobytes())
                self._refuse_error_text(tail)
            if now >= ends_at:
                raise DeviceTimeout(
                    f"{self.name} sent nothing for {timeout_s:g} s, {run.next_frame} of {run.n_frames} frames are "
                    "here; check trigger and the vendor's program"
                )
        return -1

    def _check_done(self, pixels: NDArray[np.uint8], guard: NDArray[np.uint8]) -> None:
        """DONE must stand exactly behind the last pixel, and nothing behind it."""
        behind = guard.tobytes()
        if behind == _DONE:
            return
        rest = self._open_line().drain(4 * _QUIET_S, _STOP_S)
        self._refuse_error_text(pixels[-_GUARD_BYTES:].tobytes() + behind + rest)
        raise ProtocolError(
            f"{self.name}: 0x{behind.hex()} stands behind the last pixel, not DONE; the run is not to be trusted"
        )

    def _refuse_error_text(self, tail: bytes) -> None:
        """DeviceFault with the device's own words where the last bytes are text that ends with ERROR."""
        text = tail.rstrip(b"\r\n\0 ").removesuffix(_DONE).rstrip()
        if not text.endswith(_ERROR):
            return
        start = len(text)
        while (start and 32 <= text[start - 1] < 127) or (start and text[start - 1] in b"\r\n\t"):
            start -= 1
        words = " ".join(text[start:].decode("ascii").split())
        raise DeviceFault(
            f"{self.name} ended the run: {words!r}; see the vendor's program (auto-protect?) before retrying"
        )

    def _publish(self, run: "_Run", ring: BlockRing, n: int, last: bool, ends_at: float, timeout_s: float) -> None:
        memory = self._claim(ring, ends_at, timeout_s)
        if memory is None:
            self._count(n, lost=True)
            run.just_lost = True
            run.next_frame += n
            ring.mark_overflow(n)
            return
        layout = BlockLayout(n, self._info.width, self._info.height)
        records, bits = block_views(memory, layout)
        turn_packed(self._staging[:n], self._config.rotation, bits)
        records[:] = np.zeros((), records.dtype)
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        block = seal_block(memory, self._header(run, n, last), layout, frames_lost=self._lost, payload_crc=False)
        self._count(n, lost=False)
        ring.publish(block)
        run.next_frame += n
        run.block_seq += 1
        run.just_lost = False

    def _claim(self, ring: BlockRing, ends_at: float, timeout_s: float) -> NDArray[np.uint8] | None:
        """A free slot; None where there is none and the ring does not wait."""
        while True:
            memory = ring.claim(min(_SLICE_S, max(0.0, ends_at - time.monotonic())))
            if memory is not None or not ring.waits:
                return memory
            if time.monotonic() >= ends_at or self._halt.is_set():
                raise DeviceTimeout(
                    f"{self.name}: no free slot in the ring within {timeout_s:g} s; readers are too slow"
                )

    def _count(self, n: int, *, lost: bool) -> None:
        old = self._counters
        self._counters = SpadCounters(
            old.exposed, old.delivered + (0 if lost else n), (old.lost or 0) + (n if lost else 0), None, None
        )

    @property
    def _lost(self) -> int:
        return self._counters.lost or 0

    def _header(self, run: "_Run", n: int, last: bool) -> BlockHeader:
        flags = BlockFlag.BURST
        if run.block_seq == 0:
            flags |= BlockFlag.FIRST
        if last:
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
            if run is None:
                return
            self._rest_is_lost()
            self._leave_run(run)

    def _leave_run(self, run: "_Run") -> None:
        """Ask the device to stop and take what still comes; where that is no end, close the connection."""
        if self._line is None:
            return
        try:
            # A pause first: a STOP that reached the program together with the `I` before it would be neither.
            came = self._line.drain(_QUIET_S, 2 * _QUIET_S)
            if not _ended(came):
                self._tell("STOP")
                came += self._line.drain(4 * _QUIET_S, _STOP_S)
        except DeviceDisconnected:
            came = b""
        if not _ended(came):
            _log.warning("%s: the run did not end within %g s of STOP; closing the connection", self.name, _STOP_S)
            self._hang_up()

    def _drop_run(self) -> None:
        """After an error: nothing that still comes can be told from an answer, so the connection goes with the run."""
        self._run = None
        self._rest_is_lost()
        self._hang_up()

    def _rest_is_lost(self) -> None:
        old = self._counters
        exposed = old.exposed or 0
        self._counters = SpadCounters(exposed, old.delivered, exposed - old.delivered, None, None)

    def _do_close(self) -> None:
        self._hang_up()

    def _hang_up(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _connect(self) -> Spad512sIdentity:
        """Banner, D, the calibration where one runs, D again."""
        self._line = TcpStream(self.name, self._address)
        try:
            return self._greet(self._line)
        except BaseException:
            self._hang_up()
            raise

    def _greet(self, line: TcpStream) -> Spad512sIdentity:
        try:
            banner = self._read_text(line, self._open_s)
        except DeviceDisconnected:
            raise DeviceBusy(
                f"{self.name}: {self._address} took the connection and closed it at once; it serves one client: end "
                "the other one"
            ) from None
        if not banner.split():
            raise DeviceTimeout(
                f"{self.name}: nothing greets at {self._address} within {self._open_s:g} s; is it the vendor's program?"
            )
        detector = banner.split()[0]
        if not detector.upper().startswith("SPAD"):
            raise ProtocolError(
                f"{self.name}: {self._address} greets with {banner[:60]!r}; that is no SPAD, correct 'port'"
            )
        answer = self._ask("D")
        if any(words in banner + answer for words in _CALIBRATION_STARTS):
            if _CALIBRATION_ENDS not in banner + answer:
                self._await_calibration(line)
            answer = self._ask("D")
        return self._identity_of(detector, answer)

    def _await_calibration(self, line: TcpStream) -> None:
        """Nothing may be sent before the end of it."""
        _log.info("%s: calibrates its breakdown voltage; waiting", self.name)
        ends_at = time.monotonic() + self._calibration_s
        text = ""
        while _CALIBRATION_ENDS not in text:
            left_s = ends_at - time.monotonic()
            data = line.receive(left_s) if left_s > 0 else b""
            if not data:
                raise DeviceTimeout(
                    f"{self.name}: the breakdown calibration did not end within {self._calibration_s:g} s; see the "
                    "vendor's program"
                )
            text = (text + data.decode("utf-8", "replace"))[-65_536:]
        line.drain(_QUIET_S, _ANSWER_S)

    def _identity_of(self, detector: str, answer: str) -> Spad512sIdentity:
        lines = [line.rpartition(":")[2].strip() for line in answer.splitlines() if line.strip()]
        lines = [line for line in lines if line != _DONE.decode()]
        if len(lines) < 7:
            raise ProtocolError(f"{self.name} answers D with {len(lines)} lines, not with its serials and versions")
        master, slave, software, firmware, hardware, flavour, intensity = lines[:7]
        enabled = intensity.lower() not in ("0", "no", "false", "disabled")
        identity = Spad512sIdentity(detector, master, slave, software, firmware, hardware, flavour, enabled)
        if not identity.intensity:
            raise DeviceFault(f"{self.name} {identity.master_serial}: intensity imaging is not enabled on this unit")
        return identity

    def _open_line(self) -> TcpStream:
        if self._line is None:
            raise DeviceDisconnected(f"{self.name}: the connection to {self._address} is gone; start again")
        return self._line

    def _tell(self, command: str) -> None:
        self._open_line().send(command.encode("ascii"), _ANSWER_S)

    def _ask(self, command: str) -> str:
        """Send a command and return its answer; DeviceFault where that is an ERROR."""
        line = self._open_line()
        line.drain(0.0, _ANSWER_S)  # what came unasked is no answer to this
        self._tell(command)
        answer = self._read_text(line, _ANSWER_S)
        if not answer:
            raise DeviceTimeout(f"{self.name} did not answer {command} within {_ANSWER_S:g} s")
        if answer.removesuffix(_DONE.decode()).rstrip().endswith(_ERROR.decode()):
            raise DeviceFault(f"{self.name} answers {command} with {' '.join(answer.split())!r}")
        return answer.removesuffix(_DONE.decode()).rstrip()

    def _read_text(self, line: TcpStream, deadline_s: float) -> str:
        """What comes until the line is quiet or says DONE, at most for `deadline_s`; empty where nothing came."""
        ends_at = time.monotonic() + deadline_s
        data = line.receive(deadline_s)
        while data and not data.endswith(_DONE) and time.monotonic() < ends_at:
            more = line.receive(_QUIET_S)
            if not more:
                break
            data = (data + more)[-65_536:]
        return data.decode("utf-8", "replace").strip()


def _ended(came: bytes) -> bool:
    """Whether a run has ended, by its last bytes before a silence."""
    return came.rstrip().endswith((_DONE, _ERROR))


class _Run:
    """How far a run is. The guard behind a block is the beginning of the next one."""

    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames
        self.next_frame = 0
        self.block_seq = 0
        self.just_lost = False
        self.heard_at = time.monotonic()
        self.got = 0
        """Bytes of the present block that are here."""
        self.guard: NDArray[np.uint8] = np.zeros(_GUARD_BYTES, np.uint8)
        self.guard_got = 0
        self.guard_bytes = 0

    def taken_over(self, pixels: NDArray[np.uint8], guard: NDArray[np.uint8], last: bool) -> None:
        """The block is published: what guarded it begins the next one in the staging memory."""
        self.guard_got = 0
        self.got = 0 if last else len(guard)
        if not last:
            pixels[: len(guard)] = guard


def create(config: Spad512sConfig, surroundings: Surroundings) -> Spad512s:
    """The SPAD512S at the config's port."""
    return Spad512s(config, resolve(config.port, surroundings.ports))


KIND = Kind(config=Spad512sConfig, create=create)
