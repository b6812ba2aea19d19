"""The iBeam driver on an emulated wire; what all serial lasers share is in test_serial_lasers.py."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from drivers.clock import now_s
from drivers.errors import DeviceError, DeviceFault, DeviceNotFound, ProtocolError, WrongState
from drivers.interfaces import LineLaser
from drivers.lasers.ibeam import KIND, IbeamConfig, IbeamFraming
from sim_backend.wire.firmware.ibeam import BIAS, NORMAL, UNKNOWN, IbeamModel
from tests.wire.emulated_lasers import USUAL, open_ibeam, overtaken_arm, wire


class Odd(IbeamModel):
    """A unit that gives other answers to some commands, which it does not carry out."""

    def __init__(self, answers: dict[str, list[str]], **settings: Any) -> None:
        super().__init__(**settings)
        self.answers = answers

    def _query(self, words: str) -> list[str] | None:
        return self.answers.get(words) or super()._query(words)


class Cold(IbeamModel):
    """One that comes on late, and says so."""

    def _query(self, words: str) -> list[str] | None:
        late = words == "status laser" and self.state_on and self._now_s < self._lit_at_s
        return ["OFF"] if late else super()._query(words)


class Forgetful(IbeamModel):
    """One whose `laser on` takes the input's control away, and that gives it only while it is on."""

    def _obey(self, words: str) -> list[str]:
        if words == "enable ext" and not self.state_on:
            return ["%SYS-E-031, laser is off"]
        said = super()._obey(words)
        self.ext &= words != "laser on"
        return said


@contextmanager
def opened(model: IbeamModel, **config: Any) -> Iterator[LineLaser]:
    with wire(model) as (_, surroundings), open_ibeam(surroundings, **config) as device:
        yield device


def sets(model: IbeamModel) -> list[str]:
    """The commands that ask nothing."""
    return [said for said in model.commands if said.split()[0] not in ("sta", "status", "show", "sh", "version")]


# Answers that clients have recorded from real units; docs/reference/devices/ibeam.md names them.
@pytest.mark.parametrize(
    ("answer", "reply"),
    [
        ("\r\n[OK]\r\n", "OK"),
        ("\r\n%SYS-I-077, scaled\r\nPIC  = 012000 uW  \r\n[OK]\r\n", "PIC  = 012000 uW"),
        ("\r\nCH1, PWR:  2.000 mW\r\nCH2, PWR:  0.000 mW\r\n[OK]\r\n", "CH1, PWR:  2.000 mW; CH2, PWR:  0.000 mW"),
        ("\r\n%SYS-W-047, access restricted\r\n[OK]\r\n", "%SYS-W-047, access restricted"),
        ("\r\n" * 500, ""),
    ],
)
def test_an_answer_is_read_up_to_ok_and_only_warnings_and_errors_refuse(answer: str, reply: str) -> None:
    lines, framing = iter(answer.split("\r\n")), IbeamFraming()
    assert framing.read("x", lambda: next(lines).strip()) == reply
    assert (framing.refusal(reply) is not None) == reply.startswith("%SYS")


def test_commands_and_the_bytes_of_off_end_with_crlf() -> None:
    assert IbeamFraming().encode("laser on") == b"laser on\r\n"
    assert KIND.off is not None
    off = KIND.off(IbeamConfig.model_validate(USUAL))
    assert off == b"laser off\r\n"
    model = IbeamModel(lag_gap_s=0.049)
    model.shine(0.05)
    for at_s, said in enumerate((b"channel 2 po", off, off)):  # a program that died, and the guard
        model.receive(said, float(at_s))
    assert not model.emitting
    assert not model.lagging


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("prompt", [True, False])
def test_echo_and_prompt_are_put_off_and_back(echo: bool, prompt: bool) -> None:
    model = IbeamModel(echo=echo, prompt=prompt)
    with opened(model) as device:
        assert (model.echo, model.prompt) == (False, False)
        device.arm(0.05)
    assert (model.echo, model.prompt) == (echo, prompt)
    model = IbeamModel(echo=echo, prompt=prompt)
    with wire(model) as (_, surroundings), pytest.raises(DeviceNotFound, match="not 999"):
        open_ibeam(surroundings, serial_number="999")
    assert (model.echo, model.prompt) == (echo, prompt), "also if it cannot be opened"
    assert not model.state_on


