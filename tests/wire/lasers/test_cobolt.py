"""The Cobolt driver through real pyserial against a model of its firmware: bytes of docs/reference/devices/cobolt.md,
every trap."""

from typing import Any

import pytest

from drivers.clock import now_s
from drivers.errors import DeviceFault, InterlockOpen, ProtocolError, WrongState
from drivers.lasers.cobolt import CoboltConfig, classify
from drivers.lasers.cobolt import create as create_cobolt
from sim_backend.wire.firmware.cobolt import ILLEGAL, MODELS, CoboltModel, Family
from tests.wire.emulated_lasers import bring_up, open_cobolt, overtaken_arm, wire
from tests.wire.faults import Fault, FaultScript

FAMILIES: tuple[Family, ...] = ("06-MLD", "06-01")


def told(model: CoboltModel) -> list[str]:
    """What `arm(0.05)` of a laser that was off sends, but for queries."""
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        model.commands.clear()
        laser.arm(0.05)
        return [command for command in model.commands if not command.endswith("?")]


# The bytes themselves, from docs/reference/devices/cobolt.md.


def test_the_model_answers_as_the_manual_says() -> None:
    model = CoboltModel(gap_s=0.0)
    for sent, answered in [
        (b"?\r", b"OK\r\n"),
        (b"ilk?\r", b"0\r\n"),
        (b"l?\r", b"0\r\n"),
        (b"glm?\r", b"0488-06-01-0100-100\r\n"),
        (b"p 0.05\r", b"OK\r\n"),
        (b"p?\r", b"0.0500\r\n"),
        (b"slmp 20\r", b"OK\r\n"),
        (b"glmp?\r", b"20.0\r\n"),
        (b"em\r", b"OK\r\n"),
        (b"gam?\r", b"2\r\n"),
        (b"l1\r", b"Syntax error: not allowed in autostart mode.\r\n"),
        (b"nonsense\r", b"Syntax error: illegal command\r\n"),
    ]:
        assert model.receive(sent, 0.0) == answered


def test_the_first_commands_are_a_ping_and_questions() -> None:
    model = CoboltModel()
    with wire(model) as (_, surroundings), open_cobolt(surroundings):
        twice = [question for question in ("sn?", "gmlp?", "@cobas?") for _ in range(2)]
        language = ["laser:runmode?", "?", "laser:runmode?", "gam?"]  # a refusal counts if it comes twice
        assert model.commands == ["?", "glm?", "glm?", *language, *twice]


@pytest.mark.parametrize(
    ("family", "sent"),
    [
        ("06-MLD", "slmp 0.0000, p 0, sdmes 1, sames 0, em, @cob1, slmp 50.0000"),
        (
            "06-01",
            "las:paus 1, laser:powermodulation:power:setpoint 0.0000, laser:cp:power:setpoint 0, las:pm:dig:ena 1, "
            "las:pm:ana:ena 0, laser:pm:dig:modulator external, laser:runmode PowerModulation, @cob1, "
            "laser:powermodulation:power:setpoint 50.0000, las:paus 0",
        ),
    ],
)
def test_the_gate_is_set_in_the_dark_before_the_start(family: Family, sent: str) -> None:
    assert told(CoboltModel(family)) == sent.split(", ")


# The traps of docs/reference/devices/cobolt.md, one test each.


def test_trap_commands_closer_than_100_ms_are_not_answered() -> None:
    model = CoboltModel()
    assert [model.receive(b"?\r", at_s) for at_s in (-10.0, -9.95)] == [b"OK\r\n", b""]
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        began_s, n_before = now_s(surroundings.clock), len(model.commands)
        assert laser.status.interlock_closed
        assert now_s(surroundings.clock) - began_s >= 0.1 * (len(model.commands) - n_before)


