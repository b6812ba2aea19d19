"""The models of the OBIS and of Cobolt lasers alone: bytes in, bytes out, against the tables of
docs/reference/devices."""

import pytest

from sim_backend.wire.firmware.cobolt import CoboltModel, Family
from sim_backend.wire.firmware.obis import ObisModel, Series

WARM = 1.0
"""Time at which every laser here is warm."""
LATER_S = 20.0
"""Time by which every delay is over."""


class Talk:
    """A dialogue with a model, one line at a time, slowly enough for any laser."""

    def __init__(self, model: ObisModel | CoboltModel) -> None:
        self.model, self.now_s = model, WARM
        model.tick(0.0)

    def __call__(self, line: str, end: str = "\r") -> str:
        self.now_s += 0.2
        return self.model.receive((line + end).encode("ascii"), self.now_s).decode("ascii")

    def wait(self, seconds: float = LATER_S) -> None:
        self.now_s += seconds
        self.model.tick(self.now_s)


def status(talk: Talk) -> str:
    return talk("SYST:STAT?").removesuffix("\r\nOK\r\n")


# OBIS


@pytest.mark.parametrize(("external", "digit"), [(False, "0"), (True, "4")])
def test_the_words_of_an_obis_are_those_that_real_ones_have_said(external: bool, digit: str) -> None:
    model = ObisModel(warm_up_s=10.0)
    talk = Talk(model)
    if external:
        assert talk("SOUR:AM:EXT DIG") == "OK\r\n"
    assert status(talk) == f"C8000{int(digit) + 1}00"
    assert talk("SOUR:AM:STAT ON") == "OK\r\n"
    assert status(talk) == f"C8001{int(digit) + 1}00"
    talk.wait()
    talk.wait()
    assert model.emitting
    assert status(talk) == f"C8001{digit}02"
    talk("SOUR:AM:STAT OFF")
    assert status(talk) == f"C8000{digit}08"
    model.turn_key(False, talk.now_s)
    assert status(talk) == f"CE000{digit}08"
    assert talk("SYST:LOCK?") == "OFF\r\nOK\r\n"
    model.turn_key(True, talk.now_s)
    talk.wait()
    assert status(talk) == f"C8001{digit}02"
    model.open_interlock(talk.now_s)
    assert status(talk) == f"CC000{digit}08"


def test_faults_of_an_obis_are_seen_in_both_words() -> None:
    model = ObisModel(cdrh_delay_s=0.0)
    talk = Talk(model)
    talk("SOUR:AM:STAT ON")
    model.fault = 0x4
    assert status(talk) == "C8001001"
    assert talk("SYST:FAUL?") == "00000004\r\nOK\r\n"
    model.key_on = False
    assert status(talk) == "CE000001"


def test_another_obis_has_marks_in_its_words_without_a_fault() -> None:
    talk = Talk(ObisModel(words="marked"))
    assert status(talk) == "C8001088"
    assert talk("SYST:FAUL?") == "80000000\r\nOK\r\n"


def test_only_an_obis_after_the_manuals_table_says_ready() -> None:
    assert status(Talk(ObisModel(words="ready"))) == "C800000C"


def test_the_delay_of_an_obis_has_its_own_bit_and_no_emission() -> None:
    talk = Talk(ObisModel())
    talk("SOUR:AM:STAT ON")
    assert status(talk) == "C8001010"


def test_the_emission_bit_of_an_obis_can_outlast_its_light() -> None:
    model = ObisModel(cdrh_delay_s=0.0, emission_bit_lag_s=0.5)
    talk = Talk(model)
    talk("SOUR:AM:STAT ON")
    talk("SOUR:AM:STAT OFF")
    assert not model.emitting
    assert status(talk) == "C8000002"
    talk.wait(0.5)
    assert status(talk) == "C8000008"


def test_an_obis_is_lit_by_its_supply_only_with_autostart() -> None:
    model = ObisModel(cdrh_delay_s=0.0)
    for autostart in (False, True):
        model.autostart = autostart
        model.power_up(WARM)
        assert model.emitting is autostart
    model.key_on = False
    model.power_up(WARM)
    assert not model.emitting


def test_an_obis_understands_short_and_long_words_in_any_case() -> None:
    model = ObisModel()
    talk = Talk(model)
    for question in ("SYST:INF:SNUM?", "SYSTem:INFormation:SNUMber?", "syst:information:snum?", "SYST0:INF:SNUM?"):
        assert talk(question, "\r\n") == "123456789012\r\nOK\r\n"
    assert talk("SOURce:POWer:LEVel:IMMediate:AMPLitude 0.05000") == "OK\r\n"
    assert talk("SOUR:POW:LEV:IMM:AMPL?") == "0.05000\r\nOK\r\n"
    assert talk("SOURce:AM:EXTernal DIGital") == "OK\r\n"
    assert talk("SOURce:AM:SOURce?") == "DIGITAL\r\nOK\r\n"
    talk("SYSTem:CDRH OFF")
    assert model.forbidden == ["SYST:CDRH OFF"]


