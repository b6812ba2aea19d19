"""The vendor's program of a SPAD512S as seen from its TCP port (docs/reference/devices/spad512s.md), traps included.

A pure state machine: it gets commands and the time, and gives text and pixels. It takes frames of 1 bit and of the full
width only. Their content comes upright from `frames` and is turned onto its side, as the real sensor delivers it.
Public sources tell what clients send and how they read the answers, but most answers' exact words are made up here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.spads.orientation import QuarterTurn, turn_packed

FrameSource = Callable[[int, float, float, int], NDArray[np.uint8]]
"""(first frame, start of its exposure in s, period in s, n) -> upright frames, uint8 (n, height, row bytes)."""

BANNER: Final = "SPAD512S TCP server\n"
CALIBRATION_SOON: Final = "The breakdown calibration process will start soon.\n"
CALIBRATION_BEGUN: Final = "The breakdown calibration process has started.\n"
CALIBRATION_DONE: Final = "The breakdown is around 24.1 V\n"
READ_OUT_S: Final = 10.24e-6
_INFO: Final = (
    ("Master FPGA serial", "MASTER-0042"),
    ("Slave FPGA serial", "SLAVE-0043"),
    ("Software version", "2.3.1"),
    ("Firmware version", "1.4"),
    ("Hardware version", "1.1"),
    ("Hardware flavour", "{flavour}"),
    ("Intensity imaging", "{intensity}"),
    ("Gated imaging", "1"),
    ("FLIM imaging", "0"),
)
"""Lines of the answer to `D`. The vendor's client looks for a flavour after 18 characters of the sixth line."""
_EIGHT_FIELDS: Final = 8
"""Fields of `I` with its name; the ninth one is the width of the image in pixels."""
_FRAMES_AT_ONCE = 8
"""Frames made at a time."""


@dataclass(frozen=True, slots=True)
class Spad512sProgram:
    """The ways in which programs and units differ. calibration_s: duration of the calibration that the first `D`
    starts; 0: none.

    glued_done: whether text answers end with DONE, as in one emulation; the real program's behaviour is unknown.
    extra_fields: whether `R` answers eight fields instead of six. flavour: 512, or 1M for 1024 rows. intensity: whether
    `D` says that there is intensity imaging. columns: pixels of a row as the sensor delivers it; None: as many as there
    are rows. labels: whether the lines of `D` tell what they mean. fields: numbers of fields with which `I` is taken;
    newer clients of the vendor send nine. heeds_stop: whether STOP ends a run. wants_pile_up: whether each run needs
    PU,0 before it.
    """

    calibration_s: float = 0.0
    glued_done: bool = False
    extra_fields: bool = False
    flavour: str = "512"
    intensity: bool = True
    columns: int | None = None
    labels: bool = True
    fields: tuple[int, ...] = (_EIGHT_FIELDS, _EIGHT_FIELDS + 1)
    banner: str = BANNER
    heeds_stop: bool = True
    wants_pile_up: bool = False