def test_trap_a_reply_may_take_most_of_a_second() -> None:
    with wire(CoboltModel(), faults=FaultScript(*[None] * 20, late_s=0.8)) as (server, surroundings):
        made = CoboltConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW"})
        with create_cobolt(made, surroundings) as laser:  # with the timing of real life
            server.faults = FaultScript(Fault.LATE, late_s=0.8)
            assert laser.status.interlock_closed
            assert server.faults.struck == [Fault.LATE]


def test_trap_a_reply_that_comes_too_late_is_not_taken_for_the_next_answer() -> None:
    model = CoboltModel(refuses=frozenset())
    with wire(model) as (server, surroundings), open_cobolt(surroundings) as laser:
        for script in ([Fault.LOST], [Fault.STALL], [Fault.MERGED], [Fault.REPEATED], [None, None, Fault.LATE]):
            model.interlock_open = True
            server.faults = FaultScript(*script, late_s=0.5, stall_s=0.3)
            assert not laser.status.interlock_closed
            server.faults = None
            model.interlock_open = False
            status = laser.status
            assert (status.interlock_closed, status.fault, status.key_on) == (True, None, True)


def test_trap_junk_before_a_reply_is_stripped() -> None:
    model = CoboltModel(junk=b"\x00\xff>\r\n ")
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.power_w == pytest.approx(0.05)


def test_trap_an_echo_is_stripped() -> None:
    class Echoing(CoboltModel):
        def _reply(self, command: str, now_s: float) -> bytes:
            return command.encode() + b" " + super()._reply(command, now_s)

    with wire(Echoing()) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.interlock_closed


def test_trap_l1_works_only_where_autostart_is_disabled() -> None:
    without = told(CoboltModel(autostart=False))
    assert "l1" in without
    assert "@cob1" not in without


def test_trap_key_and_autostart_bypasses_are_noticed_wherever_a_driver_sends_them() -> None:
    model = CoboltModel(gap_s=0)
    model.receive(b"@cobas 0\r@cobasky 0\r@cobasdr 1\r", 0)
    assert len(model.forbidden) == 3


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_after_l0_the_key_must_be_turned_and_after_a_pause_not(family: Family) -> None:
    model = CoboltModel(family)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        clock = surroundings.clock
        bring_up(laser, clock)
        laser.pause()
        assert model.on
        assert "l0" not in model.commands
        bring_up(laser, clock)
        laser.disarm()
        assert not model.on
        with pytest.raises(DeviceFault, match="turn the key off and on"):
            laser.arm(0.05)
        assert not laser.status.emission
        assert "key" in str(laser.status.fault)
        model.turn_key(False, now_s(clock))
        assert laser.status.key_on is (None if family == "06-MLD" else False)  # as far as it can be asked
        model.turn_key(True, now_s(clock))
        clock.sleep(10.0)
        assert not laser.status.emission  # it came on by itself, and dark
        bring_up(laser, clock)


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_units_that_refuse_the_questions_for_key_and_autostart_are_asked_otherwise(family: Family) -> None:
    for autostart, start in ((True, "@cob1"), (False, "l1")):
        model = CoboltModel(family, autostart=autostart, refuses=frozenset({"@cobas?", "@cobasks?"}))
        with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
            status = laser.status
            assert (status.key_on, status.fault) == (None, None)
            laser.arm(0.05)
            assert [command for command in model.commands if command in ("@cob1", "l1")] == [start]
            began_s = now_s(surroundings.clock)
            assert laser.status.key_on is None
            assert now_s(surroundings.clock) - began_s < 1.5
            assert model.commands.count("@cobasks?") == (2 if autostart else 0)  # refused twice, not asked any more


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("autostart", [True, False])
def test_a_close_switches_off_where_no_key_must_be_turned_afterwards(family: Family, autostart: bool) -> None:
    model = CoboltModel(family, autostart=autostart)
    with wire(model) as (_, surroundings):
        for _ in range(2):
            with open_cobolt(surroundings) as laser:
                bring_up(laser, surroundings.clock)
                assert model.on
            assert not model.emitting
            assert model.on == autostart


