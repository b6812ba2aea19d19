"""The commands in recorded control traffic that make a device do something, without the queries between them.

Queries and the numbers with which the drivers of PrawnDO and Teensy mark their lines are left out, because how many
there are depends on the host's timing. The drivers may send a command again when a reply was lost, so immediate repeats
of a command, or of a pair of commands, on a serial line count once. This module knows the queries of all devices on
serial lines, of Helios and of LaserCube (docs/reference/hardware.md); those of other USB devices are not left out.
Traffic of devices on the network is left out."""

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import accumulate

from drivers.transports.tap import OUT, TapRecord

_SERIAL, _NETWORK = "serial", "tcp"
_LINE_END = re.compile(rb"[\r\n]")
_NUMBER = re.compile(rb"^#[0-9a-f]{8} ")
"""Number before a line for a Teensy."""
_QUESTION = re.compile(
    rb"\s*|[ -~]*\?|sts|gto|ver|brd|frq|len|#[0-9a-f]{8}|0 0|end|ndb"  # Cobolt, OBIS, PrawnDO
    rb"|(sta|status|sh|show) [ -~]*|version"  # iBeam
    rb"|id|status"  # Teensy
)
"""Queries, and the lines by which a PrawnDO leaves what another client had begun, which change nothing it plays."""
_USB_QUESTIONS = {
    "06": (0x03, 0x04, 0x05),  # Helios: status, version, name
    "01": (0x83, 0x84, 0x87, 0x88, 0x89, 0x8A, 0x8B, 0x8C),  # LaserCube: rates, range, ring, version
}
FRAME_PORTS = ("02", "03")
"""Bulk endpoints for points (Helios, LaserCube). Each transfer is a buffer of points, sent when the device has room."""
BEGIN, END = (b"run", b"swr"), (b"abt", b"abort")
"""Commands of the sync source that begin and end a scan. Point buffers sent after the end are left out: they park the
mirror from wherever it happens to be."""


@dataclass(frozen=True, slots=True)
class SentCommands:
    """The commands sent to a rig. commands: those of each device, by its slot in the rig. scans: the point buffers of
    each scan, one list for each."""

    commands: dict[str, list[TapRecord]]
    scans: list[list[TapRecord]]

    @classmethod
    def of(cls, passed: Iterable[TapRecord]) -> "SentCommands":
        """Sort recorded traffic into commands by device and point buffers by scan. passed: the pieces from the taps, in
        order of time. Without a sync source all point buffers are one scan; with one on the network there are no scans,
        since its commands are not known."""
        sent: dict[tuple[str, str], list[TapRecord]] = defaultdict(list)
        for one in passed:
            if one.direction == OUT:
                sent[one.device, one.port].append(one)
        commands: dict[str, list[TapRecord]] = {}
        buffers: list[TapRecord] = []
        for (device, port), words in sent.items():
            if port == _NETWORK:
                continue
            if port in FRAME_PORTS:
                buffers += words
            else:
                asked = _USB_QUESTIONS.get(port, ())
                said = _once(_lines(words)) if port == _SERIAL else [one for one in words if one.data[0] not in asked]
                commands.setdefault(device, []).extend(said)
        # Without the commands of the sync source nobody knows which buffers are a scan's.
        return cls(commands, [] if ("sync", _NETWORK) in sent else _scans(commands.get("sync"), buffers))


def _lines(pieces: list[TapRecord]) -> list[TapRecord]:
    """The lines that are no queries. Each has the time of the piece in which it ends."""
    stream = b"".join(piece.data for piece in pieces)
    ends = list(accumulate(len(piece.data) for piece in pieces))
    found, begin, piece = [], 0, 0
    for match in _LINE_END.finditer(stream):
        line, begin_next = _NUMBER.sub(b"", stream[begin : match.start()]), match.end()
        while ends[piece] < begin_next:
            piece += 1
        if not _QUESTION.fullmatch(line):
            found.append(replace(pieces[piece], data=line))
        begin = begin_next
    return found


def _once(words: list[TapRecord]) -> list[TapRecord]:
    """The commands without immediate repeats of one command or a pair of commands; drivers repeat when in doubt."""
    kept: list[TapRecord] = []
    for word in words:
        kept.append(word)
        said = [one.data for one in kept[-4:]]
        for length in (1, 2):
            if len(said) >= 2 * length and said[-length:] == said[-2 * length : len(said) - length]:
                del kept[-length:]
                break
    return kept


def _scans(sync: list[TapRecord] | None, buffers: list[TapRecord]) -> list[list[TapRecord]]:
    """The buffers sent during each scan that was ended; without a sync source, all buffers, if any, as one scan."""
    if not buffers:
        return []
    if sync is None:
        return [buffers]
    scans, begun = [], -1
    for word in sync:
        verb = word.data.partition(b" ")[0]
        if verb in BEGIN:
            begun = word.t_ns
        elif verb in END and begun >= 0:
            scans.append([one for one in buffers if begun <= one.t_ns < word.t_ns])
            begun = -1
    return scans