def test_an_obis_names_itself_with_the_date_of_its_firmware() -> None:
    assert Talk(ObisModel())("*IDN?") == "Coherent, Inc - OBIS 488nm 100mW C - V1.8.2 - Dec 14 2010\r\nOK\r\n"


@pytest.mark.parametrize(("series", "kind", "feedback"), [("LX", "DDL", "OK"), ("LS", "OPSL", "ERR-220")])
def test_a_diode_has_modes_that_an_opsl_lacks(series: Series, kind: str, feedback: str) -> None:
    talk = Talk(ObisModel(series=series))
    assert talk("SYST:INF:TYP?") == f"{kind}\r\nOK\r\n"
    assert talk("SOUR:AM:EXT MIXSO") == f"{feedback}\r\n"
    assert talk("SOUR:AM:EXT MIXed") == "OK\r\n"
    assert talk("SOUR:AM:INT DIG") == "ERR-220\r\n"
    assert talk("SOUR:AM:INT CWP") == "OK\r\n"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("SOUR:POW:LEV:IMM:AMPL 0.2", "ERR-220"),
        ("SOUR:POW:LEV:IMM:AMPL 0.0", "ERR-220"),
        ("SOUR:POW:LEV:IMM:AMPL", "ERR-109"),
        ("SOUR:POW:LEV:IMM:AMPL much", "ERR-220"),
        ("SYST:NONE ON", "ERR-100"),
        ("SYST:NONE?", "ERR-100"),
        ("SYST:COMM:HAND MAYBE", "ERR-220"),
        ("SYST1:STAT?", "ERR-241"),
        ("SOUR1:AM:STAT ON", "ERR-241"),
    ],
)
def test_what_an_obis_refuses_it_answers_with_one_line(line: str, answer: str) -> None:
    assert Talk(ObisModel())(line) == f"{answer}\r\n"


def test_an_obis_keeps_its_mode_while_it_is_on() -> None:
    talk = Talk(ObisModel())
    talk("SOUR:AM:STAT ON")
    assert talk("SOUR:AM:EXT DIG") == "ERR-200\r\n"


def test_without_a_handshake_only_questions_are_answered_until_it_is_switched_on() -> None:
    talk = Talk(ObisModel(handshake=False))
    assert talk("SYST:COMM:HAND?") == "OFF\r\n"
    assert talk("SOUR:AM:STAT OFF") == talk("SOUR:POW:LEV:IMM:AMPL 9") == ""
    assert talk("SYST:NONE?") == "ERR-100\r\n"
    assert talk("SYST:COMM:HAND On") == "OK\r\n"
    assert talk("SYST:COMM:PROM Off") == talk("SYST:ERR:CLE") == "OK\r\n"
    assert talk("SYST:COMM:PROM?") == "OFF\r\nOK\r\n"


def test_a_box_of_lasers_tells_its_places_apart() -> None:
    talk = Talk(ObisModel(channel=2))
    assert "OBIS Remote" in talk("*IDN?")
    assert "OBIS 488nm" in talk("*IDN2?")
    assert talk("*IDN3?") == talk("SYST3:STAT?") == talk("SOUR1:AM:STAT OFF") == "ERR-241\r\n"
    assert talk("SYSTem0:INFormation:WAVelength?") == talk("SOUR:AM:STAT OFF") == "ERR-100\r\n"
    assert talk("SYSTem2:INFormation:WAVelength?") == "488.0\r\nOK\r\n"
    assert talk("SOUR2:AM:STAT OFF") == talk("SYST:COMM:HAND ON") == "OK\r\n"


# Cobolt


FAMILIES: tuple[Family, ...] = ("06-MLD", "06-DPL", "06-01")
each_family = pytest.mark.parametrize("family", FAMILIES)
ILLEGAL = "Syntax error: illegal command\r\n"


def lit(**settings: object) -> tuple[CoboltModel, Talk]:
    """A laser whose key has been turned off and on."""
    model = CoboltModel(**settings)  # type: ignore[arg-type]
    talk = Talk(model)
    talk("p 0.0500")
    model.turn_key(False, talk.now_s)
    model.turn_key(True, talk.now_s)
    talk.wait()
    assert model.emitting
    return model, talk


