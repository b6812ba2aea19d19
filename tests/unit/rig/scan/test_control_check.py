"""What drivers said is compared with the recording: the first byte that differs is shown, questions do not count."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from drivers.errors import ProtocolError
from drivers.recorded.control_words import SentCommands
from drivers.transports.tap import CONTROL_FILE, IN, OUT, Tap, TapFile, read_taps
from rig.scan.control_check import ControlCheck, check_control

MS = 1_000_000
DEVICES = ("scanner", "laser", "sync")


@dataclass
class Talk:
    """A file of control traffic, written line by line as a tap does."""

    lines: list[tuple[int, str, str, str, bytes]] = field(default_factory=list)

    def add(self, at_ms: float, device: str, port: str, data: bytes, direction: str = OUT) -> "Talk":
        self.lines.append((round(at_ms * MS), device, port, direction, data))
        return self

    def write(self, file: Path) -> Path:
        text = "".join(
            f'{{"t_ns": {t}, "device": "{d}", "port": "{p}", "dir": "{way}", "bytes": "{data.hex()}"}}\n'
            for t, d, p, way, data in self.lines
        )
        file.write_text(text)
        return file


BUFFERS = ((100, b"one"), (110, b"two"), (160, b"three"), (220, b"four"))


def scan(
    power: bytes = b"slmp 50.0000\r", buffers: Sequence[tuple[float, bytes]] = BUFFERS, tokens: int = 1, polls: int = 3
) -> Talk:
    talk = Talk()
    for number in range(polls):
        talk.add(number, "laser", "serial", b"ilk?\r").add(number + 0.5, "laser", "serial", b"OK\r\n", IN)
        talk.add(number, "sync", "serial", b"#%08x\nsts\n#%08x\n" % (tokens + number, tokens + number + 1))
        talk.add(number, "scanner", "06", b"\x03\x00").add(number, "scanner", "83", b"\x83\x01", IN)
    talk.add(10, "laser", "serial", power)
    talk.add(20, "sync", "serial", b"#%08x\nadm 0 2\n" % tokens).add(21, "sync", "serial", b"\x01\x0a#\x02\x00\x03")
    talk.add(22, "sync", "serial", b"\x00\x00\x00\x00\x00\x00\n").add(90, "sync", "serial", b"swr\n")
    for at_ms, data in buffers:
        talk.add(at_ms, "scanner", "02", data)
    talk.add(250, "sync", "serial", b"\nabt\nsts\nman 0\n").add(260, "scanner", "02", b"parked from here")
    return talk


def compare(tmp_path: Path, now: Talk, tolerance_s: float | None = 2e-3) -> ControlCheck:
    recorded = scan().write(tmp_path / "recorded.jsonl")
    return check_control(recorded, now.write(tmp_path / "now.jsonl"), devices=DEVICES, tolerance_s=tolerance_s)


def test_questions_tokens_repeats_and_parking_are_not_compared(tmp_path: Path) -> None:
    now = scan(tokens=77, polls=9)
    now.lines[-1] = (260 * MS, "scanner", "02", OUT, b"parked from there")
    now.add(270, "sync", "serial", b"abt\nman 0\n").add(280, "sync", "serial", b"abt\nman 0\n")
    found = compare(tmp_path, now)
    assert found.problems == ()
    assert found.commands > 5
    assert found.swaps == 4


def test_what_ends_another_clients_leftovers_is_not_compared(tmp_path: Path) -> None:
    """Recordings from before the driver sent it replay as they did."""
    now = scan()
    now.lines.insert(0, (0, "sync", "serial", OUT, b"\n0 0\nend\nndb\n"))
    assert compare(tmp_path, now).problems == ()


def newer(power: bytes = b"set power 20", polls: int = 3, number: int = 7) -> Talk:
    """An iBeam, a Teensy and an Ether Dream."""
    talk = Talk()
    for at in range(polls):
        talk.add(at, "laser", "serial", b"status laser\r\n").add(at, "laser", "serial", b"sh level power\r\n")
        talk.add(at, "sync", "serial", b"\n#%08x status\n" % (number + at)).add(at, "scanner", "tcp", b"?")
    talk.add(10, "laser", "serial", power + b"\r\n").add(11, "sync", "serial", b"\n#%08x new 1 50000\n" % number)
    talk.add(12, "sync", "serial", b"\n#%08x run 2000\n" % number).add(20, "laser", "serial", b"laser off\r\n")
    return talk.add(30, "sync", "serial", b"\nabort\n").add(31, "sync", "serial", b"\n#%08x abort\n" % number)


def test_devices_without_question_marks_and_on_the_network(tmp_path: Path) -> None:
    recorded = newer().write(tmp_path / "recorded.jsonl")
    for now, problem in (
        (newer(polls=9, number=1000), None),
        (newer(b"set power 30"), "laser: command 0: byte 10 is 0x33, recorded was 0x32"),
    ):
        found = check_control(recorded, now.write(tmp_path / "now.jsonl"), devices=DEVICES, tolerance_s=2e-3)
        assert found.commands == 5
        assert (problem in found.problems[0]) if problem else not found.problems


def test_points_beside_a_sync_source_on_the_network_are_not_compared(tmp_path: Path) -> None:
    recorded, now = Talk(), Talk()
    for talk, parked in ((recorded, b"from here"), (now, b"from there")):
        talk.add(1, "sync", "tcp", b"POST").add(2, "scanner", "02", b"one").add(3, "scanner", "02", parked)
    found = check_control(
        recorded.write(tmp_path / "recorded.jsonl"),
        now.write(tmp_path / "now.jsonl"),
        devices=DEVICES,
        tolerance_s=2e-3,
    )
    assert (found.problems, found.swaps) == ((), 0)


def with_program(program: bytes) -> Talk:
    now = scan()
    now.lines = [(*line[:4], program) if line[4].startswith(b"\x01\x0a") else line for line in now.lines]
    return now


@pytest.mark.parametrize(
    ("now", "problem"),
    [
        (
            scan(power=b"slmp 51.0000\r"),
            "laser: command 0: byte 6 is 0x31, recorded was 0x30 ('slmp 51.0000' instead of",
        ),
        (with_program(b"\x01\x0a#\x03\x00\x03"), "sync: command 2: byte 1 is 0x03, recorded was 0x02"),
        (scan(buffers=[(t, b.replace(b"ee", b"Ee")) for t, b in BUFFERS]), "scanner: scan 0, buffer 2: byte 3 is 0x45"),
        (scan(power=b"ilk?\r"), "laser: command 0 is missing: 'slmp 50.0000'"),
        (scan().add(300, "laser", "serial", b"l0\r"), "laser: command 1 was not recorded: 'l0'"),
        (scan(buffers=BUFFERS[:3]), None),  # the last buffer of a scan that is stopped may not have been sent
        (scan(buffers=BUFFERS[:2]), "scan 0, buffer 2 is missing"),
        (Talk([line for line in scan().lines if line[2] != "02"]), "scanner: 1 scans were recorded, 0 were run"),
    ],
)
def test_the_first_difference_is_shown(tmp_path: Path, now: Talk, problem: str | None) -> None:
    found = compare(tmp_path, now).problems
    assert (problem in found[0]) if problem else not found


def test_swaps_are_timed_from_the_scan_and_the_second_buffer_is_not(tmp_path: Path) -> None:
    moved = {b"swr\n": 490, b"\nabt\nsts\nman 0\n": 700, b"one": 500, b"two": 530, b"three": 560, b"four": 621.5}
    recorded = scan().write(tmp_path / "recorded.jsonl")
    now = Talk([(round(moved.get(data, t / MS) * MS), d, p, way, data) for t, d, p, way, data in scan().lines[:-1]])
    found = check_control(recorded, now.write(tmp_path / "now.jsonl"), devices=DEVICES, tolerance_s=2e-3)
    assert found.problems == ()
    assert found.worst_swap_s == pytest.approx(1.5e-3)
    found = check_control(recorded, tmp_path / "now.jsonl", devices=DEVICES, tolerance_s=1e-3)
    assert "scan 0, buffer 3 came +1.5 ms from its recorded time, more than 1 ms; 1 of 4 did" in found.problems[0]


def test_taps_of_several_devices_write_one_file_and_are_read_in_time(tmp_path: Path) -> None:
    file = TapFile.begin(tmp_path / CONTROL_FILE)
    laser, scanner = Tap(file, "laser"), Tap(file, "scanner")
    laser.note("serial", OUT, b"?\r")
    scanner.note("02", OUT, bytes(range(256)))
    laser.note("serial", IN, b"")
    laser.note("serial", IN, b"OK\r\n")
    laser.flush()
    scanner.flush()
    file.sync()
    with (tmp_path / CONTROL_FILE).open("a") as torn:
        torn.write('{"t_ns": 1, "dev')
    passed = read_taps(tmp_path / CONTROL_FILE)
    assert [(one.device, one.port, one.direction, one.data) for one in passed] == [
        ("laser", "serial", OUT, b"?\r"),
        ("scanner", "02", OUT, bytes(range(256))),
        ("laser", "serial", IN, b"OK\r\n"),
    ]
    assert SentCommands.of(passed).commands["laser"] == []
    (tmp_path / CONTROL_FILE).write_text("{}\n")
    with pytest.raises(ProtocolError, match="line 1"):
        read_taps(tmp_path / CONTROL_FILE)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a pipe with a name stands for a disk that does not answer")
def test_a_disk_that_hangs_holds_no_device_up_and_loses_nothing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / CONTROL_FILE)  # opening it waits for somebody who reads: nobody, until the notes have returned
    tap = Tap(TapFile.begin(tmp_path / CONTROL_FILE), "sync")
    for command in (b"abt\n", b"man 0\n"):
        tap.note("serial", OUT, command)
    tap.flush(timeout_s=0.1)
    with (tmp_path / CONTROL_FILE).open("rb", buffering=0) as pipe:
        tap.flush()
        lines = pipe.read(10_000).splitlines()
    assert [bytes.fromhex(json.loads(line)["bytes"]) for line in lines] == [b"abt\n", b"man 0\n"]
