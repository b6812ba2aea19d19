"""Every line laser: power limits, arm, pause and disarm, what it says of itself, dark when left."""

import pytest

from drivers.errors import LimitExceeded
from drivers.interfaces import DeviceState
from tests.conformance.cases import LaserCase, require_final

WARM_UP_S = 600.0
POLL_S = 0.1


def usual_power(case: LaserCase) -> float:
    limits = case.device.limits
    return (limits.min_power_w + limits.max_power_w) / 2


def await_emission(case: LaserCase) -> None:
    """Emission may follow late: a warm-up, a safety delay."""
    waited_s = 0.0
    while not case.device.status.emission:
        assert waited_s < WARM_UP_S, "no emission"
        case.clock.sleep(POLL_S)
        waited_s += POLL_S


def check_dark(case: LaserCase, *, armed: bool) -> None:
    status = case.device.status
    assert (status.emission, status.armed) == (False, armed)
    assert not case.shining()


def test_it_is_found_dark_and_describes_itself(laser: LaserCase) -> None:
    limits, status = laser.device.limits, laser.device.status
    assert laser.device.name
    assert 0 <= limits.min_power_w < limits.max_power_w
    assert status.interlock_closed
    assert status.fault is None
    assert status.input_mode
    check_dark(laser, armed=False)


def test_power_beyond_the_limits_is_refused_with_value_and_limit_and_arms_nothing(laser: LaserCase) -> None:
    limits = laser.device.limits
    for power_w in (limits.max_power_w * 1.01, limits.min_power_w - 1e-3, float("nan"), float("inf")):
        with pytest.raises(LimitExceeded) as refused:
            laser.device.arm(power_w)
        for number in (power_w, limits.max_power_w):
            assert f"{number:g} W" in str(refused.value)
        check_dark(laser, armed=False)
    assert laser.device.state is DeviceState.READY


def test_armed_it_emits_under_the_gate_also_at_another_power_and_at_its_limit(laser: LaserCase) -> None:
    for power_w in (usual_power(laser), laser.device.limits.max_power_w):
        laser.device.arm(power_w)
        await_emission(laser)
    status = laser.device.status
    assert status.armed
    assert not status.warming_up
    assert laser.shining()
    assert laser.device.state is DeviceState.RUNNING


def test_a_pause_is_dark_and_armed_and_ends_with_the_next_arm(laser: LaserCase) -> None:
    laser.device.arm(usual_power(laser))
    await_emission(laser)
    laser.device.pause()
    check_dark(laser, armed=True)
    assert laser.device.state is DeviceState.CONFIGURED
    laser.device.pause()
    laser.device.arm(usual_power(laser))
    await_emission(laser)


def test_disarmed_it_is_dark_and_not_armed(laser: LaserCase) -> None:
    laser.device.arm(usual_power(laser))
    await_emission(laser)
    laser.device.disarm()
    check_dark(laser, armed=False)
    assert laser.device.state is DeviceState.READY


def test_a_pause_while_it_warms_up_holds(laser: LaserCase) -> None:
    laser.device.arm(usual_power(laser))
    laser.device.pause()
    laser.clock.sleep(WARM_UP_S)
    check_dark(laser, armed=True)


def test_pause_and_disarm_are_possible_in_any_state(laser: LaserCase) -> None:
    for _ in range(2):
        laser.device.pause()
        check_dark(laser, armed=False)
        laser.device.disarm()
        check_dark(laser, armed=False)
    assert laser.device.state is DeviceState.READY


def test_it_closes_for_good_and_dark_whatever_happened(laser: LaserCase) -> None:
    device = laser.device
    device.arm(usual_power(laser))
    await_emission(laser)
    require_final(device, lambda: device.arm(0.0), device.pause, device.disarm, lambda: device.status)
    assert not laser.shining()
