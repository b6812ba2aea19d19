"""The connection to a SPAD512S's vendor program: text commands, their answers, and the device's identity
(docs/reference/devices/spad512s.md).

Sources there: `nirrafa/SPAD512S-remote-gui` theoretical_info/piimaging_examples and docs/, `cwseitz/SPAD512`
SPAD512/instruments/SPAD512S.py. The protocol has neither framing nor request numbers, and serves one client. Commands
go one at a time, and the length of an answer is not announced. On connection the program sends a banner whose first
word is the detector type. The first `D` may report that a calibration of the breakdown voltage starts. Then nothing may
be sent before the text "The breakdown is around" has come; after it `D` is sent again.
"""

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.errors import GONE, DeviceBusy, DeviceDisconnected, DeviceFault, DeviceTimeout, ProtocolError
from drivers.transports.endpoints import printable
from drivers.transports.tap import IN, OUT, Tap
from drivers.transports.tcp_line import TcpStream

_log = logging.getLogger(__name__)

DONE, ERROR = b"DONE", b"ERROR"
"""Words that end a run. `DONE` may also directly follow a text answer."""
QUIET_S = 0.05
"""A text answer has no stated end. It is complete after a silence of this length, or when it ends with DONE."""
_MOST_TEXT_BYTES = 65_536
_CALIBRATION_STARTS = ("will start soon", "has started")
_CALIBRATION_ENDS = "The breakdown is around"


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Longest waits in seconds."""

    open_s: float = 30.0
    """Deadline for the banner."""
    calibration_s: float = 90.0
    answer_s: float = 5.0
    stop_s: float = 1.0
    """If a run still sends this long after STOP, the connection is closed."""
    listens_s: float = 1.0
    """Time that the program may take to listen again after its only client has left."""


@dataclass(frozen=True, slots=True)
class Spad512sIdentity:
    """The device's description of itself: the banner's first word and the answer to `D`."""

    detector: str
    master_serial: str
    slave_serial: str
    software: str
    firmware: str
    hardware: str
    flavour: str

    def __str__(self) -> str:
        return (
            f"{self.detector} {self.flavour}, FPGAs {self.master_serial} and {self.slave_serial}, software "
            f"{self.software}, firmware {self.firmware}, hardware {self.hardware}"
        )

    @property
    def side(self) -> int:
        """Rows of the sensor, and columns: 1024 for the 1M flavour, else 512."""
        return 1024 if "1M" in self.flavour else 512


class Spad512sLine:
    """The connection, which is open once `connect` has returned. For use by one thread at a time."""

    def __init__(self, name: str, address: str, deadlines: Deadlines, tap: Tap | None = None) -> None:
        """tap: records commands and answers, but not pixels."""
        self.address = address
        self._tap = tap
        self._name = name
        self._deadlines = deadlines
        self._stream: TcpStream | None = None

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self._stream is not None

    def connect(self) -> Spad512sIdentity:
        """Connect, read the banner and send `D`; if a calibration runs, wait for its end and send `D` again. Raises
        what `TcpStream` raises, `DeviceBusy`, `DeviceTimeout`, `ProtocolError` or `DeviceFault`."""
        self._stream = TcpStream(self._name, self.address)
        try:
            return self._greet(self._stream)
        except BaseException:
            self.hang_up()
            raise

    def hang_up(self) -> None:
        """Close the connection; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def tell(self, command: str) -> None:
        """Send a command whose answer is pixels, or that has none. Closes the connection if the program takes
        nothing."""
        with self._given_up_on_silence():
            self._send(self._open(), command)

    def ask(self, command: str) -> str:
        """Send a command and return its answer. Raises DeviceFault for an ERROR. If no answer comes, raises
        DeviceTimeout and closes the connection."""
        answer_s = self._deadlines.answer_s
        with self._given_up_on_silence():
            stream = self._open()
            stream.drain(0.0, answer_s)  # what came before the command is no answer to it
            self._send(stream, command)
            answer = self._read_text(stream, answer_s)
            if not answer:
                raise DeviceTimeout(f"{self._name} did not answer {command} within {answer_s:g} s")
        answer = answer.removesuffix(DONE.decode()).rstrip()
        if answer.endswith(ERROR.decode()):
            raise DeviceFault(f"{self._name} answers {command} with {' '.join(answer.split())!r}")
        return answer

    @contextmanager
    def _given_up_on_silence(self) -> Iterator[None]:
        """Close a connection found gone or silent within this context: a late answer would pass for the next one."""
        try:
            yield
        except GONE:
            self.hang_up()
            raise

    def ask_numbers(self, command: str, n: int) -> list[float]:
        """The first n numbers of an answer; newer programs and emulations send more. Raises ProtocolError for fewer."""
        fields = self.ask(command).replace("\n", ",").split(",")
        try:
            numbers = [float(fields[i]) for i in range(n)]
            if all(map(math.isfinite, numbers)):
                return numbers
        except (IndexError, ValueError):
            pass
        raise ProtocolError(f"{self._name} answers {command} with {fields!r}, not with {n} numbers")

    def receive_into(self, view: memoryview, wait_s: float) -> int:
        """Receive bytes of a run; returns their number, 0 if none came. May raise `DeviceDisconnected`."""
        return self._open().receive_into(view, wait_s)

    def rest(self) -> bytes:
        """Read and drop what the program still sends of a run, until it is silent for 0.2 s, at most for
        `Deadlines.stop_s`. Returns the last 64 KiB of it, whose end says whether the run has ended. Raises
        `DeviceDisconnected` if the connection is gone."""
        return self._open().drain(4 * QUIET_S, self._deadlines.stop_s)

    def leave_run(self) -> None:
        """Ask the device to stop and read what it still sends. If the run does not end, close the connection."""
        if self._stream is None:
            return
        try:
            # A pause first: if a STOP reached the program together with the `I` before it, neither would be understood.
            came = self._stream.drain(QUIET_S, 2 * QUIET_S)
            if not _ended(came):
                self.tell("STOP")
                came += self.rest()
        except GONE:  # the program is gone, or takes nothing any more
            came = b""
        if not _ended(came):
            limit_s = self._deadlines.stop_s
            _log.warning("%s: the run did not end within %g s of STOP; closing the connection", self._name, limit_s)
            self.hang_up()

    def _open(self) -> TcpStream:
        if self._stream is None:
            raise DeviceDisconnected(f"{self._name}: the connection to {self.address} is gone; start again")
        return self._stream

    def _greet(self, stream: TcpStream) -> Spad512sIdentity:
        try:
            banner = self._read_text(stream, self._deadlines.open_s)
        except DeviceDisconnected:
            raise DeviceBusy(
                f"{self._name}: {self.address} took the connection and closed it at once; it serves one client: end "
                "the other one"
            ) from None
        if not banner.split():
            raise DeviceTimeout(
                f"{self._name}: nothing greets at {self.address} within {self._deadlines.open_s:g} s; is it the "
                "vendor's program?"
            )
        detector = printable(banner.split()[0])
        if "SPAD" not in detector.upper():
            # A newer program may greet in other words; whether it is one shows in its answer to D.
            _log.warning("%s: %s greets with %r, which names no SPAD", self._name, self.address, banner[:60])
        answer = self.ask("D")
        if any(words in banner + answer for words in _CALIBRATION_STARTS):
            if _CALIBRATION_ENDS not in banner + answer:
                self._await_calibration(stream)
            answer = self.ask("D")
        return self._identity_of(detector, answer)

    def _await_calibration(self, stream: TcpStream) -> None:
        """Wait for the end of the calibration; nothing may be sent before it."""
        _log.info("%s: calibrates its breakdown voltage; waiting", self._name)
        ends_at = time.monotonic() + self._deadlines.calibration_s
        text = ""
        while _CALIBRATION_ENDS not in text:
            left_s = ends_at - time.monotonic()
            data = stream.receive(left_s) if left_s > 0 else b""
            if not data:
                raise DeviceTimeout(
                    f"{self._name}: the breakdown calibration did not end within {self._deadlines.calibration_s:g} s; "
                    "see the vendor's program"
                )
            text = (text + data.decode("utf-8", "replace"))[-_MOST_TEXT_BYTES:]
        stream.drain(QUIET_S, self._deadlines.answer_s)

    def _identity_of(self, detector: str, answer: str) -> Spad512sIdentity:
        lines = [printable(line.rpartition(":")[2].strip()) for line in answer.splitlines() if line.strip()]
        lines = [line for line in lines if line != DONE.decode()]
        if len(lines) < 7:
            raise ProtocolError(f"{self._name} answers D with {len(lines)} lines, not with its serials and versions")
        master, slave, software, firmware, hardware, flavour, intensity = lines[:7]
        if intensity.lower() in ("0", "no", "false", "disabled"):
            raise DeviceFault(f"{self._name} {master}: intensity imaging is not enabled on this unit")
        return Spad512sIdentity(detector, master, slave, software, firmware, hardware, flavour)

    def _send(self, stream: TcpStream, command: str) -> None:
        data = command.encode("ascii")
        self._note(OUT, data)
        stream.send(data, self._deadlines.answer_s)

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note("tcp", direction, data)

    def _read_text(self, stream: TcpStream, deadline_s: float) -> str:
        """The text until a silence or DONE, at most for `deadline_s`, stripped; empty if nothing came."""
        ends_at = time.monotonic() + deadline_s
        data = stream.receive(deadline_s)
        while data and not data.endswith(DONE) and time.monotonic() < ends_at:
            more = stream.receive(QUIET_S)
            if not more:
                break
            data = (data + more)[-_MOST_TEXT_BYTES:]
        self._note(IN, data)
        return data.decode("utf-8", "replace").strip()


def _ended(came: bytes) -> bool:
    """Whether a run has ended. came: its last bytes before a silence."""
    return came.rstrip().endswith((DONE, ERROR))
