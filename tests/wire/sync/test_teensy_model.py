"""The model of the Teensy's firmware; and the firmware itself, compiled for this computer, beside the model."""

import random
import shutil
import subprocess
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from sim_backend.wire.firmware.teensy import MAX_WORDS, MOST_CHANGES, TeensyModel

HOST = Path(__file__).with_name("teensy_host")
HZ = 600_000_000
SWEEP = "add 000000000 0000186a0 a0007a120 0000003e8"
"""Wait, 1 ms dark, 5 ms of held gate, 10 us dark."""
RUN = "run 60000"
NO_PROGRAM = "error no program: new, add, end"
LATE_S = 0.4e-6
"""Time by which the firmware's edges may be late on the PC."""
SOON_S = 2.5e-6
"""A status is read a little after its line came, in which time the program may have gone on."""
Edge = tuple[float, int]


class Marker:
    """A scan marker with these edges: (time, level), ascending; low before."""

    def __init__(self, *edges: Edge) -> None:
        self.edges = edges

    def high(self, from_s: float, until_s: float) -> float | None:
        return self._first(1, from_s, until_s)

    def low(self, from_s: float, until_s: float) -> float | None:
        return self._first(0, from_s, until_s)

    def _first(self, wanted: int, from_s: float, until_s: float) -> float | None:
        level = 0
        for at_s, to in self.edges:
            if at_s <= from_s:
                level = to
            elif level != wanted and to == wanted:
                return at_s if at_s < until_s else None
        return from_s if level == wanted and from_s < until_s else None


def model_of(*edges: Edge) -> TeensyModel:
    marker = Marker(*edges)
    return TeensyModel(marker.high, marker.low)


def program(*lines: str) -> bytes:
    """The lines of a program and their end."""
    sent = "".join(f"{line}\n" for line in lines).encode()
    count = sum(len(line.split()) - 1 for line in lines[1:])
    return sent + f"end {count} {zlib.crc32(sent):08x}\n".encode()


def checked(replies: bytes) -> list[str]:
    """The replies without their checksums, which are right."""
    parts = [line.rpartition(b" *") for line in replies.splitlines()]
    assert [b"%08x" % zlib.crc32(reply) for reply, _, _ in parts] == [check for _, _, check in parts]
    return [reply.decode("latin-1") for reply, _, _ in parts]


def said(model: TeensyModel, *lines: str, at_s: float = 0.0) -> list[str]:
    return checked(model.receive("".join(f"{line}\n" for line in lines).encode(), at_s))


def started(model: TeensyModel, *lines: str, run: str = RUN) -> TeensyModel:
    answers = checked(model.receive(program(*lines) + f"{run}\n".encode(), 0.0))
    assert all(answer.startswith("ok") for answer in answers), answers
    assert answers[-1].startswith("ok state=")
    return model


def assert_changes(model: TeensyModel, *changes: Edge, until_s: float = 10.0) -> None:
    model.advance(until_s)
    found = model.changes(0.0, until_s)[1:]
    assert [level for _, level in found] == [level for _, level in changes]
    assert [at for at, _ in found] == pytest.approx([at for at, _ in changes], abs=1e-9)


# Lines

LINES = {
    "": None,
    "x": "error unknown command",
    " id": "error unknown command",
    "ID": "error unknown command",
    "id": "ok spadrig-sync 1 1234560 words=30000 tick_ns=10 shortest=500",
    "#7f status": "#7f ok state=stopped sweeps=0 word=0 pins=0 marker=0 cuts=0 why=none",
    "#a ": "#a error unknown command",
    "#a": "error unknown command",
    "# id": "error unknown command",
    "#123456789 id": "error unknown command",
    "id 1": "error usage: id",
    "#b low 1": "#b error usage: low",
    "new 0 0": "error usage: new REPEATS HOLD",
    "new 1 4294967296": "error usage: new REPEATS HOLD",
    "new 1 0 0": "error usage: new REPEATS HOLD",
    "new -1 0": "error usage: new REPEATS HOLD",
    "add": "error usage: add WORD ...",
    "add 0": NO_PROGRAM,
    "end 1 00000000": NO_PROGRAM,
    "end 0 00000000": "error usage: end COUNT CRC",
    "end 1 0000000A": "error usage: end COUNT CRC",
    RUN: NO_PROGRAM,
    "run 0": "error usage: run WATCHDOG",
    "run 60001": "error usage: run WATCHDOG",
    "run": "error usage: run WATCHDOG",
    "x" * 1023: "error unknown command",
    "#c " + "x" * 1021: "#c error line longer than 1023 bytes",
}