@pytest.mark.parametrize("autostart", [True, False])
def test_a_unit_that_says_nothing_of_key_and_autostart_can_be_started(autostart: bool) -> None:
    refused = {"@cobas?", "@cobasks?", "gas?"} | (set() if autostart else {"@cob1"})
    model = CoboltModel(autostart=autostart, refuses=frozenset(refused))
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.key_on is None
        bring_up(laser, surroundings.clock)
        laser.disarm()
        assert not model.emitting
    assert not model.forbidden


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("number", MODELS.values())
def test_trap_the_language_follows_the_firmware_and_not_the_model_number(family: Family, number: str) -> None:
    model = CoboltModel(family, model=number)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.gated
        assert model.power_w == pytest.approx(0.05)


def test_a_laser_that_knows_neither_language_is_refused() -> None:
    model = CoboltModel(refuses=frozenset({"gam?"}))
    with wire(model) as (_, surroundings), pytest.raises(DeviceFault, match="knows neither of the 06-01 languages"):
        open_cobolt(surroundings)


@pytest.mark.parametrize("refused", ["gmlp?", "laser:cp:power:setpoint? max"])
def test_trap_newer_lasers_state_their_most_power_in_their_own_language(refused: str) -> None:
    model = CoboltModel("06-01", max_power_w=0.06, refuses=frozenset({refused}))
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.limits.max_power_w == pytest.approx(0.06)


def test_a_laser_that_does_not_state_its_most_power_is_refused() -> None:
    model = CoboltModel(refuses=frozenset({"gmlp?"}))
    with wire(model) as (_, surroundings), pytest.raises(ProtocolError, match="does not say its most power"):
        open_cobolt(surroundings)


@pytest.mark.parametrize("words", ["Syntax error: illegal command", "Invalid command", "Error: illegal command"])
def test_a_refusal_may_have_other_words(words: str) -> None:
    class Curt(CoboltModel):
        def _answer(self, command: str, now_s: float) -> str:
            said = super()._answer(command, now_s)
            return words if said == ILLEGAL else said

    with wire(Curt(refuses=frozenset({"@cobasks?"}))) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.key_on is None


def test_trap_p_takes_watts_and_slmp_milliwatts() -> None:
    model = CoboltModel()
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock, 0.0123)
        assert "slmp 12.3000" in model.commands
        assert model.power_w == pytest.approx(0.0123)
        model.shine(0.07, gated=False)
        assert laser.status.emission
        assert laser.status.power_w == pytest.approx(0.07)


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_ilk_1_means_open(family: Family) -> None:
    model = CoboltModel(family)
    model.interlock_open = True
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert not laser.status.interlock_closed
        with pytest.raises(InterlockOpen, match="close it"):
            laser.arm(0.05)
    assert not any(command in ("@cob1", "l1") for command in model.commands)


@pytest.mark.parametrize(("number", "text"), [(1, "temperature"), (3, "interlock"), (4, "constant power"), (9, "9")])
def test_a_fault_is_named_and_refuses_to_arm(number: int, text: str) -> None:
    model = CoboltModel()
    model.fault = number
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert text in str(laser.status.fault)
        with pytest.raises(DeviceFault, match=rf"fault .*{text}.*; clear it at the laser and arm again"):
            laser.arm(0.05)
    assert not model.emitting


def test_trap_06_01_follows_the_external_input_and_not_commands() -> None:
    model = CoboltModel("06-01")
    model.modulator = "command"
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.modulator == "external"
        assert model.gated
        assert laser.status.input_mode == "digital"


def test_trap_analog_modulation_is_switched_off() -> None:
    for family in FAMILIES:
        model = CoboltModel(family)
        model.mode, model.digital, model.analog = "modulation", True, True
        with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
            assert laser.status.input_mode == "mixed"
            bring_up(laser, surroundings.clock)
            assert not model.analog


