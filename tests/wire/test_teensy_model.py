"""The model of the Teensy's firmware; and the firmware itself, compiled for this computer, beside the model."""

import random
import shutil
import subprocess
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import serial

from sim_backend.wire.firmware.teensy import MAX_WORDS, MOST_CHANGES, TeensyModel
from sim_backend.wire.serve.serial import SerialServer

HOST = Path(__file__).with_name("teensy_host")
HZ = 600_000_000
SWEEP = "add 000000000 0000186a0 a0007a120 0000003e8"
"""Wait, 1 ms dark, 5 ms of held gate, 10 us dark."""
LATE_S = 0.4e-6
"""Time by which the firmware's edges may be late on the PC."""
SOON_S = 2.5e-6
"""A status is read a little after its line came, in which time the program may have gone on."""


class Marker:
    """A scan marker with these edges: (time, level), ascending; low before."""

    def __init__(self, *edges: tuple[float, int]) -> None:
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


def model_of(*edges: tuple[float, int]) -> TeensyModel:
    marker = Marker(*edges)
    return TeensyModel(marker.high, marker.low)


def program(*lines: str) -> bytes:
    """The lines of a program and their end."""
    sent = "".join(f"{line}\n" for line in lines).encode()
    count = sum(len(line.split()) - 1 for line in lines[1:])
    return sent + f"end {count} {zlib.crc32(sent):08x}\n".encode()


def said(model: TeensyModel, *lines: str, at_s: float = 0.0) -> list[str]:
    return model.receive("".join(f"{line}\n" for line in lines).encode(), at_s).decode().splitlines()


def started(model: TeensyModel, *lines: str, watchdog_ms: int = 0) -> TeensyModel:
    answers = model.receive(program(*lines), 0.0).decode().splitlines()
    assert all(answer.startswith("ok") for answer in answers), answers
    assert said(model, f"run {watchdog_ms}")[0].startswith("ok state=")
    return model


def assert_changes(model: TeensyModel, *changes: tuple[float, int], until_s: float = 10.0) -> None:
    model.advance(until_s)
    found = model.changes(0.0, until_s)[1:]
    assert [level for _, level in found] == [level for _, level in changes]
    assert [at for at, _ in found] == pytest.approx([at for at, _ in changes], abs=1e-9)


# Lines


def test_it_says_who_it_is() -> None:
    assert said(TeensyModel(serial="8765430"), "id") == [
        "ok spadrig-sync 1 8765430 words=30000 tick_ns=10 shortest=500"
    ]


def test_a_tag_comes_back_and_a_line_may_come_in_pieces() -> None:
    model = TeensyModel()
    assert model.receive(b"#7f sta", 0.0) == b""
    answer = b"#7f ok state=stopped sweeps=0 word=0 pins=0 marker=0 cuts=0 why=none\n"
    assert model.receive(b"tus\r\n", 0.0) == answer
    assert said(model, "#123456789 id", "# id", "#1") == 3 * ["error unknown command"]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("", None),
        ("x", "error unknown command"),
        (" id", "error unknown command"),
        ("ID", "error unknown command"),
        ("#a ", "#a error unknown command"),
        ("id 1", "error usage: id"),
        ("#b low 1", "#b error usage: low"),
        ("new 0 0", "error usage: new REPEATS HOLD"),
        ("new 1 4294967296", "error usage: new REPEATS HOLD"),
        ("new 1 0 0", "error usage: new REPEATS HOLD"),
        ("new -1 0", "error usage: new REPEATS HOLD"),
        ("add", "error usage: add WORD ..."),
        ("add 0", "error no program: new, add, end"),
        ("end 1 00000000", "error no program: new, add, end"),
        ("end 0 00000000", "error usage: end COUNT CRC"),
        ("end 1 0000000A", "error usage: end COUNT CRC"),
        ("run 0", "error no program: new, add, end"),
        ("run 60001", "error usage: run WATCHDOG"),
        ("run", "error usage: run WATCHDOG"),
        ("x" * 1023, "error unknown command"),
        ("#c " + "x" * 1021, "#c error line longer than 1023 bytes"),
    ],
)
def test_a_line_without_a_program(line: str, answer: str | None) -> None:
    assert said(TeensyModel(), line) == ([] if answer is None else [answer])


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
    assert said(TeensyModel(), "new 1 0", f"add 0000001f4 {word}", "add 0000001f4") == [
        "ok",
        f"error word 1: {objection}",
        "error no program: new, add, end",
    ]


def test_a_program_that_did_not_arrive_whole_cannot_run() -> None:
    whole = program("new 3 50000", SWEEP)
    assert whole.endswith(b"\nend 4 %08x\n" % zlib.crc32(f"new 3 50000\n{SWEEP}\n".encode()))
    n_runs = 0
    for lost in range(len(whole) - 1):
        model = TeensyModel()
        answers = model.receive(whole[:lost] + whole[lost + 1 :] + b"\nrun 0\n", 0.0).decode().splitlines()
        n_runs += model.state == "playing"
        assert model.state == "playing" or answers[-1].startswith("error no program"), lost
    assert n_runs == 0
    model = TeensyModel()
    assert model.receive(whole.replace(b"a0007a120", b"a0007a130"), 0.0).endswith(b"error crc: f3a91884 came\n")
    assert said(model, "new 1 0", "add 0000001f4", "end 2 00000000") == ["ok", "ok 1", "error count: 1 words came"]


