"""A laser that is switched by hand: nobody may take it for dark, and nobody may arm it at another power."""

import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock
from drivers.errors import DeviceNotFound, LimitExceeded
from drivers.guard.process import Rescue
from drivers.interfaces import DeviceState
from drivers.lasers.ttl import BY_HAND, TtlConfig, TtlLaser, create
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from rig.config.files import load_config
from rig.devices import doctor
from rig.devices.open import OpenRig, light_problems, open_rig
from rig.devices.prepare import prepare
from rig.errors import DevicesError, PlanError

HAND = {"kind": "ttl", "power": "20 mW", "max_power": "50 mW"}


def test_a_config_needs_the_power_that_is_set_and_a_limit_above_it() -> None:
    config = TtlConfig.model_validate(HAND)
    assert (config.power, config.max_power, config.port) == (0.02, 0.05, None)
    for given in ({"power": "20 mW"}, {"max_power": "20 mW"}, HAND | {"power": 0.02}, HAND | {"power": "0 W"}):
        with pytest.raises(ValidationError):
            TtlConfig.model_validate(given)
    with pytest.raises(ValidationError, match="power 60 mW is above max_power 50 mW; set the laser to less"):
        TtlConfig.model_validate(HAND | {"power": "60 mW"})
    assert TtlConfig.model_validate(HAND | {"power": "50 mW"}).power == 0.05


def test_it_has_no_port_but_that_of_an_emulating_world() -> None:
    for port in ("/dev/ttyUSB0", "COM5", "emulated:", ""):
        with pytest.raises(ValidationError, match="switched by hand has none; leave it out"):
            TtlConfig.model_validate(HAND | {"port": port})
    config = TtlConfig.model_validate(HAND | {"port": "emulated:laser"})
    with pytest.raises(DeviceNotFound, match="this rig emulates no devices"):
        create(config, Surroundings(SystemClock(), None, 0))

    def at(address: str) -> Surroundings:
        return Surroundings(SystemClock(), None, 0, {"laser": Endpoint(address)})

    with create(config, at(f"{BY_HAND}0.02")) as laser:
        assert laser.limits.max_power_w == 0.02
    with pytest.raises(DeviceNotFound, match=r"set to 60 mW by hand, not 20 mW; make laser.power and world.ttl_power"):
        create(config, at(f"{BY_HAND}0.06"))
    with pytest.raises(DeviceNotFound, match=r"set world.laser to ttl"):
        create(config, at("/dev/pts/3"))


def test_it_is_armed_at_the_power_that_is_set_and_at_no_other() -> None:
    with TtlLaser.open(power_w=0.02) as laser:
        assert (laser.limits.min_power_w, laser.limits.max_power_w) == (0.02, 0.02)
        for power_w in (0.0, 0.0199, 0.0201, 0.05):
            with pytest.raises(LimitExceeded, match=r"outside 0\.02 to 0\.02 W"):
                laser.arm(power_w)
        assert not laser.status.armed
        laser.arm(0.02)
        assert laser.status.armed
        assert "20 mW, set by hand" in laser.identity
    for wrong in ({"power_w": float("nan")}, {"power_w": -1.0}, {"power_w": 0.02, "max_power_w": 0.01}):
        with pytest.raises(LimitExceeded):
            TtlLaser.open(**wrong)


def test_arming_says_plainly_that_only_the_gate_controls_the_light(caplog: pytest.LogCaptureFixture) -> None:
    with TtlLaser.open(power_w=0.02) as laser:
        laser.arm(0.02)
        (record,) = [record for record in caplog.records if record.levelno == logging.WARNING]
        for words in ("only the gate controls its light", "cannot switch it off", "at 20 mW", "by hand"):
            assert words in record.getMessage()
        caplog.clear()
        laser.disarm()
        assert "not switched off" in caplog.text


def test_nothing_makes_it_count_as_dark() -> None:
    laser = TtlLaser.open(power_w=0.02)
    assert laser.gate_only
    verbs: tuple[Callable[[], object], ...] = (lambda: None, lambda: laser.arm(0.02), laser.pause, laser.disarm)
    for verb in verbs:
        verb()
        status = laser.status
        assert status.emission
        assert (status.interlock_closed, status.key_on, status.fault, status.power_w) == (None, None, None, None)
    laser.arm(0.02)
    laser.pause()
    assert (laser.state, laser.status.armed) == (DeviceState.CONFIGURED, True)
    laser.close()


def test_its_light_counts_as_real_unless_a_world_emulates_it() -> None:
    for port, slots in (({}, ("laser ttl",)), ({"port": "emulated:laser"}, ())):
        config = load_config("simulated", {"laser": HAND | port})
        problems = light_problems(config, arm=False)
        assert len(problems) == len(slots)
        assert all(slot in problems[0] for slot in slots)
        assert not light_problems(config, arm=True)


def test_the_guard_has_no_bytes_that_switch_it_off() -> None:
    assert lookup("laser", "ttl").off is None


def test_a_rescue_by_the_application_does_not_count_it_as_safe() -> None:
    outcome = Rescue({"laser": TtlConfig.model_validate(HAND)}, {}).run({"laser"}, armed=True)
    assert outcome == "laser: NOT switched off, only its gate ends it"


def test_a_rig_with_it_opens_although_it_emits_and_plans_for_its_power_only() -> None:
    small = {"scan.columns": 8, "scan.exposures": 2, "scan.command_range": [-0.1, 0.1], "laser": HAND}
    with open_rig(load_config("simulated", small | {"scan.power": "20 mW"})) as rig:
        assert rig.laser.gate_only  # told by the guard
        assert rig.laser.status.emission
        prepare(rig)
        for power, words in (("10 mW", "the least ttl laser may give is 20 mW"), ("30 mW", "the most ttl laser")):
            other = load_config("simulated", small | {"scan.power": power})
            with pytest.raises(PlanError, match=words):
                prepare(OpenRig(**{field: getattr(rig, field) for field in _FIELDS} | {"config": other}))


_FIELDS = tuple(OpenRig.__dataclass_fields__)


def test_the_doctor_says_that_only_the_gate_ends_its_light() -> None:
    with TtlLaser.open(power_w=0.02) as laser:
        found = doctor._laser(cast(Any, SimpleNamespace(laser=laser)))
    assert found.ok
    assert "only its gate ends its light: switch it on and off by hand" in found.text
    assert "interlock closed" not in found.text


def test_switching_the_laser_off_fails_but_lowers_the_gate() -> None:
    config = load_config("simulated", {"laser": HAND})
    with pytest.raises(DevicesError) as raised:
        doctor.laser_off(config)
    said = str(raised.value)
    assert "\n" not in said
    for words in (
        "cannot be switched off from here",
        "switch it off by hand",
        "(done: simulated sync: all outputs low)",
    ):
        assert words in said
