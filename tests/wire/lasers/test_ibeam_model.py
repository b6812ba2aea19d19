"""The model of the iBeam smart firmware alone, raw bytes against what public clients send and expect. No driver."""

import pytest

from sim_backend.wire.firmware.ibeam import BANNER, BIAS, EXTERNAL, LOCKED, NORMAL, PARAMETER, UNKNOWN, IbeamModel

OK = "\r\n[OK]\r\n"


class Talk:
    """A client that has switched echo and prompt off, at a time of its own."""

    def __init__(self, model: IbeamModel) -> None:
        self.model, self.now_s = model, 1.0
        self("echo off")
        self("prom off")

    def __call__(self, command: str, end: str = "\r\n") -> str:
        return self.model.receive((command + end).encode(), self.now_s).decode()


def answer(*lines: str) -> str:
    return "\r\n" + "".join(f"{line}\r\n" for line in lines) + "[OK]\r\n"


# The dialogue.


def test_after_power_up_it_echoes_and_prompts() -> None:
    model = IbeamModel()
    model.power_up(1.0)
    assert model.tick(1.0).decode() == BANNER + "CMD> "
    assert model.receive(b"status laser\r\n", 1.0) == b"status laser\r\nOFF\r\nCMD> "
    assert model.receive(b"echo off\r\n", 1.0) == b"echo off\r\nCMD> "
    assert model.receive(b"sta la\r\n", 1.0) == b"\r\nOFF\r\nCMD> "
    assert model.receive(b"prompt off\r\n", 1.0) == b"\r\n[OK]\r\n"
    assert model.receive(b"prompt on\r\n", 1.0) == b"\r\nCMD> "


def test_a_command_may_end_with_cr_and_come_in_pieces() -> None:
    talk = Talk(IbeamModel())
    assert talk("sta la", "\r") == answer("OFF")
    assert [talk(piece, "") for piece in ("sta", " la", "\r", "\n")] == ["", "", answer("OFF"), ""]


def test_an_empty_command_answers_nothing_extra() -> None:
    assert Talk(IbeamModel())("") == OK


@pytest.mark.parametrize(
    ("command", "lines"),
    [
        ("ver", ["iBPs-001A01-05"]),
        ("version", ["iBPs-001A01-05"]),
        ("serial", ["SN: iBEAM-SMART-640-S-A3-12345"]),
        ("show serial", ["SN: iBEAM-SMART-640-S-A3-12345"]),
        ("id", ["SN: iBEAM-SMART-640-S-A3-12345"]),
        ("sta la", ["OFF"]),
        ("status channel 1", ["ON"]),
        ("sta ch 2", ["OFF"]),
        ("sta ext", ["OFF"]),
        ("sta fine", ["OFF"]),
        ("sta clip", ["GOOD"]),
        ("sh pow", ["%SYS-I-077, scaled", "PIC  = 000000 uW  "]),
        ("sh cur", ["%SYS-I-077, scaled", "LDC  = 0.0 mA  "]),
        ("sh temp", ["%SYS-I-077, scaled", "TEMP = 25.0  C"]),
        ("sh temp sys", ["TEMP = 30.2 C"]),
        ("sh level pow", ["CH1, PWR: 1.000 mW", "CH2, PWR: 10.000 mW"]),
        ("sh ch 1", ["CH1", "status: on"]),
        ("status uptime", ["PowerUP: 0 h + 1 s", "LaserON: 0 h + 0 s"]),
        ("show satellite", ["", "   Pmax: 150 mW", "   CH1 setp: 1.000 mW", "   CH2 setp: 10.000 mW"]),
        ("sh sys", ["   pulse board: yes", "   SPP modes: Normal"]),
        *((wrong, [PARAMETER]) for wrong in ("sta ch 3", "laser", "laser maybe", "enable 3")),
        ("gibberish", [UNKNOWN]),
    ],
)
def test_it_answers_a_command(command: str, lines: list[str]) -> None:
    assert Talk(IbeamModel())(command) == answer(*lines)


def test_gabby_talk_adds_information_that_is_no_error() -> None:
    talk = Talk(IbeamModel())
    talk("talk gabby")
    assert talk("la on") == answer("%SYS-I-002, laser on")
    assert talk("sta la") == answer("ON")
    assert talk("talk usual") == OK


def test_quiet_talk_swallows_answers_even_of_questions() -> None:
    talk = Talk(IbeamModel())
    assert talk("talk quiet") == ""
    assert talk("la on") == talk("show serial") == ""
    assert talk("sta la") == answer("ON")
    assert talk("nonsense") == answer(UNKNOWN)
    assert talk("talk usual") == OK


def test_replies_fall_one_behind_after_a_fast_command_until_a_reset() -> None:
    model = IbeamModel(lag_gap_s=0.02)
    talk = Talk(model)
    assert model.lagging, "two commands at once"
    talk.now_s = 2.0
    assert talk("ver") == OK
    talk.now_s = 3.0
    assert talk("sta la") == answer("iBPs-001A01-05")
    talk.now_s = 4.0
    assert talk("reset system") == BANNER + "CMD> "
    talk.now_s = 5.0
    assert talk("sta la") == "sta la\r\nOFF\r\nCMD> "


# Light.


def lit(model: IbeamModel) -> tuple[float, float]:
    """Power in mW with the gate open and closed."""
    return round(model.power_w * 1e3, 6), round(model.closed_gate_power_w * 1e3, 6)