class Spad512sModel:
    """The program and its device. rotation: the turn that makes pixels upright. paced: whether pixels come no earlier
    than the sensor exposes them. of_program: fields of `Spad512sProgram`.
    """

    def __init__(
        self, frames: FrameSource, *, rotation: QuarterTurn = 90, paced: bool = False, **of_program: Any
    ) -> None:
        self.commands: list[str] = []
        """Commands as they came, for tests to look at."""
        self.fail_at_byte: int | None = None
        """Test knob: number of bytes of pixels after which the next run ends with `fail_text`."""
        self.fail_text = b"\nAuto-protect: too much light. Acquisition ERROR"
        self._frames = frames
        self._program = program = Spad512sProgram(**of_program)
        lines = (f"{label}: {value}" if program.labels else value for label, value in _INFO)
        text = "".join(f"{line}\n" for line in lines)
        self._info = text.format(flavour=program.flavour, intensity=int(program.intensity))
        self._rows = 1024 if "1M" in program.flavour else 512
        self._columns = program.columns or self._rows
        self._excess_bias_v = 4.0
        self._rotation: QuarterTurn = rotation
        self._paced = paced
        self.restarted()
        self._calibrating_until: float | None = None
        self._pile_up_sent = False
        self._out = bytearray()
        self._run: _Run | None = None

    def connected(self, now_s: float) -> None:
        """Greet the client. No run goes on from an earlier client."""
        self._out = bytearray(self._program.banner.encode())
        self._run = None

    def disconnected(self, now_s: float) -> None:
        """End the run, if there is one."""
        self._run = None
        self._out.clear()

    def restarted(self) -> None:
        """Note that the program was started again: with a `calibration_s` above 0 the next `D` starts a calibration.

        Nothing else changes: a run, a calibration under way and the excess bias stay as they were. A run ends when the
        client is disconnected."""
        self._calibrated = self._program.calibration_s == 0

    def receive(self, data: bytes, now_s: float) -> None:
        """Take one command. Without framing, two commands that arrive together are not understood, as with the real
        program.
        """
        command = data.decode("ascii", "replace").strip()
        self.commands.append(command)
        if self._calibrating_until is not None:
            self._say("ERROR")  # whatever is sent during the calibration breaks the protocol
        elif self._run is not None:
            if command == "STOP" and self._program.heeds_stop:
                self._run.aborted = True
        else:
            self._obey(command, now_s)

    def send(self, limit: int, now_s: float) -> bytes:
        """The next bytes for the client: text first, then the pixels of the run."""
        if self._calibrating_until is not None and now_s >= self._calibrating_until:
            self._calibrating_until = None
            self._calibrated = True
            self._out += CALIBRATION_DONE.encode()
        if not self._out and self._run is not None:
            self._expose(self._run, now_s)
        piece = bytes(self._out[:limit])
        del self._out[:limit]
        return piece

    def _obey(self, command: str, now_s: float) -> None:
        name, *arguments = command.split(",")
        if name == "D" and not arguments:
            self._describe(now_s)
        elif name == "V":
            self._bias(arguments)
        elif name == "R" and not arguments:
            extra = ",1,0" if self._program.extra_fields else ""
            self._say(f"41.5,42.0,38.5,-9.5,40000000.0,97656.25{extra}")
        elif name == "PU" and arguments in (["0"], ["1"]):
            self._pile_up_sent = arguments == ["0"]
            self._say("Pile-up correction set")
        elif name == "I":
            self._acquire(arguments, now_s)
        elif name != "STOP":
            self._say(f"Unknown command {name} ERROR")

    def _describe(self, now_s: float) -> None:
        if self._calibrated:
            self._say(self._info)
            return
        self._calibrating_until = now_s + self._program.calibration_s
        self._out += (CALIBRATION_SOON + CALIBRATION_BEGUN).encode()

    def _bias(self, arguments: list[str]) -> None:
        """Answer V, or set the excess bias to the x of V,x."""
        if not arguments:
            self._say(f"23.5,{self._excess_bias_v}")
            return
        try:
            self._excess_bias_v = float(arguments[0])
        except ValueError:
            self._say("Wrong voltage ERROR")
            return
        self._say(f"Excess bias set to {self._excess_bias_v} V")

    def _acquire(self, arguments: list[str], now_s: float) -> None:
        """Begin the run of I,bits,tInt,n,trigger,overlap,sparse,stream[,width], or say what is wrong with it."""
        try:
            if 1 + len(arguments) not in self._program.fields:
                raise ValueError
            t_int = float(arguments.pop(1))
            bits, n, _, overlap, sparse, stream, *width = (int(word) for word in arguments)
        except (IndexError, ValueError):
            self._say("Wrong number of arguments ERROR")
            return
        if (bits, sparse, stream) != (1, 0, 1) or width not in ([], [self._columns]) or n < 1 or t_int < 1:
            self._say("Mode not emulated ERROR")
            return
        if self._program.wants_pile_up and not self._pile_up_sent:
            self._say("Pile-up correction not set ERROR")
            return
        self._pile_up_sent = False  # it holds for one acquisition
        exposure_s = t_int * 1e-6  # microseconds: bits is 1
        period_s = max(exposure_s, READ_OUT_S) if overlap else exposure_s + READ_OUT_S
        self._run = _Run(n, period_s, now_s)

    def _expose(self, run: "_Run", now_s: float) -> None:
        """Send the next frames if they are exposed, or the text that ends the run."""
        if run.aborted or run.next_frame == run.n_frames:
            self._out += b"ERROR" if run.aborted else b"DONE"
            self._run = None
            return
        n = min(_FRAMES_AT_ONCE, run.n_frames - run.next_frame)
        if self._paced and now_s < run.start_s + (run.next_frame + n) * run.period_s:
            return
        upright = self._frames(run.next_frame, run.start_s + run.next_frame * run.period_s, run.period_s, n)
        row_bytes = self._columns // 8
        pixels = np.empty((n, self._rows, row_bytes), np.uint8)
        turn_packed(upright, _BACK[self._rotation], pixels)
        sent = run.next_frame * self._rows * row_bytes
        run.next_frame += n
        data = pixels.tobytes()
        if self.fail_at_byte is not None and sent + len(data) > self.fail_at_byte:
            data = data[: self.fail_at_byte - sent] + self.fail_text
            self.fail_at_byte = self._run = None
        self._out += data

    def _say(self, text: str) -> None:
        done = "\nDONE" if self._program.glued_done else ""
        self._out += (text + done).encode()


_BACK: Final[dict[QuarterTurn, QuarterTurn]] = {0: 0, 90: 270, 180: 180, 270: 90}
"""For each rotation, the one that undoes it."""


@dataclass(slots=True)
class _Run:
    n_frames: int
    period_s: float
    start_s: float
    next_frame: int = 0
    aborted: bool = False