def test_a_flipped_bit_arms_no_laser_without_its_gate() -> None:
    model = CoboltModel(warm_up_s=0.0)
    model.on, model.mode = True, "modulation"
    query = model._query

    def garble(command: str) -> str | None:
        return "1" if command == "gdmes?" and model.commands.count(command) == 2 else query(command)

    model._query = garble  # type: ignore[method-assign]
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        laser.arm(0.05)  # looks at it twice before it believes that it is gated
        assert model.gated


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"model": "0561-06-91-0100-100"}, "1 kHz"),
        ({"model": "0561-06-91-0100-1100"}, "1 kHz"),
        ({"firmware": "2087"}, "-04- type"),
        ({"model": "0488-71-01-0100-100"}, "no 06-01 type"),
    ],
)
def test_trap_types_with_a_slow_gate_or_none_are_refused(settings: dict[str, Any], text: str) -> None:
    with wire(CoboltModel(**settings)) as (_, surroundings), pytest.raises(DeviceFault, match=text):
        open_cobolt(surroundings)


def test_families_are_told_apart_as_pycobolt_does() -> None:
    for model, family in (
        *((MODELS[family], family) for family in FAMILIES),
        ("0488-06-01-0100-1100-C", "06-01"),
        ("0561-06-91-0050-100", "06-DPL"),
        ("0561-04-01-0050-100", "unknown"),
    ):
        assert classify(model) == family


# Limits, identity, and lasers found in any state.


class Leaky(CoboltModel):
    """One that is not dark where only its power is 0: no source says that it is."""

    @property
    def power_w(self) -> float:
        leaks = self.on and not self.paused and self.mode != "constant current"
        return max(super().power_w, 0.001 if leaks else 0.0)


def sets(model: CoboltModel) -> list[str]:
    return [command for command in model.commands if "?" not in command]


@pytest.mark.parametrize(
    ("refused", "paused"),
    [
        ((), ["l0r", "slmp 0.0000", "p 0"]),
        (("l0r", "l1r"), ["slmp 0.0000", "p 0", "slc 0", "ecc"]),
    ],
)
def test_trap_a_power_of_0_need_not_be_dark_so_a_pause_blanks_the_light(
    refused: tuple[str, ...], paused: list[str]
) -> None:
    model = Leaky(refuses=frozenset(refused), shutter=True, warm_up_s=0.0)
    model.current_ma = 40.0
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        for _ in range(3):
            bring_up(laser, surroundings.clock)
            assert model.gated
            assert model.power_w == pytest.approx(0.05)
            laser.pause()
            assert not model.emitting
            assert not laser.status.emission
            assert model.on  # no key needed
        model.commands.clear()
        bring_up(laser, surroundings.clock)
        laser.arm(0.02)
        assert model.power_w == pytest.approx(0.02)
        model.commands.clear()
        laser.pause()
        assert sets(model) == paused
        assert not model.emitting
    assert "l0" not in model.commands


def test_a_unit_without_the_command_to_blank_is_asked_for_it_once() -> None:
    model = CoboltModel(refuses=frozenset({"l0r", "l1r"}))
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        for _ in range(3):
            bring_up(laser, surroundings.clock)
            laser.pause()
    assert model.commands.count("l0r") == 2  # the second one confirms that it was no flipped bit
    assert "l1r" not in model.commands


def test_a_laser_that_was_blanked_and_switched_off_shines_after_the_next_start() -> None:
    model = CoboltModel(shutter=True)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        laser.pause()
        laser.disarm()
        assert model.paused  # as the driver must expect
        for on in (False, True):
            model.turn_key(on, now_s(surroundings.clock))
        bring_up(laser, surroundings.clock)
        assert model.power_w == pytest.approx(0.05)


def test_a_laser_that_is_off_is_not_blanked() -> None:
    model = CoboltModel()
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        laser.pause()
        laser.arm(0.05)
        assert "l0r" not in model.commands
        assert "l1r" not in model.commands