@pytest.mark.parametrize(("line", "answer"), LINES.items())
def test_a_line_without_a_program(line: str, answer: str | None) -> None:
    assert said(TeensyModel(), line) == ([] if answer is None else [answer])


def test_a_line_may_come_in_pieces_and_a_reply_ends_with_the_crc_32_of_zlib() -> None:
    model = TeensyModel()
    assert model.receive(b"new 1", 0.0) == b""
    assert model.receive(b" 0\r\n", 0.0) == b"ok *79dcdd47\n"


@pytest.mark.parametrize(
    ("word", "objection"),
    [
        ("00000000", "9 hex digits"),
        ("00000000A", "9 hex digits"),
        ("0000001f3", "under 500 ticks"),
        ("200000000", "waits with gate high"),
        ("800000000", "waits and held"),
    ],
)
def test_a_word_that_cannot_be_played_ends_the_load(word: str, objection: str) -> None:
    load = "new 1 0", "status", f"add 0000001f4 {word}", "add 0000001f4"
    answers = said(TeensyModel(), *load)
    assert (answers[0], *answers[2:]) == ("ok", f"error word 1: {objection}", NO_PROGRAM)


def test_a_program_that_did_not_arrive_whole_cannot_run() -> None:
    whole = program("new 3 50000", SWEEP)
    for lost in range(len(whole) - 1):
        model = TeensyModel()
        model.receive(whole[:lost] + whole[lost + 1 :], 0.0)
        assert said(model, "", RUN)[-1] == NO_PROGRAM, lost
    model = TeensyModel()
    assert checked(model.receive(whole.replace(b"a0007a120", b"a0007a130"), 0.0))[-1] == "error crc: f3a91884 came"
    assert said(model, "new 1 0", "add 0000001f4", "end 2 00000000") == ["ok", "ok 1", "error count: 1 words came"]
    line = "add" + 100 * " 0000001f4"
    assert said(model, "new 1 0", *(MAX_WORDS // 100 * [line]), "add 0000001f4")[-2:] == [
        "ok 30000",
        "error full: 30000 words",
    ]


def test_other_commands_do_not_disturb_a_load_and_a_second_end_keeps_the_program() -> None:
    model, lines = TeensyModel(), program("new 1 0", SWEEP).decode().splitlines()
    assert said(model, lines[0], "abort", "low", lines[1], "status", "id", lines[2])[-1] == "ok"
    assert said(model, lines[2], "end")[:2] == 2 * ["error complete already"]
    assert said(model, RUN)[0].startswith("ok state=waiting")


# Programs

TWO_SWEEPS = (0.01, 1), (0.0159, 0), (0.03, 1), (0.0359, 0)
CUT = (0.01, 1), (0.013, 0), (0.0145, 1), (0.03, 1)
GAPS = ((t, level) for n in range(4) for t, level in ((0.012 + n * 1e-3, 0), (0.0124 + n * 1e-3, 1)))
LIT = (0.011, 2), (0.016, 0)
QUICK = [change for n in range(3) for change in ((n * 1e-5, 1), (n * 1e-5 + 5e-6, 4))]


@pytest.mark.parametrize(
    ("marker", "lines", "changes", "cuts"),
    [
        pytest.param(TWO_SWEEPS, ("new 2 50000", SWEEP), (*LIT, (0.031, 2), (0.036, 0)), 0, id="twice, and then low"),
        pytest.param([(-1.0, 1)], ("new 3 0", "add 100000000 4000001f4"), (*QUICK[1:], (3e-5, 0)), 0, id="5 us waits"),
        pytest.param(CUT, ("new 1 0", SWEEP), ((0.011, 2), (0.013, 0)), 1, id="cut at once"),
        pytest.param(CUT, ("new 1 50000", SWEEP), ((0.011, 2), (0.0135, 0)), 1, id="cut after the hold"),
        pytest.param(((0.01, 1), *GAPS), ("new 1 50000", SWEEP), LIT, 0, id="gaps within the hold"),
        pytest.param(
            ((0.01, 1), (0.0109, 0), (0.0112, 1)),
            ("new 1 50000", SWEEP.replace("a00", "f00")),
            ((0.011, 5), (0.016, 0)),
            1,
            id="low at the beginning, the other outputs play",
        ),
    ],
)
def test_what_a_program_plays(marker: Sequence[Edge], lines: Sequence[str], changes: Sequence[Edge], cuts: int) -> None:
    model = started(model_of(*marker), *lines)
    assert_changes(model, *changes)
    assert (model.cuts, model.why) == (cuts, "end")
    assert said(model, RUN, at_s=11)[0].startswith("ok state="), "the program is still there"


def test_status_follows_the_program() -> None:
    model = started(model_of(*TWO_SWEEPS), "new 2 50000", SWEEP)
    for at_s, status in {
        0.005: "ok state=waiting sweeps=0 word=0 pins=0 marker=0 cuts=0 why=none",
        0.012: "ok state=running sweeps=1 word=2 pins=2 marker=1 cuts=0 why=none",
        10.0: "ok state=stopped sweeps=2 word=0 pins=0 marker=0 cuts=0 why=end",
    }.items():
        assert said(model, "status", at_s=at_s) == [status]
        refusal = said(model, "add 000000000", at_s=at_s)
        assert refusal == (["error busy: abort first"] if at_s < 1 else [NO_PROGRAM])


def test_the_fall_of_a_marker_that_is_not_told_or_told_late_still_cuts() -> None:
    model = started(TeensyModel(Marker((0.01, 1), (0.013, 0)).high), "new 1 0", SWEEP)
    model.advance(1.0)
    assert [level for _, level in model.changes(0.0, 1.0)[1:]] == [2, 0]
    assert model.changes(0.0, 1.0)[2][0] == pytest.approx(0.013, abs=25e-6)
    marker = Marker((0.01, 1))
    model = started(TeensyModel(marker.high, marker.low), "new 1 0", SWEEP)
    model.advance(0.014)
    assert model.outputs_at(0.014) == 2
    marker.edges = (0.01, 1), (0.013, 0)
    assert_changes(model, (0.011, 2), (0.013, 0))


def test_a_marker_that_is_high_and_low_in_one_instant_ends_all_the_same() -> None:
    odd = TeensyModel(lambda a, b: a, lambda a, b: max(a, 5e-6) if b > 5e-6 else None)
    assert_changes(started(odd, "new 1 9", "add a000003e8"), (1e-5, 0))


# Ways out


@pytest.mark.parametrize(
    ("end", "why", "at_s"),
    [
        (lambda model: said(model, "abort", at_s=0.5), "abort", 0.5),
        (lambda model: model.close_port(0.25), "port", 0.25),
        (lambda model: said(model, "nonsense", at_s=0.9), "watchdog", 0.1),
        (lambda model: (said(model, "status", at_s=0.08), said(model, "nonsense", at_s=0.17)), "watchdog", 0.18),
    ],
)
def test_what_ends_a_program(end: Callable[[TeensyModel], object], why: str, at_s: float) -> None:
    model = started(TeensyModel(), "new 1000 0", "add 7000186a0", run="run 600" if why == "abort" else "run 100")
    if why == "port":
        assert said(model, "status", at_s=0.09) + said(model, "status", at_s=0.17)
    end(model)
    assert said(model, "status", at_s=1.0)[0].endswith(f"word=0 pins=0 marker=0 cuts=0 why={why}")
    assert_changes(model, (at_s, 0))
    assert said(model, RUN, at_s=11.0)[0].startswith("error port: DTR" if why == "port" else "ok state=running")


def test_a_closed_port_forgets_the_program_and_so_does_a_power_cycle() -> None:
    for end in (TeensyModel.close_port, TeensyModel.power_cycle):
        model = started(TeensyModel(), "new 1000 0", "add 2000186a0")
        model.short(1, 0.1)
        assert "pins=3" in said(model, "status", at_s=0.1)[0]
        assert "pins=1" in said(model, "abort", at_s=0.2)[0]
        end(model, 0.4)
        model.open_port(0.5)
        assert said(model, RUN, at_s=0.5) == [NO_PROGRAM]


def test_low_holds_the_gate_until_the_next_run_while_the_program_goes_on() -> None:
    model = started(TeensyModel(), "new 3 0", "add 7000186a0 1000186a0")
    assert said(model, "low", at_s=0.0005)[0].startswith("ok state=running sweeps=0 word=0 pins=5")
    assert_changes(model, (0.0005, 5), (0.001, 1), (0.002, 5), (0.003, 1), (0.004, 5), (0.005, 1), (0.006, 0))
    said(model, "low", at_s=10.5)
    assert said(model, RUN, at_s=11.0)[0].startswith("ok state=running sweeps=0 word=0 pins=7")


def test_hours_of_sweeps_fill_no_memory() -> None:
    model = started(TeensyModel(lambda from_s, until_s: from_s), "new 9999999 0", "add 000000000 1000186a0 000000bb8")
    for n in range(200):
        model.advance(n * 0.1)
        model.forget(n * 0.1 - 0.5)
    assert len(model.changes(0.0, 20.0)) < 1200
    assert model.sweeps > 18_000
    model._times, model._levels = [0.0] * MOST_CHANGES, [0] * MOST_CHANGES
    model.advance(20.1)
    assert len(model.changes(-1.0, 21.0)) < 0.6 * MOST_CHANGES


# The firmware itself beside its model

Event = tuple[float, str, str]
Firmware = Callable[[Sequence[Event]], tuple[list[tuple[float, int]], list[str]]]


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Firmware:
    """Runs the sketch by events (time, "send" | "marker" | "dtr" | "suspend", line or level): changes and replies."""
    if shutil.which("g++") is None:
        pytest.skip("no g++ here to compile the sketch with")
    program = tmp_path_factory.mktemp("teensy") / "sketch"
    sources = ["-I", str(HOST), str(HOST / "main.cpp"), "-o", str(program)]
    built = subprocess.run(["g++", "-std=gnu++17", "-O1", *sources], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr

    def run(events: Sequence[Event]) -> tuple[list[tuple[float, int]], list[str]]:
        script = ""
        for at_s, what, value in sorted(events, key=lambda event: event[0]):
            coded = f"{value}\n".encode("latin-1").hex() if what == "send" else value
            script += f"{round(at_s * HZ)} {what} {coded}\n"
        done = subprocess.run([program], input=script.encode(), capture_output=True, check=True, timeout=60)
        changes, replies = [], []
        for line in done.stdout.decode("latin-1").splitlines():
            at, what, value = line.split(" ", 2)
            if what == "pins":
                changes.append((int(at) / HZ, int(value)))
            else:
                replies.append(value)
        return changes, replies

    return run


def in_model(events: Sequence[Event]) -> tuple[list[tuple[float, int]], list[str]]:
    """As `firmware`, by the model."""
    model = model_of(*((at_s, int(value)) for at_s, what, value in events if what == "marker"))
    replies = b""
    for at_s, what, value in sorted(events, key=lambda event: event[0]):
        if what == "send":
            replies += model.receive(f"{value}\n".encode("latin-1"), at_s)
        elif what in ("dtr", "suspend"):
            (model.open_port if (what == "dtr") == (value == "1") else model.close_port)(at_s)
        else:
            model.advance(at_s)
    return model.changes(0.0, 100.0)[1:], replies.decode("latin-1").splitlines()


def assert_alike(firmware: Firmware, events: Sequence[Event], late_s: float = LATE_S) -> list[tuple[float, int]]:
    changes, replies = firmware(events)
    wanted, answers = in_model(events)
    later = in_model([(at_s + SOON_S * (what == "send"), what, value) for at_s, what, value in events])[1]
    assert [reply for reply, *right in zip(replies, answers, later, strict=True) if reply not in right] == []
    assert [level for _, level in changes] == [level for _, level in wanted]
    for (found_s, _), (wanted_s, _) in zip(changes, wanted, strict=True):
        assert -1e-8 < found_s - wanted_s < late_s
    return changes


def some_program(draw: random.Random) -> list[str]:
    words = []
    for _ in range(draw.randint(1, 12)):
        kind = draw.random()
        ticks = draw.choice([500, 500, draw.randint(501, 3000), draw.randint(3000, 300_000)])
        if kind < 0.3:
            words.append(f"{draw.choice([0, 1, 4, 5])}00000000")
        else:
            words.append(f"{draw.randint(0, 15):x}{ticks:08x}")
    if all(int(word[1:], 16) == 0 for word in words):
        words.append("4000003e8")
    lines = [f"new {draw.randint(1, 30)} {draw.choice([0, draw.randint(1, 100_000)])}", f"add {' '.join(words)}"]
    return [*lines, program(*lines).decode().splitlines()[-1]]


@pytest.mark.parametrize("seed", range(60))
def test_firmware_and_model_play_alike_whatever_the_program_marker_and_commands(seed: int, firmware: Firmware) -> None:
    draw = random.Random(seed)
    events: list[Event] = [(1e-4, "send", line) for line in some_program(draw)]
    events.append((1e-3, "send", f"run {draw.choice([5000, 60_000])}"))
    at_s, level = draw.choice([0.0, 1e-3]), 0
    while at_s < 0.2:
        at_s += draw.choice([draw.uniform(5e-6, 1e-4), draw.uniform(1e-4, 1e-2)])
        level = 1 - level
        events.append((round(at_s, 8), "marker", str(level)))
    commands = "status", "#x status", "low", "new 1 0", RUN, "id", "y", *(5 * ["status"])
    said_s = [round(draw.uniform(2e-3, 0.2), 8) for _ in range(15)]
    ends_s = round(draw.uniform(0.01, 0.4), 8)
    # The board looks at the port only every millisecond.
    events += [(at_s, "send", draw.choice(commands)) for at_s in said_s if not 0 <= at_s - ends_s < 1.1e-3]
    events.append((ends_s, *draw.choice([("send", "abort"), ("dtr", "0"), ("suspend", "1")])))
    events += [(0.5, "send", "status"), (0.6, "send", RUN), (0.7, "send", "abort")]
    events += [(0.75, "dtr", "1"), (0.76, "suspend", "0"), (0.8, "send", RUN), (0.9, "send", "abort")]
    port_ends = {"dtr", "suspend"} & {what for _, what, _ in events}
    assert_alike(firmware, events, 1.1e-3 if port_ends else 3e-6)  # waits that pass at once add up their delays


@pytest.mark.parametrize("seed", range(20))
def test_firmware_and_model_say_the_same_to_nonsense(seed: int, firmware: Firmware) -> None:
    draw = random.Random(seed)
    lines = []
    for _ in range(40):
        lines += [*some_program(draw), *draw.choices([RUN, "abort", "status", "#12 id", "low", ""], k=2)]
    for _ in range(60):
        place = draw.randrange(len(lines))
        line = lines[place]
        at = draw.randint(0, len(line))
        inserted = draw.choice(["", " ", "0", "f", "\r", "\0", "#", "é", "x" * 1000, "\t"])
        lines[place] = line[:at] + inserted + line[at + draw.randint(0, 2) :]
    assert_alike(firmware, [(1e-3 * (n + 1), "send", line) for n, line in enumerate(lines)], 1.0)


def test_the_firmware_is_not_late_for_long_in_an_ordinary_scan(firmware: Firmware) -> None:
    lines = ["new 50 50000", SWEEP]
    events = [(1e-4, "send", line) for line in (*lines, program(*lines).decode().splitlines()[-1], "run 500")]
    for n in range(50):
        events += [(0.01 * n + 0.001, "marker", "1"), (0.01 * n + 0.00675, "marker", "0")]
        events.append((0.01 * n + 0.003, "send", "status"))
    changes = assert_alike(firmware, [*events, (0.6, "send", "status")])
    assert len(changes) == 100


def test_the_firmwares_watchdog_is_late_by_a_millisecond_at_most(firmware: Firmware) -> None:
    lines = ["new 4294967295 0", "add 2000001f4"]
    events = [(1e-4, "send", line) for line in (*lines, program(*lines).decode().splitlines()[-1])]
    events += [(1e-3, "send", "run 20"), (0.015, "send", "status"), (0.03, "send", "y"), (0.1, "send", "status")]
    changes = assert_alike(firmware, events, 1.1e-3)
    assert changes[-1][1] == 0
    assert 0.035 <= changes[-1][0] < 0.0361


def test_a_word_may_be_longer_than_the_cycle_counter(firmware: Firmware) -> None:
    lines = ["new 1 0", "add 2ffffffff 4000003e8"]
    events = [(1e-4, "send", line) for line in (*lines, program(*lines).decode().splitlines()[-1])]
    changes = assert_alike(firmware, [*events, (20.0, "send", RUN), (70.0, "send", "status")])
    assert changes[1][0] - changes[0][0] == pytest.approx(42.94967295, abs=1e-6)
