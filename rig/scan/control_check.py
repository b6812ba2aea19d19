"""Compares what drivers sent to their devices in a replay with the recording: the commands, and when each was sent.

Commands are compared byte by byte. For buffers of points the time is compared too: how much later each was sent than in
the recording, less the median of its scan, since the host chooses when a scan begins. The host's timing also decides at
which point a scan was stopped. So two things are not compared: a last buffer that was sent only in the replay or only
in the recording, and how the mirror was parked.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.recorded.control_words import SentCommands
from drivers.transports.tap import TapRecord, read_taps

SWAP_TOLERANCE_S = 2e-3
"""Longest time by which a buffer may come earlier or later than in the recording."""
STOP_BUFFERS = 1
"""Number of buffers by which recorded and replayed scan may differ at their ends."""
_SHOWN = 24
"""Bytes of a command that are shown."""


@dataclass(frozen=True, slots=True)
class ControlCheck:
    """Result of a comparison. commands, swaps: numbers of commands, and of buffers of points, that were compared.

    worst_swap_s: the most by which one of these buffers came too early or too late; 0 if there are none. problems: one
    line each; empty if replay and recording agree.
    """

    commands: int
    swaps: int
    worst_swap_s: float
    problems: tuple[str, ...]

    def __str__(self) -> str:
        """Say in one line what was compared."""
        return (
            f"{self.commands} commands as recorded, {self.swaps} buffer swaps at most {self.worst_swap_s * 1e3:.1f} ms "
            "from their times"
        )


def check_control(recorded: Path, now: Path, *, devices: Sequence[str], tolerance_s: float | None) -> ControlCheck:
    """Compare two files of control traffic: the recorded one, and that of the replay, which counts as empty if missing.

    devices: those whose drivers took part in the replay. tolerance_s: most by which a buffer may come too early or too
    late; None allows any time. Raises ProtocolError if a file is not one of control traffic.
    """
    before, after = SentCommands.of(read_taps(recorded)), SentCommands.of(read_taps(now) if now.exists() else ())
    problems: list[str] = []
    commands = swaps = 0
    for device in devices:
        said, says = before.commands.get(device, []), after.commands.get(device, [])
        found = _first_difference(device, "command", said, says, tail=0)
        commands += min(len(said), len(says))
        problems += [found] if found else []
    worst_s = 0.0
    if "scanner" in devices:
        if len(before.scans) != len(after.scans):
            problems.append(f"scanner: {len(before.scans)} scans were recorded, {len(after.scans)} were run")
        for number, (said, says) in enumerate(zip(before.scans, after.scans, strict=False)):
            found = _first_difference("scanner", f"scan {number}, buffer", said, says, tail=STOP_BUFFERS)
            problems += [found] if found else []
            off_s = _swaps_off(said, says)
            swaps += len(off_s)
            worst_s = max([worst_s, *map(abs, off_s)])
            problems += _untimely(number, off_s, tolerance_s)
    return ControlCheck(commands, swaps, worst_s, tuple(problems))


def _first_difference(device: str, what: str, said: list[TapRecord], says: list[TapRecord], *, tail: int) -> str | None:
    """Describe the first difference: another byte, or over `tail` commands missing or added at the end; else None."""
    for number, (old, new) in enumerate(zip(said, says, strict=False)):
        if old.data != new.data:
            pairs = enumerate(zip(old.data, new.data, strict=False))
            at = next((i for i, (a, b) in pairs if a != b), min(len(old.data), len(new.data)))
            return (
                f"{device}: {what} {number}: byte {at} is {_byte(new.data, at)}, recorded was {_byte(old.data, at)} "
                f"({_shown(new.data, at)} instead of {_shown(old.data, at)})"
            )
    missing = len(said) - len(says)
    if abs(missing) <= tail:
        return None
    if missing > 0:
        return f"{device}: {what} {len(says)} is missing: {_shown(said[len(says)].data, 0)} was recorded"
    return f"{device}: {what} {len(said)} was not recorded: {_shown(says[len(said)].data, 0)}"


def _swaps_off(said: list[TapRecord], says: list[TapRecord]) -> list[float]:
    """Seconds by which each buffer came later than recorded, less the median of its scan.

    The second buffer gets 0: a device takes it as soon as the host has it, so its time depends on the host alone.
    """
    late_s = [(new.t_ns - old.t_ns) / 1e9 for old, new in zip(said, says, strict=False)]
    timed_s = late_s[:1] + late_s[2:]
    middle_s = statistics.median(timed_s) if timed_s else 0.0
    return [0.0 if i == 1 else each_s - middle_s for i, each_s in enumerate(late_s)]


def _untimely(number: int, off_s: list[float], tolerance_s: float | None) -> list[str]:
    late = [i for i, each_s in enumerate(off_s) if tolerance_s is not None and abs(each_s) > tolerance_s]
    if not late:
        return []
    return [
        f"scanner: scan {number}, buffer {late[0]} came {off_s[late[0]] * 1e3:+.1f} ms from its recorded time, "
        f"more than {(tolerance_s or 0.0) * 1e3:g} ms; {len(late)} of {len(off_s)} did; unload the host"
    ]


def _byte(data: bytes, at: int) -> str:
    return f"0x{data[at]:02x}" if at < len(data) else "none"


def _shown(data: bytes, at: int) -> str:
    begin = max(0, at - _SHOWN // 2)
    piece = data[begin : begin + _SHOWN]
    text = repr(piece.decode("ascii")) if piece.isascii() and piece.decode("ascii").isprintable() else piece.hex(" ")
    return f"{'..' if begin else ''}{text}{'..' if begin + _SHOWN < len(data) else ''}"