def test_the_most_power_is_asked_of_older_units_too_and_must_be_said() -> None:
    restricted = ["%SYS-W-047, access restricted"]
    with opened(Odd({"show satellite": restricted}), max_power="2 W") as device:
        assert device.limits.max_power_w == 0.15
    silent = Odd({"show satellite": restricted, "show data": ["   enable EXT: OFF"]})
    with pytest.raises(ProtocolError, match="does not say its most power"), opened(silent):
        pass


def test_it_is_named_by_the_end_of_its_serial_number_or_all_of_it() -> None:
    for given in (None, "12345", "iBEAM-SMART-640-S-A3-12345"):
        with opened(IbeamModel(), serial_number=given) as device:
            assert device.name == "iBeam smart iBEAM-SMART-640-S-A3-12345"


@pytest.mark.parametrize(
    ("answers", "error", "match"),
    [
        ({"show serial": ["SN: 1"], "version": ["V1"]}, DeviceNotFound, "no iBeam smart"),
        ({"show system": ["   pulse board: no"]}, DeviceFault, "no pulse board"),
        ({"show system": ["   SPP modes: CW (On2)"]}, DeviceFault, "CW mode of Micro-Manager"),
    ],
)
def test_another_device_and_one_without_a_gate_are_refused(
    answers: dict[str, list[str]], error: type[DeviceError], match: str
) -> None:
    with pytest.raises(error, match=match), opened(Odd(answers)):
        pass


def test_a_unit_that_says_nothing_of_its_pulse_board_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with opened(Odd({"show system": ["%SYS-W-047, access restricted"]})):
        assert "make sure that the gate switches it" in caplog.text


def test_trap_a_unit_whose_replies_come_one_late_is_switched_off_and_refused() -> None:
    model = IbeamModel(lagging=True)
    model.shine(0.05)
    with pytest.raises(DeviceFault, match="replies come one command late"), opened(model):
        pass
    assert not model.emitting


def test_the_gate_is_set_up_while_it_is_off_and_the_power_comes_last() -> None:
    model = IbeamModel()
    with opened(model) as device:
        assert device.status.input_mode == "constant power"
        model.commands.clear()
        device.arm(0.05)
        assert sets(model) == [
            "laser off",
            "channel 1 power 0.000 micro",
            "channel 2 power 0.000 micro",
            "disable ext",  # channel 2 could not be enabled while it is on
            "enable 2",
            "enable ext",
            "laser on",
            "enable ext",
            "channel 2 power 50000.000 micro",
        ]
        status = device.status
        assert (status.emission, status.armed, status.input_mode) == (True, True, "digital")
        assert (status.key_on, status.interlock_closed, status.fault) == (None, None, None)
        assert (status.temperature_c, status.power_w) == (30.2, 0.0)  # measured, and the gate is low
        model.commands.clear()
        device.arm(0.06)  # under the gate already
        assert sets(model) == ["channel 2 power 60000.000 micro"]


TRAPS: dict[str, Callable[[], IbeamModel]] = {
    "a bias that shines whatever the gate does": IbeamModel,
    "laser on enables no channel": partial(IbeamModel, default_channel=None, enabled=set()),
    "channels that shine though disabled": partial(IbeamModel, disabled_shine=True, enabled=set()),
    "a third channel": partial(IbeamModel, powers_w={1: 0.01, 2: 0.01, 3: 0.02}, enabled={1, 3}),
    "channel 2 cannot be enabled while ext is": partial(IbeamModel, ext=True),
    "FINE": partial(IbeamModel, fine=True),
    "gabby talk": partial(IbeamModel, talk="gabby"),
    "quiet talk": partial(IbeamModel, talk="quiet", echo=False, prompt=False),
    "replies late by one after hurried commands": partial(IbeamModel, lag_gap_s=0.049),
    "laser on takes ext away": Forgetful,
    "older: no FINE, no CLIP, no power": partial(
        Odd, {said: [UNKNOWN] for said in ("status fine", "status clip", "show power")}
    ),
}


@pytest.mark.parametrize("shines", [False, True])
@pytest.mark.parametrize("name", TRAPS)
def test_trap(name: str, shines: bool) -> None:
    model, leaks = TRAPS[name](), []
    if shines:
        model.shine(0.02, gated=False)
    with opened(model) as device:
        assert device.status.emission == shines
        model.on_emission = lambda emits, at_s: leaks.append(model.closed_gate_power_w)
        if shines:
            device.pause()
            assert not model.emitting
        device.arm(0.05)
        assert (model.power_w, model.closed_gate_power_w) == (pytest.approx(0.05), 0)
        assert (device.status.input_mode, device.status.fault, model.fine) == ("digital", None, False)
        device.pause()
        device.arm(0.03)
        assert model.power_w == pytest.approx(0.03)
        assert not any(leaks)
        device.disarm()
        assert (model.state_on, model.powers_w[NORMAL], device.status.armed) == (False, 0.0, False)