@each_family
@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_a_cobolt_says_who_it_is(family: Family, end: str) -> None:
    talk = Talk(CoboltModel(family))
    assert talk("sn?", end) == talk("gsn?", end) == "16328\r\n"
    assert "4.1.3" in talk("gfv?", end)
    assert talk("?", end) == "OK\r\n"
    assert talk("gkses?", end) == "1\r\n"
    assert ("CAP-1004" in talk("gfv?", end)) == (family == "06-01")
    assert talk("glm?", end)[4:11] == ("-06-91-" if family == "06-DPL" else "-06-01-")


def test_a_06_mld_refuses_to_say_how_the_key_is_turned() -> None:
    assert Talk(CoboltModel())("@cobasks?") == ILLEGAL
    assert Talk(CoboltModel())("@cobasks") == Talk(CoboltModel())("@cobas?") == "1\r\n"
    assert Talk(CoboltModel("06-01"))("@cobasks?") == "1\r\n"
    assert Talk(CoboltModel("06-01"))("keyswitch?") == "1\r\n"
    stubborn = Talk(CoboltModel(refuses=frozenset({"@cobas?"})))
    assert stubborn("@cobas?") == ILLEGAL
    assert stubborn("gas?") == "1\r\n"
    assert stubborn("@cobasks?") == "1\r\n"


def test_the_key_can_be_off_and_in_force() -> None:
    model = CoboltModel("06-01", key_on=False)
    talk = Talk(model)
    assert (talk("gkses?"), talk("@cobasks?")) == ("1\r\n", "0\r\n")
    model.keyswitch = False
    assert talk("gkses?") == talk("keyswitch:enabled?") == "0\r\n"


@each_family
def test_a_cobolt_with_autostart_is_not_switched_on_by_l1(family: Family) -> None:
    model = CoboltModel(family)
    assert Talk(model)("l1") == "Syntax error: not allowed in autostart mode.\r\n"
    assert not model.on
    assert Talk(CoboltModel(family, autostart=False))("l1") == "OK\r\n"


@each_family
@pytest.mark.parametrize("command", ["l0", "@cob0", "@cob1"])
def test_a_cobolt_that_was_on_is_dark_after_it_until_the_key_is_turned(family: Family, command: str) -> None:
    model, talk = lit(family=family)
    assert talk(command) == "OK\r\n"
    assert not model.emitting
    talk("@cob1")
    talk.wait()
    assert not model.emitting
    assert talk("state?" if family == "06-01" else "gom?") in ("AutostartWaitingForKeyOn\r\n", "1\r\n")
    model.turn_key(False, talk.now_s)
    model.turn_key(True, talk.now_s)
    talk.wait()
    assert model.emitting


def test_some_cobolts_wait_for_the_key_although_they_were_never_off() -> None:
    for key_cycle in (False, True):
        model = CoboltModel(key_cycle=key_cycle)
        talk = Talk(model)
        talk("p 0.05")
        talk("@cob1")
        talk.wait()
        assert model.emitting is not key_cycle


@pytest.mark.parametrize("abort", ["abort", "@cob0"])
def test_an_aborted_program_begins_again_with_restart_and_the_key(abort: str) -> None:
    model, talk = lit()
    assert talk(abort) == "OK\r\n"
    assert talk("gom?") == "6\r\n"
    assert talk("restart") == "OK\r\n"
    assert talk("gom?") == "1\r\n"
    assert not model.emitting


@pytest.mark.parametrize(
    ("family", "numbers"), [("06-MLD", ("0", "0", "2", "4", "5")), ("06-DPL", ("0", "3", "4", "7", "5"))]
)
def test_numbers_of_the_operating_mode_depend_on_the_family(family: Family, numbers: tuple[str, ...]) -> None:
    model = CoboltModel(family)
    talk = Talk(model)
    said = [talk("gom?")]
    talk("@cob1")
    said.append(talk("gom?"))
    talk.wait()
    said.append(talk("gom?"))
    talk("em")
    said.append(talk("gom?"))
    model.open_interlock(talk.now_s)
    said.append(talk("gom?"))
    assert said == [f"{number}\r\n" for number in numbers]


def test_without_autostart_the_program_begins_without_the_key() -> None:
    model = CoboltModel(autostart=False)
    talk = Talk(model)
    talk("p 0.05")
    talk("@cob1")
    talk.wait()
    assert model.emitting
    assert talk("@cob0") == "OK\r\n"
    assert talk("gom?") == "0\r\n"
    talk("@cob1")
    talk.wait()
    assert model.emitting


def test_an_old_laser_refuses_questions_that_others_answer() -> None:
    old = frozenset({"l?", "sn?", "glmp?"})
    talk = Talk(CoboltModel(refuses=old))
    assert {talk(question) for question in old} == {ILLEGAL}
    assert talk("gsn?") == "16328\r\n"