def test_a_laser_that_ends_no_pause_before_it_is_on_can_be_armed_again_later() -> None:
    class Early(CoboltModel):
        def _act(self, name: str, value: str, now_s: float) -> bool:
            return (name != "l1r" or self.on) and super()._act(name, value, now_s)

    model = Early(shutter=True, warm_up_s=30.0)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        laser.arm(0.05)
        laser.pause()  # while it warms up
        laser.arm(0.05)
        surroundings.clock.sleep(40.0)
        assert not laser.status.warming_up
        assert model.on
        assert not model.emitting
        laser.arm(0.05)
        assert model.power_w == pytest.approx(0.05)


class Stubborn(CoboltModel):
    """A laser that says yes to another power and keeps its own."""

    def _set(self, name: str, value: str) -> bool:
        return name == "slmp" or super()._set(name, value)


def test_an_arm_that_fails_blanks_the_light_even_if_the_power_does_not_obey() -> None:
    model = Stubborn()
    model.shine(0.06)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(DeviceFault, match="glmp"):
            laser.arm(0.01)
        assert not model.emitting


@pytest.mark.parametrize("refused", [("las:paus",), ("las:paus", "l0r")])
def test_a_newer_laser_that_refuses_to_pause_is_blanked_otherwise_or_switched_off(refused: tuple[str, ...]) -> None:
    model = CoboltModel("06-01", refuses=frozenset(refused))
    model.shine(0.06)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        laser.pause()
        assert not model.emitting
        assert model.on == (len(refused) == 1)


def test_a_laser_found_at_constant_current_that_cannot_be_blanked_needs_no_key_after_a_pause() -> None:
    model = CoboltModel(refuses=frozenset({"l0r", "l1r"}))
    model.on, model.mode, model.current_ma = True, "constant current", 50.0
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.emission
        laser.pause()
        assert not model.emitting
        assert model.on
        assert not laser.status.emission
        bring_up(laser, surroundings.clock)
        assert model.gated
        assert model.power_w == pytest.approx(0.05)
        assert model.current_ma == 0  # never put back while the laser is on


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("gated", [True, False])
def test_a_laser_found_emitting_says_so_and_can_be_paused(family: Family, gated: bool) -> None:
    model = CoboltModel(family)
    model.shine(0.06, gated=gated)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        status = laser.status
        assert (status.emission, status.armed) == (True, False)
        assert (status.input_mode == "digital") == gated
        laser.pause()
        assert not model.emitting
        assert model.on  # no key needed
        assert not laser.status.emission
    with wire(model, clock=surroundings.clock) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert not laser.status.emission  # the next program sees that it is dark


@pytest.mark.parametrize("family", FAMILIES)
def test_a_laser_found_emitting_at_constant_current_is_switched_off(family: Family) -> None:
    model = CoboltModel(family, shutter=True)
    model.on, model.mode, model.current_ma = True, "constant current", 50.0
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.emission
        laser.pause()
        assert not model.on
        assert not laser.status.emission


def test_a_laser_that_keeps_its_power_is_switched_off_by_a_pause() -> None:
    model = Stubborn()
    model.shine(0.06)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(DeviceFault, match="glmp"):
            laser.arm(0.01)
        laser.pause()
        assert not model.emitting


def test_arm_that_fails_half_way_leaves_it_dark() -> None:
    class NoGate(CoboltModel):
        def _set(self, name: str, value: str) -> bool:
            return name != "sames" and super()._set(name, value)

    model = NoGate()
    model.on, model.analog = True, True
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(ProtocolError, match="refuses 'sames 0'"):
            laser.arm(0.05)
        assert not model.emitting
        assert not laser.status.armed


def test_a_pause_from_another_thread_ends_an_arm_before_it_lights() -> None:
    model = CoboltModel()
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert isinstance(overtaken_arm(laser, model, b"@cob1"), WrongState)
        assert "slmp 50.0000" not in model.commands
        assert not model.emitting