def test_powers_are_in_milliwatts_unless_micro_follows() -> None:
    talk = Talk(IbeamModel())
    assert talk("ch 2 pow 50") == OK
    assert talk.model.powers_w[NORMAL] == pytest.approx(0.05)
    assert talk("channel 2 power 1234.500 micro") == talk("ch 1 pow 100.000000 mic") == OK
    assert talk("sh level pow") == answer("CH1, PWR: 0.100 mW", "CH2, PWR: 1.234 mW")


@pytest.mark.parametrize("command", ["ch 2 pow 150.1", "ch 2 pow 50000", "ch 2 pow -1", "ch 2 pow x", "ch 3 pow 1"])
def test_a_power_that_cannot_be_is_refused_and_the_old_one_stays(command: str) -> None:
    talk = Talk(IbeamModel())
    assert talk(command) == answer(PARAMETER)
    assert talk.model.powers_w == {BIAS: 0.001, NORMAL: 0.01}
    assert talk("ch 2 pow 150") == OK


def test_light_is_the_sum_of_the_enabled_channels() -> None:
    talk = Talk(IbeamModel(scaled=False))
    talk("en 2")
    assert lit(talk.model) == (0, 0)
    talk("la on")
    assert lit(talk.model) == (11, 11)
    assert talk("sh pow") == answer("PIC  = 011000 uW  ")
    talk("di 1")
    assert lit(talk.model) == (10, 10)
    talk("di 0")
    assert lit(talk.model) == (0, 0)
    assert talk("sta la") == answer("ON")
    talk("en 0")
    talk("ch 1 pow 149")
    assert lit(talk.model) == (150, 150)
    talk("la off")
    assert not talk.model.emitting
    model = IbeamModel(
        powers_w={1: 0.001, 2: 0.01, 3: 0.02}, disabled_shine=True, enabled=set(), state_on=True, ext=True
    )
    assert lit(model) == (31, 21)


def test_laser_on_enables_the_default_channel_again() -> None:
    talk = Talk(IbeamModel())
    talk("di 1")
    talk("en 2")
    talk("la on")
    assert talk("sta ch 1") == answer("ON")
    assert lit(talk.model) == (11, 11)
    talk = Talk(IbeamModel(default_channel=None))
    talk("di 1")
    talk("la on")
    assert not talk.model.emitting


def test_the_digital_input_switches_channel_2_and_leaves_the_bias() -> None:
    model = IbeamModel()
    talk = Talk(model)
    for command in ("en 2", "enable ext", "la on"):
        assert talk(command) == OK
    assert model.gated
    assert lit(model) == (11, 1)
    assert talk("sh pow") == answer("%SYS-I-077, scaled", "PIC  = 001000 uW  ")
    model.gate_high = True
    assert talk("sh pow") == answer("%SYS-I-077, scaled", "PIC  = 011000 uW  ")
    talk("ch 1 pow 0")
    assert lit(model) == (10, 0)
    assert talk("di 2") == talk("en 2") == talk("di 0") == answer(EXTERNAL)
    assert talk("sta ext") == answer("ON")
    assert talk("di x") == OK
    assert lit(model) == (10, 10), "the light is on without a gate"


def test_without_a_pulse_board_an_open_input_is_full_power() -> None:
    model = IbeamModel(pulse_board=False)
    talk = Talk(model)
    assert talk("sh sys") == answer("   pulse board: no", "   SPP modes: Normal")
    for command in ("ch 1 pow 0", "en 2", "en ext", "la on"):
        assert talk(command) == OK
    assert not model.gated
    assert lit(model) == (10, 10)


def test_an_open_interlock_a_key_or_a_fault_darkens_and_refuses_until_laser_on_is_sent_again() -> None:
    model = IbeamModel()
    talk = Talk(model)
    talk("la on")
    model.open_interlock(2.0)
    assert talk("sta la") == answer("OFF")
    assert talk("la on") == answer(LOCKED)
    model.interlock_open = False
    assert not model.emitting
    assert talk("la on") == OK
    model.turn_key(False, 3.0)
    assert talk("la on") == answer(LOCKED)
    model.turn_key(True, 4.0)
    model.set_fault("overtemperature", 5.0)
    assert talk("la on") == answer("%SYS-F-050, overtemperature")
    assert not model.emitting


def test_emission_may_come_after_the_status() -> None:
    told: list[tuple[bool, float]] = []
    model = IbeamModel(on_delay_s=0.5, on_emission=lambda emits, now_s: told.append((emits, now_s)))
    talk = Talk(model)
    talk("la on")
    assert talk("sta la") == answer("ON")
    assert not told
    model.tick(1.5)
    talk.now_s = 2.0
    talk("la off")
    assert told == [(True, 1.5), (False, 2.0)]


def test_every_change_of_power_is_told() -> None:
    told: list[bool] = []
    model = IbeamModel(on_emission=lambda emits, now_s: told.append(emits))
    talk = Talk(model)
    for command in ("la on", "ch 1 pow 5", "ch 2 pow 5", "en 2", "di 0", "la off"):
        talk(command)
    assert told == [True, True, True, False]


def test_a_laser_left_on_shines_until_it_is_without_power_and_forgets_ext() -> None:
    model = IbeamModel()
    model.shine(0.02)
    assert lit(model) == (20, 0)
    model.power_up(5.0)
    assert lit(model) == (0, 0)
    assert not model.ext