def test_a_fault_is_cleared_once_its_cause_is_gone() -> None:
    model, talk = lit()
    model.open_interlock(talk.now_s)
    assert talk("cf") == "OK\r\n"
    assert (talk("f?"), talk("ilk?")) == ("3\r\n", "1\r\n")
    model.interlock_open = False
    talk("cf")
    assert (talk("f?"), talk("ilk?"), talk("l?")) == ("0\r\n", "0\r\n", "0\r\n")


def test_on_off_modulation_has_its_own_number() -> None:
    _, talk = lit()
    assert talk("eoom") == "OK\r\n"
    assert talk("gom?") == "3\r\n"
    talk("xoom")
    assert talk("gom?") == "2\r\n"


@pytest.mark.parametrize(("command", "unit"), [("p", 1.0), ("slp", 1e3), ("slmp", 1e3)])
def test_a_power_beyond_the_limit_is_out_of_range_and_changes_nothing(command: str, unit: float) -> None:
    talk = Talk(CoboltModel())
    assert talk(f"{command} {0.05 * unit:.4f}") == "OK\r\n"
    assert talk(f"{command} {0.101 * unit:.4f}") == "Syntax error: Value is out of range.\r\n"
    assert talk(f"{command} -1") == "Syntax error: Value is out of range.\r\n"
    assert talk(f"{command} much") == ILLEGAL
    expected = {"p?": "0.0500", "glp?": "50.0"} if command != "slmp" else {"glmp?": "50.0", "p?": "0.0000"}
    for question, answer in expected.items():
        assert talk(question) == f"{answer}\r\n"


def test_modes_have_two_commands_each_and_a_number() -> None:
    talk = Talk(CoboltModel())
    for command, number in (("ci", 0), ("cp", 1), ("ecc", 0), ("ecp", 1), ("em", 2)):
        assert talk(command) == "OK\r\n"
        assert talk("gam?") == f"{number}\r\n"
    assert talk("slc 30") == "OK\r\n"
    assert talk("glc?") == "30.0\r\n"
    assert talk("slc 1000") == ILLEGAL


def test_a_dpl_is_modulated_by_currents() -> None:
    model, talk = lit(family="06-DPL")
    assert talk("slmp 30") == talk("glmp?") == talk("eoom") == ILLEGAL
    assert talk("smc 40") == talk("slth 5") == talk("em") == "OK\r\n"
    assert (talk("gmc?"), talk("glth?")) == ("40.0\r\n", "5.0\r\n")
    assert model.power_w == pytest.approx(0.04)


@pytest.mark.parametrize(("family", "shutter"), [("06-MLD", False), ("06-MLD", True), ("06-01", None)])
def test_l0r_and_l1r_pause_and_resume_where_the_laser_knows_them(family: Family, shutter: bool | None) -> None:
    model, talk = lit(family=family, shutter=shutter)
    knows = shutter is not False
    assert talk("l0r") == ("OK\r\n" if knows else ILLEGAL)
    assert model.emitting is not knows
    assert talk("l?") == "1\r\n"
    talk("l1r")
    assert model.emitting


def test_a_laser_that_starts_says_ok_to_a_power_and_forgets_it() -> None:
    model = CoboltModel(deaf_s=180.0)
    talk = Talk(model)
    talk("p 0.02")
    talk("@cob1")
    assert talk("p 0.05") == "OK\r\n"
    assert talk("p?") == "0.0200\r\n"
    talk.wait(180.0)
    talk("p 0.05")
    assert talk("p?") == "0.0500\r\n"


def test_autostart_that_is_enabled_by_a_command_darkens_the_laser() -> None:
    model = CoboltModel(autostart=False)
    talk = Talk(model)
    talk("l1")
    assert talk("@cobas 1") == "OK\r\n"
    assert not model.on
    assert talk("gas?") == "1\r\n"
    assert model.forbidden == ["@cobas 1"]


def test_the_newer_language_has_short_and_long_words_and_limits() -> None:
    talk = Talk(CoboltModel("06-01"))
    assert talk("LASer:CP:POWer:SETPoint 50.0") == "OK\r\n"
    assert talk("laser:cp:power:setpoint?") == talk("las:cp:pow:setp?") == "50.0000\r\n"
    assert talk("laser:pm:power:setpoint? max") == talk("laser:cp:power:setpoint? max") == "100.0000\r\n"
    assert talk("laser:pm:digital:enabled 1") == "OK\r\n"
    assert talk("las:pm:dig:ena?") == talk("autostart:enabled?") == "1\r\n"
    assert talk("laser:power:reading?") == talk("LASer:POWer?") == "0.0000\r\n"
    assert talk("laser:cp:power:setpoint 101") == "Syntax error: Value is out of range.\r\n"
    assert talk("autostart:abort") == talk("fault:clear") == "OK\r\n"
    assert talk("gom?") == talk("slmp 5") == ILLEGAL