def test_what_a_unit_does_not_know_is_not_asked_again() -> None:
    model = Odd({"status clip": [UNKNOWN]})
    with opened(model) as device:
        device.arm(0.05)
        asked = model.commands.count("sta clip")
        assert asked
        assert device.status.fault is None
        assert model.commands.count("sta clip") == asked


def test_an_input_that_is_never_enabled_leaves_it_dark() -> None:
    model = Odd({"enable ext": [UNKNOWN]})
    with opened(model) as device:
        with pytest.raises(DeviceError, match="refuses 'enable ext'"):
            device.arm(0.05)
        assert not model.state_on
        assert model.powers_w[NORMAL] == 0


def test_light_that_leaks_past_the_gate_is_a_fault_that_arming_again_mends() -> None:
    model = IbeamModel()
    with opened(model) as device:
        for leak, said in (("ch 1 pow 1", "digital over a bias of 1 mW"), ("di ext", "constant power")):
            device.arm(0.05)
            device.ask(leak)  # type: ignore[attr-defined]
            assert model.closed_gate_power_w > 0
            assert device.status.fault == f"its light is under {said}, not only the gate"
        device.arm(0.05)
        assert (device.status.fault, model.closed_gate_power_w) == (None, 0)


def test_a_laser_that_does_not_obey_off_is_not_taken_for_dark() -> None:
    model = IbeamModel()
    with wire(model) as (_, surroundings):
        device = open_ibeam(surroundings)
        device.arm(0.05)
        model._switch_laser = lambda on: ""  # type: ignore[method-assign]
        for verb in (device.pause, device.disarm, device.close):
            with pytest.raises(DeviceFault, match="told 'laser off'"):
                verb()


def test_a_laser_that_goes_off_by_itself_has_a_fault_until_it_is_armed_again() -> None:
    model = IbeamModel()
    with opened(model) as device:
        for lock, said in (
            (model.open_interlock, "laser locked"),
            (lambda at_s: model.set_fault("too hot", at_s), "too hot"),
        ):
            device.arm(0.05)
            lock(model._now_s)
            status = device.status
            assert not status.emission
            assert "went off by itself: its key, its interlock or a fault" in str(status.fault)
            with pytest.raises(DeviceError, match=said):
                device.arm(0.05)
            model.interlock_open, model.fault = False, ""
        device.arm(0.05)
        assert device.status.fault is None
        model.clip = "FAIL"
        with pytest.raises(DeviceFault, match="clipped"):
            device.arm(0.05)


def test_arm_waits_until_it_is_on_and_a_pause_ends_the_wait() -> None:
    model = Cold(on_delay_s=4.0)
    with wire(model) as (_, surroundings), open_ibeam(surroundings) as device:
        device.arm(0.05)
        assert now_s(surroundings.clock) > 4.0
        assert device.status.emission
    model = Cold(on_delay_s=9.0)
    with opened(model) as device:
        assert isinstance(overtaken_arm(device, model, b"laser on"), WrongState)
        assert not model.state_on
    with opened(Cold(on_delay_s=11.0)) as device, pytest.raises(DeviceFault, match="not on 10 s after 'laser on'"):
        device.arm(0.05)


def test_one_that_was_power_cycled_hears_off_but_must_be_opened_again() -> None:
    model = IbeamModel()
    with wire(model) as (_, surroundings):
        device = open_ibeam(surroundings)
        device.arm(0.05)
        model.power_up(model._now_s)
        model.shine(0.05)
        with pytest.raises(DeviceError):
            device.pause()
        assert not model.state_on
        device.close()
        with open_ibeam(surroundings) as again:
            again.arm(0.05)
            assert model.closed_gate_power_w == 0 < model.power_w
            assert model.powers_w[BIAS] == 0


def test_a_laser_that_shines_and_cannot_be_used_is_told_to_switch_off() -> None:
    model = IbeamModel(pulse_board=False)
    model.shine(0.02, gated=False)
    with wire(model) as (_, surroundings), pytest.raises(DeviceFault, match="no pulse board"):
        open_ibeam(surroundings)
    assert model.closed_gate_power_w == 0