def test_a_program_fills_the_memory_and_no_more() -> None:
    model = TeensyModel()
    line = "add" + 100 * " 0000001f4"
    assert said(model, "new 1 0", *(MAX_WORDS // 100 * [line]))[-1] == "ok 30000"
    assert said(model, "add 0000001f4") == ["error full: 30000 words"]


def test_it_answers_on_a_serial_port() -> None:
    with SerialServer(TeensyModel(), baud=10_000_000) as wire, serial.Serial(wire.path, timeout=5) as port:
        port.write(program("new 1000 0", "add 3000186a0") + b"run 0\n#z abort\n")
        answers = [port.readline().decode() for _ in range(5)]
    assert answers[:3] == ["ok\n", "ok 1\n", "ok\n"]
    assert answers[3].startswith("ok state=running sweeps=0 word=0 pins=3 ")
    assert answers[4] == "#z ok state=aborted sweeps=0 word=0 pins=0 marker=0 cuts=0 why=abort\n"


# Programs


def test_a_program_is_played_as_often_as_it_says_and_ends_low() -> None:
    model = started(model_of((0.01, 1), (0.0159, 0), (0.03, 1), (0.0359, 0)), "new 2 50000", SWEEP)
    assert said(model, "status", "add 000000000", at_s=0.005) == [
        "ok state=waiting sweeps=0 word=0 pins=0 marker=0 cuts=0 why=none",
        "error busy: abort first",
    ]
    assert said(model, "status", at_s=0.012) == ["ok state=running sweeps=1 word=2 pins=2 marker=1 cuts=0 why=none"]
    assert_changes(model, (0.011, 2), (0.016, 0), (0.031, 2), (0.036, 0))
    assert said(model, "status", at_s=10) == ["ok state=stopped sweeps=2 word=0 pins=0 marker=0 cuts=0 why=end"]
    assert said(model, "run 0", at_s=11)[0].startswith("ok state=waiting"), "the program is still there"


def test_a_wait_passes_while_the_marker_is_high_but_takes_five_microseconds() -> None:
    assert_changes(started(model_of((-1.0, 1)), "new 3 0", "add 100000000 4000001f4"), *[
        change for n in range(3) for change in ((n * 1e-5, 1), (n * 1e-5 + 5e-6, 4))
    ][1:], (3e-5, 0))  # fmt: skip


@pytest.mark.parametrize(("hold", "fallen"), [(0, 0.013), (50_000, 0.0135)])
def test_a_held_gate_falls_when_the_marker_has_been_low_for_the_hold(hold: int, fallen: float) -> None:
    edges = (0.01, 1), (0.013, 0), (0.0145, 1), (0.03, 1)
    model = started(model_of(*edges), f"new 1 {hold}", SWEEP, "add 4000003e8")
    assert_changes(model, (0.011, 2), (fallen, 0), (0.01601, 4), (0.01602, 0))
    assert model.cuts == 1


def test_a_marker_that_comes_back_within_the_hold_cuts_nothing() -> None:
    gaps = [(t, level) for n in range(4) for t, level in ((0.012 + n * 1e-3, 0), (0.0124 + n * 1e-3, 1))]
    assert_changes(started(model_of((0.01, 1), *gaps), "new 1 50000", SWEEP), (0.011, 2), (0.016, 0))


def test_a_held_word_that_begins_without_the_marker_stays_dark_and_keeps_its_other_outputs() -> None:
    model = started(model_of((0.01, 1), (0.0109, 0), (0.0112, 1)), "new 1 50000", SWEEP.replace("a00", "f00"))
    assert_changes(model, (0.011, 5), (0.016, 0))


def test_the_fall_of_the_marker_is_found_without_being_told() -> None:
    marker = Marker((0.01, 1), (0.013, 0))
    model = started(TeensyModel(marker.high), "new 1 0", SWEEP)
    model.advance(1.0)
    found = model.changes(0.0, 1.0)[1:]
    assert [level for _, level in found] == [2, 0]
    assert found[1][0] == pytest.approx(0.013, abs=25e-6)


def test_a_marker_that_the_scanner_tells_late_still_cuts() -> None:
    marker = Marker((0.01, 1))
    model = started(TeensyModel(lambda a, b: marker.high(a, b), lambda a, b: marker.low(a, b)), "new 1 0", SWEEP)
    model.advance(0.014)
    assert model.outputs_at(0.014) == 2
    marker.edges = (0.01, 1), (0.013, 0)
    assert_changes(model, (0.011, 2), (0.013, 0))


def test_a_marker_that_is_high_and_low_in_one_instant_ends_all_the_same() -> None:
    model = started(
        TeensyModel(lambda a, b: a, lambda a, b: max(a, 5e-6) if b > 5e-6 else None), "new 1 9", "add a000003e8"
    )
    assert_changes(model, (1e-5, 0))


# Ways out


def test_abort_takes_everything_low_and_the_program_stays() -> None:
    model = started(TeensyModel(), "new 1000 0", "add 7000186a0")
    assert said(model, "abort", at_s=0.5) == ["ok state=aborted sweeps=0 word=0 pins=0 marker=0 cuts=0 why=abort"]
    assert_changes(model, (0.5, 0))
    assert said(model, "abort", at_s=11.0)[0].startswith("ok state=aborted")
    assert said(model, "run 0", at_s=11.0)[0].startswith("ok state=running sweeps=0 word=0 pins=7")


def test_low_holds_the_gate_until_the_next_run_while_the_program_goes_on() -> None:
    model = started(TeensyModel(), "new 3 0", "add 7000186a0 1000186a0")
    assert said(model, "low", at_s=0.0005)[0].startswith("ok state=running sweeps=0 word=0 pins=5")
    assert_changes(model, (0.0005, 5), (0.001, 1), (0.002, 5), (0.003, 1), (0.004, 5), (0.005, 1), (0.006, 0))
    assert said(model, "run 0", at_s=11.0)[0].startswith("ok state=running sweeps=0 word=0 pins=7")


def test_the_watchdog_ends_a_program_whose_host_says_nothing_right() -> None:
    model = started(TeensyModel(), "new 1000 0", "add 2000186a0", watchdog_ms=100)
    assert "state=running" in said(model, "status", at_s=0.08)[0]
    assert said(model, "nonsense", at_s=0.17) == ["error unknown command"]
    assert "state=aborted" in said(model, "status", at_s=0.3)[0]
    assert model.why == "watchdog"
    assert_changes(model, (0.18, 0))


def test_a_closed_port_ends_a_program_and_lets_none_begin() -> None:
    model = started(TeensyModel(), "new 1000 0", "add 2000186a0")
    model.close_port(0.25)
    assert said(model, "run 0", at_s=0.5) == ["error port: DTR is low"]
    model.open_port(0.6)
    assert said(model, "status", at_s=0.6)[0].endswith("pins=0 marker=0 cuts=0 why=port")
    assert_changes(model, (0.25, 0))


def test_power_takes_the_program_away_and_a_short_circuit_is_read_back() -> None:
    model = started(TeensyModel(), "new 1000 0", "add 2000186a0")
    model.short(1, 0.1)
    assert "pins=3" in said(model, "status", at_s=0.1)[0]
    assert "pins=1" in said(model, "abort", at_s=0.2)[0]
    model.short(0, 0.3)
    model.power_cycle(0.4)
    assert said(model, "status", "run 0", at_s=0.5) == [
        "ok state=stopped sweeps=0 word=0 pins=0 marker=0 cuts=0 why=none",
        "error no program: new, add, end",
    ]


def test_hours_of_sweeps_fill_no_memory() -> None:
    model = started(
        TeensyModel(lambda from_s, until_s: from_s), "new 4294967295 0", "add 000000000 1000186a0 000000bb8"
    )
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
    events.append((1e-3, "send", f"run {draw.choice([0, 60_000])}"))
    at_s, level = draw.choice([0.0, 1e-3]), 0
    while at_s < 0.2:
        at_s += draw.choice([draw.uniform(5e-6, 1e-4), draw.uniform(1e-4, 1e-2)])
        level = 1 - level
        events.append((round(at_s, 8), "marker", str(level)))
    commands = "status", "#x status", "low", "new 1 0", "run 0", "id", "y", *(5 * ["status"])
    said_s = [round(draw.uniform(2e-3, 0.2), 8) for _ in range(15)]
    ends_s = round(draw.uniform(0.01, 0.4), 8)
    # The board looks at the port only every millisecond.
    events += [(at_s, "send", draw.choice(commands)) for at_s in said_s if not 0 <= at_s - ends_s < 1.1e-3]
    events.append((ends_s, *draw.choice([("send", "abort"), ("dtr", "0"), ("suspend", "1")])))
    events += [(0.5, "send", "status"), (0.6, "send", "run 0"), (0.7, "send", "abort")]
    port_ends = {"dtr", "suspend"} & {what for _, what, _ in events}
    assert_alike(firmware, events, 1.1e-3 if port_ends else 3e-6)  # waits that pass at once add up their delays


@pytest.mark.parametrize("seed", range(20))
def test_firmware_and_model_say_the_same_to_nonsense(seed: int, firmware: Firmware) -> None:
    draw = random.Random(seed)
    lines = []
    for _ in range(40):
        lines += [*some_program(draw), *draw.choices(["run 0", "abort", "status", "#12 id", "low", ""], k=2)]
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
    changes = assert_alike(firmware, [*events, (20.0, "send", "run 0"), (70.0, "send", "status")])
    assert changes[1][0] - changes[0][0] == pytest.approx(42.94967295, abs=1e-6)
