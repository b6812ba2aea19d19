"""A recorded device answers what it answered, with today's tokens, and nothing to what was not recorded."""

from drivers.transports.tap import IN, OUT, Passed
from sim_backend.wire.recorded import RecordedModel


def passed(*pieces: tuple[float, str, bytes]) -> list[Passed]:
    return [Passed(round(t_s * 1e9), "sync", "serial", way, data) for t_s, way, data in pieces]


TALK = passed(
    (0.0, OUT, b"?\r"), (0.1, IN, b"OK\r\n"), (1.0, OUT, b"slmp 5\r"), (1.1, IN, b"O"), (1.2, IN, b"K\r\n"),
    (1.3, OUT, b"pa?\r"), (1.4, IN, b"0\r\n"), (3.0, OUT, b"pa?\r"), (3.1, IN, b"5\r\n"),
    (4.0, OUT, b"slmp 0\r"), (4.1, IN, b"DONE\r\n"),
)  # fmt: skip


def test_questions_are_answered_as_often_as_asked_and_as_it_stood_then() -> None:
    model = RecordedModel(TALK)
    assert model.receive(b"?\r", 10.0) == model.receive(b"?\r", 11.0) == b"OK\r\n"
    assert model.receive(b"slmp 5\r", 20.0) == b"OK\r\n"
    assert [model.receive(b"pa?\r", 20.0 + t_s) for t_s in (0.1, 1.0, 2.5, 9.0)] == [b"0\r\n"] * 2 + [b"5\r\n"] * 2
    assert model.receive(b"?\r", 30.0) == b"OK\r\n"


def test_pieces_may_come_torn_and_joined() -> None:
    model = RecordedModel(TALK)
    assert [model.receive(bytes([byte]), 0.0) for byte in b"?\r"] == [b"", b"OK\r\n"]
    assert model.receive(b"?\rslmp 5\rpa?\rslm", 1.0) == b"OK\r\nOK\r\n0\r\n"
    assert model.receive(b"p 0\r", 1.0) == b"DONE\r\n"
    assert not model.diverged


def test_commands_come_in_their_order_and_may_be_said_again() -> None:
    model = RecordedModel(TALK)
    assert model.receive(b"slmp 5\r", 0.0) == model.receive(b"slmp 5\r", 0.1) == b"OK\r\n"
    assert model.receive(b"slmp 0\r", 0.2) == b"DONE\r\n"
    skips = RecordedModel(TALK)
    assert skips.receive(b"slmp 0\r", 0.0) == skips.receive(b"?\r", 0.1) == b""  # nothing after what was not recorded
    assert skips.diverged


def test_answers_bear_the_tokens_of_today() -> None:
    model = RecordedModel(
        passed(
            (0.0, OUT, b"#00000001\nsts\n#00000002\n"),
            (0.1, IN, b"bad: #00000001\r\nrun-status:0\r\nbad: #00000002\r\n"),
            (0.2, OUT, b"#00000003\ncls\n#00000004\n"),
            (0.3, IN, b"bad: #00000003\r\nok\r\nbad: #00000004\r\n"),
        )
    )
    for first in (0x2, 0xAB):  # the first of these is a token of the recording, shifted by one
        asked = b"#%08x\nsts\n#%08x\n" % (first, first + 1)
        assert model.receive(asked, 0.0) == b"bad: #%08x\r\nrun-status:0\r\nbad: #%08x\r\n" % (first, first + 1)
    assert b"bad: #0000ffff\r\nok" in model.receive(b"#0000ffff\ncls\n#00010000\n", 0.1)
