"""The vendor's program of a SPAD512S as seen from its TCP port (docs/reference/hardware.md), traps included.

A pure state machine: it gets commands and the time, and gives text and pixels. It takes frames of 1 bit only. Their
content comes upright from `frames` and is turned onto its side, as the real sensor delivers it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.spads.orientation import QuarterTurn, turn_packed

FrameSource = Callable[[int, float, float, int], NDArray[np.uint8]]
"""(first frame, start of its exposure in s of the clock, period in s, n) -> upright frames, uint8 (n, height, bytes).
"""

BANNER: Final = "SPAD512S TCP server\n"
CALIBRATION_SOON: Final = "The breakdown calibration process will start soon.\n"
CALIBRATION_BEGUN: Final = "The breakdown calibration process has started.\n"
CALIBRATION_DONE: Final = "The breakdown is around 24.1 V\n"
READ_OUT_S: Final = 10.24e-6
_INFO: Final = "MASTER-0042\nSLAVE-0043\n2.3.1\n1.4\n1.1\n{flavour}\n{intensity}\n1\n0\n"
_FRAMES_AT_ONCE = 8
"""Frames made at a time."""


class Spad512sModel:
    """The program and its device. calibration_s: duration of the calibration that the first `D` starts; 0: none.

    glued_done: whether text answers end with DONE, as in one emulation; the real program's behaviour is unknown.
    extra_fields: whether `R` answers eight fields instead of six. heeds_stop: whether STOP ends a run. rotation: the
    turn that makes its pixels upright. paced: whether pixels come no earlier than the sensor exposes them.
    wants_width: whether `I` must name the image width, as in the newest sample; else it may.
    """

    def __init__(
        self,
        frames: FrameSource,
        *,
        calibration_s: float = 0.0,
        glued_done: bool = False,
        extra_fields: bool = False,
        flavour: str = "512",
        intensity: bool = True,
        heeds_stop: bool = True,
        rotation: QuarterTurn = 90,
        paced: bool = False,
        banner: str = BANNER,
        wants_width: bool = False,
    ) -> None:
        self.commands: list[str] = []
        """Commands as they came, for tests to look at."""
        self.fail_at_byte: int | None = None
        """Test knob: number of bytes of pixels after which the next run ends with `fail_text`."""
        self.fail_text = b"\nAuto-protect: too much light. Acquisition ERROR"
        self._frames = frames
        self._calibration_s = calibration_s
        self._done = "\nDONE" if glued_done else ""
        self._extra = ",1,0" if extra_fields else ""
        self._heeds_stop = heeds_stop
        self._info = _INFO.format(flavour=flavour, intensity=int(intensity))
        self._rows = 1024 if "1M" in flavour else 512
        self._rotation: QuarterTurn = rotation
        self._paced = paced
        self._banner = banner
        self._wants_width = wants_width
        self.restarted()
        self._calibrating_until: float | None = None
        self._pile_up_sent = False
        self._out = bytearray()
        self._run: _Run | None = None

    def connected(self, now_s: float) -> None:
        """Greet the client."""
        self._out = bytearray(self._banner.encode())
        self._run = None

    def disconnected(self, now_s: float) -> None:
        """End the run, if there is one."""
        self._run = None
        self._out.clear()

    def restarted(self) -> None:
        """End the program and start it again."""
        self._calibrated = self._calibration_s == 0

    def receive(self, data: bytes, now_s: float) -> None:
        """Take one command. Without framing, two commands that arrive together are not understood, as with the real
        program.
        """
        command = data.decode("ascii", "replace").strip()
        self.commands.append(command)
        if self._calibrating_until is not None:
            self._say("ERROR")  # whatever is sent during the calibration breaks the protocol
        elif self._run is not None:
            if command == "STOP" and self._heeds_stop:
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
        elif name == "V" and not arguments:
            self._say("23.5,4.0")
        elif name == "R" and not arguments:
            self._say(f"41.5,42.0,38.5,-9.5,40000000.0,97656.25{self._extra}")
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
        self._calibrating_until = now_s + self._calibration_s
        self._out += (CALIBRATION_SOON + CALIBRATION_BEGUN).encode()

    def _acquire(self, arguments: list[str], now_s: float) -> None:
        """Begin the run of I,bits,tInt,n,trigger,overlap,sparse,stream[,width], or say what is wrong with it."""
        try:
            bits, t_int, n, _, _, sparse, stream, *width = (int(word) for word in arguments)
        except ValueError:
            self._say("Wrong number of arguments ERROR")
            return
        if width != [self._rows] and (width or self._wants_width):
            self._say("Wrong number of arguments ERROR")
            return
        if (bits, sparse, stream) != (1, 0, 1) or n < 1 or t_int < 1:
            self._say("Mode not emulated ERROR")
            return
        if not self._pile_up_sent:
            self._say("Pile-up correction not set ERROR")
            return
        self._pile_up_sent = False  # it holds for one acquisition
        self._run = _Run(n, max(t_int * 1e-6, READ_OUT_S), now_s)  # microseconds: bits is 1

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
        pixels = np.empty((n, self._rows, self._rows // 8), np.uint8)
        turn_packed(upright, _BACK[self._rotation], pixels)
        sent = run.next_frame * self._rows * self._rows // 8
        run.next_frame += n
        data = pixels.tobytes()
        if self.fail_at_byte is not None and sent + len(data) > self.fail_at_byte:
            data = data[: self.fail_at_byte - sent] + self.fail_text
            self.fail_at_byte = self._run = None
        self._out += data

    def _say(self, text: str) -> None:
        self._out += (text + self._done).encode()


_BACK: Final[dict[QuarterTurn, QuarterTurn]] = {0: 0, 90: 270, 180: 180, 270: 90}
"""For each rotation, the one that undoes it."""


@dataclass(slots=True)
class _Run:
    n_frames: int
    period_s: float
    start_s: float
    next_frame: int = 0
    aborted: bool = False
